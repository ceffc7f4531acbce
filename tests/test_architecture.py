"""The structure: who may import whom, what library code must not do, and that the package works wherever it is put."""

import ast
import importlib
import shutil
import subprocess
import sys
import zipfile
from functools import cache
from pathlib import Path

import pytest

import uwblite

PACKAGE = Path(uwblite.__file__).parent
MODULES = sorted(p.relative_to(PACKAGE).with_suffix("").as_posix() for p in PACKAGE.rglob("*.py"))

FLOORS = (
    ("errors", "arrays", "findings"),
    ("validation", "field_docs"),
    ("se2", "config"),
    ("sensor_log", "graph", "drivers"),
    ("problem",),
    ("constraints", "odometry", "grid"),
    ("map_result", "radio", "navigation"),
    ("lidar", "report"),
    ("screening",),
    ("loop_closure", "evaluation", "io"),
    ("pipeline",),
    ("assessment",),
    ("mapping",),
    ("localization",),
    ("server",),
    ("cli",),
    ("__main__",),
)
"""From the ground up: folders, and modules beside them. Each imports from the floors below its own, never from its own."""


def room_of(module: str) -> str:
    return module.partition("/")[0]


def floor_of(module: str) -> int:
    for number, rooms in enumerate(FLOORS):
        if room_of(module) in rooms:
            return number
    raise AssertionError(f"{module} has no floor; give {room_of(module)} one in tests/test_architecture.py")


def test_contributing_draws_the_same_floors():
    text = (PACKAGE.parent / "CONTRIBUTING.md").read_text()
    drawn = [line.split("  the ")[0].split() for line in text.split("```\ncli ")[1].split("```")[0].splitlines()]
    drawn[0] = ["cli"]
    known = {room for floor in FLOORS for room in floor}
    rooms = [{word for word in line if word in known} for line in drawn]
    assert rooms == [set(floor) for floor in reversed(FLOORS) if floor != ("__main__",)]


@cache
def tree_of(module: str) -> ast.Module:
    return ast.parse((PACKAGE / f"{module}.py").read_text())


@cache
def nodes_of(module: str) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(tree_of(module)))


def imports_of(module: str):
    """Yield (imported module of this package, whether only for type checking)."""
    here = module.split("/")
    typing_only = {
        id(child)
        for node in nodes_of(module)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for child in ast.walk(node)
    }
    for node in nodes_of(module):
        if not isinstance(node, ast.ImportFrom) or not node.level or id(node) in typing_only:
            continue
        base = here[: len(here) - node.level] + (node.module.split(".") if node.module else [])
        for alias in node.names:
            whole = "/".join([*base, alias.name])
            yield whole if whole in MODULES else "/".join(base)


@pytest.mark.parametrize("module", [m for m in MODULES if m.startswith(("io/", "drivers/"))])
def test_files_and_devices_know_no_algorithm(module):
    algorithms = ("radio", "lidar", "loop_closure", "pipeline", "assessment", "mapping", "localize", "localization")
    solver = ("graph/solver", "graph/marginals")
    assert not [m for m in imports_of(module) if room_of(m) in algorithms or m in solver]


def inits(modules):
    return [m for m in modules if not m.endswith("__init__")]


@pytest.mark.parametrize("module", inits(MODULES))
def test_imports_run_downwards(module):
    for imported in imports_of(module):
        if imported and room_of(imported) not in ("__init__", room_of(module)):
            assert floor_of(imported) < floor_of(module), f"{module} imports {imported} from above"


def test_no_import_circles():
    graph = {m: {i for i in imports_of(m) if i in MODULES} for m in inits(MODULES)}
    done: set[str] = set()

    def visit(module, path):
        assert module not in path, " -> ".join([*path, module])
        if module not in done:
            for imported in graph.get(module, ()):
                visit(imported, (*path, module))
            done.add(module)

    for module in graph:
        visit(module, ())


@pytest.mark.parametrize("module", MODULES)
def test_imports_within_the_package_are_relative(module):
    for node in nodes_of(module):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and not node.level:
            names = [node.module or ""]
        assert not [n for n in names if n.split(".")[0] == "uwblite"], f"{module}:{node.lineno} names the package by name"


def test_type_checkers_see_what_is_resolved_on_first_use():
    """`__getattr__` returns an object of any kind: without the imports beside it `build_map(log)` is an error to them."""
    imports = [node for node in ast.walk(tree_of("__init__")) if isinstance(node, ast.ImportFrom) and node.level]
    typed = {alias.name: node.module for node in imports for alias in node.names}
    assert set(typed) == set(uwblite._LAZY)
    for name, module in typed.items():
        assert getattr(importlib.import_module(f"uwblite.{module}"), name) is getattr(uwblite, name)
    assert {*typed, "__version__"} == set(uwblite.__all__)


FORBIDDEN_CALLS = {
    "print": "print",
    "exit": "exit",
    "input": "input",
    "sys.exit": "exit",
    "os._exit": "exit",
    "warnings.simplefilter": "a warnings filter",
    "warnings.filterwarnings": "a warnings filter",
    "np.seterr": "a global numpy setting",
    "np.random.seed": "the global random generator",
    "logging.basicConfig": "the host's logging",
    "importlib.metadata.version": "package metadata",
}
CLOCKS = ("time.time", "time.monotonic", "time.perf_counter", "datetime.now", "datetime.datetime.now", "os.getenv")


