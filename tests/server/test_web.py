"""The page on a real socket: loopback only, headers that keep others out, nonsense that does not end it."""

import http.client
import json
import socket
import threading

import pytest
from helpers.results import small_log, small_result

from uwblite.io.result_text import RunRecord
from uwblite.io.results import write_result
from uwblite.io.stored_result import read_result
from uwblite.server.app import app_of
from uwblite.server.web import server_for


@pytest.fixture
def served(tmp_path):
    write_result(tmp_path / "map", [small_log()], small_result(), RunRecord("uwblite map x", ""))
    app = app_of([read_result(tmp_path / "map")], {}, tmp_path / "c.toml", lambda words: None)
    server = server_for(app)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    yield app, server
    server.shutdown()
    server.server_close()


def ask(server, method, path, body=None, headers=None):
    connection = http.client.HTTPConnection(*server.server_address, timeout=10)
    connection.request(method, path, body, headers or {})
    answer = connection.getresponse()
    return answer.status, dict(answer.getheaders()), answer.read()


def test_it_listens_to_this_computer_alone(served):
    assert served[1].server_address[0] == "127.0.0.1"


def test_answers_carry_what_keeps_others_out(served):
    app, server = served
    status, headers, body = ask(server, "GET", "/")
    assert status == 200
    assert app.token.encode() in body
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert "Access-Control-Allow-Origin" not in headers
    assert headers["Cache-Control"] == "no-store"
    assert headers["X-Content-Type-Options"] == "nosniff"
    _, headers, _ = ask(server, "GET", "/run/0/report.html")
    assert headers["Content-Security-Policy"].startswith("sandbox allow-scripts;")


def test_a_post_comes_through_and_a_long_one_does_not(served):
    app, server = served
    headers = {"X-Token": app.token, "Content-Type": "application/json"}
    status, _, body = ask(server, "POST", "/closure", json.dumps({"run": 0, "number": 0, "wish": "reject"}), headers)
    assert status == 200
    assert json.loads(body)["edits"] == 1
    assert ask(server, "POST", "/closure", b"x" * 70_000, headers)[0] == 413
    assert ask(server, "POST", "/closure", b"{}", {**headers, "Host": "evil.example"})[0] == 403


@pytest.mark.parametrize(
    "sent", [b"", b"\r\n\r\n", b"GET\r\n\r\n", b"\xff\xfe\x00" * 50, b"POST / HTTP/1.1\r\nContent-Length: -5\r\n\r\n"]
)
def test_nonsense_does_not_end_it(served, sent):
    _, server = served
    with socket.create_connection(server.server_address, timeout=10) as line:
        line.sendall(sent)
        line.shutdown(socket.SHUT_WR)
        line.recv(1000)
    assert ask(server, "GET", "/state")[0] == 200
