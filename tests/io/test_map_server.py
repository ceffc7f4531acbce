import contextlib
import os
import struct
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from uwblite import se2
from uwblite.errors import FormatError
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from uwblite.io.map_server import read_map, write_map
from uwblite.io.png import decode_png, encode_png
from uwblite.io.tum import write_tum


def sample(rows=7, cols=11, seed=0, origin=(-12.345678, 3.05)):
    rng = np.random.default_rng(seed)
    log_odds = rng.choice([0.0, -5.0, -0.5, 0.3, 0.5, 6.0], (rows, cols)).astype(np.float32)
    return OccupancyGrid(GridGeometry(0.05, np.array(origin), rows, cols), log_odds)


def load_like_nav2(yaml_path):
    """The rules of nav2's map_io: required keys, thresholds with strict comparisons, row order, origin."""
    yaml = pytest.importorskip("yaml")
    doc = yaml.safe_load(yaml_path.read_text())
    image_file = yaml_path.parent / doc["image"]
    mode = doc.get("mode", "trinary")
    resolution, origin = float(doc["resolution"]), doc["origin"]
    occupied, free, negate = float(doc["occupied_thresh"]), float(doc["free_thresh"]), bool(doc["negate"])
    assert len(origin) == 3
    data = image_file.read_bytes()
    if data.startswith(b"P5"):
        magic, size, depth, pixels = data.split(b"\n", 3)
        assert (magic, depth) == (b"P5", b"255")
        width, height = map(int, size.split())
        image = np.frombuffer(pixels, np.uint8).reshape(height, width, 1)
    else:
        image = decode_png(data)
    height, width, channels = image.shape
    cells = np.empty((height, width), int)
    for y in range(height):
        for x in range(width):
            alpha = image[y, x, -1] if channels in (2, 4) else 255
            shade = image[y, x, 0] / 255.0
            p = shade if negate else 1.0 - shade
            if mode == "trinary":
                value = OCCUPIED if occupied < p else FREE if p < free else UNKNOWN
            elif mode == "scale":
                if alpha != 255:
                    value = UNKNOWN
                elif occupied < p:
                    value = OCCUPIED
                elif p < free:
                    value = FREE
                else:
                    value = round((p - free) / (occupied - free) * 100)
            cells[height - y - 1, x] = value
    return cells, resolution, origin


def test_nav2_reads_the_same_cells(tmp_path):
    grid = sample()
    image, yaml = write_map(tmp_path, grid)
    cells, resolution, origin = load_like_nav2(yaml)
    np.testing.assert_array_equal(cells, grid.states())
    assert resolution == 0.05
    assert origin == [-12.345678, 3.05, 0]
    assert image.name == "map.pgm"
    assert "free_thresh: 0.196\n" in yaml.read_text()
    assert set(np.unique(np.frombuffer(image.read_bytes()[-77:], np.uint8))) == {0, 205, 254}


def test_nav2_reads_probabilities_in_scale_mode(tmp_path):
    grid = sample()
    _, yaml = write_map(tmp_path, grid, mode="scale")
    cells, _, _ = load_like_nav2(yaml)
    p = grid.probability()
    expected = np.where(p > 0.65, 100, np.where(p < 0.196, 0, (p - 0.196) / (0.65 - 0.196) * 100))
    np.testing.assert_allclose(cells[grid.log_odds != 0], expected[grid.log_odds != 0], atol=1.0)
    assert (cells[grid.log_odds == 0] == UNKNOWN).all()


@pytest.mark.parametrize("mode", ["trinary", "scale"])
@pytest.mark.parametrize("seed", range(2))
def test_what_is_written_is_read(tmp_path, mode, seed):
    grid = sample(rows=1 + seed, seed=seed)
    _, yaml = write_map(tmp_path, grid, name="a", mode=mode)
    back = read_map(yaml)
    np.testing.assert_array_equal(back.states(), grid.states())
    np.testing.assert_allclose(back.geometry.origin, grid.geometry.origin, atol=1e-8)
    assert back.geometry.resolution == grid.geometry.resolution


def test_the_lower_left_corner_is_the_origin(tmp_path):
    log_odds = np.zeros((4, 6), np.float32)
    log_odds[0, 0] = 5.0
    _, yaml = write_map(tmp_path, OccupancyGrid(GridGeometry(0.5, np.array([10.0, 20.0]), 4, 6), log_odds))
    np.testing.assert_allclose(read_map(yaml).occupied_points(), [[10.25, 20.25]])


