"""Robust spreads: laws of the median absolute deviation, and normal errors with outliers."""

import inspect
import sys
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from uwblite import SensorLog, build_map
from uwblite.arrays import (
    MAD_TO_SIGMA,
    Table,
    array_fields,
    as_array,
    concatenated,
    evenly,
    numbered,
    renumbered,
    require_finite,
    require_index,
    require_shape,
    rms_length,
    row_medians,
    run_starts,
    runs_of,
    spread,
    spread_about_median,
    stable_order,
    unique_rows,
    white_noise,
)
from uwblite.errors import DataError, SolverError
from uwblite.graph import graph, point_edges, pose_edges, range_edges
from uwblite.graph.graph import Calibration, Edges, Graph, PriorEdges, UnknownKey
from uwblite.graph.point_edges import AnchorDistanceEdges
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.solver import optimize
from uwblite.lidar.point_to_point import align
from uwblite.sensor_log import Gyro, LaserScans, Odometry, SensorMounting, UwbRanges


def test_the_factor_is_that_of_normal_errors():
    # 1 / (0.75 quantile of the standard normal distribution).
    assert pytest.approx(1.0 / 0.6744897501960817, abs=5e-5) == MAD_TO_SIGMA


def test_spreads_by_hand():
    assert spread(np.array([-1.0, 2.0, 4.0])) == pytest.approx(2.0 * 1.4826)
    assert spread_about_median(np.array([9.0, 10.0, 13.0])) == pytest.approx(1.4826)


@pytest.mark.parametrize("most", [1, 50, 2**31 - 1, 2**62])
@pytest.mark.parametrize("n", [0, 1, 7, 300])
def test_keys_sort_in_the_order_of_numpy_however_large(n, most):
    keys = np.random.default_rng(n).integers(0, most, n)
    np.testing.assert_array_equal(stable_order(keys), np.argsort(keys, kind="stable"))


def test_a_run_begins_wherever_a_column_changes():
    one, other = np.array([0, 0, 1, 1, 1, 1]), np.array([5, 5, 5, 6, 6, 5])
    assert run_starts(one).tolist() == [0, 2]
    assert run_starts(one, other).tolist() == [0, 2, 3, 5]
    assert run_starts(one[:0], other[:0]).tolist() == []


def test_half_of_the_errors_may_be_outliers():
    errors = np.random.default_rng(1).normal(0.0, 0.2, 20_000)
    assert spread(errors) == pytest.approx(0.2, rel=0.03)
    errors[:4000] = 1e6
    # The median size is then the 0.5 / 0.8 = 0.625 quantile of the sizes, 0.887 standard deviations.
    assert spread(errors) == pytest.approx(0.2 * 0.887 * 1.4826, rel=0.03)


def test_lengths_of_vectors_not_of_their_parts_are_averaged():
    assert rms_length(np.array([[3.0, 4.0], [0.0, 0.0], [0.0, 5.0]])) == pytest.approx(np.sqrt(50.0 / 3.0))


def test_renumbered_values_are_those_of_either_array_once():
    used, one, other = renumbered(np.array([7, 3, 7]), np.array([9, 3, 3]))
    assert used.tolist() == [3, 7, 9]
    assert (used[one].tolist(), used[other].tolist()) == ([7, 3, 7], [9, 3, 3])
    assert [a.size for a in renumbered(np.zeros(0, int), np.zeros(0, int))] == [0, 0, 0]


@pytest.mark.parametrize("columns", [1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 200])
def test_unique_rows_are_numpys(count, columns):
    rows = np.random.default_rng(3).integers(-3, 4, (count, columns))
    for table in (rows, np.floor(rows / 2.0)):
        found, number = unique_rows(table)
        expected, where = np.unique(table, axis=0, return_inverse=True)
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(number, where.reshape(-1))


def test_runs_are_those_of_set_flags():
    assert runs_of(np.array([True, False, True, True])) == [(0, 1), (2, 4)]
    assert runs_of(np.zeros(3, dtype=bool)) == runs_of(np.zeros(0, dtype=bool)) == []


@pytest.mark.parametrize("columns", [1, 2, 3, 8, 99, 100])
def test_medians_of_rows_are_numpys_to_the_last_bit(columns):
    values = np.random.default_rng(columns).normal(size=(40, columns))
    assert np.array_equal(row_medians(values), np.median(values, axis=1))


