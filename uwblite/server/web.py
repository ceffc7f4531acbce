"""Pages on a socket: answers, the rules for access, and the standard library's HTTP server.

A page is for this computer alone unless it is opened to the network on purpose. In either case a request must name the
server as its Host by an address or a name that it has: a page elsewhere whose own name is resolved to this computer cannot
(DNS rebinding). A request of another page carries a foreign Origin and is refused. What changes anything must be a POST
with JSON and the token that only the served page knows.

Connections, threads and what a request may bring are bounded. Where all places are taken, the connection that has asked for
nothing for the longest time gives way: neither half requests nor streams that nobody reads keep others out, and a browser whose
stream was ended opens it again.
"""

import io
import ipaddress
import json
import secrets
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from email.errors import FirstHeaderLineIsContinuationDefect, MissingHeaderBodySeparatorDefect
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote

from ..errors import UwbliteError

LOOPBACK = "127.0.0.1"
MOST_BYTES = 1 << 16
"""Of a request's body."""
MOST_CONNECTIONS = 64
"""At one time; each takes a thread, and those that gave way keep theirs until they notice. A browser opens six."""
_MOST_HEAD = 1 << 15
"""Bytes of a request's first line and headers."""
_PATIENCE = 10.0
"""s that a connection may stay silent, or not take what is sent to it."""
_FULL = b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 5\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_INLINE = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; "
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
HTML, TEXT, PNG, JSON = "text/html; charset=utf-8", "text/plain; charset=utf-8", "image/png", "application/json"


@dataclass(frozen=True, slots=True)
class Response:
    """What is sent back."""

    kind: str
    body: bytes
    status: HTTPStatus = HTTPStatus.OK
    policy: str = f"{_INLINE}img-src 'self' data:; connect-src 'self'; frame-ancestors 'none'"
    stream: Callable[[], Iterator[bytes]] | None = None
    """In place of a body: what goes out piece by piece for as long as somebody listens."""


REPORT_POLICY = f"sandbox allow-scripts; {_INLINE}img-src data:"
"""Of a report, which brings its own styles and scripts and may do nothing else."""


class Page(ABC):
    """What a server answers for."""

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(24)
        self.host = ""
        """Name and port under which the page is asked for, such as 127.0.0.1:8000."""
        self.names: tuple[str, ...] | None = None
        """Under which other computers may ask, beside addresses; None = this computer alone may."""

    @abstractmethod
    def get(self, path: str) -> Response | None:
        """Return what is found at a path."""

    def post(self, path: str, body: bytes) -> Response | None:
        """Change something, and return the answer; by default nothing can be changed."""
        return None

    def handle(self, method: str, target: str, headers: dict[str, str], body: bytes = b"") -> Response:
        """Answer a request; names of headers are in lower case."""
        if refused := refusal(self, self.token, method, headers):
            return refused
        path = unquote(target.partition("?")[0].partition("#")[0]) if target.startswith("/") else ""
        try:
            found = self.post(path, body) if method == "POST" else self.get(path)
        except UwbliteError as error:
            return json_response({"error": str(error)}, HTTPStatus.BAD_REQUEST)
        return found or text_response("there is no such page", HTTPStatus.NOT_FOUND)


def refusal(page: Page, token: str, method: str, headers: dict[str, str]) -> Response | None:
    """Return the answer to a request that must not be answered; None where it may be."""
    host, why, status = headers.get("host", ""), "", HTTPStatus.FORBIDDEN
    kind = headers.get("content-type", "").partition(";")[0].strip()
    if not _is_ours(page, host):
        why = "this page is for this computer only" if page.names is None else "no such name here"
    elif headers.get("origin") not in (None, f"http://{host}") or headers.get("sec-fetch-site") not in _OWN_SITES:
        why = "another page may not ask"
    elif method not in ("GET", "HEAD", "POST"):
        why, status = "only GET, HEAD and POST are answered", HTTPStatus.METHOD_NOT_ALLOWED
    elif method == "POST" and not secrets.compare_digest(headers.get("x-token", "").encode(), token.encode()):
        why = "the token is missing: reload the page"
    elif method == "POST" and kind != JSON:
        why, status = "a POST must be application/json", HTTPStatus.UNSUPPORTED_MEDIA_TYPE
    return text_response(why, status) if why else None


_OWN_SITES = (None, "same-origin", "none")


def _is_ours(page: Page, host: str) -> bool:
    """Return whether a host and port are the server's; of one that is open every address is: no foreign name is one."""
    if host.endswith("]") or ":" not in host:
        host += ":80"  # which browsers leave out
    name, _, port = host.rpartition(":")
    if port != page.host.rpartition(":")[2]:
        return False
    return host == page.host or name == "localhost" or (page.names is not None and (name in page.names or _is_address(name)))


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def json_response(value: Any, status: HTTPStatus = HTTPStatus.OK) -> Response:
    return Response(JSON, json.dumps(value, allow_nan=False).encode(), status)


def text_response(text: str, status: HTTPStatus) -> Response:
    return Response(TEXT, text.encode(), status)


