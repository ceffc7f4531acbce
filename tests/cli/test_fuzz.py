"""Hostile and broken files of every kind through the command line: one clear line, no internal error, nothing outside --out."""

import gzip

import numpy as np
import pytest
from helpers.small_files import ANCHORS, G2O, KNOWN, LOG, PYFG, SETTINGS

from uwblite.cli import main

pytestmark = pytest.mark.slow

ODDITIES = (*b"nan inf -inf 1e400 1e20 -1 0 999999999999999999999 ../../x".split(), b"", b"\0", b"\xff\xfe", b'"', b"[", b"=")


def mutations(whole, count, seed):
    """Yield damaged versions: bytes changed, tokens replaced, lines doubled, dropped or swapped, the end cut off."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        kind = rng.integers(5)
        if kind == 0:
            data = bytearray(whole)
            for place in rng.integers(0, len(data), rng.integers(1, 6)):
                data[place] = rng.integers(256)
            yield bytes(data)
        elif kind == 1:
            lines = [line.split(b" ") for line in whole.split(b"\n")]
            line = lines[rng.integers(len(lines))]
            line[rng.integers(len(line))] = ODDITIES[rng.integers(len(ODDITIES))]
            yield b"\n".join(b" ".join(words) for words in lines)
        elif kind == 2:
            lines = whole.split(b"\n")
            yield b"\n".join(lines[k] for k in rng.integers(0, len(lines), len(lines)))
        elif kind == 3:
            yield whole[: rng.integers(len(whole))]
        else:
            packed = bytearray(gzip.compress(whole, mtime=0))
            packed[rng.integers(10, len(packed))] ^= 1 << rng.integers(8)
            yield bytes(packed)


CASES = {
    "check": (LOG, "x.log", ["check", "{file}"]),
    "map": (LOG, "x.log", ["map", "{file}", "--out", "{out}/map", "--force"]),
    "convert": (LOG, "x.log", ["convert", "{file}", "{out}/y.log", "--force"]),
    "g2o": (G2O, "x.g2o", ["optimize", "{file}", "--out", "{out}/y.pyfg", "--force"]),
    "pyfg": (PYFG, "x.pyfg", ["optimize", "{file}", "--out", "{out}/y.g2o", "--from-odometry", "--force"]),
    "settings": (SETTINGS, "x.toml", ["config", "--config", "{file}"]),
    "constraints": (KNOWN, "x.toml", ["map", "{log}", "--out", "{out}/map", "--force", "--constraints", "{file}"]),
    "anchors": (ANCHORS, "x.csv", ["map", "{log}", "--out", "{out}/map", "--force", "--anchors-from", "{file}"]),
}


@pytest.mark.parametrize("case", CASES)
def test_a_damaged_file_is_at_worst_one_clear_line(case, tmp_path, capsys):
    whole, name, words = CASES[case]
    (tmp_path / "out").mkdir()
    (tmp_path / "good.log").write_bytes(LOG)
    names = {"file": str(tmp_path / name), "out": str(tmp_path / "out"), "log": str(tmp_path / "good.log")}
    for number, data in enumerate(mutations(whole, 150, seed=len(case))):
        (tmp_path / name).write_bytes(data)
        code = main([word.format(**names) for word in words])
        said = capsys.readouterr().err
        assert code in (0, 1, 3), (number, data)
        assert "internal error" not in said, (number, data, said)
        if code == 1:
            assert said.rstrip("\n").splitlines()[-1].startswith("uwblite: error: "), said
    assert {p.name for p in tmp_path.iterdir()} == {"out", "good.log", name}