def test_tables_are_concatenated_field_by_field():
    @dataclass(frozen=True)
    class Inner(Table):
        places: np.ndarray

    @dataclass(frozen=True)
    class Outer(Table):
        SHARED = ("common",)
        inner: Inner
        flags: np.ndarray
        common: np.ndarray
        unknown: np.ndarray

    parts = [Outer(Inner(np.full((n, 2), n)), np.full(n, n > 1), np.full(2, n), np.zeros(0)) for n in (1, 0, 2)]
    whole = concatenated(parts)
    for table in (whole, whole.rows(np.arange(3))):
        assert table.inner.places.tolist() == [[1, 1], [2, 2], [2, 2]]
        assert table.flags.tolist() == [False, True, True]
        assert (table.common.tolist(), len(table.unknown)) == ([1, 1], 0)


KINDS = [
    cls for module in (graph, pose_edges, range_edges, point_edges)
    for _, cls in inspect.getmembers(sys.modules[module.__name__], inspect.isclass)
    if issubclass(cls, Edges) and cls is not Edges and cls.__module__ == module.__name__
]  # fmt: skip


def table(cls, edges=2):
    """Return edges of a kind, all zero."""
    if cls is PriorEdges:
        return PriorEdges("poses", np.zeros(edges, dtype=np.int64), np.zeros((edges, 3)), np.zeros((edges, 3, 3)))
    arrays = {}
    for name, (kind, _, may_be_empty) in array_fields(cls).items():
        row = cls.ROWS.get(name, ())
        if name != "weights" and not may_be_empty:
            arrays[name] = np.zeros(row if name in cls.SHARED else (edges, *row), dtype=kind)
    return cls(**arrays)


def test_every_kind_of_edges_is_tested():
    assert len(KINDS) == 8
    assert all(len(table(cls, 3)) == 3 for cls in KINDS)


@pytest.mark.parametrize("cls", KINDS, ids=lambda c: c.__name__)
def test_every_array_of_every_kind_of_edges_is_checked(cls):
    """A row too many, an axis too many, text; numbers that are not whole for indices; the message has class and field."""
    good = table(cls)
    for name, (kind, _, _) in array_fields(cls).items():
        values = getattr(good, name)
        if values is None or not len(values):
            values = np.zeros(2)
        bad = [values[None], np.full(values.shape, "x"), *([values + 0.5] if issubclass(kind, np.integer) else [])]
        for wrong in bad:
            with pytest.raises(DataError, match=rf"^{cls.__name__}.*\b{name} (has shape|must hold)"):
                replace(good, **{name: wrong})
        with pytest.raises(DataError, match=rf"^{cls.__name__}.* has shape .*(e = \d as of {cls.__name__}|expected \(\d)"):
            replace(good, **{name: np.concatenate([values, values[:1]])})


@pytest.mark.parametrize("cls", KINDS, ids=lambda c: c.__name__)
def test_indices_outside_the_graph_are_refused(cls):
    unknowns = Graph(np.zeros((2, 3)), np.zeros((2, 2)), calibration=Calibration((UnknownKey("range_scale"),), np.zeros(1)))
    good = table(cls)
    unknowns.with_edges(good)
    for name in cls.UNKNOWNS:
        for wrong in (-2, 2):
            index = getattr(good, name).copy()
            index.flat[-1] = wrong
            with pytest.raises(DataError, match=rf"{cls.__name__}.*{name}\[\d\] = {wrong} is no index of \d (poses|anch|cal)"):
                unknowns.with_edges(replace(good, **{name: index}))


def test_lists_and_whole_numbers_are_taken_like_arrays():
    edges = RelativePoseEdges([0, 1], [1, 2], [[1, 0, 0], [1, 0, 0]], [np.eye(3)] * 2)
    solved, summary = optimize(Graph([[0, 0, 0], [2, 0, 0], [3, 1, 0]], edges=[edges]))
    assert summary.converged
    np.testing.assert_allclose(solved.poses, [[0, 0, 0], [1, 0, 0], [2, 0, 0]], atol=1e-9)
    scans = LaserScans([0, 1], [[1, 2, np.inf], [2, 1, np.nan]], 0, 1, 0, 0, 9)
    assert scans.ranges.dtype == np.float32
    log = SensorLog(
        Odometry([0, 1], [[0, 0, 0], [1, 0, 0]]), UwbRanges([0, 1], [0, 0], [1, 2], [100, 100], ["A"]), scans,
        SensorMounting([0.1, 0, 0], tag_position=[0, 0, 1], more_tags=[]), gyro=Gyro([0, 1], [0, 0]),
    )  # fmt: skip
    assert log.ranges.anchor_ids == ("A",)
    assert log.mounting.tags.shape == (1, 3)
    assert {log.odometry.poses.dtype, log.ranges.ranges.dtype, log.gyro.heading.dtype} == {np.dtype(np.float64)}


ODOMETRY = Odometry(np.arange(2.0), np.zeros((2, 3)))
SCANS = LaserScans(np.arange(2.0), np.ones((2, 4), dtype=np.float32), 0.0, 0.1, 0.0, 0.0, 9.0)
RANGES = UwbRanges(np.arange(2.0), np.zeros(2, dtype=np.int64), np.ones(2), np.ones(2), ("A", "B"))


