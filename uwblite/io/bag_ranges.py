"""Ranges in a bag: to anchors, by one tag of the robot or several, and those between other nodes, which are none of ours."""

from collections import Counter
from typing import Any

import numpy as np

from ..arrays import Floats
from ..sensor_log import UwbRanges, fault_of_id
from .bag_frames import Frames
from .uwb_mapping import Reading

_USUAL_FRAMES = ("uwb_tag", "uwb_link", "uwb", "tag")
_MOST_TAGS = 9
"""Tags on one robot that a log keeps apart."""


class RangeReadings:
    """Collects the readings of all topics."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, Reading, str]] = []
        self._frames: dict[str, Counter[str]] = {}

    def __len__(self) -> int:
        return len(self._rows)

    def take(self, stamp: float, readings: list[Reading], message: Any, kind: str = "") -> None:
        """Take the readings of a message; ids are names of nodes within the messages of one kind."""
        self._rows += [(stamp, reading, kind) for reading in readings]
        if hasattr(message, "header"):
            for tag in {reading.tag for reading in readings}:
                self._frames.setdefault(tag, Counter())[message.header.frame_id] += 1

    def ranges(self, offset: float, warnings: list[str]) -> tuple[UwbRanges | None, tuple[str, ...]]:
        """Return the ranges, moved in time by an offset, s, and the tags that measured them, '' where none is named."""
        faults = {name: fault for name in {r.anchor for _, r, _ in self._rows} if (fault := fault_of_id(name))}
        if faults:
            count = sum(r.anchor in faults for _, r, _ in self._rows)
            warnings.append(f"{count} ranges were left out: the anchor's id {faults[min(faults)]}")
        sound = [row for row in self._rows if np.isfinite((row[0], row[1].range, row[1].quality)).all()]
        sound = [row for row in sound if row[1].anchor not in faults]
        rows = [(t, r) for kind in sorted({row[2] for row in sound}) for t, r in _of_the_robot(sound, kind, warnings)]
        if not rows:
            return None, ()
        tags, ids = tuple(sorted({r.tag for _, r in rows})), tuple(sorted({r.anchor for _, r in rows}))
        if len(tags) > 1:
            named = ", ".join(tag or "without name" for tag in tags)
            warnings.append(f"{len(tags)} tags measured ({named}); the ranges of each are kept apart (UWB, UWB2 ...)")
        stamps = np.array([t for t, _ in rows]) + offset
        order = np.argsort(stamps, kind="stable")
        anchor, tag = (np.array([names[n] for n in column], dtype=np.intp) for names, column in (
            ({name: k for k, name in enumerate(ids)}, [r.anchor for _, r in rows]),
            ({name: k for k, name in enumerate(tags)}, [r.tag for _, r in rows]),
        ))  # fmt: skip
        metres, quality = np.array([r.range for _, r in rows]), np.array([r.quality for _, r in rows])
        whose = tag[order] if len(tags) > 1 else None
        return UwbRanges(stamps[order], anchor[order], metres[order], quality[order], ids, whose), tags

    def places(self, tags: tuple[str, ...], frames: Frames, base: str, warnings: list[str]) -> Floats:
        """Return where the tags sit on the robot (t, 3), m, by the transforms; the middle of the robot where these do not tell.

        Messages name the tag's frame, or the anchor's; then the usual names are tried.
        """
        found, unknown = [], []
        for tag in tags:
            named = [name for name, _ in self._frames.get(tag, Counter[str]()).most_common(1)]
            usual = [f"uwb_{tag}", f"tag_{tag}", tag] if len(tags) > 1 else list(_USUAL_FRAMES)
            poses = (frames.pose(base, name) for name in (*named, *usual) if name)
            pose = next((p for p in poses if p is not None), None)
            found.append(np.zeros(3) if pose is None else pose[:3, 3].copy())
            unknown += [tag] if pose is None else []
        if unknown and len(tags) > 1:
            warnings.append(
                f"no transform to the tags {', '.join(unknown)}: they are taken to sit in the middle of the robot, on the"
                " floor; convert to a .log and write PARAM uwb_tag_offset_x, uwb2_tag_offset_x ... (docs/formats.md)"
            )
        elif unknown:
            warnings.append(
                "no transform to the UWB tag: it is taken to sit in the middle of the robot, on the floor; give --tag X,Y,Z"
            )
        return np.array(found).reshape(-1, 3)


def _of_the_robot(every: list[tuple[float, Reading, str]], kind: str, warnings: list[str]) -> list[tuple[float, Reading]]:
    """Return stamps and ranges of one kind of messages without those between other nodes.

    Tags that others range to as to an anchor are not on this robot. Where all tags are such, the one that measured most is the
    robot's.
    """
    rows = [(t, r) for t, r, k in every if k == kind]
    by_tag, anchors = Counter(r.tag for _, r in rows), {r.anchor for _, r in rows}
    ranked = sorted(by_tag, key=lambda tag: (-by_tag[tag], tag))
    own = ([tag for tag in ranked if tag not in anchors] or ranked[:1])[:_MOST_TAGS]
    others = Counter(f"{r.tag} to {r.anchor}" for _, r in rows if r.tag not in own)
    if others:
        shown = ", ".join(name for name, _ in others.most_common(3))
        warnings.append(
            f"{others.total()} ranges between other nodes ({shown}{' ...' if len(others) > 3 else ''}) were left out: the tag"
            f" on the robot is taken to be {', '.join(sorted(own))}"
        )
    return [(t, r) for t, r in rows if r.tag in own]
