"""The page on a real socket: loopback only, headers that keep others out, nonsense that does not end it."""

import http.client
import json
import select
import socket
import threading

import pytest
from helpers.results import small_folder

from uwblite.io.stored_result import read_result
from uwblite.server.app import App
from uwblite.server.live import LivePage
from uwblite.server.web import server_for


@pytest.fixture
def served(tmp_path):
    small_folder(tmp_path / "map")
    app = App([read_result(tmp_path / "map")], {}, tmp_path / "c.toml", lambda words: None)
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
    _, headers, _ = ask(server, "GET", "/result/0/report.html")
    assert headers["Content-Security-Policy"].startswith("sandbox allow-scripts;")


def test_a_post_comes_through_and_a_long_one_does_not(served):
    app, server = served
    headers = {"X-Token": app.token, "Content-Type": "application/json"}
    status, _, body = ask(server, "POST", "/closure", json.dumps({"result": 0, "number": 0, "wish": "reject"}), headers)
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


@pytest.fixture
def live(monkeypatch):
    monkeypatch.setattr("uwblite.server.web.MOST_CONNECTIONS", 8)
    page = LivePage("live")
    server = server_for(page)
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
    yield page, server
    page.feed.close()
    server.shutdown()
    server.server_close()


def test_events_flow_for_as_long_as_somebody_listens(live):
    page, server = live
    page.show_status({"summary": "one"})
    connection = http.client.HTTPConnection(*server.server_address, timeout=10)
    connection.request("GET", "/events")
    answer = connection.getresponse()
    assert answer.getheader("Content-Type") == "text/event-stream"
    lines = iter(answer.readline, b"")
    assert next(line for line in lines if line.startswith(b"data")) == b'data: {"summary": "one"}\n'
    page.show_status({"summary": "two"})
    assert next(line for line in lines if line.startswith(b"data")) == b'data: {"summary": "two"}\n'
    page.feed.close()
    assert list(lines) is not None


def test_a_thousand_connections_are_turned_away_and_do_no_harm(live):
    """Eight have room, each with half a request; for one more the oldest gives way, or, until its thread has ended, the new."""
    _, server = live
    lines = []
    for _ in range(1000):
        line = socket.create_connection(server.server_address, timeout=10)
        line.sendall(b"GET / HTTP/1.1\r\nHost: x")
        lines.append(line)
        if len(lines) > 8:
            answered = select.select(lines, [], [], 10)[0]
            assert answered
            for line in answered:
                assert line.recv(100).startswith(b"HTTP/1.1 503")
                line.close()
                lines.remove(line)
    assert threading.active_count() < 40
    assert ask(server, "GET", "/", headers={"Host": server.page.host})[0] == 200
    for line in lines:
        line.close()


def test_streams_that_nobody_reads_keep_nobody_out(live):
    page, server = live
    streams = []
    for k in range(12):
        line = socket.create_connection(server.server_address, timeout=10)
        line.sendall(f"GET /events HTTP/1.1\r\nHost: {page.host}\r\n\r\n".encode())
        assert line.recv(15) == b"HTTP/1.1 200 OK"
        streams.append(line)
        assert ask(server, "GET", "/")[0] == 200
        page.show_status({"summary": f"news {k}"})
    assert sum(_ended(line) for line in streams[:4]) == 4
    for line in streams:
        line.close()


def _ended(line):
    """Return whether a stream has come to its end, after what was sent before."""
    while line.recv(1 << 16):
        pass
    return True


def test_a_head_has_a_limit_and_the_answer_says_so(live):
    page, server = live
    host = f"Host: {page.host}\r\n".encode()
    for head, code in (
        (b"GET /" + b"x" * 40_000 + b" HTTP/1.1\r\n", b" 414 "),
        (b"GET / HTTP/1.1\r\n" + host + b"A: " + b"x" * 40_000 + b"\r\n\r\n", b" 431 "),
        (b"GET / HTTP/1.1\r\n" + host + b"".join(b"A%d: " % k + b"x" * 900 + b"\r\n" for k in range(40)) + b"\r\n", b" 431 "),
        (b"GET / HTTP/1.1\r\n" + host + b"A: " + b"x" * 20_000 + b"\r\nConnection: close\r\n\r\n", b" 200 "),
    ):
        with socket.create_connection(server.server_address, timeout=10) as line:
            line.sendall(head)
            assert code in line.recv(1000).split(b"\r\n")[0]


