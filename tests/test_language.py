"""Docstrings begin with their noun or verb."""

import ast
import re
from collections.abc import Iterator

from places import ROOT

FRAGMENT = re.compile(r"(Of|That|Those|What|Where|Which|How|The same|As|Beside|With|In)\b")
SOURCES = sorted((ROOT / "src" / "jcr").rglob("*.py"))


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and text of the docstrings of modules, classes, functions, fields and constants."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if documented and (text := ast.get_docstring(node)):
            yield body[0].lineno, text
        for before, below in zip(body, body[1:], strict=False):
            if isinstance(before, ast.Assign | ast.AnnAssign) and isinstance(below, ast.Expr):
                value = below.value
                if isinstance(value, ast.Constant) and isinstance(value.value, str):
                    yield below.lineno, value.value


def test_no_docstring_is_a_fragment():
    found = [
        f"{file.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for file in SOURCES
        for line, text in docstrings(ast.parse(file.read_text()))
        if FRAGMENT.match(text.strip())
    ]
    assert found == []
