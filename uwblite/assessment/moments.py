"""Where in the recordings a finding about keyframes lies, and the command that leaves that part out."""

from dataclasses import replace

from ..findings import Finding
from ..pipeline.recordings import Recordings


def seconds(recordings: Recordings, keyframe: int) -> float:
    """Return the time of a keyframe since the first one of its recording, s."""
    first = int((recordings.of_keyframe == recordings.of_keyframe[keyframe]).argmax())
    return float(recordings.stamps[keyframe] - recordings.stamps[first])


def between_keyframes(finding: Finding, recordings: Recordings, *spans: tuple[int, int]) -> Finding:
    """Return a finding that concerns the stretches from one keyframe to another, with the command that leaves them out.

    Parameters
    ----------
    spans : first and last keyframe of each stretch, in one recording; there is one at least.
    """
    stretches = tuple((float(recordings.stamps[first]), float(recordings.stamps[last])) for first, last in spans)
    begin, end = seconds(recordings, spans[0][0]), seconds(recordings, spans[-1][1])
    number = int(recordings.of_keyframe[spans[0][0]]) + 1
    return replace(finding, recording=number, stretches=stretches, cure=parts_beside(begin, end))


def parts_beside(begin: float, end: float) -> str:
    """Return what cuts a recording before and after a stretch, s since its start."""
    return (
        f"`end={begin:.0f}` and `start={end:.0f}` give the parts before and after it; "
        "map each, or both together where they have anchors in common"
    )
