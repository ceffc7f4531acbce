"""The pose graph: the unknowns (poses, anchors, calibration) and the interface of the edges that measure them.

A kind of edges is one dataclass of arrays with ``linearize(graph)``, whitened, so that the sum of squares is chi2. A new
sensor is one more dataclass and one more row in the numeric-Jacobian test; the solver does not change.

A step moves poses along arcs of constant twist and is added to the rest, see ``unknowns``; Jacobians are by the coordinates
x, y, theta, to which such an arc is the sum to first order. Residuals are expected minus measured, those of poses in the
chart of g2o, e = Z^-1 (Xi^-1 Xj). What a MapResult states about ranges is measured minus expected.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import ClassVar, NamedTuple, Self

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, Shape, Table, array_fields, concatenated, require_index, require_type, settle
from ..config import documented
from ..errors import DataError
from .robust import SQUARED, Kernel
from .work import Work

WIDTHS = {"poses": se2.POSE[0], "anchors": 2, "calibration": 1}
"""Blocks of unknowns, and the scalars of one unknown."""
Block = tuple[str, Ints, Floats]
"""(block name, index (e,) of the unknown in that block, Jacobian (e, d, k) of the whitened residual by it)."""


@dataclass(frozen=True, slots=True, eq=False)
class Linearization:
    """Whitened residuals of one kind of edges and their Jacobians."""

    residuals: Floats
    """(e, d), in standard deviations."""
    blocks: tuple[Block, ...]
    """An edge may name several unknowns of one block; each is an entry of its own."""


@documented
@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Edges(Table):
    """A kind of edges: a dataclass of arrays with a row per edge."""

    UNKNOWNS: ClassVar[Mapping[str, str]] = {}
    """Block of the unknowns whose indices an array holds, by the array's name; the first one has an index per edge."""
    ROWS: ClassVar[Mapping[str, Shape]] = {}
    """Shape of a row of each array whose rows are no single numbers."""
    kernel: Kernel = SQUARED
    """Robust kernel applied to each edge's squared whitened norm."""
    weights: Floats | None = None
    """(e,) factors on each edge's cost (0 switches it off), None = all 1."""

    def __post_init__(self) -> None:
        rows = {name: self.ROWS.get(name, ()) for name in array_fields(type(self))}
        settle(self, type(self).__name__, {n: row if n in self.SHARED else ("e", *row) for n, row in rows.items()})

    def __len__(self) -> int:
        return len(getattr(self, next(iter(self.UNKNOWNS))))

    def require_unknowns(self, counts: Mapping[str, int]) -> None:
        """Raise DataError where an edge refers to an unknown that is not among so many of each block; -1 may stand for none."""
        for name, block in self.UNKNOWNS.items():
            least = -1 if name == "calibration" else 0
            require_index(getattr(self, name), f"{type(self).__name__}.{name}", counts[block], block, least)

    @property
    def own_weights(self) -> Floats:
        """The weights (e,), never None."""
        return np.ones(len(self)) if self.weights is None else np.asarray(self.weights)

    @property
    def alive(self) -> Bools:
        """Which edges (e,) count."""
        return self.own_weights > 0.0

    def followed_by(self, *others: Self) -> Self:
        """Return these edges followed by others of their kind; the values that all edges share are taken from these."""
        tables = [self, *others]
        if any(t.weights is not None for t in tables):
            tables = [replace(t, weights=t.own_weights) for t in tables]
        return concatenated(tables)

    def linearize(self, graph: "Graph") -> Linearization:
        """Return whitened residuals and Jacobians."""
        raise NotImplementedError

    def residuals(self, graph: "Graph") -> Floats:
        """Return whitened residuals (e, d)."""
        return self.linearize(graph).residuals


class UnknownKey(NamedTuple):
    """Identity of a scalar unknown: its kind, and the anchor, the recording and the robot's tag that it belongs to."""

    kind: str
    """One of the kinds of calibration.py."""
    anchor: str | None = None
    """Id; None = belongs to no single anchor."""
    recording: int | None = None
    """0, 1, ...; None = all recordings have it in common."""
    tag: int = 0
    """0 = the robot's first tag, or of none; 1 = its second ..."""

    @property
    def label(self) -> str:
        """The key as text: ``bias:5C0B``, of the second tag ``bias:5C0B@tag2``, in the second recording ``bias:5C0B#2``."""
        anchor = "" if self.anchor is None else f":{self.anchor}"
        tag = f"@tag{self.tag + 1}" if self.tag else ""
        return f"{self.kind}{anchor}{tag}{f'#{self.recording + 1}' if self.recording else ''}"


