"""Memory: limits that are read, what is said beforehand, and one line where there is too little."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
from conftest import ROOT

from uwblite.cli import main, making, memory
from uwblite.pipeline import expected_cost as cost

resource = pytest.importorskip("resource")


@pytest.fixture
def system(tmp_path, monkeypatch):
    """Folders that stand for /proc and /sys/fs/cgroup, with nothing in them; the address space has no limit."""
    (tmp_path / "proc" / "self").mkdir(parents=True)
    monkeypatch.setattr(memory, "_PROC", str(tmp_path / "proc"))
    monkeypatch.setattr(memory, "_CGROUPS", str(tmp_path / "cgroup"))
    monkeypatch.setattr(memory, "shell_limits", lambda: [])
    monkeypatch.setattr(sys, "maxsize", (1 << 63) - 1)

    def write(name, text):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)

    return write


def sizes():
    return [limit.bytes for limit in memory.limits()]


def test_what_cannot_be_read_sets_no_limit(system):
    assert memory.limits() == []
    assert memory.shortage(1e9) is None
    system("proc/meminfo", "no such rows\n")
    system("proc/self/cgroup", "neither\n")
    system("proc/self/statm", "nor this")
    assert memory.limits() == []


def test_the_limit_of_every_group_around_the_process_counts(system):
    system("proc/self/cgroup", "0::/user/shell\n")
    system("cgroup/memory.max", "max\n")
    system("cgroup/user/memory.max", "500000000\n")
    system("cgroup/user/shell/memory.max", "max\n")
    assert sizes() == [500_000_000]


def test_groups_of_the_first_version_have_a_folder_for_memory(system):
    system("proc/self/cgroup", "5:cpu,cpuacct:/a\n4:memory:/a\n0::/b\n")
    system("cgroup/memory/a/memory.limit_in_bytes", "400000000\n")
    system("cgroup/memory/memory.limit_in_bytes", "9223372036854771712\n")
    assert sizes() == [400_000_000]


def test_the_computer_has_its_memory_and_what_it_swaps(system):
    system("proc/meminfo", "MemTotal:        1000 kB\nMemFree:  5 kB\nSwapTotal:  24 kB\n")
    assert sizes() == [1024 * 1024]


def test_the_tightest_limit_is_named_and_twice_as_much_is_hopeless(system):
    system("proc/meminfo", "MemTotal: 1000000 kB\nSwapTotal: 0 kB\n")
    system("proc/self/cgroup", "0::/\n")
    system("cgroup/memory.max", "500000000\n")
    assert memory.shortage(499.0) is None
    few, many = memory.shortage(600.0), memory.shortage(1001.0)
    assert not few.hopeless
    assert many.hopeless
    assert "about 600 MB" in few.text
    assert "control group is 500 MB" in few.text


def test_maps_that_are_made_at_a_time_share_the_memory_but_not_the_addresses(system, monkeypatch):
    system("proc/meminfo", "MemTotal: 1000000 kB\nSwapTotal: 0 kB\n")
    assert memory.shortage(400.0, maps=2) is None
    four = memory.shortage(400.0, maps=4)
    assert "4 such maps at a time need about 1600 MB" in four.text
    assert "--jobs" in four.text
    assert not four.hopeless, "each of them would fit alone"
    monkeypatch.setattr(memory, "shell_limits", lambda: [memory.Limit("the shell", 500_000_000, of_addresses=True)])
    assert "4 such maps" in memory.shortage(400.0, maps=4).text
    system("proc/meminfo", "")
    assert memory.shortage(400.0, maps=4) is None


def test_a_group_that_does_not_hold_the_libraries_is_refused_before_they_are_loaded(system, short_log, capsys):
    system("proc/self/cgroup", "0::/\n")
    system("cgroup/memory.max", "48000000\n")
    assert main(["check", str(short_log)]) == 1
    line = "uwblite: error: out of memory; numpy and scipy alone need 76 MB; the limit of this control group is 48 MB\n"
    assert capsys.readouterr().err == line


@pytest.mark.parametrize(("kind", "unused"), [("of_addresses", 60_000), ("of_data", 4_000)])
def test_what_is_mapped_and_not_used_counts_in_the_limits_of_the_shell(system, monkeypatch, kind, unused):
    monkeypatch.setattr(memory, "shell_limits", lambda: [memory.Limit("the shell's limit", 300_000_000, **{kind: True})])
    system("proc/self/statm", "61000 1000 100 4 0 4900 0\n")
    page = memory._pages().mapped // 61_000
    assert memory.shortage(299.0 - unused * page / 1e6) is None
    assert "shell's limit" in memory.shortage(301.0 - unused * page / 1e6).text


def test_a_system_of_32_bits_addresses_so_much(system, monkeypatch):
    monkeypatch.setattr(sys, "maxsize", (1 << 31) - 1)
    assert sizes() == [1 << 31]
    assert "32-bit" in memory.shortage(3000.0).text
    # An emulator reserves the 4 GB of the program that it runs, which sees the emulator's pages as its own.
    system("proc/self/statm", f"{(5 << 30) // os.sysconf('SC_PAGE_SIZE')} 1000 100 4 0 4900 0\n")
    assert memory.shortage(300.0) is None


def limited(monkeypatch, size):
    monkeypatch.setattr(memory, "limits", lambda: [memory.Limit("the limit of this test", size)])
    monkeypatch.setattr(memory, "_RESIDENT", 0)


def test_a_map_that_will_not_fit_is_refused_before_it_begins(short_log, tmp_path, monkeypatch, capsys):
    limited(monkeypatch, 10_000_000)
    words = ["map", str(short_log), "--out", str(tmp_path / "map")]
    monkeypatch.setattr("uwblite.cli.making.build_map", lambda *_, **__: pytest.fail("nothing is to be mapped"))
    assert main(words) == 1
    said = capsys.readouterr().err
    assert "the limit of this test is 10 MB" in said
    assert "--ignore-memory" in said
    assert not (tmp_path / "map").exists()


def test_it_is_tried_where_that_is_wanted_and_where_it_may_fit(short_log, tmp_path, monkeypatch, capsys):
    words = ["map", str(short_log), "--out", str(tmp_path / "map"), "--without", "lidar"]
    limited(monkeypatch, 10_000_000)
    assert main([*words, "--ignore-memory"]) in (0, 3)
    assert "the limit of this test" in capsys.readouterr().err
    limited(monkeypatch, 70_000_000)
    assert main([*words, "--force"]) in (0, 3)
    assert "70 MB" in capsys.readouterr().err
    assert main(["map", str(short_log), "--dry-run"]) == 0
    assert "70 MB" in capsys.readouterr().err


def test_of_several_recordings_the_program_counts_once(log):
    one = cost.expected_cost(log)
    two = cost.together([one, one])
    assert one["megabytes"] < two["megabytes"] < 2 * one["megabytes"] - 50
    assert one["seconds"] < two["seconds"] < 2 * one["seconds"]


def test_a_map_that_takes_long_says_so_beforehand(short_log, monkeypatch, capsys):
    monkeypatch.setattr(making, "_LONG", 0.1)
    assert main(["map", str(short_log), "--dry-run"]) == 0
    said = capsys.readouterr().err
    assert "minutes of a desktop computer" in said
    assert "keyframes.distance" in said


LIMITED = """
import resource, sys
resource.setrlimit(getattr(resource, sys.argv[1]), (int(sys.argv[2]) * 1_000_000,) * 2)
sys.argv = ["uwblite", *sys.argv[3:]]
from uwblite.__main__ import start
sys.exit(start())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the address space is limited on Linux")
@pytest.mark.parametrize(
    ("kind", "megabytes", "need", "command"),
    [
        ("RLIMIT_AS", 60, "300 MB of addresses", "ulimit -v"), ("RLIMIT_AS", 260, "300 MB of addresses", "ulimit -v"),
        ("RLIMIT_DATA", 60, "200 MB of data", "ulimit -d"), ("RLIMIT_DATA", 150, "200 MB of data", "ulimit -d"),
    ],
)  # fmt: skip
def test_where_the_shell_allows_too_little_the_end_comes_soon_and_in_one_line(
    kind, megabytes, need, command, short_log, tmp_path
):
    words = [kind, str(megabytes), "map", str(short_log), "--out", str(tmp_path / "map"), "-q"]
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, *words], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 1, done.stdout + done.stderr
    assert done.stderr.startswith(f"uwblite: error: out of memory; numpy and scipy alone need {need}")
    assert f"{megabytes} MB ({command})" in done.stderr
    assert done.stderr.count("\n") == 1


