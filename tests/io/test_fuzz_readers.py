"""Every reader on damaged files: an error of ours that names the file, or a value; never another exception.

The damage is drawn by hypothesis from whole files, so that it reaches the depths of each format and shrinks to its cause.
"""

import gzip
import sqlite3
from pathlib import Path

import pytest
from helpers.results import small_log, small_result
from helpers.small_files import G2O, KNOWN, LOG, MAPPING, PYFG, SETTINGS, TABLE, TORO, TUM
from hypothesis import example, given, settings
from hypothesis import strategies as st

from uwblite.config import merge, parse_toml
from uwblite.errors import UwbliteError
from uwblite.io.carmen import read_log
from uwblite.io.constraints_file import parse_constraints, read_anchors
from uwblite.io.csv_folder import read_csv_folder, write_csv_folder
from uwblite.io.csv_table import read_csv
from uwblite.io.g2o import read_g2o
from uwblite.io.map_server import read_map, write_map
from uwblite.io.png import decode_png
from uwblite.io.pyfg import read_pyfg
from uwblite.io.result_text import anchors_csv
from uwblite.io.tum import read_tum
from uwblite.io.uwb_mapping import parse_mappings
from uwblite.mapping import MappingConfig

pytestmark = pytest.mark.slow

EXAMPLES = 300
TOKENS = st.sampled_from(
    [b"nan", b"inf", b"-inf", b"1e308", b"1e400", b"-1", b"0", b"-0.0", b"9" * 30, b"../../x", b"<script>", b"", b"\0",
     b"\xff\xfe", b'"', b"'", b"[", b"]", b"=", b"{", b"}", b"#", b"\n", b"\r", b",", b",,", b" ", b"1_0", b"0x1p3",
     b"\xd9\xa3", b"true", b"[[a]]", b"\xe9", b"A" * 5000, b"ODOM", b"999999999"]
)  # fmt: skip
EDIT = st.one_of(
    st.tuples(st.just("byte"), st.floats(0, 1), st.integers(0, 255)),
    st.tuples(st.just("word"), st.floats(0, 1), TOKENS),
    st.tuples(st.just("insert"), st.floats(0, 1), TOKENS),
    st.tuples(st.just("cut"), st.floats(0, 1), st.floats(0, 1)),
    st.tuples(st.just("swap"), st.floats(0, 1), st.floats(0, 1)),
    st.tuples(st.just("double"), st.floats(0, 1), st.integers(1, 3)),
    st.tuples(st.just("end"), st.floats(0, 1), st.none()),
)


def damaged(whole, edits):
    """Return a file after the edits; places are shares of its length."""
    for kind, where, what in edits:
        at = int(where * (len(whole) - 1)) if len(whole) > 1 else 0
        if kind == "byte":
            whole = whole[:at] + bytes([what]) + whole[at + 1 :]
        elif kind in ("word", "insert"):
            start = max(whole.rfind(c, 0, at) for c in (b" ", b",", b"\n", b"=")) + 1
            ends = [e for c in (b" ", b",", b"\n") if (e := whole.find(c, start)) >= 0]
            end = min(ends, default=len(whole)) if kind == "word" else start
            whole = whole[:start] + what + whole[end:]
        elif kind == "cut":
            other = int(what * len(whole))
            whole = whole[: min(at, other)] + whole[max(at, other) :]
        elif kind == "end":
            whole = whole[:at]
        else:
            lines = whole.split(b"\n")
            k = min(int(where * len(lines)), len(lines) - 1)
            if kind == "double":
                lines[k:k] = [lines[k]] * what
            else:
                j = min(int(what * len(lines)), len(lines) - 1)
                lines[k], lines[j] = lines[j], lines[k]
            whole = b"\n".join(lines)
    return whole


def from_text(parse):
    """Parse as the command line does: bytes that are no text never come so far."""
    return lambda path: parse(path.read_bytes().decode(errors="replace"), str(path))


def settings_from(text, path):
    return merge(MappingConfig(), parse_toml(text, path))


TEXTS = {
    "carmen": (LOG, read_log), "g2o": (G2O, read_g2o), "toro": (TORO, read_g2o), "pyfg": (PYFG, read_pyfg),
    "tum": (TUM, read_tum), "csv": (TABLE, read_csv), "anchors": (anchors_csv(small_result()).encode(), read_anchors),
    "settings": (SETTINGS, from_text(settings_from)), "constraints": (KNOWN, from_text(parse_constraints)),
    "mapping": (MAPPING, from_text(parse_mappings)),
}  # fmt: skip


def no_worse_than_an_error(read, path):
    said = "none"
    try:
        read(path)
    except UwbliteError as error:
        said = str(error)
    assert 0 < len(said.strip()) < 2000


@pytest.mark.parametrize("kind", TEXTS)
@given(edits=st.lists(EDIT, min_size=1, max_size=6), packed=st.booleans())
@example(edits=[], packed=False)
@settings(max_examples=EXAMPLES)
def test_damaged_text(tmp_path_factory, kind, edits, packed):
    whole, read = TEXTS[kind]
    path = tmp_path_factory.getbasetemp() / f"fuzz.{kind}"
    data = damaged(whole, edits)
    path.write_bytes(gzip.compress(data, mtime=0) if packed and kind in ("carmen", "g2o", "pyfg", "tum", "csv") else data)
    no_worse_than_an_error(read, path)


