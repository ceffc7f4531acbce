"""Streams without a check sum: what leaps waits, damage does not become a reading, and what is given up is counted."""

import math
import random
from bisect import bisect
from itertools import islice

import pytest
from emulators.scip_device import ScipDevice
from emulators.simulated_time import of_kind, simulate
from emulators.uwb_boards import BOARDS, slots
from emulators.world import RoomWorld, WorldClock

from uwblite.drivers.continuity import MOST_GAP, SPEED, SPREAD, Continuity, LinkHealth, RangeGuard
from uwblite.drivers.devices import open_device
from uwblite.drivers.events import Corrupt, LaserScan, Lost, RangeEpoch, RangeReading

CLEAN_ROUNDS, ROUNDS = 20, 300
NUMBERED = ("makerfabs-at", "bu01", "bu03", "linktrack")
SPECS = {name: f"{name}:port" for name in BOARDS} | {
    "line": "line:port?columns=t,id,range,quality&prefix=UWB&unit=0.001&time_unit=0.001"
}
SEEN = SPREAD + SPEED * MOST_GAP + 0.1
"""m; a wrong range so near to the one before cannot be distinguished from a right one; that may be a little wrong, too."""


def flip(data, rate, rng):
    """Change each bit with this probability."""
    out, at = bytearray(data), -1
    while (at := at + 1 + int(math.log(1 - rng.random()) / math.log(1 - rate))) < 8 * len(out):
        out[at >> 3] ^= 1 << (at & 7)
    return bytes(out)


def played(name, rate, seed):
    """Return the rounds that were sent, [(time, {anchor: m})], and what a session makes of them on a noisy line."""
    rng, sent, actions = random.Random(seed), [], []
    session = open_device("uwb", SPECS[name])[0]
    session.start(0.0)
    for k, epoch in enumerate(islice(RoomWorld().epochs(), ROUNDS)):
        data, arrival = BOARDS[name](epoch, k, round(1000 * epoch.time)), 100.0 + epoch.time
        noisy = flip(data, rate, rng) if k >= CLEAN_ROUNDS else data
        noisy = b"\xff\xfe\r\n" + noisy if k == CLEAN_ROUNDS else noisy  # a link that has shown no damage is believed
        actions += session.feed(noisy, arrival + rng.expovariate(1000.0))
        names = {f"{a:X}" if name == "makerfabs" else f"{a:04X}": mm / 1000 for a, mm, _ in epoch.readings}
        numbers = {str(i): mm / 1000 for i, mm in enumerate(slots(epoch)) if mm}
        sent.append((arrival, numbers if name in NUMBERED else names))
    return sent, actions + session.stop()


@pytest.mark.parametrize("rate", [1e-3, 3e-3, 1e-2])
@pytest.mark.parametrize("name", SPECS)
def test_bits_that_change_make_no_readings(name, rate):
    sent, actions = played(name, rate, round(1000 * rate))
    arrivals, received = [arrival for arrival, _ in sent], 0
    for epoch in (a for a in actions if isinstance(a, RangeEpoch)):
        after = bisect(arrivals, epoch.stamp)
        arrival, ranges = min(sent[max(after - 1, 0) : after + 1], key=lambda round_: abs(round_[0] - epoch.stamp))
        assert abs(arrival - epoch.stamp) < 0.06  # LATE, jitter and the tick of its clock
        for reading in epoch.readings:
            received += 1
            assert abs(reading.range - ranges[reading.anchor_id]) < SEEN
    missing = sum(len(ranges) for _, ranges in sent) - received
    assert sum(isinstance(a, Corrupt) for a in actions) >= missing / 16  # a frame holds four ranges, noise joins frames
    assert received >= CLEAN_ROUNDS


