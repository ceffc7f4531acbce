"""What all tests share: the slow marker, one BLAS thread, hypothesis without clocks, recordings kept elsewhere."""

import gc
import os
import signal
import sys
import time
from collections import Counter
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings

# Tests start Python some hundred times; compiling everything each time is a sixth of their work.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# All that is collected lives to the end: looking for cycles in it over and over would be a tenth of the work.
gc.disable()

ROOT = Path(__file__).resolve().parent.parent
SHARED = Path(os.environ.get("UWBLITE_SHARED_DATA", ROOT.parent / "shared" / "data"))
"""Real recordings under other licences; they are no part of this repository."""
ABSENT = "real recordings, whose licences keep them out of this repository (UWBLITE_SHARED_DATA names their folder)"

os.environ.setdefault("HYPOTHESIS_STORAGE_DIRECTORY", str(ROOT / ".hypothesis"))
# What tests start finds this package and no other, from any folder.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
# A shell's background jobs ignore SIGINT, and so would the programs that the tests start and end with it.
signal.signal(signal.SIGINT, signal.default_int_handler)
unhurried = settings(deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("uwblite", unhurried, max_examples=25)
settings.register_profile("once", settings.get_profile("uwblite"), max_examples=10)
settings.load_profile("uwblite")


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="run the slow tests too")
    text = "run each test with the first of its parameters and few random examples: for other versions of numpy and scipy"
    parser.addoption("--once", action="store_true", help=text)


def pytest_ignore_collect(collection_path, config):
    """Files without slow tests need not be imported where nothing else is asked for."""
    if config.getoption("-m") == "slow" and collection_path.suffix == ".py":
        return "mark.slow" not in collection_path.read_text(encoding="utf-8") or None
    return None


def pytest_collection_modifyitems(config, items):
    chosen = [item for item in items if config.getoption("--slow") or "slow" not in item.keywords]
    if config.getoption("--once"):
        chosen = list({item.nodeid.partition("[")[0]: item for item in reversed(chosen)}.values())[::-1]
    kept = set(map(id, chosen))
    config.hook.pytest_deselected(items=[item for item in items if id(item) not in kept])
    items[:] = chosen


def pytest_collection_finish():
    gc.freeze()
    gc.enable()


def pytest_configure(config):
    if config.getoption("--once"):
        settings.load_profile("once")
    if "PYTEST_XDIST_WORKER" not in os.environ:
        config.pluginmanager.register(Remaining(config))


class Remaining:
    """Says now and then how much of the tests is done, and how long the rest will take."""

    def __init__(self, config):
        self.config, self.done, self.began, self.said = config, 0, None, 0.0

    def pytest_sessionstart(self, session):
        self.session = session

    def pytest_runtest_logfinish(self):
        now = time.monotonic()
        if self.began is None:
            self.began = self.said = now
        self.done += 1
        if now - self.said < SAID_EVERY or self.done >= self.session.testscollected:
            return
        self.said = now
        left = (now - self.began) * (self.session.testscollected / self.done - 1.0)
        reporter = self.config.pluginmanager.get_plugin("terminalreporter")
        reporter.ensure_newline()
        share = self.done / self.session.testscollected
        reporter.write_line(f"{share:.0%} of {self.session.testscollected} tests, about {max(round(left / 60), 1)} min to go")


SAID_EVERY = 20.0
"""s."""


@pytest.fixture(scope="session", autouse=True)
def started_here(tmp_path_factory):
    """An empty folder, in which all tests start, whatever lies in the user's own; none leaves anything there."""
    folder, before = tmp_path_factory.mktemp("started_here"), Path.cwd()
    os.chdir(folder)
    yield folder
    os.chdir(before)
    left = sorted(p.name for p in folder.iterdir())
    assert not left, f"tests have left {left} in the folder they were started in"


@pytest.fixture(scope="session")
def shared_data():
    """Folder with real recordings; the test is skipped where it is absent."""
    if not SHARED.is_dir():
        pytest.skip(ABSENT)
    return SHARED


@pytest.fixture(scope="session")
def room_log():
    """Path of the small simulated recording that lives in this repository."""
    return ROOT / "tests" / "data" / "room.log.gz"


@pytest.fixture(scope="session")
def minute_log(room_log, tmp_path_factory):
    """Path of its first minute: for tests of what the program does with a recording, whatever the map is."""
    from uwblite.io.carmen import read_log, write_log

    path = tmp_path_factory.mktemp("minute") / "minute.log.gz"
    write_log(path, read_log(room_log).crop(0.0, 60.0))
    return path


@pytest.fixture(scope="session")
def short_log(room_log, tmp_path_factory):
    """Path of its first 18 s, within which nothing closes."""
    from uwblite.io.carmen import read_log, write_log

    path = tmp_path_factory.mktemp("short") / "short.log.gz"
    write_log(path, read_log(room_log).crop(0.0, 18.0))
    return path


@pytest.fixture(scope="session")
def once(tmp_path_factory):
    """A function that makes a folder of this name, which no test may change; once for all processes of a run."""
    import fcntl

    shared = tmp_path_factory.getbasetemp()
    shared = shared.parent if "PYTEST_XDIST_WORKER" in os.environ else shared

    def made(name, make):
        with open(shared / f"{name}.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            folder = shared / name
            if not folder.exists():
                folder.mkdir()
                make(folder)
        return folder

    return made


@pytest.fixture(scope="session")
def minute_map(minute_log, once):
    """Folder with the map of that minute."""
    import shutil

    from uwblite.cli import main

    def mapped(folder):
        shutil.copy(minute_log, folder / "run.log.gz")
        assert main(["map", str(folder / "run.log.gz"), "--out", str(folder / "map"), "-q"]) in (0, 3)

    return once("minute_map", mapped) / "map"


@pytest.fixture(scope="session")
def room_map(room_log, once):
    """Folder with the map of the whole recording of the room, with the default settings, and what was said."""
    import contextlib
    import pickle
    from unittest import mock

    from uwblite import mapping
    from uwblite.cli import main, making

    def mapped(folder):
        def build_map(*args, **options):
            result = mapping.build_map(*args, **options)
            (folder / "result").write_bytes(pickle.dumps(result))
            return result

        words = ["map", str(room_log), "--out", str(folder / "map"), "--corrected-log", str(folder / "corrected.log")]
        with (
            open(folder / "said.txt", "w") as said,
            contextlib.redirect_stdout(said),
            mock.patch.object(making, "build_map", build_map),
        ):
            (folder / "code").write_text(str(main(words)))

    return once("room_map", mapped)


@pytest.fixture(scope="session")
def room_result(room_map):
    """That map as it was before it was written."""
    import pickle

    return pickle.loads((room_map / "result").read_bytes())


@pytest.fixture(scope="session")
def log(room_log):
    """That recording, read."""
    from uwblite.io.carmen import read_log

    return read_log(room_log)


def pytest_terminal_summary(terminalreporter, config):
    reasons = Counter(report.longrepr[2].removeprefix("Skipped: ") for report in terminalreporter.stats.get("skipped", []))
    if reasons:
        terminalreporter.write_line("skipped: " + "; ".join(f"{count} for {why}" for why, count in reasons.most_common()))
    if not config.getoption("--slow"):
        terminalreporter.write_line("slow tests are left out; --slow runs them too")
