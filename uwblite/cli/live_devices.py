"""Devices for `uwblite localize --live`: the recorder of `uwblite record`, whose lines go to the localiser and to no file."""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

from ..drivers.log_file import LogFile
from ..drivers.recorder import Recorder
from .named_devices import device_links, host_name, show_note


class LinesTo(LogFile):
    """A log that is written nowhere."""

    def __init__(self, take: Callable[[bytes], None]) -> None:
        self._take = take
        self.head, self.path, self.first, self.bytes, self.part = [], Path("-"), Path("-"), 0, 1

    def write(self, lines: list[str]) -> None:
        """Hand lines on."""
        if lines:
            data = ("\n".join(lines) + "\n").encode("ascii", "replace")
            self.bytes += len(data)
            self._take(data)

    def restore(self) -> bool:
        """Return False: nothing can be deleted."""
        return False

    def close(self) -> None:
        """Nothing is open."""


def record_into(
    args: argparse.Namespace, take: Callable[[bytes], None], stopping: Callable[[], bool], wait: Callable[[], None]
) -> None:
    """Read devices until asked to stop, and hand on what `uwblite record` would write; wait is called meanwhile."""
    links = device_links(args)
    offset = time.time() - time.monotonic()
    recorder = Recorder(links, LinesTo(take), monotonic=time.monotonic, wall_offset=offset, host=host_name(), on_note=show_note)
    recorder.begin([])
    recorder.run(duration=None, stopping=stopping, on_status=wait)
