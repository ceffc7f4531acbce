"""`uwblite batch`: many recordings, each mapped on its own, and a table of what became of them."""

import argparse
import hashlib
import json
import os
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import ConfigError
from ..io.constraints_file import read_constraints
from ..io.files import sha256_of, write_text
from ..io.folders import refuse_foreign, sole_writer, unmarked
from ..io.results import check_target
from ..report.batch import BatchRow, row_of, table_csv, table_html
from . import console, failure
from .inputs import bag_choices, name_recordings_once
from .making import config_text, given_files, make, read_logs, repeat_command, settings
from .workers import cluster, processes, versions


class Outcome(NamedTuple):
    """What a worker says of a recording; its figures stand in report.json."""

    error: str = ""
    notes: tuple[str, ...] = ()


def run(args: argparse.Namespace) -> int:
    name_recordings_once(args)
    tasks = tasks_of(args)
    refuse_foreign(unmarked(Path(args.out), ("batch.csv", "batch.html"), "batch.csv", table_csv([])))
    with sole_writer(args.out):
        os.makedirs(args.out, exist_ok=True)
        rows = _rows(args, tasks)
    if args.json:
        console.say_json({"out": args.out, "recordings": [row.plain() for row in rows], "exit_code": _exit_code(rows)})
    else:
        console.say(f"the table: {os.path.join(args.out, 'batch.html')} and {os.path.join(args.out, 'batch.csv')}")
    return _exit_code(rows)


def tasks_of(args: argparse.Namespace) -> list[argparse.Namespace]:
    """Return the command line of each recording's map, with absolute paths: workers may stand in another folder.

    Raises
    ------
    UsageError, ConfigError : settings or files that no map could be made with, or two folders of the same name.
    """
    settings(args), read_constraints(args.constraints, args.anchors_from), bag_choices(args)
    absolute = {name: os.path.abspath(value) for name in _FILES if (value := getattr(args, name))}
    return [
        argparse.Namespace(**{**vars(args), **absolute, "logs": [os.path.abspath(log)], "out": os.path.abspath(folder)})
        for log, folder in zip(args.logs, (os.path.join(args.out, name) for name in folder_names(args.logs)), strict=True)
    ]


_FILES = ("constraints", "anchors_from", "uwb_mapping", "config")


def folder_names(logs: Sequence[str]) -> list[str]:
    """Return the name of each recording's folder: its own without ending, behind its folder's where names are alike.

    Raises
    ------
    ConfigError : two recordings are alike in both.
    """
    paths = [os.path.abspath(log).removesuffix(".gz") for log in logs]
    short = [os.path.splitext(os.path.basename(path))[0] or os.path.basename(path) for path in paths]
    parents = [os.path.basename(os.path.dirname(path)) for path in paths]
    names = [f"{parent}_{name}" if short.count(name) > 1 else name for name, parent in zip(short, parents, strict=True)]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise ConfigError(f"{logs[names.index(name)]} and {logs[k]} would both go to the folder {name}; rename one of them")
    return names


def _rows(args: argparse.Namespace, tasks: Sequence[argparse.Namespace]) -> list[BatchRow]:
    """Map what is not there yet; write the table after every recording."""
    finished = {k for k, task in enumerate(tasks) if is_finished(task)}
    rows = {k: _row(args.logs[k], tasks[k], Outcome()) for k in sorted(finished)}
    if finished:
        console.note(f"uwblite: {len(finished)} of {len(tasks)} recordings are mapped already")
    _write_table(args.out, rows)
    for k, outcome in _outcomes({k: task for k, task in enumerate(tasks) if k not in finished}, args):
        rows[k] = _row(args.logs[k], tasks[k], outcome)
        _write_table(args.out, rows)
        for text in outcome.notes:
            console.note(text.replace("uwblite: ", f"uwblite: {args.logs[k]}: ", 1))
        if not args.json:
            console.say(f"{len(rows)} of {len(tasks)}: {_line(rows[k])}")
    return [rows[k] for k in range(len(tasks))]


