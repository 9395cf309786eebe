"""`benchmarks all`: every bench in a process of its own, and an index with one line per claim."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from benchmarks.freshness import is_marked_old
from benchmarks.table import BENCHES, LONG, PARTS, title_of
from jcr.errors import InputError
from jcr.files import write_text
from jcr.reconstruct.backends import BACKENDS

CHECKOUT = Path(__file__).parents[1]
CLAIM = "> "
"""Begins the lines of a bench's page that say in a sentence what was found."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment of benches that run two at a time; those that are timed have a user's."""
MARKS = ("<!-- python -m benchmarks all: begin -->", "<!-- python -m benchmarks all: end -->")
"""Lines of the index between which the claims go."""


@dataclass(frozen=True)
class Outcome:
    """What became of one bench."""

    name: str
    seconds: float
    trouble: str = ""
    """Why there is no new page."""


def run(
    benches: dict[str, bool],
    out: Path,
    arguments: dict[str, list[str]],
    report: Callable[[Outcome], None],
) -> list[Outcome]:
    """Run the benches, those that are not timed two at a time and then the timed ones alone, and write the index.

    `benches` has of each name whether it is timed; `arguments` holds what else each is given. A bench that fails loses
    no other one's page.
    """
    outcomes = dict[str, Outcome]()

    def measured(name: str, environment: Mapping[str, str]) -> None:
        outcomes[name] = _measured(name, out, arguments.get(name, []), environment)
        report(outcomes[name])

    with ThreadPoolExecutor(2) as two:
        list(
            two.map(lambda name: measured(name, ONE_THREAD), [name for name in benches if not benches[name]])
        )
    for name in benches:
        if benches[name]:
            measured(name, {})
    return [outcomes[name] for name in benches]


def _measured(name: str, out: Path, arguments: Sequence[str], environment: Mapping[str, str]) -> Outcome:
    begun = time.perf_counter()
    environment = os.environ | environment
    environment["PYTHONPATH"] = os.pathsep.join([str(CHECKOUT), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "benchmarks", name, *arguments, "--out", str(out)]
    done = subprocess.run(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    seconds = time.perf_counter() - begun
    said = done.stderr.strip().splitlines() or [""]
    return Outcome(
        name, seconds, f"ended with status {done.returncode}: {said[-1]}" if done.returncode else ""
    )


def claims(page: Path) -> list[str]:
    """What a bench's page says in a sentence each."""
    if not page.is_file():
        return []
    return [line.removeprefix(CLAIM) for line in page.read_text().splitlines() if line.startswith(CLAIM)]


def write_index(
    outcomes: Sequence[Outcome],
    out: Path,
    command: str,
    machine: str,
    absent: Sequence[str],
    wall_s: float,
) -> None:
    """README.md in `out`: the claims of every page, what failed, and what is `absent` and why."""
    lines = [
        "# Results",
        "",
        f"Written by `{command}`, {date.today().isoformat()}. {machine} {len(outcomes)} benches in "
        f"{wall_s / 60:.1f} minutes; those that are not timed ran two at a time.",
        "",
        *MARKS,
        "",
        "Not here:",
        "",
        *(f"- {what}" for what in absent),
        *(f"- **{outcome.name}** {outcome.trouble}" for outcome in outcomes if outcome.trouble),
        "",
        "| bench | s |",
        "|---|---|",
        *(f"| [{outcome.name}]({outcome.name}.md) | {outcome.seconds:.0f} |" for outcome in outcomes),
        "",
        "```{toctree}",
        ":hidden:",
        ":glob:",
        "",
        "*",
        "```",
    ]
    failed = {outcome.name for outcome in outcomes if outcome.trouble}
    write_text(out / "README.md", with_claims("\n".join(lines) + "\n", out, failed))


def absent_networks() -> list[str]:
    """The foundation models whose weights are not on this machine, so that no table has a line of theirs."""
    return [
        f"`{name}`: its weights ({row.licence}) are not on this machine; with them, table1 has lines of its own for it"
        for name, row in BACKENDS.items()
        if not row.has_weights()
    ]


def with_claims(index: str, out: Path, without: Collection[str] = ()) -> str:
    """An index with a table of each part's pages in `out` between its marks, and what came out.

    Of a bench with a long page the short one is named beside it. Raises InputError where the text has no marks.
    """
    before, begin, rest = index.partition(MARKS[0])
    _, end, after = rest.partition(MARKS[1])
    if not (begin and end):
        raise InputError(
            f"the index of results has no lines {MARKS[0]} and {MARKS[1]} to put the claims between"
        )
    pages = {page.stem: page for page in out.glob("*.md") if page.name != "README.md"}
    shown = {stem: page for stem, page in pages.items() if stem not in without}
    parts = []
    for part in PARTS:
        rows = [_row(name, shown) for name, bench in BENCHES.items() if bench.part == part]
        if any(rows):
            parts += ["", f"## {part}", "", "| bench | what came out |", "|---|---|", *filter(None, rows)]
    return "\n".join([before + begin, *parts, "", end]) + after


def _row(name: str, pages: Mapping[str, Path]) -> str:
    """Of a bench: its page, the short one beside the long one, and what came out; empty where it has none."""
    stems = [stem for stem in (name + LONG, name) if stem in pages]
    if not stems:
        return ""
    page = pages[stems[0]]
    links = [f"[{title_of(name)}]({page.name})", *(f"([short]({pages[stem].name}))" for stem in stems[1:])]
    old = " *Older than the code.*" if is_marked_old(page.read_text()) else ""
    return f"| {' '.join(links)} | {_cell(' '.join(claims(page)))}{old} |"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
