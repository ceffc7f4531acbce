#!/usr/bin/env python3
"""Copy the part of uwblite that a program needs into it, under any name: modules, licence and a note of the version.

examples:
  python tools/vendor.py acme/_uwblite --for map           recordings to maps: from ._uwblite.mapping import build_map
  python tools/vendor.py acme/_solver --for solve          pose graphs with ranges
  python tools/vendor.py acme/_solver --for covariances    the same and how certain the solution is
  python tools/vendor.py acme/_uwblite --for localize      where a robot is in a map, afterwards or live
  python tools/vendor.py acme/_drivers --for drivers       bytes of devices to measurements; neither numpy nor ports
  python tools/vendor.py acme/_drivers --for record        the same with ports and a log; needs pyserial
  python tools/vendor.py --list                            what each needs
"""

import argparse
import ast
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "uwblite"

_SOLVER = ("graph.solver", "graph.pose_edges", "graph.range_edges", "graph.point_edges")
PARTS = {
    "map": ("mapping", "io.carmen", "io.results", "config"),
    "solve": _SOLVER,
    "covariances": (*_SOLVER, "graph.marginals"),
    "localize": ("localization", "localization.localize", "io.stored_result", "io.carmen"),
    "drivers": ("drivers.devices",),
    "record": ("drivers.devices", "drivers.recorder", "drivers.log_file", "drivers.link", "drivers.transport"),
}
"""The modules that a program imports for each purpose."""


def file_of(module: str) -> Path | None:
    """Return the file of a module of the package, by its name below it; None where there is none."""
    base = PACKAGE.joinpath(*filter(None, module.split(".")))
    return next((f for f in (base / "__init__.py", base.with_suffix(".py")) if f.is_file()), None)


@cache
def imported(module: str, file: Path) -> tuple[str, ...]:
    """Return the modules of the package that a module imports, wherever in it, but for those that only type checkers read."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    checking = [n for n in ast.walk(tree) if isinstance(n, ast.If) and "TYPE_CHECKING" in ast.unparse(n.test)]
    unread = {id(below) for block in checking for statement in block.body for below in ast.walk(statement)}
    here = module.split(".") if file.name == "__init__.py" else module.split(".")[:-1]
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level and id(node) not in unread:
            base = [*here[: len(here) - node.level + 1], *(node.module or "").split(".")]
            found += [".".join(filter(None, (*base, name))) for name in ("", *(alias.name for alias in node.names))]
    return tuple(found)


def files_for(modules: tuple[str, ...]) -> list[Path]:
    """Return the files that modules and everything they import stand in, in the order of their names."""
    wanted, found = list(modules), set[Path]()
    while wanted:
        module = wanted.pop()
        file = file_of(module)
        if file is None or file in found or file == PACKAGE / "__init__.py":
            continue
        found.add(file)
        wanted += imported(module, file)
        wanted += [module.rpartition(".")[0]] if "." in module else []
    return sorted(found)


def start_of_package(part: str) -> str:
    """Return the __init__.py of a copy: the whole one where its names are there, else docstring and version alone."""
    text = (PACKAGE / "__init__.py").read_text(encoding="utf-8")
    if part == "map":
        return text
    tree = ast.parse(text)
    version = next(n for n in tree.body if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "__version__")
    licence = next(line for line in text.splitlines() if "SPDX" in line)
    return f'{licence}\n"""{(ast.get_docstring(tree) or "").splitlines()[0]}"""\n\n{ast.unparse(version)}\n'


def commit() -> str:
    """Return the commit of this clone, '' where it is none."""
    done = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip()


def copy(part: str, target: Path) -> tuple[int, int]:
    """Write the copy for a purpose into a folder; return how many files it has, and bytes."""
    for file in files_for(PARTS[part]):
        place = target / file.relative_to(PACKAGE)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, place)
    start = start_of_package(part)
    (target / "__init__.py").write_text(start, encoding="utf-8")
    shutil.copyfile(PACKAGE / "py.typed", target / "py.typed")
    shutil.copyfile(ROOT / "LICENSE", target / "LICENSE")
    version = next(line for line in start.splitlines() if line.startswith("__version__")).split("=")[1].strip(" \"'")
    note = f"uwblite {version}{f', commit {commit()}' if commit() else ''}\npart of it, for: {part}\nmade by tools/vendor.py\n"
    (target / "VERSION").write_text(note, encoding="utf-8")
    written = [file for file in target.rglob("*") if file.is_file()]
    return len(written), sum(file.stat().st_size for file in written)


def main() -> int:
    """Copy, or list what there is to copy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", metavar="DEST", nargs="?", type=Path, help="folder of the copy; its name is free")
    parser.add_argument("--for", dest="part", choices=tuple(PARTS), help="what it is needed for")
    parser.add_argument("--list", action="store_true", help="list files and sizes of every part, copy nothing")
    parser.add_argument("--force", action="store_true", help="replace a copy that is there: what else lies in DEST goes too")
    args = parser.parse_args()
    if args.list:
        for part, modules in PARTS.items():
            files = files_for(modules)
            kilobytes = sum(f.stat().st_size for f in files) / 1e3
            print(f"{part:<11} {len(files):4} modules, {kilobytes:6.0f} kB: {', '.join(modules)}")
        return 0
    if args.target is None or args.part is None:
        parser.error("name a folder, and with --for what the copy is needed for")
    if args.target.exists() and any(args.target.iterdir()):
        if not args.force:
            parser.error(f"{args.target} is not empty; --force replaces it")
        if not (args.target / "VERSION").is_file():
            parser.error(f"{args.target} is no earlier copy (it has no VERSION); choose another folder")
        shutil.rmtree(args.target)
    count, size = copy(args.part, args.target)
    print(f"{args.target}: {count} files, {size / 1e3:.0f} kB, for {args.part}: {', '.join(PARTS[args.part])}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
