"""Who reads what: every reader, and every verb that reads, with a whole input to damage."""

import contextlib
import io
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uwblite.cli import main
from uwblite.config import merge, parse_toml, to_toml
from uwblite.drivers.devices import DEVICES
from uwblite.errors import UwbliteError
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OccupancyGrid
from uwblite.io.carmen import read_log
from uwblite.io.carmen_live import LogTail
from uwblite.io.constraints_file import parse_constraints, read_anchors
from uwblite.io.csv_folder import read_csv_folder, write_csv_folder
from uwblite.io.csv_table import read_csv
from uwblite.io.formats import format_of, read_graph, read_recording
from uwblite.io.g2o import read_g2o
from uwblite.io.librsf import read_librsf
from uwblite.io.map_server import read_map, write_map
from uwblite.io.png import decode_png
from uwblite.io.pyfg import read_pyfg
from uwblite.io.tum import read_relations, read_tum
from uwblite.io.uwb_mapping import parse_mappings
from uwblite.mapping import MappingConfig
from uwblite.server.live import watch_status

from .small_files import ANCHORS, CORRECTED, G2O, ISAM, KNOWN, LIBRSF, LOG, MAPPING, OTHERS, PYFG, RELATIONS, TABLE, TORO, TUM
from .wires_and_pages import DEVICE_OPTIONS, RESULT, ask, listen, open_named, result_of, show, wire

Read = Callable[[Path], object]


@dataclass(frozen=True, slots=True)
class Case:
    """One reader and a whole input of its."""

    file: str
    """What is damaged, below the folder of the case."""
    read: Read
    """Reads the file; a UwbliteError is its good right."""
    prepare: Callable[[Path], object]
    """Makes the whole input in an empty folder."""
    cost: int = 1
    """How many times fewer inputs it gets, because each takes long."""


class Fault(Exception):
    """What must not happen; the text says what did."""


def _text(parse: Callable[[str, str], object]) -> Read:
    """Parse as the command line does: bytes that are no text never come so far."""
    return lambda path: parse(path.read_bytes().decode(errors="replace"), str(path))


def _settings(text: str, path: str) -> object:
    return merge(MappingConfig(), parse_toml(text, path))


def _log(readings: int = 40) -> bytes:
    """Return a recording of a path along a wall with three anchors, as large as it takes to be mapped."""
    rng, anchors = np.random.default_rng(1), (("91A3", 3.0, 6.0), ("5C0B", 3.0, 4.0), ("0D27", 6.0, -3.0))
    lines = [LOG.decode()]
    for k in range(readings):
        t, x, (name, *place) = 4.0 + 0.25 * k, 1.5 + 0.1 * k, anchors[k % 3]
        distance = np.hypot(x - place[0], 0.3 * np.sin(x) - place[1])
        lines.append(f"ODOM {x:.3f} {0.3 * np.sin(x):.3f} {0.3 * np.cos(x):.3f} 0.4 0 0 {t:.2f} h {t:.2f}\n")
        lines.append(f"UWB {name} {distance + rng.normal(0, 0.1):.2f} 90 {t:.2f} h {t:.2f}\n")
        if k % 2:
            rays = " ".join(f"{r:.3f}" for r in rng.uniform(1.0, 5.7, 12))
            pose = f"{x:.3f} 0 0 {x:.3f} 0 0 0 0 0 0 0 {t:.2f} h {t:.2f}"
            lines.append(f"ROBOTLASER1 2 -1.5 3.0 0.27 5.6 0.01 0 12 {rays} 0 {pose}\n")
    return "".join(lines).encode()


def _grid() -> OccupancyGrid:
    odds = np.where(np.random.default_rng(0).random((40, 60)) < 0.2, 4.0, -4.0).astype(np.float32)
    odds[:5] = 0.0
    return OccupancyGrid(GridGeometry(0.05, np.array([-1.0, -1.0]), 40, 60), odds)


