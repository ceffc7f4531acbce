"""Who may ask the page what, and what its posts do to the constraints file."""

import json
import shutil

import pytest
from helpers.results import EVIL, small_folder

from uwblite.io.constraints_file import parse_constraints
from uwblite.io.stored_result import read_result
from uwblite.server.app import App

HOST = "127.0.0.1:8000"


class Work:
    """A map that is being made, as the test wants it."""

    def __init__(self, words):
        self.words, self.ended = words, None

    def code(self):
        return self.ended

    def output(self):
        return "occupancy grid"

    def stop(self):
        self.ended = -15


@pytest.fixture
def app(tmp_path):
    folder = tmp_path / "map"
    small_folder(folder, evil=EVIL, command="uwblite map run.log --laser-flipped", settings="x = 1")
    recording = tmp_path / "run.log"
    app = App([read_result(folder)], {"ab" * 32: recording}, tmp_path / "c.toml", Work)
    app.host = HOST
    return app


def headers(app, **more):
    return {"host": HOST, "x-token": app.token, "content-type": "application/json", "origin": f"http://{HOST}"} | more


def post(app, path, wish, **more):
    return app.handle("POST", path, headers(app, **more), json.dumps(wish).encode())


def test_the_page_and_its_state_are_served(app):
    page = app.handle("GET", "/", {"host": HOST})
    assert page.status == 200
    assert app.token.encode() in page.body
    assert app.handle("GET", "/", {"host": "localhost:8000"}).status == 200
    shown = json.loads(app.handle("GET", "/state", {"host": HOST}).body)["results"][0]
    assert shown["name"] == "map"
    assert (shown["accepted"], shown["candidates"]) == (1, 3)
    assert [a["id"] for a in shown["anchors"]][1] == "91A3"
    assert shown["closures"][0]["wish"] == "leave"
    assert 'href="/result/0/grid.png"' in shown["svg"]
    assert "<script>" not in shown["svg"]


@pytest.mark.parametrize(
    "foreign",
    [
        {"host": "evil.example:8000"}, {"host": "127.0.0.1:9"}, {"host": ""}, {"host": "127.0.0.1:8000.evil.example"},
        {"origin": "http://evil.example"}, {"origin": "null"}, {"origin": f"https://{HOST}"}, {"origin": "http://127.0.0.1:9"},
        {"sec-fetch-site": "cross-site"}, {"sec-fetch-site": "same-site"},
    ],
)  # fmt: skip
def test_strangers_get_nothing(app, foreign):
    for method, path in (("GET", "/"), ("GET", "/state"), ("GET", "/result/0/report.json"), ("POST", "/closure")):
        answer = app.handle(method, path, headers(app, **foreign), b"{}")
        assert answer.status == 403
        assert app.token.encode() not in answer.body
    assert not app.constraints.exists()


@pytest.mark.parametrize("token", ["", "x", "\u00e9"])
def test_posts_need_the_token_and_json(app, token):
    wish = {"result": 0, "number": 0, "wish": "reject"}
    assert post(app, "/closure", wish, **{"x-token": token}).status == 403
    assert post(app, "/closure", wish, **{"content-type": "text/plain"}).status == 415
    assert app.handle("PUT", "/closure", headers(app), b"{}").status == 405
    assert app.handle("OPTIONS", "/", headers(app)).status == 405
    assert not app.constraints.exists()


@pytest.mark.parametrize(
    "path",
    [
        "/result/0/../map/report.json", "/result/0/..%2f..%2fc.toml", "/result/0/%2fetc%2fpasswd", "/result/0/c.toml",
        "/result/1/map.png", "/result/-1/map.png", "/result/0/", "/result/0", "/etc/passwd", "/result/0/map.png/x",
        "/result/0/secret.png", "//", "/result/0/report.html%00.png", "/result/\u00b2/map.png",
    ],
)  # fmt: skip
def test_nothing_but_a_result_s_own_files_is_served(app, path):
    folder = app.results[0].result.folder
    (folder / "secret.png").write_bytes(b"secret")
    (folder.parent / "c.toml").write_text("secret = 1")
    assert app.handle("GET", path, {"host": HOST}).status == 404


