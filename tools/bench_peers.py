"""The same problems for other libraries, where they are installed: GTSAM, small_gicp, Open3D."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from uwblite.graph.graph import Graph
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.range_edges import RangeEdges

Floats = NDArray[np.float64]


def gtsam_optimizer(graph: Graph) -> Callable[[], float] | None:
    """Return a function that optimises the graph with GTSAM's Levenberg-Marquardt and returns chi2; None without GTSAM.

    Its factors and values are built here, outside the time that is measured, as our arrays are.
    """
    try:
        import gtsam
    except ImportError:
        return None
    factors, values, first_anchor = gtsam.NonlinearFactorGraph(), gtsam.Values(), len(graph.poses)
    for k, pose in enumerate(graph.poses):
        values.insert(k, gtsam.Pose2(*pose))
    for k, anchor in enumerate(graph.anchors):
        values.insert(first_anchor + k, anchor)
    factors.add(gtsam.NonlinearEqualityPose2(0, gtsam.Pose2(*graph.poses[0])))
    for edges in graph.edges:
        if isinstance(edges, RelativePoseEdges):
            for i, j, z, root in zip(edges.i, edges.j, edges.T_i_j, edges.sqrt_information, strict=True):
                noise = gtsam.noiseModel.Gaussian.SqrtInformation(root)
                factors.add(gtsam.BetweenFactorPose2(int(i), int(j), gtsam.Pose2(*z), noise))
        elif isinstance(edges, RangeEdges):
            for i, a, r, sigma in zip(edges.pose, edges.anchor, edges.ranges, edges.sigma, strict=True):
                noise = gtsam.noiseModel.Isotropic.Sigma(1, float(sigma))
                factors.add(gtsam.RangeFactor2D(int(i), first_anchor + int(a), float(r), noise))
        else:
            raise TypeError(f"no GTSAM factor for {type(edges).__name__}")

    def run() -> float:
        return 2.0 * float(factors.error(gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()))

    return run


def _flat(points: Floats) -> Floats:
    return np.column_stack([points, np.zeros(len(points))])


def _matrix(pose: Floats) -> Floats:
    matrix = np.eye(4)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    matrix[:2, :2], matrix[:2, 3] = [[c, -s], [s, c]], pose[:2]
    return matrix


def _pose(matrix: Floats) -> Floats:
    return np.array([matrix[0, 3], matrix[1, 3], np.arctan2(matrix[1, 0], matrix[0, 0])])


def small_gicp_align(target: Floats, source: Floats, guess: Floats, distance: float) -> Callable[[], Floats] | None:
    """Return a function that aligns two clouds by small_gicp's point-to-point ICP, its tree included."""
    try:
        import small_gicp
    except ImportError:
        return None
    a, b, start = _flat(target), _flat(source), _matrix(guess)

    def run() -> Floats:
        cloud = small_gicp.PointCloud(a)
        tree = small_gicp.KdTree(cloud)
        options = {"registration_type": "ICP", "max_correspondence_distance": distance, "max_iterations": 50}
        found = small_gicp.align(cloud, small_gicp.PointCloud(b), tree, start, num_threads=1, **options)
        return _pose(found.T_target_source)

    return run


def open3d_align(target: Floats, source: Floats, guess: Floats, distance: float) -> Callable[[], Floats] | None:
    """Return a function that aligns two clouds by Open3D's point-to-line ICP, tree and normals included."""
    try:
        import open3d
    except ImportError:
        return None
    a, b, start = _flat(target), _flat(source), _matrix(guess)
    near = open3d.geometry.KDTreeSearchParamRadius(0.25)
    criteria = open3d.pipelines.registration.ICPConvergenceCriteria(max_iteration=50)
    method = open3d.pipelines.registration.TransformationEstimationPointToPlane()

    def run() -> Floats:
        source_cloud, target_cloud = (open3d.geometry.PointCloud(open3d.utility.Vector3dVector(p)) for p in (b, a))
        target_cloud.estimate_covariances(near)
        target_cloud.normals = open3d.utility.Vector3dVector(_in_plane(np.asarray(target_cloud.covariances)))
        found = open3d.pipelines.registration.registration_icp(source_cloud, target_cloud, distance, start, method, criteria)
        return _pose(found.transformation)

    return run


def _in_plane(covariances: Floats) -> Floats:
    """Return normals (n, 3) across the lines; Open3D's own point out of a flat cloud."""
    along = 0.5 * np.arctan2(2.0 * covariances[:, 0, 1], covariances[:, 0, 0] - covariances[:, 1, 1])
    return np.column_stack([-np.sin(along), np.cos(along), np.zeros(len(along))])
