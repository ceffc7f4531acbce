"""Findings: what a rule says about a recording, about a result or about a live pose.

A rule looks at a view and yields findings; no rule changes or withdraws what another one said. Where one fault explains
another, the consequence names its cause in ``explained_by``.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

NOTE, WARNING, DOUBT = "note", "warning", "doubt"
SEVERITIES = (DOUBT, WARNING, NOTE)
"""Worst first."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding."""

    kind: str
    """Fixed name for scripts and tests, such as ``odometry-gap``; docs/findings.md describes each."""
    severity: str
    """``doubt``: a reason not to trust the result; ``warning``: it was repaired or costs accuracy; ``note``: good to know."""
    text: str
    """For people: what, where, and how to fix it."""
    cure: str = ""
    """What to do about it; empty where the text says it."""
    sensor: str = ""
    """'log', 'odometry', 'radio', 'lidar' or 'map'; empty where it concerns none of them alone."""
    stretches: tuple[tuple[float, float], ...] = ()
    """First and last time, s, of each stretch that it concerns; empty: the whole recording."""
    recording: int = 0
    """Number of the recording that it concerns, from 1; 0: all of them."""
    anchor: str = ""
    """Name of the anchor, or of the place of one, that it concerns; empty where it concerns none."""
    figures: dict[str, Any] = field(default_factory=dict)
    """Named figures behind the text (JSON-ready)."""
    explained_by: tuple[str, ...] = ()
    """Kinds of the findings whose cause, once removed from the data, removes this one as well."""

    def __str__(self) -> str:
        return self.text

    def record(self) -> dict[str, Any]:
        """Return it as report.json has it: without severity, sensor and anchor, which its list and figures tell."""
        return {
            "kind": self.kind,
            "text": self.text,
            "cure": self.cure,
            "recording": self.recording,
            "stretches": list(self.stretches),
            "explained_by": list(self.explained_by),
            "figures": self.figures,
        }


@dataclass(frozen=True, slots=True)
class Fact:
    """What a stage saw or did, for people to know; the rule of its kind makes a finding of it."""

    kind: str
    """As a finding's."""
    figures: dict[str, Any]
    """What the rule needs (JSON-ready)."""

    @staticmethod
    def of(kind: str, **figures: Any) -> "Fact":
        """Return a fact with named figures."""
        return Fact(kind, figures)


WHEELS_AGAINST_LIDAR = "wheels-against-lidar"
"""Kind of a finding of which only a map can tell whether it is a doubt."""


def doubt(kind: str, text: str, **figures: Any) -> Finding:
    """Return a reason not to trust the result."""
    return Finding(kind, DOUBT, text, figures=figures)


def warning(kind: str, text: str, **figures: Any) -> Finding:
    """Return a fault that was repaired or costs accuracy."""
    return Finding(kind, WARNING, text, figures=figures)


def of_severity(findings: Iterable[Finding], severity: str) -> tuple[Finding, ...]:
    """Return the findings of one severity, in their order."""
    return tuple(finding for finding in findings if finding.severity == severity)


def kinds(findings: Iterable[Finding]) -> set[str]:
    """Return the kinds that occur."""
    return {finding.kind for finding in findings}


def ranked(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings, worst first, otherwise in their order."""
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))


def folded(findings: Iterable[Finding]) -> list[tuple[Finding, tuple[Finding, ...]]]:
    """Return the findings that no other one of them explains, each with those that it explains, directly or by another one."""
    given = tuple(findings)
    first = {finding.kind: finding for finding in reversed(given)}

    def cause(finding: Finding) -> Finding:
        known = next((first[kind] for kind in finding.explained_by if kind in first), None)
        return finding if known is None else cause(known)

    roots = [cause(finding) for finding in given]
    return [
        (one, tuple(f for f, root in zip(given, roots, strict=True) if root is one and f is not one))
        for one, own in zip(given, roots, strict=True)
        if own is one
    ]
