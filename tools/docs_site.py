"""A hook of mkdocs: pages from outside docs/ join the site, links lead within it, and blocks of code are recognised."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
_NOTES = sorted(f"firmware_notes/{p.name}" for p in (ROOT / "firmware_notes").glob("*.md"))
OUTSIDE = ("CONTRIBUTING.md", "CHANGELOG.md", *_NOTES)
"""Pages of the site beside those in docs/."""
_NOT_PAGES = ("CITATION.cff", "LICENSE")
"""Files of the repository that the site does not hold; links to them stay where they are."""


def on_files(files, config):
    """Add the pages from outside docs/."""
    from mkdocs.structure.files import File

    for name, target in (("README.md", "index.md"), *((name, name) for name in OUTSIDE)):
        files.append(File.generated(config, target, content=as_in_site(name, (ROOT / name).read_text(encoding="utf-8"))))
    return files


def on_page_markdown(markdown, page, config, files):
    """Turn the links of a page in docs/ into those of the site."""
    return as_in_site(f"docs/{page.file.src_uri}", markdown) if page.file.src_dir else markdown


def as_in_site(name, text):
    """Return a page with its links as they lead within the site, and its blocks of code as mkdocs finds them.

    Parameters
    ----------
    name : of the page within the repository.
    text : its Markdown.
    """
    folder = Path(name).parent

    def link(match):
        target, hash_, part = match[1].partition("#")
        if "://" in target or not target:
            return match[0]
        path = Path(*_normal(folder / target))
        if path.name in _NOT_PAGES:
            return "](#)"
        if path == Path("firmware_notes"):
            path = path / "README.md"
        if path == Path("README.md"):
            path = Path("docs/index.md")
        site = path.relative_to("docs") if path.parts[0] == "docs" else path
        here = folder.relative_to("docs") if folder.parts[:1] == ("docs",) else folder
        up = "../" * len(here.parts)
        return f"]({up}{site.as_posix()}{hash_}{part})"

    # Words behind a fence's language say how the tests run the block; mkdocs takes no fence with several for one.
    text = re.sub(r"^(```\w+) .*$", r"\1", text, flags=re.MULTILINE)
    return re.sub(r"\]\(([^)\s]+)\)", link, text)


def _normal(path):
    parts = []
    for part in path.parts:
        parts = parts[:-1] if part == ".." else [*parts, part]
    return parts
