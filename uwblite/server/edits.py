"""What the page of `uwblite view` changes: closures rejected or forced and anchors pinned, and the command that maps so.

The file may hold constraints of the user's own. They stay as they are, above a line that marks where the page's begin.
"""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..constraints import Constraints, ForbiddenClosure, GivenAnchor, GivenClosure
from ..errors import ConfigError
from ..io.constraints_file import constraints_text, parse_constraints
from ..io.stored_result import StoredClosure

MARK = "# Below this line: made by uwblite view, which writes it again. Constraints of your own belong above."
_FORCED_SIGMA = (0.1, 0.1, 0.05)
"""m, m, rad; of a closure that was forced: its match is taken at its word."""
_PINNED_SIGMA = 0.05
"""m; of an anchor that was pinned."""
_SAME = 1e-4
"""s by which stamps that were written and read again may differ."""
_REJECTED_WITHIN = 1.0
"""s; a rejected closure forbids its own pair of places and not those driven through before and after."""
_REPEATED = {
    *("--every-nth-scan", "--laser-pose", "--laser-flipped", "--tag", "--anchor-height", "--anchors-from", "--odometry-topic"),
    *("--scan-topic", "--imu-topic", "--uwb-topic", "--uwb-mapping", "--base-frame"),
}
"""Options of the earlier command that hold again."""
_FLAG = "--laser-flipped"
"""The one without a value."""


def parse_edits(text: str, path: str = "") -> tuple[str, Constraints]:
    """Return the user's own part of a constraints file and what the page wrote below it.

    Raises
    ------
    ConfigError : a table or field is unknown, missing or of the wrong kind.
    """
    own, marked, edited = text.partition(MARK)
    parse_constraints(own, path)
    return own, parse_constraints(edited, path) if marked else Constraints()


def edits_text(own: str, edits: Constraints) -> str:
    """Return the constraints file: the user's own part, the mark, and the page's tables."""
    head = f"{own.rstrip()}\n\n" if own.strip() else ""
    return f"{head}{MARK}\n{constraints_text(edits)}"


def with_closure(edits: Constraints, closure: StoredClosure, wish: str) -> Constraints:
    """Return the edits with another wish for a closure: 'reject', 'force', or 'leave' it to the mapper.

    Raises
    ------
    ConfigError : there is no such wish, or the closure has no measured pose to force.
    """
    left = replace(
        edits,
        closures=tuple(c for c in edits.closures if not _same(c, closure)),
        forbidden=tuple(c for c in edits.forbidden if not _same(c, closure)),
    )
    if wish == "leave":
        return left
    if wish == "reject":
        ban = ForbiddenClosure(closure.stamps, _REJECTED_WITHIN, closure.recordings)
        return replace(left, forbidden=(*left.forbidden, ban))
    if wish != "force":
        raise ConfigError(f"a closure can be rejected, forced or left, not {wish[:40]!r}")
    if closure.pose is None:
        raise ConfigError("the report does not contain the pose of this closure, so it cannot be forced")
    x, y, theta = closure.pose.tolist()
    forced = GivenClosure(closure.stamps, (x, y, theta), _FORCED_SIGMA, closure.recordings)
    return replace(left, closures=(*left.closures, forced))


def with_anchor(edits: Constraints, name: str, place: tuple[float, float] | None) -> Constraints:
    """Return the edits with an anchor pinned at a place, m, or with None no longer pinned."""
    others = tuple(a for a in edits.anchors if a.id != name)
    return replace(edits, anchors=others if place is None else (*others, GivenAnchor(name, place, _PINNED_SIGMA)))


def wish_for(edits: Constraints, closure: StoredClosure) -> str:
    if any(_same(c, closure) for c in edits.forbidden):
        return "reject"
    return "force" if any(_same(c, closure) for c in edits.closures) else "leave"


def _same(one: GivenClosure | ForbiddenClosure, closure: StoredClosure) -> bool:
    near = all(abs(a - b) < _SAME for a, b in zip(one.stamps, closure.stamps, strict=True))
    return near and tuple(one.recordings) == closure.recordings


def remap_command(report: dict[str, Any], folder: Path, recordings: dict[str, Path], constraints: Path, out: Path) -> list[str]:
    """Return the arguments of `uwblite` that map a result's recordings again, in their order.

    Recordings at hand go by the SHA-256 of their bytes; config.toml in the result's folder holds the settings.

    Raises
    ------
    ConfigError : a recording is not at hand.
    """
    inputs = report.get("inputs") or ()
    lost = [str(i.get("source", "?")) for i in inputs if i.get("sha256") not in recordings]
    if lost or not inputs:
        raise ConfigError(f"the recording is not at hand: {', '.join(lost) or '?'}; name it: uwblite view DIR RECORDING")
    words, config = ["map", *(str(recordings[i["sha256"]]) for i in inputs)], folder / "config.toml"
    words += ["--config", str(config)] if config.is_file() else []
    return [*words, *_repeated(str(report.get("command", ""))), "--constraints", str(constraints), "--out", str(out)]


def _repeated(command: str) -> list[str]:
    """Return the options of an earlier command that hold again, as --option=value."""
    try:
        words: Sequence[str] = shlex.split(command)
    except ValueError:
        return []
    pairs = [(word, word.partition("="), value) for word, value in zip(words, [*words[1:], ""], strict=True)]
    return [
        word if equals or name == _FLAG else f"{word}={value}" for word, (name, equals, _), value in pairs if name in _REPEATED
    ]
