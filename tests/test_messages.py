"""Messages are for people: nothing in the source reads one to decide."""

import ast
from collections.abc import Iterator

import pytest

from places import ROOT

SOURCES = [*(ROOT / "src" / "jcr").rglob("*.py"), *(ROOT / "ros2" / "jcr_ros" / "jcr_ros").glob("*.py")]
FIELDS = {"warnings", "doubt", "remarks", "advice", "why_not", "unobservable", "remedies"}
"""Attributes that hold messages."""
WORDS = {"text", "remedy", "sentence", "doubt_of", "warnings_of"}
"""Functions of jcr.findings."""
ERRORS = {"error", "failure", "nothing", "refusal"}
"""As exceptions are named."""
READS = {"split", "rsplit", "partition", "startswith", "endswith", "find", "index", "count", "removesuffix"}
"""Methods of a string that read it."""


def is_message(node: ast.expr, named: set[str]) -> bool:
    """Whether an expression is a message, or several; `named` are names bound to one."""
    match node:
        case ast.Attribute(attr=attr):
            return attr in FIELDS
        case ast.Name(id=name):
            return name in named
        case ast.Call(func=ast.Name(id="str"), args=[ast.Name(id=name)]):
            return name in ERRORS
        case ast.Call(func=ast.Name(id=name)):
            return name in WORDS
        case ast.Subscript(value=value):
            return is_message(value, named)
        case ast.BoolOp(values=values):
            return any(is_message(value, named) for value in values)
        case _:
            return False


def bound(nodes: list[ast.AST]) -> Iterator[tuple[ast.AST, str, ast.expr]]:
    """What gives names to values: the statement or comprehension, the name, the value or what it goes through."""
    for node in nodes:
        match node:
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                yield node, name, value
            case ast.NamedExpr(target=ast.Name(id=name), value=value):
                yield node, name, value
            case ast.For(target=ast.Name(id=name), iter=value):
                yield node, name, value
            case ast.comprehension(target=ast.Name(id=name), iter=value):
                yield node, name, value


def readings(tree: ast.AST) -> Iterator[int]:
    """Lines on which a message is read."""
    scopes = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)] or [tree]
    for scope in scopes:
        nodes = list(ast.walk(scope))
        named = {name for _, name, value in bound(nodes) if is_message(value, set())}
        for node in nodes:
            match node:
                case ast.Compare(left=left, ops=ops, comparators=comparators):
                    sides = [left, *comparators]
                    if any(isinstance(op, ast.In | ast.NotIn | ast.Eq | ast.NotEq) for op in ops) and any(
                        is_message(side, named) for side in sides
                    ):
                        yield node.lineno
                case ast.Call(func=ast.Attribute(value=ast.Name(id="re")), args=args):
                    if any(is_message(arg, named) for arg in args):
                        yield node.lineno
                case ast.Call(func=ast.Attribute(value=value, attr=attr), args=[_, *_]):
                    # Without an argument, split() makes one line of several.
                    if attr in READS and is_message(value, named):
                        yield node.lineno
                case ast.Subscript(value=ast.Attribute(attr=attr)):
                    if attr in FIELDS:
                        yield node.lineno


def test_no_message_is_read_to_decide():
    against = [
        f"{file.relative_to(ROOT)}:{line}"
        for file in SOURCES
        for line in sorted(set(readings(ast.parse(file.read_text("utf-8")))))
    ]
    assert not against


@pytest.mark.parametrize(
    "line",
    [
        'any("p = " in text for text in hand_eye.warnings)',
        "re.search(BOARD, calibration.doubt or '')",
        "fault, *others = (last.why_not or '').split('; ')",
        "first = hand_eye.warnings[0]",
        "if 'unit' in str(error): pass",
        "if sentence(one).startswith('the images'): pass",
        "words = text(finding)\n    if words == 'few': pass",
    ],
)
def test_reading_one_is_found(line: str):
    assert list(readings(ast.parse(f"def f():\n    {line}\n")))


def test_saying_one_is_no_reading():
    said = (
        "def f():\n    lines = [*found.warnings]\n    if found.doubt is not None: print(f'{found.doubt}')\n"
    )
    assert not list(readings(ast.parse(said)))
