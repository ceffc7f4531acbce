"""A sample of tools/fuzz.py: every reader and every verb on damaged files; and that a fault would be seen."""

import numpy as np
import pytest
from fuzz import try_case
from fuzzing.damage import damaged
from fuzzing.readers import Case, cases
from fuzzing.small_files import LOG

CASES = cases()


@pytest.mark.parametrize("name", CASES)
def test_damaged_inputs_are_at_worst_one_clear_line(name):
    assert try_case(name, CASES[name], seed=11, numbers=range(max(4 // CASES[name].cost, 1))).faults == []


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_many_damaged_inputs_are_at_worst_one_clear_line(name):
    assert try_case(name, CASES[name], seed=12, numbers=range(max(40 // CASES[name].cost, 2))).faults == []


@pytest.mark.parametrize("name", [name for name in CASES if not name.startswith("localize in ")])
def test_whole_inputs_are_read(name, tmp_path):
    """What is refused from the first says nothing of a reader's depths."""
    case = CASES[name]
    case.prepare(tmp_path)
    if name not in ("ros1 bag", "constraints of map", "other programs"):
        case.read(tmp_path / case.file)


def test_the_same_number_is_the_same_damage():
    one, same, other = (damaged(LOG, np.random.default_rng([1, 2, k])) for k in (3, 3, 4))
    assert one == same != other


def test_faults_are_seen_and_kept(tmp_path):
    def careless(path):
        data = path.read_bytes()
        if len(data) != len(LOG):
            raise KeyError(len(data))

    case = Case("x.log", careless, lambda folder: (folder / "x.log").write_bytes(LOG))
    outcome = try_case("careless", case, seed=1, numbers=range(20), keep=tmp_path / "kept")
    assert outcome.faults
    assert all("KeyError" in wrong for _, wrong in outcome.faults)
    assert len(list((tmp_path / "kept").iterdir())) == len(outcome.faults)
    assert try_case("careless", case, seed=1, numbers=range(1), least_bytes=5000).size >= 5000
