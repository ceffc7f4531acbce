"""Requests and replies that RPLIDAR and YDLIDAR share. Sans-I/O.

A request is ``A5 command``, with a payload ``A5 command length payload xor``. A reply is::

    A5 5A | length (30 bits) and mode (2 bits, 1 = a stream follows), little-endian | type | payload

Source: Slamtec, RPLIDAR interface protocol and application notes, and its SDK.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from .events import Action, Note, Param, Send
from .session import Identity, Script
from .spinning import SpinningDriver

SYNC = 0xA5
INFO_REPLY, HEALTH_REPLY = 0x04, 0x06
HEALTH = ("good", "warning", "error")
HEAD = b"\xa5\x5a"
DESCRIPTOR = 7


@dataclass(frozen=True, slots=True)
class Reply:
    """What the lidar answered."""

    kind: int
    """Type of the reply."""
    payload: bytes
    """Empty where a stream begins."""


def request(command: int, payload: bytes = b"") -> bytes:
    """Return the bytes of a request; a payload has at most 255 bytes, and its length and checksum are added."""
    if not payload:
        return bytes((SYNC, command))
    body = bytes((SYNC, command, len(payload))) + payload
    total = 0
    for byte in body:
        total ^= byte
    return body + bytes([total])


def reply_size(buffer: bytearray, offset: int, kinds: dict[int, int]) -> int:
    """Return the size of a reply at `offset`, of which each kind has one length of payload; 0 = wait, -1 = none begins here."""
    head = bytes(buffer[offset : offset + DESCRIPTOR])
    if head[:2] != HEAD[: len(head)]:
        return -1
    if len(head) < DESCRIPTOR:
        return 0
    word, kind = struct.unpack_from("<IB", head, 2)
    length, streams = word & 0x3FFFFFFF, bool(word >> 30)
    # Whoever says who it is says it once: a stream of that is a bit that has turned over.
    if kinds.get(kind) != length or (streams and kind in (INFO_REPLY, HEALTH_REPLY)):
        return -1
    size = DESCRIPTOR + (0 if streams else length)
    return size if offset + size <= len(buffer) else 0


def decode_reply(data: bytes) -> Reply:
    return Reply(data[DESCRIPTOR - 1], data[DESCRIPTOR:])


def answers(kind: int) -> Callable[[Any], bool]:
    """Return what distinguishes a reply of a kind from other events."""
    return lambda event: isinstance(event, Reply) and event.kind == kind


class SlamtecDriver(SpinningDriver):
    """What RPLIDAR and YDLIDAR share: who are you, how are you."""

    def take(self, event: Any) -> list[Action]:
        """Return the scans of a lidar that is known; before, they are those of a dead host's stream."""
        return super().take(event) if self.facts else []

    def greet(self, info: bytes, health: bytes) -> Script[bool]:
        """Ask for model and health; False = nobody answers."""
        reply = yield from self.ask(info, answers(INFO_REPLY), 0.5, 2)
        if reply is None:
            return False
        model, minor, major, hardware = reply.payload[:4]
        serial = reply.payload[4:].hex().upper()
        self.facts = {"product": f"{self.title}, model {model}", "firmware": f"{major}.{minor:02d}", "serial": serial}
        self.facts["hardware"] = str(hardware)
        for name in ("product", "firmware", "serial"):
            yield Param(f"laser_{name}", self.facts[name].replace(" ", "_"))
        reply = yield from self.ask(health, answers(HEALTH_REPLY), 0.5, 2)
        self.facts["health"] = HEALTH[min(reply.payload[0], 2)] if reply is not None else "unknown"
        yield from self.say_once(*self._findings())
        return True

    def _findings(self) -> tuple[Note, ...]:
        health = self.facts.get("health")
        if health not in ("warning", "error"):
            return ()
        text = f"lidar: it reports its health as {health}: see that nothing holds the motor, power it down and up"
        return (Note(health, "lidar-health", text),)

    def begin_stream(self, command: bytes, kind: int) -> Script[bool]:
        """Ask for a stream, which goes on from no reading before it; False = none is announced."""
        self.is_new_stream = (yield from self.ask(command, answers(kind), 0.5, 2)) is not None
        return self.is_new_stream

    def quiet(self, stop: bytes) -> Script[None]:
        """Stop the stream of a dead host and let it drain."""
        yield Send(stop)
        yield from self.sleep(0.1)

    def identity(self) -> Identity:
        return Identity(self.title, tuple(self.facts.items()), self._findings())
