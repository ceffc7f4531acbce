"""The page docs/findings.md: every kind of finding, from the rules' own code and texts and from the table of faults.

A rule is a function of the package that makes a finding of a kind; its docstring says what it looks at and why, its text is the
example. What the kind means and what to do stand in the table of docs/formats.md, what it explains in assessment/causes.py, and
the table of faults in docs/lab/accuracy.md shows which planted faults only this kind names.
"""

import ast
import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from uwblite.assessment.causes import EXPLAINS
from uwblite.assessment.facts import TEXTS

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "uwblite"
FACTORIES = {"doubt": "doubt", "warning": "warning", "Finding": "", "say": "", "add": ""}
"""Functions that make a finding of the kind that is their first argument, and its severity where they say it."""
MAKES = re.compile(r"\b(?:doubt|warning|Finding)\b|\b(?:say|add)\(\s*f?\"")
"""What stands in a file that makes findings."""
KIND = re.compile(r"[a-z]+(-[a-z]+)+|gyro|drift|scales|carried|uncertain|mirrored|reader|refused|silences|spikes")

HEAD = """\
# Findings

Written by `tools/make_docs.py` from the rules themselves; do not edit.

A finding says what is wrong in a recording, in a map or in a live pose. Its kind is a fixed name, for searching here and for
scripts (`kind` in `report.json` and in `--json`). A **doubt** is a reason not to trust the result: the files are written and
the exit code is 3. A **warning** was repaired or costs accuracy; a **note** is good to know. No rule takes back what another
found; what is a consequence of another finding names it (`explained_by`) and is told below it. Where a doubt is about stretches
of the path, these are marked in `map.png` and `report.html`, and the rest is as good as it states. Settings and
arguments stand in backticks; the command line puts its options there.

*Planted faults* are those of `tools/faults.py` in a simulated laboratory and in a real recording: the faults after which this
kind was the only doubt. A kind without such a fault is named by other rules at the same time, or needs a recording of another
sort (several recordings, a lost anchor, a wide place).
"""


@dataclass(frozen=True, slots=True)
class Rule:
    """A function that makes a finding of a kind."""

    kind: str
    severity: str
    """'doubt', 'warning', 'note', or several of them, as 'warning or doubt'."""
    room: str
    says: str
    """Docstring of the function; empty for a row of a table, whose text tells all."""
    text: str
    """The finding's text, an ellipsis in place of each value; empty where it is made elsewhere."""