def _map_folder(folder: Path) -> None:
    write_map(folder, _grid())
    write_map(folder, _grid(), name="map_scale", mode="scale")
    text = (folder / "map.yaml").read_text()
    (folder / "map_raw.yaml").write_text(text.replace("trinary", "raw").replace("free_thresh: 0.196", "free_thresh: 0.25"))
    (folder / "map_turned.yaml").write_text(text.replace(", 0]", ", 0.6]").replace("free_thresh: 0.196", "free_thresh: 0.25"))
    rows, cols = _grid().log_odds.shape
    pixels = (folder / "map.pgm").read_bytes()[-rows * cols :]
    grey = (b"%d%s" % (v, b" " if k % 20 else b"\n") for k, v in enumerate(pixels))
    (folder / "map_text.pgm").write_bytes(b"P2\n# drawn\n%d %d\n255\n" % (cols, rows) + b"".join(grey))
    (folder / "map_text.yaml").write_text(text.replace("map.pgm", "map_text.pgm"))
    for yaml in folder.glob("*.yaml"):
        yaml.write_text("# a map\n" + yaml.read_text() + "# width: 60, height: 40, drawn on Monday\n" * 8)
    (folder / "anchors.csv").write_bytes(ANCHORS)
    (folder / "trajectory.tum").write_bytes(TUM)


def _map_and_log(folder: Path) -> None:
    _map_folder(folder)
    (folder / "long.log").write_bytes(_log(80))


def _toro(poses: int) -> bytes:
    edges = (f"EDGE2 {k} {k + 1} 1 0.1 0.2 100 0 100 100 0 0" for k in range(1, poses))
    return TORO + "".join(f"{edge}\n" for edge in edges).encode()


def _followed(path: Path) -> object:
    """Follow a log to its end and return what the page would be sent."""
    tail = LogTail(str(path))
    while tail.poll():
        pass
    return json.dumps(watch_status(tail, None, 0.0, ""), allow_nan=False)


def _told(path: Path) -> object:
    """Read a file of any content as what it is told to be."""
    if format_of(str(path)) in ("g2o", "pyfg", "isam"):
        return read_graph(str(path))
    return read_recording(str(path))


def _file(name: str, data: bytes, read: Read, cost: int = 1) -> Case:
    return Case(name, read, lambda folder: (folder / name).write_bytes(data), cost)


def _verb(name: str, data: bytes, *words: str, cost: int = 20, prepare: Callable[[Path], object] | None = None) -> Case:
    """Return a verb of the command line; {} in its words is the folder of the case."""

    def made(folder: Path) -> None:
        if prepare is not None:
            prepare(folder)
        (folder / "good.log").write_bytes(_log())
        if data:
            (folder / name).write_bytes(data)

    def run(path: Path) -> None:
        before = {p.name for p in path.parent.iterdir()}
        out, stated = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(stated):
            code = main([word.format(path.parent) for word in words])
        made_here = {"out", *(f"out.{ending}" for ending in ("g2o", "pyfg", "log", "tum", "csv", "png"))}
        left = {p.name for p in path.parent.iterdir()} - before - made_here
        text = stated.getvalue()
        last = text.rstrip("\n").rpartition("\n")[2]
        for wrong, what in (
            (code not in (0, 1, 2, 3), f"exit code {code}"),
            ("internal error" in text or "Traceback" in text, last),
            ("out of memory" in text, last),
            # What became of each recording of a batch stands in its table.
            (code == 1 and not last.startswith("uwblite: error: ") and words[0] != "batch", f"exit code 1 and {last!r}"),
            (not (out.getvalue() + text).replace("\n", "").isprintable(), "what a terminal would obey"),
            (bool(left), f"files {left}"),
        ):
            if wrong:
                raise Fault(what)
        if code == 1:
            raise UwbliteError(last or "what became of each recording stands in the table")

    return Case(name, run, made, cost)


def _bags() -> Iterator[tuple[str, Case]]:
    """Yield a case for every kind of bag, where rosbags is there."""
    try:
        import rosbags.highlevel  # noqa: F401
    except ImportError:
        return
    from uwblite.io.rosbag import read_bag
    from uwblite.io.rosbag_writer import write_bag

    def whole(folder: Path, storage: str) -> None:
        (folder / "x.log").write_bytes(_log(10))
        write_bag(folder / "bag", read_log(folder / "x.log"), storage=storage)
        shutil.copy(next(p for p in (folder / "bag").iterdir() if p.name != "metadata.yaml"), folder / "bag" / "messages")

    def reader(storage: str) -> Read:
        def read(path: Path) -> object:
            bag = path.parent
            if path.name == "messages":
                shutil.copy(path, next(p for p in bag.iterdir() if p.suffix in (".mcap", ".db3")))
            return read_bag(bag)

        return read

    for storage in ("mcap", "sqlite3"):
        for part in ("messages", "metadata.yaml"):
            name = f"bag/{part}"
            yield f"{storage} {part}", Case(name, reader(storage), lambda folder, s=storage: whole(folder, s), 4)  # type: ignore[misc]
    yield "ros1 bag", Case("one.bag", lambda path: read_bag(path), _ros1, 4)

    def alone(folder: Path) -> None:
        whole(folder, "mcap")
        data = next((folder / "bag").glob("*.mcap")).read_bytes()
        (folder / "cut.mcap").write_bytes(data[: int(0.7 * len(data))])
        (folder / "bag" / "metadata.yaml").unlink()

    yield "mcap cut off", Case("cut.mcap", lambda path: read_bag(path), alone, 4)
    yield "parts without metadata", Case("bag/messages", reader("mcap"), alone, 4)
    yield "ros1 bag that is active", Case("run.bag.active", lambda path: read_bag(path), _active, 4)