def test_maps_of_other_writers_are_read(tmp_path):
    (tmp_path / "m.pgm").write_bytes(b"P5\n# CREATOR: map_saver 0.05 m/pix\n2 2\n255\n" + bytes([0, 254, 205, 254]))
    (tmp_path / "m.yaml").write_text(
        'image: "m.pgm"  # a comment\nresolution: 0.050000\norigin:\n  - -1.5\n  - 2\n  - 0.0\n'
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n\n"
    )
    grid = read_map(tmp_path / "m.yaml")
    np.testing.assert_array_equal(grid.states(), [[UNKNOWN, FREE], [OCCUPIED, FREE]])
    np.testing.assert_allclose(grid.geometry.origin, [-1.5, 2.0])
    (tmp_path / "m.pgm").write_bytes(b"P2 2 2 100\n100 0\n0 100\n")
    np.testing.assert_array_equal(read_map(tmp_path / "m.yaml").states(), [[OCCUPIED, FREE], [FREE, OCCUPIED]])
    (tmp_path / "m.pgm").write_bytes(encode_png(np.array([[[0, 0, 0, 255], [0, 0, 0, 0]]], np.uint8)))
    np.testing.assert_array_equal(read_map(tmp_path / "m.yaml").states(), [[OCCUPIED, UNKNOWN]])


def foreign(tmp_path, pixels, start="", **changes):
    """Write a map of pixels (rows, cols), and return it as it is read, with the warnings."""
    (tmp_path / "m.pgm").write_bytes(b"P5 %d %d 255\n" % pixels.shape[::-1] + pixels.astype(np.uint8).tobytes())
    settings = GOOD | {"image": "m.pgm"} | changes
    (tmp_path / "m.yaml").write_text(start + "".join(f"{key}: {value}\n" for key, value in settings.items()))
    warnings = []
    return read_map(tmp_path / "m.yaml", warnings), warnings


PIXELS = np.array([[0, 254, 205, 255], [205, 0, 254, 100], [254, 254, 254, 0]])


def test_the_grey_of_unknown_cells_stays_unknown(tmp_path):
    """nav2's map saver writes free_thresh 0.25, by which its own unknown cells would be free."""
    usual, silent = foreign(tmp_path, PIXELS)
    nav2, said = foreign(tmp_path, PIXELS, free_thresh="0.25")
    np.testing.assert_array_equal(nav2.states(), usual.states())
    assert silent == []
    assert len(said) == 1
    assert said[0].startswith("2 cells have the grey of unknown ones (205), which free_thresh 0.25 would make free")
    scale, said = foreign(tmp_path, PIXELS, free_thresh="0.25", mode="scale")
    assert np.count_nonzero(scale.states() == FREE) == np.count_nonzero(usual.states() == FREE) + 2
    assert said == []


def test_raw_pixels_are_percentages(tmp_path):
    grid, said = foreign(tmp_path, np.array([[0, 100, 255], [19, 50, 66]]), mode="raw")
    np.testing.assert_array_equal(grid.states(), [[FREE, UNKNOWN, OCCUPIED], [FREE, OCCUPIED, UNKNOWN]])
    assert said == []


@pytest.mark.parametrize("yaw", ["1e-9", "-1e-9", "6.283185307", "0.0"])
def test_a_yaw_that_moves_no_cell_is_none(tmp_path, yaw):
    grid, _ = foreign(tmp_path, PIXELS, origin=f"[1, 2, {yaw}]")
    np.testing.assert_array_equal(grid.log_odds, foreign(tmp_path, PIXELS, origin="[1, 2, 0]")[0].log_odds)
    np.testing.assert_array_equal(grid.geometry.origin, [1.0, 2.0])


def test_a_byte_order_mark_is_skipped(tmp_path):
    assert foreign(tmp_path, PIXELS, "\ufeff")[0].states().shape == (3, 4)


@pytest.mark.parametrize("quarters", [1, 2, 3, -1])
def test_a_map_turned_by_quarters_keeps_every_cell(tmp_path, quarters):
    plain = foreign(tmp_path, PIXELS, origin="[0, 0, 0]")[0]
    grid, _ = foreign(tmp_path, PIXELS, origin=f"[1, 2, {quarters * np.pi / 2}]")
    np.testing.assert_array_equal(grid.log_odds, np.rot90(plain.log_odds, -quarters))
    turn = se2.compose(np.array([1.0, 2.0, quarters * np.pi / 2]), np.zeros(3))
    expected = se2.transform(turn, plain.occupied_points())
    assert {tuple(p) for p in np.round(grid.occupied_points(), 6)} == {tuple(p) for p in np.round(expected, 6)}


