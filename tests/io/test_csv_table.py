"""Tables with a header: columns by name, clear errors with line numbers."""

import numpy as np
import pytest

from uwblite.errors import FormatError
from uwblite.io.csv_table import read_csv


@pytest.fixture
def table_of(tmp_path):
    def read(text):
        path = tmp_path / "table.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_csv(path)

    return read


def test_columns_are_found_by_name(table_of):
    table = table_of('# made by hand\nid, x,y,note,height\nDD07,1.5,-2,,\n\n1E05,0.25,3e1,"a, b",2\n')
    assert table.texts("id") == ("DD07", "1E05")
    np.testing.assert_array_equal(table.numbers("y", "x"), [[-2.0, 1.5], [30.0, 0.25]])
    assert table.texts("note") == ("", "a, b")
    assert table.texts("absent", default="-") == ("-", "-")
    np.testing.assert_array_equal(table.numbers("radius", default=0.3), [[0.3], [0.3]])
    np.testing.assert_array_equal(table.numbers("height", default=0.6), [[0.6], [2.0]])


def test_a_header_alone_is_an_empty_table(table_of):
    assert table_of("id,x,y\n").numbers("x", "y").shape == (0, 2)


def test_byte_order_mark_and_windows_line_ends(table_of):
    table = table_of(b"\xef\xbb\xbfid,x\r\nA,1\r\n")
    assert table.texts("id") == ("A",)
    assert table.numbers("x")[0, 0] == 1.0


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("id,x\nA,1\nB\n", r"table.csv:3: has 1 fields where the header names 2"),
        ("id,x\nA,one\n", r"table.csv:2: x is 'one', not a number"),
        ("id,x\nA,inf\n", r"table.csv:2: x is 'inf'"),
        ("id,x\nA,\n", r"table.csv:2: x is ''"),
        ("id,y\nA,1\n", r"table.csv:1: has no column 'x'; its header is 'id,y'"),
        ("# nothing\n", "holds no table"),
        (b"\xff\xfa,1\n", "not UTF-8"),
        (b"id\0\n", "binary"),
    ],
)
def test_errors_report_where(table_of, text, problem):
    with pytest.raises(FormatError, match=problem):
        table_of(text).numbers("x")


def test_nan_is_a_number_without_meaning(table_of):
    assert np.isnan(table_of("id,x\nA,nan\n").numbers("x")[0, 0])
