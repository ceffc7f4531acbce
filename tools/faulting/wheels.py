"""Faults of wheels, odometry and of those who move the robot."""


import numpy as np

from uwblite import se2

from .case import Case, Fault, Floats, Rng, chained, kept, shifted, with_odometry


def frozen_wheels(start: float, seconds: float) -> Fault:
    """Wheels that repeat their last reading; start as a share of the recording, then they go on from where they froze."""

    def fault(case: Case, rng: Rng) -> Case:
        def change(stamps: Floats, poses: Floats) -> Floats:
            begin = stamps[0] + start * (stamps[-1] - stamps[0])
            still = (stamps >= begin) & (stamps < begin + seconds)
            steps = se2.between(poses[:-1], poses[1:])
            steps[still[1:]] = 0.0
            return chained(poses[0], steps)

        return with_odometry(case, change)

    return fault


def reset(case: Case, rng: Rng) -> Case:
    """The base restarts half-way and counts from zero."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        later = stamps >= case.middle
        poses[later] = se2.between(np.broadcast_to(poses[later][0], poses[later].shape), poses[later])
        return poses

    return with_odometry(case, change)


def glitch(case: Case, rng: Rng) -> Case:
    """A single reading is 3 km off."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        poses[len(poses) // 2, :2] += 3000.0
        return poses

    return with_odometry(case, change)


def rescaled(x: float, y: float, theta: float) -> Fault:
    """Multiply the odometry."""
    return lambda case, rng: with_odometry(case, lambda stamps, poses: poses * np.array([x, y, theta]))


def redriven(way: float, turn: float) -> Fault:
    """Let the wheels count other ways and turns: the path follows the wrong heading, as a base computes it."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps = se2.between(poses[:-1], poses[1:])
        half = 0.5 * steps[:, 2]
        # A base on omnidirectional wheels drives sideways as well.
        moved = se2.rotate(-half, steps[:, :2]) * np.array([way, way * turn])
        turned = turn * steps[:, 2]
        return chained(poses[0], np.column_stack([se2.rotate(0.5 * turned, moved), turned]))

    return lambda case, rng: with_odometry(case, change)


def heading_without_sign(case: Case, rng: Rng) -> Case:
    """The heading is taken from a quaternion as twice the arc cosine of w: it is never negative."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        return np.column_stack([poses[:, :2], np.abs(se2.wrap_angle(poses[:, 2]))])

    return with_odometry(case, change)


def from_half(fault: Fault) -> Fault:
    """Another fault of the wheels from half time on: the chain of steps goes on where it was."""

    def half(case: Case, rng: Rng) -> Case:
        other = fault(case, rng).log.odometry.poses

        def change(stamps: Floats, poses: Floats) -> Floats:
            sound, wrong = (se2.between(p[:-1], p[1:]) for p in (poses, other))
            return chained(poses[0], np.where((stamps[1:] >= case.middle)[:, None], wrong, sound))

        return with_odometry(case, change)

    return half


def pushed(metres: float) -> Fault:
    """The robot is pushed sideways half-way within 2 s, and no wheel counts it."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps, middle = se2.between(poses[:-1], poses[1:]), float(np.mean(stamps[[0, -1]]))
        on = (stamps[1:] >= middle) & (stamps[1:] < middle + 2.0)
        steps[on, 1] -= 0.5 * metres * np.diff(stamps)[on]
        return chained(poses[0], steps)

    return lambda case, rng: with_odometry(case, change)


def drifting_radius(to: float) -> Fault:
    """The wheels' radius changes steadily, up to a factor on their ways: a tyre loses air."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps, age = se2.between(poses[:-1], poses[1:]), (stamps[1:] - stamps[0]) / np.ptp(stamps)
        steps[:, :2] *= (1.0 + (to - 1.0) * age)[:, None]
        return chained(poses[0], steps)

    return lambda case, rng: with_odometry(case, change)


