"""Summaries of the stages, warnings and doubts, and the caller's progress callback and clock."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from ..errors import Cancelled
from ..findings import DOUBT, WARNING, WHEELS_AGAINST_LIDAR, Finding, doubt, of_severity, warning
from ..graph.solver import SolverSummary
from ..map_result import StageSummary
from ..sensor_log import SensorLog


class Stage(str):
    """A stage in a progress report: text for people, such as ``loop closure 2``, and its parts for programs."""

    name: str
    """Name of the stage, without its number."""
    lap: int
    """1, 2, ... of a stage that is repeated until nothing changes; else 0."""
    detail: str
    """Information for the user before the stage begins; usually empty."""

    def __new__(cls, name: str, lap: int = 0, detail: str = "") -> "Stage":
        """Make the text of the parts."""
        stage = super().__new__(cls, " ".join(filter(None, (name, str(lap or ""), detail))))
        stage.name, stage.lap, stage.detail = name, lap, detail
        return stage


Progress = Callable[[Stage, int, int], object]
"""progress(stage, done, total); returning False asks to stop, see errors.Cancelled."""


class Stages:
    """Collects figures, warnings and doubts of the stages; calls the caller's progress callback."""

    def __init__(self, progress: Progress | None, clock: Callable[[], float] | None) -> None:
        self._progress, self._clock = progress, clock
        self._since = clock() if clock else 0.0
        self.done: list[StageSummary] = []
        self.findings: list[Finding] = []

    @property
    def warnings(self) -> list[Finding]:
        """The findings that are warnings."""
        return list(of_severity(self.findings, WARNING))

    @property
    def doubts(self) -> list[Finding]:
        """The findings that are doubts."""
        return list(of_severity(self.findings, DOUBT))

    def note(self, logs: Sequence[SensorLog]) -> None:
        """Take over what the screening of the recordings found, but for what only a finished map can judge."""
        self.findings += [finding for finding in of_recordings(logs) if finding.kind != WHEELS_AGAINST_LIDAR]

    def report(self, stage: str, done: int, total: int) -> None:
        """Report progress; raises Cancelled where the callback returns False."""
        stage = stage if isinstance(stage, Stage) else Stage(stage)
        if self._progress is not None and self._progress(stage, done, total) is False:
            raise Cancelled(f"stopped by the caller during {stage}")

    def warn(self, kind: str, text: str, **figures: object) -> None:
        """Add a warning."""
        self.findings.append(warning(kind, text, **figures))

    def doubt(self, kind: str, text: str, **figures: object) -> None:
        """Add a reason not to trust the result."""
        self.findings.append(doubt(kind, text, **figures))

    def end(self, stage: str, **figures: object) -> None:
        """Close a stage."""
        now = self._clock() if self._clock else 0.0
        self.done.append(StageSummary(stage, now - self._since, figures))
        self._since = now
        self.report(stage, 1, 1)

    @property
    def passes(self) -> float:
        """How often a stage ran, on the mean over all stages and recordings."""
        return len(self.done) / max(len({(stage.name, stage.figures.get("recording")) for stage in self.done}), 1)

    def reporter(self, stage: str) -> Callable[[int, int], None]:
        """Return a callback (done, total) for one stage."""
        return lambda done, total: self.report(stage, done, total)


def of_recordings(logs: Sequence[SensorLog]) -> list[Finding]:
    """Return what the screening found in recordings, each with its recording's number and, where there are several, name."""
    found = []
    for number, log in enumerate(logs):
        where = f"recording {number + 1}: " if len(logs) > 1 else ""
        own = () if log.screening is None else log.screening.findings
        found += [replace(finding, text=where + finding.text, recording=number + 1) for finding in own]
    return found


def solver_figures(result: SolverSummary) -> dict[str, object]:
    """Return the figures of an optimisation."""
    return {
        "converged": result.converged,
        "reason": result.reason,
        "iterations": result.iterations,
        "chi2": round(result.chi2, 4),
        "dof": result.dof,
        "chi2_per_dof": round(result.chi2_per_dof, 4),
    }