@documented
@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Scalar unknowns."""

    keys: tuple[UnknownKey, ...] = ()
    values: Floats = field(default_factory=lambda: np.zeros(0))
    """(c,), unit by kind: see calibration.py."""

    def __post_init__(self) -> None:
        settle(self, "Calibration", {"values": ("c",)})

    def index(self, kind: str, anchor: str | None = None, recording: int | None = None, tag: int = 0) -> int:
        """Return the position of an unknown, -1 where the graph has none such; recording None = the first that has one."""
        for number, key in enumerate(self.keys):
            if (key.kind, key.anchor, key.tag) == (kind, anchor, tag) and recording in (None, key.recording):
                return number
        return -1

    def get(self, kind: str, default: float = 0.0) -> float:
        """Return the value of an unknown of no single anchor, or the default where the graph has none such."""
        i = self.index(kind)
        return default if i < 0 else float(self.values[i])

    def of_kinds(self, *kinds: str) -> Bools:
        """Return which unknowns (c,) are of these kinds."""
        return np.array([key.kind in kinds for key in self.keys], dtype=bool)


@documented
@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """Estimates, which of them are fixed, and the measurements between them."""

    poses: Floats
    """(n, 3) T_map_base."""
    anchors: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """(a, 2) m, map frame."""
    edges: tuple[Edges, ...] = ()
    calibration: Calibration = field(default_factory=Calibration)
    fixed_poses: Bools = field(default_factory=lambda: np.zeros(0, dtype=bool))
    """(n,) True = fixed; made without any, the graph has its first pose fixed (gauge)."""
    fixed_anchors: Bools = field(default_factory=lambda: np.zeros(0, dtype=bool))
    """(a,) True = fixed; made without any, all are free."""
    fixed_calibration: Bools = field(default_factory=lambda: np.zeros(0, dtype=bool))
    """(c,) True = fixed; made without any, all are free."""
    work: Work = field(default_factory=Work, repr=False)
    """To which the operations on this graph, and on all that are made from it, are added; see graph/work.py."""

    def __post_init__(self) -> None:
        estimates: dict[str, Shape] = {"poses": ("n", *se2.POSE), "anchors": ("a", 2)}
        settle(self, "Graph", {**estimates, "fixed_poses": ("n",), "fixed_anchors": ("a",)})
        require_type(self.calibration, "Graph.calibration", Calibration)
        values = self.calibration.values
        if len(values) != len(self.calibration.keys):
            raise DataError(f"Calibration has {len(values)} values for {len(self.calibration.keys)} keys")
        settle(self, "Graph", {"fixed_calibration": (len(values),)})
        counts = {"poses": len(self.poses), "anchors": len(self.anchors), "calibration": len(values)}
        for name, count in counts.items():
            if not len(getattr(self, f"fixed_{name}")):
                gauge = (np.arange(count) == 0) & (name == "poses")
                object.__setattr__(self, f"fixed_{name}", gauge)
        if not isinstance(self.edges, Sequence):
            raise DataError(f"Graph.edges must be a tuple of tables of edges, not {type(self.edges).__name__}")
        object.__setattr__(self, "edges", tuple(self.edges))
        for k, edges in enumerate(self.edges):
            if not isinstance(edges, Edges):
                raise DataError(f"Graph.edges[{k}] is a {type(edges).__name__}, which is no table of edges")
            edges.require_unknowns(counts)

    @property
    def calibration_priors(self) -> "tuple[PriorEdges, ...]":
        """Priors of the calibration among the edges."""
        return tuple(e for e in self.edges if isinstance(e, PriorEdges) and e.block == "calibration")

    def free_columns(self, index: Ints) -> Bools:
        """Return which columns of indices (e, k) of calibration values, -1 = none, hold a free one."""
        if self.fixed_calibration.all():
            return np.zeros(index.shape[1], dtype=bool)
        return np.any(np.append(~self.fixed_calibration, False)[index], axis=0)

    def calibration_blocks(self, index: Ints, columns: Sequence[Floats]) -> list[Block]:
        """Return the blocks by the calibration values of indices (e, k), -1 = none, that are free, of derivatives (d, e)."""
        used = compress(zip(index.T, columns, strict=False), self.free_columns(index))
        return [("calibration", np.maximum(i, 0), np.where(i >= 0, column, 0.0).T[..., None]) for i, column in used]

    def with_edges(self, *edges: Edges) -> "Graph":
        """Return the graph with further edges; empty ones are left out."""
        return replace(self, edges=self.edges + tuple(e for e in edges if len(e)))

    def updated(self, poses: Floats, anchors: Floats, calibration: Floats) -> "Graph":
        """Return the graph with new estimates, of as many unknowns: what was checked stays so."""
        new = copy(self)
        values = {"poses": poses, "anchors": anchors, "calibration": replace(self.calibration, values=calibration)}
        for name, value in values.items():
            object.__setattr__(new, name, value)
        return new

    def with_estimates_of(self, solved: "Graph") -> "Graph":
        """Return the graph with the estimates of another, its own edges kept."""
        return self.updated(solved.poses, solved.anchors, solved.calibration.values)

    def chi2(self) -> float:
        """Return the sum of squared whitened residuals, robust kernels and weights applied."""
        return sum(edge_cost(e, e.residuals(self)) for e in self.edges)


def edge_cost(edges: Edges, residuals: Floats) -> float:
    """Return the robust, weighted cost of whitened residuals (e, d) of these edges."""
    rho = edges.kernel.rho(np.einsum("ed,ed->e", residuals, residuals))
    return float(np.sum(rho if edges.weights is None else rho * edges.weights))


def linearized_cost(graph: Graph, linearized: Sequence[Linearization]) -> float:
    """Return the same of all edges of a graph, linearised at its estimates."""
    return sum(edge_cost(edges, lin.residuals) for edges, lin in zip(graph.edges, linearized, strict=True))


def kernel_weights(edges: Edges, residuals: Floats) -> Floats:
    """Return each edge's share (e,) in the normal equations at whitened residuals (e, d): its own weight times the kernel's."""
    return edges.kernel.weight(np.einsum("ed,ed->e", residuals, residuals)) * edges.own_weights


def edge_weights(edges: Edges, graph: Graph) -> Floats:
    """Return the same (e,) at the estimates of a graph."""
    return kernel_weights(edges, edges.residuals(graph))


def linearize(graph: Graph) -> list[Linearization]:
    """Linearise every kind of edges."""
    return [edges.linearize(graph) for edges in graph.edges]


def whiten(sqrt_information: Floats, values: Floats) -> Floats:
    """Return values (e, 3, ...) or vectors (e, d) times each edge's square root of information (e, d, d)."""
    return np.einsum("eij,ej...->ei...", sqrt_information, values)


