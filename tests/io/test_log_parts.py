"""A recording in parts is one recording, whichever part is named."""

import gzip
import hashlib
import shutil
from pathlib import Path

import pytest

from uwblite.drivers.events import OdometryPose
from uwblite.drivers.log_file import LogFile, pose_line
from uwblite.io.carmen import read_log
from uwblite.io.log_parts import each_once, parts_of


@pytest.fixture
def parts(tmp_path):
    """Return the paths of a recording of 400 poses in parts of 4 kB."""
    log = LogFile(tmp_path / "run.log", rotate=4000)
    log.head.append("PARAM uwb_tag_offset_x 0.25 0 host 0")
    log.write(log.head)
    for k in range(400):
        log.write([pose_line(OdometryPose(k * 0.05, 0.01 * k, 0.0, 0.0), f"{k * 0.05:.6f} host 0")])
    log.close()
    return [str(tmp_path / ("run.log" if part == 1 else f"run.{part}.log")) for part in range(1, log.part + 1)]


def test_every_part_names_the_whole(parts):
    assert len(parts) > 5
    joined = b"".join(Path(part).read_bytes() for part in parts)
    for part in (parts[0], parts[3], parts[-1]):
        assert parts_of(part) == (parts, "")
        log = read_log(part)
        assert log.odometry.poses[:, 0].tolist() == pytest.approx([0.01 * k for k in range(400)])
        assert log.notes.sha256 == hashlib.sha256(joined).hexdigest()
        assert log.notes.broken == 0
        assert not log.notes.warnings
        assert all(name in log.notes.source for name in parts)


def test_parts_may_be_packed(parts):
    for part in parts:
        with open(part, "rb") as plain, gzip.open(part + ".gz", "wb") as packed:
            shutil.copyfileobj(plain, packed)
    packed = [part + ".gz" for part in parts]
    assert parts_of(packed[2]) == (packed, "")
    shutil.move(packed[1], packed[1] + ".away")
    assert parts_of(packed[2]) == ([packed[0], parts[1], *packed[2:]], "")


def test_a_part_that_is_not_there_is_named(parts, tmp_path):
    shutil.move(parts[2], tmp_path / "away")
    assert parts_of(parts[0]) == (parts[:2], "run.3.log")
    assert parts_of(parts[5]) == (parts[3:], "run.3.log")
    (warning,) = read_log(parts[5]).notes.warnings
    assert "run.3.log" in warning
    (warning,) = read_log(parts[0]).notes.warnings
    assert "run.3.log" in warning


def test_other_files_are_alone(parts, tmp_path):
    """A second recording whose name looks like a part, a part that was renamed, a recording that is not there."""
    other = tmp_path / "walk.2.log"
    shutil.copy(parts[0], other)
    shutil.copy(parts[0], tmp_path / "walk.log")
    assert parts_of(str(other)) == ([str(other)], "walk.2.2.log")
    assert parts_of(str(tmp_path / "walk.log")) == ([str(tmp_path / "walk.log")], "walk.2.log")
    renamed = tmp_path / "middle.log"
    shutil.copy(parts[1], renamed)
    assert parts_of(str(renamed)) == ([str(renamed)], "run.log")
    assert parts_of("-") == (["-"], "")
    assert parts_of(str(tmp_path / "absent.log")) == ([str(tmp_path / "absent.log")], "")


def test_a_recording_that_is_named_by_several_of_its_parts_is_one(parts, tmp_path):
    other = tmp_path / "walk.log"
    shutil.copy(parts[-1], other)
    assert each_once([parts[1], str(other), parts[3], parts[0]]) == [parts[0], str(other)]
    assert each_once([parts[2], str(other)]) == [parts[2], str(other)]
    assert each_once([str(other), str(other), "-"]) == [str(other), "-"]