@pytest.mark.parametrize(("make", "words"), [
    (lambda: SensorLog("run.log"), "odometry must be an Odometry, not str 'run.log'"),
    (lambda: SensorLog(None), "odometry must be an Odometry, not NoneType"),
    (lambda: SensorLog(ODOMETRY, SCANS), "ranges must be a UwbRanges, not LaserScans"),
    (lambda: SensorLog(ODOMETRY, mounting={}), "mounting must be a SensorMounting, not dict"),
    (lambda: Odometry(np.zeros(2), np.zeros((2, 2))), r"odometry\.poses has shape \(2, 2\), expected \(n, 3\) with n = 2"),
    (lambda: Odometry("now", np.zeros((1, 3))), "odometry.stamps must hold numbers, not str"),
    (lambda: Odometry([[0], [0, 1]], []), "odometry.stamps is no array: "),
    (lambda: Odometry([0], [[0, 0, None]]), "odometry.poses must hold numbers, not object such as 0"),
    (lambda: UwbRanges([0.0], [0.0], [1.0], [1.0], ("A",)), "ranges.anchor must hold whole numbers, not float64 such as"),
    (lambda: SensorLog(ODOMETRY, replace(RANGES, anchor=np.array([0, -1]))), r"anchor\[1\] = -1 is no index of 2 anchor_ids"),
    (lambda: SensorLog(ODOMETRY, replace(RANGES, anchor_ids=("A", "A"))), "anchor_ids has 'A' twice"),
    (lambda: SensorLog(ODOMETRY, replace(RANGES, anchor_ids=(1, 2))), r"anchor_ids\[0\] must be a str, not int 1"),
    (lambda: SensorLog(ODOMETRY, replace(RANGES, tag=np.array([0, 1]))), r"tag\[1\] = 1 is no index of 1 tags of the mounting"),
    (lambda: SensorLog(ODOMETRY, replace(RANGES, ranges=[1.0, np.inf])), r"ranges\.ranges\[1\] is not finite"),
    (lambda: replace(SCANS, ranges=np.ones(4)), r"scans\.ranges has shape \(4,\), expected \(k, b\)"),
    (lambda: SensorLog(ODOMETRY, scans=replace(SCANS, angle_min=np.nan)), "scans.angle_min is nan"),
    (lambda: SensorLog(ODOMETRY, scans=replace(SCANS, range_max=None)), "scans.range_max must be a number, not NoneType"),
    (lambda: SensorMounting(T_base_laser=np.zeros(2)), r"mounting\.T_base_laser has shape \(2,\), expected \(3,\)"),
    (lambda: Graph(np.zeros((3, 2))), r"Graph\.poses has shape \(3, 2\), expected \(n, 3\)"),
    (lambda: Graph(np.zeros((3, 3)), fixed_poses=np.ones(2, dtype=bool)), r"fixed_poses has shape \(2,\), expected \(n,\) w"),
    (lambda: Graph(np.zeros((3, 3)), fixed_poses=[0, 1, 0]), "Graph.fixed_poses must hold True or False, not int"),
    (lambda: Graph(np.zeros((3, 3)), edges=table(RelativePoseEdges)), "edges must be a tuple of tables of edges, not Relative"),
    (lambda: Graph(np.zeros((3, 3)), edges=("x",)), r"Graph\.edges\[0\] is a str, which is no table of edges"),
    (lambda: Graph(np.zeros((3, 3)), calibration=Calibration((), np.zeros(1))), "Calibration has 1 values for 0 keys"),
    (lambda: optimize(Graph([[0, 0, 0], [np.nan, 0, 0]], edges=[table(RelativePoseEdges)])), r"not finite: poses\[1\]"),
    (lambda: optimize(Graph(np.zeros((1, 3)), np.zeros((2, 2)), (AnchorDistanceEdges([0], [1], [1], [0]),))),
     r"edge 0 of AnchorDistanceEdges .*its sigma is 0\.0"),
    (lambda: optimize(Graph(np.zeros((2, 3)), edges=[RelativePoseEdges([0], [1], [[0, 0, np.nan]], [np.eye(3)])])),
     r"edge 0 of RelativePoseEdges .*its T_i_j is \[0\.0, 0\.0, nan\]"),
    (lambda: align(np.zeros((20, 3)), np.zeros((20, 2))), r"target has shape \(20, 3\), expected \(n, 2\)"),
    (lambda: align(np.zeros((20, 2)), [[np.nan, 0]]), r"source\[0\] is not finite"),
    (lambda: align(np.zeros((20, 2)), np.zeros((20, 2)), [0, 0]), r"T_target_source has shape \(2,\), expected \(3,\)"),
    (lambda: build_map("run.log"), "logs must be a SensorLog, not str 'run.log'"),
    (lambda: build_map([]), "logs is empty"),
    (lambda: build_map([SensorLog(ODOMETRY), 3]), r"logs\[1\] must be a SensorLog, not int 3"),
    (lambda: build_map(SensorLog(ODOMETRY), {}), "config must be a MappingConfig, not dict"),
    (lambda: build_map(SensorLog(ODOMETRY), constraints=()), "constraints must be a Constraints, not tuple"),
])  # fmt: skip
def test_the_argument_that_is_wrong_is_named(make, words):
    with pytest.raises((DataError, SolverError), match=words):
        make()


