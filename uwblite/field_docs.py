"""The lines under the fields of a dataclass, for `help` and for settings files: Python itself does not keep them."""

import ast
import sys
from dataclasses import fields
from itertools import pairwise
from typing import Any, TypeVar

_Class = TypeVar("_Class", bound=type)


def field_docs(cls: type) -> dict[str, str]:
    """Return the docstring under each field of a class, by name; empty where the source is not at hand.

    `inspect` asks the module's loader where there is no file, so that the source is found in a zip too.
    """
    import inspect

    try:
        tree = ast.parse(inspect.getsource(sys.modules[cls.__module__]))
    except (OSError, TypeError, KeyError):
        return {}
    body = next((node.body for node in tree.body if isinstance(node, ast.ClassDef) and node.name == cls.__name__), [])
    docs = {}
    for node, below in pairwise([*body, ast.Pass()]):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        constant = below.value if isinstance(below, ast.Expr) else None
        text = constant.value if isinstance(constant, ast.Constant) else None
        docs[node.target.id] = " ".join(text.split()) if isinstance(text, str) else ""
    return docs


def documented(cls: _Class) -> _Class:
    """Let the docstring of a dataclass list its fields too; the source is read when somebody asks."""
    cls.__doc__ = _Docs(cls.__doc__ or "")  # type: ignore[assignment]
    return cls


class _Docs:
    """A docstring that is completed when it is read."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __get__(self, instance: Any, owner: type) -> str:
        docs = field_docs(owner)
        if not docs:
            return self.text
        texts = {f.name: docs.get(f.name) or getattr(f.type, "__name__", str(f.type)) for f in fields(owner)}
        listed = "".join(f"\n    {name} : {text}" for name, text in texts.items())
        return f"{self.text.rstrip()}\n\n    Attributes\n    ----------{listed}\n"
