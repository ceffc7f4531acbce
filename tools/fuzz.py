#!/usr/bin/env python3
"""Damaged inputs for every reader and every verb that reads: at worst one clear line, never another exception.

    python tools/fuzz.py                          20,000 inputs, at least a million bytes for each reader
    python tools/fuzz.py --only optimize          cases whose names contain a word
    python tools/fuzz.py --seed 7 --inputs 2000
    python tools/fuzz.py --only "csv table" --number 1234    one input again

A fault is any exception but UwbliteError, an internal error of the command line, an exit code that is not documented,
text that a terminal would obey, files beside --out, more than 20 s of processor time or 500 MB of memory for one input.
Faulty inputs are kept in --keep. Every input is drawn from (seed, case, number) alone.
"""

import argparse
import resource
import shutil
import signal
import sys
import tempfile
import time
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from fuzzing.damage import damaged
from fuzzing.readers import Case, Fault, cases

from uwblite.errors import UwbliteError

SECONDS, MEGABYTES = 20.0, 500
"""Processor time and memory that one input may take."""
LEAST_BYTES = 1_000_000
"""Of damaged input for each reader."""


@dataclass
class Outcome:
    """What came of one case."""

    name: str
    inputs: int = 0
    size: int = 0
    """Bytes of all damaged inputs."""
    refused: int = 0
    slowest: float = 0.0
    """s of processor time."""
    faults: list[tuple[int, str]] = field(default_factory=list)
    """Number of the input, and what happened."""


class _TooLong(BaseException):
    """One input took too much processor time; no reader may catch it."""


def try_case(name: str, case: Case, seed: int, numbers: range, least_bytes: int = 0, keep: Path | None = None) -> Outcome:
    """Read damaged inputs of one case, more than asked for until they are so many bytes."""
    outcome = Outcome(name)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as made:
        whole_folder, folder = Path(made) / "whole", Path(made) / "in"
        whole_folder.mkdir()
        case.prepare(whole_folder)
        whole = (whole_folder / case.file).read_bytes()
        number = numbers.start
        while number < numbers.stop or outcome.size < least_bytes:
            data = damaged(whole, np.random.default_rng([seed, zlib.crc32(name.encode()), number]))
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(whole_folder, folder)
            (folder / case.file).write_bytes(data)
            wrong = _try(case, folder / case.file, outcome)
            if wrong:
                outcome.faults.append((number, wrong))
                if keep is not None:
                    keep.mkdir(parents=True, exist_ok=True)
                    (keep / f"{name.replace(' ', '_')}-{seed}-{number}{Path(case.file).suffix}").write_bytes(data)
            outcome.inputs += 1
            outcome.size += len(data)
            number += 1
    return outcome


def _try(case: Case, path: Path, outcome: Outcome) -> str:
    """Read one input; return what was wrong with that, '' = nothing."""

    def stop(*_: Any) -> None:
        raise _TooLong

    began = time.process_time()
    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
    try:
        case.read(path)
    except UwbliteError as error:
        outcome.refused += 1
        return "" if 0 < len(str(error).strip()) < 2000 else f"{len(str(error))} characters of an error"
    except Fault as fault:
        return str(fault)
    except _TooLong:
        return f"more than {SECONDS:.0f} s"
    except BaseException as error:
        return f"{type(error).__name__}: {error}"
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)
        outcome.slowest = max(outcome.slowest, time.process_time() - began)
    return ""


def limit_memory() -> None:
    """Let one input take so much more memory than the process has now."""
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    if pages:
        most = pages * resource.getpagesize() + (MEGABYTES << 20)
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))


def main() -> int:
    """Run the cases and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="WORD", help="cases whose names contain this")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--inputs", type=int, default=20_000, help="of all cases together (20000)")
    parser.add_argument("--bytes", type=int, default=LEAST_BYTES, help="least bytes for each reader (1000000)")
    parser.add_argument("--number", type=int, help="one input again, with its traceback")
    parser.add_argument("--keep", type=Path, default=Path("fuzz_faults"), help="folder for faulty inputs")
    args = parser.parse_args()
    chosen = {name: case for name, case in cases().items() if args.only in name}
    shares = sum(1.0 / case.cost for case in chosen.values())
    print(f"seed {args.seed}\n{'case':<22}{'inputs':>8}{'bytes':>11}{'refused':>9}{'slowest':>9}{'faults':>8}", flush=True)
    total = Outcome("all")
    for name, case in chosen.items():
        limit_memory()
        count = max(round(args.inputs / case.cost / shares), 1)
        numbers = range(count) if args.number is None else range(args.number, args.number + 1)
        # Verbs read what the readers have read already.
        least = 0 if args.number is not None or case.cost > 4 else args.bytes
        done = try_case(name, case, args.seed, numbers, least, args.keep)
        for field_name in ("inputs", "size", "refused"):
            setattr(total, field_name, getattr(total, field_name) + getattr(done, field_name))
        total.slowest, total.faults = max(total.slowest, done.slowest), total.faults + done.faults
        _say(done)
        for number, wrong in done.faults[:5]:
            print(f"    --only {name!r} --seed {args.seed} --number {number}: {wrong[:150]}", flush=True)
    _say(total)
    return 1 if total.faults else 0


def _say(o: Outcome) -> None:
    print(f"{o.name:<22}{o.inputs:>8}{o.size:>11}{o.refused:>9}{o.slowest:>7.2f} s{len(o.faults):>8}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
