"""Files, imports, commands and extras that the documents name exist; docstrings begin with noun or verb."""

import ast
import json
import re
import shlex
import sys
import tomllib
from collections.abc import Iterator
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
import tyro
import yaml

import jcr
from benchmarks.__main__ import Arguments as BenchArguments
from jcr.cli import COMMANDS, command, dispatch
from jcr.cli.arguments import parsed
from jcr.cli.board_docs_models import page as page_named
from jcr.cli.board_docs_models import pages
from jcr.errors import InputError
from jcr.extras import DISTRIBUTION, extra
from jcr.findings import FindingKind
from jcr.records.capture_schema import CameraEntry, CaptureFile, FrameEntry, IntrinsicsEntry
from places import ROOT
from refusal import refused
from simulation.__main__ import Arguments as SimulationArguments

TEXTS = [file.read_text() for file in sorted((ROOT / "src" / "jcr").rglob("*.py"))]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
# Pages of results show the command of the day on which they were measured.
MADE = {"api.md", "cli.md", "findings.md", "formats.md"}
MANUAL = [
    page
    for page in sorted((ROOT / "docs").rglob("*.md"))
    if page.parent.name != "results" and page.name not in MADE
]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "examples/README.md")),
    *MANUAL,
]
MODULES = {"simulation": SimulationArguments, "benchmarks": BenchArguments}


def commands(page: Path) -> list[tuple[str, bool]]:
    """Return the commands of jcr, `simulation` and `benchmarks` on a page, and whether each is complete.

    Those in code blocks are complete; comments, redirections and further commands on the line are cut off, continued
    lines are joined. Those in inline code may leave arguments out.
    """
    text = page.read_text().replace("\\\n", " ")
    blocks = re.findall(r"^ *```(?:bash|text|console)?\n(.*?)^ *```", text, flags=re.DOTALL | re.MULTILINE)
    lines = [line.strip() for block in blocks for line in block.splitlines()]
    calls = [line for line in lines if re.match(r"jcr [a-z]|python -m (?:simulation|benchmarks)", line)]
    inline = re.findall(r"`(jcr [a-z][^`\n]*|python -m (?:simulation|benchmarks) [^`\n]*)`", text)
    complete = [(re.split(r"\s+#|\s+&&|\s+>", line)[0], True) for line in calls]
    return complete + [(line, False) for line in inline]


def understand(line: str, is_complete: bool) -> None:
    """Raise InputError or SystemExit unless the command exists and takes its arguments, if it is complete."""
    program, name, *rest = shlex.split(line)
    if program == "jcr" and name not in COMMANDS:
        raise InputError("no such command")
    if is_complete and program == "jcr":
        parsed(command(name), f"jcr {name}", rest)
    elif is_complete:
        tyro.cli(MODULES[rest[0]], args=rest[1:])


def test_commands_in_the_documents_exist_and_take_their_arguments():
    found = {(page, *command) for page in PAGES for command in commands(page)}
    wrong = []
    for page, line, is_complete in sorted(found):
        try:
            understand(line, is_complete)
        except (InputError, SystemExit, ValueError) as error:
            wrong.append(f"{page.relative_to(ROOT)}: {line}: {error}")
    assert len(found) > 100 and wrong == []


def test_files_and_imports_that_the_documents_name_exist():
    pattern = r"`(?:python )?((?:src|tests|simulation|benchmarks|examples|docs)/[\w/.-]+)"
    missing = []
    for page in PAGES:
        text = page.read_text()
        missing += [(page.name, path) for path in re.findall(pattern, text) if not (ROOT / path).exists()]
        code = "\n".join(re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL))
        for module, names in re.findall(r"^from (jcr[\w.]*) import (.+)$", code, flags=re.MULTILINE):
            there = vars(import_module(module))
            missing += [(page.name, f"{module}.{name}") for name in names.split(", ") if name not in there]
    assert missing == []