@pytest.mark.parametrize("kind", ["carmen", "g2o", "pyfg", "tum", "csv"])
@given(edits=st.lists(EDIT, min_size=1, max_size=3))
@settings(max_examples=EXAMPLES // 3)
def test_damaged_gzip(tmp_path_factory, kind, edits):
    whole, read = TEXTS[kind]
    path = tmp_path_factory.getbasetemp() / f"fuzz.{kind}.gz"
    path.write_bytes(damaged(gzip.compress(whole * 20, mtime=0), edits))
    no_worse_than_an_error(read, path)


@pytest.mark.parametrize("file", ["odometry.csv", "ranges.csv", "scans.csv", "sensors.toml"])
@given(edits=st.lists(EDIT, min_size=1, max_size=5))
@settings(max_examples=EXAMPLES // 2)
def test_damaged_tables(tmp_path_factory, file, edits):
    folder = tmp_path_factory.getbasetemp() / "tables"
    whole = tmp_path_factory.getbasetemp() / "tables_whole"
    if not whole.exists():
        write_csv_folder(whole, small_log())
        write_csv_folder(folder, small_log())
    (folder / file).write_bytes(damaged((whole / file).read_bytes(), edits))
    try:
        no_worse_than_an_error(read_csv_folder, folder)
    finally:
        (folder / file).write_bytes((whole / file).read_bytes())


@pytest.mark.parametrize("file", ["map.yaml", "map.pgm", "map_scale.yaml", "map_scale.png"])
@given(edits=st.lists(EDIT, min_size=1, max_size=5))
@settings(max_examples=EXAMPLES // 2)
def test_damaged_maps(tmp_path_factory, file, edits):
    folder = tmp_path_factory.getbasetemp() / "map"
    if not folder.exists():
        folder.mkdir()
        write_map(folder, small_result().grid)
        write_map(folder, small_result().grid, name="map_scale", mode="scale")
    good = (folder / file).read_bytes()
    (folder / file).write_bytes(damaged(good, edits))
    try:
        no_worse_than_an_error(read_map, folder / f"{file.split('.')[0]}.yaml")
    finally:
        (folder / file).write_bytes(good)


@given(data=st.binary(max_size=200))
@settings(max_examples=EXAMPLES)
def test_pictures_of_any_bytes(data):
    no_worse_than_an_error(lambda path: decode_png(b"\x89PNG\r\n\x1a\n" + data, path), "x.png")


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """Small bags of every storage, whole."""
    pytest.importorskip("rosbags.highlevel", reason="rosbags is absent")
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    from uwblite.io.rosbag_writer import write_bag

    root = tmp_path_factory.mktemp("bags")
    for storage in ("mcap", "sqlite3"):
        write_bag(root / storage, small_log(), storage=storage)
    store = get_typestore(Stores.ROS1_NOETIC)
    t = store.types
    header = t["std_msgs/msg/Header"](seq=0, stamp=t["builtin_interfaces/msg/Time"](5, 0), frame_id="5C0B")
    message = t["sensor_msgs/msg/Range"](header, 0, 0.1, 0.1, 9.0, 3.0)
    (root / "ros1").mkdir()
    with Writer(root / "ros1" / "one.bag") as writer:
        radio = writer.add_connection("/uwb/a/distance", "sensor_msgs/msg/Range", typestore=store)
        for k in range(5):
            writer.write(radio, k * 10**9, store.serialize_ros1(message, "sensor_msgs/msg/Range"))
    return root


BAG_PARTS = [(s, part) for s in ("mcap", "sqlite3") for part in ("messages", "metadata.yaml")] + [("ros1", "one.bag")]


@pytest.mark.parametrize(("storage", "part"), BAG_PARTS)
def test_damaged_bags(bags, tmp_path_factory, storage, part):
    from uwblite.io.rosbag import read_bag

    whole = {p.name: p.read_bytes() for p in (bags / storage).iterdir()}
    name = part if part in whole else next(n for n in whole if n != "metadata.yaml")
    folder = tmp_path_factory.mktemp("bag")

    @given(edits=st.lists(EDIT, min_size=1, max_size=4))
    @settings(max_examples=EXAMPLES // 6)
    def run(edits):
        for file, data in whole.items():
            (folder / file).write_bytes(damaged(data, edits) if file == name else data)
        no_worse_than_an_error(read_bag, folder / "one.bag" if storage == "ros1" else folder)

    run()


def test_a_database_that_is_no_bag(tmp_path):
    from uwblite.io.rosbag import read_bag

    pytest.importorskip("rosbags.highlevel", reason="rosbags is absent")
    connection = sqlite3.connect(tmp_path / "x.db3")
    connection.execute("create table topics(id)")
    connection.commit()
    connection.close()
    no_worse_than_an_error(read_bag, tmp_path / "x.db3")
    assert sorted(p.name for p in Path(tmp_path).iterdir()) == ["x.db3"]