def is_finished(task: argparse.Namespace) -> bool:
    """Return whether a folder holds the map of this recording, made with these settings by this version."""
    report = _report(task.out)
    if not report or not os.path.exists(task.logs[0]):
        return False
    config = settings(task)
    return (
        report.get("command") == repeat_command(task, config)
        and report.get("config_sha256") == hashlib.sha256(config_text(config).encode()).hexdigest()
        and report.get("given") == given_files(task)
        and report.get("versions") == versions()
        and [entry.get("sha256") for entry in report.get("inputs", ())] == [sha256_of(task.logs[0])]
    )


def _report(folder: str) -> dict[str, Any]:
    try:
        with open(os.path.join(folder, "report.json"), encoding="utf-8") as stream:
            report = json.load(stream)
    except (OSError, ValueError, RecursionError):
        return {}
    return report if isinstance(report, dict) else {}


def map_one(task: argparse.Namespace) -> Outcome:
    """Map one recording; what goes wrong is the outcome, for it shall not stop the others."""
    notes: list[str] = []
    try:
        with warnings.catch_warnings(), sole_writer(task.out):
            warnings.simplefilter("ignore", RuntimeWarning)
            check_target(task.out, force=task.force)
            maps = 1 if task.scheduler else task.jobs
            make(task, read_logs(task), note=notes.append, maps=maps)
    except Exception as error:
        return Outcome(failure(error)[1])
    return Outcome(notes=tuple(notes))


def _outcomes(tasks: dict[int, argparse.Namespace], args: argparse.Namespace) -> Iterator[tuple[int, Outcome]]:
    """Yield number and outcome of every task as they come.

    Where a process is killed, for instance for want of memory, all that it shared a pool with have no outcome: each of
    them gets a process of its own, one at a time, and who then falls has failed.
    """
    broken = []
    if tasks:
        with cluster(args.scheduler) if args.scheduler else processes(args.jobs) as executor:
            for k, outcome in _as_they_come(tasks, executor):
                if outcome is None:
                    broken.append(k)
                else:
                    yield k, outcome
    for k in sorted(broken):
        with processes(1) as executor:
            for _, outcome in _as_they_come({k: tasks[k]}, executor):
                yield k, outcome or Outcome("its process was killed; too little memory? see the system's log")


def _as_they_come(tasks: dict[int, argparse.Namespace], executor: Executor) -> Iterator[tuple[int, Outcome | None]]:
    """Yield number and outcome of every task; None where the pool broke."""
    futures = {executor.submit(map_one, task): k for k, task in tasks.items()}
    for future in as_completed(futures):
        error = future.exception()
        if isinstance(error, BrokenExecutor):
            yield futures[future], None
        elif error is not None:
            yield futures[future], Outcome(failure(error)[1])
        else:
            yield futures[future], future.result()


def _row(recording: str, task: argparse.Namespace, outcome: Outcome) -> BatchRow:
    folder = os.path.basename(task.out)
    if outcome.error:
        return BatchRow(recording, folder, "failed", outcome.error.replace(task.logs[0], recording))
    return row_of(recording, folder, _report(task.out))


def _line(row: BatchRow) -> str:
    text = f"{row.recording}: {row.outcome}"
    if row.outcome == "failed":
        return f"{text}: {row.reason}"
    size = "" if row.figures["width"] is None else ", {width:.1f} x {height:.1f} m".format_map(row.figures)
    counts = "{anchors} anchors, {closures} loop closures".format_map(row.figures)
    return f"{text}{f' ({row.reason})' if row.reason else ''}{size}, {counts}"


def _write_table(out: str, rows: dict[int, BatchRow]) -> None:
    ordered = [rows[k] for k in sorted(rows)]
    write_text(Path(out) / "batch.csv", table_csv(ordered))
    write_text(Path(out) / "batch.html", table_html(ordered, os.path.basename(os.path.abspath(out))))


def _exit_code(rows: Sequence[BatchRow]) -> int:
    outcomes = {row.outcome for row in rows}
    return 1 if "failed" in outcomes else 3 if "doubted" in outcomes else 0
