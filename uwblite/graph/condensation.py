"""A large graph solved part by part: each part is condensed to the unknowns that it shares with others.

An unknown that edges of several parts touch is shared: anchors, calibration that recordings have in common, poses at the
ends of closures between recordings. With the interior unknowns of a part i and its shared ones s, one step of Levenberg-
Marquardt needs of the part only the Schur complement

    S = H_ss - H_si H_ii^-1 H_is,    v = g_s - H_si H_ii^-1 g_i,

which its machine sends: a dense matrix and a vector, whatever the length of the recording. Sums of these, and the edges
between parts, give the step of the shared unknowns, which is sent back; h_i = -H_ii^-1 (g_i + H_is h_s) is computed on the
machine of the part. Every part is then linearised again, round by round. These steps are exactly those of the whole graph, so
that they end in its minimum. (K. Ni, D. Steedly, F. Dellaert, Tectonic SAM, ICRA 2007; A. Cunningham, M. Paluri, F. Dellaert,
DDF-SAM, IROS 2010.) A group of parts is again a part: a district condenses the matrices of its buildings.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from .. import se2
from ..arrays import Floats, Ints
from .factorization import superlu
from .graph import Graph
from .normal_equations import NormalEquations, filled
from .partition import Part
from .unknowns import Unknowns, moved

_CONVERGED = 1e-9
"""m and rad; a round in which no change is larger is the last."""
_FIRST_DAMPING, _FIRST_BRAKE = 1e-10, 1e-5
"""Damping as a share of the diagonal: at first, and at least after a step that failed."""
_EASED, _BRAKED = 0.1, 10.0
"""Factors on the damping after a step that decreased chi2, and after one that did not."""
_MOST_ROUNDS = 100


@dataclass(frozen=True, slots=True, eq=False)
class Condensed:
    """The condensed equations that a part sends."""

    numbers: Ints
    """(m,) its shared scalars among all shared ones."""
    information: Floats
    """(m, m) S."""
    vector: Floats
    """(m,) v."""
    diagonal: Floats
    """(m,) of H_ss, for the damping."""

    @property
    def size(self) -> int:
        """Bytes sent, of S one triangle."""
        m = len(self.numbers)
        return 8 * (m * (m + 1) // 2 + 2 * m) + 4 * m


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Result of the rounds."""

    shared: Graph
    parts: tuple[Part, ...]
    chi2: float
    rounds: int
    sent: tuple[int, ...]
    """Bytes that each part sends in a round."""


def solve_condensed(shared: Graph, parts: Sequence[Part]) -> Solution:
    """Minimise the cost of a graph in parts; see partition.split.

    Parameters
    ----------
    shared : shared unknowns, and the edges among them that are no part's.
    """
    damping, chi2, sent = _FIRST_DAMPING, _total(shared, parts), tuple[int, ...]()
    rounds = 0
    while rounds < _MOST_ROUNDS:
        rounds += 1
        normal = filled(shared, subtrees=True)
        unknowns = normal.unknowns
        interiors = [_Interior(part, unknowns, damping) for part in parts]
        sent = tuple(interior.condensed.size for interior in interiors)
        step = _shared_step(normal, [interior.condensed for interior in interiors], damping)
        tried = [interior.moved(step) for interior in interiors]
        trial = moved(shared, unknowns, step)
        cost = _total(trial, tried)
        if cost <= chi2:
            motion = max([_motion(shared, trial), *(_motion(a.graph, b.graph) for a, b in zip(parts, tried, strict=True))])
            shared, parts, chi2, damping = trial, tried, cost, damping * _EASED
            if motion <= _CONVERGED:
                break
        elif chi2 - cost > -_ROUNDED * chi2:
            break
        else:
            damping = max(damping * _BRAKED, _FIRST_BRAKE)
    return Solution(shared, tuple(parts), chi2, rounds, sent)


_ROUNDED = 1e-13
"""Share of chi2 by which rounding raises it at the minimum."""


class _Interior:
    """A part while one step is found: it keeps the factor of its interior, and sends `condensed`."""

    def __init__(self, part: Part, shared: Unknowns, damping: float) -> None:
        self._part, normal = part, filled(part.graph, subtrees=True)
        self._unknowns, H, g = normal.unknowns, normal.matrix, normal.gradient
        number = normal.unknowns.number
        self._own = _scalars(number[name][k < 0] for name, k in part.shared.items())
        used = _scalars(shared.number[name][k[k >= 0]] for name, k in part.shared.items())
        order = np.argsort(used)
        self._shared = _scalars(number[name][k >= 0] for name, k in part.shared.items())[order]
        inside = H[self._own][:, self._own] + sparse.diags(_damped(normal.diagonal[self._own], damping))
        across = H[self._own][:, self._shared].toarray()
        solved = superlu(inside.tocsc(), "MMD_AT_PLUS_A").solve(np.column_stack([across, g[self._own]]))
        self._follow, self._alone = solved[:, :-1], solved[:, -1]
        corner = H[self._shared][:, self._shared].toarray() - across.T @ self._follow
        vector = g[self._shared] - across.T @ self._alone
        self.condensed = Condensed(used[order], corner, vector, normal.diagonal[self._shared])

    def moved(self, step: Floats) -> Part:
        """Return the part after a step of all shared unknowns, with its interior solved for."""
        of_shared = step[self.condensed.numbers]
        whole = np.empty(self._unknowns.size)
        whole[self._own], whole[self._shared] = -self._alone - self._follow @ of_shared, of_shared
        return replace(self._part, graph=moved(self._part.graph, self._unknowns, whole))


def _shared_step(normal: NormalEquations, condensed: list[Condensed], damping: float) -> Floats:
    """Return the step of all shared scalars from the condensed parts and the edges that belong to no part."""
    H, g, diagonal = normal.matrix, normal.gradient, normal.diagonal
    for sent in condensed:
        g[sent.numbers] += sent.vector
        diagonal[sent.numbers] += sent.diagonal
    rows = [np.repeat(sent.numbers, len(sent.numbers)) for sent in condensed]
    columns = [np.tile(sent.numbers, len(sent.numbers)) for sent in condensed]
    values = np.concatenate([sent.information.ravel() for sent in condensed])
    sums = sparse.csc_matrix((values, (np.concatenate(rows), np.concatenate(columns))), shape=H.shape)
    matrix = H + sums + sparse.diags(_damped(diagonal, damping))
    return -superlu(matrix.tocsc(), "MMD_AT_PLUS_A").solve(g) if len(g) else g


def _damped(diagonal: Floats, damping: float) -> Floats:
    return damping * np.where(diagonal > 0, diagonal, 1.0)


def _scalars(numbers: Iterable[Ints]) -> Ints:
    """Return all numbers of free scalars."""
    every = np.concatenate([n.ravel() for n in numbers])
    return every[every >= 0]


def _total(shared: Graph, parts: Sequence[Part]) -> float:
    return shared.chi2() + sum(part.graph.chi2() for part in parts)


def _motion(before: Graph, after: Graph) -> float:
    """Return the largest change of a pose or an anchor, m or rad."""
    turned = np.abs(se2.wrap_angle(after.poses[:, 2] - before.poses[:, 2]))
    straight = [np.abs(after.poses[:, :2] - before.poses[:, :2]), np.abs(after.anchors - before.anchors)]
    return float(max(part.max(initial=0.0) for part in (turned, *straight)))
