"""Summaries of the stages, warnings and doubts, and the caller's progress callback and clock."""

from collections.abc import Callable, Sequence

from ..errors import Cancelled
from ..graph.solver import SolverSummary
from ..map_result import Notice, StageSummary
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
        self.warnings: list[Notice] = []
        self.doubts: list[Notice] = []

    def note(self, logs: Sequence[SensorLog]) -> None:
        """Take over what the screening of the recordings found."""
        for number, log in enumerate(logs):
            where = f"recording {number + 1}: " if len(logs) > 1 else ""
            for remark in log.screening.remarks if log.screening is not None else ():
                add = self.doubt if remark.doubt else self.warn
                figures = {"recording": number + 1, "stretches": remark.stretches} if remark.stretches else {}
                add(remark.kind, where + remark.text, **figures)

    def report(self, stage: str, done: int, total: int) -> None:
        """Report progress; raises Cancelled where the callback returns False."""
        stage = stage if isinstance(stage, Stage) else Stage(stage)
        if self._progress is not None and self._progress(stage, done, total) is False:
            raise Cancelled(f"stopped by the caller during {stage}")

    def warn(self, kind: str, text: str, **figures: object) -> None:
        """Add a warning."""
        self.warnings.append(Notice(kind, text, figures))

    def doubt(self, kind: str, text: str, **figures: object) -> None:
        """Add a reason not to trust the result."""
        self.doubts.append(Notice(kind, text, figures))

    def settle(self, doubt: Notice, by: str) -> None:
        """Turn a doubt into a warning, and add the reason that settles it."""
        self.doubts.remove(doubt)
        self.warn(doubt.kind, f"{doubt.text}; {by}", **doubt.figures)

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
