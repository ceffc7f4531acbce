import numpy as np
import pytest

from uwblite import se2
from uwblite.graph.graph import Graph
from uwblite.graph.point_edges import LandmarkEdges


def sample(seed):
    rng = np.random.default_rng(seed)
    poses = np.stack([*rng.normal(scale=3.0, size=(2, 6)), rng.uniform(-np.pi, np.pi, 6)], axis=1)
    pose, anchor = rng.integers(0, 6, 9), rng.integers(0, 2, 9)
    edges = LandmarkEdges(pose, anchor, rng.normal(size=(9, 2)), rng.normal(size=(9, 2, 2)))
    return Graph(poses, rng.normal(scale=3.0, size=(2, 2)), (edges,)), edges


def test_the_residual_is_the_landmark_in_the_frame_of_the_pose():
    graph, edges = sample(0)
    expected = [
        L @ (se2.transform(se2.inverse(graph.poses[p]), graph.anchors[a]) - z)
        for p, a, z, L in zip(edges.pose, edges.anchor, edges.position, edges.sqrt_information, strict=True)
    ]
    np.testing.assert_allclose(edges.residuals(graph), expected, atol=1e-12)
    assert len(edges) == 9


@pytest.mark.parametrize("seed", range(3))
def test_jacobians_equal_differences(seed):
    graph, edges = sample(seed)
    linearized = edges.linearize(graph)
    np.testing.assert_allclose(linearized.residuals, edges.residuals(graph), atol=1e-12)
    step = 1e-6
    for block, index, jacobian in linearized.blocks:
        values = getattr(graph, block)
        for e in range(len(edges)):
            for k in range(values.shape[1]):
                either = []
                for sign in (1.0, -1.0):
                    moved = values.copy()
                    moved[index[e], k] += sign * step
                    other = Graph(**{"poses": graph.poses, "anchors": graph.anchors, block: moved})
                    either.append(edges.residuals(other)[e])
                np.testing.assert_allclose(jacobian[e, :, k], (either[0] - either[1]) / (2 * step), atol=1e-6)
