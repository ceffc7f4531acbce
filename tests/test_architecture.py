"""The structure: who may import whom, what library code must not do, and that the package works wherever it is put."""

import ast
import importlib
import re
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
KNOWN = frozenset(MODULES)

FLOORS = (
    ("errors", "findings"),
    ("arrays",),
    ("se2", "config", "clocks"),
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


@cache
def imports_of(module: str) -> tuple[str, ...]:
    """Return the modules of this package that are imported, but for those that only type checkers see."""
    here, found = module.split("/"), list[str]()
    typing_only = {
        id(child)
        for node in nodes_of(module)
        if isinstance(node, ast.If)
        and "TYPE_CHECKING" in {getattr(n, "id", getattr(n, "attr", "")) for n in ast.walk(node.test)}
        for child in ast.walk(node)
    }
    for node in nodes_of(module):
        if not isinstance(node, ast.ImportFrom) or not node.level or id(node) in typing_only:
            continue
        base = here[: len(here) - node.level] + (node.module.split(".") if node.module else [])
        for alias in node.names:
            whole = "/".join([*base, alias.name])
            found.append(whole if whole in KNOWN else "/".join(base))
    return tuple(found)


def algorithms_in_files_and_devices(module):
    algorithms = ("radio", "lidar", "loop_closure", "pipeline", "assessment", "mapping", "localize", "localization")
    solver = ("graph/solver", "graph/marginals")
    if module.startswith(("io/", "drivers/")):
        for imported in imports_of(module):
            if room_of(imported) in algorithms or imported in solver:
                yield f"{module} imports {imported}"


def inits(modules):
    return [m for m in modules if not m.endswith("__init__")]


def imports_from_above(module):
    for imported in () if module.endswith("__init__") else imports_of(module):
        if imported and room_of(imported) not in ("__init__", room_of(module)) and floor_of(imported) >= floor_of(module):
            yield f"{module} imports {imported}"


def test_no_import_circles():
    graph = {m: {i for i in imports_of(m) if i in KNOWN} for m in inits(MODULES)}
    done: set[str] = set()

    def visit(module, path):
        assert module not in path, " -> ".join([*path, module])
        if module not in done:
            for imported in graph.get(module, ()):
                visit(imported, (*path, module))
            done.add(module)

    for module in graph:
        visit(module, ())


def imports_by_the_name_of_the_package(module):
    for node in nodes_of(module):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and not node.level:
            names = [node.module or ""]
        if [n for n in names if n.split(".")[0] == "uwblite"]:
            yield f"{module}:{node.lineno}"


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


def noise_and_impurity(module):
    """Printing, exits, clocks, the environment, random numbers from nowhere, files below io and drivers."""
    for node in () if module.startswith("cli/") or module == "__main__" else nodes_of(module):
        if isinstance(node, ast.Attribute):
            name = ast.unparse(node)
            if name == "os.environ":
                yield f"{module}:{node.lineno} reads the environment"
            if name.startswith("np.random.") and name not in ("np.random.Generator", "np.random.default_rng"):
                yield f"{module}:{node.lineno} uses the global random generator"
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        if name in FORBIDDEN_CALLS:
            yield f"{module}:{node.lineno} uses {FORBIDDEN_CALLS[name]}"
        if not module.startswith("drivers/") and name in CLOCKS:
            yield f"{module}:{node.lineno} reads the clock or the environment"
        if not module.startswith("drivers/") and name.endswith("default_rng") and not node.args:
            yield f"{module}:{node.lineno} draws random numbers from nowhere"
        if not module.startswith(("drivers/", "io/")) and name == "open":
            yield f"{module}:{node.lineno} opens a file below io"


def numbers_of_a_fixed_width(module):
    """On 32-bit machines numpy takes no 64-bit numbers as indices or counts, and 32 bits hold no ids of files: Ints and WIDE of
    arrays.py say which is meant."""
    for node in () if module == "arrays" else nodes_of(module):
        name = node.attr if isinstance(node, ast.Attribute) else node.value if isinstance(node, ast.Constant) else ""
        if name in FIXED_WIDTHS:
            yield f"{module}:{node.lineno} says {name}; np.intp where it indexes, else WIDE of arrays.py"


FIXED_WIDTHS = ("int64", "int_", "longlong", "i8", "<i8", "=i8")


def mutable_state(module):
    for node in () if module.startswith("cli/") else tree_of(module).body:
        value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        names = [ast.unparse(t) for t in targets if t]
        constant = all(n.strip("_").isupper() or n == "__all__" or n[:1].isupper() for n in names)
        made = isinstance(value, ast.List | ast.Set | ast.ListComp | ast.SetComp)
        if made and not constant:
            yield f"{module}:{node.lineno} {names} looks mutable"
    if not module.startswith("cli/") and [n for n in nodes_of(module) if isinstance(n, ast.Global)]:
        yield f"{module} rebinds a global"


def options_in_messages(module):
    """Options of the command line, in what is said to someone who passed arrays; the pages' own texts and styles are theirs."""
    if module.startswith(("cli/", "server/", "report/")) or module == "__main__":
        return
    documents = {id(node.value) for node in nodes_of(module) if isinstance(node, ast.Expr)}
    for node in nodes_of(module):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documents:
            text = re.sub(r"var\(--\w+|<!--|ros2 topic .*|-m venv --\S+", "", node.value)
            if re.search(r"(?<![\w-])--[a-z]", text):
                yield f"{module}:{node.lineno} {text!r}"


def findings_made_elsewhere(module):
    """Screening and stages hand over facts; what they mean for people is said in one room, and of live poses beside it."""
    if room_of(module) in ("assessment", "localization", "findings"):
        return
    for node in nodes_of(module):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("doubt", "warning", "Finding"):
            yield f"{module}:{node.lineno} makes a finding; note a fact, and let a rule of assessment/ say it"


def records_by_value(module):
    """Records with arrays, which have no one truth when they are compared, are compared by identity, and so are those that hold
    such records; records do not change, but for a few that count or collect, and have no fields but their own."""
    for name, held, options in records_of(module):
        if options.get("eq") != "False" and held & with_arrays():
            yield f"{module} {name} compares arrays: eq=False"
        if options.get("frozen") != "True" and name not in COLLECTING:
            yield f"{module} {name} can be changed: frozen=True"
        if options.get("slots") != "True":
            yield f"{module} {name} takes fields that it has not, and more memory: slots=True"


COLLECTING = (
    "Collector", "Counts", "PortReport", "RecordFile", "RunningFit", "Sensor", "Silence", "Window", "_Scans",
)  # fmt: skip
"""Records that change."""


@cache
def records_of(module):
    """Return name, names in the annotations of its fields, and options of each dataclass."""
    found = []
    for node in nodes_of(module):
        for decorator in getattr(node, "decorator_list", ()) if isinstance(node, ast.ClassDef) else ():
            if getattr(getattr(decorator, "func", decorator), "id", "") == "dataclass":
                fields = [ast.unparse(field.annotation) for field in node.body if isinstance(field, ast.AnnAssign)]
                options = {word.arg: ast.unparse(word.value) for word in getattr(decorator, "keywords", ())}
                found.append((node.name, frozenset(re.findall(r"\w+", " ".join(fields))), options))
    return found


@cache
def with_arrays():
    """Return the names of the kinds of arrays, and of records that hold some, at any depth."""
    names = {"Floats", "Singles", "Ints", "Bools", "NDArray"}
    every = [(name, held) for module in MODULES for name, held, _ in records_of(module)]
    while more := {name for name, held in every if held & names} - names:
        names |= more
    return names


RULES = (
    algorithms_in_files_and_devices, imports_from_above, imports_by_the_name_of_the_package, noise_and_impurity,
    numbers_of_a_fixed_width, mutable_state, options_in_messages, findings_made_elsewhere, records_by_value,
)  # fmt: skip


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_no_module_has(rule):
    assert [fault for module in MODULES for fault in rule(module)] == []


def run_python(*words, cwd=None, path=PACKAGE.parent):
    environment = {"PATH": "/usr/bin:/bin"}
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
from acme._x.uwblite.config import field_docs
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