@pytest.mark.parametrize("module", [m for m in MODULES if not m.startswith("cli/") and m != "__main__"])
def test_library_code_is_silent_and_pure(module):
    for node in nodes_of(module):
        if isinstance(node, ast.Attribute):
            name = ast.unparse(node)
            assert name != "os.environ", f"{module}:{node.lineno} reads the environment"
            legacy = name.startswith("np.random.") and name not in ("np.random.Generator", "np.random.default_rng")
            assert not legacy, f"{module}:{node.lineno} uses the global random generator"
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        assert name not in FORBIDDEN_CALLS, f"{module}:{node.lineno} uses {FORBIDDEN_CALLS[name]}"
        if not module.startswith("drivers/"):
            assert name not in CLOCKS, f"{module}:{node.lineno} reads the clock or the environment"
            unseeded = name.endswith("default_rng") and not node.args
            assert not unseeded, f"{module}:{node.lineno} draws random numbers from nowhere"
        if not module.startswith(("drivers/", "io/")):
            assert name != "open", f"{module}:{node.lineno} opens a file below io"


@pytest.mark.parametrize("module", [m for m in MODULES if m != "arrays"])
def test_numbers_are_as_wide_as_addresses_or_named_as_wider(module):
    # On 32-bit machines numpy takes no 64-bit numbers as indices or counts, and 32 bits hold no ids of files: Ints and WIDE
    # of arrays.py say which is meant.
    for node in nodes_of(module):
        name = node.attr if isinstance(node, ast.Attribute) else node.value if isinstance(node, ast.Constant) else ""
        assert name not in FIXED_WIDTHS, f"{module}:{node.lineno} says {name}; np.intp where it indexes, else WIDE of arrays.py"


FIXED_WIDTHS = ("int64", "int_", "longlong", "i8", "<i8", "=i8")


@pytest.mark.parametrize("module", [m for m in MODULES if not m.startswith("cli/")])
def test_no_mutable_state_at_module_level(module):
    for node in tree_of(module).body:
        value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        names = [ast.unparse(t) for t in targets if t]
        constant = all(n.strip("_").isupper() or n == "__all__" or n[:1].isupper() for n in names)
        made = isinstance(value, ast.List | ast.Set | ast.ListComp | ast.SetComp)
        assert constant or not made, f"{module}:{node.lineno} {names} looks mutable"
    assert not [n for n in nodes_of(module) if isinstance(n, ast.Global)], f"{module} rebinds a global"


def run_python(*words, cwd=None, path=PACKAGE.parent):
    environment = {"PATH": "/usr/bin:/bin", "PYTHONDONTWRITEBYTECODE": "1"}
    if path:
        environment["PYTHONPATH"] = str(path)
    return subprocess.run([sys.executable, *words], cwd=cwd, env=environment, capture_output=True, text=True, check=False)


HEAVY = ("numpy", "scipy", "serial", "rosbags")
LOADED = f"import sys; print([m for m in {HEAVY!r} if m in sys.modules])"


def test_importing_the_package_loads_nothing_heavy():
    done = run_python("-c", f"import uwblite; {LOADED}")
    assert done.stdout.strip() == "[]", done.stderr


WORDS = ("--help", "--version", "map --help", "record --help", "mpa", "map", "check --no-such-option")


@pytest.mark.parametrize("words", WORDS)
def test_help_and_usage_errors_load_nothing_heavy(words):
    done = run_python("-c", f"import sys\nfrom uwblite.cli import main\nmain({words.split()!r})\n{LOADED}")
    assert done.stdout.strip().endswith("[]"), done.stdout + done.stderr


WITHOUT_SERIAL = """
import sys
sys.modules["serial"] = None
sys.path.insert(0, {path!r})
"""


@pytest.fixture(scope="module")
def vendored(tmp_path_factory):
    root = tmp_path_factory.mktemp("vendored")
    shutil.copytree(PACKAGE, root / "acme" / "_x" / "uwblite", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in ("acme", "acme/_x"):
        (root / folder / "__init__.py").touch()
    return root


USE = """
from acme._x import uwblite
from acme._x.uwblite.cli import main
from acme._x.uwblite.field_docs import field_docs
from acme._x.uwblite.odometry.keyframes import KeyframeConfig
assert field_docs(KeyframeConfig)["distance"]
assert not [m for m in sys.modules if m.split(".")[0] == "uwblite"]
log = uwblite.read_log({log!r})
assert len(log.odometry.stamps)
sys.exit(main(["--version"]))
"""


def test_works_copied_into_another_package_without_pyserial(vendored, room_log):
    code = WITHOUT_SERIAL.format(path=str(vendored)) + USE.format(log=str(room_log))
    done = run_python("-I", "-c", code)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"uwblite {uwblite.__version__}\n"


def test_works_out_of_a_zip(vendored, tmp_path, room_log):
    archive = tmp_path / "vendored.zip"
    with zipfile.ZipFile(archive, "w") as packed:
        for file in vendored.rglob("*.py"):
            packed.write(file, file.relative_to(vendored))
    done = run_python("-I", "-c", WITHOUT_SERIAL.format(path=str(archive)) + USE.format(log=str(room_log)))
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"uwblite {uwblite.__version__}\n"


def test_runs_as_a_module_under_another_name(vendored):
    done = run_python("-m", "acme._x.uwblite", "--version", cwd=vendored, path=vendored)
    assert done.stdout == f"uwblite {uwblite.__version__}\n", done.stderr
