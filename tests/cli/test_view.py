"""`uwblite view` as a user starts it, and in Chromium: a closure is rejected with a click and the map made again."""

import shutil
from types import SimpleNamespace

import pytest
from helpers.browser import CHROMIUM, Browser
from helpers.results import small_folder
from helpers.served import Served

from uwblite.cli import main, view
from uwblite.io.constraints_file import parse_constraints


@pytest.fixture(scope="module")
def mapped(tmp_path_factory, minute_map):
    """A folder with a minute of the sample recording, and its map."""
    return shutil.copytree(minute_map.parent, tmp_path_factory.mktemp("view") / "minute")


def test_it_reports_its_address_and_ends_with_ctrl_c(mapped):
    import urllib.request

    with Served("view", "map", cwd=mapped) as served, urllib.request.urlopen(served.address + "state", timeout=20) as answer:
        assert b'"name": "map"' in answer.read()
    assert served.code == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{0}/run.log.gz"], "holds no result; map it first: uwblite map"),
        (["{0}/map", "{0}/none.log"], "no such file"),
        (["{0}/map", "{0}/map/config.toml"], "is not the recording that the map was made of"),
        (["{0}/map", "--constraints", "{0}/run.log.gz"], "run.log.gz: not a text file"),
    ],
)
def test_what_cannot_be_shown_is_one_clear_line(mapped, capsys, words, message):
    assert main(["view", *(w.format(mapped) for w in words)]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
@pytest.mark.parametrize(("width", "dark"), [(1280, False), (390, True)])
def test_a_click_rejects_a_closure_and_maps_again(mapped, tmp_path, width, dark):
    (mapped / "map_constraints.toml").unlink(missing_ok=True)
    with Served("view", "map", cwd=mapped) as served, Browser(tmp_path / "profile", width=width, dark=dark) as browser:
        browser.open(served.address)
        browser.until("document.querySelector('section svg .kept polyline')")
        assert browser.run("document.documentElement.scrollWidth") <= width
        marks = browser.run("['.start', '.end', '.anchor text'].map(k => document.querySelectorAll('section svg ' + k).length)")
        assert marks == [1, 1, 4]
        rejected = browser.run("document.querySelector('.kept polyline').dataset.closure")
        browser.run("document.querySelector('.kept polyline.hit').dispatchEvent(new MouseEvent('click'))")
        browser.run("document.querySelector('[data-wish=reject]').click()")
        browser.until("document.querySelector('polyline.reject')")
        assert browser.run("document.querySelector('polyline.reject').dataset.closure") == rejected
        assert len(parse_constraints((mapped / "map_constraints.toml").read_text()).forbidden) == 1
        assert browser.complaints == []
        if width < 1280:  # what the button does is the same everywhere
            return
        before = browser.run("document.querySelectorAll('section').length")
        browser.run("document.querySelector('button.map-again').click()")
        browser.until(f"document.querySelectorAll('section').length > {before}", patience=180)
        browser.until("document.getElementById('say').textContent.length > 0")
        assert browser.complaints == []
    assert (mapped / "map_2" / "map.png").is_file()


@pytest.mark.parametrize("job", [None, "runs", "has ended"])
def test_a_page_that_ends_ends_the_map_that_it_makes(tmp_path, monkeypatch, capsys, job):
    """It reports where it is, and opens a browser where one is wanted."""
    small_folder(tmp_path / "map")
    seen = []
    child = SimpleNamespace(code=lambda: None if job == "runs" else 0, stop=lambda: seen.append("stopped"))

    def serve(poll_interval):
        seen.append("served")
        raise KeyboardInterrupt

    def server_for(app, port):
        app.host, app.job = f"127.0.0.1:{port}", None if job is None else child
        return SimpleNamespace(serve_forever=serve, server_close=lambda: seen.append("closed"))

    monkeypatch.setattr(view, "server_for", server_for)
    monkeypatch.setattr("webbrowser.open", seen.append)
    assert main(["view", str(tmp_path / "map"), "--port", "8123", *(["--open"] if job is None else [])]) == 0
    opened, stopped = ["http://127.0.0.1:8123/"] if job is None else [], ["stopped"] if job == "runs" else []
    assert seen == [*opened, "served", *stopped, "closed"]
    output = capsys.readouterr()
    assert output.out == "open http://127.0.0.1:8123/ in a browser; Ctrl-C ends it\n"
    assert f"corrections go to {tmp_path / 'map'}_constraints.toml" in output.err
    assert "the page has ended" in output.err
