"""Settings: round trips, strictness, names nearly right, documentation of fields."""

import dataclasses
import inspect
import math
import pydoc
import re
import subprocess
import sys
from dataclasses import dataclass, fields, replace

import pytest
from helpers.example_settings import Outer

import uwblite
from uwblite.config import documented, field_docs, from_dict, leaves, merge, override, parse_toml, setting, to_dict, toml_value
from uwblite.errors import ConfigError
from uwblite.graph.graph import Graph
from uwblite.graph.range_edges import RangeEdges
from uwblite.lidar.point_to_point import Registration
from uwblite.localization import LocalizerState
from uwblite.map_result import AnchorEstimate, MapResult
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.sensor_log import LaserScans, Odometry, SensorLog, SensorMounting, UwbRanges


def test_defaults_survive_dict():
    assert from_dict(Outer, to_dict(Outer())) == Outer()
    assert from_dict(Outer, {}) == Outer()


def test_values_are_converted_to_the_type_of_the_field():
    config = from_dict(Outer, {"icp": {"distance": 1, "pose": [1, 2, 3]}})
    assert repr(config.icp.distance) == "1.0"
    assert config.icp.pose == (1.0, 2.0, 3.0)
    assert from_dict(Outer, {"icp": {"optional": "none"}}).icp.optional is None


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"icp": {"max_iteration": 3}}, "did you mean 'icp.max_iterations'"),
        ({"icpp": {}}, "did you mean 'icp'"),
        ({"max_iterations": 3}, "did you mean 'icp.max_iterations'"),
        ({"icp": {"zzz": 3}}, "unknown setting 'icp.zzz'; there are icp.max_iterations, icp."),
        ({"icp": 3}, "icp is a table"),
        ({"icp": {"max_iterations": 3.5}}, "icp.max_iterations must be a whole number, not 3.5"),
        ({"icp": {"max_iterations": True}}, "must be a whole number"),
        ({"icp": {"max_iterations": 0}}, "it must be >= 1 and <= 10000"),
        ({"icp": {"distance": 0}}, "it must be > 0"),
        ({"icp": {"distance": "far"}}, "must be a number"),
        ({"icp": {"distance": math.nan}}, "not nan"),
        ({"icp": {"kernel": "hubert"}}, "did you mean 'huber'"),
        ({"icp": {"pose": [1, 2]}}, "3 values, not 2"),
        ({"icp": {"pose": 1}}, "must be a list"),
        ({"icp": {"optional": -1}}, None),
        ({"robust": 1}, "true or false"),
        ({"heights": 3}, "must be a table"),
    ],
)
def test_wrong_settings_are_named(data, message):
    if message is None:
        assert from_dict(Outer, data).icp.optional == -1.0
        return
    with pytest.raises(ConfigError, match=re.escape(message)):
        from_dict(Outer, data)


@pytest.mark.parametrize("group", ["ranges", "odometry"])
def test_a_wrong_kernel_is_named_with_where_it_stands(group):
    with pytest.raises(ConfigError, match=f"{group}.kernel.name must be one of none, .*did you mean 'huber'"):
        merge(MappingConfig(), {group: {"kernel": {"name": "hubr"}}})
    with pytest.raises(ConfigError, match=f"{group}.kernel.scale = 0.0 is out of range; it must be > 0"):
        merge(MappingConfig(), {group: {"kernel": {"scale": 0}}})


def test_what_toml_cannot_hold_is_named():
    with pytest.raises(ConfigError, match="cannot write a complex as TOML"):
        toml_value({"a": [1, 2j]})


def test_a_number_with_a_natural_default_must_not_be_negative():
    @dataclasses.dataclass(frozen=True)
    class Plain:
        sigma: float = 0.1

    with pytest.raises(ConfigError, match=r"sigma = -1\.0 is out of range; it must be >= 0"):
        from_dict(Plain, {"sigma": -1})


@pytest.mark.parametrize("value", [1e9, -1e9, math.inf, 1e308, 1e-308, 10**10])
def test_a_number_beyond_all_measure_is_refused(value):
    """Its square would overflow, or its inverse; inf stays where it is the default and means that there is no limit."""

    @dataclasses.dataclass(frozen=True)
    class Plain:
        sigma: float = setting(0.1, minimum=-math.inf)
        count: int = 3
        pair: tuple[float, float] = (1.0, 2.0)
        heights: dict[str, float] = dataclasses.field(default_factory=dict)
        limit: float = math.inf

    wrong = [{"sigma": value}, {"pair": [1.0, value]}, {"heights": {"a": value}}]
    for data in [{"count": value}] if isinstance(value, int) else wrong:
        with pytest.raises(ConfigError, match="is out of range; its size must be"):
            merge(Plain(), data)
    assert merge(Plain(), {"limit": math.inf, "sigma": 1e6, "count": 10**9, "pair": [0, -1e-15]}).limit == math.inf
    # What is read is no setting: stamps since 1970, places in a national grid.
    assert from_dict(Plain, {"sigma": 1.7e9}).sigma == 1.7e9


def test_assignments_on_the_command_line():
    config = override(Outer(), ["icp.max_iterations=30", "icp.kernel=huber", "icp.pose=[1, 2, 3]"])
    config = override(config, ['name="b c"', "robust=false"])
    assert config.icp.max_iterations == 30
    assert config.icp.kernel == "huber"
    assert (config.name, config.robust, config.icp.pose) == ("b c", False, (1.0, 2.0, 3.0))
    with pytest.raises(ConfigError, match="name=value"):
        override(Outer(), ["icp.max_iterations"])
    with pytest.raises(ConfigError, match=r"unknown setting 'icp\.max'"):
        override(Outer(), ["icp.max=3"])


def test_merge_keeps_what_is_not_named():
    config = merge(override(Outer(), ["icp.max_iterations=30"]), {"icp": {"distance": 0.5}})
    assert (config.icp.max_iterations, config.icp.distance) == (30, 0.5)


def test_toml_that_is_none_is_one_clear_error():
    with pytest.raises(ConfigError, match=r"my\.toml: not valid TOML: .*line 1"):
        parse_toml("a = = 3", "my.toml")
    with pytest.raises(ConfigError):
        parse_toml("a = " + "[" * 100_000, "deep.toml")


def test_a_number_of_thousands_of_digits_is_no_internal_error():
    with pytest.raises(ConfigError, match="not valid TOML"):
        parse_toml("x = " + 5000 * "9")


def test_leaves_name_every_setting():
    names = [name for name, _ in leaves(Outer)]
    assert names[0] == "icp.max_iterations"
    assert "heights" in names


def test_a_message_that_quotes_a_broken_file_stays_short():
    with pytest.raises(ConfigError, match=r"unknown setting 'AAA.* \.\.\. A*'; there are .*$") as caught:
        merge(MappingConfig(), {"A" * 100_000: 1})
    assert len(str(caught.value)) < 1000


@dataclasses.dataclass(frozen=True)
class Reach:
    """One setting."""

    reach: float = 1.0
    """Farthest match, m."""


def refused(data):
    with pytest.raises(ConfigError) as error:
        from_dict(Reach, data)
    return str(error.value)


@pytest.mark.parametrize(("length", "shown"), [(58, "'" + 58 * "x" + "'"), (59, "'" + 56 * "x" + "...")])
def test_what_is_not_understood_is_shown_up_to_sixty_characters(length, shown):
    with pytest.raises(ConfigError) as error:
        from_dict(Reach, {"reach": length * "x"})
    assert str(error.value).endswith(f"not {shown}")


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
