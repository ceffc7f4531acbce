"""Counting the package: a planted one whose numbers are known."""

import house


def test_a_planted_package_is_counted(tmp_path):
    (tmp_path / "low.py").write_text('"""Doc 7."""\nLIMIT = 3.5\nHALF = -0.5\n')
    for name, text in {
        "io/reader.py": "from ..low import LIMIT\nMOST = 99\n",
        "solver/__init__.py": "",
        "solver/steps.py": "from .. import low\nfrom .inner import a\n\n\ndef f(x):\n    return x * 1e-6 + 2 * low.LIMIT\n",
        "solver/inner.py": "class C:\n    gate: float = 0.15\n    on: bool = True\n",
    }.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    found = house.measure(tmp_path)
    assert (found.files, found.lines, found.core_lines) == (5, 14, 12)
    assert (found.literals, found.constants) == (3, 2)
    assert (found.rooms, found.arrows) == (3, 2)
