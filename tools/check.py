#!/usr/bin/env python3
"""All checks behind one command: ruff, mypy --strict, pytest. Options it does not know go to pytest.

examples:
  python tools/check.py                     ruff and the fast tests
  python tools/check.py --lint              ruff and mypy --strict
  python tools/check.py --slow              all of it: ruff, mypy, the fast and the slow tests
  python tools/check.py --tests -k icp      only tests, and only some
  python tools/check.py --tests -n 4        in four processes (three where pytest-xdist is installed)
  python tools/check.py --house             lines, files, rooms, arrows and numeric literals of the package
"""

import argparse
import importlib.util
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import house

ROOT = Path(__file__).resolve().parent.parent


def main() -> int:
    """Run the checks and return 0 where all of them passed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--slow", action="store_true", help="run mypy and the slow tests too")
    parser.add_argument("--lint", action="store_true", help="ruff and mypy only")
    parser.add_argument("--tests", action="store_true", help="pytest only, no mypy even with --slow")
    parser.add_argument("--house", action="store_true", help="count the package and stop")
    args, pytest_args = parser.parse_known_args()
    if args.house:
        print("\n".join(f"{name:11} {number:6,}" for name, number in asdict(house.measure()).items()))
        return 0
    steps = []
    if not args.tests:
        steps.append(("ruff", ["ruff", "check", "."]))
    if args.lint or (args.slow and not args.tests):
        steps += _types()
    if not args.lint:
        steps += [("pytest", ["pytest", *_workers(pytest_args), *(["--slow"] if args.slow else []), *pytest_args])]
    results = _run_all(steps)
    failed = [name for name, code in results if code]
    print("checks: " + ("all passed" if not failed else "FAILED: " + ", ".join(failed)))
    return 1 if failed else 0


def _workers(pytest_args: list[str]) -> list[str]:
    """Return the options for several test processes, where pytest-xdist is there and nothing else is asked for.

    Two processes work while a third waits: tests of devices wait for emulated ports.
    """
    if importlib.util.find_spec("xdist") is None or (os.cpu_count() or 1) < 2 or {"-n", "-s", "--pdb"} & set(pytest_args):
        return []
    return ["-n", "3", "--dist", "worksteal"]


def _types() -> list[tuple[str, list[str]]]:
    """Return mypy, a minute of work in a fresh clone, where numpy's own annotations are fine enough for it."""
    code = "import numpy, sys; sys.exit(int(numpy.__version__.split('.')[0]) < 2)"
    if subprocess.run([sys.executable, "-c", code], check=False).returncode == 0:
        return [("mypy --strict", ["mypy"])]
    print("== mypy: SKIPPED; the annotations of numpy before 2.0 are too coarse for it")
    return []


def _run_all(steps: list[tuple[str, list[str]]]) -> list[tuple[str, int]]:
    """Run the steps and return their exit codes; those before the last run beside it, and are shown when they end.

    mypy works in one process and the tests wait for ports and files: together they use two cores better.
    """
    with ThreadPoolExecutor(1) as beside:
        earlier = [(name, beside.submit(_run, name, command, quiet=True)) for name, command in steps[:-1]]
        last = [(name, _run(name, command)) for name, command in steps[-1:]]
        return [(name, code.result()) for name, code in earlier] + last


def _run(name: str, command: list[str], *, quiet: bool = False) -> int:
    """Run a module of this Python; quiet: show its output at its end."""
    began = time.monotonic()
    if not quiet:
        print(f"== {name}", flush=True)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": os.environ.get("OPENBLAS_NUM_THREADS", "1")}
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT} if quiet else {}
    done = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, env=environment, check=False, **output)
    shown = f"\n== {name}\n{done.stdout.decode(errors='replace')}" if quiet else ""
    outcome = "ok" if done.returncode == 0 else f"exit {done.returncode}"
    print(f"{shown}== {name}: {outcome}, {time.monotonic() - began:.0f} s\n", flush=True)
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
