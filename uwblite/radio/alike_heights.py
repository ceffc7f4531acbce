"""A common prior of anchor heights: anchors of one building are mounted at similar heights.

From a straight path, as along a corridor, the ranges to an anchor determine its distance from the path's line, but not which
part of that is height and which is horizontal distance. An assumed height of 0 then moves every anchor away from the path,
always outwards. The height of anchors near corners is observable. So the squared heights q of one robot's tag get the prior

    q_k = m + d_k,    m ~ N(0, (4 sigma)^2),    d_k ~ N(0, tau^2)

instead of independent ones, N(0, sigma^2). Their spread tau is the mean of widths from nearly equal to
independent heights, weighted by marginal likelihood (as in radio/prior_selection.py). Every height then has a prior of its own
about the common mean, whose width contains the uncertainty of the mean and the spread.
"""

from dataclasses import replace

import numpy as np

from ..arrays import Floats, Ints
from ..errors import SolverError
from ..graph.calibration import HEIGHT
from ..graph.graph import Graph, PriorEdges
from ..graph.joint_covariance import calibration_covariance
from ..problem.evidence import prior_sigma

_LEAST = 0.3
"""Least spread of squared heights, m^2: anchors 1.5 m above the tag, mounted within 10 cm."""
_WIDTHS = 6
"""Spreads tried, evenly spaced in their logarithm."""
_TOGETHER = 4.0
"""Ratio of the prior width of the mean to that of a single square: all anchors of a hall may be twice as high as usual."""
_FEWEST = 3
"""Least number of anchors for a common mean."""


def with_alike_heights(graph: Graph) -> Graph:
    """Return the graph with priors of squared heights about their common mean.

    Parameters
    ----------
    graph : solved with all its edges and its heights free, about priors of 0.
    """
    kinds = graph.calibration.of_kinds(HEIGHT) & ~graph.fixed_calibration
    sigma, owners = prior_sigma(graph), [(key.recording, key.tag) for key in graph.calibration.keys]
    groups = [np.flatnonzero(kinds & np.array([o == own for o in owners])) for own in sorted(set(owners), key=str)]
    groups = [group for group in groups if len(group) >= _FEWEST and np.all(np.isfinite(sigma[group]))]
    if not groups:
        return graph
    try:
        covariance = calibration_covariance(graph)
    except SolverError:
        return graph
    about = np.zeros(len(sigma))
    for group in groups:
        mean, width = _common(graph.calibration.values[group], covariance[np.ix_(group, group)], sigma[group])
        about[group], sigma[group] = mean, width
    return _with_priors(graph, np.concatenate(groups), about, sigma)


def _common(values: Floats, covariance: Floats, sigma: Floats) -> tuple[float, float]:
    """Return the mean of the heights' common prior and its standard deviation.

    Parameters
    ----------
    values, covariance : (h,) and (h, h) posterior of the squared heights. sigma : (h,) of their independent priors.
    """
    posterior = np.linalg.inv(covariance)
    pulled, measured = posterior @ values, posterior - np.diag(sigma**-2.0)
    usual = float(np.median(sigma))
    wide, found = _TOGETHER * usual, []
    for spread in np.geomspace(min(_LEAST, usual), usual, _WIDTHS).tolist():
        prior = wide**2 + spread**2 * np.eye(len(values))
        whole = measured + np.linalg.inv(prior)
        likely = 0.5 * (pulled @ np.linalg.solve(whole, pulled) - np.linalg.slogdet(whole)[1] - np.linalg.slogdet(prior)[1])
        # Information about the mean from ranges and spread; each anchor is weighted by how well its height is determined.
        shown = np.linalg.inv(np.eye(len(values)) + spread**2 * measured)
        worth = (shown @ measured).sum() + wide**-2.0
        mean = float((shown @ pulled).sum() / worth)
        found.append((likely, mean, 1.0 / worth, spread))
    likely, mean, variance, spread = np.array(found).T
    weight = np.exp(likely - likely.max())
    weight /= weight.sum()
    # A square cannot be below 0.
    middle = max(float(weight @ mean), 0.0)
    return middle, float(np.sqrt(weight @ (variance + (mean - middle) ** 2) + np.exp(2.0 * weight @ np.log(spread))))


def _with_priors(graph: Graph, which: Ints, about: Floats, sigma: Floats) -> Graph:
    """Return the graph with other priors of some calibration values: about (c,), with standard deviations sigma (c,)."""
    edges = []
    for e in graph.edges:
        if isinstance(e, PriorEdges) and e.block == "calibration":
            own = np.isin(e.index, which)[:, None]
            root = (1.0 / sigma[e.index])[:, None, None]
            e = replace(
                e, value=np.where(own, about[e.index][:, None], e.value),
                sqrt_information=np.where(own[:, None], root, e.sqrt_information),
            )  # fmt: skip
        edges.append(e)
    return replace(graph, edges=tuple(edges))
