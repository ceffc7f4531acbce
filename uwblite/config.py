"""Settings: nested frozen dataclasses to and from dicts and TOML, checked strictly; independent of mapping.

A settings class is a frozen dataclass whose fields have a type, a default and, on the line below, a docstring (unit,
meaning, when to change it). Fields are bool, int, float, str, a Literal of strings, a tuple or dict of these, one of
these or None, or another settings class. A number whose default is not negative must not be negative; ``setting`` says
other ranges. TOML has no null: None is written "none".

Laws: ``from_dict(type(c), to_dict(c))`` and ``from_dict(type(c), parse_toml(to_toml(c)))`` give a c of equal values.
"""

import ast
import dataclasses
import operator
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields
from difflib import get_close_matches
from itertools import pairwise
from textwrap import wrap
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from .errors import ConfigError

Settings = TypeVar("Settings")

RANGE, ADVANCED = "uwblite range", "uwblite advanced"
"""In the metadata of a field: its permitted range, and that it is for experiments."""


def setting(default: Any, *, advanced: bool = False, **limits: float) -> Any:
    """Return a dataclass field with a default and a permitted range: above < value < below, minimum <= value <= maximum.

    An advanced setting is for experiments and presets; lists for users leave it out where it has its default.
    """
    return dataclasses.field(default=default, metadata={ADVANCED: advanced, **({RANGE: limits} if limits else {})})


def to_dict(config: Any) -> dict[str, Any]:
    """Return the settings as nested dicts of plain values, in the order of the fields."""
    return {f.name: _plain(getattr(config, f.name)) for f in dataclasses.fields(config)}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_dict(value)
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    return value


def from_dict(cls: type[Settings], data: Mapping[str, Any]) -> Settings:
    """Return settings of a class from nested dicts; what is not named keeps its default.

    Raises
    ------
    ConfigError : a name is unknown (with the nearest known one), a value has the wrong type or is out of its range.
    """
    return cast(Settings, _merge(cls(), data, (), cls, sized=False))


def merge(config: Settings, data: Mapping[str, Any]) -> Settings:
    """Return the settings with those named in nested dicts replaced; errors as in from_dict, and out of all proportion."""
    return cast(Settings, _merge(config, data, (), type(config), sized=True))


def override(config: Settings, assignments: Iterable[str]) -> Settings:
    """Return the settings with assignments such as 'icp.max_iterations=30' carried out; values are TOML or bare words."""
    for text in assignments:
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise ConfigError(f"{text!r} sets nothing: write a setting as table.name=value, such as grid.resolution=0.1")
        try:
            nested: Any = tomllib.loads(f"value = {value}")["value"]
        except ValueError:  # not TOML, or a number of thousands of digits
            nested = value.strip()
        for part in reversed(name.strip().split(".")):
            nested = {part: nested}
        config = merge(config, nested)
    return config


def parse_toml(text: str, path: str = "") -> dict[str, Any]:
    """Return the nested dicts of a TOML text; path is its name for error messages."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # a number of thousands of digits is a plain ValueError
        raise ConfigError(f"{path or 'TOML'}: not valid TOML: {error or 'nested too deeply'}") from None


def leaves(cls: type) -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and default of every setting of a class, nested ones included."""
    yield from flat(to_dict(cls()))


