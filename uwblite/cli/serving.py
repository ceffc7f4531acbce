"""A page served from a thread of its own, for as long as a verb works."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from ..server.live import LivePage
from ..server.web import server_for
from .options import LOCAL


@contextmanager
def serving(page: LivePage, host: str, port: int) -> Iterator[str]:
    """Serve a page until the block ends; give the address at which it is found.

    Raises
    ------
    OSError : the port is taken, or the address is none of this computer's.
    """
    name = socket.gethostname()
    server = server_for(page, port, host, (name, f"{name}.local") if name else ())
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.2}, daemon=True)
    thread.start()
    try:
        yield _address(page.host)
    finally:
        page.feed.close()
        server.shutdown()
        server.server_close()


def _address(listening: str) -> str:
    """Return where a page is to be found; of one that is open to the network, under this computer's address in it."""
    host, _, port = listening.rpartition(":")
    if host in ("0.0.0.0", ""):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect(("192.0.2.1", 9))  # nothing is sent; it shows which address would be used
                host = str(probe.getsockname()[0])
            except OSError:
                host = LOCAL[0]
    return f"http://{host}:{port}/"
