"""Maps as ROS map_server and nav2 exchange them: ``map.yaml`` beside ``map.pgm`` (or a PNG).

Image row 0 is the top, that is the largest y; ``origin`` is the pose of the lower left corner. A pixel x stands for
the probability p = (255 - x) / 255 of being occupied. On loading, p > occupied_thresh is occupied, p < free_thresh is free
and the rest unknown. The usual pixels 0, 254 and 205 give p = 1, 0.004 and 0.19608, so that by its rules a free_thresh above
0.196 makes everything unknown free.
"""

import os
import re
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from ..grid.geometry import GridGeometry
from ..grid.occupancy_grid import FREE, FREE_BELOW, LARGEST_CELL, LEAST_CELL, OCCUPIED, OCCUPIED_ABOVE, OccupancyGrid
from .files import write_bytes, write_text
from .png import MOST_PIXELS, SIGNATURE, decode_png, encode_png, png_shape
from .source import finite, opened, read_bounded

Image = NDArray[np.uint8]
Settings = dict[str, str | list[str]]

PIXEL_OCCUPIED, PIXEL_UNKNOWN, PIXEL_FREE = 0, 205, 254
_MOST_YAML_BYTES = 1 << 16
_MOST_OCCUPIED = 4_000_000
"""Occupied cells of a map that is read: walls of ten kilometres, drawn ten cells thick, have half as many."""
_READ_ODDS = 4.0
"""Log-odds given to occupied and free cells of a map that was read; three states carry no more."""


def write_map(
    folder: str | os.PathLike[str], grid: OccupancyGrid, *, name: str = "map", mode: str = "trinary"
) -> tuple[Path, Path]:
    """Write a map as an image and a YAML file beside it, and return their paths.

    Parameters
    ----------
    name : name of both files without ending.
    mode : 'trinary' writes a binary PGM of occupied, free and unknown; 'scale' a PNG of probabilities with unknown
        cells transparent.
    """
    image = Path(folder) / (f"{name}.png" if mode == "scale" else f"{name}.pgm")
    yaml = Path(folder) / f"{name}.yaml"
    write_bytes(image, encode_png(scale_image(grid)) if mode == "scale" else encode_pgm(trinary_image(grid)))
    x, y = grid.geometry.origin.tolist()
    write_text(
        yaml,
        f"image: {image.name}\nmode: {mode}\nresolution: {grid.geometry.resolution:.9g}\n"
        f"origin: [{x + 0.0:.9g}, {y + 0.0:.9g}, 0]\nnegate: 0\n"
        f"occupied_thresh: {OCCUPIED_ABOVE}\nfree_thresh: {FREE_BELOW}\n",
    )
    return image, yaml


def trinary_image(grid: OccupancyGrid) -> Image:
    """Return the map as pixels 0 (occupied), 254 (free) and 205 (unknown), largest y on top."""
    states = grid.states()[::-1]
    pixels = np.full(states.shape, PIXEL_UNKNOWN, dtype=np.uint8)
    pixels[states == OCCUPIED] = PIXEL_OCCUPIED
    pixels[states == FREE] = PIXEL_FREE
    return pixels


def scale_image(grid: OccupancyGrid) -> Image:
    """Return the map as grey = 1 - p and alpha (rows, cols, 2), unknown cells transparent, largest y on top."""
    grey = np.rint(255.0 * (1.0 - grid.probability()[::-1])).astype(np.uint8)
    alpha = np.where(grid.log_odds[::-1] != 0.0, 255, 0).astype(np.uint8)
    return np.stack([grey, alpha], axis=-1)


def encode_pgm(image: Image) -> bytes:
    """Return a grey image (height, width) as binary PGM."""
    height, width = image.shape
    return f"P5\n{width} {height}\n255\n".encode() + image.tobytes()