@documented
@dataclass(frozen=True, slots=True, eq=False)
class PriorEdges(Edges):
    """Priors of unknowns of one block: a surveyed anchor, a pinned pose, a plausible calibration."""

    block: str
    """'poses', 'anchors' or 'calibration'."""
    index: Ints
    """(e,) which unknown."""
    value: Floats
    """(e, k) with k of WIDTHS; angles in rad."""
    sqrt_information: Floats
    """(e, k, k) L with information = L^T L."""
    UNKNOWNS: ClassVar[Mapping[str, str]] = {"index": ""}

    def __post_init__(self) -> None:
        width = WIDTHS.get(self.block)
        if width is None:
            raise DataError(f"a prior on {self.block!r}: it must be on poses, anchors or calibration")
        shapes: dict[str, Shape] = {"value": ("e", width), "sqrt_information": ("e", width, width)}
        settle(self, f"PriorEdges on {self.block}", {"index": ("e",), **shapes, "weights": ("e",)})

    def require_unknowns(self, counts: Mapping[str, int]) -> None:
        """Raise DataError where a prior refers to an unknown that is not among so many of its block."""
        require_index(self.index, f"PriorEdges on {self.block}: index", counts[self.block], self.block)

    def residuals(self, graph: Graph) -> Floats:
        """Return whitened residuals (e, k)."""
        if self.block == "calibration":
            error = graph.calibration.values[self.index][:, None] - self.value
        else:
            error = (graph.poses if self.block == "poses" else graph.anchors)[self.index] - self.value
        if self.block == "poses":
            error[:, 2] = se2.wrap_angle(error[:, 2])
        return whiten(self.sqrt_information, error)

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians."""
        return Linearization(self.residuals(graph), ((self.block, self.index, self.sqrt_information),))
