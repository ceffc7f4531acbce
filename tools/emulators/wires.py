"""Where the emulated devices are plugged in: pseudo-terminals with a link of a chosen name, or TCP ports."""

import contextlib
import errno
import os
import select
import socket
import tty
from pathlib import Path

UNSENT = 1 << 16


class PtyWire:
    """A pseudo-terminal; unplugging it makes the host's end fail as a pulled USB cable does.

    Parameters
    ----------
    link : path of a symbolic link to it, kept up to date; None = no link.
    """

    def __init__(self, link: Path | None) -> None:
        self.link = link
        self.master: int | None = None
        self.path = ""
        self._unsent = bytearray()
        self.overflow = 0
        """Bytes lost because the host did not read."""

    def plug_in(self) -> None:
        """Make the port appear."""
        if self.master is not None:
            return
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        os.close(slave)  # from now on a hang-up says that no host has it open
        os.set_blocking(self.master, False)
        if self.link:
            with contextlib.suppress(FileNotFoundError):
                self.link.unlink()
            self.link.symlink_to(self.path)

    def unplug(self) -> None:
        """Make the port vanish."""
        if self.master is None:
            return
        if self.link:
            with contextlib.suppress(FileNotFoundError):
                self.link.unlink()
        os.close(self.master)
        self.master = None
        self._unsent.clear()

    def fileno(self) -> int | None:
        """Return the descriptor to wait on; None while no host has the port open (it would be ready all the time)."""
        return self.master if self.connected() else None

    def connected(self) -> bool:
        """Return whether a host has the port open."""
        if self.master is None:
            return False
        poller = select.poll()
        poller.register(self.master, select.POLLIN)
        return not any(flags & select.POLLHUP for _, flags in poller.poll(0))

    def read(self) -> bytes:
        """Return what the host has written."""
        if self.master is None:
            return b""
        try:
            return os.read(self.master, 4096)
        except OSError as error:
            if error.errno in (errno.EIO, errno.EAGAIN):
                return b""
            raise

    def write(self, data: bytes) -> None:
        """Send to the host; without a host the bytes are gone, a host that does not read loses what does not fit."""
        if self.master is None or not self.connected():
            self._unsent.clear()
            return
        self._unsent += data
        try:
            while self._unsent:
                del self._unsent[: os.write(self.master, self._unsent)]
        except BlockingIOError:
            pass
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            self._unsent.clear()
        if len(self._unsent) > UNSENT:
            self.overflow += len(self._unsent) - UNSENT
            del self._unsent[:-UNSENT]


class TcpWire:
    """A TCP port for one client at a time, as ser2net or an Ethernet unit has it.

    Parameters
    ----------
    host, port : where to listen; port 0 chooses one.
    """

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self._unsent = bytearray()
        self.overflow = 0
        self.path = ""

    def plug_in(self) -> None:
        """Listen."""
        if self._listener is None:
            self._listener = socket.create_server(self._address)
            self._listener.setblocking(False)
            self._address = self._listener.getsockname()[:2]
            self.path = f"socket://{self._address[0]}:{self._address[1]}"

    def unplug(self) -> None:
        """Stop listening and drop the client."""
        for end in (self._client, self._listener):
            if end is not None:
                end.close()
        self._client = self._listener = None
        self._unsent.clear()

    def fileno(self) -> int | None:
        """Return the descriptor to wait on."""
        end = self._client or self._listener
        return end.fileno() if end is not None else None

    def connected(self) -> bool:
        """Return whether a client is there."""
        return self._client is not None

    def read(self) -> bytes:
        """Accept a client, or return what it has written."""
        if self._client is None:
            if self._listener is not None:
                with contextlib.suppress(BlockingIOError):
                    self._client, _ = self._listener.accept()
                    self._client.setblocking(False)
                    self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        try:
            data = self._client.recv(4096)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._client.close()
            self._client = None
        return data

    def write(self, data: bytes) -> None:
        """Send to the client; without one the bytes are gone."""
        if self._client is None:
            self._unsent.clear()
            return
        self._unsent += data
        try:
            while self._unsent:
                del self._unsent[: self._client.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError:
            self._client.close()
            self._client = None
            self._unsent.clear()
        if len(self._unsent) > UNSENT:
            self.overflow += len(self._unsent) - UNSENT
            del self._unsent[:-UNSENT]