def _active(folder: Path) -> None:
    """Make a bag whose header names no index, cut off in its last block."""
    _ros1(folder, "nav_msgs/msg/Odometry")
    data = bytearray((folder / "one.bag").read_bytes())
    place = data.index(b"index_pos=") + len(b"index_pos=")
    index = int.from_bytes(data[place : place + 8], "little")
    data[place : place + 8] = bytes(8)
    (folder / "run.bag.active").write_bytes(data[: index - 40])


def _ros1(folder: Path, kind: str = "sensor_msgs/msg/Range") -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store: Any = get_typestore(Stores.ROS1_NOETIC)
    t = store.types
    header = t["std_msgs/msg/Header"](seq=0, stamp=t["builtin_interfaces/msg/Time"](5, 0), frame_id="5C0B")
    message = t["sensor_msgs/msg/Range"](header, 0, 0.1, 0.1, 9.0, 3.0)
    if kind == "nav_msgs/msg/Odometry":
        point, turn, zero = t["geometry_msgs/msg/Point"], t["geometry_msgs/msg/Quaternion"], np.zeros(36)
        pose = t["geometry_msgs/msg/Pose"](point(1.0, 2.0, 0.0), turn(0.0, 0.0, 0.0, 1.0))
        still = t["geometry_msgs/msg/Twist"](*(t["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0) for _ in range(2)))
        with_covariance = [t[f"geometry_msgs/msg/{n}WithCovariance"](v, zero) for n, v in (("Pose", pose), ("Twist", still))]
        message = t[kind](header, "base_link", *with_covariance)
    with Writer(folder / "one.bag") as writer:
        topic = writer.add_connection("/uwb/a/distance", kind, typestore=store)
        for k in range(5):
            writer.write(topic, k * 10**9, store.serialize_ros1(message, kind))


def _tables(folder: Path) -> None:
    (folder / "x.log").write_bytes(_log(10))
    write_csv_folder(folder / "tables", read_log(folder / "x.log"))


def cases() -> dict[str, Case]:
    """Return every case by name."""
    found = {
        "carmen": _file("x.log", _log(20), read_log),
        "g2o": _file("x.g2o", G2O, read_g2o),
        "toro": _file("x.graph", _toro(12), read_g2o),
        "pyfg": _file("x.pyfg", PYFG, read_pyfg),
        "relations": _file("x.relations", RELATIONS * 4, read_relations),
        "tum": _file("x.tum", TUM * 4, read_tum),
        "csv table": _file("x.csv", TABLE * 6, read_csv),
        "anchors": _file("x.csv", ANCHORS + b"".join(b"A%d,%d,2.5,0.1,0.2,ok\n" % (k, k) for k in range(20)), read_anchors),
        "settings": _file("x.toml", to_toml(MappingConfig()).encode()[:2500].rpartition(b"\n")[0], _text(_settings)),
        "constraints": _file("x.toml", KNOWN * 3, _text(parse_constraints)),
        "mapping": _file("x.toml", MAPPING * 3, _text(parse_mappings)),
        "log tail": _file("x.log", _log(20), _followed),
        "librsf": _file("x.txt", LIBRSF, read_librsf),
        "corrected log": _file("x.log", CORRECTED, read_log),
        "graph with scans": _file("x.g2o", G2O + LOG[LOG.index(b"ROBOTLASER1") :], lambda path: read_recording(str(path))),
        "other programs": _file("x.log", OTHERS + LOG, lambda path: read_recording(str(path))),
        "told by content": _file("x.txt", LIBRSF + CORRECTED[:900] + ISAM + TORO, _told),
    }
    for name in ("odometry.csv", "ranges.csv", "scans.csv", "sensors.toml"):
        found[name] = Case(f"tables/{name}", lambda path: read_csv_folder(path.parent), _tables)
    for name in DEVICES:
        found[f"wire {name}"] = _file("x.bin", wire(name), listen(name))
    found["device options"] = _file("x.txt", DEVICE_OPTIONS, open_named)
    for name in RESULT:
        found[f"page of {name}"] = Case(name, show, result_of(_log()), 10)
    found["requests"] = Case("requests", ask, result_of(_log()), 20)
    for name in ("map.yaml", "map.pgm", "map_text.pgm", "map_scale.yaml", "map_scale.png"):
        found[name] = Case(name, lambda path: read_map(path.with_suffix(".yaml")), _map_folder)
    for name in ("map_raw.yaml", "map_turned.yaml"):
        found[name] = Case(name, read_map, _map_folder)
    found["png"] = Case("map_scale.png", lambda path: decode_png(path.read_bytes(), str(path)), _map_folder)
    found |= dict(_bags())
    log, shared = _log(), ("-q", "--force")
    found |= {
        "check": _verb("x.log", log, "check", "{}/x.log"),
        "check corrected log": _verb("x.log", CORRECTED, "check", "{}/x.log"),
        "map": _verb("x.log", log, "map", "{}/x.log", "--out", "{}/out", *shared, cost=100),
        "map of tables": _verb(
            "tables/odometry.csv", b"", "map", "{}/../tables", "--out", "{}/out", *shared, cost=100, prepare=_tables
        ),
        "convert": _verb("x.log", log, "convert", "{}/x.log", "{}/out.log", "-q", "--force", cost=5),
        "localize": _verb(
            "x.log",
            _log(80),
            "localize",
            "{}/x.log",
            "--map",
            "{}",
            "--out",
            "{}/out.tum",
            *shared,
            cost=100,
            prepare=_map_folder,
        ),
        **{
            f"localize in {name}": _verb(
                name,
                b"",
                "localize",
                "{}/long.log",
                "--map",
                "{}",
                "--out",
                "{}/out.tum",
                *shared,
                cost=100,
                prepare=_map_and_log,
            )
            for name in ("map.yaml", "map.pgm", "anchors.csv")
        },
        "batch": _verb("x.log", log, "batch", "{}/x.log", "--out", "{}/out", *shared, cost=200),
        "convert a result": _verb(
            "report.json", b"", "convert", "{}", "{}/out.tum", "--to", "tum", *shared, cost=20, prepare=result_of(log)
        ),
        "settings of map": _verb(
            "x.toml",
            to_toml(MappingConfig()).encode()[:2500].rpartition(b"\n")[0],
            "map",
            "{}/good.log",
            "--out",
            "{}/out",
            "--config",
            "{}/x.toml",
            *shared,
            cost=100,
        ),
        "plan": _verb(
            "map.pgm",
            b"",
            "plan",
            "--map",
            "{}/map.yaml",
            "--from",
            "0,-0.88",
            "--to",
            "1,-0.88",
            "--radius",
            "0",
            "--unknown",
            "price",
            "--out",
            "{}/out",
            *shared,
            cost=20,
            prepare=_map_folder,
        ),
        "optimize g2o": _verb("x.g2o", G2O, "optimize", "{}/x.g2o", "--out", "{}/out.pyfg", *shared, cost=10),
        "optimize toro": _verb("x.graph", TORO, "optimize", "{}/x.graph", "--out", "{}/out.g2o", *shared, cost=10),
        "optimize pyfg": _verb(
            "x.pyfg", PYFG, "optimize", "{}/x.pyfg", "--from-odometry", "--out", "{}/out.g2o", *shared, cost=10
        ),
        "evaluate relations": _verb(
            "x.relations", RELATIONS * 2, "evaluate", "{}", "--relations", "{}/x.relations", cost=5, prepare=_map_folder
        ),
        "evaluate": _verb("trajectory.tum", b"", "evaluate", "{}", "--truth", "{}/trajectory.tum", cost=5, prepare=_map_folder),
        "constraints of map": _verb(
            "x.toml", KNOWN, "map", "{}/good.log", "--out", "{}/out", "--constraints", "{}/x.toml", *shared, cost=100
        ),
    }
    return {name: replace(case) for name, case in found.items()}
