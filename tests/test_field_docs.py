"""Help shows what stands under the fields of a dataclass, and costs nothing before it is read."""

import inspect
import pydoc
import subprocess
import sys
from dataclasses import dataclass, fields, replace

import pytest

import uwblite
from uwblite.field_docs import documented, field_docs
from uwblite.graph.graph import Graph
from uwblite.graph.range_edges import RangeEdges
from uwblite.lidar.point_to_point import Registration
from uwblite.localization import LocalizerState
from uwblite.map_result import AnchorEstimate, MapResult
from uwblite.sensor_log import LaserScans, Odometry, SensorLog, SensorMounting, UwbRanges

CLASSES = [SensorLog, Odometry, UwbRanges, LaserScans, SensorMounting, MapResult, AnchorEstimate, Graph, RangeEdges,
           Registration, LocalizerState, uwblite.MappingConfig]  # fmt: skip


@pytest.mark.parametrize("cls", CLASSES, ids=lambda c: c.__name__)
def test_the_docstring_lists_every_field_with_its_line(cls):
    text = inspect.getdoc(cls)
    below = text.split("Attributes\n----------\n")[1]
    assert [line.split(" : ")[0] for line in below.splitlines()] == [f.name for f in fields(cls)]
    for name, line in field_docs(cls).items():
        if line and name in {f.name for f in fields(cls)}:
            assert f"{name} : {line}" in below


def test_help_of_the_package_states_shapes_and_units():
    text = pydoc.render_doc(uwblite, renderer=pydoc.plaintext)
    assert "trajectory : (n, 3) T_map_base at the stamps." in text
    assert "keyframe_stamps : (k,) s." in text


def test_a_class_whose_source_is_not_at_hand_keeps_its_docstring():
    space = {"dataclass": dataclass, "documented": documented, "__name__": "elsewhere"}
    sys.modules["elsewhere"] = type(sys)("elsewhere")
    exec('@documented\n@dataclass(frozen=True, slots=True)\nclass Point:\n    """A point."""\n    x: float', space)
    point = space["Point"](1.0)
    assert space["Point"].__doc__ == "A point."
    assert replace(point, x=2.0).x == 2.0
    del sys.modules["elsewhere"]


def test_nobody_reads_sources_while_importing():
    code = (
        "import inspect, sys\n"
        "def refuse(*_): raise AssertionError('a source was read')\n"
        "inspect.getsource = refuse\n"
        "import uwblite.graph.range_edges, uwblite.sensor_log, uwblite.map_result\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