@pytest.mark.parametrize("yaw", [0.3, -1.2, 2.5])
def test_a_turned_map_has_its_walls_where_its_origin_says(tmp_path, yaw):
    """Every occupied cell lies within a cell of one of the picture's, and the other way round; walls have no gap."""
    pixels = np.full((40, 60), 254)
    pixels[0, :] = pixels[-1, :] = pixels[:, 0] = pixels[:, -1] = 0
    plain = foreign(tmp_path, pixels, origin="[0, 0, 0]")[0]
    grid, _ = foreign(tmp_path, pixels, origin=f"[-3, 1, {yaw}]")
    expected = se2.transform(np.array([-3.0, 1.0, yaw]), plain.occupied_points())
    apart = np.hypot(*(grid.occupied_points()[:, None] - expected[None]).transpose(2, 0, 1))
    assert apart.min(axis=0).max() < 0.05
    assert apart.min(axis=1).max() < 0.05
    outside = ndimage.label(grid.states() != OCCUPIED)[0]
    middle = grid.geometry.cell_of(se2.transform(np.array([-3.0, 1.0, yaw]), np.array([1.5, 1.0])))
    assert outside[middle] not in {outside[row, col] for row, col in [(0, 0), (-1, -1), (0, -1), (-1, 0)]}


GOOD = {"image": "map.pgm", "resolution": "0.05", "origin": "[0, 0, 0]", "occupied_thresh": "0.65", "free_thresh": "0.196"}


@pytest.mark.parametrize(
    ("change", "outputs"),
    [
        ({"image": ""}, "image is missing"),
        ({"image": "none.pgm"}, "cannot be opened"),
        ({"image": "."}, "cannot be opened"),
        ({"resolution": "x"}, "resolution: 'x' is not a number"),
        ({"resolution": "0"}, "positive"),
        ({"origin": "[0, 0]"}, "origin"),
        ({"origin": "3"}, "origin must be a list"),
        ({"origin": "[0, 0, -nan]"}, "the yaw is -nan, as some map savers write it; set it to 0"),
        ({"origin": "[0, nan, 0]"}, "origin: 'nan' is not a number"),
        ({"free_thresh": "nan"}, "free_thresh"),
        ({"mode": "grey"}, "mode grey is not read; save the map as trinary, scale or raw"),
        ({"? strange": ""}, "not 'key: value'"),
    ],
)
def test_wrong_maps_are_named(tmp_path, change, outputs):
    write_map(tmp_path, sample())
    text = "".join(f"{key}: {value}\n" for key, value in (GOOD | change).items())
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(FormatError, match=outputs):
        read_map(tmp_path / "bad.yaml")


@given(st.binary(max_size=80), st.text("imageresoluton: []-0123\n#'", max_size=80))
def test_anything_else_is_a_format_error(tmp_path_factory, image, extra):
    folder = tmp_path_factory.mktemp("map")
    (folder / "map.pgm").write_bytes(image)
    (folder / "map.yaml").write_text("".join(f"{key}: {value}\n" for key, value in GOOD.items()) + extra)
    with pytest.raises(FormatError):
        read_map(folder / "map.yaml")
    (folder / "map.pgm").write_bytes(b"P5 2 2 255\n" + image)
    with contextlib.suppress(FormatError):
        read_map(folder / "map.yaml")


def mapped(folder, image):
    folder.mkdir(exist_ok=True)
    (folder / "map.yaml").write_text("".join(f"{key}: {value}\n" for key, value in (GOOD | {"image": "map.pgm"}).items()))
    if image is not None:
        (folder / "map.pgm").write_bytes(image)
    return folder / "map.yaml"


def test_the_header_of_a_picture_bounds_what_is_read(tmp_path):
    """A quarter of a gigabyte of nothing, by its header and by its length, in pixels and as text: none is looked at."""
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", 16000, 16000, 8, 0, 0, 0, 0)
    tracemalloc.start()
    for header in (b"P5\n16384 16384\n255\n", b"P2\n16384 16384\n255\n", png):
        yaml = mapped(tmp_path / "map", header)
        os.truncate(tmp_path / "map" / "map.pgm", 1 << 28)
        with pytest.raises(FormatError, match=r"is not read \(at most"):
            read_map(yaml)
    yaml = mapped(tmp_path / "map", b"P5\n100 100\n255\n" + bytes([254]) * 10_000)
    os.truncate(tmp_path / "map" / "map.pgm", 1 << 28)
    assert read_map(yaml).geometry.cells == 10_000
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


def test_a_text_picture_is_that_of_its_bytes(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (30, 20))
    text = b"P2\n# a comment\n20 30\n255\n" + "\n".join(" ".join(map(str, row)) for row in pixels.tolist()).encode()
    grid = read_map(mapped(tmp_path / "map", text))
    binary = read_map(mapped(tmp_path / "map", b"P5 20 30 255\n" + pixels.astype(np.uint8).tobytes()))
    np.testing.assert_array_equal(grid.log_odds, binary.log_odds)
    for damaged in (text[:-40], text[:100] + b" x " + text[100:], text[:-3] + b" 999"):
        with pytest.raises(FormatError, match=r"cut off|damaged"):
            read_map(mapped(tmp_path / "map", damaged))


