"""A page on a socket: the standard library's HTTP server, on the loopback address where nothing else is asked for."""

import threading
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from .requests import Page, Response

LOOPBACK = "127.0.0.1"
MOST_BYTES = 1 << 16
"""Of a request's body."""
MOST_CONNECTIONS = 64
"""At one time; each takes a thread. A browser opens six."""
_PATIENCE = 10.0
"""s that a connection may stay silent, or not take what is sent to it."""
_FULL = b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 5\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_PAGE = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src 'self' data:; connect-src 'self';"
    " frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
_REPORT = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:;"
    " base-uri 'none'; form-action 'none'"
)


class _Server(ThreadingHTTPServer):
    """A server that turns away what is too much at one time."""

    daemon_threads = True
    request_queue_size = MOST_CONNECTIONS

    def __init__(self, address: tuple[str, int], page: Page) -> None:
        self.page, self.lock = page, threading.Lock()
        self._room = threading.BoundedSemaphore(MOST_CONNECTIONS)
        super().__init__(address, _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._room.acquire(blocking=False):
            with suppress(OSError):
                request.setblocking(False)
                request.send(_FULL)
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a client that leaves is no error of ours."""


class _Handler(BaseHTTPRequestHandler):
    """Answers requests by the server's page, one at a time."""

    server: _Server
    protocol_version = "HTTP/1.1"
    timeout = _PATIENCE

    def do_GET(self) -> None:
        self._answer(b"")

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()) or len(length) > 9 or int(length) > MOST_BYTES:
            self.close_connection = True
            self._send(Response(413, "text/plain", b"too long"))
            return
        self._answer(self.rfile.read(int(length)))

    do_HEAD = do_PUT = do_DELETE = do_OPTIONS = do_GET

    def _answer(self, body: bytes) -> None:
        headers = {name.lower(): value for name, value in self.headers.items()}
        with self.server.lock:
            response = self.server.page.handle(self.command, self.path, headers, body)
        self._send(response)

    def _send(self, response: Response) -> None:
        self.send_response(response.status)
        self.send_header("Content-Type", response.kind)
        if response.stream is None:
            self.send_header("Content-Length", str(len(response.body)))
        else:
            self.send_header("Connection", "close")
            self.close_connection = True
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Content-Security-Policy", _REPORT if response.framed else _PAGE)
        self.end_headers()
        if self.command == "HEAD":
            return
        self.wfile.write(response.body)
        for piece in response.stream() if response.stream is not None else ():
            self.wfile.write(piece)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the page itself shows what went wrong."""


def server_for(
    page: Page, port: int = 0, host: str = LOOPBACK, names: tuple[str, ...] = ()
) -> ThreadingHTTPServer:  # fmt: skip
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
