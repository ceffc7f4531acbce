"""Planar poses as (..., 3) arrays of x, y, theta; every function broadcasts over the leading axes.

Laws, up to rounding, for all poses a, b, c and points p (angles compared modulo 2 pi)::

    compose(a, compose(b, c)) == compose(compose(a, b), c)
    compose(a, inverse(a)) == 0 == compose(inverse(a), a)
    between(a, b) == compose(inverse(a), b)          compose(a, between(a, b)) == b
    transform(compose(a, b), p) == transform(a, transform(b, p))
    exp(log(a)) == a      log(exp(xi)) == xi for |xi_theta| < pi
    interpolate(a, b, 0) == a      interpolate(a, b, 1) == b

Angles are kept in (-pi, pi].
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import Complexes, Floats, chunks

POSE: tuple[int, ...] = (3,)
"""Shape of a pose; POSE * 2 is that of its information."""
_ABOVE_MINUS_PI = np.nextafter(-np.pi, 0.0)


def wrap_angle(angle: ArrayLike) -> Floats:
    """Return the angle, rad, moved into (-pi, pi]; one that lies there already keeps every bit."""
    angle = np.asarray(angle, dtype=np.float64)
    wrapped = angle - 2.0 * np.pi * np.ceil(angle / (2.0 * np.pi) - 0.5)
    inside: Floats = np.minimum(np.maximum(wrapped, _ABOVE_MINUS_PI), np.pi)
    return inside


def cos_sin(angle: ArrayLike) -> tuple[Floats, Floats]:
    """Return cosine and sine of angles (...), rad.

    Of a contiguous copy: numpy 1.24 rounds either way on strided input, depending on its address in memory. A single value
    counts as contiguous with any stride; so it is always copied.
    """
    angle = np.array(angle, dtype=np.float64, order="C")
    return np.cos(angle), np.sin(angle)


def bearing(vectors: ArrayLike) -> Floats:
    """Return the direction (...) of vectors (..., 2), rad in (-pi, pi]; of contiguous copies, see cos_sin."""
    vectors = np.asarray(vectors, dtype=np.float64)
    return np.arctan2(np.array(vectors[..., 1], order="C"), np.array(vectors[..., 0], order="C"))


def as_complex(vectors: Floats) -> Complexes:
    """Return x + i y (...) of vectors or poses (..., 2 or 3)."""
    return np.asarray(vectors[..., 0] + 1j * vectors[..., 1])


def unit_complex(angle: ArrayLike) -> Complexes:
    """Return exp(i theta) (...) of angles (...), rad: it turns vectors that are complex numbers."""
    return np.asarray(np.exp(1j * np.asarray(angle, dtype=np.float64)))


def rotate(theta: ArrayLike, vectors: ArrayLike) -> Floats:
    """Turn vectors (..., 2) by theta (...), rad."""
    c, s = cos_sin(theta)
    vectors = np.asarray(vectors, dtype=np.float64)
    x, y = vectors[..., 0], vectors[..., 1]
    ahead = c * x - s * y
    turned = np.empty((*ahead.shape, 2))
    turned[..., 0], turned[..., 1] = ahead, s * x + c * y
    return turned


def rotation(theta: ArrayLike) -> Floats:
    """Return blockdiag(R(theta), 1), (..., 3, 3): it turns errors of poses; its first two rows and columns turn vectors."""
    c, s = cos_sin(theta)
    matrix = np.zeros((*c.shape, *POSE, *POSE))
    matrix[..., 0, 0] = matrix[..., 1, 1] = c
    matrix[..., 1, 0], matrix[..., 0, 1] = s, -s
    matrix[..., 2, 2] = 1.0
    return matrix


def transform(pose: ArrayLike, points: ArrayLike) -> Floats:
    """Express points (..., 2), given in the frame of pose (..., 3), in the frame the pose is given in."""
    pose = np.asarray(pose, dtype=np.float64)
    return rotate(pose[..., 2], points) + pose[..., :2]


def rotate_each(theta: Floats, owner: NDArray[np.signedinteger], vectors: ArrayLike) -> Floats:
    """Turn vectors (p, 2), each by its own one (p,) of the angles (k,), rad: rotate with few sines for many vectors."""
    cosine, sine = cos_sin(theta)
    vectors = np.asarray(vectors)
    turned = np.empty((len(vectors), 2))
    for part in chunks(len(vectors)):
        c, s = cosine.take(owner[part]), sine.take(owner[part])
        x, y = vectors[part].astype(np.float64).T
        turned[part, 0] = c * x - s * y
        turned[part, 1] = s * x + c * y
    return turned


def transform_each(poses: Floats, owner: NDArray[np.signedinteger], points: ArrayLike) -> Floats:
    """Express points (p, 2), each given in the frame of its own one (p,) of the poses (k, 3), as transform does."""
    moved = rotate_each(poses[:, 2], owner, points)
    for part in chunks(len(moved)):
        moved[part] += poses[:, :2].take(owner[part], axis=0)
    return moved


def compose(a: ArrayLike, b: ArrayLike) -> Floats:
    """Return T_a_c from T_a_b and T_b_c."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    xy = transform(a, b[..., :2])
    return np.concatenate([xy, wrap_angle(a[..., 2] + b[..., 2])[..., None]], axis=-1)


