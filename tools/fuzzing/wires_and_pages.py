"""What comes down a device's wire, what is asked of a page, and the files of a result that a page shows."""

import contextlib
import io
import json
import socket
import tempfile
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from uwblite.cli import main
from uwblite.drivers.devices import DEVICES, open_device
from uwblite.errors import UwbliteError
from uwblite.io.stored_result import read_result
from uwblite.server.app import App
from uwblite.server.web import server_for

from .device_words import WORDS

LINE_OPTIONS = "?columns=t,x,y,theta"
"""Which columns a line of odometry has is the user's to say."""
RESULT = (
    "report.json", "trajectory.tum", "trajectory_covariance.csv", "anchors.csv", "range_errors.csv", "map.yaml", "map.pgm",
)  # fmt: skip
"""Files of a result that are read back."""
_PATIENCE = 15.0
"""s that a page may take to answer."""


def wire(name: str) -> bytes:
    """Return what a device might say: all its words, in order and backwards, in pieces that fit and do not."""
    words = WORDS.get(name, WORDS["line"])
    return b"".join([*words, *words[::-1], bytes(7), *words]) * 6


def listen(name: str) -> Callable[[Path], object]:
    """Return what feeds a session of a device with bytes, in pieces of many sizes, while time goes on."""

    def read(path: Path) -> object:
        data, now, at, taken = path.read_bytes(), 0.0, 0, 0
        session = open_device(DEVICES[name].sensor, f"{name}:/dev/null" + LINE_OPTIONS * (name == "line"))[0]
        session.start(now)
        while at < len(data):
            size = 1 + (7 * at + len(data)) % 61
            taken += len(session.feed(data[at : at + size], now)) + len(session.tick(now))
            at, now = at + size, now + (0.001, 0.1, 1.2)[size % 3]
        session.stop()
        return taken

    return read


DEVICE_OPTIONS = b"\n".join(
    [f"{d.sensor} {name}:/dev/ttyUSB0".encode() for name, d in DEVICES.items() if not name.endswith("line")]
    + [b"uwb linktrack:/dev/ttyUSB0?baud=115200", b"uwb tlv:socket://[::1]:99?timeout=3"]
    + [b"odometry line:socket://robot:99?columns=t,left,right&tick=1.2e-4&wheel_base=0.3&time_unit=0%2E001"]
    + [b"gyro line:/dev/x?columns=t,turn_rate&time_unit=0.001"]
)  # fmt: skip
"""Devices as `uwblite record` names them, with options, one a line."""


def open_named(path: Path) -> object:
    """Make a session of every device that is named in a file; bytes that are no text come as the command line has them."""
    opened, refused = 0, list[UwbliteError]()
    for line in path.read_bytes().decode(errors="surrogateescape").split("\n"):
        sensor, _, spec = line.partition(" ")
        try:
            opened += len(open_device(sensor, spec))
        except UwbliteError as error:
            refused.append(error)
    if refused:
        raise refused[0]
    return opened


@cache
def _result(log: bytes) -> dict[str, bytes]:
    """Return the files of the result of a recording."""
    with tempfile.TemporaryDirectory(prefix="fuzz-result-") as made:
        (Path(made) / "x.log").write_bytes(log)
        with contextlib.redirect_stdout(io.StringIO()):
            code = main(["map", f"{made}/x.log", "--out", f"{made}/map", "-q"])
        if code not in (0, 3):
            raise RuntimeError("the small recording cannot be mapped")
        return {path.name: path.read_bytes() for path in (Path(made) / "map").iterdir() if path.is_file()}


def result_of(log: bytes) -> Callable[[Path], object]:
    """Return what writes the result of a recording into a folder, and requests for its page."""

    def prepare(folder: Path) -> None:
        for name, data in _result(log).items():
            (folder / name).write_bytes(data)
        (folder / "good.log").write_bytes(log)
        (folder / "requests").write_bytes(_REQUESTS)

    return prepare


def _page(folder: Path) -> App:
    def no_job(words: Any) -> Any:
        raise AssertionError(f"a job was begun: {words}")

    return App([read_result(folder)], {}, folder / "edits.toml", no_job)


def show(path: Path) -> object:
    """Read a result and answer what its page asks for."""
    page = _page(path.parent)
    page.host = "127.0.0.1:8000"
    headers = {"host": page.host}
    for target in ("/", "/state", "/result/0/map.png", "/0/map.png"):
        answer = page.handle("GET", target, headers)
        if answer.status >= 500:
            raise AssertionError(f"{target}: {answer.status}")
        if answer.kind == "application/json":
            json.loads(answer.body, parse_constant=_refused)
    return page


def _refused(word: str) -> None:
    raise AssertionError(f"{word} is no JSON")


def ask(path: Path) -> object:
    """Send requests to a page on a socket; whatever they are, it must answer, or end the connection, and live on."""
    failed: list[str] = []
    page = _page(path.parent)
    server = server_for(page)
    server.handle_error = lambda *_: failed.append("an exception in a handler")  # type: ignore[method-assign]
    running = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    running.start()
    try:
        said = _answers(path.read_bytes().replace(b"127.0.0.1:8000", page.host.encode()), server.server_port)
        alive = _answers(f"GET /state HTTP/1.1\r\nHost: {page.host}\r\nConnection: close\r\n\r\n".encode(), server.server_port)
    finally:
        server.shutdown()
        server.server_close()
    if b"Traceback" in said or b" 500 " in said.partition(b"\r\n")[0] or b" 200 " not in alive.partition(b"\r\n")[0]:
        raise AssertionError(f"answered with {said[:80]!r} and then {alive[:80]!r}")
    if failed:
        raise AssertionError(failed[0])
    return said


def _answers(asked: bytes, port: int) -> bytes:
    """Return all that is answered until the connection ends."""
    said = b""
    with socket.create_connection(("127.0.0.1", port), _PATIENCE) as wire:
        try:
            wire.sendall(asked)
            wire.shutdown(socket.SHUT_WR)
            while piece := wire.recv(1 << 16):
                said += piece
        except ConnectionError:
            # It was turned away before it had said all.
            return said
    return said


_HEAD = b"Host: 127.0.0.1:8000\r\nAccept: */*\r\n"
_JSON = b'{"result": 0, "closure": 0, "wish": "reject"}'
_REQUESTS = b"".join(
    [
        b"GET / HTTP/1.1\r\n" + _HEAD + b"\r\n",
        b"GET /state HTTP/1.1\r\n" + _HEAD + b"\r\n",
        b"HEAD /0/map.png HTTP/1.1\r\n" + _HEAD + b"\r\n",
        b"GET /0/..%2f..%2fetc/passwd HTTP/1.1\r\n" + _HEAD + b"\r\n",
        b"POST /closure HTTP/1.1\r\n" + _HEAD + b"X-Token: TOKEN\r\nContent-Type: application/json\r\n",
        b"Content-Length: %d\r\n\r\n" % len(_JSON) + _JSON,
        b"POST /map HTTP/1.1\r\n" + _HEAD + b'Transfer-Encoding: chunked\r\n\r\n5\r\n{"a":\r\n0\r\n\r\n',
        b"GET /state HTTP/1.1\r\n" + _HEAD + b"Connection: close\r\n\r\n",
    ]
)
