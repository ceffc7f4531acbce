"""Settings as commented TOML, as `uwblite config` prints them and a result keeps them; config.parse_toml reads them back."""

import dataclasses
from collections.abc import Mapping
from textwrap import wrap
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from ..config import ADVANCED, RANGE, field_docs, flat, range_text, to_dict
from ..errors import ConfigError


def differences(config: Any, base: Any) -> list[str]:
    """Return the settings that differ from those of a base, as `override` takes them."""
    theirs = dict(flat(to_dict(base)))
    return [f"{name}={toml_value(v)}" for name, v in flat(to_dict(config)) if v != theirs.get(name)]


def to_toml(config: Any, *, comments: bool = False, header: str = "", advanced: bool = True) -> str:
    """Return the settings as TOML, with the meaning of each setting as a comment where asked for.

    Parameters
    ----------
    comments : write each field's docstring, permitted range and choices above it.
    header : text for the first lines, written as comments.
    advanced : also write advanced settings that have their defaults.
    """
    lines = [f"# {line}".rstrip() for line in header.splitlines()]
    _write_table(lines, config, (), comments, advanced)
    return "\n".join(lines).strip("\n") + "\n"


def shown_fields(config: Any, advanced: bool = False) -> "list[dataclasses.Field[Any]]":
    """Return the fields to list for a user: without advanced ones that have their defaults, unless these are asked for."""

    def shown(f: "dataclasses.Field[Any]") -> bool:
        value = getattr(config, f.name)
        if f.metadata.get(ADVANCED) and not advanced:
            return bool(value != f.default)
        return not dataclasses.is_dataclass(value) or bool(shown_fields(value, advanced))

    return [f for f in dataclasses.fields(config) if shown(f)]


def _write_table(lines: list[str], config: Any, path: tuple[str, ...], comments: bool, advanced: bool) -> None:
    docs = field_docs(type(config)) if comments else {}
    hints = get_type_hints(type(config))
    tables = []
    if path:
        text = _wrapped((type(config).__doc__ or "").strip().split("\n\n")[0]) if comments else []
        lines += ["", *text, f"[{'.'.join(path)}]"]
    for f in shown_fields(config, advanced):
        value = getattr(config, f.name)
        if dataclasses.is_dataclass(value):
            tables.append((f.name, value))
            continue
        if comments:
            lines += _wrapped(" ".join(filter(None, (docs.get(f.name, ""), permitted(f, hints[f.name])))))
        lines.append(f"{f.name} = {toml_value(value)}")
    for name, value in tables:
        _write_table(lines, value, (*path, name), comments, advanced)


def permitted(field: "dataclasses.Field[Any]", hint: Any) -> str:
    """Return what values a field takes beyond its type, in brackets; empty where there is none."""
    parts = []
    literal = next((h for h in (hint, *get_args(hint)) if get_origin(h) is Literal), None)
    if literal is not None:
        parts.append(", ".join(map(str, get_args(literal))))
    if field.metadata.get(RANGE):
        parts.append(range_text(field.metadata[RANGE]))
    if NoneType in get_args(hint):
        parts.append('or "none"')
    return f"({'; '.join(parts)})" if parts else ""


def _wrapped(text: str) -> list[str]:
    return [f"# {line}" for line in wrap(" ".join(text.split()), 116)]


def toml_value(value: Any) -> str:
    """Return a plain value as TOML; None becomes the text "none"."""
    if value is None:
        return '"none"'
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return _toml_text(value)
    if isinstance(value, tuple | list):
        return "[" + ", ".join(toml_value(v) for v in value) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_toml_text(str(k))} = {toml_value(v)}" for k, v in value.items()) + " }" if value else "{}"
    raise ConfigError(f"cannot write a {type(value).__name__} as TOML")


def _toml_text(text: str) -> str:
    escapes = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\r": "\\r", "\t": "\\t", "\b": "\\b", "\f": "\\f"}
    safe = (escapes.get(c, c if c.isprintable() else f"\\U{ord(c):08X}") for c in text)
    return '"' + "".join(safe) + '"'