def test_a_map_of_nothing_but_walls_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("uwblite.io.map_server._MOST_OCCUPIED", 50)
    with pytest.raises(FormatError, match="64 of 64 cells are occupied; is negate right"):
        read_map(mapped(tmp_path / "map", b"P5 8 8 255\n" + bytes(64)))


@pytest.mark.parametrize("name", ["map.yaml", "map.pgm"])
def test_a_pipe_that_nobody_fills_is_an_error(tmp_path, monkeypatch, name):
    monkeypatch.setattr("uwblite.io.source._PIPE_PATIENCE", 0.1)
    yaml = mapped(tmp_path / "map", None)
    (tmp_path / "map" / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / "map" / name)
    with pytest.raises(FormatError, match="is a pipe, and nobody wrote into it"):
        read_map(yaml)


@pytest.mark.slow
def test_evo_draws_a_path_on_the_map(tmp_path):
    pytest.importorskip("evo")
    _, yaml = write_map(tmp_path, sample(60, 80))
    poses = np.linspace([-12.0, 4.0, 0.0], [-9.0, 5.0, 0.0], 5)
    write_tum(tmp_path / "a.tum", np.arange(5.0), poses)
    command = ["evo_traj", "tum", "a.tum", "--ros_map_yaml", yaml.name, "--plot_mode", "xy", "--save_plot", "plot.png"]
    environment = os.environ | {"HOME": str(tmp_path), "MPLBACKEND": "Agg"}
    program = Path(sys.executable).with_name(command[0])
    result = subprocess.run([program, *command[1:]], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert list(tmp_path.glob("plot*.png"))


USUAL = "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
GREYS = np.array([[0, 254, 205, 255], [205, 0, 254, 128], [40, 230, 254, 0]], dtype=np.uint8)
"""Besides the three usual greys those of cartographer: 128 is unknown, others are shades of a probability."""


def binary(head, pixels):
    return b"P5\n" + head + b"%d %d\n255\n" % pixels.shape[::-1] + pixels.tobytes()


def text_of_gimp(pixels):
    """One number a line, as GIMP exports a picture as ASCII."""
    numbers = b"".join(b"%d\n" % v for v in pixels.ravel().tolist())
    return b"P2\n# Created by GIMP version 2.10.34 PNM plug-in\n%d %d\n255\n" % pixels.shape[::-1] + numbers


def transparent(pixels):
    """What was unknown is made transparent; colours under it mean nothing."""
    alpha = np.where(pixels == 205, 0, 255).astype(np.uint8)
    shown = np.where(pixels == 205, 0, pixels)
    return encode_png(np.stack([shown, shown, shown, alpha], axis=-1))


WRITERS = {
    "nav2": ("m.pgm", lambda g: binary(b"", g), "mode: trinary\n" + USUAL.replace("0.196", "0.25")),
    "map_server": ("m.pgm", lambda g: binary(b"# CREATOR: map_saver.cpp 0.050 m/pix\n", g), USUAL + "\n"),
    "slam_toolbox": ("m.pgm", lambda g: binary(b"", g), "mode: trinary\n" + USUAL.replace("0.196", "0.25")),
    "cartographer": ("m.pgm", lambda g: binary(b"# Cartographer map; 0.050000 m/pixel\n", g), USUAL),
    "hector": ("m.pgm", lambda g: binary(b"# CREATOR: Map_generator.cpp 0.050 m/pix\n", g), USUAL),
    "GIMP": ("m.pgm", lambda g: binary(b"# Created by GIMP version 2.10.34 PNM plug-in\n", g), USUAL),
    "GIMP, as text": ("m.pgm", text_of_gimp, USUAL),
    "GIMP, with alpha": ("m.png", transparent, USUAL),
}
"""Name and content of the picture, and end of the YAML file, in the form of each program."""


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_maps_of_each_program_have_their_three_states(tmp_path, writer, ends):
    name, picture, settings = WRITERS[writer]
    (tmp_path / name).write_bytes(picture(GREYS))
    text = f"image: {name}\nresolution: 0.050000\norigin: [-1.000000, -2.000000, 0.000000]\n{settings}"
    (tmp_path / "m.yaml").write_bytes(text.replace("\n", ends).encode())
    occupied, unknown = GREYS < 0.35 * 255, (GREYS == 205) | (GREYS == 128)
    expected = np.where(occupied, OCCUPIED, np.where(unknown, UNKNOWN, FREE))
    grid = read_map(tmp_path / "m.yaml")
    np.testing.assert_array_equal(grid.states(), expected[::-1])
    np.testing.assert_allclose(grid.geometry.origin, [-1.0, -2.0])
