"""The raster of a cloud against a tree of its points."""

import numpy as np
from helpers.registration_worlds import scattered
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from uwblite.lidar.cloud_rasters import _RUN, rasterize


@settings(max_examples=15)
@given(st.integers(0, 1000))
def test_the_raster_names_the_nearest_point_to_a_cell(seed):
    rng = np.random.default_rng(seed)
    clouds, cell, reach = scattered(rng, [40, 0, 1, 80]), 0.05, 0.3
    raster = rasterize(clouds, cell, reach)
    # Runs of cells that name no point are kept once for all.
    assert np.flatnonzero(raster.nearest.reshape(-1, _RUN).max(axis=1) < 0).tolist() == [0]
    usable = np.any(clouds.normals != 0.0, axis=1)
    for k in range(4):
        own = np.flatnonzero(usable & (clouds.owner == k))
        cells = raster.cells(k)
        if not len(own):
            assert np.all(cells == -1)
            continue
        grid = np.stack(np.meshgrid(*(np.arange(s) for s in cells.shape), indexing="ij"), axis=-1)
        centres = raster.origin[k] + (grid + 0.5) * cell
        nearest, _ = cKDTree(clouds.points[own]).query(centres)
        filled = cells >= 0
        # A point stands for the centre of its cell: off by at most half the diagonal, for the point named and for the true one.
        slack = cell * np.sqrt(2) / 2
        assert np.all(filled[nearest < reach - slack])
        assert not np.any(filled[nearest > reach + slack])
        named_rows = clouds.offsets[k] + cells[filled]
        named = np.hypot(*(clouds.points[named_rows] - centres[filled]).T)
        assert np.all(named <= nearest[filled] + 2 * slack + 1e-9)
        assert np.isin(named_rows, own).all()