def test_icp_takes_points_as_lists():
    corner = [[0.1 * k, 0.0] for k in range(30)] + [[0.0, 0.1 * k] for k in range(1, 30)]
    found = align(corner, (np.array(corner) - [0.03, 0.02]).tolist())
    assert found.converged
    np.testing.assert_allclose(found.T_target_source, [0.03, 0.02, 0.0], atol=1e-6)


def test_arrays_of_the_right_kind_are_not_copied():
    values = np.zeros((4, 3))
    assert as_array(values, "x") is values
    assert as_array(np.zeros(2, dtype=np.int32), "x", np.int64).dtype == np.int32
    assert Graph(values).poses is values


def test_lengths_that_have_a_name_are_the_same_everywhere():
    known = {}
    require_shape(np.zeros((4, 2)), "one", ("n", 2), known)
    assert known == {"n": (4, "one")}
    with pytest.raises(DataError, match=r"other has shape \(5,\), expected \(n,\) with n = 4 as of one"):
        require_shape(np.zeros(5), "other", ("n",), known)


def test_an_index_into_nothing():
    require_index(np.zeros(0, dtype=int), "i", 0, "poses")
    with pytest.raises(DataError, match=r"i\[0\] = 0 is no index of 0 poses \(there are none\)"):
        require_index(np.zeros(1, dtype=int), "i", 0, "poses")


def test_arrays_are_found_by_their_annotations():
    found = array_fields(UwbRanges)
    assert set(found) == {f.name for f in fields(UwbRanges)} - {"anchor_ids"}
    assert issubclass(found["anchor"][0], np.integer)
    assert found["tag"][1]
    assert not found["ranges"][1]


def test_indices_wider_than_addresses_are_narrowed_where_they_fit():
    """As random integers are on 32-bit machines, whose indices are int32 there."""
    wide = np.array([0, 7], dtype=np.int64)
    assert as_array(wide, "pose", np.int32).dtype == np.int32
    assert as_array(wide, "pose", np.int64) is wide
    assert as_array(wide.astype(np.int16), "pose", np.int32).dtype == np.int16
    with pytest.raises(DataError, match="pose holds 8589934592, which does not fit into int32"):
        as_array(wide + (1 << 33), "pose", np.int32)


@pytest.mark.parametrize(("value", "most", "words"), [(np.nan, np.inf, "is not finite"), (1e9, 1e6, r"is beyond 1e\+06")])
def test_the_row_of_a_table_that_is_no_measurement_is_named(value, most, words):
    table = np.zeros((5, 3))
    table[3, 1:] = value
    with pytest.raises(DataError, match=rf"^poses\[3\] {words} \(1 such rows\)"):
        require_finite(table, "poses", most)


def test_the_noise_of_a_smooth_series_is_what_was_added_to_it():
    """20,000 values: the median absolute deviation of normal errors scatters by 1.2 / sqrt(n), neighbours counted twice."""
    rng, time = np.random.default_rng(0), np.linspace(0.0, 30.0, 20_000)
    assert white_noise(4.0 * np.sin(time) + 0.3 * rng.standard_normal(len(time))) == pytest.approx(0.3, rel=0.03)


@pytest.mark.parametrize(("count", "most"), [(0, 5), (1, 5), (3, 5), (5, 5), (6, 5), (1000, 7), (999, 500)])
def test_an_even_choice_has_both_ends_and_gaps_that_differ_by_one(count, most):
    chosen = evenly(count, most)
    assert len(chosen) == min(count, most)
    if count:
        assert (chosen[0], chosen[-1]) == (0, count - 1)
    if len(chosen) > 1:
        assert 1 <= np.diff(chosen).min() >= np.diff(chosen).max() - 1


def test_entries_of_groups_are_numbered_from_0_on():
    group, number = numbered(np.array([2, 0, 3]))
    assert group.tolist() == [0, 0, 2, 2, 2]
    assert number.tolist() == [0, 1, 0, 1, 2]
    assert [len(column) for column in numbered(np.zeros(0, dtype=np.intp))] == [0, 0]