def carried(seconds: float, gap: float) -> Fault:
    """The robot is picked up half-way and put down where it would have been `seconds` later; the log pauses for a gap, s."""

    def fault(case: Case, rng: Rng) -> Case:
        begin, end = case.middle, case.middle + min(seconds, 0.3 * float(np.ptp(case.log.odometry.stamps)))
        poses, stamps = case.log.odometry.poses, case.log.odometry.stamps
        before, after = np.searchsorted(stamps, [begin, end])
        put_down = se2.compose(poses[before - 1], se2.inverse(poses[after]))
        case = with_odometry(case, lambda t, p: np.where((t >= end)[:, None], se2.compose(put_down, p), p))
        case = kept(case, lambda t: (t < begin) | (t >= end))
        return shifted(case, lambda t: np.where(t >= end, gap - (end - begin), 0.0))

    return fault


def slipping_wheel(case: Case, rng: Rng) -> Case:
    """One wheel spins on a smooth patch: for 6 s three times over, the wheels count a turn and way that are not."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps, span = se2.between(poses[:-1], poses[1:]), np.diff(stamps)
        for share in (0.3, 0.55, 0.8):
            begin = stamps[0] + share * (stamps[-1] - stamps[0])
            on = (stamps[1:] >= begin) & (stamps[1:] < begin + 6.0)
            steps[on] += np.column_stack([0.05 * span[on], np.zeros(on.sum()), 0.25 * span[on]])
        return chained(poses[0], steps)

    return with_odometry(case, change)


def other_wheels(factor: float) -> Fault:
    """From half-way on the wheels have another radius: a tyre was changed, or a load presses it flat."""

    def fault(case: Case, rng: Rng) -> Case:
        def change(stamps: Floats, poses: Floats) -> Floats:
            steps = se2.between(poses[:-1], poses[1:])
            steps[stamps[1:] >= case.middle, :2] *= factor
            return chained(poses[0], steps)

        return with_odometry(case, change)

    return fault


def larger_at_first(factor: float, share: float) -> Fault:
    """Up to a share of the recording the wheels have another radius: a load is put down then."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps = se2.between(poses[:-1], poses[1:])
        steps[stamps[1:] < stamps[0] + share * (stamps[-1] - stamps[0]), :2] *= factor
        return chained(poses[0], steps)

    return lambda case, rng: with_odometry(case, change)


def turned_at_once(angle: float, share: float) -> Fault:
    """The heading jumps by so much, rad, from one reading to the next: a gyro was set, or a wheel hit a sill."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps = se2.between(poses[:-1], poses[1:])
        steps[int(share * len(steps)), 2] += angle
        return chained(poses[0], steps)

    return lambda case, rng: with_odometry(case, change)


def spinning_wheels(case: Case, rng: Rng) -> Case:
    """Half-way both wheels spin against an obstacle for 20 s and count 4 m that are none."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps, span = se2.between(poses[:-1], poses[1:]), np.diff(stamps)
        on = (stamps[1:] >= case.middle) & (stamps[1:] < case.middle + 20.0)
        steps[on, 0] += 0.2 * span[on]
        return chained(poses[0], steps)

    return with_odometry(case, change)


def drifting_heading(rate: float) -> Fault:
    """The heading drifts ever faster, up to a rate, rad/s: a gyro that warms up."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps, span = se2.between(poses[:-1], poses[1:]), np.diff(stamps)
        steps[:, 2] += rate * span * (stamps[1:] - stamps[0]) / np.ptp(stamps)
        return chained(poses[0], steps)

    return lambda case, rng: with_odometry(case, change)


def stuck_heading(case: Case, rng: Rng) -> Case:
    """From half-way on the heading stays what it was; the positions follow it, as a base computes them."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps = se2.between(poses[:-1], poses[1:])
        steps[stamps[1:] >= case.middle, 2] = 0.0
        return chained(poses[0], steps)

    return with_odometry(case, change)


def one_wheel(factor: float, seconds: float = 1e9) -> Fault:
    """From half-way on the left wheel of a track of 0.3 m counts so many times its way, for so long."""

    def fault(case: Case, rng: Rng) -> Case:
        def change(stamps: Floats, poses: Floats) -> Floats:
            steps, track = se2.between(poses[:-1], poses[1:]), 0.3
            on = (stamps[1:] >= case.middle) & (stamps[1:] < case.middle + seconds)
            left, right = (steps[on, 0] + side * 0.5 * track * steps[on, 2] for side in (-factor, 1.0))
            left += (factor - 1.0) * steps[on, 0]
            steps[on] = np.column_stack([0.5 * (left + right), steps[on, 1], (right - left) / track])
            return chained(poses[0], steps)

        return with_odometry(case, change)

    return fault


