"""Places of UWB ranges in ROS messages: there is no standard, so a table lists where to look.

As TOML, an ``[[uwb]]`` table per kind of message with the fields of `UwbMapping` (docs/formats.md); the first that fits counts.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from fnmatch import fnmatchcase
from numbers import Integral
from typing import Any, NamedTuple

from ..config import from_dict, parse_toml
from ..errors import ConfigError


class Reading(NamedTuple):
    """One range in a message."""

    anchor: str
    range: float
    """m."""
    quality: float
    """0..100."""
    tag: str = ""
    """Id of the tag that measured; '' where the message does not tell."""


_OF_ENDS = ("requester", "source", "src", "origin", "initiator")
_TAGS = ("tagId", "tag_id", "tagID", "tag", "id_tag", *(f"{end}{form}" for end in _OF_ENDS for form in ("_id", "Id")))
"""Usual names of the field with the tag's id."""


@dataclass(frozen=True, slots=True)
class UwbMapping:
    """Places of the ranges in one kind of message."""

    topic: str = "*"
    """Pattern of the topic's name, * and ? as in file names."""
    type: str = "*"
    """Pattern of the message's type, such as gtec_msgs/Ranging."""
    readings: str = ""
    """Field of the message that holds a list of readings; empty: the message itself is one reading."""
    anchor: str = "id"
    """Field of the reading with the anchor's id; 'topic:REGEX' takes it from the first group in the topic's name;
    'index' takes the place in the array where the range is an array, which may also have an array of ids beside it."""
    range: str = "range"
    """Field of the reading with the distance."""
    unit: float = 1.0
    """Metres per unit of the range: 0.001 for millimetres."""
    stamp: str = "header.stamp"
    """Field of the message with the time; empty: when it was recorded."""
    quality: str = ""
    """Field of the reading with a quality of 0..100; empty: none."""
    anchor_format: str = "{}"
    """How a numeric id is written: '{}' as it is, '{:04X}' as four hexadecimal digits."""
    tag: str = ""
    """Field of the reading, or of the message, with the id of the tag that measured, or 'topic:REGEX'; empty: the first of
    the usual names (tag_id, tagId, requester_id ...) that is there."""
    only: dict[str, int] = field(default_factory=dict)
    """Fields of the reading that must have these values, e.g. the tag's id where there are several tags; with 'index' a
    field that is an array is asked at the place of the range."""

    def fits(self, topic: str, message_type: str) -> bool:
        """Return whether the mapping is meant for a topic; ``pkg/Name`` and ``pkg/msg/Name`` are one type."""
        return fnmatchcase(topic, self.topic) and fnmatchcase(short_type(message_type), short_type(self.type))

    def extract(self, message: Any, topic: str) -> list[Reading]:
        """Return every reading in a message, or raise MissingField; 0 or nan in an array for all anchors is none."""
        readings = _field(message, self.readings, self) if self.readings else [message]
        extracted = []
        for reading in readings:
            value = _field(reading, self.range, self)
            quality = float(_field(reading, self.quality, self)) if self.quality else 100.0
            tag = self._tag(reading, message, topic)
            if hasattr(value, "__len__"):
                ids = range(len(value)) if self.anchor == "index" else _field(reading, self.anchor, self)
                pairs = zip(range(len(value)), ids, value, strict=False)
                measured = [(name, float(v)) for k, name, v in pairs if self._wanted(reading, k)]
                usable = [(self._name(name), v) for name, v in measured if math.isfinite(v) and v != 0.0]
                extracted += [Reading(name, v * self.unit, quality, tag) for name, v in usable]
            elif self._wanted(reading):
                extracted.append(Reading(self._anchor(reading, topic), float(value) * self.unit, quality, tag))
        return extracted

    def _tag(self, reading: Any, message: Any, topic: str) -> str:
        """Return the id of the tag that measured, '' where the message does not tell."""
        if self.tag.startswith("topic:"):
            match = re.search(self.tag.removeprefix("topic:"), topic)
            return match.group(1) if match and match.groups() else ""
        for name in (self.tag,) if self.tag else _TAGS:
            for holder in (reading, message):
                if name != self.anchor and isinstance(value := getattr(holder, name, None), str | Integral):
                    return self._name(value)
        return ""

    def _wanted(self, reading: Any, place: int | None = None) -> bool:
        """Return whether the fields of `only` have their values, in an array the value at a place."""
        values = ((_field(reading, name, self), wanted) for name, wanted in self.only.items())
        return all(int(v if place is None or not hasattr(v, "__len__") else v[place]) == wanted for v, wanted in values)

    def _anchor(self, reading: Any, topic: str) -> str:
        if self.anchor.startswith("topic:"):
            match = re.search(self.anchor.removeprefix("topic:"), topic)
            if match is None or not match.groups():
                raise ConfigError(f"uwb mapping: {self.anchor!r} finds no anchor id in the topic {topic}")
            return self._name(match.group(1))
        return self._name(_field(reading, self.anchor, self))

    def _name(self, value: Any) -> str:
        name = self.anchor_format.format(value if isinstance(value, str) else int(value))
        # The id is one word of a text line: blanks would tear it apart.
        return re.sub(r"\s+", "_", name.strip()) or "?"


