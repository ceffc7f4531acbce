"""A mapping to begin with for messages of an unknown kind that may hold ranges, guessed from the names of their fields."""

import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields as dataclass_fields
from numbers import Number
from typing import Any

import numpy as np

from ..sensor_log import LONGEST_RANGE
from .uwb_mapping import UwbMapping, short_type

_HINT = re.compile(r"uwb|dwm?\d|rang(e|es|ing)\b|anchor|beacon|pozyx|decawave|linktrack|toa\b|twr|ultra.?wide", re.I)
"""In the name of a topic or type: it may be about radio ranges."""
_OTHERS = re.compile(
    r"(action|actionlib|diagnostic|geometry|lifecycle|map|move_base|nav|rosgraph|shape|stereo|tf2|trajectory|visualization)_msgs/"
    r"|rcl_interfaces/|dynamic_reconfigure/|tf/|sensor_msgs/(?!Range\b)"
)
"""Types that hold no ranges to anchors, whatever a field of theirs is called."""
_OTHER_RANGE = re.compile(r"sonar|ultra.?sonic|infra.?red|\bir\b|cliff|bumper|proximity|altitude|height|lidar|tof", re.I)
"""In the name of a topic of sensor_msgs/Range: not a radio."""
_RANGE = re.compile(r"((measured|raw|uwb)_)?(ranges?|distances?|dist|dis)(_?arr(ay)?)?(_?(mm|cm|m|raw|meas|met(er|re)s?))?")
"""Name of a field with a distance."""
_ID = re.compile(
    r"((anchor|dest(ination)?|responder|remote|target|beacon|node|peer|mac|uwb)_?)?(device_?)?(ids?2?|addr(ess)?|mac|dest|name)s?"
)
"""Name of a field with whom the distance leads to."""
_NOT_ID = re.compile(r"tag|origin|source|src|requester|seq|frame|msg|message|session|own|self")
"""In the name of a field: the other end, or something else."""
_MOST_SAMPLES = 20
"""Messages looked at: a list may be empty at first."""


def suggested(topic: str, message_type: str, samples: Callable[[str], Sequence[Any]]) -> UwbMapping | None:
    """Return a mapping for a topic that may hold ranges to anchors, None where it does not look like it.

    Parameters
    ----------
    samples : gives the first messages of a topic.
    """
    kind = short_type(message_type)
    hinted = _HINT.search(topic) is not None or _HINT.search(kind) is not None
    if kind == "sensor_msgs/Range":
        # The anchor's name is the last word of the topic, or the one before a general one.
        general = topic.rsplit("/", 1)[-1] in ("range", "distance", "dist", "data", "raw") and topic.count("/") > 1
        anchor = "topic:([^/]+)/[^/]+$" if general else "topic:([^/]+)$"
        return None if _OTHER_RANGE.search(topic) else UwbMapping(topic=topic, type=kind, anchor=anchor)
    if _OTHERS.match(kind) or (kind.startswith("std_msgs/") and not hinted):
        return None
    for message in list(samples(topic))[:_MOST_SAMPLES]:
        for path, reading in _readings(message):
            if (found := _mapping(reading, kind, hinted)) is not None:
                stamp = "header.stamp" if hasattr(message, "header") else ""
                return UwbMapping(topic, kind, path, **found, stamp=stamp)
    return UwbMapping(topic, kind, anchor="?", range="?") if hinted and not kind.startswith("std_msgs/") else None


def as_toml(mappings: Iterable[UwbMapping]) -> str:
    """Return mappings as one line of TOML, with the fields that are not as they are by themselves."""
    plain = UwbMapping()
    tables = []
    for m in mappings:
        names = [f.name for f in dataclass_fields(m)]
        changed = [n for n in names if n in ("anchor", "range") or getattr(m, n) != getattr(plain, n)]
        tables.append("{ " + ", ".join(f"{name} = {json.dumps(getattr(m, name))}" for name in changed) + " }")
    return f"uwb = [{', '.join(tables)}]"


def _readings(message: Any) -> list[tuple[str, Any]]:
    """Return the message itself and the first entry of each list of messages in it, with its path."""
    lists = ((name, value) for name, value in _fields(message) if isinstance(value, list | tuple) and value)
    return [("", message), *((name, v[0]) for name, v in lists if hasattr(v[0], "__dataclass_fields__"))]


def _mapping(reading: Any, kind: str, hinted: bool) -> dict[str, Any] | None:
    """Return anchor, range and unit of a reading, None where no field looks like a range of something."""
    values = dict(_fields(reading))
    ranges = [name for name in values if _RANGE.fullmatch(name.lower()) or kind.startswith("std_msgs/")]
    lists = [name for name in ranges if _is_array(values[name], "fiu") and len(values[name])]
    single = [name for name in ranges if isinstance(values[name], Number)]
    named = [name for name in values if _ID.fullmatch(name.lower()) and not _NOT_ID.match(name.lower())]
    ids = [name for name in named if isinstance(values[name], str | Number)]
    ids.sort(key=lambda name: (name.lower() == "id", _NOT_ID.search(name.lower()) is not None))
    if single and ids:
        return {"anchor": ids[0], "range": single[0], "unit": _unit(single[0], values[single[0]])}
    if lists:
        beside = [n for n in named if n not in lists and _is_ids(values[n], len(values[lists[0]]))]
        anchor = min(beside, key=lambda name: (_NOT_ID.search(name.lower()) is not None, name.lower() == "id"), default="index")
        return {"anchor": anchor, "range": lists[0], "unit": _unit(lists[0], np.max(values[lists[0]]))}
    if hinted and kind in ("std_msgs/Float32", "std_msgs/Float64"):
        return {"anchor": "topic:([^/]+)$", "range": "data"}
    return None


def _fields(message: Any) -> list[tuple[str, Any]]:
    names = [n for n in getattr(message, "__dataclass_fields__", {}) if not n.startswith("_")]
    return [(name, getattr(message, name)) for name in names]


def _is_array(value: Any, kinds: str) -> bool:
    return isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in kinds


def _is_ids(value: Any, count: int) -> bool:
    """Return whether a field holds an id for each of so many ranges."""
    texts = isinstance(value, list | tuple) and all(isinstance(v, str) for v in value)
    return (texts or _is_array(value, "iu")) and len(value) == count


def _unit(name: str, value: Any) -> float:
    """Return metres per unit: by the name; millimetres for whole numbers, and for those that no radio reaches in metres."""
    if name.lower().endswith("cm"):
        return 0.01
    whole = isinstance(value, int | np.integer)
    return 0.001 if name.lower().endswith("mm") or whole or float(value) > LONGEST_RANGE else 1.0
