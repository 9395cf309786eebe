"""Run benches by name and print their tables: `python -m benchmarks NAME`."""

import os
import platform
import shlex
import subprocess
import sys
from dataclasses import dataclass
from datetime import date
from importlib import import_module
from importlib.metadata import version
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from benchmarks.suite import run_all, write_index
from benchmarks.table import BENCHES
from jcr.errors import InputError
from jcr.extras import DISTRIBUTION, is_installed
from jcr.files import write_text

COMMANDS = {"align": "benchmarks.adam", "fetch-captures": "benchmarks.real_captures.fetch"}
"""Modules of what is no bench, with arguments of its own."""
if TYPE_CHECKING:
    BenchName = str
else:
    BenchName = Literal[("all", *sorted(BENCHES))]


@dataclass(frozen=True)
class Arguments:
    """Measure, and print a Markdown table with the machine, versions, commit and date.

    examples:
      python -m benchmarks speed
      python -m benchmarks map --out docs/results
      python -m benchmarks fetch-captures captures
      python -m benchmarks real captures --boards bench=charuco:7x5:0.030:0.022:DICT_4X4_50
      python -m benchmarks all captures --out docs/results
      python -m benchmarks align PAIRS.npz OUT.npz --method adam
    """

    name: Annotated[BenchName, tyro.conf.Positional]
    """Bench to run, or all of them."""
    captures: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[DIR]")] = None
    """Folder that holds capture folders, for benches of real captures."""
    boards: tuple[str, ...] = ()
    """CAPTURE=BOARD, a board as in jcr run --board, for benches that use boards."""
    runs: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder in which a bench keeps its runs and looks for those of an earlier call."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also write NAME.md, the images of that bench and the index README.md into this folder."""


def main(arguments: Arguments) -> int:
    """Run one bench or all of them and return the exit status."""
    if arguments.name == "all":
        if arguments.out is None:
            raise InputError("bench all: name the folder for the tables with --out DIR")
        return run_all(arguments.out, arguments.captures, arguments.boards)
    bench = import_module(f"benchmarks.{arguments.name}")
    options = ("captures", "boards", "runs", "out")
    given = {name: value for name in options if (value := getattr(arguments, name))}
    taken = signature(bench.run).parameters
    if "captures" in taken and arguments.captures is None:
        raise InputError(f"bench {arguments.name}: name the folder that holds the captures")
    if excess := given.keys() - taken.keys() - {"out"}:
        raise InputError(f"bench {arguments.name}: does not use {', '.join(sorted(excess))}; leave it out")
    page = heading(arguments) + bench.run(**{name: value for name, value in given.items() if name in taken})
    sys.stdout.write(page)
    if arguments.out is not None:
        write_text(arguments.out / f"{arguments.name}.md", page)
        write_index(arguments.out)
    return 0


def heading(arguments: Arguments) -> str:
    """Return title, command, date, commit and machine of a page."""
    command = ["python", "-m", "benchmarks", arguments.name]
    if arguments.captures is not None:
        # The path of the folder is a detail of this machine.
        command += [arguments.captures.name, *(["--boards", *arguments.boards] if arguments.boards else [])]
    bench = BENCHES[arguments.name]
    return (
        f"# {bench.title}\n\n{bench.what}\n\n    {shlex.join(command)}\n\n"
        f"{date.today().isoformat()}, commit `{_commit()}`. {_machine()}\n\n"
    )


def _commit() -> str:
    """Return the short name of the commit that is checked out, or "unknown"."""
    command = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    try:
        done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True)
    except OSError:
        return "unknown"
    return done.stdout.strip() or "unknown"


def _machine() -> str:
    """Return processor, cores and versions in a sentence."""
    names = (DISTRIBUTION, "numpy", "scipy", "torch", "pycolmap")
    versions = ", ".join(
        f"{name} {version(name)}" for name in names if name == DISTRIBUTION or is_installed(name)
    )
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    processor = models[0] if models else platform.machine()
    return f"{processor}, {os.cpu_count()} cores, Python {platform.python_version()}, {versions}."


if __name__ == "__main__":
    try:
        if sys.argv[1:2] and (command := COMMANDS.get(sys.argv[1])):
            sys.exit(import_module(command).main(sys.argv[2:]))
        sys.exit(main(tyro.cli(Arguments, prog="python -m benchmarks")))
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        sys.exit(2)