class MissingField(ConfigError):
    """A message has not the field that a mapping names."""


def _field(message: Any, path: str, mapping: UwbMapping) -> Any:
    for name in path.split("."):
        if not hasattr(message, name):
            fields = [k for k in getattr(message, "__dataclass_fields__", {}) if not k.startswith("_")]
            near = "".join(f"; did you mean {n}?" for n in get_close_matches(name, fields, n=1))
            raise MissingField(
                f"uwb mapping for {mapping.topic}, type {mapping.type}: a message has no field {path!r};"
                f" it has {', '.join(fields)}{near}"
            )
        message = getattr(message, name)
    return message


def short_type(name: str) -> str:
    """Return ``pkg/Name`` of a message's type, as ROS 1 writes it, for ``pkg/msg/Name`` of ROS 2."""
    return name.replace("/msg/", "/")


def readings_of(message: Any, topic: str, mappings: Sequence[UwbMapping]) -> list[Reading]:
    """Return the readings of a message by the first mapping that finds some; raise MissingField where none finds its fields."""
    missing: MissingField | None = None
    understood = False
    for mapping in mappings:
        try:
            if readings := mapping.extract(message, topic):
                return readings
            understood = True
        except MissingField as error:
            missing = missing or error
    if missing is not None and not understood:
        raise missing
    return []


def fitting(topic: str, message_type: str, table: Sequence[UwbMapping]) -> tuple[UwbMapping, ...]:
    """Return the first mapping of a table that fits a topic, and with it the others of the same patterns."""
    first = next((m for m in table if m.fits(topic, message_type)), None)
    return () if first is None else tuple(m for m in table if (m.topic, m.type) == (first.topic, first.type))


def parse_mappings(text: str, path: str = "") -> tuple[UwbMapping, ...]:
    """Return the mappings of a TOML text; path is its name for error messages."""
    path = path or "uwb mapping"
    data = parse_toml(text, path)
    tables = data.get("uwb")
    if set(data) - {"uwb"} or not isinstance(tables, list) or not tables or not all(isinstance(each, dict) for each in tables):
        raise ConfigError(f"{path}: it must hold [[uwb]] tables and nothing else")
    try:
        return tuple(_checked(from_dict(UwbMapping, table)) for table in tables)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


_PLAIN_FORMAT = re.compile(r"[^{}]{0,40}\{(:[#0]*[0-9]{0,2}[a-zA-Z]?)?\}[^{}]{0,40}")
"""No attributes, and no widths that fill the memory."""


