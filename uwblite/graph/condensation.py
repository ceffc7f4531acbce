"""A large graph solved part by part: each part is condensed to the unknowns that it shares with others.

An unknown that edges of several parts touch is shared: anchors, calibration that recordings have in common, poses at the
ends of closures between recordings. With the interior unknowns of a part i and its shared ones s, one step of Levenberg-
Marquardt needs of the part only the Schur complement

    S = H_ss - H_si H_ii^-1 H_is,    v = g_s - H_si H_ii^-1 g_i,

which is what its machine sends: a dense matrix and a vector, however long the recording was. Sums of these, and the edges
between parts, give the step of the shared unknowns, which is sent back; h_i = -H_ii^-1 (g_i + H_is h_s) follows where the
part is. Every part is then linearised anew, round by round. These are the very steps of the whole graph, so that they end in
its minimum. (K. Ni, D. Steedly, F. Dellaert, Tectonic SAM, ICRA 2007; A. Cunningham, M. Paluri, F. Dellaert, DDF-SAM, IROS
2010.) A group of parts is again a part: districts condense what their buildings send.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from .. import se2
from ..arrays import Bools, Floats, Ints
from .factorization import superlu
from .graph import Graph
from .partition import Part
from .solver import edge_weights, linearize
from .unknowns import WIDTHS, Unknowns, free_unknowns, moved

_SETTLED = 1e-9
"""m and rad; a round that moves nothing by more is the last."""
_FIRST_DAMPING, _FIRST_BRAKE = 1e-10, 1e-5
"""Damping as a share of the diagonal: at first, and at least after a step that failed."""
_EASED, _BRAKED = 0.1, 10.0
"""Factors on the damping after a step that decreased chi2, and after one that did not."""
_MOST_ROUNDS = 100


@dataclass(frozen=True, slots=True, eq=False)
class Condensed:
    """What a part sends."""

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
    """Where the rounds ended."""

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
    unknowns = _numbered(free_unknowns(shared))
    damping, chi2, sent = _FIRST_DAMPING, _total(shared, parts), tuple[int, ...]()
    rounds = 0
    while rounds < _MOST_ROUNDS:
        rounds += 1
        interiors = [_Interior(part, unknowns, damping) for part in parts]
        sent = tuple(interior.condensed.size for interior in interiors)
        step = _shared_step(shared, unknowns, [interior.condensed for interior in interiors], damping)
        tried = [interior.moved(step) for interior in interiors]
        trial = moved(shared, unknowns, step)
        cost = _total(trial, tried)
        if cost <= chi2:
            motion = max([_motion(shared, trial), *(_motion(a.graph, b.graph) for a, b in zip(parts, tried, strict=True))])
            shared, parts, chi2, damping = trial, tried, cost, damping * _EASED
            if motion <= _SETTLED:
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
        self._part = part
        own = _numbered({name: mask & (part.shared[name] < 0) for name, mask in free_unknowns(part.graph).items()})
        place = {name: np.append(shared.number[name], _NOWHERE[name], axis=0)[k] for name, k in part.shared.items()}
        n, used = own.size, np.unique(np.concatenate([p[p >= 0] for p in place.values()]))
        # Shared unknowns stand behind the part's own, in the order of their numbers among all shared ones.
        number = {k: np.where(place[k] >= 0, n + np.searchsorted(used, place[k]), own.number[k]) for k in place}
        self._unknowns = Unknowns(number, n + len(used))
        J, r = _jacobian(part.graph, self._unknowns)
        H, g = (J.T @ J).tocsc(), J.T @ r
        diagonal = H.diagonal()
        inside = H[:n, :n] + sparse.diags(_damped(diagonal[:n], damping))
        across = H[:n, n:].toarray()
        solved = superlu(inside.tocsc(), "MMD_AT_PLUS_A").solve(np.column_stack([across, g[:n]]))
        self._follow, self._alone = solved[:, :-1], solved[:, -1]
        corner, vector = H[n:, n:].toarray() - across.T @ self._follow, g[n:] - across.T @ self._alone
        self.condensed = Condensed(used, corner, vector, diagonal[n:])

    def moved(self, step: Floats) -> Part:
        """Return the part moved by a step of all shared unknowns, its interior following."""
        of_shared = step[self.condensed.numbers]
        whole = np.concatenate([-self._alone - self._follow @ of_shared, of_shared])
        return replace(self._part, graph=moved(self._part.graph, self._unknowns, whole))


_NOWHERE = {name: np.full((1, width), -1) for name, width in WIDTHS.items()}
"""Numbers of scalars that are not unknown, by block."""


def _shared_step(shared: Graph, unknowns: Unknowns, condensed: list[Condensed], damping: float) -> Floats:
    """Return the step of all shared scalars from what the parts sent and the edges that are no part's."""
    J, r = _jacobian(shared, unknowns)
    H, g = J.T @ J, J.T @ r
    diagonal = H.diagonal()
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


def _numbered(masks: dict[str, Bools]) -> Unknowns:
    """Number the scalars of the unknowns that masks name, block after block."""
    number, size = {}, 0
    for name, mask in masks.items():
        each = np.full((len(mask), WIDTHS[name]), -1)
        each[mask] = size + np.arange(mask.sum() * WIDTHS[name]).reshape(-1, WIDTHS[name])
        number[name], size = each, size + int(mask.sum()) * WIDTHS[name]
    return Unknowns(number, size)


def _jacobian(graph: Graph, unknowns: Unknowns) -> tuple[sparse.csr_matrix, Floats]:
    """Return Jacobian (d, size) and residuals (d,) of all edges, their weights in them."""
    rows, columns, values, residuals, first = [_NONE], [_NONE], [np.zeros(0)], [np.zeros(0)], 0
    for edges, lin in zip(graph.edges, linearize(graph), strict=True):
        root = np.sqrt(edge_weights(edges, graph))
        row = first + np.arange(lin.residuals.size).reshape(lin.residuals.shape)
        for name, index, jacobian in lin.blocks:
            column = np.broadcast_to(unknowns.number[name][index][:, None, :], jacobian.shape)
            free = column >= 0
            rows.append(np.broadcast_to(row[:, :, None], jacobian.shape)[free])
            columns.append(column[free])
            values.append((jacobian * root[:, None, None])[free])
        residuals.append((lin.residuals * root[:, None]).ravel())
        first += lin.residuals.size
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_matrix(entries, shape=(first, unknowns.size)), np.concatenate(residuals)


_NONE = np.zeros(0, dtype=np.int64)


def _total(shared: Graph, parts: Sequence[Part]) -> float:
    return shared.chi2() + sum(part.graph.chi2() for part in parts)


def _motion(before: Graph, after: Graph) -> float:
    """Return the largest change of a pose or an anchor, m or rad."""
    turned = np.abs(se2.wrap_angle(after.poses[:, 2] - before.poses[:, 2]))
    straight = [np.abs(after.poses[:, :2] - before.poses[:, :2]), np.abs(after.anchors - before.anchors)]
    return float(max(part.max(initial=0.0) for part in (turned, *straight)))
