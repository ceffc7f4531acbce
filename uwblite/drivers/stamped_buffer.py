"""Bytes held until they complete a frame, and when each of them arrived."""


class StampedBuffer:
    """Bytes in the order of their arrival. Frames may come in pieces: each byte keeps the stamp of its own piece."""

    def __init__(self) -> None:
        self.data = bytearray()
        self._marks: list[tuple[int, float]] = []

    def append(self, piece: bytes, stamp: float) -> None:
        """Hold a piece that arrived at `stamp`, s."""
        self._marks.append((len(self.data), stamp))
        self.data += piece

    def stamp_at(self, offset: int) -> float:
        """Return the arrival of the byte at `offset`, s; noise before a frame must not lend it its time."""
        return next(when for at, when in reversed(self._marks) if at <= offset)

    def drop(self, count: int) -> None:
        """Forget the first bytes."""
        if count >= len(self.data):
            self.clear()
        elif count:
            self._marks = [(0, self.stamp_at(count))] + [(at - count, when) for at, when in self._marks if at > count]
            del self.data[:count]

    def clear(self) -> None:
        """Forget all bytes."""
        self.data.clear()
        self._marks.clear()
