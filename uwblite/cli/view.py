"""`uwblite view`: results in the browser, side by side, with closures and anchors to correct."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from ..errors import ConfigError
from ..io.files import sha256_of
from ..io.formats import format_of
from ..io.stored_result import StoredResult, read_result
from ..server.app import App
from ..server.web import server_for
from . import console
from .child import Child


def run(args: argparse.Namespace) -> int:
    folders = [path for path in args.paths if format_of(path) == "map"]
    if not folders:
        raise ConfigError(f"{args.paths[0]} holds no result; map it first: uwblite map {args.paths[0]} --out map")
    results = [read_result(folder) for folder in folders]
    recordings = _recordings([path for path in args.paths if path not in folders], results)
    first = os.path.abspath(folders[0])
    constraints = Path(args.constraints or f"{first}_constraints.toml")
    app = App(results, recordings, constraints, Child)
    server = server_for(app, args.port)
    address = f"http://{app.host}/"
    console.say(f"open {address} in a browser; Ctrl-C ends it")
    console.note(f"uwblite: corrections go to {constraints}")
    console.flush()
    if args.open:
        import webbrowser

        webbrowser.open(address)
    try:
        server.serve_forever(poll_interval=0.2)
    except KeyboardInterrupt:
        console.note("uwblite: the page has ended")
    finally:
        if app.job is not None and app.job.code() is None:
            app.job.stop()
        server.server_close()
    return 0


def _recordings(named: Sequence[str], results: Sequence[StoredResult]) -> dict[str, Path]:
    """Return the recordings at hand by the SHA-256 of their bytes: those that are named, and those the results name."""
    wanted = {str(i.get("sha256")) for r in results for i in r.report.get("inputs") or ()}
    recordings: dict[str, Path] = {}
    for name in named:
        if not os.path.exists(name):
            raise ConfigError(f"{name}: no such file or folder")
        recordings[sha256_of(name)] = Path(name).resolve()
    if named and wanted and not wanted & recordings.keys():
        raise ConfigError(f"{named[0]} is not the recording that the map was made of (its bytes differ)")
    for result in results:
        for entry in result.report.get("inputs") or ():
            source, key = str(entry.get("source", "")), str(entry.get("sha256"))
            places = (Path(source), result.folder.parent / source, result.folder.parent / os.path.basename(source))
            file = next((p for p in places if source and p.exists()), None)
            if key not in recordings and file is not None and sha256_of(file) == key:
                recordings[key] = file.resolve()
    return recordings
