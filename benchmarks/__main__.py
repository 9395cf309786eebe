"""Run benches by name and print their tables: `python -m benchmarks NAME`."""

import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from importlib import import_module
from importlib.metadata import version
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from jcr.errors import InputError
from jcr.extras import DISTRIBUTION, is_installed
from jcr.files import write_text

ROBOTS, HONEST, MAPPED, TIME, OTHERS = PARTS = (
    "Real robots and captures",
    "Is the stated accuracy true, and are faults found?",
    "Depth, map and objects",
    "Time and memory",
    "Beside other methods",
)
BENCHES = {
    "real": (ROBOTS, "Real captures"),
    "features": (ROBOTS, "Features on real captures"),
    "cameras": (ROBOTS, "Several cameras"),
    "coverage": (HONEST, "Is ± true?"),
    "faults": (HONEST, "Faults"),
    "live": (HONEST, "Live calibration"),
    "map": (MAPPED, "The map"),
    "speed": (TIME, "Speed"),
    "peers": (OTHERS, "Peers"),
    "kinhec": (OTHERS, "KinHEC"),
    "pointmaps": (OTHERS, "Pointmaps"),
}
"""Part of the index and title of each bench, a module of this package with a function `run`, in the index's order."""
COMMANDS = {"align": "benchmarks.adam", "fetch-captures": "benchmarks.real_captures.fetch"}
"""Modules of commands that are no bench and take arguments of their own, by name."""
CLAIM = "> "
"""Prefix of the lines of a page that state its result in a sentence."""
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
    """CAPTURE=BOARD, a board as in jcr run --board, for the bench `real`."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also write NAME.md and the index README.md into this folder."""


def main(arguments: Arguments) -> int:
    """Run one bench or all of them and return the exit status."""
    if arguments.name == "all":
        if arguments.out is None:
            raise InputError("bench all: name the folder for the tables with --out DIR")
        return run_all(arguments.out, arguments.captures, arguments.boards)
    run = import_module(f"benchmarks.{arguments.name}").run
    given = {name: value for name in ("captures", "boards") if (value := getattr(arguments, name))}
    taken = signature(run).parameters
    if "captures" in taken and arguments.captures is None:
        raise InputError(f"bench {arguments.name}: name the folder that holds the captures")
    if excess := given.keys() - taken.keys():
        raise InputError(f"bench {arguments.name}: does not use {', '.join(sorted(excess))}; leave it out")
    page = heading(arguments) + run(**given)
    sys.stdout.write(page)
    if arguments.out is not None:
        write_text(arguments.out / f"{arguments.name}.md", page)
        write_index(arguments.out)
    return 0


def run_all(out: Path, captures: Path | None, boards: Sequence[str] = ()) -> int:
    """Run every bench in a process of its own, write pages and index into `out`, and return 1 if one failed, else 0.

    Benches of real captures need `captures`.
    """
    passed = True
    for name in BENCHES:
        taken = signature(import_module(f"benchmarks.{name}").run).parameters
        if "captures" in taken and captures is None:
            continue
        words = [str(captures)] if "captures" in taken else []
        words += ["--boards", *boards] if boards and "boards" in taken else []
        begun, checkout = time.perf_counter(), str(Path(__file__).parents[1])
        path = os.pathsep.join([checkout, os.environ.get("PYTHONPATH", "")])
        command = [sys.executable, "-m", "benchmarks", name, *words, "--out", str(out)]
        done = subprocess.run(
            command, env=os.environ | {"PYTHONPATH": path}, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
        )
        lines = done.stderr.decode().strip().splitlines() or [""]
        outcome = f"exit status {done.returncode}: {lines[-1]}" if done.returncode else "done"
        sys.stderr.write(f"{name}: {outcome}, {time.perf_counter() - begun:.0f} s\n")
        passed &= done.returncode == 0
    return int(not passed)


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
        rows = [
            f"| [{title}]({name}.md) | {claims(out / f'{name}.md').replace('|', chr(92) + '|')} |"
            for name, (own, title) in BENCHES.items()
            if own == part and (out / f"{name}.md").is_file()
        ]
        lines += ["", f"## {part}", "", "| bench | result |", "|---|---|", *rows] if rows else []
    lines += ["", "```{toctree}", ":hidden:", ":glob:", "", "*", "```", ""]
    write_text(out / "README.md", "\n".join(lines))


def heading(arguments: Arguments) -> str:
    """Return title, subject, command, date, commit, machine and versions of a page."""
    command = ["python", "-m", "benchmarks", arguments.name]
    if arguments.captures is not None:
        # The path of the folder is a detail of this machine.
        command += [arguments.captures.name, *(["--boards", *arguments.boards] if arguments.boards else [])]
    subject = (import_module(f"benchmarks.{arguments.name}").__doc__ or "").partition("\n")[0]
    git = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    done = subprocess.run(git, cwd=Path(__file__).parent, capture_output=True, text=True)
    names = (DISTRIBUTION, "numpy", "scipy", "torch", "pycolmap")
    versions = [f"{name} {version(name)}" for name in names if name == DISTRIBUTION or is_installed(name)]
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    processor = [*models, platform.machine()][0]
    return (
        f"# {BENCHES[arguments.name][1]}\n\n{subject}\n\n    {shlex.join(command)}\n\n"
        f"{date.today().isoformat()}, commit `{done.stdout.strip() or 'unknown'}`. {processor}, {os.cpu_count()} "
        f"cores, Python {platform.python_version()}, {', '.join(versions)}.\n\n"
    )


if __name__ == "__main__":
    try:
        if sys.argv[1:2] and (command := COMMANDS.get(sys.argv[1])):
            sys.exit(import_module(command).main(sys.argv[2:]))
        sys.exit(main(tyro.cli(Arguments, prog="python -m benchmarks")))
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        sys.exit(2)
