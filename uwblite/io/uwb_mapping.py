"""How UWB ranges stand in ROS messages: there is no standard, so a small table says where to look.

As TOML, one ``[[uwb]]`` table per kind of message; the first that fits a topic is used::

    [[uwb]]
    topic = "/beacon_raw"        # pattern of the topic's name, * and ? as in file names
    readings = "sensed_data"     # list within the message that holds the readings; "" = the message is one reading
    anchor = "id"                # field of the reading with the anchor's id
    range = "range"              # field of the reading with the distance
    unit = 1.0                   # metres per unit of it, 0.001 for millimetres
    stamp = "header.stamp"       # field of the message with the time; "" = when it was recorded
"""

import re
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any

from ..config import from_dict, parse_toml
from ..errors import ConfigError


@dataclass(frozen=True, slots=True)
class UwbMapping:
    """Where the ranges stand in one kind of message."""

    topic: str = "*"
    """Pattern of the topic's name, * and ? as in file names."""
    type: str = "*"
    """Pattern of the message's type, such as gtec_msgs/msg/Ranging."""
    readings: str = ""
    """Field of the message that holds a list of readings; empty: the message itself is one reading."""
    anchor: str = "id"
    """Field of the reading with the anchor's id; 'topic:REGEX' takes it from the first group in the topic's name;
    'index' takes the place in the array where the range is an array."""
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
    only: dict[str, int] = field(default_factory=dict)
    """Fields of the reading that must have these values, e.g. the tag's id where there are several tags."""

    def fits(self, topic: str, message_type: str) -> bool:
        """Tell whether the mapping is meant for a topic."""
        return fnmatchcase(topic, self.topic) and fnmatchcase(message_type, self.type)

    def extract(self, message: Any, topic: str) -> list[tuple[str, float, float]]:
        """Return (anchor id, range in m, quality) of every reading in a message.

        Raises
        ------
        ConfigError : the message has no such field.
        """
        readings = _field(message, self.readings, self) if self.readings else [message]
        found = []
        for reading in readings:
            if any(int(_field(reading, name, self)) != value for name, value in self.only.items()):
                continue
            value = _field(reading, self.range, self)
            quality = float(_field(reading, self.quality, self)) if self.quality else 100.0
            if self.anchor == "index":
                found += [(self._name(k), float(v) * self.unit, quality) for k, v in enumerate(value)]
            else:
                found.append((self._anchor(reading, topic), float(value) * self.unit, quality))
        return found

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


def _field(message: Any, path: str, mapping: UwbMapping) -> Any:
    for name in path.split("."):
        if not hasattr(message, name):
            known = ", ".join(k for k in getattr(message, "__dataclass_fields__", {}) if not k.startswith("_"))
            raise ConfigError(f"uwb mapping for {mapping.topic}: a message has no field {path!r}; it has {known}")
        message = getattr(message, name)
    return message


KNOWN = (
    # What `uwblite convert` itself writes.
    UwbMapping(topic="/uwb/anchor_*/range", type="sensor_msgs/msg/Range", anchor="header.frame_id"),
    UwbMapping(type="mrpt_msgs/msg/ObservationRangeBeacon", readings="sensed_data"),
    UwbMapping(type="gtec_msgs/msg/Ranging", anchor="anchorId", unit=0.001, stamp=""),
    UwbMapping(type="mrs_msgs/msg/RangeWithCovarianceArrayStamped", readings="ranges", range="range.range"),
    UwbMapping(type="dwm1001*_ros/msg/UWBMeas", readings="measurements", range="dist", stamp=""),
    UwbMapping(type="px4_msgs/msg/SensorUwb", anchor="mac_dest", range="distance", stamp="", anchor_format="{:04X}"),
    UwbMapping(topic="/uwb/*/distance", type="sensor_msgs/msg/Range", anchor="topic:([^/]+)/distance$"),
)
"""Mappings tried where the user gives none."""


def parse_mappings(text: str, path: str = "") -> tuple[UwbMapping, ...]:
    """Return the mappings of a TOML text; path is its name for error messages."""
    data = parse_toml(text, path)
    tables = data.get("uwb")
    if set(data) - {"uwb"} or not isinstance(tables, list) or not tables:
        raise ConfigError(f"{path or 'uwb mapping'}: it must hold [[uwb]] tables and nothing else")
    return tuple(_checked(from_dict(UwbMapping, table), path) for table in tables)


_PLAIN_FORMAT = re.compile(r"[^{}]{0,40}\{(:[#0]*[0-9]{0,2}[a-zA-Z]?)?\}[^{}]{0,40}")
"""No attributes, and no widths that fill the memory."""


def _checked(mapping: UwbMapping, path: str) -> UwbMapping:
    if not _PLAIN_FORMAT.fullmatch(mapping.anchor_format):
        wrong = mapping.anchor_format[:40]
        raise ConfigError(f"{path}: anchor_format {wrong!r} is not text around one '{{}}' or such as '{{:04X}}'")
    try:
        mapping.anchor_format.format(0)
        re.compile(mapping.anchor)
    except (ValueError, IndexError, KeyError, re.error) as error:
        raise ConfigError(f"{path}: anchor or anchor_format of a uwb mapping is not valid: {error}") from None
    return mapping
