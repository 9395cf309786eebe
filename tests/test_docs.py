"""What the documents name exists: files, links, imports."""

import ast
import re
import runpy
from html import unescape
from pathlib import Path

import pytest

from places import ROOT

SOURCE = ROOT / "src" / "jcr"
ARCHITECTURE = ROOT / "docs" / "explanation" / "architecture.md"
GENERATED = ("cli.md", "api.md", "formats.md")
"""By docs/generated.py, when the site is built."""
PAGES = [
    ROOT / "README.md",
    *sorted(page for page in (ROOT / "docs").rglob("*.md") if page.name not in GENERATED),
]
MORE_GENERATED = ("cli.md", "api.md", "formats.md")
"""By docs/generated.py, when the site is built."""
PAGES = [
    ROOT / "CHANGELOG.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "SECURITY.md",
    ROOT / "examples" / "README.md",
]


def without_code(page: Path) -> str:
    return re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)


def anchors(page: Path) -> set[str]:
    """The headings of a page as GitHub makes anchors of them."""
    headings = re.findall(r"^#+ (.+)$", without_code(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def rooms() -> set[str]:
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
        if (not target.exists() and target.name not in GENERATED) or (
            anchor and anchor not in anchors(target)
        ):
            broken.append(link)
    assert not broken


@pytest.mark.parametrize("page", [*PAGES, *MORE_PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_named_files_of_the_project_exist(page):
    named = re.findall(r"`(?:python )?((?:src|tests|benchmarks|examples|docs)/[\w/.-]+)", page.read_text())
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
    assert not rooms() - seen


def test_picture_shows_what_there_is():
    drawn = (ROOT / "docs" / "explanation" / "rooms.svg").read_text()
    assert drawn == runpy.run_path(str(ROOT / "docs" / "explanation" / "rooms.py"))["picture"]()
    names = re.findall(r'<text class="name"[^>]*>([^<]*)<', drawn)
    shown = {
        name if name.endswith(("/", ".py")) else f"{name}.py"
        for text in names
        for name in unescape(text).split(", ")
    }
    assert not rooms() - shown
