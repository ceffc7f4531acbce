"""Who may ask: this computer under its own names; others, where the page is open, under addresses and names of it."""

from types import SimpleNamespace

import pytest

from uwblite.server.web import refusal

TOKEN = "t0ken"
LOCAL = SimpleNamespace(host="127.0.0.1:8000", names=None)
OPEN = SimpleNamespace(host="0.0.0.0:8000", names=("robot", "robot.local"))


def status(page, method="GET", **headers):
    answer = refusal(page, TOKEN, method, {name.replace("_", "-"): value for name, value in headers.items()})
    return 200 if answer is None else answer.status


@pytest.mark.parametrize("host", ["127.0.0.1:8000", "localhost:8000"])
def test_this_computer_may_ask(host):
    assert status(LOCAL, host=host, origin=f"http://{host}") == status(OPEN, host=host) == 200


@pytest.mark.parametrize("host", ["192.168.0.5:8000", "[fe80::1]:8000", "robot:8000", "robot.local:8000"])
def test_others_may_ask_only_where_the_page_is_open(host):
    assert status(OPEN, host=host) == 200
    assert status(OPEN, host=host, origin=f"http://{host}", sec_fetch_site="same-origin") == 200
    assert status(LOCAL, host=host) == 403


@pytest.mark.parametrize(
    "host", ["evil.example:8000", "192.168.0.5.evil.example:8000", "192.168.0.5:80", "192.168.0.5", "", ":8000", "robot:8000:1"]
)
def test_foreign_names_may_never_ask(host):
    assert status(OPEN, host=host) == status(LOCAL, host=host) == 403


@pytest.mark.parametrize("origin", ["http://192.168.0.66:8000", "null", "https://192.168.0.5:8000", "http://evil.example"])
def test_pages_from_elsewhere_may_not_ask(origin):
    assert status(OPEN, host="192.168.0.5:8000", origin=origin) == 403


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "127.0.0.1:80"])
def test_browsers_leave_the_port_of_the_web_out(host):
    page = SimpleNamespace(host="127.0.0.1:80", names=None)
    assert status(page, host=host, origin=f"http://{host}") == 200
    assert status(LOCAL, host=host) == 403


def test_an_address_of_version_6_may_be_without_a_port():
    assert status(SimpleNamespace(host="0.0.0.0:80", names=()), host="[fe80::1]") == 200


def test_changes_need_post_json_and_the_token():
    good = {"host": "127.0.0.1:8000", "x_token": TOKEN, "content_type": "application/json; charset=utf-8"}
    assert status(LOCAL, "POST", **good) == 200
    assert status(LOCAL, "POST", **good | {"x_token": "other"}) == 403
    assert status(LOCAL, "POST", **good | {"content_type": "text/plain"}) == 415
    assert status(LOCAL, "DELETE", **good) == 405
