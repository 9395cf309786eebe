"""The pages of the manual: beside the source in a checkout, else where the distribution installed them."""

from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

from jcr.errors import InputError, did_you_mean
from jcr.extras import DISTRIBUTION

CHECKOUT = Path(__file__).parents[2] / "docs"
SECTIONS = ("tutorials", "how-to", "reference", "explanation", "results")
"""Folders of pages. Those of results are named with their folder, as other pages have the same names."""


def pages() -> dict[str, Path]:
    """Return the file of each page by its name, as `jcr docs` takes it; empty where no page was installed."""
    if (CHECKOUT / "conf.py").is_file():
        found = sorted(CHECKOUT.rglob("*.md"))
    else:
        try:
            installed = [file for file in files(DISTRIBUTION) or [] if file.suffix == ".md"]
        except PackageNotFoundError:  # run from source files alone
            installed = []
        found = sorted(Path(str(file.locate())) for file in installed if f"doc/{DISTRIBUTION}/" in str(file))
    order = {section: number for number, section in enumerate(SECTIONS)}
    found = [
        path for path in found if path.parent.name in order and path.name not in ("index.md", "README.md")
    ]
    found.sort(key=lambda path: order[path.parent.name])
    return {_name(path): path for path in found}


def _name(path: Path) -> str:
    return f"results/{path.stem}" if path.parent.name == "results" else path.stem


def page(name: str) -> str:
    """Return the Markdown of a page by its name (`captures`, `results/speed`); raise InputError without such a page."""
    found = pages()
    if name not in found:
        there = ", ".join(other for other in found if "/" not in other) or "none on this machine"
        raise InputError(f"jcr docs {name}: no such page{did_you_mean(name, found)}; there are: {there}")
    return found[name].read_text(encoding="utf-8")


def title(path: Path) -> str:
    """Return the first heading of a page."""
    with path.open(encoding="utf-8") as lines:
        return next((line[2:].strip() for line in lines if line.startswith("# ")), path.stem)