GROUPED = """
import sys
from uwblite.cli import main, memory
memory._group_limits = lambda: iter([int(sys.argv[1]) * 1_000_000])
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="private memory is limited on Linux")
def test_a_control_group_ends_a_map_by_an_error_before_the_system_kills_it(room_log, tmp_path):
    words = ["80", "map", str(room_log), "--out", str(tmp_path / "map"), "-q", "--ignore-memory"]
    done = subprocess.run([sys.executable, "-c", GROUPED, *words], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stdout + done.stderr
    assert done.stderr.startswith("uwblite: error: out of memory; ")
    assert done.stderr.endswith("this control group allows 80 MB\n")
    assert done.stderr.count("\n") == 1


LOADED = """
import resource, sys
import scipy.linalg
from uwblite.cli import memory
mapped = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (mapped + int(sys.argv[1]), resource.RLIM_INFINITY))
memory._load_libraries()
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the address space is limited and counted by Linux")
@pytest.mark.parametrize(("left", "fits"), [(200_000_000, True), (60_000_000, False)])
def test_libraries_that_are_loaded_need_room_for_their_buffers_alone(left, fits):
    words = [sys.executable, "-c", LOADED, str(left)]
    done = subprocess.run(words, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"}, capture_output=True, text=True, check=False)
    assert (done.returncode == 0) == fits, done.stderr
    assert ("NoRoom" in done.stderr) != fits


@pytest.mark.parametrize(("platform", "gives"), [("linux", True), ("darwin", False), ("win32", False)])
def test_free_memory_is_given_back_where_the_system_has_a_way(monkeypatch, platform, gives):
    monkeypatch.setattr("sys.platform", platform)
    monkeypatch.setattr("ctypes.CDLL", lambda name: SimpleNamespace(malloc_trim=lambda pad: 1))
    memory._trim.cache_clear()
    try:
        assert (memory._trim() is not None) is gives
    finally:
        memory._trim.cache_clear()
