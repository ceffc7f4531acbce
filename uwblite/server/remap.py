"""The command that makes a result again with other constraints."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import ConfigError

_REPEATED = (
    "--every-nth-scan",
    "--laser-pose",
    "--laser-flipped",
    "--tag",
    "--anchor-height",
    "--anchors-from",
    "--odometry-topic",
    "--scan-topic",
    "--imu-topic",
    "--uwb-topic",
    "--uwb-mapping",
    "--base-frame",
)
"""Options of the earlier command that hold again."""
_FLAGS = ("--laser-flipped",)
"""Those without a value."""


def missing_recordings(report: dict[str, Any], recordings: dict[str, Path]) -> list[str]:
    """Return the names of the recordings a result was made of that are not at hand."""
    return [str(i.get("source", "?")) for i in report.get("inputs") or () if i.get("sha256") not in recordings]


def remap_command(report: dict[str, Any], folder: Path, recordings: dict[str, Path], constraints: Path, out: Path) -> list[str]:
    """Return the arguments of `uwblite` that map a result's recordings again, in their order.

    Parameters
    ----------
    folder : of the result; config.toml there holds the settings.
    recordings : files at hand by the SHA-256 of their bytes.

    Raises
    ------
    ConfigError : a recording is not at hand.
    """
    inputs = report.get("inputs") or ()
    lost = missing_recordings(report, recordings)
    if lost or not inputs:
        raise ConfigError(f"the recording is not at hand: {', '.join(lost) or '?'}; name it: uwblite view DIR RECORDING")
    words = ["map", *(str(recordings[i["sha256"]]) for i in inputs)]
    if (folder / "config.toml").is_file():
        words += ["--config", str(folder / "config.toml")]
    return [*words, *_repeated(str(report.get("command", ""))), "--constraints", str(constraints), "--out", str(out)]


def _repeated(command: str) -> list[str]:
    """Return the options of an earlier command that hold again, as --option=value."""
    try:
        words: Sequence[str] = shlex.split(command)
    except ValueError:
        return []
    kept = []
    for k, word in enumerate(words):
        name, equals, _ = word.partition("=")
        if name not in _REPEATED:
            continue
        if equals or name in _FLAGS:
            kept.append(word)
        elif k + 1 < len(words):
            kept.append(f"{word}={words[k + 1]}")
    return kept