def flat(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and value of every setting of nested dicts."""
    for name, value in data.items():
        if isinstance(value, Mapping) and value:
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _merge(config: Any, data: Any, path: tuple[str, ...], root: type, *, sized: bool) -> Any:
    if not isinstance(data, Mapping):
        raise ConfigError(f"{'.'.join(path)} is a table of settings, not {_shown(data)}")
    fields = {f.name: f for f in dataclasses.fields(config)}
    hints = get_type_hints(type(config))
    changes = {}
    for name, value in data.items():
        where = (*path, str(name))
        if name not in fields:
            raise ConfigError(_unknown(where, type(config), root))
        old = getattr(config, name)
        if dataclasses.is_dataclass(old):
            changes[name] = _merge(old, value, where, root, sized=sized)
        else:
            converted = _convert(value, hints[name], where)
            if sized:
                _check_size(converted, fields[name].default, where)
            changes[name] = _check_range(converted, _limits(fields[name]), where)
    return dataclasses.replace(config, **changes)


def _unknown(where: tuple[str, ...], cls: type, root: type) -> str:
    """Return why a name is no setting: it is a constant of its class now, or never was one."""
    name = ".".join(where)
    if where[-1] in cls.__annotations__:
        return f"{name!r} is no setting any more: it is now a constant of {cls.__name__}, {getattr(cls, where[-1])!r}"
    known = [name for name, _ in leaves(root)]
    known += sorted({name.rpartition(".")[0] for name in known} - {""})
    by_end = {name.rpartition(".")[2]: name for name in reversed(known)}
    ends = [by_end[where[-1]]] if where[-1] in by_end else []
    near = ends or get_close_matches(name, known, n=1, cutoff=_ALIKE)
    near = near or [by_end[end] for end in get_close_matches(where[-1], by_end, n=1, cutoff=_ALIKE)]
    siblings = ", ".join(".".join((*where[:-1], f.name)) for f in dataclasses.fields(cls))
    return f"unknown setting {name!r}; " + (f"did you mean {near[0]!r}?" if near else f"there are {siblings}")


_ALIKE = 0.7
"""Share of letters by which a name is taken for a misspelt one."""


def _convert(value: Any, hint: Any, where: tuple[str, ...]) -> Any:
    """Return the value as the type of the hint, or raise ConfigError."""
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        if value is None or value == "none":
            return None
        return _convert(value, next(a for a in args if a is not NoneType), where)
    if origin is Literal:
        if value not in args:
            near = get_close_matches(str(value), [str(a) for a in args], n=1)
            hint_text = f"; did you mean {near[0]!r}?" if near else ""
            raise ConfigError(f"{'.'.join(where)} must be one of {', '.join(map(str, args))}, not {_shown(value)}{hint_text}")
        return value
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{'.'.join(where)} must be a list, not {_shown(value)}")
        each = (args[0],) * len(value) if args[1:] == (Ellipsis,) else args
        if len(value) != len(each):
            raise ConfigError(f"{'.'.join(where)} must have {len(each)} values, not {len(value)}")
        return tuple(_convert(v, a, where) for v, a in zip(value, each, strict=True))
    if origin is dict:
        if not isinstance(value, Mapping):
            raise ConfigError(f"{'.'.join(where)} must be a table, not {_shown(value)}")
        return {str(k): _convert(v, args[1], (*where, str(k))) for k, v in value.items()}
    if hint is float and type(value) is int:
        value = float(value)
    if type(value) is not hint or value != value:
        raise ConfigError(f"{'.'.join(where)} must be {_TYPE_NAMES.get(hint, str(hint))}, not {_shown(value)}")
    return value


def _limits(field: "dataclasses.Field[Any]") -> Mapping[str, float]:
    default = field.default
    quantity = isinstance(default, int | float) and not isinstance(default, bool) and default >= 0
    return field.metadata.get(RANGE, {"minimum": 0.0} if quantity else {})


_COMPARED = {
    "above": (">", operator.gt),
    "minimum": (">=", operator.ge),
    "maximum": ("<=", operator.le),
    "below": ("<", operator.lt),
}


def _check_range(value: Any, limits: Mapping[str, float], where: tuple[str, ...]) -> Any:
    for v in value if isinstance(value, tuple) else (value,):
        if v is not None and not all(_COMPARED[name][1](v, limit) for name, limit in limits.items()):
            raise ConfigError(f"{'.'.join(where)} = {_shown(v)} is out of range; it must be {range_text(limits)}")
    return value


def require_permitted(config: Any) -> None:
    """Raise ConfigError where a field of settings is out of its range: for those that are made in Python."""
    for field in dataclasses.fields(config):
        _check_range(getattr(config, field.name), _limits(field), (field.name,))


def range_text(limits: Mapping[str, float]) -> str:
    """Return a permitted range in words, such as '> 0 and <= 1'."""
    return " and ".join(f"{_COMPARED[name][0]} {limit:g}" for name, limit in limits.items())


_SMALLEST, _LARGEST, _MOST_COUNTED = 1e-15, 1e6, int(1e9)
"""In whatever unit, no setting of an algorithm means anything beyond, though a stamp or a place may; squares of what is within
do not overflow. The last is of what is counted."""


def _check_size(value: Any, default: Any, where: tuple[str, ...]) -> None:
    """Refuse a number that is too large or too small to mean anything, unless the default is."""
    several = value.values() if isinstance(value, Mapping) else value if isinstance(value, tuple) else (value,)
    for v in several:
        if not isinstance(v, int | float) or v in (default, 0):
            continue
        least, most = (_SMALLEST, _LARGEST) if isinstance(v, float) else (1, _MOST_COUNTED)
        if not least <= abs(v) <= most:
            raise ConfigError(f"{'.'.join(where)} = {_shown(v)} is out of range; its size must be {least:g} to {most:g}")


_TYPE_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def differences(config: Any, base: Any) -> list[str]:
    """Return the settings that differ from those of a base, as `override` takes them."""
    defaults = dict(flat(to_dict(base)))
    return [f"{name}={toml_value(v)}" for name, v in flat(to_dict(config)) if v != defaults.get(name)]


def to_toml(config: Any, *, comments: bool = False, header: str = "", advanced: bool = True) -> str:
    """Return the settings as TOML.

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
    safe = (f"\\{c}" if c in '"\\' else c if c.isprintable() else f"\\U{ord(c):08X}" for c in text)
    return '"' + "".join(safe) + '"'


_Class = TypeVar("_Class", bound=type)


def field_docs(cls: type) -> dict[str, str]:
    """Return the docstring under each field of a class, by name; empty where the source is not at hand.

    `inspect` asks the module's loader where there is no file, so that the source is found in a zip too.
    """
    import inspect

    try:
        tree = ast.parse(inspect.getsource(sys.modules[cls.__module__]))
    except (OSError, TypeError, KeyError):
        return {}
    body = next((node.body for node in tree.body if isinstance(node, ast.ClassDef) and node.name == cls.__name__), [])
    docs = {}
    for node, below in pairwise([*body, ast.Pass()]):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        constant = below.value if isinstance(below, ast.Expr) else None
        text = constant.value if isinstance(constant, ast.Constant) else None
        docs[node.target.id] = " ".join(text.split()) if isinstance(text, str) else ""
    return docs


def documented(cls: _Class) -> _Class:
    """Let the docstring of a dataclass list its fields too; the source is read when somebody asks."""
    cls.__doc__ = _Docs(cls.__doc__ or "")  # type: ignore[assignment]
    return cls


class _Docs:
    """A docstring that is completed when it is read."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __get__(self, instance: Any, owner: type) -> str:
        docs = field_docs(owner)
        if not docs:
            return self.text
        texts = {f.name: docs.get(f.name) or getattr(f.type, "__name__", str(f.type)) for f in fields(owner)}
        listed = "".join(f"\n    {name} : {text}" for name, text in texts.items())
        return f"{self.text.rstrip()}\n\n    Attributes\n    ----------{listed}\n"
