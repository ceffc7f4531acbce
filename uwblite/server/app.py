"""The requests and answers of `uwblite view`, without a socket."""

import itertools
import json
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from ..constraints import Constraints
from ..errors import ConfigError, UwbliteError
from ..io.files import write_text
from ..io.results import is_of_result
from ..io.source import read_settings
from ..io.stored_result import StoredResult, read_result
from .edits import PINNED_SIGMA, edits_text, parse_edits, remap_command, with_anchor, with_closure
from .pages import view_page
from .shown_results import ShownResult, described, shown_result
from .web import HTML, JSON, PNG, TEXT, Response, json_response, path_of, refusal, text_response

_TYPES = {".html": HTML, ".png": PNG, ".json": JSON, **dict.fromkeys((".csv", ".toml", ".tum", ".yaml"), TEXT)}
_FARTHEST = 1e7
"""m; no anchor is pinned beyond it."""


class Job(Protocol):
    """A command that runs."""

    def code(self) -> int | None:
        """Return its exit code; None while it runs."""

    def output(self) -> str:
        """Return the last line of its output."""


@dataclass(slots=True)
class App:
    """The state behind the page."""

    results: list[ShownResult]
    recordings: dict[str, Path]
    """Recordings at hand, by the SHA-256 of their bytes."""
    constraints: Path
    """The file that edits go to."""
    launch: Callable[[Sequence[str]], Job]
    """Starts `uwblite` with these arguments."""
    token: str
    host: str = ""
    """Name and port under which the page is asked for, such as 127.0.0.1:8000."""
    names: tuple[str, ...] | None = None
    own: str = ""
    """The user's part of the constraints file."""
    edits: Constraints = field(default_factory=Constraints)
    job: Job | None = None
    making: Path | None = None

    def show(self, result: StoredResult) -> None:
        """Put a result beside the others."""
        self.results.append(shown_result(result, f"/result/{len(self.results)}/grid.png"))

    def handle(self, method: str, target: str, headers: dict[str, str], body: bytes = b"") -> Response:
        """Answer a request.

        Parameters
        ----------
        headers : with names in lower case.
        """
        if refused := refusal(self, self.token, method, headers):
            return refused
        path = path_of(target)
        try:
            return self._post(path, body) if method == "POST" else self._get(path)
        except UwbliteError as error:
            return json_response({"error": str(error)}, 400)

    def _get(self, path: str) -> Response:
        if path == "/":
            return Response(200, HTML, view_page(self.token).encode())
        if path == "/state":
            return json_response(self._state())
        parts = path.strip("/").split("/")
        results = {str(k): shown for k, shown in enumerate(self.results)}
        if len(parts) == 3 and parts[0] == "result" and parts[1] in results:
            return self._file(results[parts[1]], parts[2])
        return text_response("there is no such page", 404)

    def _file(self, shown: ShownResult, name: str) -> Response:
        """Return a file of a result; nothing but the names that a result may hold is looked for."""
        if name == "grid.png" and shown.grid_png is not None:
            return Response(200, PNG, shown.grid_png)
        file = shown.result.folder / name
        kind = _TYPES.get(file.suffix)
        if not is_of_result(name) or kind is None or not file.is_file() or file.is_symlink():
            return text_response("there is no such file in this result", 404)
        return Response(200, kind, file.read_bytes(), framed=file.suffix == ".html")

    def _state(self) -> dict[str, Any]:
        self._collect()
        edited = len(self.edits.closures) + len(self.edits.forbidden) + len(self.edits.anchors)
        return {
            "results": [described(shown, self.edits) for shown in self.results],
            "edits": edited,
            "constraints": self.constraints.name,
            "job": None if self.job is None else {"code": self.job.code(), "output": self.job.output()},
        }

    def _post(self, path: str, body: bytes) -> Response:
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
            return text_response("there is no such page", 404)
        return json_response(self._state())

    def _chosen(self, wish: dict[str, Any]) -> ShownResult:
        return self.results[_whole(wish, "result", len(self.results))]

    def _with_anchor(self, wish: dict[str, Any]) -> Constraints:
        shown, name, place = self._chosen(wish), wish.get("id"), wish.get("place")
        if name not in {a.id for a in shown.result.anchors}:
            raise ConfigError("there is no such anchor in this result")
        if place is None:
            return with_anchor(self.edits, str(name), None)
        sigma = wish.get("sigma", PINNED_SIGMA)
        numbers = [*place, sigma] if isinstance(place, list) and len(place) == 2 else []
        good = all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= _FARTHEST for v in numbers)
        if not numbers or not good or sigma <= 0:
            raise ConfigError("an anchor is pinned at two numbers, x and y in metres, with a positive sigma")
        return with_anchor(self.edits, str(name), (float(place[0]), float(place[1])), float(sigma))

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
        self.job = self.launch(remap_command(shown.result.report, folder, self.recordings, self.constraints, out))
        self.making = out

    def _collect(self) -> None:
        """Put a result that has been finished beside the others."""
        if self.job is None or self.making is None or self.job.code() is None:
            return
        made, self.making = self.making, None
        if self.job.code() in (0, 3):
            self.show(read_result(made))


def app_of(
    results: Sequence[StoredResult], recordings: dict[str, Path], constraints: Path, launch: Callable[[Sequence[str]], Job]
) -> App:
    """Return the page's state, with a token of its own.

    Raises
    ------
    ConfigError : the constraints file is there and is none.
    """
    app = App([], recordings, constraints, launch, secrets.token_urlsafe(24))
    for result in results:
        app.show(result)
    if constraints.is_file():
        app.own, app.edits = parse_edits(read_settings(str(constraints)), str(constraints))
    return app


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
