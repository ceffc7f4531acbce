"""What became of a recording with a fault in it, and the tables that sum up many of them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

ATE_BAR = 0.5
"""m; a map with more is wrong."""
ANCHOR_BAR = 1.0
"""m, beyond three standard deviations; a map with an anchor called ok that is farther off is wrong."""
VERDICTS = {
    "right": "not doubted, and within both limits",
    "doubted": "doubted, though within both limits",
    "caught": "wrong, and doubted",
    "refused": "no map: an error that says what is wrong",
    "FALSE ALARM": "doubted without any fault",
    "SILENT": "wrong, and not doubted",
    "CRASH": "an internal error",
    "TOO LONG": "stopped",
}
"""What may become of a case; those in capitals are failures of the program."""
SENSORS = {"all": "all sensors", "no-lidar": "no lidar", "no-uwb": "no UWB"}
CRASHED = 4
"""Exit code of a case that ended with an internal error, or that was stopped."""


@dataclass(frozen=True)
class Outcome:
    """What became of one case."""

    world: str
    name: str
    sensors: str
    ate: float
    """m; nan where there is no map."""
    anchor: float
    """Worst error among the anchors that are called ok, m; nan without any."""
    beyond: float
    """By how much the worst of them exceeds ANCHOR_BAR and three standard deviations, m."""
    exit_code: int
    stated: tuple[str, ...]
    """Doubts, or the error."""
    kinds: tuple[str, ...]
    """Kinds of the doubts, as docs/formats.md lists them."""
    check: int
    """Exit code of `uwblite check`."""
    seconds: float
    warnings: tuple[str, ...] = ()
    causes: tuple[str, ...] = ()
    """Kinds of findings, or words of a refusal, that name the fault."""

    @property
    def named(self) -> bool | None:
        """Whether what is told first names the true cause; None where nothing is doubted, or there is no fault."""
        if self.exit_code not in (1, 3) or not self.causes:
            return None
        return self.kinds[0] in self.causes if self.kinds else any(word in self.stated[0] for word in self.causes)

    @property
    def verdict(self) -> str:
        """One of VERDICTS."""
        wrong = self.ate > ATE_BAR or self.beyond > 0.0
        if self.exit_code == CRASHED:
            return "TOO LONG" if "stopped after" in self.stated[0] else "CRASH"
        if self.exit_code == 0:
            return "SILENT" if wrong else "right"
        if self.exit_code == 1:
            return "refused"
        return "caught" if wrong else "FALSE ALARM" if self.name == "none" else "doubted"


def cell(outcome: Outcome) -> str:
    """Return the verdict in a word, and the error of the trajectory; of an anchor too, where that is what is wrong."""
    word = f"**{outcome.verdict}**" if outcome.verdict.isupper() else outcome.verdict
    word += " by another name" if outcome.named is False else ""
    error = "" if np.isnan(outcome.ate) else f" {outcome.ate:.2f}"
    return word + error + (f", anchor {outcome.anchor:.1f}" if outcome.beyond > 0.0 else "")


def columns_of(done: Sequence[Outcome]) -> list[tuple[str, str]]:
    """Return the world and the sensors of each column: worlds as they come, all sensors first."""
    there = {(o.world, o.sensors) for o in done}
    return [(world, s) for world in dict.fromkeys(o.world for o in done) for s in SENSORS if (world, s) in there]


def by_kind(done: Sequence[Outcome]) -> tuple[list[str], list[list[str]]]:
    """Return the head and the rows of a table with one row for each kind of fault."""
    columns = columns_of(done)
    found = {(o.name, o.world, o.sensors): o for o in done}
    head = ["fault", *(f"{world}, {SENSORS[sensors]}" for world, sensors in columns), "doubts"]
    rows = []
    for name in dict.fromkeys(o.name for o in done):
        of_name = [found.get((name, *column)) for column in columns]
        kinds = Counter(kind for o in of_name if o for kind in dict.fromkeys(o.kinds))
        rows.append([name, *("" if o is None else cell(o) for o in of_name), ", ".join(k for k, _ in kinds.most_common())])
    return head, rows


def counted(done: Sequence[Outcome]) -> tuple[list[str], list[list[str]]]:
    """Return the head and the rows of a table that counts verdicts, a row for each world and its sensors."""
    rows = []
    for world, sensors in columns_of(done):
        verdicts = Counter(o.verdict for o in done if (o.world, o.sensors) == (world, sensors))
        rows.append([f"{world}, {SENSORS[sensors]}", *(str(verdicts[v]) for v in VERDICTS)])
    return ["recording", *VERDICTS], rows


def summary(done: Sequence[Outcome]) -> str:
    """Return the counts of all verdicts in one line."""
    verdicts = Counter(o.verdict for o in done)
    counts = ", ".join(f"{v} {verdicts[v]}" for v in VERDICTS)
    named = [o.named for o in done if o.named is not None]
    first = f"; true cause named first in {sum(named)} of {len(named)} that were doubted or refused" if named else ""
    return f"{len({o.name for o in done})} kinds of fault in {len(done)} recordings: {counts}{first}"
