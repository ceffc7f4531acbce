"""Starts for the optimisation of an imported graph: every chain and every anchor gets a place.

Which minimum an optimisation finds depends on its start. Where no certificate (graph/certificate.py) proves that it is the
global one, further starts may lead to a lower one.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..arrays import Floats, Ints
from ..graph.chordal_start import chordal_start
from ..graph.components import tied_chains
from ..graph.graph import Graph
from .anchor_starts import place_anchors, search_anchors
from .chain_starts import place_chains


class Start(NamedTuple):
    """A graph to optimise."""

    graph: Graph
    unplaced: tuple[int, ...]
    """Anchors that could not be placed: they are fixed at the origin, and their ranges do not count."""

    def placed(self, optimised: Graph) -> Graph:
        """Return the graph as optimised from here; the anchors that could not be placed have no place (nan) in it."""
        unplaced = np.isin(np.arange(len(optimised.anchors)), self.unplaced)
        return replace(optimised, anchors=np.where(unplaced[:, None], np.nan, optimised.anchors))


def starts(graph: Graph, chains: Ints, elsewhere: Floats | None = None) -> Iterator[Start]:
    """Yield starts from the poses of each chain, the likeliest first; none where nothing ties some chain to the others.

    Parameters
    ----------
    graph : poses of each chain in a frame of its own; those of chain 0, and anchors that have a place, are where they are.
    chains : (n,) chain of each pose.
    elsewhere : (a, 2) m, places for anchors that these poses cannot place; nan, or None: there is none.
    """
    if tied_chains(graph, chains).all():
        for placed in place_chains(graph, chains):
            yield Start(*place_anchors(placed, elsewhere))


def starts_nearby(start: Start, optimised: Graph) -> Iterator[Start]:
    """Yield starts that may lead out of the minimum that was found: all poses by chordal_start, or anchors elsewhere."""
    for graph in (chordal_start(optimised), search_anchors(start.graph)):
        if graph is not None:
            yield Start(graph, start.unplaced)