def _checked(mapping: UwbMapping) -> UwbMapping:
    if not _PLAIN_FORMAT.fullmatch(mapping.anchor_format):
        wrong = mapping.anchor_format[:40]
        raise ConfigError(f"anchor_format {wrong!r} is not text around one '{{}}' or such as '{{:04X}}'")
    try:
        mapping.anchor_format.format(0)
        re.compile(mapping.anchor)
    except (ValueError, IndexError, KeyError, re.error) as error:
        raise ConfigError(f"anchor or anchor_format of a uwb mapping is not valid: {error}") from None
    return mapping


_ANCHOR, _TAG, _UNKNOWN = ord("A"), ord("T"), ord("U")
"""How uwb_msgs/TwoWayRangeStamped calls the ends of a range."""


def _two_way(source: int, target: int) -> UwbMapping:
    """Return the mapping of a range between such ends: the anchor is the end that is not the tag."""
    anchor, tag = ("uwb_id1", "uwb_id2") if target == _TAG else ("uwb_id2", "uwb_id1")
    only = {"type_id1": source, "type_id2": target}
    return UwbMapping(type="uwb_msgs/TwoWayRangeStamped", anchor=anchor, tag=tag, range="range_raw", only=only)


KNOWN = (
    UwbMapping(topic="/uwb/anchor_*/range", type="sensor_msgs/Range", anchor="header.frame_id"),
    UwbMapping(type="mrpt_msgs/ObservationRangeBeacon", readings="sensed_data"),
    UwbMapping(type="gtec_msgs/PozyxRanging*", anchor="destinationId", unit=0.001, stamp=""),
    UwbMapping(type="gtec_msgs/PozyxRanging*", anchor="destination_id", unit=0.001, stamp=""),
    UwbMapping(type="gtec_msgs/*Ranging", anchor="anchorId", unit=0.001, stamp=""),
    UwbMapping(type="gtec_msgs/*Ranging", anchor="anchor_id", unit=0.001, stamp=""),
    UwbMapping(type="nlink_parser*/LinktrackNodeframe[23]", readings="nodes", tag="id", range="dis"),
    UwbMapping(type="nlink_parser*/LinktrackTagframe0", anchor="index", tag="id", range="dis_arr"),
    *(_two_way(*ends) for ends in ((_TAG, _ANCHOR), (_ANCHOR, _TAG), (_UNKNOWN, _ANCHOR), (_UNKNOWN, _UNKNOWN))),
    UwbMapping(type="uwb_msgs/TwoWayRangeStamped", anchor="UWB_ID2", tag="UWB_ID1", range="range_raw"),
    UwbMapping(type="*/UwbRange", anchor="responder_id", range="distance"),
    UwbMapping(type="pozyx_ros/DeviceRanges", readings="ranges", anchor="remote_device_id", range="distance"),
    UwbMapping(type="pozyx_msgs/Ranges", readings="ranges", anchor="remote_network_id", range="distance"),
    UwbMapping(type="pozyx*/DeviceRange", anchor="deviceId", range="distance", unit=0.001, anchor_format="{:04x}"),
    UwbMapping(type="bitcraze_lps_estimator/RangeArray", anchor="index", range="ranges", stamp="", only={"valid": 1}),
    UwbMapping(type="dwm1001*_ros*/UWBMeas", readings="measurements", range="dist", stamp=""),
    UwbMapping(type="*dwm1001*/Anchor", range="distance"),
    UwbMapping(type="mdek_uwb_driver/Uwb", readings="ranges", range="distance"),
    UwbMapping(type="mrs_msgs/RangeWithCovarianceArrayStamped", readings="ranges", range="range.range"),
    # Its time counts from the start of the flight controller.
    UwbMapping(type="px4_msgs/SensorUwb", anchor="mac_dest", range="distance", stamp="", anchor_format="{:04X}"),
    UwbMapping(
        topic="/uwb/*/distance", type="sensor_msgs/Range", anchor="topic:([^/]+)/distance$", tag="topic:([^/]+)/[^/]+/distance$"
    ),
)