@cache
def rules() -> tuple[Rule, ...]:
    """Return the rules of the package, in the order of kinds."""
    found: dict[tuple[str, str], Rule] = {}
    for kind, row in TEXTS.items():
        # Of a figure an ellipsis, of a choice the first text.
        text = re.sub(r"{[^{}|]+}", "...", row.text)
        text = re.sub(r"{[^{}:]+:([^{}|]*)\|[^{}]*}", r"\1", text)
        severity = "warning or doubt" if "{" in row.severity else row.severity
        found[kind, ""] = Rule(kind, severity, "assessment/facts.py", "", text)
    sources = ((path, path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py")))
    for path, text in sources:
        for function in _functions(ast.parse(text)) if MAKES.search(text) else ():
            for rule in _rules_of(function, path.relative_to(PACKAGE).as_posix()):
                known = found.get((rule.kind, rule.room + rule.says))
                if known is not None and known.severity != rule.severity:
                    rule = Rule(rule.kind, "warning or doubt", rule.room, rule.says, known.text or rule.text)
                found[rule.kind, rule.room + rule.says] = rule
    return tuple(sorted(found.values(), key=lambda rule: (rule.kind, rule.room)))


def _functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    return (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def _rules_of(function: ast.FunctionDef, room: str) -> Iterator[Rule]:
    assigned = [node for node in ast.walk(function) if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)]
    assigned.sort(key=lambda node: node.lineno)
    texts = [(node.lineno, getattr(node.targets[0], "id", ""), node.value) for node in assigned]
    for call in (node for node in ast.walk(function) if isinstance(node, ast.Call)):
        name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
        if not call.args or (name not in FACTORIES and not isinstance(call.func, ast.IfExp)):
            continue
        kind = _kind(call.args[0])
        if not kind or not KIND.fullmatch(kind):
            continue
        severity = FACTORIES.get(name, "")
        if name == "Finding" and len(call.args) > 1:
            names = {part.id.lower() for part in ast.walk(call.args[1]) if isinstance(part, ast.Name)}
            severity = " or ".join(sorted(names & {"doubt", "warning", "note"}, reverse=True))
        text = call.args[2 if name == "Finding" else 1] if len(call.args) > (2 if name == "Finding" else 1) else None
        if isinstance(text, ast.Name):
            before = [value for line, target, value in texts if target == text.id and line <= call.lineno]
            text = before[-1] if before else None
        yield Rule(kind, severity or "warning or doubt", room, ast.get_docstring(function) or "", plain(text))


def _kind(node: ast.expr) -> str:
    if isinstance(node, ast.JoinedStr):
        return "".join(part.value if isinstance(part, ast.Constant) else "x" for part in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def plain(node: ast.expr | None) -> str:
    """Return an expression for a text with an ellipsis in place of each value."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=values):
            return "".join(part.value if isinstance(part, ast.Constant) else "..." for part in values)
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return plain(left) + plain(right)
        case ast.IfExp(body=body):
            return plain(body)
        case _:
            return ""


def only_named_by() -> dict[str, list[str]]:
    """Return, by kind, the faults after which it was the only doubt, from the table in docs/lab/accuracy.md."""
    page = (ROOT / "docs" / "lab" / "accuracy.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (.+?) \|.*\| ([a-z, -]*) \|$", page.partition("### Every kind of fault")[2], re.M)
    alone: dict[str, list[str]] = {}
    for fault, kinds in rows:
        if kinds and "," not in kinds:
            alone.setdefault(kinds, []).append(fault)
    return alone


def short_form() -> dict[str, tuple[str, str]]:
    """Return, by kind, what it means and what to do, from the table in docs/formats.md."""
    table = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8").partition("### Warnings and doubts")[2]
    rows = re.findall(r"^\| ((?:`[a-z-]+`(?:, )?)+) \| [A-Z/]+ \| (.+?) \| (.+?) \|$", table, re.M)
    return {kind: (means, do) for kinds, means, do in rows for kind in re.findall(r"`([a-z-]+)`", kinds)}


def listed(kinds: Iterable[str]) -> str:
    """Return kinds as links to their paragraphs."""
    return ", ".join(f"[{kind}](#{kind})" for kind in sorted(kinds))


def page() -> str:
    """Return the text of docs/findings.md."""
    parts, alone, every, short = [HEAD], only_named_by(), rules(), short_form()
    by_kind: dict[str, list[Rule]] = {}
    named, made = {rule.kind for rule in every}, Counter((rule.room, rule.says) for rule in every)
    for rule in every:
        open_kind = re.compile(rule.kind.replace("x", "[a-z-]+")) if "x" in rule.kind.split("-") else None
        for kind in (rule.kind,) if open_kind is None else filter(open_kind.fullmatch, short.keys() - named):
            by_kind.setdefault(kind, []).append(rule)
    for kind, own in sorted(by_kind.items()):
        severities = {rule.severity for rule in own}
        means, do = short.get(kind, ("", ""))
        head = f"A {severities.pop() if len(severities) == 1 else 'warning or doubt'}{f': {means}' if means else ''}."
        parts.append(f"\n## {kind}\n\n{head}{f' **To do**: {do}.' if do else ''}\n")
        for rule in own:
            says = " ".join(rule.says.partition("\n\nParameters")[0].partition("\n\nReturns")[0].split())
            # What makes several kinds describes none of them.
            parts.append(f"\n{says} (`{rule.room}`)\n" if made[rule.room, rule.says] == 1 else f"\nIn `{rule.room}`:\n")
            if rule.text:
                parts.append(f"\n> {rule.text}\n")
        consequences = EXPLAINS.get(kind, frozenset()) & by_kind.keys()
        causes = [cause for cause, explained in EXPLAINS.items() if kind in explained and cause in by_kind]
        if consequences:
            parts.append(f"\nIt explains {listed(consequences)}.\n")
        if causes:
            parts.append(f"\nIt is explained by {listed(causes)}.\n")
        if kind in alone:
            parts.append(f"\nPlanted faults that only this kind names: {'; '.join(alone[kind])}.\n")
    return "".join(parts)
