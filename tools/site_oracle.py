"""A site mapped from several recordings against what their measurements allow together.

    python tools/site_oracle.py                        writes the part "site" of docs/lab/accuracy.md
    python tools/site_oracle.py --seeds 1 --print      the first three recordings only

The oracle of tools/oracle.py for several recordings at once: anchors, their biases and patterns, walls and columns are the same
unknowns in all, poses, wheels, radios and tags each recording's own; only the first pose of the first one is fixed. What rooms
add to ranges at one place counts as independent between recordings, which makes the oracle less sure than one could be.
"""

import one_thread  # noqa: F401

import argparse
import sys

import numpy as np
import oracle
from numpy.typing import NDArray
from scipy import sparse
from simulation.recording import Recording, Settings, simulate
from trials import ROOT, as_read, table, write_section

from uwblite.mapping import build_map
from uwblite.se2 import align, transform
from uwblite.sensor_log import SensorLog

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

RECORDINGS, MINUTES, BAR, RATIO = 3, 10.0, 0.10, 1.3
"""Recordings of one map, their length, and the bars: ATE in m, or this multiple of the oracle's."""


_UNHEARD = 1e-6
"""m^-2; so that an anchor without ranges leaves nothing singular."""


class SiteOracle:
    """The least-squares problem of several recordings of one building."""

    def __init__(self, recordings: list[Recording], logs: list[SensorLog]) -> None:
        pairs = zip(recordings, logs, strict=True)
        self.each = [oracle.Oracle(r, log, first_known=n == 0) for n, (r, log) in enumerate(pairs)]
        self.shared, self.size, self.columns = _numbered(self.each)
        counts = np.bincount(np.concatenate(self.columns), minlength=self.size)
        for one, columns in zip(self.each, self.columns, strict=True):
            one.sharing = counts[columns].astype(np.float64)

    def solve(self) -> float:
        """Descend from the truth and return the ATE of all keyframes together, m."""
        for _ in range(oracle.ROUNDS):
            step = self._step()
            for one, columns in zip(self.each, self.columns, strict=True):
                one.x += step[columns]
            if np.abs(step).max() < oracle.CONVERGED:
                break
        return ate([one.poses() for one in self.each], [one.truth for one in self.each])

    def _step(self) -> Floats:
        matrix, gradient = np.zeros((self.shared, self.shared)), np.zeros(self.size)
        whole = sparse.csr_matrix((self.size, self.size))
        for one, columns in zip(self.each, self.columns, strict=True):
            sparse_part, dense, slope = one.normal()
            place = sparse.csr_matrix(
                (np.ones(len(columns)), (np.arange(len(columns)), columns)), shape=(len(columns), self.size)
            )
            whole = whole + place.T @ sparse_part @ place
            own, anchors = columns[: one.layout.shared], columns[one.layout.anchors.ravel()]
            matrix[np.ix_(own, own)] += dense
            matrix[anchors, anchors] += _UNHEARD
            gradient[columns] += slope
        return oracle.step_of(whole.tocsr(), matrix, gradient, self.shared)[1]


def _numbered(each: list[oracle.Oracle]) -> tuple[int, int, list[Ints]]:
    """Return the number of unknowns before those of surfaces, of all, and where each recording's stand among all.

    An anchor is the same in two recordings where name and true place are.
    """
    keys = []
    for n, one in enumerate(each):
        layout, ids = one.layout, one.recording.plan.anchor_ids
        own: list[object] = [(n, k) for k in range(layout.size)]
        for k, place in enumerate(one.recording.anchors):
            name = (ids[k], *np.round(place, 6).tolist())
            for part, at in (("place", layout.anchors[k]), ("bias", layout.bias[k : k + 1]), ("pattern", layout.patterns[k])):
                for c, column in enumerate(at.tolist()):
                    own[column] = (part, name, c)
        for surface, first in zip(one.seen.tolist(), layout.surfaces[:, 0].tolist(), strict=True):
            own[first : first + 4] = [("surface", surface, c) for c in range(4)]
        keys.append(own)
    before = dict.fromkeys(key for own, one in zip(keys, each, strict=True) for key in own[: one.layout.shared])
    every = dict.fromkeys([*before, *(key for own in keys for key in own)])
    number = {key: k for k, key in enumerate(every)}
    return len(before), len(every), [np.array([number[key] for key in own], dtype=np.intp) for own in keys]


def ate(found: list[Floats], true: list[Floats]) -> float:
    """Return the rms distance of places after one rigid motion of all, m."""
    here, there = (np.concatenate(poses)[:, :2] for poses in (found, true))
    return float(np.sqrt(np.mean(np.sum((transform(align(here, there), here) - there) ** 2, axis=1))))


def settings_of(seed: int) -> list[Settings]:
    """Return three recordings by two robots, the last one of the next day."""
    worlds = ("site", "site", "site_next_day")
    return [
        Settings(world=world, minutes=MINUTES, speed=0.4, scan_rate=5.0, seed=10 * seed + n, robot=1 + n % 2, building=seed)
        for n, world in enumerate(worlds)
    ]


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--seeds", type=int, default=3, metavar="N", help="sites (3)")
    p.add_argument("--print", action="store_true", help="print instead of writing")
    args = p.parse_args(argv)
    rows = []
    for seed in range(1, args.seeds + 1):
        recordings = [simulate(settings) for settings in settings_of(seed)]
        logs = [as_read(recording).log for recording in recordings]
        best = SiteOracle(recordings, logs).solve()
        result = build_map(logs)
        of_each = [result.recording == n for n in range(len(logs))]
        made = ate(
            [result.trajectory[own] for own in of_each],
            [_true(r, result.stamps[own]) for r, own in zip(recordings, of_each, strict=True)],
        )
        doubts = ", ".join(notice.kind for notice in result.doubts)
        rows.append([seed, made, best, f"{made / best:.2f}", "yes" if made <= max(BAR, RATIO * best) else "**no**", doubts])
        print(f"site {seed}: {made:.4f} {best:.4f}", file=sys.stderr, flush=True)
    text = (
        f"## A site of several recordings\n\nThree recordings of {MINUTES:g} min at 0.4 m/s of the simulator's `site`, two "
        "robots, the third on the next day, in one map;\nATE of all together after one rigid motion, m. *Oracle*: as above, "
        f"for the three together (tools/site_oracle.py).\nBar: {BAR:g} m, or {RATIO:g} times the oracle's.\n\n"
        + table(["seed", "ATE", "oracle", "ratio", "kept", "doubts"], rows)
    )
    if args.print:
        print(text)
    else:
        write_section(ROOT / "docs" / "lab" / "accuracy.md", "site", text)
    return 0


def _true(recording: Recording, stamps: Floats) -> Floats:
    return np.stack([np.interp(stamps, recording.stamps, recording.truth[:, k]) for k in range(3)], axis=-1)


if __name__ == "__main__":
    sys.exit(main())