class _Server(ThreadingHTTPServer):
    """A server that turns away what is too much at one time."""

    daemon_threads = True
    request_queue_size = MOST_CONNECTIONS

    def __init__(self, address: tuple[str, int], page: Page) -> None:
        self.page, self.lock = page, threading.Lock()
        self._room = threading.BoundedSemaphore(2 * MOST_CONNECTIONS)
        self._open: dict[socket.socket, bool] = {}
        """Whether each connection has asked for something; the one that has been at rest the longest comes first."""
        self._order = threading.Lock()
        super().__init__(address, _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._room.acquire(blocking=False):
            _turn_away(request, asked=False)
            self.shutdown_request(request)
            return
        with self._order:
            self._open[request] = False
            if len(self._open) > MOST_CONNECTIONS:
                oldest = next(iter(self._open))
                _turn_away(oldest, self._open.pop(oldest))
        super().process_request(request, client_address)

    def asked(self, request: socket.socket) -> None:
        """Note that a connection has asked for something just now."""
        with self._order:
            if self._open.pop(request, None) is not None:
                self._open[request] = True

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._order:
                self._open.pop(request, None)
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a client that leaves is no error of ours."""


def _turn_away(request: socket.socket, asked: bool) -> None:
    """End a connection, with a word where no answer has begun."""
    with suppress(OSError):
        if not asked:
            request.send(_FULL, getattr(socket, "MSG_DONTWAIT", 0))
        request.shutdown(socket.SHUT_RDWR)


class _Input(io.BufferedReader):
    """What a connection sends, with a limit for the lines of a request."""

    left = _MOST_HEAD
    """Bytes that they may still have."""

    def readline(self, size: int | None = -1, /) -> bytes:
        line = super().readline(self.left + 1)
        self.left -= len(line)
        # A line that the standard library refuses, with an answer, stands for any that is too much.
        return line if self.left >= 0 else b" " * (1 << 17)


class _Handler(BaseHTTPRequestHandler):
    """Answers requests by the server's page, one at a time."""

    server: _Server
    protocol_version = "HTTP/1.1"
    timeout = _PATIENCE
    rbufsize = 0

    def setup(self) -> None:
        super().setup()
        self.rfile = self._input = _Input(self.rfile)

    def handle_one_request(self) -> None:
        self._input.left = _MOST_HEAD
        super().handle_one_request()

    def do_GET(self) -> None:
        """Answer a request, or close the connection: where a request ends must not be a matter of opinion."""
        length = self.headers.get("Content-Length", "0" if self.command != "POST" else "")
        number = length.isascii() and length.isdigit()
        # No number of more digits is looked at: reading it may take long.
        size = int(length) if number and len(length) <= len(str(MOST_BYTES)) else MOST_BYTES + 1
        if fault := self._fault(empty=size == 0) or ("" if number else "a length is a number"):
            self._refuse(HTTPStatus.BAD_REQUEST, fault)
        elif size > MOST_BYTES:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "too long")
        else:
            self._answer(self.rfile.read(size))

    do_POST = do_HEAD = do_PUT = do_DELETE = do_OPTIONS = do_GET

    def _fault(self, empty: bool) -> str:
        """Return why the head of a request cannot be trusted (RFC 9112, sections 3.2, 5.1 and 6.3), "" where it can."""
        # What follows such a line was not read as headers; other defects are those of a body in parts.
        if any(isinstance(defect, (FirstHeaderLineIsContinuationDefect, MissingHeaderBodySeparatorDefect))
               for defect in self.headers.defects):
            return "a line of the head is no header"
        for name in ("Host", "Content-Length"):
            if len(self.headers.get_all(name, ())) > 1:
                return f"more than one {name}"
        if "Transfer-Encoding" in self.headers:
            return "a body is sent with its length"
        return "" if empty or self.command == "POST" else "only a POST has a body"

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self.close_connection = True
        self._send(text_response(why, status))

    def _answer(self, body: bytes) -> None:
        self.server.asked(self.connection)
        headers = {name.lower(): value for name, value in self.headers.items()}
        with self.server.lock:
            response = self.server.page.handle(self.command, self.path, headers, body)
        self._send(response)

    def _send(self, response: Response) -> None:
        self.send_response(response.status)
        self.send_header("Content-Type", response.kind)
        if response.stream is None:
            self.send_header("Content-Length", str(len(response.body)))
        self.close_connection |= response.stream is not None
        if self.close_connection:
            self.send_header("Connection", "close")
        for name, value in (*_HEADERS.items(), ("Content-Security-Policy", response.policy)):
            self.send_header(name, value)
        self.end_headers()
        if self.command == "HEAD":
            return
        self.wfile.write(response.body)
        for piece in response.stream() if response.stream is not None else ():
            self.wfile.write(piece)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the page itself shows what went wrong."""


def server_for(page: Page, port: int = 0, host: str = LOOPBACK, names: tuple[str, ...] = ()) -> ThreadingHTTPServer:
    """Return a server that answers for a page; `serve_forever` runs it.

    Parameters
    ----------
    page : its `host` is set, and its `names` where it is open to others.
    host : the address to listen on; 0.0.0.0 is the whole network.
    names : under which other computers may ask, beside addresses.

    Raises
    ------
    OSError : the port is taken, or the address is none of this computer's.
    """
    server = _Server((host, port), page)
    page.names = None if host in (LOOPBACK, "localhost") else names
    page.host = f"{host}:{server.server_address[1]}"
    return server
