"""What a URG-04LX sees: every ray is cast from where the laser is at that ray's own time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LaserModel:
    """Geometry and noise of the scanner; the defaults are those of its data sheet."""

    beams: int = 682
    first_step: int = -340
    """Step of beam 0, counted from straight ahead (steps 44..725 about 384)."""
    increment: float = 2.0 * np.pi / 1024.0
    """rad; 1024 steps a turn."""
    time_increment: float = 0.1 / 1024.0
    """s between rays."""
    stated: bool = True
    """Whether the log states the time between rays."""
    max_range: float = 5.6
    min_range: float = 0.02
    near_sd: float = 0.010
    """m, up to 1 m."""
    far_sd: float = 0.010
    """of the distance, beyond 1 m."""
    surface_sd: float = 0.004
    """m; constant error of one wall by its colour."""
    blind: float = 0.01
    """Share of rays that see nothing for no reason."""
    grazing: float = np.deg2rad(80.0)
    """Angle of incidence at which half of the rays at 3 m are lost."""
    weak: float = 0.0
    """Share of rays lost at full reach; in proportion to the square of the distance, and to paint."""
    dark: float = 0.0
    """Share of the surfaces that are painted dark: the angle and the distance at which they answer halve."""
    mixed: float = 0.35
    """Share of the rays at an edge that return a distance between the two surfaces."""
    error_codes: float = 0.1
    """Share of the lost rays that are reported as a code below 20 mm; the rest as max_range."""

    @property
    def angles(self) -> Floats:
        """(beams,) angle of each ray in the laser frame, rad."""
        return (self.first_step + np.arange(self.beams)) * self.increment


SPINNING = LaserModel(
    beams=450, first_step=-225, increment=2.0 * np.pi / 450.0, time_increment=0.0, max_range=8.0, surface_sd=0.008
)
"""A turn of 0.8 deg rays, as of an LD06, as if all were of one time."""
UNSTATED = LaserModel(
    beams=360, first_step=-180, increment=2.0 * np.pi / 360.0, time_increment=0.1 / 360.0, stated=False, max_range=8.0,
    surface_sd=0.008,
)
"""A turn of 360 rays in 0.1 s, in a log that does not say so."""
NARROW = LaserModel(
    beams=160, first_step=-80, increment=np.deg2rad(0.75), time_increment=0.0, max_range=4.0
)
"""120 deg and 4 m."""
RIGHT_ANGLE = LaserModel(
    beams=180, first_step=-90, increment=np.deg2rad(0.5), time_increment=0.0, max_range=8.0
)
"""90 deg and 8 m."""


def cast(
    origins: Floats, angles: Floats, walls: Floats, columns: Floats, reach: float
) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Return distance (n,), cosine of incidence (n,) and surface index (n,) seen by rays from origins (n, 2) at angles (n,).

    Walls are (w, 4), columns (c, 3) or (n, c, 3) where they move. Nothing within reach: distance inf, surface -1.
    Surfaces count walls first, columns after.
    """
    dx, dy = np.cos(angles), np.sin(angles)
    best = np.full(len(angles), np.inf)
    cosine, surface = np.ones(len(angles)), np.full(len(angles), -1, dtype=np.intp)
    for k, (x1, y1, x2, y2) in enumerate(walls):
        ex, ey = x2 - x1, y2 - y1
        ax, ay = x1 - origins[:, 0], y1 - origins[:, 1]
        cross = dx * ey - dy * ex
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (ax * ey - ay * ex) / cross
            u = (ax * dy - ay * dx) / cross
        hit = (t > 0.0) & (u >= 0.0) & (u <= 1.0) & (t < best)
        best[hit] = t[hit]
        cosine[hit] = np.abs(cross[hit]) / np.hypot(ex, ey)
        surface[hit] = k
    for k in range(columns.shape[-2]):
        cx, cy, radius = (columns[..., k, j] for j in range(3))
        ax, ay = cx - origins[:, 0], cy - origins[:, 1]
        along = ax * dx + ay * dy
        miss = ax * dy - ay * dx
        depth2 = radius * radius - miss * miss
        t = along - np.sqrt(np.maximum(depth2, 0.0))
        hit = (depth2 > 0.0) & (t > 0.0) & (t < best)
        best[hit] = t[hit]
        cosine[hit] = np.sqrt(depth2[hit]) / np.broadcast_to(radius, t.shape)[hit]
        surface[hit] = len(walls) + k
    beyond = best > reach
    best[beyond], surface[beyond] = np.inf, -1
    return best, cosine, surface


def near(walls: Floats, columns: Floats, centre: Floats, reach: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return indices of the walls and columns that come within reach of the centre (2,)."""
    a, e = walls[:, :2], walls[:, 2:] - walls[:, :2]
    length2 = np.maximum((e * e).sum(axis=1), 1e-12)
    u = np.clip(((centre - a) * e).sum(axis=1) / length2, 0.0, 1.0)
    far = np.hypot(*(a + u[:, None] * e - centre).T)
    return np.flatnonzero(far <= reach), np.flatnonzero(np.hypot(*(columns[:, :2] - centre).T) - columns[:, 2] <= reach)


def disturb(
    true: Floats, cosine: Floats, surface: NDArray[np.intp], model: LaserModel, colour: Floats, rng: np.random.Generator,
    dark: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the reported distances, mm, of whole scans (k, beams), and which are of two surfaces at once.

    There are noise, mixed pixels, lost rays and error codes. dark (s,): which surfaces are painted dark, the last one is none.
    """
    seen = np.isfinite(true)
    range_ = np.where(seen, true, model.max_range)
    jump = np.zeros_like(seen)
    jump[:, :-1] = np.abs(range_[:, 1:] - range_[:, :-1]) > 0.12
    # Neighbours on one oblique wall are no edge, however far apart they are.
    jump[:, :-1] &= surface[:, 1:] != surface[:, :-1]
    jump &= seen
    mix = jump & (rng.random(true.shape) < model.mixed)
    neighbour = np.concatenate([range_[:, 1:], range_[:, -1:]], axis=1)
    # A neighbour that sees nothing leaves no second echo to mix with: such an edge only loses rays.
    both = mix & np.concatenate([seen[:, 1:], seen[:, -1:]], axis=1)
    share = rng.random(true.shape)
    stated = np.where(both, range_ + share * (neighbour - range_), range_)
    sd = np.maximum(model.near_sd, model.far_sd * stated)
    stated = stated + sd * rng.standard_normal(true.shape) + np.where(surface >= 0, colour[surface], 0.0)
    # Little light comes back from oblique and far surfaces: the angle that still answers shrinks with distance.
    painted = np.ones(true.shape) if dark is None else np.where((surface >= 0) & dark[surface], 2.0, 1.0)
    limit = np.cos(model.grazing) * painted * range_ / 3.0
    lost = rng.random(true.shape) > 1.0 / (1.0 + np.exp(np.clip((limit - cosine) / (0.15 * limit + 1e-3), -50, 50)))
    lost |= rng.random(true.shape) < model.blind + model.weak * np.square(painted * range_ / model.max_range)
    lost |= mix & ~both
    lost |= ~seen | (stated >= model.max_range) | (stated < model.min_range)
    code = rng.random(true.shape) < model.error_codes
    codes = np.where(code, rng.integers(0, 20, true.shape), round(model.max_range * 1000))
    return np.where(lost, codes, np.rint(stated * 1000)).astype(np.intp), both
