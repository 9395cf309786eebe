"""`python -m benchmarks NAME`: the tables and timings that the README quotes."""

import os
import platform
import shlex
import sys
import time
from dataclasses import dataclass, field
from datetime import date
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from benchmarks.table import BENCHES, LONG, paths_of, title_of
from jcr.cli.output import Output
from jcr.errors import InputError
from jcr.extras import DISTRIBUTION, is_installed

if TYPE_CHECKING:
    BenchName = str
else:
    BenchName = Literal[("all", "stale", *sorted(BENCHES))]


@dataclass(frozen=True)
class Arguments:
    """Measure, and print a Markdown table with the machine, versions and date.

    examples:
      python -m benchmarks calibrate
      python -m benchmarks run --out docs/results
      python -m benchmarks real captures --boards bench=charuco:7x5:0.030:0.022:DICT_4X4_50
      python -m benchmarks robots --long --out docs/results
      python -m benchmarks all captures --out docs/results
      python -m benchmarks stale --write
    """

    name: Annotated[
        BenchName,
        tyro.conf.Positional,
        tyro.conf.arg(
            help=f"What to measure: {', '.join(('all', *sorted(BENCHES)))}; stale: which pages are old."
        ),
    ]
    captures: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[DIR]")] = None
    """For real: the folder that holds capture folders, each with a reference.json."""
    boards: tuple[str, ...] = ()
    """CAPTURE=BOARD, as jcr run --board has it. For real: of those that show one. For matching: to make references. For
    check_points: of those that state a side; others are looked for."""
    runs: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """For check_points: keep the run folders here, and use those that are."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also write NAME.md in this folder (NAME_long.md with --long), and the images of those benches that draw some."""
    long: bool = False
    """Measure more than all has time for: more draws, images or methods."""
    write: bool = False
    """For stale: write into each page whether it is older than the code that it measures."""
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Run one bench, or all of them."""
    if arguments.name == "all":
        return _all(arguments)
    if arguments.name == "stale":
        return _stale(arguments)
    from jcr.files import write_text

    name = arguments.name
    if BENCHES[name].of_captures and arguments.captures is None:
        raise InputError(
            f"bench {name}: name the folder that holds the captures, as in python -m benchmarks {name} captures"
        )
    if not BENCHES[name].of_captures and arguments.captures is not None:
        raise InputError(f"bench {name}: takes no folder of captures; leave it out")
    if not BENCHES[name].of_boards and arguments.boards:
        raise InputError(f"bench {name}: takes no --boards; leave them out")
    if not BENCHES[name].keeps_runs and arguments.runs is not None:
        raise InputError(f"bench {name}: keeps no run folders; leave out --runs")
    if arguments.long and not BENCHES[name].long:
        raise InputError(f"bench {name}: has no --long; leave it out")
    bench = import_module(f"benchmarks.{name}")
    asks = {"captures": BENCHES[name].of_captures, "boards": BENCHES[name].of_boards}
    asks |= {"runs": BENCHES[name].keeps_runs, "out": BENCHES[name].draws, "long": bool(BENCHES[name].long)}
    found = bench.run(**{option: getattr(arguments, option) for option, is_asked in asks.items() if is_asked})
    table = heading(arguments) + found
    arguments.output.result(table, {"bench": name, "markdown": table})
    if arguments.out is not None:
        write_text(arguments.out / f"{name}{LONG if arguments.long else ''}.md", table)
    return 0


def _all(arguments: Arguments) -> int:
    """Every bench; 1 when one of them failed."""
    if arguments.long:
        raise InputError("bench all: --long is of one bench at a time; leave it out")
    if arguments.out is None:
        raise InputError(
            "bench all: name the folder for the tables, as in python -m benchmarks all --out docs/results"
        )
    from benchmarks.suite import Outcome, absent_networks, run, write_index

    names: dict[str, bool] = {name: bench.timed for name, bench in BENCHES.items()}
    given: dict[str, list[str]] = {}
    absent = absent_networks()
    for name in (name for name, bench in BENCHES.items() if bench.of_captures):
        if arguments.captures is None:
            del names[name]
            absent.append(f"{name}: no folder of captures was given")
        else:
            boards = ["--boards", *arguments.boards] if arguments.boards and BENCHES[name].of_boards else []
            given[name] = [str(arguments.captures), *boards]

    def report(outcome: Outcome) -> None:
        if not arguments.output.quiet:
            sys.stderr.write(f"{outcome.name}: {outcome.trouble or 'done'}, {outcome.seconds:.0f} s\n")

    begun = time.perf_counter()
    outcomes = run(names, arguments.out, given, report)
    command = " ".join(
        ["python -m benchmarks all", *(["CAPTURES"] if arguments.captures else []), "--out DIR"]
    )
    write_index(outcomes, arguments.out, command, machine(), absent, time.perf_counter() - begun)
    index = arguments.out / "README.md"
    facts = {outcome.name: {"seconds": outcome.seconds, "trouble": outcome.trouble} for outcome in outcomes}
    arguments.output.result(index.read_text(), {"bench": "all", "benches": facts})
    return int(any(outcome.trouble for outcome in outcomes))


def _stale(arguments: Arguments) -> int:
    """Which pages are older than the code that they measure; 1 where one does not say so."""
    from benchmarks.freshness import PAGES, changed_since_measured, is_marked_old, marked
    from benchmarks.suite import with_claims
    from jcr.files import write_text

    pages = arguments.out or PAGES
    facts, lines, silent = {}, [], 0
    for page in sorted(pages.glob("*.md")):
        if (paths := paths_of(page.stem)) is None:
            continue
        text, changed = page.read_text(), changed_since_measured(page, paths)
        facts[page.stem] = changed
        lines.append(f"{page.stem}: {f'{len(changed)} files changed since' if changed else 'new'}")
        if arguments.write:
            write_text(page, marked(text, changed))
        elif bool(changed) is not is_marked_old(text):
            silent += 1
            lines[-1] += (
                f"; the page does {'not say so' if changed else 'say otherwise'}: python -m benchmarks stale --write"
            )
    if arguments.write:
        write_text(pages / "README.md", with_claims((pages / "README.md").read_text(), pages))
    arguments.output.result("\n".join(lines) + "\n", {"bench": "stale", "changed": facts})
    return int(silent > 0)


def heading(arguments: Arguments) -> str:
    """What a reader needs to judge and repeat the numbers."""
    command = ["python", "-m", "benchmarks", arguments.name, *(["--long"] if arguments.long else [])]
    if arguments.captures is not None:
        # Where they lie is the machine's own affair.
        command += [arguments.captures.name, *(["--boards", *arguments.boards] if arguments.boards else [])]
    from benchmarks.freshness import commit_now

    measured = f"{date.today().isoformat()}, {commit_now(paths_of(arguments.name) or ())}"
    return (
        f"# {title_of(arguments.name + LONG * arguments.long)}\n\n"
        f"{BENCHES[arguments.name].what}\n\n"
        f"    {shlex.join(command)}\n\n{measured}. {machine()}\n\n"
    )


def machine() -> str:
    """Processor, cores and versions in a sentence."""
    names = (DISTRIBUTION, "numpy", "scipy", "torch", "pycolmap")
    there = [name for name in names if name == DISTRIBUTION or is_installed(name)]
    versions = ", ".join(f"{name} {version(name)}" for name in there)
    return f"{_processor()}, {os.cpu_count()} cores, Python {platform.python_version()}, {versions}."


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()


if __name__ == "__main__":
    from jcr.cli import call

    sys.exit(call(lambda: sys.modules["__main__"], "python -m benchmarks", sys.argv[1:]))