def read_map(path: str | os.PathLike[str], warnings: list[str] | None = None) -> OccupancyGrid:
    """Read a map from its YAML file and the image named there (PGM or PNG).

    Modes trinary (the default), scale and raw are read, by the rules of map_server, but for one: the grey of unknown cells,
    205, stays unknown where free_thresh would make it free, as in what nav2's map saver writes. A map whose origin is turned is
    sampled on a grid along the axes.

    Parameters
    ----------
    warnings : takes what was read otherwise than the file has it.

    Raises
    ------
    FormatError : a file is missing or is not what it should be.
    """
    name, remarks = os.fspath(path), [] if warnings is None else warnings
    settings = _parse_yaml(read_bounded(name, _MOST_YAML_BYTES).decode("utf-8-sig", errors="replace"), name)
    pixels = _read_picture(os.path.join(os.path.dirname(name), _text(settings, "image", name)))[::-1]
    origin, numbers = _origin(settings, name), ("resolution", "occupied_thresh", "free_thresh")
    resolution, occupied, free = (_number(_text(settings, key, name), key, name) for key in numbers)
    if not LEAST_CELL <= resolution <= LARGEST_CELL or len(origin) != 3 or max(map(abs, origin)) > 1e7:
        raise FormatError("resolution must be positive (0.0001 to 1000 m) and origin must be a place [x, y, yaw]", name)
    mode = str(settings.get("mode", "trinary"))
    if mode not in ("trinary", "scale", "raw"):
        raise FormatError(f"mode {mode} is not read; save the map as trinary, scale or raw", name)
    negate = str(settings.get("negate", "0")).lower() in ("1", "true")
    log_odds = _log_odds(pixels, negate, occupied, free, mode)
    if mode == "trinary" and not negate and (count := _keep_unknown(log_odds, pixels)):
        remarks.append(
            f"{count} cells have the grey of unknown ones ({PIXEL_UNKNOWN}), which free_thresh {free:g} would make free: they"
            " stay unknown (free_thresh: 0.196 says so to every program)"
        )
    if (walls := int(np.count_nonzero(log_odds > 0))) > _MOST_OCCUPIED:
        raise FormatError(f"{walls} of {log_odds.size} cells are occupied; is negate right in the YAML file?", name)
    grid = OccupancyGrid(GridGeometry(resolution, np.array(origin[:2]), *log_odds.shape), log_odds)
    # A turn that moves no cell to another's place is none: sums of angles leave 1e-9 where 0 was meant.
    yaw = float(np.angle(np.exp(1j * origin[2])))
    return grid if abs(yaw) * float(np.hypot(*log_odds.shape)) < 0.5 else _turned(grid, yaw, name)


def _origin(settings: Settings, name: str) -> list[float]:
    """Return the pose of the lower left corner; older map savers wrote a yaw that is no number."""
    value = settings.get("origin")
    if not isinstance(value, list):
        raise FormatError("origin must be a list of numbers", name)
    if len(value) == 3 and value[2].lower().lstrip("+-.") == "nan":
        raise FormatError(f"origin: the yaw is {value[2]}, as some map savers write it; set it to 0 in the YAML file", name)
    return [_number(item, "origin", name) for item in value]


def _keep_unknown(log_odds: NDArray[np.float32], pixels: Image) -> int:
    """Make cells of the grey of unknown ones unknown where the threshold makes them free; return how many there were."""
    grey = pixels[:, :, 0] == PIXEL_UNKNOWN
    for channel in range(1, 3 if pixels.shape[2] >= 3 else 1):
        grey &= pixels[:, :, channel] == PIXEL_UNKNOWN
    grey &= log_odds < 0.0
    log_odds[grey] = 0.0
    return int(np.count_nonzero(grey))


def _turned(grid: OccupancyGrid, yaw: float, name: str) -> OccupancyGrid:
    """Return a map, turned about its lower left corner by an angle, rad, on a grid along the axes: each cell takes the state of
    the one that its centre falls on."""
    from scipy import ndimage  # a tenth of a second, which few maps need

    g, turn = grid.geometry, np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    corners = (turn @ (g.resolution * np.array([[0, g.cols, 0, g.cols], [0, 0, g.rows, g.rows]], dtype=np.float64))).T
    low = g.resolution * np.floor(corners.min(axis=0) / g.resolution + 1e-6)
    cols, rows = np.ceil((corners.max(axis=0) - low) / g.resolution - 1e-6).astype(int).tolist()
    if rows * cols > MOST_PIXELS:
        raise FormatError("is too large to be turned as its origin says; turn the picture and set the yaw to 0", name)
    # Where a cell's centre was before the turn, in cells from the centre of the first: rows, columns.
    back = turn.T[::-1, ::-1]
    first = back @ (low[::-1] / g.resolution + 0.5) - 0.5 + 1e-6
    turned = ndimage.affine_transform(grid.log_odds, back, first, (rows, cols), order=0, mode="grid-constant")
    return OccupancyGrid(GridGeometry(g.resolution, g.origin + low, rows, cols), turned)


