"""Causes before consequences: which finding explains which, and the order in which they are told.

A fault of the data shows in many places: a clock that was set back bends the path, moves anchors and scatters ranges. Each rule
says what it sees; here every consequence names its cause. Nothing is left out, and no severity changes. The table says what a
cause may explain; it does where both are of one recording, anchor and time, and where what is found in all ranges is found no
more once the times of the cause are left out. A cause without times concerns all readings of its sensor.
"""

from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType

from ..findings import SEVERITIES, Finding

Stretches = tuple[tuple[float, float], ...]


def _of(*kinds: str | frozenset[str]) -> frozenset[str]:
    """Return kinds of findings that are listed in words or in sets."""
    return frozenset().union(*(kind.split() if isinstance(kind, str) else kind for kind in kinds))


_TIMES = _of("silences equal-stamps slow-odometry odometry-gap clock-offset scan-duration")
"""What stamps that are no times look like."""
_PLACES = _of(
    "anchor-distrusted anchor-mirror-ambiguous anchor-unplaced no-anchor moved-anchor anchors-moved-together",
    "sustained-outliers ranges-disagree",
)
"""What anchors seem to do along a path that is wrong, or by ranges that are no distances."""
_BY_RANGES = _of(
    _PLACES,
    "range-scatter odometry-unit odometry-slips drift other-side anchor-heights mirrored unusual-calibration uncertain",
    "poor-fit path-displaced",
)
"""What a map by ranges and wheels alone shows of a fault of either."""
_BY_SCANS = _of(
    "free-space-violation no-closure loose-links turn-scale scales uncertain",
    "poor-fit untied-parts unusual-calibration mirrored",
)
"""What a map shows of a fault of lidar or wheels."""
_CUT = _of(_PLACES, _BY_SCANS, "other-side drift path-displaced odometry-alone worse-than-parts")
"""What a map shows of a path in parts that odometry does not connect."""
_ALL = _of(_BY_RANGES, _BY_SCANS, "wheels-against-lidar carried wheels-stand-still")

EXPLAINS: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        "refused": _of("odometry-alone"),
        "clock-set-back": _TIMES | _ALL,
        "scans-outside-odometry": _of(_TIMES, "no-lidar"),
        "late-ranges": _of(_BY_RANGES, "range-scatter path-displaced worse-than-parts drift ranges-outside-odometry"),
        "exchanged-names": _of(_BY_RANGES, "worse-than-parts untied-parts carried"),
        "wheels-against-ranges": _BY_RANGES,
        "ranges-outside-odometry": _of(_TIMES, "no-ranges"),
        "odometry-gap": _CUT,
        "odometry-breaks": _CUT,
        "made-up-stamps": _TIMES,
        "stamps-of-receipt": _TIMES,
        "stamps-in-bursts": _TIMES,
        "hardly-moving": _of(_PLACES, "uncertain straight-path moves-across-heading"),
        "scans-do-not-match": _of(_BY_SCANS, "wheels-against-lidar range-scatter odometry-alone"),
        "laser-turned-over": _of(_BY_SCANS, "wheels-against-lidar range-scatter anchors-moved-together"),
        "wheels-stand-still": _BY_RANGES | _BY_SCANS,
        "marked-ranges": _of(_PLACES, "uncertain odometry-alone untied-parts few-in-reach few-ranges"),
        "repeated-ranges": _of("few-ranges anchor-unplaced no-anchor odometry-alone uncertain"),
        "repeated-scans": _of("odometry-alone untied-parts silences"),
        "odometry-alone": _of("uncertain"),
        "worse-than-parts": _of(_PLACES, "path-displaced free-space-violation"),
        "wheels-against-lidar": _of(_BY_SCANS, _PLACES, "carried range-scatter path-displaced"),
        "scales": _of(_PLACES, "range-scatter poor-fit free-space-violation path-displaced unusual-calibration"),
        "carried": _BY_SCANS | _BY_RANGES,
        "mirrored": _of("unusual-calibration odometry-unit"),
        "loose-links": _of("free-space-violation no-closure untied-parts anchors-moved-together path-displaced"),
        "free-space-violation": _of(_PLACES, "range-scatter path-displaced"),
        "path-displaced": _PLACES,
        "range-scatter": _BY_RANGES - _of("range-scatter path-displaced"),
        "drift": _of(_PLACES, "odometry-slips odometry-unit unusual-calibration"),
        "odometry-slips": _of(_PLACES, "unusual-calibration odometry-unit"),
        "anchors-moved-together": _of("moved-anchor anchor-distrusted ranges-disagree sustained-outliers"),
        "anchor-distrusted": _of("sustained-outliers spikes"),
        "straight-path": _of("anchor-mirror-ambiguous"),
        "few-ranges": _of("anchor-unplaced"),
    }
)
"""By the kind of a cause, the kinds that it explains; a cause stands before those causes that it explains."""
_SHOWN_BY: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        "radio": _of(
            _TIMES,
            _BY_RANGES,
            "ranges-outside-odometry worse-than-parts range-scatter carried spikes few-in-reach few-ranges no-ranges",
            "untied-parts odometry-alone",
        ),
        "lidar": _of(_TIMES, _BY_SCANS, _PLACES, "wheels-against-lidar carried no-lidar range-scatter path-displaced"),
    }
)
"""What a fault of one sensor alone can explain; one of the odometry may explain all."""
_RANK = {kind: number for number, kind in enumerate(EXPLAINS)}