def test_pages_of_the_reference_are_made_from_the_source():
    spec = spec_from_file_location("generated", ROOT / "docs" / "generated.py")
    generated = module_from_spec(spec)
    spec.loader.exec_module(generated)
    made = {name: page() for name, page in generated.PAGES.items()}
    assert all(f"## jcr {name}" in made["cli.md"] for name in COMMANDS)
    assert all(f"## jcr.{name}" in made["api.md"] for name in jcr.__all__)
    assert "| `gripper_from_camera`" in made["formats.md"]
    assert all(f"### `{kind}`" in made["findings.md"] for kind in FindingKind)
    old = [name for name, page in made.items() if page != (ROOT / "docs" / "reference" / name).read_text()]
    assert not old, f"write them again: python docs/generated.py ({old})"


def test_pages_are_installed_printed_listed_and_named_by_messages(capsys: pytest.CaptureFixture[str]):
    assert dispatch(["docs", "captures"]) == 0
    assert capsys.readouterr().out == (ROOT / "docs" / "reference" / "captures.md").read_text()
    assert dispatch(["docs"]) == 0
    listed = capsys.readouterr().out
    assert all(f"\n  {name} " in listed for name in ("results/speed", "api", "cli", "findings", "formats"))
    for name, said in (
        ("board", "pages that contain this word: .*markers"),
        ("tool centre point", "pages that contain these words: .*formats"),
        ("xyzzy", "`jcr docs` lists the pages"),
        ("troubleshoot", "did you mean troubleshooting?"),
    ):
        with refused(said):
            page_named(name)
    named = {name for text in TEXTS for name in re.findall(r"jcr docs ([a-z][\w/-]*)", text)}
    assert named and named <= pages().keys()
    data_files = PROJECT["tool"]["setuptools"]["data-files"]
    shipped = {file for globs in data_files.values() for glob in globs for file in ROOT.glob(glob)}
    assert set(pages().values()) <= shipped


