"""The page on a socket: the standard library's HTTP server on the loopback address."""

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from .app import MOST_BYTES, App, Response

LOOPBACK = "127.0.0.1"
_PAGE = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src 'self' data:; connect-src 'self';"
    " frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
_REPORT = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:;"
    " base-uri 'none'; form-action 'none'"
)


def server_for(app: App, port: int = 0) -> ThreadingHTTPServer:
    """Return a server that answers for the app on the loopback address; `serve_forever` runs it.

    Parameters
    ----------
    app : the page; its `host` is set.
    port : 0 = any that is free.

    Raises
    ------
    OSError : the port is taken.
    """
    lock = threading.Lock()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        timeout = 30

        def do_GET(self) -> None:
            self._answer(b"")

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            if not length.isdigit() or int(length) > MOST_BYTES:
                self.close_connection = True
                self._send(Response(413, "text/plain", b"too long"))
                return
            self._answer(self.rfile.read(int(length)))

        do_HEAD = do_PUT = do_DELETE = do_OPTIONS = do_GET

        def _answer(self, body: bytes) -> None:
            headers = {name.lower(): value for name, value in self.headers.items()}
            with lock:
                response = app.handle(self.command, self.path, headers, body)
            self._send(response)

        def _send(self, response: Response) -> None:
            self.send_response(response.status)
            self.send_header("Content-Type", response.kind)
            self.send_header("Content-Length", str(len(response.body)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Referrer-Policy", "no-referrer")
            self.send_header("Cross-Origin-Resource-Policy", "same-origin")
            self.send_header("Content-Security-Policy", _REPORT if response.framed else _PAGE)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(response.body)

        def log_message(self, format: str, *args: Any) -> None:
            """Say nothing: the page itself shows what went wrong."""

    server = ThreadingHTTPServer((LOOPBACK, port), Handler)
    server.daemon_threads = True
    app.host = f"{LOOPBACK}:{server.server_address[1]}"
    return server
