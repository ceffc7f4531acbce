"""The documents as a site: links of pages inside and outside docs/ lead within the site, and mkdocs has no complaint."""

import importlib.util
import subprocess
import sys

import pytest
from conftest import ROOT
from docs_site import as_in_site


@pytest.mark.parametrize(
    ("page", "link", "expected"),
    [
        ("README.md", "docs/formats.md#bags", "formats.md#bags"),
        ("README.md", "docs/images/lab.png", "images/lab.png"),
        ("README.md", "firmware_notes/", "firmware_notes/README.md"),
        ("README.md", "CONTRIBUTING.md", "CONTRIBUTING.md"),
        ("docs/getting_started.md", "../firmware_notes/", "firmware_notes/README.md"),
        ("docs/getting_started.md", "driving.md", "driving.md"),
        ("docs/api.md", "../README.md", "index.md"),
        ("firmware_notes/README.md", "../docs/formats.md", "../formats.md"),
        ("firmware_notes/README.md", "anchors.md", "../firmware_notes/anchors.md"),
        ("docs/lab/paper.md", "https://arxiv.org/abs/2106.03648", "https://arxiv.org/abs/2106.03648"),
        ("docs/api.md", "#progress", "#progress"),
    ],
)
def test_links_lead_within_the_site(page, link, expected):
    assert as_in_site(page, f"see [this]({link}).") == f"see [this]({expected})."


def test_what_a_block_of_code_is_run_with_is_left_out():
    assert as_in_site("docs/driving.md", "a\n```sh norun\nuwblite record\n```\nb") == "a\n```sh\nuwblite record\n```\nb"


@pytest.mark.slow
def test_mkdocs_has_no_complaint(tmp_path):
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("mkdocs is absent")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    index = (tmp_path / "index.html").read_text()
    assert 'href="driving.html"' in index
    assert "https://fonts" not in index
