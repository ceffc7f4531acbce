"""Which topics of a bag hold wheels, scans, an IMU, ranges and transforms; and which may hold ranges that no mapping reads."""

import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from dataclasses import fields as dataclass_fields
from difflib import get_close_matches
from numbers import Number
from typing import Any

import numpy as np

from ..errors import ConfigError
from ..sensor_log import LONGEST_RANGE
from .uwb_mapping import KNOWN, MissingField, UwbMapping, fitting, readings_of, short_type

ODOMETRY, SCAN, TRANSFORMS = "nav_msgs/msg/Odometry", "sensor_msgs/msg/LaserScan", "tf2_msgs/msg/TFMessage"
IMU = "sensor_msgs/msg/Imu"
NONE = "none"
"""In place of the topic of an IMU: no IMU is read."""

Samples = Callable[[str], Sequence[Any]]
"""First messages of a topic, by its name."""


@dataclass(frozen=True, slots=True)
class BagTopics:
    """Which topics to read; empty = guess from the types."""

    odometry: str = ""
    scan: str = ""
    uwb: tuple[str, ...] = ()
    imu: str = ""
    """NONE = the heading is the odometry's, whatever IMU there is."""
    base_frame: str = ""
    """Empty = the odometry's child frame."""


GUESSED = BagTopics()
"""No topic is named: all are guessed."""


@dataclass(frozen=True, slots=True)
class BagTopic:
    """One topic of a bag."""

    name: str
    type: str
    count: int


@dataclass(frozen=True, slots=True)
class TopicPlan:
    """What is read from which topic."""

    odometry: str
    """Empty, or a topic of transforms: the transform from odom to the base is the odometry."""
    scan: str
    imu: str
    uwb: dict[str, tuple[UwbMapping, ...]]
    tf: tuple[str, ...]
    passed_over: tuple[str, ...]
    """Topics that would have done too."""
    unread: dict[str, UwbMapping]
    """Topics that may hold ranges, with a mapping to begin with."""
    choices: tuple[str, ...] = ()
    """Where several topics would have done: which was chosen, and how to take another."""

    def role(self, name: str) -> str:
        """Return the purpose for which a topic is read; '' where it is not read."""
        roles = {self.odometry: "odometry", self.scan: "scans", self.imu: "heading"} | dict.fromkeys(self.uwb, "ranges")
        return roles.get(name, "")


def plan_topics(
    topics: tuple[BagTopic, ...], samples: Samples, asked: BagTopics = GUESSED, mappings: tuple[UwbMapping, ...] = ()
) -> TopicPlan:
    """Choose the topics of a bag.

    Parameters
    ----------
    topics : all of the bag. samples : gives the first messages of a topic. asked : topics that the user names.
    mappings : the user's mappings of ranges; the known ones are tried after these.

    Raises
    ------
    ConfigError : a topic that was asked for is not there or of another type, or a mapping of the user's matches nothing.
    """
    wheels = [t for t in topics if not is_truth(t.name)]
    by_tf = bool(asked.odometry) and _topic(topics, asked.odometry).type == TRANSFORMS
    odometry = asked.odometry or _best(wheels, ODOMETRY, ("odom", "wheel"), ("filtered", "gps", "visual"))
    scan = asked.scan or _best(topics, SCAN, ("/scan",), ("sonar", "ultra", "back", "rear"))
    imu = asked.imu or _best(topics, IMU, ("imu",), ("camera", "realsense", "zed", "oak", "head", "arm", "mag"))
    imu = "" if imu == NONE else imu
    for name, kind, what in ((odometry, ODOMETRY, "odometry"), (scan, SCAN, "scans"), (imu, IMU, "headings")):
        if name and not (by_tf and name == odometry) and (given := _topic(topics, name)).type != kind:
            fit = [t.name for t in topics if t.type == kind]
            fits = f"; of that type: {', '.join(fit)}" if fit else ", of which the bag has none"
            raise ConfigError(f"{name} is of type {short_type(given.type)}; {what} are read from {short_type(kind)}{fits}")
    for name in asked.uwb:
        _topic(topics, name)
    others = (t for t in topics if t.name not in (odometry, scan) and t.type not in (IMU, TRANSFORMS))
    rest = [*others, *(t for t in topics if t.name in asked.uwb and t.name in (odometry, scan))]
    _check_mappings(rest, mappings)
    uwb, unread = {}, {}
    for t in rest:
        chosen = t.name in asked.uwb or not asked.uwb
        if chosen and (usable := _usable(t, samples, mappings)):
            uwb[t.name] = usable
        elif (guess := suggested(t.name, t.type, samples)) is not None:
            unread[t.name] = guess
        if t.name in asked.uwb and t.name not in uwb:
            text, guess = f"no uwb mapping reads {t.name} of type {short_type(t.type)}", unread.get(t.name)
            start = "" if guess is None else f", for a start: {as_toml([guess])}"
            raise ConfigError(f"{text}; describe it in a file for `mappings`{start}")
    # X is left out where X_raw exists: the map has its own correction.
    kept = uwb if asked.uwb else {name: m for name, m in uwb.items() if f"{name}_raw" not in uwb}
    spare = [t.name for t in topics if t.type in (ODOMETRY, SCAN, IMU) and t.name not in (odometry, scan, imu)]
    spare += [name for name in uwb if name not in kept]
    choices = []
    for kind, taken, named, what, option in (
        (ODOMETRY, odometry, asked.odometry, "odometry is", "`topics.odometry`"),
        (SCAN, scan, asked.scan, "scans are", "`topics.scan`"),
    ):
        alike = [t.name for t in topics if t.type == kind and t.name != taken]
        if taken and alike and not named:
            choices.append(f"the {what} read from {taken}; {option} takes another ({', '.join(alike)})")
    tf = tuple(t.name for t in topics if t.type == TRANSFORMS)
    return TopicPlan(odometry, scan, imu, kept, tf, tuple(spare), {} if asked.uwb else unread, tuple(choices))


