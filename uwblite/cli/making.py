"""Recordings of a command line read, mapped and written, as `uwblite map` and `uwblite batch` do it; nothing is said here."""

import argparse
import os
import shlex
import sys
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from ..config import differences, override, to_toml
from ..errors import ConfigError
from ..io.constraints_file import read_constraints
from ..io.files import sha256_of
from ..io.formats import read_recording
from ..io.result_text import RunRecord, base_name
from ..io.results import write_result
from ..mapping import MappingConfig, MapResult, Progress, Stage, build_map
from ..pipeline.expected_cost import expected_cost, together
from ..pipeline.mapping_config import preset
from ..pipeline.recordings import prepared
from ..sensor_log import SensorLog
from .inputs import apply_mounting, bag_choices, effective_config, mounting_words
from .memory import FreedMemory, Shortage, shortage
from .options import name_options, name_options_in
from .workers import versions


class Recordings(NamedTuple):
    logs: list[SensorLog]
    seconds: float
    """That reading took."""


class Made(NamedTuple):
    """A map that is written."""

    logs: list[SensorLog]
    result: MapResult
    names: list[str]
    """Of the files in --out, in the order in which a user wants to see them."""
    seconds: float
    """From the first recording's first byte to the last file."""


def read_logs(args: argparse.Namespace, executor: Executor | None = None) -> Recordings:
    """Return the recordings of the command line, with its mounting."""
    began = time.perf_counter()
    read = partial(read_recording, every_nth_scan=args.every_nth_scan, bag=bag_choices(args))
    logs = [apply_mounting(log, args) for log in (executor.map if executor else map)(read, args.logs)]
    worded = [replace(log.notes, warnings=tuple(map(name_options, log.notes.warnings))) for log in logs]
    logs = [replace(log, notes=notes) for log, notes in zip(logs, worded, strict=True)]
    return Recordings(logs, time.perf_counter() - began)


def make(
    args: argparse.Namespace,
    recordings: Recordings,
    progress: Progress | None = None,
    executor: Executor | None = None,
    note: Callable[[str], None] | None = None,
    maps: int = 1,
) -> Made:
    """Map recordings, as many at a time as `maps`, and write the result; say nothing but notes.

    The list of logs is emptied, for scans that no map looks at are most of the memory.

    Raises
    ------
    ConfigError : the map needs more than twice the memory there is, and args.ignore_memory is not set.
    """
    config, constraints, freed = settings(args), read_constraints(args.constraints, args.anchors_from), FreedMemory()
    logs, reading = recordings

    def report(stage: Stage, done: int, total: int) -> object:
        freed.give_back(over=done >= total)
        return progress(stage, done, total) if progress is not None else None

    began = time.perf_counter()
    kept = [prepared(logs.pop(0), config) for _ in range(len(logs))]
    _check_cost(kept, config, args.ignore_memory, note, maps)
    log = kept[0] if len(kept) == 1 else kept
    result = build_map(log, config, constraints=constraints, progress=report, executor=executor, clock=time.perf_counter)
    result = replace(result, findings=name_options_in(result.findings))
    record = RunRecord(
        command=repeat_command(args, config),
        config=config_text(config),
        versions=versions(),
        given=given_files(args),
        preset=args.preset or "",
        changed=changed_settings(args, config),
        seconds=0.0 if args.no_timings else reading + time.perf_counter() - began,
        reading_seconds=reading,
        peak_rss_bytes=peak_memory(),
        scale_map=args.scale_map,
    )
    names = write_result(args.out, kept, result, record)
    return Made(kept, result, names, reading + time.perf_counter() - began)


def _check_cost(
    logs: list[SensorLog], config: MappingConfig, ignore: bool, note: Callable[[str], None] | None, maps: int
) -> None:
    """Refuse a map that will not fit in memory; note what may not, and what will take long."""
    whole = together([expected_cost(log, config.grid) for log in logs])
    lack = shortage(whole["megabytes"], maps)
    if lack is not None and lack.hopeless and not ignore:
        raise ConfigError(f"{lack.text}; --ignore-memory tries all the same")
    if note is not None:
        note_cost(lack, whole["seconds"], note)


def note_cost(lack: Shortage | None, seconds: float, note: Callable[[str], None]) -> None:
    """Tell beforehand of memory that will be short, and of a map that takes more than ten minutes."""
    if lack is not None:
        note(f"uwblite: {lack.text}")
    if seconds > _LONG:
        cure = "a part of it (uwblite convert --start --end) or a larger --set keyframes.distance=METRES takes less"
        note(
            f"uwblite: this map will take about {seconds / 60.0:.0f} minutes of a desktop computer, more of a small one: {cure}"
        )


_LONG = 600.0
"""s; a user who is not told of it takes a longer run for one that hangs."""


def config_text(config: MappingConfig) -> str:
    return to_toml(config, header="settings in force; `uwblite config` explains them")


def given_files(args: argparse.Namespace) -> dict[str, str]:
    """Return the SHA-256 of the files that the command line names beside recordings and settings, by option.

    What can be read once only, such as a pipe, has none.
    """
    named = {"constraints": args.constraints, "anchors-from": args.anchors_from, "uwb-mapping": args.uwb_mapping}
    return {option: sha256_of(file) for option, file in named.items() if file and os.path.isfile(file)}


def settings(args: argparse.Namespace) -> MappingConfig:
    config = override(effective_config(args), [f"use_{name}=false" for name in args.without])
    short = {"grid.resolution": args.resolution, "align": args.align, "crop": args.crop and list(args.crop)}
    return override(config, [f"{name}={value}" for name, value in short.items() if value is not None])


def changed_settings(args: argparse.Namespace, config: MappingConfig) -> tuple[str, ...]:
    """Return the settings that differ from those of the command line's preset, as --set takes them."""
    return tuple(differences(config, preset(args.preset) if args.preset else MappingConfig()))


def repeat_command(args: argparse.Namespace, config: MappingConfig) -> str:
    """Return the command that makes the same map again, in a folder with the recordings and other files that it names.

    Files stand with their names alone: the result is the same wherever they lie.
    """
    words = ["uwblite", "map", *map(base_name, args.logs)]
    words += [f"--preset={args.preset}"] if args.preset else []
    words += [f"--set={setting}" for setting in changed_settings(args, config)]
    if args.every_nth_scan > 1:
        words.append(f"--every-nth-scan={args.every_nth_scan}")
    for option, value in (("--constraints", args.constraints), ("--anchors-from", args.anchors_from)):
        words += [option, base_name(value)] if value else []
    words += mounting_words(args)
    for option in ("odometry_topic", "scan_topic", "imu_topic", "uwb_mapping", "base_frame"):
        if value := getattr(args, option):
            words.append(f"--{option.replace('_', '-')}={base_name(value) if option == 'uwb_mapping' else value}")
    words += [f"--uwb-topic={topic}" for topic in args.uwb_topic]
    words += ["--scale-map"] if args.scale_map else []
    return shlex.join([*words, "--out", "map_again"])


def peak_memory() -> int:
    """Return the peak resident memory of this process and the largest of its children, bytes; 0 where it is not known."""
    try:
        import resource
    except ImportError:
        return 0
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
