"""Where a page is found that a verb serves."""

import socket
from contextlib import nullcontext

import pytest

from uwblite.cli import serving


@pytest.mark.parametrize("address", ["127.0.0.1:80", "10.0.0.7:8000", "robot:1"])
def test_a_page_of_one_address_is_found_there(address):
    assert serving._address(address) == f"http://{address}/"


class Probe:
    """A socket of a computer that has one address in its network, or is in none."""

    def __init__(self, address):
        self.address, self.bound = address, "0.0.0.0"

    def connect(self, place):
        if self.address is None:
            raise OSError("network is unreachable")
        self.bound = self.address

    def getsockname(self):
        return self.bound, 40000


@pytest.mark.parametrize(("own", "host"), [("10.1.2.3", "10.1.2.3"), (None, "127.0.0.1")])
@pytest.mark.parametrize("listening", ["0.0.0.0:8000", ":8000"])
def test_a_page_that_is_open_to_the_network_is_found_under_the_address_of_this_computer(monkeypatch, own, host, listening):
    monkeypatch.setattr(socket, "socket", lambda *_: nullcontext(Probe(own)))
    assert serving._address(listening) == f"http://{host}:8000/"
