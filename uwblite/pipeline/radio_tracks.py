"""Ranges of each radio along the path, with what its places are explained by."""

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Ints
from ..radio.place_evidence import MovePolicy, PlaceModel, Track
from ..radio.place_intervals import explain
from ..radio.range_noise import short_term_sigma
from ..sensor_log.sensors import radio_name
from .estimate import Estimate, Task


@dataclass(frozen=True, slots=True, eq=False)
class RadioTrack:
    """One radio's ranges."""

    name: str
    numbers: tuple[int, ...]
    """Of the graph's anchors that are its places, the first one first."""
    rows: Ints
    """(m,) of the estimate's ranges, in the order of recordings and of time."""
    chosen: Ints
    """Those of them (indices into rows) of which the track is."""
    pose: Ints
    """Keyframe of each range of the track."""
    model: PlaceModel
    """Of the track."""

    @property
    def track(self) -> Track:
        """The ranges that are explained."""
        return self.model.track

    def inside(self, begin: int, end: int) -> Ints:
        """Return which ranges of the track are from keyframes begin <= k < end."""
        return np.flatnonzero((self.pose >= begin) & (self.pose < end))


def radio_tracks(estimate: Estimate, task: Task) -> list[RadioTrack]:
    """Return the radios that have a place, with their ranges along the estimate's path."""
    ranges, ids, config = estimate.ranges, estimate.anchor_ids, task.config
    assert ranges is not None
    # Prior knowledge of the user refers to anchors by their present numbers.
    tied = bool(task.constraints.anchors or task.constraints.distances)
    names = [name if tied or radio_name(name) not in ids else radio_name(name) for name in ids]
    recording, positions = task.recordings.of_keyframe[ranges.pose], ranges.tag_positions(estimate.graph.poses)
    used = ranges.alive & estimate.placed[ranges.anchor]
    values = np.append(estimate.graph.calibration.values, 0.0)[ranges.calibration]
    level = replace(ranges, ranges=ranges.corrected / (1.0 + values[:, 0]), late=np.zeros(0)).planar_ranges()
    of_each, true = ranges.anchor + len(ids) * recording, ranges.corrected / (1.0 + values[:, 0])
    sigma = short_term_sigma(ranges.stamps[used], of_each[used], true[used], config.ranges)
    radios = []
    for name in dict.fromkeys(names):
        numbers = tuple(k for k, other in enumerate(names) if other == name)
        rows = np.flatnonzero(used & np.isin(ranges.anchor, numbers))
        rows = rows[np.lexsort((ranges.stamps[rows], recording[rows]))]
        if not len(rows):
            continue
        chosen = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MovePolicy.most_ranges)).round().astype(np.intp))
        sample = rows[chosen]
        unknown = ranges.calibration[sample[0], 2] >= 0
        height = float(np.sqrt(max(values[sample[0], 2], 0.0)))
        heights = (height, *(h for h in (0.0, *MovePolicy.heights) if h != height)) if unknown else (0.0,)
        track = Track(positions[sample], level[sample], recording[sample], sigma, heights)
        model = PlaceModel(track, config.trilateration, config.ranges)
        radios.append(RadioTrack(name, numbers, rows, chosen, ranges.pose[sample], model))
    return radios


def range_evidence(estimate: Estimate, task: Task) -> float:
    """Return the logarithm of the evidence of all ranges along the estimate's path, their anchors placed anew."""
    return sum(explain(radio.model).evidence for radio in radio_tracks(estimate, task))