Left = Callable[[Finding], Container[tuple[str, str]]]
"""Returns the kinds and anchors of what is still found in all ranges where the times of a cause are left out."""
FOUND_AGAIN = frozenset({"range-scatter", "ranges-disagree", "anchor-distrusted"})
"""Kinds that `Left` seeks again."""


def explained(findings: Iterable[Finding], left: Left = lambda cause: ()) -> tuple[Finding, ...]:
    """Return findings with their causes named, in the order in which they are told.

    Worst first; among those of one severity causes come before what they explain, and a finding that nothing explains before
    those that something does.
    """
    given = tuple(findings)
    named = [replace(f, explained_by=_causes(f, given, left)) for f in given]
    return tuple(sorted(named, key=_place))


def _causes(finding: Finding, findings: Iterable[Finding], left: Left) -> tuple[str, ...]:
    """Return the kinds of the findings that explain one, the first cause first."""
    causes = {cause.kind for cause in findings if _may_explain(cause, finding) and _gone_without(cause, finding, left)}
    return tuple(sorted(causes, key=_RANK.__getitem__))


def _gone_without(cause: Finding, finding: Finding, left: Left) -> bool:
    """Return whether a finding goes with the readings of a cause: with all of its sensor, or with those of its times."""
    if not cause.stretches or finding.stretches:
        return True
    return finding.kind in FOUND_AGAIN and (finding.kind, finding.anchor) not in left(cause)


def _may_explain(cause: Finding, finding: Finding) -> bool:
    """Return whether a finding may be a consequence of another, of its recording, anchor and time where both have such."""
    if finding.kind not in EXPLAINS.get(cause.kind, ()) or _RANK[cause.kind] >= _RANK.get(finding.kind, len(_RANK)):
        return False
    if finding.kind not in _SHOWN_BY.get(cause.sensor, (finding.kind,)):
        return False
    if cause.recording and finding.recording and cause.recording != finding.recording:
        return False
    if cause.stretches and finding.stretches and finding.kind not in _ASIDE and not _meet(cause.stretches, finding.stretches):
        return False
    return not (cause.anchor and finding.anchor and cause.anchor != finding.anchor)


def _meet(some: Stretches, others: Stretches) -> bool:
    """Return whether one of some stretches meets one of others, s."""
    return any(a <= end + _AFTER and begin <= b + _AFTER for a, b in some for begin, end in others)


_ASIDE = frozenset({"path-displaced"})
"""Kinds whose times are those of a part on one side of the cause, however far from it."""
_AFTER = 5.0
"""Time that a fault shows in readings after it, s: medians, keyframes, ranges one by one."""


def _place(finding: Finding) -> tuple[int, bool, int]:
    return SEVERITIES.index(finding.severity), bool(finding.explained_by), _RANK.get(finding.kind, len(_RANK))
