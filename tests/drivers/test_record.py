"""`uwblite record` and `uwblite devices` end to end: real processes, pseudo-terminals, faults, signals."""

import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest
from compare_recording import compare
from emulators.dwm_device import DwmDevice, DwmOptions
from emulators.kobuki_device import KobukiDevice
from emulators.scip_device import ScipDevice, ScipOptions
from emulators.world import RoomWorld, WorldClock
from helpers import virtual_recording
from helpers.driver_harness import ROOT

from uwblite.cli import main
from uwblite.drivers.devices import open_device
from uwblite.io.folders import sole_writer

WITHOUT_NUMPY = "import sys; sys.modules['numpy'] = sys.modules['scipy'] = None; from uwblite.cli import main; sys.exit(main())"


@pytest.fixture
def bench(tmp_path):
    """Start emulators; returns (start, device arguments, truth file)."""
    started = []
    truth = tmp_path / "truth.jsonl"
    places = {"lidar": tmp_path / "lidar", "uwb": tmp_path / "uwb", "kobuki": tmp_path / "base"}

    def start(*options, devices=("lidar", "uwb", "kobuki")):
        where = [word for name in devices for word in (f"--{name}", str(places[name]))]
        command = [sys.executable, str(ROOT / "tools" / "emulate.py"), *where, "--truth", str(truth), *options]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        started.append(process)
        for _ in devices:
            process.stdout.readline()
        return process

    arguments = ["--lidar", str(places["lidar"]), "--uwb", str(places["uwb"]), "--odometry", f"kobuki:{places['kobuki']}"]
    yield start, arguments, truth
    for process in started:
        process.terminate()
        process.wait()
        process.stdout.close()


def record(arguments, out, *options):
    command = [sys.executable, "-c", WITHOUT_NUMPY, "record", *arguments, "--out", str(out), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)


def check_row(name, row):
    """Nothing lost, nothing invented. A tag keeps only its latest fix: a computer that stalls for 100 ms may miss one."""
    spare = 3 if name == "uwb" else 0
    assert row["missing"] <= spare, name
    assert row["foreign"] <= spare, name


def finish(process):
    out, err = process.communicate(timeout=120)
    return process.returncode, out, err


def test_record_without_numpy_loses_nothing(bench, tmp_path):
    start, arguments, truth = bench
    emulator = start("--scip1", "--lidar-skew", "1e-4")
    code, out, err = finish(record(arguments, tmp_path / "run.log", "--duration", "2.5", "--json"))
    emulator.terminate()
    emulator.wait()
    assert code == 0, err
    summary = json.loads(out)
    assert summary["doubts"] == []
    report = compare(tmp_path / "run.log", truth)
    assert set(report) == {"lidar", "uwb", "odometry"}
    for name, row in report.items():
        assert row["sent"] > 8
        check_row(name, row)


@pytest.mark.slow
def test_the_log_is_read_by_the_mapper(bench, tmp_path):
    from uwblite.io.carmen import read_log

    start, arguments, _ = bench
    start()
    options = ("--tag", "-0.05,0,0.6", "--laser-pose", "0.1,0,0", "--anchor-height", "0.6")
    process = record(arguments, tmp_path / "run.log", *options)
    for word in ("ODOM", "ROBOTLASER1", "UWB"):
        wait_for(tmp_path / "run.log", f"\n{word} ", 12)
    process.terminate()
    assert finish(process)[0] in (0, 3)
    log = read_log(tmp_path / "run.log")
    assert log.notes.broken == 0
    assert log.scans.ranges.shape[1] == 682
    assert log.mounting.tag_position.tolist() == [-0.05, 0.0, 0.6]
    assert log.mounting.T_base_laser.tolist() == pytest.approx([0.1, 0.0, 0.0], abs=1e-5)
    assert log.mounting.anchor_height == 0.6
    assert len(log.ranges.anchor_ids) == 4


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_signals_end_a_recording_cleanly(bench, tmp_path, number, code):
    start, arguments, _ = bench
    start()
    process = record(arguments, tmp_path / "run.log")
    wait_for(tmp_path / "run.log", "ROBOTLASER1")
    process.send_signal(number)
    got, out, err = finish(process)
    assert got == code, err
    assert "lidar:" in out
    text = (tmp_path / "run.log").read_text()
    assert text.endswith("\n")
    assert "recorded" in text.splitlines()[-4]


