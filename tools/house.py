"""The size of the package: lines, files, rooms, arrows between them, and the numeric literals of its core.

The core is everything but io, drivers and cli. Numeric literals are counted over the syntax tree, wherever they stand; 0, 1, 2
and 0.5, of either sign, and those in annotations and subscripts of types are no choices and do not count.
"""

import ast
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "uwblite"
OUTER = ("io", "drivers", "cli")
"""Rooms that read, write and talk to people and devices; the rest is the core."""
PLAIN = (0, 1, 2, 0.5)
"""Numbers that need no name."""


@dataclass(frozen=True, slots=True)
class House:
    """Counts of a package."""

    files: int
    lines: int
    core_lines: int
    literals: int
    """Numeric literals of the core."""
    constants: int
    """Of these, those in the value of an assignment of a module or class."""
    rooms: int
    arrows: int
    """Ordered pairs of rooms of which one imports from the other."""


def measure(package: Path = PACKAGE) -> House:
    """Count a package of which every folder and every module beside them is a room."""
    modules = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(package.rglob("*.py"))}
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in modules}
    core = [path for path in modules if room(path, package) not in OUTER]
    arrows = {(room(path, package), other) for path, tree in modules.items() for other in imported(path, tree, package)}
    return House(
        files=len(modules),
        lines=sum(lines.values()),
        core_lines=sum(lines[path] for path in core),
        literals=sum(len(literals(modules[path])) for path in core),
        constants=sum(len(literals(node)) for path in core for node in _assigned(modules[path])),
        rooms=len({room(path, package) for path in modules}),
        arrows=sum(1 for one, other in arrows if one != other),
    )


def room(path: Path, package: Path = PACKAGE) -> str:
    """Return the folder of the package, or the module beside them, to which a file belongs."""
    return path.relative_to(package).with_suffix("").parts[0]


def literals(tree: ast.AST) -> list[float | complex]:
    """Return the numbers of a tree that are not plain."""
    return [
        node.value for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and type(node.value) in (int, float, complex) and node.value not in PLAIN
    ]  # fmt: skip


def imported(path: Path, tree: ast.AST, package: Path = PACKAGE) -> set[str]:
    """Return the rooms from which a file imports, by its relative imports."""
    places = path.relative_to(package).parent.parts
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = places[: len(places) - node.level + 1] + tuple((node.module or "").split(".") if node.module else ())
            found |= {base[0]} if base else {alias.name for alias in node.names}
    return {name for name in found if (package / name).is_dir() or (package / f"{name}.py").is_file()}


def _assigned(tree: ast.Module) -> list[ast.expr]:
    """Return the values of assignments of a module and of its classes."""
    bodies = [tree.body, *(node.body for node in tree.body if isinstance(node, ast.ClassDef))]
    nodes = [node for body in bodies for node in body if isinstance(node, ast.Assign | ast.AnnAssign)]
    return [node.value for node in nodes if node.value is not None]
