"""The HTML report: all that belongs in it, nothing that does not, and a real browser that opens it."""

import re
import shutil
import struct
import subprocess
import zlib
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from helpers.results import EVIL, small_result

from uwblite.graph.graph import UnknownKey
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OccupancyGrid
from uwblite.map_result import OUTCOMES, CalibrationEstimate
from uwblite.report.drawn_map import DrawnAnchor, DrawnMap, drawn_map, free_sides
from uwblite.report.html import Heading, render

FRAME = np.array([[-10.0, -10.0], [10.0, 10.0]])
"""Corners of a map, m."""
VOID = {"meta", "link", "input", "br", "img"}


class Page(HTMLParser):
    """Checks that elements close in order and gathers what is asked about."""

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.words, self.tags, self.links = [], set(), [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.ids |= {value for name, value in attrs if name == "id"}
        self.links += [value for name, value in attrs if name in ("href", "src", "action")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def png():
    rows = b"".join(b"\0" + bytes([205]) * 100 for _ in range(80))

    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", 100, 80, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def page(**options):
    return render(small_result(**options), Heading("run.log", "uwblite map run.log --out map/"), png())


def test_everything_that_belongs_in_it_is_there():
    text = page()
    words = " ".join(Page(text).words)
    for wanted in (
        "uwblite map run.log --out map/", "5C0B", "+0.460", "mirror-ambiguous", "overlap too small",
        "1 of 3 candidates accepted",
        "odometry_scale", "\u22121.20 \u00b10.20 %", "the robot hardly turns", "anchor 91A3 may be mirrored",
    ):  # fmt: skip
        assert wanted in words, wanted
    assert {"map", "anchors", "calibration", "loop-closures", "range-residuals", "warnings"} <= Page(text).ids
    assert text.count("<ellipse") == 2
    assert 'class="mirror"' in text


def test_verdict_and_map_come_first_and_how_it_was_made_last():
    text = render(small_result(), Heading("run.log", "uwblite map", "4 min 00 s", (("sha256", "ab" * 32),)))
    parts = ("<h1>", 'id="warnings"', "4 min 00 s", "<svg", 'id="anchors"', "abababab", "uwblite map<")
    places = [text.index(part) for part in parts]
    assert places == sorted(places)


def test_every_cell_of_a_wide_table_names_its_column():
    """On a phone a row is a block, and the head of the table is gone."""
    wide = re.findall(r'<table class="cards">(.*?)</table>', page(), re.S)
    assert len(wide) >= 3
    for table in wide:
        head, cells = re.findall(r"<th>([^<]*)</th>", table), re.findall(r'<td[^>]*data-name="([^"]*)"', table)
        assert cells == head * (len(cells) // len(head))
        assert len(cells) == table.count("<td")


def test_a_squared_height_is_shown_as_a_height():
    squared = CalibrationEstimate(UnknownKey("height2", "5C0B"), 0.09, 0.08, "m2", "squared height", "estimated")
    text = render(replace(small_result(), calibration=(squared,)), Heading("a", "b"))
    assert "height of anchor 5C0B above or below the tag</td>" in text
    assert ">0.30 m, below 0.50 m</td>" in text


def test_marked_ranges_are_those_that_disagree():
    result = small_result()
    text = page()
    for index in (0, 1):
        mine = result.range_table["anchor"] == index
        share = 100 * np.mean(result.range_table["agrees"][mine] == 0)
        assert f"{share:.0f} % marked" in text
    drawn = sum(figure.count("M") for figure in re.findall(r'class="(?:los|nlos)" d="([^"]*)"', text))
    assert drawn == len(result.range_table["stamp"])
    joint = page(each=2)
    assert "<span>last recording</span>" in joint
    xs = [float(x) for x in re.findall(r"M([\d.]+) [\d.]+h0", joint)]
    assert (min(xs), max(xs)) == (0.0, 1000.0)


def test_rejected_closures_are_counted_by_outcome():
    result = small_result()
    more = [replace(result.closures[1], reason=f"only {k}% of its points match (least 40%)") for k in (3, 12, 37)]
    text = render(replace(result, closures=(*result.closures, *more)), Heading("a", "b"))
    assert re.search(f">{OUTCOMES['few-matches']}</td><td[^>]*>5</td>", text)
    assert "only 12% of its points" in text


def test_nothing_comes_from_elsewhere():
    for link in Page(page()).links:
        assert link.startswith("data:"), link
    assert "default-src 'none'" in page()


def test_text_of_a_log_stays_text():
    evil = page(evil=EVIL)
    assert EVIL not in evil
    assert Page(evil).tags.count("script") == Page(page()).tags.count("script") == 1
    titled = render(small_result(), Heading(EVIL, EVIL, facts=((EVIL, EVIL),)))
    assert Page(titled).tags.count("script") == 1


def test_same_result_same_bytes_however_long_it_took():
    assert page(seconds=1.0) == page(seconds=2.0)


def test_works_without_lidar_and_without_radio():
    bare = replace(small_result(lidar=False), anchors=(), range_table={}, closures=(), calibration=(), findings=())
    text = render(bare, Heading("a", "b"))
    assert "No warnings." in text
    assert "<image" not in text


def side_of(place, walls=()):
    """Return where the name 5C0B stands beside a place of a map of 20 x 20 m with walls at points."""
    geometry = GridGeometry(0.1, FRAME[0], 200, 200)
    log_odds = np.full((200, 200), -4.0, dtype=np.float32)
    log_odds[geometry.cell_of(np.array(walls, dtype=float).reshape(-1, 2))] = 4.0
    drawn = DrawnMap(OccupancyGrid(geometry, log_odds, 1), anchors=[DrawnAnchor("5C0B", np.array(place))])
    return free_sides(drawn, FRAME, (14.0 / 360.0,))[0]


@pytest.mark.parametrize(("walls", "free"), [("", "right"), ("r", "left"), ("rl", "below"), ("rlb", "above"), ("lba", "right")])
def test_the_name_of_an_anchor_stands_where_no_wall_is(walls, free):
    """As on a phone, 18 pixels a metre."""
    middles = {"r": (1.5, 0.0), "l": (-1.5, 0.0), "b": (0.0, -0.8), "a": (0.0, 1.0)}
    assert side_of((0.0, 0.0), [middles[side] for side in walls]) == free


def test_a_name_leaves_the_map_on_no_side():
    assert side_of((9.8, 0.0)) == "left"
    assert side_of((np.nan, np.nan)) == "right"
    assert free_sides(DrawnMap(None, anchors=[DrawnAnchor("5C0B", np.zeros(2))]), FRAME, (0.03, 0.01)) == ["right"]


def test_an_unplaced_anchor_is_listed_and_not_drawn():
    result = small_result()
    lost = replace(
        result.anchors[0], id="lost", position=np.full(2, np.nan), covariance=np.full((2, 2), np.nan), status="unplaced"
    )
    text = render(replace(result, anchors=(*result.anchors, lost)), Heading("a", "b"))
    assert "unplaced" in text
    assert "nan" not in text
    assert text.count("<ellipse") == 2


def test_the_ellipse_has_two_sigma_along_the_right_axis():
    ellipse = re.findall(r'<ellipse [^>]*rx="([\d.]+)" ry="([\d.]+)" transform="[^"]*rotate\(([-\d.]+)', page())
    first, second = ([float(v) for v in e] for e in ellipse)
    assert first[:2] == [0.08, 0.04]
    assert abs(first[2]) % 180 == 0
    # Positive correlation: the long axis points to the upper right, which SVG's y downwards calls -45 degrees.
    assert second[2] % 180 == pytest.approx(135)
    assert second[:2] == pytest.approx([2 * np.sqrt(0.014), 2 * np.sqrt(0.006)], abs=1e-4)


CHROMIUM = next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--enable-logging=stderr", "--v=0", "--virtual-time-budget=3000"),
)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is absent")
@pytest.mark.parametrize("size", ["1200,900", "390,844"])
def test_chromium_shows_it_without_complaint(tmp_path, size):
    file, picture = tmp_path / "report.html", tmp_path / "shot.png"
    file.write_text(page(evil=EVIL))
    base = [CHROMIUM, *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={size}"]
    shown = subprocess.run([*base, "--dump-dom", file.as_uri()], capture_output=True, text=True, timeout=120, check=False)
    assert 'class="map"' in shown.stdout
    assert "</svg>" in shown.stdout
    assert "CONSOLE" not in shown.stderr, shown.stderr
    subprocess.run([*base, f"--screenshot={picture}", file.as_uri()], capture_output=True, timeout=120, check=True)
    width, height = struct.unpack(">II", picture.read_bytes()[16:24])
    assert (width, height) == tuple(map(int, size.split(",")))


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is absent")
def test_the_script_zooms_and_toggles(tmp_path):
    """The page's own controls are pressed by a script put in for the test; it writes what happened into the title."""
    probe = """<script>
      var svg = document.querySelector('.map'), before = svg.getAttribute('viewBox');
      document.getElementById('zoom-in').click();
      var zoomed = svg.viewBox.baseVal.width, whole = parseFloat(before.split(' ')[2]);
      document.getElementById('zoom-all').click();
      var back = svg.viewBox.baseVal.width;
      var box = document.querySelector('[data-layer=rejected]'), layer = document.querySelector('.rejected');
      var hidden = layer.classList.contains('hidden');
      box.click();
      var at = svg.getBoundingClientRect();
      svg.dispatchEvent(new PointerEvent('pointermove', {clientX: at.x + at.width / 2, clientY: at.y + at.height / 2}));
      var said = document.getElementById('place').textContent;
      document.title = [/^x -?[0-9.]+ m, y -?[0-9.]+ m$/.test(said),
        Math.abs(zoomed * 1.5 - whole) < 1e-3, Math.abs(back - whole) < 1e-3,
        hidden, !layer.classList.contains('hidden')].join();
    </script></body>"""
    file = tmp_path / "report.html"
    file.write_text(page().replace("</body>", probe))
    base = [CHROMIUM, *FLAGS, f"--user-data-dir={tmp_path / 'profile'}"]
    shown = subprocess.run([*base, "--dump-dom", file.as_uri()], capture_output=True, text=True, timeout=120, check=False)
    assert "<title>true,true,true,true,true</title>" in shown.stdout


def test_kept_and_rejected_closures_are_distinguished():
    groups = dict(re.findall(r'<g class="closure (kept|rejected)(?: hidden)?">(.*?)</g>', page(), re.S))
    assert groups["kept"].count("<polyline") == 1
    assert "consistent with the others" in groups["kept"]
    assert groups["rejected"].count("<polyline") == 2


def test_the_name_of_an_anchor_at_the_edge_has_room():
    result = small_result()
    far = replace(result.anchors[0], position=np.array([60.0, 0.0]))
    text = render(replace(result, anchors=(far,)), Heading("run.log", "uwblite"))
    x, _, width, _ = map(float, re.search(r'class="map" viewBox="([^"]*)"', text)[1].split())
    assert x + width > 60.0 + 0.1 * width


def test_every_recording_has_a_path_of_its_own():
    result = small_result()
    second = np.arange(len(result.stamps)) % 3 == 0
    drawn = drawn_map(replace(result, recording=np.where(second, 1, 0)))
    for path, own in zip(drawn.paths, (~second, second), strict=True):
        np.testing.assert_array_equal(path, result.trajectory[own, :2])