def wait_for(path, word, count=5):
    """Wait until a file holds a word so many times."""
    for _ in range(600):
        if path.exists() and path.read_text(errors="replace").count(word) >= count:
            return
        time.sleep(0.05)
    raise AssertionError(f"{word} never came")


@pytest.mark.slow
def test_a_log_that_is_being_written_is_not_appended_to(tmp_path, capsys):
    path = tmp_path / "run.log"
    path.write_bytes(b"# CARMEN Logfile\n")
    with sole_writer(path):
        assert main(["record", "--odometry", f"kobuki:{tmp_path}/base", "--wait", "--out", str(path), "--append"]) == 1
    assert "another run is writing" in capsys.readouterr().err
    assert path.read_bytes() == b"# CARMEN Logfile\n"


def test_kill_and_append(bench, tmp_path):
    """kill -9 in mid-run: every line but perhaps the last is whole, and --append goes on from the last pose."""
    start, arguments, _ = bench
    start()
    path = tmp_path / "run.log"
    process = record(arguments, path)
    wait_for(path, "ROBOTLASER1", 10)
    process.kill()
    process.communicate()
    before = path.read_text().splitlines()
    last_pose = [line.split()[1:4] for line in before if line.startswith("ODOM ") and len(line.split()) == 10][-1]
    code, _, err = finish(record(arguments, path, "--append", "--duration", "2.5"))
    assert code == 0, err
    after = path.read_text().splitlines()
    assert after[: len(before) - 1] == before[:-1]
    first_pose = next(line.split()[1:4] for line in after[len(before) :] if line.startswith("ODOM "))
    assert [float(v) for v in first_pose] == pytest.approx([float(v) for v in last_pose], abs=1e-6)
    assert any("goes on with a log that broke off" in line for line in after)


@pytest.mark.slow
def test_a_port_has_one_owner(bench, tmp_path):
    start, arguments, _ = bench
    start(devices=("lidar",))
    first = record(arguments[:2], tmp_path / "a.log")
    wait_for(tmp_path / "a.log", "ROBOTLASER1")
    code, _, err = finish(record(arguments[:2], tmp_path / "b.log", "--duration", "1"))
    assert code == 3
    assert "another program has it open" in err
    first.terminate()
    assert finish(first)[0] == 0


@pytest.mark.slow
def test_absent_and_silent_devices_are_named(tmp_path):
    master, slave = os.openpty()
    arguments = ["--uwb", os.ttyname(slave), "--lidar", str(tmp_path / "nothing")]
    code, _, err = finish(record(arguments, tmp_path / "run.log", "--duration", "4", "--wait"))
    os.close(master)
    os.close(slave)
    assert code == 3
    assert "no such port" in err
    assert "no data" in err
    assert "uwb: no data at all" in err
    assert "lidar: no data at all" in err


def test_a_base_that_prints_lines(tmp_path):
    """It moves 10 mm from line to line, however long a line takes: none is lost, none comes twice."""
    master, slave = os.openpty()
    stop = threading.Event()

    def talk():
        began, ticks = time.monotonic(), 0
        while not stop.wait(0.02):
            ticks += 10
            os.write(master, f"{int(1000 * (time.monotonic() - began))},{ticks},{ticks}\n".encode())

    thread = threading.Thread(target=talk)
    thread.start()
    spec = f"line:{os.ttyname(slave)}?columns=t,left,right&tick=0.001&wheel_base=0.3&time_unit=0.001"
    process = record(["--odometry", spec], tmp_path / "run.log")
    wait_for(tmp_path / "run.log", "\nODOM ", 25)
    process.terminate()
    code, _, err = finish(process)
    stop.set()
    thread.join()
    os.close(master)
    os.close(slave)
    assert code == 0, err
    rows = [line.split() for line in (tmp_path / "run.log").read_text().splitlines() if line.startswith("ODOM")]
    x = [float(row[1]) for row in rows]
    assert [b - a for a, b in itertools.pairwise(x)] == pytest.approx([0.01] * (len(x) - 1), abs=1e-5)


@pytest.mark.slow
def test_rotation(bench, tmp_path):
    start, arguments, _ = bench
    start()
    assert finish(record(arguments, tmp_path / "run.log", "--duration", "4", "--rotate", "60k"))[0] == 0
    parts = list(tmp_path.glob("run*.log"))
    assert len(parts) >= 2
    assert all(part.read_text().startswith("# CARMEN Logfile\n") for part in parts)


