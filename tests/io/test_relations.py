"""Files of relations between scans."""

import numpy as np
import pytest

from uwblite.errors import FormatError
from uwblite.io.tum import read_relations


def test_relations_are_read(tmp_path):
    path = tmp_path / "truth.relations"
    path.write_text("# by hand\n10.5 9.25 0.5 -0.1 9 9 9 1.5\n\n1134864645.90321 1134864646.32420 1 2 0 0 0 -0.2\n")
    first, second, T_first_second = read_relations(path)
    np.testing.assert_array_equal(first, [10.5, 1134864645.90321])
    np.testing.assert_array_equal(second, [9.25, 1134864646.32420])
    np.testing.assert_array_equal(T_first_second, [[0.5, -0.1, 1.5], [1.0, 2.0, -0.2]])


@pytest.mark.parametrize(
    ("text", "message"), [("1 2 3\n", "expected 8: stamp1 stamp2 x y z roll pitch yaw"), ("# none\n", "no relations in it")]
)
def test_damaged_files_are_named(tmp_path, text, message):
    path = tmp_path / "truth.relations"
    path.write_text(text)
    with pytest.raises(FormatError, match=message):
        read_relations(path)