def inverse(a: ArrayLike) -> Floats:
    """Return T_b_a from T_a_b."""
    a = np.asarray(a, dtype=np.float64)
    return np.concatenate([-rotate(-a[..., 2], a[..., :2]), wrap_angle(-a[..., 2])[..., None]], axis=-1)


def between(a: ArrayLike, b: ArrayLike) -> Floats:
    """Return T_a_b from T_w_a and T_w_b: b as seen from a."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    xy = rotate(-a[..., 2], b[..., :2] - a[..., :2])
    return np.concatenate([xy, wrap_angle(b[..., 2] - a[..., 2])[..., None]], axis=-1)


def _chord(theta: Floats) -> Floats:
    """Return the chord of an arc that turns by theta (...) in units of its length, (..., 1); it points half the turn aside."""
    return np.sinc(theta / (2.0 * np.pi))[..., None]


def exp(xi: ArrayLike) -> Floats:
    """Return the pose reached by the constant twist xi (..., 3) = vx, vy, omega in unit time."""
    xi = np.asarray(xi, dtype=np.float64)
    theta = np.array(xi[..., 2], order="C")
    return np.concatenate([_chord(theta) * rotate(0.5 * theta, xi[..., :2]), wrap_angle(theta)[..., None]], axis=-1)


def log(pose: ArrayLike) -> Floats:
    """Return the twist whose exp is the pose; its angle lies in (-pi, pi]."""
    pose = np.asarray(pose, dtype=np.float64)
    theta = wrap_angle(pose[..., 2])
    return np.concatenate([rotate(-0.5 * theta, pose[..., :2]) / _chord(theta), theta[..., None]], axis=-1)


def interpolate(a: ArrayLike, b: ArrayLike, fraction: ArrayLike) -> Floats:
    """Return the pose a fraction (...) of the way from a to b along the arc of constant twist."""
    fraction = np.asarray(fraction, dtype=np.float64)[..., None]
    return compose(a, exp(fraction * log(between(a, b))))


def interpolate_trajectory(stamps: Floats, poses: Floats, query: ArrayLike) -> Floats:
    """Return poses (..., 3) at the query times (...) of a trajectory with non-decreasing stamps (n,) and poses (n, 3).

    Outside the recorded time the nearest end pose holds; between equal stamps the later pose holds.
    """
    query = np.asarray(query, dtype=np.float64)
    if len(stamps) == 1:
        return np.broadcast_to(poses[0], (*query.shape, *POSE)).copy()
    left = np.clip(np.searchsorted(stamps, query, side="right") - 1, 0, len(stamps) - 2)
    span = stamps[left + 1] - stamps[left]
    since = query - stamps[left]
    fraction = np.where(span > 0, np.clip(since / np.where(span > 0, span, 1.0), 0.0, 1.0), since >= 0)
    return interpolate(poses[left], poses[left + 1], fraction)


def chain(start: Floats, steps: Floats) -> Floats:
    """Return the poses (n + 1, 3) of a chain of steps (n, 3), each in the frame of the pose before it, from a start (3,)."""
    theta = start[2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    xy = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(rotate(theta[:-1], steps[:, :2]), axis=0)])
    return np.column_stack([xy, wrap_angle(theta)])


def between_jacobians(a: ArrayLike, b: ArrayLike) -> tuple[Floats, Floats]:
    """Return the Jacobians (..., 3, 3) of between(a, b) by the coordinates of a and of b."""
    a, b = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
    c, s = cos_sin(a[..., 2])
    d = rotate(-a[..., 2], b[..., :2] - a[..., :2])
    db = np.zeros((*a.shape[:-1], *POSE, *POSE))
    db[..., 0, 0] = db[..., 1, 1] = c
    db[..., 0, 1], db[..., 1, 0] = s, -s
    db[..., 2, 2] = 1.0
    da = -db
    da[..., 0, 2] = d[..., 1]
    da[..., 1, 2] = -d[..., 0]
    return da, db


def align(source: Floats, target: Floats) -> Floats:
    """Return T_target_source (3,), the rigid motion that minimises the squared distances of paired points.

    Parameters
    ----------
    source, target : (n, 2) m, point k of one belongs to point k of the other.

    Notes
    -----
    Closed form of Umeyama (1991) in the plane: with centred points p, q the angle is atan2(sum p x q, sum p . q).
    """
    p, q = source - source.mean(axis=0), target - target.mean(axis=0)
    theta = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p * q))
    shift = target.mean(axis=0) - rotate(theta, source.mean(axis=0))
    return np.array([shift[0], shift[1], float(theta)])