def loose_encoder(case: Case, rng: Rng) -> Case:
    """The plug of the left encoder is loose: for 6 s of 50 the left wheel counts nothing, on a track of 0.3 m."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps = se2.between(poses[:-1], poses[1:])
        off = (stamps[1:] - stamps[0]) % 50.0 < 6.0
        right = steps[:, 0] + 0.15 * steps[:, 2]
        steps[off, 0], steps[off, 2] = 0.5 * right[off], right[off] / 0.3
        return chained(poses[0], steps)

    return with_odometry(case, change)


def wrapped_counters(case: Case, rng: Rng) -> Case:
    """The counters of both wheels have 16 bits, 0.2 mm each, and the base does not notice that they wrap."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps, track, size = se2.between(poses[:-1], poses[1:]), 0.3, 2**16 * 0.0002
        counted = np.cumsum([steps[:, 0] + side * 0.5 * track * steps[:, 2] for side in (-1.0, 1.0)], axis=1)
        left, right = np.diff(np.mod(counted + 0.4 * size, size), axis=1, prepend=0.4 * size)
        return chained(poses[0], np.column_stack([0.5 * (left + right), steps[:, 1], (right - left) / track]))

    return with_odometry(case, change)


def corrected_by_jumps(metres: float, turn: float, every: float) -> Fault:
    """What is recorded as odometry is the pose of a SLAM, which jumps now and then (1 sigma, m and rad)."""

    def fault(case: Case, rng: Rng) -> Case:
        def change(stamps: Floats, poses: Floats) -> Floats:
            steps = se2.between(poses[:-1], poses[1:])
            at = np.flatnonzero(np.diff(np.floor((stamps - stamps[0]) / every)) > 0)
            steps[at] += rng.normal(0.0, [metres, metres, turn], (len(at), 3))
            return chained(poses[0], steps)

        return with_odometry(case, change)

    return fault


def exchanged_axes(case: Case, rng: Rng) -> Case:
    """x stands where y should, and y where x should."""
    return with_odometry(case, lambda stamps, poses: poses[:, [1, 0, 2]])


def coarse(way: float, turn: float) -> Fault:
    """Positions and heading are rounded to so many metres and radians."""
    return lambda case, rng: with_odometry(
        case, lambda stamps, poses: np.round(poses / [way, way, turn]) * [way, way, turn]
    )


def cut_off(way: float, turn: float) -> Fault:
    """The base cuts each step off to whole units, m and rad, and forgets the rest."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        unit = np.array([way, way, turn])
        return chained(poses[0], np.trunc(se2.between(poses[:-1], poses[1:]) / unit) * unit)

    return lambda case, rng: with_odometry(case, change)


def one_side_drifting(to: float) -> Fault:
    """The way of the left wheel of a track of 0.4 m is counted with a factor that goes steadily to another one."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps, track = se2.between(poses[:-1], poses[1:]), 0.4
        factor = 1.0 + (to - 1.0) * (stamps[1:] - stamps[0]) / np.ptp(stamps)
        left, right = (steps[:, 0] - 0.5 * track * steps[:, 2]) * factor, steps[:, 0] + 0.5 * track * steps[:, 2]
        return chained(poses[0], np.column_stack([0.5 * (left + right), steps[:, 1], (right - left) / track]))

    return lambda case, rng: with_odometry(case, change)


def shoved(ahead: float, left: float, turn: float) -> Fault:
    """The robot is shoved half-way, m and rad, between two readings, and no wheel counts it."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps, at = se2.between(poses[:-1], poses[1:]), int(np.searchsorted(stamps[1:], np.mean(stamps[[0, -1]])))
        # Wheels know nothing of it: what they count lacks the shove.
        steps[at] = se2.compose(steps[at], se2.inverse(np.array([ahead, left, turn])))
        return chained(poses[0], steps)

    return lambda case, rng: with_odometry(case, change)