def test_usage_errors(tmp_path, capsys):
    assert main(["record", "--out", str(tmp_path / "x.log")]) == 2
    assert main(["record", "--odometry", "create:/dev/x", "--out", str(tmp_path / "x.log")]) == 1
    assert "kobuki:PORT" in capsys.readouterr().err
    assert main(["record", "--lidar", "x"]) == 2
    (tmp_path / "there.log").write_text("")
    assert main(["record", "--lidar", "x", "--out", str(tmp_path / "there.log")]) == 1
    assert not (tmp_path / "x.log").exists()


@pytest.mark.slow
def test_devices_names_what_is_wrong(bench, capsys):
    start, arguments, _ = bench
    start("--scip1", "--uwb-stream", "lec", "--uwb-stationary", "--uwb-not-joined", "--no-wait")
    ports = [arguments[1], arguments[3], arguments[5].removeprefix("kobuki:")]
    assert main(["devices", *ports, "--pan-id", "0xC0DE", "--json"]) == 3
    lidar, tag, base = json.loads(capsys.readouterr().out)["devices"]
    assert lidar["kind"] == "laser scanner URG-04LX"
    assert any("SCIP 1.1" in f["text"] for f in lidar["findings"])
    assert any("laser is off" in f["text"] for f in lidar["findings"])
    assert (tag["kind"], tag["id"], tag["network"]) == ("DWM1001 tag", "1512", "0xBACA")
    texts = " ".join(f["text"] for f in tag["findings"])
    for word in ("stationary detection", "not joined", "nis 0xC0DE"):
        assert word in texts
    assert base["kind"] == "Kobuki base"


@pytest.mark.slow
def test_devices_names_an_anchor_and_a_dead_port(bench, capsys, tmp_path):
    start, arguments, _ = bench
    start("--uwb-anchor", devices=("uwb",))
    assert main(["devices", arguments[3], str(tmp_path / "none")]) == 3
    out = capsys.readouterr().out
    assert "DWM1001 anchor" in out
    assert "type `nmt`" in out
    assert "no such port" in out


def emulated(sent, lidar=None, clock_skew=0.0, **options):
    """Return an emulated URG-04LX, tag and base with their sessions, and the clock of their world; `sent` gets the truth."""
    world, clock = RoomWorld(), WorldClock()

    def truth(name):
        return lambda at, *content: sent.append([name, at, content[0]])

    base = KobukiDevice(world.poses(), clock, clock_skew=clock_skew, on_packet=truth("odometry"), **options)
    return clock, [
        ("lidar", open_device("lidar", "port")[0], ScipDevice(world.scans(), clock, lidar or ScipOptions(), truth("lidar"))),
        ("uwb", open_device("uwb", "port")[0], DwmDevice(world.epochs(), clock, DwmOptions(), truth("uwb"))),
        ("odometry", open_device("odometry", "kobuki:port")[0], base),
    ]


def compared(folder, sent):
    (folder / "truth.jsonl").write_text("".join(json.dumps(row) + "\n" for row in sent))
    return compare(folder / "run.log", folder / "truth.jsonl")


def test_unplugging_is_survived_and_reported(tmp_path):
    """In simulated time: each device is away for a second, one after the other."""
    sent = []
    clock, devices = emulated(sent)
    away = {"lidar": (4.0, 5.0), "uwb": (4.5, 5.5), "odometry": (5.0, 6.0)}
    path = tmp_path / "run.log"
    recorder = virtual_recording.record(path, devices, 14.0, begin=lambda now: clock.start(now + 1.5), away=away)
    assert [link.counts.connects for link in recorder.links] == [2, 2, 2]
    text = path.read_text()
    for name in away:
        assert f"warning {name}-gone" in text
    for name, row in compared(tmp_path, sent).items():
        check_row(name, {**row, "missing": 0})
    assert "odometry-gap" not in text  # encoders and gyro counted on


@pytest.mark.slow
def test_a_minute_at_full_rates(tmp_path):
    """In simulated time: crystals that are wrong, and clocks that wrap within the minute."""
    sent, lidar = [], ScipOptions(clock_start=16747216, clock_skew=1e-4)
    clock, devices = emulated(sent, lidar, clock_start=30000, clock_skew=-5e-5)
    recorder = virtual_recording.record(tmp_path / "run.log", devices, 62.0, begin=lambda now: clock.start(now + 1.5))
    assert recorder.doubts() == []
    for name, row in compared(tmp_path, sent).items():
        check_row(name, row)
        assert row["sent"] > (2900 if name == "odometry" else 580)
        assert row["p95_ms"] < 5.0
