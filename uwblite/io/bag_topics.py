"""Which topics of a bag hold wheels, scans, an IMU, ranges and transforms; and which may hold ranges that no mapping reads."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from ..errors import ConfigError
from .bag_motion import did_you_mean
from .uwb_mapping import KNOWN, MissingField, UwbMapping, fitting, readings_of, short_type
from .uwb_suggestions import as_toml, suggested

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
    topics : all of the bag.
    samples : gives the first messages of a topic.
    asked : topics that the user names.
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
            there = f"; of that type: {', '.join(fit)}" if fit else ", of which the bag has none"
            raise ConfigError(f"{name} is of type {short_type(given.type)}; {what} are read from {short_type(kind)}{there}")
    for name in asked.uwb:
        _topic(topics, name)
    others = (t for t in topics if t.name not in (odometry, scan) and t.type not in (IMU, TRANSFORMS))
    rest = [*others, *(t for t in topics if t.name in asked.uwb and t.name in (odometry, scan))]
    _check_mappings(rest, mappings)
    uwb, unread = {}, {}
    for t in rest:
        chosen = t.name in asked.uwb or not asked.uwb
        if chosen and (found := _usable(t, samples, mappings)):
            uwb[t.name] = found
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
    if own := fitting(topic.name, topic.type, mappings):
        return own
    known = fitting(topic.name, topic.type, KNOWN)
    try:
        for message in samples(topic.name) if known else ():
            readings_of(message, topic.name, known)
    except MissingField:
        return ()
    return known


def _topic(topics: Sequence[BagTopic], name: str) -> BagTopic:
    """Return the topic of a name.

    Raises
    ------
    ConfigError : there is none.
    """
    found = next((t for t in topics if t.name == name), None)
    if found is None:
        names = [t.name for t in topics]
        raise ConfigError(f"the bag has no topic {name}; {did_you_mean(name, names)}it has {', '.join(names)}")
    return found


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