def guard(rows, *, damaged=False):
    """Return the ranges that pass and how many are given up; rows of (time, anchor, m)."""
    health = LinkHealth()
    watch, actions = RangeGuard(health), []
    for stamp, anchor, metres in rows:
        if damaged:
            health.damage(stamp)
        actions += watch.take(RangeEpoch(stamp, (RangeReading(anchor, metres, 100),)), stamp)
    actions += watch.finish()
    passed = [(a.stamp, r.anchor_id, r.range) for a in actions if isinstance(a, RangeEpoch) for r in a.readings]
    return passed, sum(isinstance(a, Corrupt) for a in actions)


WALK = [(0.1 * k, "A", 5.0 + 0.1 * k) for k in range(40)]


@pytest.mark.parametrize("damaged", [False, True])
def test_a_robot_that_walks_loses_nothing(damaged):
    assert guard(WALK, damaged=damaged) == (WALK, 0)


@pytest.mark.parametrize("wrong", [(2.05, "A", 9.0), (2.05, "B", 7.0)])
def test_a_leap_away_and_back_and_an_anchor_seen_once_are_given_up_and_counted(wrong):
    assert guard(sorted([*WALK, wrong]), damaged=True) == (WALK, 1)
    assert guard(sorted([*WALK, wrong])) == (sorted([*WALK, wrong]), 0)


def test_a_leap_that_stays_passes_with_its_own_stamps():
    """A person steps into the line of sight: the first range waits for the second, and both are logged."""
    rows = [(t, name, metres + (2.0 if 1.95 < t < 3.0 else 0.0)) for t, name, metres in WALK]
    assert guard(rows, damaged=True) == (rows, 0)


def test_anchors_are_rarely_invented_by_a_damaged_link_and_a_slow_board_is_read():
    rng = random.Random(1)
    strange = [(0.05 * k, f"{rng.randrange(8)}", 0.001 * 2 ** rng.randrange(9)) for k in range(0, 2000, 7)]
    passed, given_up = guard(strange, damaged=True)
    assert not passed
    assert given_up == len(strange)
    slow = [(2.0 * k, "A", 5.0) for k in range(40)]
    assert guard(slow) == (slow, 0)


def test_ranges_that_scatter_on_a_clean_link_pass_whole():
    rng = random.Random(2)
    rows = [(0.1 * k, "AB"[k % 2], rng.uniform(1.0, 8.0)) for k in range(300)]
    assert guard(rows) == (rows, 0)


def test_memory_is_bounded():
    watch = RangeGuard(LinkHealth())
    for k in range(5000):
        watch.take(RangeEpoch(0.1 * k, (RangeReading(f"{k:X}", 3.0, 100),)), 0.1 * k)
    assert len(watch._anchors) < 300


def test_a_series_that_begins_again_is_followed():
    series = Continuity(lambda before, after: abs(after - before) < 2)
    taken = [series.take(item, 1) for item in (1, 2, 50, 3, 80, 81, 82)]
    assert taken == [([], []), ([1, 2], []), ([], []), ([3], [50]), ([], []), ([80, 81], []), ([82], [])]


def test_a_reading_with_a_sum_that_was_late_passes_with_the_next_that_goes_on_from_both():
    for summed, taken in ((True, ([2.5, 1.0], [])), (False, ([1.0], [2.5]))):
        series = Continuity(lambda before, after: abs(after - before) < 2, summed=summed)
        series.take(0, 0)
        assert series.take(2.5, 1) == ([], [])
        assert series.take(1.0, 1) == taken


@pytest.mark.parametrize("pause", [0.2, 0.6])
@pytest.mark.parametrize("kind", ["pause", "stop"])
def test_no_scan_is_lost_to_a_short_pause(kind, pause):
    sent = []
    clock = WorldClock()
    clock.start(1000.0)
    device = ScipDevice(RoomWorld().scans(), clock, on_scan=lambda t, values: sent.append(t))
    actions, _ = simulate(open_device("lidar", "scip:port")[0], device, 8.0, **{kind: (5.0, pause)})
    got = of_kind(actions, LaserScan)
    assert len(got) == len([t for t in sent if got[0].stamp - 0.05 < t < got[-1].stamp + 0.05])
    assert not of_kind(actions, Lost)
    assert not of_kind(actions, Corrupt)