def _log_odds(pixels: Image, negate: bool, occupied: float, free: float, mode: str) -> NDArray[np.float32]:
    """Return the states of cells from their pixels (rows, cols, channels); transparent ones are unknown.

    In mode raw a pixel is a percentage, and above 100 unknown.
    """
    colours = 3 if pixels.shape[2] >= 3 else 1
    total = pixels[:, :, 0].astype(np.uint16)
    for channel in range(1, colours):
        total += pixels[:, :, channel]
    p = np.arange(255 * colours + 1) / (255.0 * colours)
    if mode == "raw":
        percent = np.rint(255.0 * p)
        p = np.where(percent <= 100.0, percent / 100.0, 0.5 * (occupied + free))
    else:
        p = p if negate else 1.0 - p
    log_odds = np.select([p > occupied, p < free], [_READ_ODDS, -_READ_ODDS], 0.0).astype(np.float32)[total]
    if pixels.shape[2] in (2, 4):
        log_odds[pixels[:, :, -1] == 0] = 0.0
    return log_odds


def _parse_yaml(text: str, path: str) -> Settings:
    """Read the flat YAML of a map: ``key: value``, lists in brackets or as ``- item`` lines, comments, quotes."""
    settings: Settings = {}
    key = ""
    for number, line in enumerate(text.splitlines(), 1):
        line = re.sub(r"(^|\s)#.*", "", line).rstrip()
        if not line or line in ("---", "...") or line.startswith("%"):
            continue
        if match := re.match(r"\s*-\s+(.*)", line):
            items = settings.get(key) or []
            if not key or isinstance(items, str):
                raise FormatError("a list item without a key", path, number)
            settings[key] = [*items, match[1].strip()]
            continue
        match = re.match(r"([A-Za-z_]+)\s*:(?:\s+(.*))?$", line)
        if not match:
            raise FormatError("is not 'key: value', as the lines of a map's YAML file are", path, number)
        key, value = match[1], (match[2] or "").strip()
        if value.startswith("["):
            settings[key] = [item.strip() for item in value.strip("[]").split(",")]
        else:
            settings[key] = value[1:-1] if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"" else value
    return settings


def _text(settings: Settings, key: str, path: str) -> str:
    value = settings.get(key)
    if not isinstance(value, str) or not value:
        raise FormatError(f"{key} is missing; needed are image, resolution, origin, occupied_thresh and free_thresh", path)
    return value


def _number(text: str, key: str, path: str) -> float:
    return finite(text, f"{key}: {text[:40]!r} is not a number", path)


def _read_picture(path: str) -> Image:
    """Return the pixels (height, width, channels) of a PGM or PNG; its header gives how much of the file is read at all."""
    with opened(path) as stream:
        start = stream.read(_HEADER_BYTES)
        if not start.startswith(SIGNATURE):
            return _decode_pgm(start, stream, path)[:, :, None]
        height, width, channels = png_shape(start, path)
        return decode_png(start + stream.read(height * (1 + width * channels) + _PNG_EXTRAS), path)


_HEADER_BYTES = 4096
"""A picture's header, comments included, is shorter."""
_PNG_EXTRAS = 1 << 20
"""Bytes that a PNG may take beside its pixels: texts, times, colour profiles."""


def _decode_pgm(start: bytes, rest: BinaryIO, path: str) -> Image:
    """Return the pixels of a PGM with values up to 255, binary (P5) or text (P2), from its beginning and the rest."""
    header = re.match(rb"(P[25])" + 3 * rb"(?:\s+(?:#[^\n]*\n\s*)*)(\d{1,9})" + rb"\s", start)
    if not header:
        raise FormatError("this is neither a PGM nor a PNG picture", path)
    width, height, highest = (int(header[i]) for i in (2, 3, 4))
    if not 0 < highest <= 255 or not 0 < width * height <= MOST_PIXELS:
        most = f"{MOST_PIXELS / 1e6:.0f} million pixels"
        raise FormatError(f"a PGM of {width} x {height} pixels with values up to {highest} is not read (at most {most})", path)
    start, count = start[header.end() :], width * height
    if header[1] == b"P2":
        text = start + rest.read(_TEXT_BYTES * count)
        plain = re.fullmatch(rb"[\d\s]*", text) is not None and text.strip() != b""
        values = np.fromstring(text, dtype=np.float32, sep=" ")[:count] if plain else np.zeros(0)
        if (text.strip() and not plain) or values.max(initial=0.0) > 255.0:
            raise FormatError("the PGM's pixels are damaged", path)
        pixels = values.astype(np.uint8)
    else:
        pixels = np.frombuffer(start + rest.read(max(count - len(start), 0)), dtype=np.uint8)[:count]
    if len(pixels) < count:
        raise FormatError("the PGM is cut off", path)
    pixels = pixels.reshape(height, width)
    if highest != 255:
        pixels = (np.minimum(np.arange(256), highest) * (255.0 / highest)).astype(np.uint8)[pixels]
    return pixels


_TEXT_BYTES = 5
"""Of a pixel in a text picture, with the blank or line end behind it."""