def test_a_link_out_of_the_folder_is_not_followed(app):
    folder = app.results[0].result.folder
    (folder / "config.toml").unlink()
    (folder.parent / "elsewhere").write_text("secret")
    (folder / "config.toml").symlink_to(folder.parent / "elsewhere")
    assert app.handle("GET", "/result/0/config.toml", {"host": HOST}).status == 404
    report = app.handle("GET", "/result/0/report.html", {"host": HOST})
    assert report.status == 200
    assert report.policy.startswith("sandbox")


def test_wishes_go_into_the_constraints_file(app):
    assert post(app, "/closure", {"result": 0, "number": 0, "wish": "reject"}).status == 200
    assert post(app, "/closure", {"result": 0, "number": 1, "wish": "force"}).status == 200
    state = json.loads(post(app, "/anchor", {"result": 0, "id": "91A3", "place": [1.5, -2.0]}).body)
    assert state["edits"] == 3
    closures = sorted(state["results"][0]["closures"], key=lambda c: c["number"])
    assert [c["wish"] for c in closures] == ["reject", "force", "leave"]
    written = parse_constraints(app.constraints.read_text())
    assert written.forbidden[0].stamps == (1000.0, 1006.0)
    assert written.closures[0].pose == (1.0, 1.0, 1.0)
    assert written.anchors[0].position == (1.5, -2.0)
    assert json.loads(post(app, "/anchor", {"result": 0, "id": "91A3", "place": None}).body)["edits"] == 2
    # Who starts again finds it as it was.
    again = App([app.results[0].result], {}, app.constraints, Work)
    assert again.edits == app.edits


@pytest.mark.parametrize(
    ("path", "wish"),
    [
        ("/closure", {"result": 0, "number": 9, "wish": "reject"}),
        ("/closure", {"result": 0, "number": True, "wish": "reject"}),
        ("/closure", {"result": 3, "number": 0, "wish": "reject"}), ("/closure", {"result": 0, "number": 0, "wish": "burn"}),
        ("/closure", {}), ("/closure", []), ("/anchor", {"result": 0, "id": "?", "place": [0, 0]}),
        ("/anchor", {"result": 0, "id": "91A3", "place": [0]}), ("/anchor", {"result": 0, "id": "91A3", "place": ["1", 2]}),
        ("/anchor", {"result": 0, "id": "91A3", "place": [1e99, 2]}),
        ("/anchor", {"result": 0, "id": "91A3", "place": [float("nan"), 0]}),
    ],
)  # fmt: skip
def test_what_makes_no_sense_changes_nothing(app, path, wish):
    answer = post(app, path, wish)
    assert answer.status == 400
    assert json.loads(answer.body)["error"]
    assert not app.constraints.exists()
    assert app.handle("POST", path, headers(app), b"\xff{").status == 400


def test_mapping_again_puts_the_new_result_beside_the_old(app):
    answer = json.loads(post(app, "/map", {"result": 0}).body)
    assert answer["job"] == {"code": None, "output": "occupancy grid"}
    folder = app.results[0].result.folder
    assert app.job.words[0] == "map"
    assert app.job.words[-4:] == ["--constraints", str(app.constraints), "--out", str(folder.with_name("map_2"))]
    assert "--laser-flipped" in app.job.words
    assert post(app, "/map", {"result": 0}).status == 400
    shutil.copytree(folder, folder.with_name("map_2"))
    app.job.ended = 3
    state = json.loads(app.handle("GET", "/state", {"host": HOST}).body)
    assert [r["name"] for r in state["results"]] == ["map", "map_2"]
    assert post(app, "/map", {"result": 1}).status == 200
    assert app.job.words[-1].endswith("map_2_2")


def test_a_map_that_failed_is_not_shown(app):
    post(app, "/map", {"result": 0})
    app.job.ended = 1
    assert len(json.loads(app.handle("GET", "/state", {"host": HOST}).body)["results"]) == 1


def test_without_the_recording_it_reports_what_to_do(app):
    app.recordings.clear()
    answer = post(app, "/map", {"result": 0})
    assert answer.status == 400
    assert "uwblite view DIR RECORDING" in json.loads(answer.body)["error"]
