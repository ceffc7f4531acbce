"""The requests and answers of `uwblite view`, without a socket."""

import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from ..constraints import Constraints
from ..errors import ConfigError
from ..io.files import write_text
from ..io.source import read_settings
from ..io.stored_result import StoredResult, is_of_result, read_result
from .edits import edits_text, parse_edits, remap_command, with_anchor, with_closure
from .pages import view_page
from .shown_results import ShownResult, described, shown_result
from .web import HTML, JSON, PNG, REPORT_POLICY, TEXT, Page, Response, json_response

_TYPES = {".html": HTML, ".png": PNG, ".json": JSON, **dict.fromkeys((".csv", ".toml", ".tum", ".yaml"), TEXT)}
_FARTHEST = 1e7
"""m; no anchor is pinned beyond it."""


class Job(Protocol):
    """A command that runs."""

    def code(self) -> int | None:
        """Return its exit code; None while it runs."""

    def output(self) -> str:
        """Return the last line of its output."""

    def stop(self) -> None:
        """End it."""


class App(Page):
    """The page of `uwblite view`: results, recordings by the SHA-256 of their bytes, and the file that edits go to.

    Raises
    ------
    ConfigError : the constraints file is there and is none.
    """

    def __init__(
        self,
        results: Sequence[StoredResult],
        recordings: dict[str, Path],
        constraints: Path,
        launch: Callable[[Sequence[str]], Job],
    ) -> None:
        super().__init__()
        self.recordings, self.constraints, self._launch = recordings, constraints, launch
        self.results: list[ShownResult] = []
        self.own, self.edits = "", Constraints()
        """The user's part of the constraints file, and what the page changed."""
        self.job: Job | None = None
        self._making: Path | None = None
        for result in results:
            self._show(result)
        if constraints.is_file():
            self.own, self.edits = parse_edits(read_settings(str(constraints)), str(constraints))

    def _show(self, result: StoredResult) -> None:
        self.results.append(shown_result(result, f"/result/{len(self.results)}/grid.png"))

    def get(self, path: str) -> Response | None:
        """Return the page, its state or a file of a result."""
        if path == "/":
            return Response(HTML, view_page(self.token).encode())
        if path == "/state":
            return json_response(self._state())
        files = {f"/result/{k}/": shown for k, shown in enumerate(self.results)}
        folder, slash, name = path.rpartition("/")
        return self._file(files[folder + slash], name) if folder + slash in files else None

    def _file(self, shown: ShownResult, name: str) -> Response | None:
        """Return a file of a result; nothing but the names that a result may hold is looked for."""
        if name == "grid.png" and shown.grid_png is not None:
            return Response(PNG, shown.grid_png)
        file = shown.result.folder / name
        kind = _TYPES.get(file.suffix)
        if not is_of_result(name) or kind is None or not file.is_file() or file.is_symlink():
            return None
        answer = Response(kind, file.read_bytes())
        return replace(answer, policy=REPORT_POLICY) if kind == HTML else answer

    def _state(self) -> dict[str, Any]:
        self._collect()
        edited = len(self.edits.closures) + len(self.edits.forbidden) + len(self.edits.anchors)
        return {
            "results": [described(shown, self.edits) for shown in self.results],
            "edits": edited,
            "constraints": self.constraints.name,
            "job": None if self.job is None else {"code": self.job.code(), "output": self.job.output()},
        }

    def post(self, path: str, body: bytes) -> Response | None:
        """Write a wish for a closure or an anchor into the constraints file, or map again."""
        wish = _parsed(body)
        if path == "/closure":
            closures = self._chosen(wish).result.closures
            number = _whole(wish, "number", len(closures))
            self._keep(with_closure(self.edits, closures[number], str(wish.get("wish", ""))))
        elif path == "/anchor":
            self._keep(self._with_anchor(wish))
        elif path == "/map":
            self._start(self._chosen(wish))
        else:
            return None
        return json_response(self._state())

    def _chosen(self, wish: dict[str, Any]) -> ShownResult:
        return self.results[_whole(wish, "result", len(self.results))]

    def _with_anchor(self, wish: dict[str, Any]) -> Constraints:
        shown, name, place = self._chosen(wish), wish.get("id"), wish.get("place")
        if name not in {a.id for a in shown.result.anchors}:
            raise ConfigError("there is no such anchor in this result")
        if place is None:
            return with_anchor(self.edits, str(name), None)
        good = isinstance(place, list) and len(place) == 2
        good = good and all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= _FARTHEST for v in place)
        if not good:
            raise ConfigError("an anchor is pinned at two numbers, x and y in metres")
        return with_anchor(self.edits, str(name), (float(place[0]), float(place[1])))

    def _keep(self, edits: Constraints) -> None:
        """Write the constraints file, then hold the edits to be true."""
        write_text(self.constraints, edits_text(self.own, edits))
        self.edits = edits

    def _start(self, shown: ShownResult) -> None:
        self._collect()
        if self.job is not None and self.job.code() is None:
            raise ConfigError("a map is being made already")
        folder = shown.result.folder.resolve()
        out = next(p for k in itertools.count(2) if not (p := folder.with_name(f"{folder.name}_{k}")).exists())
        if not self.constraints.exists():
            self._keep(self.edits)
        self.job = self._launch(remap_command(shown.result.report, folder, self.recordings, self.constraints, out))
        self._making = out

    def _collect(self) -> None:
        """Put a result that has been finished beside the others."""
        if self.job is None or self._making is None or self.job.code() is None:
            return
        made, self._making = self._making, None
        if self.job.code() in (0, 3):
            self._show(read_result(made))


def _parsed(body: bytes) -> dict[str, Any]:
    try:
        wish = json.loads(body)
    except (ValueError, RecursionError):
        raise ConfigError("the request is no JSON") from None
    if not isinstance(wish, dict):
        raise ConfigError("the request is no JSON object")
    return wish


def _whole(wish: dict[str, Any], name: str, end: int) -> int:
    value = wish.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < end:
        raise ConfigError(f"there is no {name} {str(value)[:40]}")
    return value
