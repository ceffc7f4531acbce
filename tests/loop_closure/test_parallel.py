"""Work spread over processes: the same answers in the same order, the same maps byte for byte."""

import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uwblite.cli import main
from uwblite.io.carmen import read_log, write_log
from uwblite.loop_closure.parallel import in_order
from uwblite.mapping import MappingConfig, build_map


def late_first(task):
    time.sleep(0.02 * (3 - task))
    return task * task


@pytest.mark.parametrize("workers", [None, 1, 3])
def test_answers_come_in_the_order_of_the_tasks(workers):
    if workers is None:
        assert list(in_order(late_first, iter(range(4)))) == [0, 1, 4, 9]
        return
    with ThreadPoolExecutor(workers) as executor:
        assert list(in_order(late_first, iter(range(4)), executor)) == [0, 1, 4, 9]


@pytest.fixture(scope="module")
def minutes(room_log, tmp_path_factory):
    """Two recordings of 15 s in one room, as files."""
    folder, log = tmp_path_factory.mktemp("minutes"), read_log(room_log)
    paths = [folder / "one.log", folder / "two.log"]
    for path, start in zip(paths, (0.0, 50.0), strict=True):
        write_log(path, log.crop(start, start + 15.0))
    return paths


def files(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files of a folder by name."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.mark.slow
@pytest.mark.parametrize("several", [False, True])
def test_a_map_is_the_same_bytes_for_any_number_of_jobs(minutes, tmp_path, several):
    written = []
    for jobs in (1, 3):
        out = tmp_path / f"jobs{jobs}"
        logs = [str(path) for path in (minutes if several else minutes[:1])]
        main(["map", *logs, "--out", str(out), "--jobs", str(jobs), "--no-timings", "--quiet"])
        written.append(files(out))
    assert len(written[0]) > 8
    for other in written[1:]:
        assert other.keys() == written[0].keys()
        assert [name for name in other if other[name] != written[0][name]] == []


def same_map(one, other) -> bool:
    """Return whether two results agree in every bit of what was matched and traced."""
    pairs = [(one.trajectory, other.trajectory), (one.grid.log_odds, other.grid.log_odds)]
    pairs += [(a.T_i_j, b.T_i_j) for a, b in zip(one.closures, other.closures, strict=True)]
    return all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("method", [pytest.param("search", marks=pytest.mark.slow), "icp"])
def test_closures_and_rays_are_the_same_bytes_whatever_the_executor(minutes, method):
    log = read_log(minutes[0])
    config = MappingConfig()
    if method == "icp":
        config = replace(config, loop_closure=replace(config.loop_closure, method="icp", rounds=1))
    alone = build_map(log, config)
    with ProcessPoolExecutor(2) as executor:
        assert same_map(alone, build_map(log, config, executor=executor))


def test_a_cluster_makes_the_same_bytes(minutes):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed (extra: dev)")
    log = read_log(minutes[0])
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
        client.get_executor() as executor,
    ):
        spread = build_map(log, executor=executor)
    assert same_map(build_map(log), spread)
