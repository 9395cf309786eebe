"""What the documents name exists: files, links, imports."""

import ast
import json
import re
import runpy
import shlex
import tomllib
from html import unescape
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
import yaml
from benchmarks.freshness import OLD

from jcr.cli import COMMANDS, dispatch
from jcr.cli.usage import parsed
from jcr.errors import InputError
from jcr.pages import page as page_named
from jcr.pages import pages
from places import ROOT

SOURCE = ROOT / "src" / "jcr"
ARCHITECTURE = ROOT / "docs" / "explanation" / "architecture.md"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
MORE_PAGES = [
    ROOT / "CHANGELOG.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "SECURITY.md",
    ROOT / "examples" / "README.md",
]


def without_code(page: Path) -> str:
    return re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)


def without_old(page: Path) -> str:
    """Without the files that a page of results says have changed, or gone."""
    return "\n".join(line for line in page.read_text().splitlines() if not line.startswith(OLD))


def anchors(page: Path) -> set[str]:
    """The headings of a page as GitHub makes anchors of them."""
    headings = re.findall(r"^#+ (.+)$", without_code(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def stages() -> set[str]:
    """Packages as `name/` and modules as `name.py`, of the top of the source."""
    packages = {f"{path.parent.name}/" for path in SOURCE.glob("*/__init__.py")}
    modules = {path.name for path in SOURCE.glob("*.py") if not path.name.startswith("__")}
    return packages | modules


@pytest.mark.parametrize("page", [*PAGES, *MORE_PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_relative_links_resolve(page):
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", without_code(page)):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert not broken


@pytest.mark.parametrize("page", [*PAGES, *MORE_PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_named_files_of_the_project_exist(page):
    named = re.findall(r"`(?:python )?((?:src|tests|benchmarks|examples|docs)/[\w/.-]+)", without_old(page))
    assert not [path for path in named if not (ROOT / path).exists()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_imports_of_the_examples_on_a_page_exist(page):
    """Read from the source, so that nothing heavy is imported."""
    missing = []
    for code in re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL):
        for module, names in re.findall(r"^from (jcr[\w.]*) import (.+)$", code, flags=re.MULTILINE):
            file = SOURCE.joinpath(*module.split(".")[1:]).with_suffix(".py")
            defined = {
                node.name
                for node in (ast.parse(file.read_text()).body if file.is_file() else ())
                if isinstance(node, ast.FunctionDef | ast.ClassDef)
            }
            missing += [f"{module}.{name}" for name in names.split(", ") if name not in defined]
    assert not missing


def commands(page: Path) -> list[str]:
    """The lines of a page's code blocks that call jcr, without comments; continued lines are one."""
    blocks = re.findall(
        r"^ *```(?:bash|text)?\n(.*?)^ *```", page.read_text(), flags=re.DOTALL | re.MULTILINE
    )
    lines = [line.strip() for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [re.split(r"\s+#|\s+&&|\s+>", line)[0] for line in lines if re.match(r"jcr [a-z]", line)]


@pytest.mark.parametrize("page", [*PAGES, *MORE_PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_on_a_page_are_understood(page):
    if page.parent.name == "results":
        return  # what was typed when it was measured, mistakes included
    for line in commands(page):
        _, name, *rest = shlex.split(line)
        assert name in COMMANDS, line
        command = import_module(f"jcr.cli.{name.replace('-', '_')}")
        try:
            parsed(command.Arguments, f"jcr {name}", rest)
        except InputError as error:
            pytest.fail(f"{line}\n{error}")


def test_pages_that_messages_name_exist():
    named = {
        name
        for file in SOURCE.rglob("*.py")
        for name in re.findall(r"jcr docs ([a-z][\w/-]*)", file.read_text())
    }
    assert named and named <= pages().keys()


@pytest.mark.parametrize("name", ["api.md", "backends.md", "cli.md", "formats.md"])
def test_pages_of_the_reference_are_those_that_the_source_makes(name: str):
    spec = spec_from_file_location("generated", ROOT / "docs" / "generated.py")
    assert spec is not None and spec.loader is not None
    generated = module_from_spec(spec)
    spec.loader.exec_module(generated)
    written = (ROOT / "docs" / "reference" / name).read_text()
    assert generated.PAGES[name]() == written, "write it again: python docs/generated.py"


def test_pages_are_printed_and_listed(capsys: pytest.CaptureFixture[str]):
    assert dispatch(["docs", "captures"]) == 0
    assert capsys.readouterr().out == (ROOT / "docs" / "reference" / "captures.md").read_text()
    assert dispatch(["docs"]) == 0
    assert "results/run" in capsys.readouterr().out
    with pytest.raises(InputError, match="no such page; there are: .*captures"):
        page_named("nonsense")
    with pytest.raises(InputError, match="did you mean troubleshooting?"):
        page_named("troubleshoot")


def test_symptoms_are_in_the_words_of_messages():
    page = (ROOT / "docs" / "how-to" / "troubleshooting.md").read_text()
    constants = (
        node.value
        for file in SOURCE.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
    said = "\n".join(constants)
    quotes = re.findall(r'"([^"\n]+)"', page)
    pieces = [piece.strip() for quote in quotes for piece in re.split(r"…|\d+(?:\.png)?|ur5e", quote)]
    long_enough = [piece for piece in pieces if len(piece) > 8]
    assert len(long_enough) > 10 and [piece for piece in long_enough if piece not in said] == []


def test_every_page_that_a_checkout_has_is_installed():
    import tomllib

    tool = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    shipped = {file for globs in tool["data-files"].values() for glob in globs for file in ROOT.glob(glob)}
    assert set(pages().values()) <= shipped


def test_the_readme_is_short_before_its_limits():
    assert len((ROOT / "README.md").read_text().split("## Limits")[0].split()) <= 600


def test_the_schema_of_captures_takes_ours_and_knows_every_key_that_is_read():
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads((ROOT / "docs" / "reference" / "schemas" / "capture.schema.json").read_text())
    valid = jsonschema.Draft202012Validator(schema)
    valid.validate(json.loads((ROOT / "examples" / "tabletop" / "capture.json").read_text()))
    cell = re.search(r"```json\n(.*?)```", (ROOT / "docs" / "how-to" / "cameras.md").read_text(), re.DOTALL)
    assert cell is not None
    content: dict[str, Any] = json.loads(cell[1])
    content["cameras"]["right"]["frames"][0]["base_from_gripper"] = content["frames"][0]["base_from_gripper"]
    valid.validate(content)
    assert not valid.is_valid({"frames": [{"image": "a.png"}]})
    source = "\n".join(
        (SOURCE / "capture" / file).read_text()
        for file in ("formats/capture_json.py", "cell_cameras.py", "camera_json.py")
    )
    read = set(re.findall(r"\b(?:content|frame|camera|intrinsics|given)\.get\(\"(\w+)\"", source))
    known = set(schema["properties"]).union(
        *(part.get("properties", {}) for part in schema["$defs"].values())
    )
    assert len(read) > 10 and read <= known


def test_architecture_names_what_there_is():
    """A bare file name belongs to the package that its paragraph is about, or to the top of the source."""
    missing, seen = [], set()
    for paragraph in re.split(r"\n(?=- )|\n\n", ARCHITECTURE.read_text()):
        about = re.match(r"- \*\*(.*?)\*\*", paragraph)
        packages = re.findall(r"`([\w/]+/)`", about[1]) if about else []
        places = [SOURCE, ROOT, *(SOURCE / package for package in packages)]
        for name in re.findall(r"`([\w/]+(?:\.py|/))`", paragraph):
            if not any((place / name).exists() for place in places):
                missing.append(name)
            seen.add(name)
    assert not missing
    assert not stages() - seen


def test_image_shows_what_there_is():
    drawn = (ROOT / "docs" / "explanation" / "packages.svg").read_text()
    assert drawn == runpy.run_path(str(ROOT / "docs" / "explanation" / "packages.py"))["drawing"]()
    names = re.findall(r'<text class="name"[^>]*>([^<]*)<', drawn)
    shown = {
        name if name.endswith(("/", ".py")) else f"{name}.py"
        for text in names
        for name in unescape(text).split(", ")
    }
    assert not stages() - shown


def test_version_and_date_of_the_release_are_the_same_everywhere():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    latest = re.search(r"^## (\S+) — (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert latest is not None
    assert (cited["version"], str(cited["date-released"])) == latest.groups()
    assert latest[1] == version
