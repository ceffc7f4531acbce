"""Settings: round trips, strictness, names nearly right, documentation of fields."""

import dataclasses
import math
import re
import tomllib
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblite.config import (
    differences,
    field_docs,
    from_dict,
    leaves,
    merge,
    override,
    parse_toml,
    setting,
    to_dict,
    to_toml,
    toml_value,
)
from uwblite.errors import ConfigError
from uwblite.pipeline.mapping_config import MappingConfig


@dataclasses.dataclass(frozen=True, slots=True)
class Inner:
    """A stage of the walk."""

    max_iterations: int = setting(300, minimum=1, maximum=10_000)
    """Most rounds of matching."""
    distance: float = setting(0.1, above=0.0)
    """Outlier distance, m. Larger: wider basin,
    more false matches."""
    kernel: Literal["none", "huber"] = "none"
    """Robust kernel."""
    pose: tuple[float, float, float] = (0.0, -1.0, 0.5)
    """A pose: m, m, rad."""
    optional: float | None = None
    """Height, m."""


@dataclasses.dataclass(frozen=True, slots=True)
class Outer:
    """All settings."""

    icp: Inner = Inner()
    """Matching."""
    robust: bool = True
    """Whether to be."""
    name: str = "a"
    offset: float = -1.0
    """May be negative, for its default is."""
    weights: tuple[float, ...] = (1.0, 2.0)
    heights: dict[str, float] = dataclasses.field(default_factory=dict)


def test_defaults_survive_dict_and_toml():
    assert from_dict(Outer, to_dict(Outer())) == Outer()
    assert from_dict(Outer, parse_toml(to_toml(Outer()))) == Outer()
    assert from_dict(Outer, parse_toml(to_toml(Outer(), comments=True, header="two\nlines"))) == Outer()
    assert from_dict(Outer, {}) == Outer()


numbers = st.floats(allow_nan=False)


@given(
    st.builds(
        Outer,
        icp=st.builds(
            Inner,
            max_iterations=st.integers(1, 10_000),
            distance=st.floats(min_value=1e-300, allow_infinity=True),
            kernel=st.sampled_from(["none", "huber"]),
            pose=st.tuples(numbers, numbers, numbers),
            optional=st.none() | st.floats(0, 1e9),
        ),
        robust=st.booleans(),
        name=st.text().filter(lambda s: not any(0xD800 <= ord(c) < 0xE000 for c in s)),
        offset=numbers,
        weights=st.lists(numbers).map(tuple),
        heights=st.dictionaries(st.text(st.characters(codec="utf-8")), numbers),
    )
)
def test_any_settings_survive_toml(config):
    assert from_dict(Outer, parse_toml(to_toml(config, comments=True))) == config


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
        ({"icp": {"zzz": 3}}, "uwblite config"),
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


def test_a_number_with_a_natural_default_must_not_be_negative():
    @dataclasses.dataclass(frozen=True)
    class Plain:
        sigma: float = 0.1

    with pytest.raises(ConfigError, match=r"sigma = -1\.0 is out of range; it must be >= 0"):
        from_dict(Plain, {"sigma": -1})


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


def test_docstrings_under_the_fields_become_comments():
    assert field_docs(Inner)["distance"] == "Outlier distance, m. Larger: wider basin, more false matches."
    text = to_toml(Outer(), comments=True)
    assert "# Outlier distance, m. Larger: wider basin, more false matches. (> 0)\ndistance = 0.1" in text
    assert "# Robust kernel. (none, huber)" in text
    assert '# Height, m. (or "none")\noptional = "none"' in text
    assert "# A stage of the walk.\n[icp]" in text


def test_leaves_name_every_setting():
    names = [name for name, _ in leaves(Outer)]
    assert names[0] == "icp.max_iterations"
    assert "heights" in names


@given(st.text(st.characters(codec="utf-8")))
def test_any_text_survives_toml(text):
    assert tomllib.loads(f"x = {toml_value(text)}")["x"] == text


def test_a_message_that_quotes_a_broken_file_stays_short():
    with pytest.raises(ConfigError, match=r"unknown setting 'AAA.* \.\.\. A*'; `uwblite config` lists all settings$") as caught:
        merge(MappingConfig(), {"A" * 100_000: 1})
    assert len(str(caught.value)) < 1000


def test_differences_are_what_override_makes_of_the_base():
    base = MappingConfig()
    assert differences(base, base) == []
    changed = override(base, ["use_loops=false", "grid.resolution=0.1", "crop=[0, 0, 12, 8]"])
    assert sorted(differences(changed, base)) == ["crop=[0.0, 0.0, 12.0, 8.0]", "grid.resolution=0.1", "use_loops=false"]
    assert override(base, differences(changed, base)) == changed