def is_truth(topic: str) -> bool:
    """Return whether a topic is named as the truth, which is no odometry."""
    words = re.split(r"[/_\-]", topic.lower())
    return any(word in ("gt", "truth", "groundtruth") for word in words)


def unread_warning(plan: TopicPlan) -> str:
    """Return one line that names the topics which may hold ranges, with a mapping to paste."""
    names = ", ".join(plan.unread)
    return (
        f"not read, though there may be ranges in it: {names}. If there are, put this line into a file uwb.toml, correct it"
        f" (docs/formats.md explains it) and give `mappings=uwb.toml`: {as_toml(plan.unread.values())}"
    )


def _usable(topic: BagTopic, samples: Samples, mappings: Sequence[UwbMapping]) -> tuple[UwbMapping, ...]:
    """Return the mappings by which a topic is read: the user's, or known ones whose fields its messages have."""
    if given := fitting(topic.name, topic.type, mappings):
        return given
    known = fitting(topic.name, topic.type, KNOWN)
    try:
        for message in samples(topic.name) if known else ():
            readings_of(message, topic.name, known)
    except MissingField:
        return ()
    return known


def _topic(topics: Sequence[BagTopic], name: str) -> BagTopic:
    """Return the topic of a name, or raise ConfigError."""
    topic = next((t for t in topics if t.name == name), None)
    if topic is None:
        names = [t.name for t in topics]
        raise ConfigError(f"the bag has no topic {name}; {did_you_mean(name, names)}it has {', '.join(names)}")
    return topic


def did_you_mean(name: str, names: Sequence[str]) -> str:
    """Return a question for the name that is nearest to a wrong one, '' where none is near."""
    return "".join(f"did you mean {near}? " for near in get_close_matches(name, names, n=1))


def _check_mappings(topics: Sequence[BagTopic], mappings: Sequence[UwbMapping]) -> None:
    """Raise ConfigError where a mapping of the user's matches no topic."""
    for number, m in enumerate(mappings, 1):
        if any(m.fits(t.name, t.type) for t in topics):
            continue
        named = [t for t in topics if UwbMapping(topic=m.topic).fits(t.name, t.type)]
        typed = [t for t in topics if UwbMapping(type=m.type).fits(t.name, t.type)]
        near = [t for t in topics if t.name in get_close_matches(m.topic, [t.name for t in topics], n=2)]
        shown = [f"{t.name} of type {short_type(t.type)}" for t in (named or typed or near or topics)[:5]]
        raise ConfigError(
            f"uwb mapping number {number} matches nothing: topic {m.topic!r} and type {m.type!r};"
            f" the bag has {', '.join(shown) or 'nothing besides odometry, scans and transforms'}"
        )


def _best(topics: Sequence[BagTopic], kind: str, liked: tuple[str, ...], disliked: tuple[str, ...]) -> str:
    """Return the likeliest topic of a type; '' where there is none."""

    def rank(topic: BagTopic) -> tuple[bool, bool, int, str]:
        name = topic.name.lower()
        return (any(d in name for d in disliked), not any(w in name for w in liked), -topic.count, topic.name)

    fitting = [t for t in topics if t.type == kind]
    return min(fitting, key=rank).name if fitting else ""


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


def suggested(topic: str, message_type: str, samples: Samples) -> UwbMapping | None:
    """Return a mapping for a topic that may hold ranges to anchors, by the names of its fields; None where it does not."""
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
            if (mapping := _mapping(reading, kind, hinted)) is not None:
                stamp = "header.stamp" if hasattr(message, "header") else ""
                return UwbMapping(topic, kind, path, **mapping, stamp=stamp)
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
