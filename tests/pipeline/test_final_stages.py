"""The occupancy grid: a map larger than memory allows is drawn coarser, and that is said."""

from dataclasses import replace

import pytest
from helpers.room_recording import recording, two_rounds

from uwblite.grid.occupancy_grid import GridConfig
from uwblite.mapping import MappingConfig, build_map


@pytest.fixture(scope="module")
def room():
    log = recording(two_rounds())
    return log.crop(end=float(log.odometry.stamps[0]) + 15.0)


@pytest.mark.parametrize(("most", "kind"), [(10_000, "warnings"), (150, "doubts")])
def test_a_map_larger_than_allowed_is_drawn_coarser_and_reported(room, most, kind):
    result = build_map(room, replace(MappingConfig(), grid=GridConfig(max_cells=most)))
    assert result.grid.geometry.cells <= most
    (notice,) = [n for n in getattr(result, kind) if n.kind == "coarse-grid"]
    edge = result.grid.geometry.resolution
    assert notice.figures == {"resolution": edge, "asked": 0.05}
    assert f"cells of {edge:g} m instead of 0.05 m" in notice.text