def test_symptoms_are_in_the_words_of_messages():
    page = (ROOT / "docs" / "how-to" / "troubleshooting.md").read_text()
    constants = (
        node.value
        for text in TEXTS
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
    said = "\n".join(constants)
    quotes = re.findall(r'"([^"\n]+)"', page)
    pieces = [piece.strip() for quote in quotes for piece in re.split(r"…|\d+(?:\.png)?|ur5e", quote)]
    long_enough = [piece for piece in pieces if len(piece) > 8]
    assert len(long_enough) > 10 and [piece for piece in long_enough if piece not in said] == []


def test_the_schema_of_captures_takes_ours_and_knows_every_key_that_is_read():
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads((ROOT / "docs" / "reference" / "schemas" / "capture.schema.json").read_text())
    valid = jsonschema.Draft202012Validator(schema)
    valid.validate(json.loads((ROOT / "examples" / "tabletop" / "capture.json").read_text()))
    cell = re.search(r"```json\n(.*?)```", (ROOT / "docs" / "how-to" / "cameras.md").read_text(), re.DOTALL)
    content: dict[str, Any] = json.loads(cell[1])
    content["cameras"]["right"]["frames"][0]["base_from_gripper"] = content["frames"][0]["base_from_gripper"]
    valid.validate(content)
    assert not valid.is_valid({"frames": [{"image": "a.png"}]})
    read = set().union(*(one.model_fields for one in (CaptureFile, FrameEntry, CameraEntry, IntrinsicsEntry)))
    known = set().union(*(part.get("properties", {}) for part in (schema, *schema["$defs"].values())))
    assert len(read) > 10 and read <= known


def test_version_and_date_of_the_release_are_the_same_everywhere():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    latest = re.search(r"^## (\S+) — (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert latest is not None and latest[1] == PROJECT["project"]["version"]
    assert (cited["version"], str(cited["date-released"])) == latest.groups()


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


METADATA = PROJECT["project"]


def test_the_extras_that_are_named_exist():
    assert METADATA["name"] == DISTRIBUTION
    named = set()
    for folder in ("src", "benchmarks", "docs", "examples"):
        for file in (one for one in (ROOT / folder).rglob("*.*") if one.suffix in (".py", ".md")):
            text = file.read_text()
            assert not re.search(r"pip\s+install\s+'?jcr\b(?!-)", text), file
            several = ",".join(re.findall(rf"{DISTRIBUTION}\[([\w,]+)\]", text)).split(",")
            every = [*re.findall(r'\bextra\("[\w.]+", "(\w+)"', text), *filter(None, several)]
            named |= {(name, file.name) for name in every}
    assert {name for name, _ in named} >= {"networks", "view", "sam", "ros", "lerobot", "planning"}
    assert not {(name, file) for name, file in named if name not in METADATA["optional-dependencies"]}


def test_the_lowest_versions_are_those_that_are_tested():
    bounds = {}
    for requirement in [*METADATA["dependencies"], *METADATA["optional-dependencies"]["ros"],
                        *METADATA["optional-dependencies"]["lerobot"]]:  # fmt: skip
        name, version = re.fullmatch(r"([\w-]+)>=([\d.]+)(?:,.*)?", requirement).groups()
        bounds[name] = version
    pinned = dict(
        line.split("==")
        for line in (ROOT / "constraints-lowest.txt").read_text().splitlines()
        if "==" in line
    )
    assert pinned.keys() == bounds.keys()
    for name, version in bounds.items():
        shortest = re.sub(r"(\.0)+$", "", pinned[name])
        assert shortest == version or pinned[name].startswith(f"{version}.0."), name


def test_a_package_that_is_there_but_broken_reports_why(tmp_path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "brokenpackage.py").write_text("raise ImportError('libmissing.so: no such file')")
    monkeypatch.syspath_prepend(tmp_path)
    with refused(r"cannot be imported \(libmissing.so: no such file\): pip install"):
        extra("brokenpackage", "view", "the simulation")
    monkeypatch.setitem(sys.modules, "brokenpackage", None)
    with refused("the simulation needs brokenpackage, which is not installed"):
        extra("brokenpackage", "view", "the simulation")


def imported_by(module: Path) -> set[str]:
    """Return the modules of jcr that a module imports, at the top, in functions, or by name in a text."""
    found = set[str]()
    for node in ast.walk(ast.parse(module.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            found |= {node.module, *(f"{node.module}.{one.name}" for one in node.names)}
        elif isinstance(node, ast.Import):
            found |= {one.name for one in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("jcr."):
            found.add(node.value.partition(":")[0])
    return found


def test_the_tables_of_the_architecture_are_the_imports_of_the_code():
    """In the table of readings no import of one of its modules by another is missing, and all lead downwards."""
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text()
    source = ROOT / "src" / "jcr"
    of_section = dict(part.split("\n", 1) for part in page.split("\n## ")[1:])
    for title, is_whole in (("A capture on its way through `jcr run`", False), ("From files to poses", True)):
        rows = [line.split("|")[1:-1] for line in of_section[title].splitlines() if line.startswith("| `")]
        road = [re.findall(r"`([\w/.]+)`", row[0])[0] for row in rows]
        assert len(road) >= 8
        for place, row in enumerate(rows):
            file, listed = source / road[place], set(re.findall(r"`([\w/.]+)`", row[-1]))
            files = sorted(file.rglob("*.py")) if file.is_dir() else [file]
            known = set[str]().union(*map(imported_by, files))

            def uses(name: str, known: set[str] = known) -> bool:
                """Test whether a module or package, such as capture/read.py or capture/formats/, is imported."""
                dotted = "jcr." + name.removesuffix(".py").strip("/").replace("/", ".")
                return any(one == dotted or one.startswith(f"{dotted}.") for one in known)

            assert all((source / name).exists() and uses(name) for name in listed), (road[place], listed)
            if is_whole:
                assert {name for name in road if name != road[place] and uses(name)} == listed, road[place]
                assert not listed & set(road[: place + 1]), road[place]
