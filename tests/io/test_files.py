import gzip
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from uwblite.io.files import replacing, write_bytes, write_text

ROOT = Path(__file__).resolve().parents[2]


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def test_the_file_appears_whole(tmp_path):
    write_text(tmp_path / "a.txt", "größe\n")
    assert (tmp_path / "a.txt").read_bytes() == "größe\n".encode()
    with replacing(tmp_path / "a.txt") as stream:
        stream.write(b"new")
        stream.flush()
        assert (tmp_path / "a.txt").read_bytes() == "größe\n".encode()
    assert (tmp_path / "a.txt").read_bytes() == b"new"
    assert names(tmp_path) == ["a.txt"]


def test_an_error_leaves_the_previous_file_and_nothing_else(tmp_path):
    write_bytes(tmp_path / "a", b"old")

    def interrupted():
        with replacing(tmp_path / "a") as stream:
            stream.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert (tmp_path / "a").read_bytes() == b"old"
    assert names(tmp_path) == ["a"]


def test_compressed_files_are_equal_every_time(tmp_path):
    write_bytes(tmp_path / "a.gz", b"text" * 100)
    write_bytes(tmp_path / "b.gz", b"text" * 100)
    assert (tmp_path / "a.gz").read_bytes() == (tmp_path / "b.gz").read_bytes()
    assert gzip.decompress((tmp_path / "a.gz").read_bytes()) == b"text" * 100


def test_devices_and_links_stay_what_they_are(tmp_path):
    write_bytes("/dev/null", b"gone")
    assert not Path("/dev/null").is_file()
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write_bytes(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes() == b"new"


def test_missing_folders_and_full_devices_are_os_errors(tmp_path):
    with pytest.raises(OSError, match="No such file"):
        write_bytes(tmp_path / "none" / "a", b"x")
    with pytest.raises(OSError, match="No space left"):
        write_bytes("/dev/full", b"x" * 100_000)


def run(code, folder):
    command = [sys.executable, "-c", code, str(folder / "a")]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_a_kill_while_writing_leaves_the_previous_file(tmp_path):
    write_bytes(tmp_path / "a", b"old")
    code = (
        "import os, signal, sys\nfrom uwblite.io.files import replacing\n"
        "with replacing(sys.argv[1]) as s:\n    s.write(b'x' * 1000000)\n    s.flush()\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    assert run(code, tmp_path).returncode == -signal.SIGKILL
    assert (tmp_path / "a").read_bytes() == b"old"


def test_running_out_of_space_leaves_the_previous_file(tmp_path):
    write_bytes(tmp_path / "a", b"old")
    code = (
        "import resource, signal, sys\nfrom uwblite.io.files import write_bytes\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\nresource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try:\n    write_bytes(sys.argv[1], b'x' * 100000)\n"
        "except OSError as e:\n    sys.exit(7 if e.filename == sys.argv[1] else e.filename)\n"
    )
    result = run(code, tmp_path)
    assert result.returncode == 7, result.stderr
    assert (tmp_path / "a").read_bytes() == b"old"
    assert names(tmp_path) == ["a"]


def test_the_file_gets_the_usual_permissions(tmp_path):
    write_bytes(tmp_path / "a", b"x")
    (tmp_path / "b").write_bytes(b"x")
    assert os.stat(tmp_path / "a").st_mode == os.stat(tmp_path / "b").st_mode
