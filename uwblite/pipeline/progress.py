"""Summaries of the stages, facts for the rules, and the caller's progress callback and clock."""

from collections.abc import Callable, Iterable
from typing import Any

from ..errors import Cancelled
from ..findings import DOUBT, WARNING, Fact, Finding, of_severity
from ..graph.solver import SolverSummary
from ..graph.work import KINDS, StageSummary, Work


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
    """Collects figures and facts of the stages, and what the rules find; calls the caller's progress callback."""

    def __init__(self, progress: Progress | None, clock: Callable[[], float] | None) -> None:
        self._progress, self._clock = progress, clock
        self._since = clock() if clock else 0.0
        self.done: list[StageSummary] = []
        self.work = Work()
        """Operations since the last stage ended."""
        self.facts: list[Fact] = []
        self.findings: list[Finding] = []

    @property
    def warnings(self) -> list[Finding]:
        """The findings that are warnings."""
        return list(of_severity(self.findings, WARNING))

    @property
    def doubts(self) -> list[Finding]:
        """The findings that are doubts."""
        return list(of_severity(self.findings, DOUBT))

    def report(self, stage: str, done: int, total: int) -> None:
        """Report progress; raises Cancelled where the callback returns False."""
        stage = stage if isinstance(stage, Stage) else Stage(stage)
        if self._progress is not None and self._progress(stage, done, total) is False:
            raise Cancelled(f"stopped by the caller during {stage}")

    def note(self, kind: str, **figures: object) -> None:
        """Add a fact, of which the rule of its kind (assessment/facts.py) makes a finding."""
        self.facts.append(Fact(kind, figures))

    def restate(self, of_question: Callable[[Fact], bool], facts: Iterable[Fact]) -> None:
        """Put facts in place of those of a question that is decided again."""
        self.facts = [*(fact for fact in self.facts if not of_question(fact)), *facts]

    def end(self, stage: str, **figures: object) -> None:
        """Close a stage; its figures are rounded."""
        now = self._clock() if self._clock else 0.0
        work = {kind: n for kind in KINDS if (n := self.work[kind])}
        self.done.append(StageSummary(stage, now - self._since, _rounded(figures), work))
        self._since = now
        self.work.clear()
        self.report(stage, 1, 1)

    @property
    def passes(self) -> float:
        """How often a stage ran, on the mean over all stages and recordings."""
        return len(self.done) / max(len({(stage.name, stage.figures.get("recording")) for stage in self.done}), 1)

    def reporter(self, stage: str) -> Callable[[int, int], None]:
        """Return a callback (done, total) for one stage."""
        return lambda done, total: self.report(stage, done, total)


_DECIMALS = 5
"""Of figures in a report."""


def _rounded(figure: Any) -> Any:
    """Return a figure, or a list or dictionary of them, rounded."""
    if isinstance(figure, dict):
        return {name: _rounded(value) for name, value in figure.items()}
    if isinstance(figure, list):
        return [_rounded(value) for value in figure]
    return round(figure, _DECIMALS) if isinstance(figure, float) else figure


def solver_figures(result: SolverSummary) -> dict[str, object]:
    """Return the figures of an optimisation."""
    names = ("converged", "reason", "iterations", "chi2", "dof", "chi2_per_dof")
    return {name: getattr(result, name) for name in names}