def test_the_limit_of_a_head_holds_for_each_request_of_a_connection(live):
    _, server = live
    connection = http.client.HTTPConnection(*server.server_address, timeout=10)
    for _ in range(3):
        connection.request("HEAD", "/", headers={"A": "x" * 20_000})
        answer = connection.getresponse()
        assert (answer.status, answer.read()) == (200, b"")


@pytest.mark.parametrize("target", ["http://[", "//[", "/%00", "/..%2f..%2fetc/passwd", "*", "/result/0/../../c.toml"])
def test_a_target_that_names_no_page_is_not_found(served, live, target):
    for _, server in (served, live):
        with socket.create_connection(server.server_address, timeout=10) as line:
            line.sendall(f"GET {target} HTTP/1.1\r\nHost: {server.page.host}\r\nConnection: close\r\n\r\n".encode())
            assert b" 404 " in line.recv(1000).split(b"\r\n")[0]


def test_of_a_thousand_bytes_of_nonsense_in_a_length_nothing_is_read(live):
    _, server = live
    for length, code in (("9" * 4000, b" 413 "), ("\u00b2", b" 400 "), ("1e3", b" 400 "), ("-1", b" 400 "), ("", b" 400 ")):
        with socket.create_connection(server.server_address, timeout=10) as line:
            line.sendall(f"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: {length}\r\n\r\n".encode())
            assert code in line.recv(1000)


def test_a_path_of_another_place_is_not_found(live):
    _, server = live
    with socket.create_connection(server.server_address, timeout=10) as line:
        host = f"127.0.0.1:{server.server_address[1]}"
        line.sendall(f"GET /../../etc/passwd HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
        answer = line.recv(4000)
    assert b" 404 " in answer.split(b"\r\n")[0]
    assert b"root:" not in answer


def test_an_open_page_is_asked_for_by_address():
    page = LivePage("open")
    server = server_for(page, 0, "0.0.0.0", ("robot",))
    assert page.names == ("robot",)
    port = server.server_address[1]
    assert page.handle("GET", "/", {"host": f"10.0.0.5:{port}"}).status == 200
    assert page.handle("GET", "/", {"host": f"robot:{port}"}).status == 200
    assert page.handle("GET", "/", {"host": f"evil.example:{port}"}).status == 403
    server.server_close()


@pytest.mark.parametrize(
    ("head", "body"),
    [
        ("GET / HTTP/1.1\r\nHost: {host}\r\nContent-Length: 4", "abcd"),
        ("GET / HTTP/1.1\r\nHost: {host}\r\nHost: elsewhere", ""),
        ("GET / HTTP/1.1\r\nHost: {host}\r\nContent-Length : 4", "abcd"),
        ("GET / HTTP/1.1\r\nHost: {host}\r\nno header\r\nOrigin: http://elsewhere", ""),
        ("GET / HTTP/1.1\r\nHost: {host}\r\nTransfer-Encoding: chunked", "0\r\n\r\n"),
        ("HEAD / HTTP/1.1\r\nHost: {host}\r\nContent-Length: x", ""),
        ("POST /closure HTTP/1.1\r\nHost: {host}\r\nContent-Length: 2\r\nContent-Length: 2", "{}"),
        ("POST /closure HTTP/1.1\r\nHost: {host}\r\nContent-Length: 2\r\nTransfer-Encoding: chunked", "{}"),
    ],
)
def test_a_request_whose_end_is_in_doubt_is_refused_and_the_connection_closed(served, head, body):
    _, server = served
    text = head.format(host=f"127.0.0.1:{server.server_address[1]}") + "\r\n\r\n" + body
    with socket.create_connection(server.server_address, timeout=10) as connection:
        connection.sendall(text.encode() + b"GET /smuggled HTTP/1.1\r\n\r\n")
        answer = b""
        while piece := connection.recv(1 << 16):
            answer += piece
    assert answer.startswith(b"HTTP/1.1 400 ")
    assert answer.count(b"HTTP/1.1") == 1
    assert b"Connection: close" in answer


def test_a_form_in_parts_is_a_request_like_any_other(served):
    """Its body is in parts that only the header's type names; it has no token."""
    _, server = served
    head = f"POST /closure HTTP/1.1\r\nHost: 127.0.0.1:{server.server_address[1]}\r\nContent-Length: 2"
    with socket.create_connection(server.server_address, timeout=10) as connection:
        connection.sendall(f"{head}\r\nContent-Type: multipart/form-data\r\n\r\n{{}}".encode())
        assert connection.recv(1 << 16).startswith(b"HTTP/1.1 403 ")
