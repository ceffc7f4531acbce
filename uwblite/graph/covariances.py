"""Covariances of the unknowns of an optimised graph, and the expected error of the shape of its path."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class Covariances:
    """Marginal covariances of all unknowns, and the joint one of some poses.

    Zero where an unknown is fixed, infinite on the diagonal where no edge touches it.
    """

    poses: Floats
    """(n, 3, 3) of x, y, theta, map frame, m and rad."""
    anchors: Floats
    """(a, 2, 2) m^2, map frame."""
    calibration: Floats
    """(c,) standard deviations, unit by name."""
    chosen: Ints
    """(k,) poses whose joint covariance is known."""
    among: Floats
    """(3 k, 3 k) of the k chosen poses with each other, x, y, theta of each in turn."""


def about_best_fit(poses: Floats, covariance: Floats) -> Floats:
    """Return the covariances (k, 3, 3) of poses in the frame that fits all of them best, not that of the first pose.

    The fit is the rigid motion ``xi = A^+ e`` of least squares that the errors e of the places have in common; what is left at
    each pose is ``e_i - G_i xi``.

    Parameters
    ----------
    poses : (k, 3), spread so that they represent all. covariance : (3 k, 3 k) of them with each other.
    """
    count = len(poses)
    x, y = (poses[:, :2] - poses[:, :2].mean(axis=0)).T
    moves = np.tile(np.eye(3), (count, 1, 1))
    moves[:, 0, 2], moves[:, 1, 2] = -y, x
    fit = np.zeros((3, count, 3))
    fit[:, :, :2] = np.linalg.pinv(moves[:, :2].reshape(-1, 3)).reshape(3, count, 2)
    left = np.eye(3 * count) - moves.reshape(-1, 3) @ fit.reshape(3, -1)
    whole = (left @ covariance @ left.T).reshape(count, 3, count, 3)
    return np.asarray(whole[np.arange(count), :, np.arange(count), :])


def shape_error(poses: Floats, covariance: Floats) -> float:
    """Return the rms error of places (m) that is expected after alignment by a similarity.

    sqrt(tr(P C P) / k) with P = 1 - Q Q^T, where Q (2 k, 4) spans translation, rotation and scale of the whole.

    Parameters
    ----------
    poses : (k, 3), spread so that they represent all. covariance : (3 k, 3 k) of them with each other.
    """
    places = poses[:, :2] - poses[:, :2].mean(axis=0)
    own = covariance.reshape(len(poses), 3, len(poses), 3)[:, :2, :, :2].reshape(places.size, places.size)
    turn = places @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    q = np.linalg.qr(np.column_stack([np.tile(np.eye(2), (len(poses), 1)), turn.ravel(), places.ravel()]))[0]
    return float(np.sqrt(max(np.trace(own) - np.trace(q.T @ own @ q), 0.0) / len(poses)))
