"""The source: docstrings begin with their noun or verb, and imports between packages go downwards only."""

import ast
import re
from collections.abc import Iterator

from places import ROOT

FRAGMENT = re.compile(r"(Of|That|Those|What|Where|Which|How|The same|As|Beside|With|In)\b")


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and text of the docstrings of modules, classes, functions, fields and constants."""
    documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    for node in (one for one in ast.walk(tree) if isinstance(one, documented)):
        for before, own in zip([None, *node.body], node.body, strict=False):
            is_place = before is None or isinstance(before, ast.Assign | ast.AnnAssign)
            value = own.value if is_place and isinstance(own, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield own.lineno, value.value.strip()


def test_no_docstring_is_a_fragment():
    found = [
        f"{file.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for file in sorted((ROOT / "src" / "jcr").rglob("*.py"))
        for line, text in docstrings(ast.parse(file.read_text()))
        if FRAGMENT.match(text)
    ]
    assert found == []
