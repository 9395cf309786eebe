"""Run every bench in a process of its own, and write the index of their pages."""

import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from inspect import signature
from pathlib import Path

from benchmarks.table import BENCHES, PARTS
from jcr.files import write_text

CHECKOUT = Path(__file__).parents[1]
CLAIM = "> "
"""Prefix of the lines of a page that state its result in a sentence."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment of benches that run two at a time; timed benches run alone with the user's environment."""


def run_all(out: Path, captures: Path | None, boards: Sequence[str] = ()) -> int:
    """Run all benches, write their pages and the index into `out`, and return 1 if a bench failed, else 0.

    Benches that are not timed run two at a time, before the timed ones. Benches of real captures need `captures`.
    """
    given: dict[str, list[str]] = {}
    for name in BENCHES:
        taken = signature(import_module(f"benchmarks.{name}").run).parameters
        if "captures" not in taken:
            given[name] = []
        elif captures is not None:
            given[name] = [str(captures), *(["--boards", *boards] if boards and "boards" in taken else [])]
    with ThreadPoolExecutor(2) as two:
        untimed = [name for name in given if not BENCHES[name].timed]
        passed = list(two.map(lambda name: _run_bench(name, out, given[name], ONE_THREAD), untimed))
    passed += [_run_bench(name, out, given[name], {}) for name in given if BENCHES[name].timed]
    return int(not all(passed))


def _run_bench(name: str, out: Path, arguments: Sequence[str], environment: Mapping[str, str]) -> bool:
    """Run one bench, report it on stderr, and return whether it succeeded."""
    begun = time.perf_counter()
    path = os.pathsep.join([str(CHECKOUT), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "benchmarks", name, *arguments, "--out", str(out)]
    done = subprocess.run(
        command, env=os.environ | environment | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    lines = done.stderr.strip().splitlines() or [""]
    outcome = f"exit status {done.returncode}: {lines[-1]}" if done.returncode else "done"
    sys.stderr.write(f"{name}: {outcome}, {time.perf_counter() - begun:.0f} s\n")
    return done.returncode == 0


def claims(page: Path) -> str:
    """Return the sentences in which a page states its result."""
    lines = page.read_text().splitlines()
    return " ".join(line.removeprefix(CLAIM) for line in lines if line.startswith(CLAIM))


def write_index(out: Path) -> None:
    """Write README.md into `out`: the pages that are there by part, with their results."""
    lines = [
        "# Results",
        "",
        "Written by `python -m benchmarks`; each page has its command, commit and machine.",
    ]
    for part in PARTS:
        pages = {name: out / f"{name}.md" for name, bench in BENCHES.items() if bench.part == part}
        rows = [
            f"| [{BENCHES[name].title}]({page.name}) | {claims(page).replace('|', chr(92) + '|')} |"
            for name, page in pages.items()
            if page.is_file()
        ]
        lines += ["", f"## {part}", "", "| bench | result |", "|---|---|", *rows] if rows else []
    lines += ["", "```{toctree}", ":hidden:", ":glob:", "", "*", "```", ""]
    write_text(out / "README.md", "\n".join(lines))
