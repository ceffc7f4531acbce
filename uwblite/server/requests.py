"""Common parts of all pages of the server: answers, and the rules for access.

A page is for this computer alone unless it is opened to the network on purpose. In either case a request must name the
server as its Host by an address or a name that it has: a page elsewhere whose own name is resolved to this computer cannot
(DNS rebinding). A request of another page carries a foreign Origin and is refused. What changes anything must be a POST
with JSON and the token that only the served page knows.
"""

import ipaddress
import json
import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol
from urllib.parse import unquote

HTML, PNG = "text/html; charset=utf-8", "image/png"


@dataclass(frozen=True, slots=True)
class Response:
    """What is sent back."""

    status: int
    kind: str
    body: bytes
    framed: bool = False
    """A report, which brings its own styles and scripts and may do nothing else."""
    stream: Callable[[], Iterator[bytes]] | None = None
    """In place of a body: what goes out piece by piece for as long as somebody listens."""


class Page(Protocol):
    """What a server answers for."""

    host: str
    """Name and port under which the page is asked for, such as 127.0.0.1:8000."""
    names: tuple[str, ...] | None
    """Under which other computers may ask, beside addresses; None = this computer alone may."""

    def handle(self, method: str, target: str, headers: dict[str, str], body: bytes = b"") -> Response:
        """Answer a request; names of headers are in lower case."""


def refusal(page: Page, token: str, method: str, headers: dict[str, str]) -> Response | None:
    """Return the answer to a request that must not be answered; None where it may be."""
    host = headers.get("host", "")
    if not _is_ours(page, host):
        return text_response("this page is for this computer only" if page.names is None else "no such name here", 403)
    origin = headers.get("origin")
    if origin not in (None, f"http://{host}"):
        return text_response("another page may not ask", 403)
    if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
        return text_response("another page may not ask", 403)
    if method not in ("GET", "HEAD", "POST"):
        return text_response("only GET, HEAD and POST are answered", 405)
    if method == "POST":
        if not secrets.compare_digest(headers.get("x-token", "").encode(), token.encode()):
            return text_response("the token is missing: reload the page", 403)
        if headers.get("content-type", "").partition(";")[0].strip() != "application/json":
            return text_response("a POST must be application/json", 415)
    return None


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


def path_of(target: str) -> str:
    """Return the path that a request asks for, "" where it names none."""
    return unquote(target.partition("?")[0].partition("#")[0]) if target.startswith("/") else ""


def json_response(value: Any, status: int = 200) -> Response:
    """Return JSON."""
    return Response(status, "application/json", json.dumps(value, allow_nan=False).encode())


def text_response(text: str, status: int) -> Response:
    """Return plain text."""
    return Response(status, "text/plain; charset=utf-8", text.encode())
