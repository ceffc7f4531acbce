#!/usr/bin/env python3
"""Write docs/tuning.md and docs/findings.md from the source; ``--check`` only says whether they are up to date."""

import dataclasses
import sys
from pathlib import Path
from typing import Any, get_type_hints

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import finding_page

from uwblite.config import field_docs, permitted, shown_fields, toml_value
from uwblite.mapping import MappingConfig
from uwblite.pipeline.mapping_config import preset

TARGET = ROOT / "docs" / "tuning.md"

HEAD = """\
# Tuning

Written by `tools/make_docs.py` from the source; do not edit. The defaults are meant to do without tuning; change a
setting when a row of the table below, or of [troubleshooting](troubleshooting.md), tells you to.

```sh
uwblite config                                  # these, as a file for --config
uwblite config --all                            # also those for experiments
uwblite config --preset paper                   # the paper's plain choices
uwblite map run.log --out tuned --set grid.resolution=0.02 --set keyframes.distance=0.2
```

| if | then change |
|---|---|
| walls are thick or speckled | `grid.resolution`; a cell of about three times the lidar's noise |
| the middle of halls stays unknown | `grid.max_clear_distance` |
| the odometry is much worse than usual (slip, carpet) | `odometry.*` upwards |
| the ranges are much worse than usual | `ranges.sigma`, `trilateration.bias_sigma` upwards |
| mapping takes too long | `keyframes.distance` upwards, `keyframes.scans` downwards |
| a calibration value must not be estimated | its sigma in `calibration.*` to 0 |

An unknown name is answered with the nearest known one; a value out of its range is refused.
"""


def table(config: Any, path: str = "") -> str:
    """Return the settings of a class as a table, and those of the classes within it below."""
    docs, hints = field_docs(type(config)), get_type_hints(type(config))
    rows, below = [], []
    for field in shown_fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            below.append(table(value, f"{path}{field.name}."))
            continue
        text = " ".join(filter(None, (docs.get(field.name, ""), permitted(field, hints[field.name]))))
        rows.append(f"| `{path}{field.name}` | `{toml_value(value)}` | {text.replace('|', chr(92) + '|')} |")
    head = " ".join((type(config).__doc__ or "").split("\n\n")[0].split())
    name = path.rstrip(".")
    title = f"## [{name}]\n\n{head}\n" if path else f"## General\n\n{head}\n"
    listing = "\n".join(["| setting | default | meaning |", "|---|---|---|", *rows]) if rows else ""
    return "\n".join(filter(None, (f"\n{title}\n{listing}\n", *below)))


def presets() -> str:
    """Return what the presets change, as a table."""
    rows = []
    for name in ("paper",):
        changed = dict(differences(preset(name), MappingConfig()))
        rows += [f"| `{name}` | `{key}` | `{toml_value(value)}` |" for key, value in changed.items()]
    return "\n## Presets\n\n| preset | setting | value |\n|---|---|---|\n" + "\n".join(rows) + "\n"


def differences(one: Any, two: Any, path: str = "") -> list[tuple[str, Any]]:
    """Return (dotted name, value) of the settings of `one` that differ from those of `two`."""
    found = []
    for field in dataclasses.fields(one):
        a, b = getattr(one, field.name), getattr(two, field.name)
        if dataclasses.is_dataclass(a):
            found += differences(a, b, f"{path}{field.name}.")
        elif a != b:
            found.append((path + field.name, a))
    return found


def page() -> str:
    """Return the text of docs/tuning.md."""
    return HEAD + table(MappingConfig()) + presets()


def main() -> int:
    """Write the pages, or check them."""
    late = []
    for target, text in ((TARGET, page()), (ROOT / "docs" / "findings.md", finding_page.page())):
        if "--check" not in sys.argv[1:]:
            target.write_text(text)
            print(target)
        elif not target.exists() or target.read_text() != text:
            late.append(target.name)
    if late:
        print(f"out of date: {', '.join(late)}: python tools/make_docs.py")
    return 1 if late else 0


if __name__ == "__main__":
    sys.exit(main())
