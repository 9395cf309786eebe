"""The field's words in what a person reads: documents, help, messages, docstrings, comments and identifiers."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from places import ROOT

GENERATED = ("cli.md", "api.md", "formats.md")
"""From the source, when the site is built."""

WORDS = {
    r"\boffset (?:of the camera|in the gripper)\b|\bof the offset\b|\bthe offset is\b": "translation",
    r"\blens(?:es)?\b": "intrinsics, or distortion; the glass alone is a lens",
    r"\bpictures?\b": "image",
    r"\bturn(?:s|ed|ing)?\b(?! (?:out|into|to|off|on|red|blue|green)\b)": "rotate, rotation",
    r"\bheld[ -]out\b|\bmissed by\b|\bleft out are predicted\b": "leave-one-out error",
    r"\bshows? too little\b|\bno motion shows?\b|\bnot shown yet\b": "unobservable, degenerate motion",
    r"\bcures?\b": "remedy",
    r"\b(?:goes|go|compares?|found) by colou?rs?\b|\bcompares colou?rs\b": "direct (photometric) alignment",
    r"\bevened\b|\bevening\b": "exposure compensation, gain",
    r"\btold\b": "weight, residual, predicted pose, …: whichever it is",
    r"\brobot's word\b|\bno say\b|\ba say\b": "reported pose; the robot pose is not used",
    r"\brobot's noise\b": "robot pose noise",
    r"\bcovariance (?:that )?(?:covers|holds)\b": "the covariance is calibrated",
    r"\b(?:not )?to be trusted\b|\bnot trusted\b|\bis trusted\b|\bare trusted\b": "accepted, rejected",
    r"\bg[ai]ves? nothing\b": "failed: registered 2 of 12 images",
    r"\bdetective\b": "pose-convention diagnosis",
    r"\bfood of\b": "observations",
    r"\bgo(?:es)? on (?:with|from)\b|\bgone on with\b|\bcommand goes on\b": "resumed",
    r"\bmend(?:s|ed)?\b": "fix",
    r"\bask(?:s|ing)? the map\b": "query the map",
    r"\bwhat leaves\b": "export formats",
    r"\bone fears\b": "has the camera moved?",
    r"\brooms?\b|\bhouse\b": "package, module",
    r"\brough start\b|\bwild\b": "initial estimate",
    r"\banew\b|\bof which\b|\bso many\b|\bnone else\b": "again, whose, n, no others",
}
"""What is not said (a pattern), and what is said in its place."""
MEANT = re.compile(
    r"\b(?:has|leaves?|make|of|little|much) room\b|room (?:on|in|for|to)\b|room is\b|--[\w-]+|"
    r"turns? images into|in turn\b|in the original image"
)
"""Words in another meaning: disk room, one after the other; and options."""


STRING_OR_COMMENT = re.compile(
    r"(#[^\n]*)"
    r'|(?:\b[bfruBFRU]{1,2})?(?:"""(?:[^"\\]+|\\.|"(?!""))*"""|"(?!"")(?:[^"\\\n]+|\\.)*")'
    r"|(?:\b[bfruBFRU]{1,2})?(?:'''(?:[^'\\]+|\\.|'(?!''))*'''|'(?!'')(?:[^'\\\n]+|\\.)*')",
    re.DOTALL,
)
"""A comment, or a whole string of Python 3.11 with its prefix. Python's own tokenizer takes many times as long."""


def without_code(text: str) -> str:
    """What is not between backticks: names keep their spelling."""
    return re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)", " ", text, flags=re.DOTALL)


def faults(text: str) -> list[str]:
    """Every word that is not said, with what is."""
    text = MEANT.sub(" ", re.sub(r"\s+", " ", without_code(text)))
    return [
        f"{found[0]!r}: {right}" for wrong, right in WORDS.items() for found in re.finditer(wrong, text, re.I)
    ]


def docstrings(file: Path) -> list[str]:
    """The docstrings of a module, its classes and functions."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    nodes = (node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, documented))
    return [text for node in nodes if (text := ast.get_docstring(node))]


def names(file: Path) -> list[str]:
    """The identifiers of a Python file in which a word stands that no identifier has."""
    found = comments_and_names(file)[1]
    if file.name in OF_FILES_ONLY_IN:
        found -= OF_FILES
    return sorted(
        name
        for name in found
        if NO_NAMES & {part.lower() for part in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name)}
    )


@cache
def comments_and_names(file: Path) -> tuple[list[str], frozenset[str]]:
    """The comments and the identifiers of a Python file; what stands in its strings is neither."""
    comments: list[str] = []

    def taken_out(found: re.Match[str]) -> str:
        comments.extend(filter(None, [found[1]]))
        return " "

    code = STRING_OR_COMMENT.sub(taken_out, file.read_text())
    return comments, frozenset(re.findall(r"\b[^\W\d]\w*", code))


def strings(file: Path) -> list[str]:
    """The texts of a Python file that have more than one word: messages, help and docstrings."""
    found = (node.value for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Constant))
    return [text for text in found if isinstance(text, str) and " " in text.strip()]


DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "SECURITY.md",
    *sorted(
        page
        for page in (ROOT / "docs").rglob("*.md")
        if page.parent.name != "results" and page.name not in GENERATED
    ),
]
MODULES = sorted([*(ROOT / "src" / "jcr").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")])
TESTS = sorted((ROOT / "tests").rglob("*.py"))
NO_NAMES = {
    "told", "lens", "lenses", "picture", "pictures", "turn", "turns", "turned", "turning", "missed", "room", "rooms",
    "trusted", "held", "food", "say", "says", "cure", "mended",
}  # fmt: skip
"""No identifier is made of these words, but for fields of files and the names that version 0.1 had."""
OF_FILES = {"held_out", "held_out_mm", "held_out_deg", "turn_std_deg", "NotTrustedError", "pictures", "lens"}
OF_FILES_ONLY_IN = {
    "batch.py", "calibration_json.py", "cameras_json.py", "errors.py", "pipeline.py", "results.py", "verdict.py",
    "viewer.py", "words.py", "__init__.py", "structure.py", "test_api.py", "real.py",
}  # fmt: skip


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: str(page.relative_to(ROOT)))
def test_documents_show_it_in_the_words_of_the_field(page: Path):
    assert faults(page.read_text()) == []


def test_source_is_in_the_words_of_the_field():
    texts = {file: strings(file) + comments_and_names(file)[0] for file in MODULES}
    texts |= {
        file: docstrings(file) + comments_and_names(file)[0]
        for file in TESTS
        if file.name != Path(__file__).name
    }
    found = {
        str(file.relative_to(ROOT)): [f for t in some for f in faults(t)] for file, some in texts.items()
    }
    assert {name: wrong for name, wrong in found.items() if wrong} == {}


def test_names_are_in_the_words_of_the_field():
    found = {str(file.relative_to(ROOT)): names(file) for file in [*MODULES, *TESTS]}
    assert {name: wrong for name, wrong in found.items() if wrong} == {}
