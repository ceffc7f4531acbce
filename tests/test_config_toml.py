"""Settings as TOML: what is written reads back; the documentation of fields stands above them."""

import tomllib

from helpers.example_settings import Inner, Outer
from hypothesis import given
from hypothesis import strategies as st

from uwblite.config import differences, field_docs, from_dict, override, parse_toml, to_toml, toml_value
from uwblite.pipeline.mapping_config import MappingConfig


def test_defaults_survive_toml():
    assert from_dict(Outer, parse_toml(to_toml(Outer()))) == Outer()
    assert from_dict(Outer, parse_toml(to_toml(Outer(), comments=True, header="two\nlines"))) == Outer()


numbers = st.floats(-1e6, 1e6).filter(lambda x: x == 0 or abs(x) >= 1e-15)


@given(
    st.builds(
        Outer,
        icp=st.builds(
            Inner,
            max_iterations=st.integers(1, 10_000),
            distance=st.floats(1e-15, 1e6),
            kernel=st.sampled_from(["none", "huber"]),
            pose=st.tuples(numbers, numbers, numbers),
            optional=st.none() | numbers.map(abs),
        ),
        robust=st.booleans(),
        name=st.text().filter(lambda s: not any(0xD800 <= ord(c) < 0xE000 for c in s)),
        offset=numbers,
        weights=st.lists(numbers).map(tuple),
        heights=st.dictionaries(st.text(st.characters(blacklist_categories=("Cs",))), numbers),
    )
)
def test_any_settings_survive_toml(config):
    assert from_dict(Outer, parse_toml(to_toml(config, comments=True))) == config


def test_docstrings_under_the_fields_become_comments():
    assert field_docs(Inner)["distance"] == "Outlier distance, m. Larger: wider basin, more false matches."
    text = to_toml(Outer(), comments=True)
    assert "# Outlier distance, m. Larger: wider basin, more false matches. (> 0)\ndistance = 0.1" in text
    assert "# Robust kernel. (none, huber)" in text
    assert '# Height, m. (or "none")\noptional = "none"' in text
    assert "# A stage of the walk.\n[icp]" in text


@given(st.text(st.characters(blacklist_categories=("Cs",))))
def test_any_text_survives_toml(text):
    assert tomllib.loads(f"x = {toml_value(text)}")["x"] == text


def test_differences_are_what_override_makes_of_the_base():
    base = MappingConfig()
    assert differences(base, base) == []
    changed = override(base, ["use_loops=false", "grid.resolution=0.1", "crop=[0, 0, 12, 8]"])
    assert sorted(differences(changed, base)) == ["crop=[0.0, 0.0, 12.0, 8.0]", "grid.resolution=0.1", "use_loops=false"]
    assert override(base, differences(changed, base)) == changed
