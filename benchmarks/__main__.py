"""Run benches by name and print their tables: `python -m benchmarks NAME`."""

import os
import platform
import shlex
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
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
PAGES = {
    "real": (
        ROBOTS,
        {
            "real": "Real captures",
            "features": "Features on real captures",
            "shuffled": "Effects of the order, in random orders",
        },
    ),
    "cameras": (ROBOTS, {"cameras": "Several cameras"}),
    "inputs": (ROBOTS, {"inputs": "Files as people hold them"}),
    "verified": (ROBOTS, {"verified": "Real captures verified", "month": "A simulated month"}),
    "coverage": (HONEST, {"coverage": "Is ± true?", "spheres": "Spheres at a confidence"}),
    "faults": (HONEST, {"faults": "Faults"}),
    "live": (HONEST, {"live": "Live calibration"}),
    "map": (MAPPED, {"map": "The map"}),
    "speed": (TIME, {"speed": "Speed"}),
    "peers": (OTHERS, {"peers": "Peers", "kinhec": "KinHEC"}),
    "published": (OTHERS, {"published": "Tables of the paper", "pointmaps": "Pointmaps"}),
}
"""Part of the index and benches of each page, in the index's order. A bench is a module of this package with a function
`run`, here with its title; the first one names the page."""
RESULTS = Path(__file__).parents[1] / "docs" / "results"
SHARE = 4
"""`all` takes one case in SHARE of the benches with many."""
COMMANDS = {"align": "benchmarks.align", "fetch-captures": "benchmarks.real_captures.fetch"}
"""Modules of commands that are no bench and take arguments of their own, by name."""
CLAIM = "> "
"""Prefix of the lines of a page that state its result in a sentence."""
if TYPE_CHECKING:
    BenchName = str
else:
    BenchName = Literal[("all", *sorted(name for _, benches in PAGES.values() for name in benches))]


@dataclass(frozen=True)
class Arguments:
    """Measure, and print a Markdown table with the machine, versions, commit and date.

    examples:
      python -m benchmarks speed
      python -m benchmarks map docs/results
      python -m benchmarks fetch-captures data
      python -m benchmarks real --boards bench=charuco:7x5:0.030:0.022:DICT_4X4_50
      python -m benchmarks all out/results
      python -m benchmarks kinhec --every 12 --seed 1
      python -m benchmarks align PAIRS.npz OUT.npz --method adam
    """

    name: Annotated[BenchName, tyro.conf.Positional]
    """Bench to run, with the others of its page if it names one; `all`: all, one case in four of those with many."""
    out: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[OUT]")] = None
    """Folder into which the page NAME.md and the index README.md are written, too (unset: of `all` docs/results)."""
    captures: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("data")
    """Folder that holds capture folders, for benches of real captures."""
    boards: tuple[str, ...] = ()
    """CAPTURE=BOARD, a board as in jcr run --board, for the bench `real`."""
    every: int = 1
    """Measure one case in this many (1: all); captures, faults and sequences are taken at even steps."""
    seed: int = 0
    """Number that is added to the seed of KinHEC's tier; each number generates other sequences."""


def main(arguments: Arguments) -> int:
    """Run one bench or all of them and return the exit status."""
    if arguments.every < 1:
        raise InputError(f"--every {arguments.every}: give 1 or more")
    if arguments.name == "all":
        return run_all(arguments)
    if arguments.out is not None and arguments.name not in PAGES:
        (page,) = (page for page, (_, benches) in PAGES.items() if arguments.name in benches)
        raise InputError(f"bench {arguments.name}: it is a part of the page {page}; name that to write it")
    titles = PAGES[arguments.name][1] if arguments.name in PAGES else {arguments.name: arguments.name}
    runs = {name: import_module(f"benchmarks.{name}").run for name in titles}
    taken = {option for run in runs.values() for option in signature(run).parameters}
    if excess := options_of(arguments).keys() - taken:
        raise InputError(f"bench {arguments.name}: does not use {', '.join(sorted(excess))}; leave it out")
    page = heading(arguments)
    for name, run in runs.items():
        found = run(**{option: getattr(arguments, option) for option in signature(run).parameters})
        if name != arguments.name:
            found = f"\n## {titles[name]}\n\n{subject_of(name)}\n\n" + found.replace("\n##", "\n###")
        page += found
    sys.stdout.write(page)
    if arguments.out is not None:
        write_text(arguments.out / f"{arguments.name}.md", page)
        write_index(arguments.out)
    return 0


def options_of(arguments: Arguments) -> dict[str, list[str]]:
    """Return the options that are not at their defaults, each as the words of a command line."""
    default, found = Arguments(arguments.name), {}
    for name in ("captures", "boards", "every", "seed"):
        if (value := getattr(arguments, name)) != getattr(default, name):
            found[name] = [f"--{name}", *(value if name == "boards" else [str(value)])]
    return found


def run_all(arguments: Arguments) -> int:
    """Run the benches, two at a time and `speed` alone at the end, and return 1 if one failed, else 0.

    Each runs in a process of its own. Benches of real captures are left out where there are none.
    """
    out, options = arguments.out or RESULTS, options_of(arguments) | {"every": ["--every", str(SHARE)]}
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}

    def is_done(name: str) -> bool:
        """Run one bench and report it on stderr."""
        begun, modules = (
            time.perf_counter(),
            [import_module(f"benchmarks.{bench}") for bench in PAGES[name][1]],
        )
        taken = {option for module in modules for option in signature(module.run).parameters}
        if "captures" in taken and not arguments.captures.is_dir():
            sys.stderr.write(f"{name}: left out, there is no folder {arguments.captures}\n")
            return True
        words = [word for option, pair in options.items() if option in taken for word in pair]
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks", name, str(out), *words], env=environment, capture_output=True
        )
        lines = done.stderr.decode().strip().splitlines() or [""]
        outcome = f"exit status {done.returncode}: {lines[-1]}" if done.returncode else "done"
        sys.stderr.write(f"{name}: {outcome}, {time.perf_counter() - begun:.0f} s\n")
        return done.returncode == 0

    with ThreadPoolExecutor(2) as two:
        passed = [*two.map(is_done, (name for name in PAGES if name != "speed"))]
    return int(not all([*passed, is_done("speed")]))


def claims(page: Path) -> str:
    """Return the sentences in which a page states its result."""
    lines = page.read_text().splitlines()
    return " ".join(line.removeprefix(CLAIM) for line in lines if line.startswith(CLAIM))


def write_index(out: Path) -> None:
    """Write README.md into `out`: the pages that are there by part, with their results."""
    lines = [
        "# Results",
        "",
        "Written by `python -m benchmarks`; each page has its command, commit and machine. `python -m benchmarks all` "
        f"takes 50 minutes of two cores, with one case in {SHARE} where the command has `--every {SHARE}`. "
        "`python -m benchmarks NAME docs/results` takes all of "
        "one page.",
    ]
    for part in PARTS:
        rows = [
            f"| [{titles[name]}]({name}.md) | {claims(out / f'{name}.md').replace('|', chr(92) + '|')} |"
            for name, (own, titles) in PAGES.items()
            if own == part and (out / f"{name}.md").is_file()
        ]
        lines += ["", f"## {part}", "", "| bench | result |", "|---|---|", *rows] if rows else []
    lines += ["", "```{toctree}", ":hidden:", ":glob:", "", "*", "```", ""]
    write_text(out / "README.md", "\n".join(lines))


def subject_of(name: str) -> str:
    """Return what a bench measures, in a sentence: the first line of its module."""
    return (import_module(f"benchmarks.{name}").__doc__ or "").partition("\n")[0]


def heading(arguments: Arguments) -> str:
    """Return title, subject, command, date, commit, machine and versions of a page."""
    # The path of the captures is a detail of this machine.
    options = options_of(arguments) | {"captures": []}
    command = [
        "python",
        "-m",
        "benchmarks",
        arguments.name,
        *(word for pair in options.values() for word in pair),
    ]
    share = f" One case in {arguments.every}; without `--every` all." if arguments.every > 1 else ""
    git, root = ["git", "-C", str(Path(__file__).parents[1])], ["--", ".", ":!docs/results"]
    done = subprocess.run([*git, "describe", "--always", "--exclude=*"], capture_output=True, text=True)
    # Pages that were written before this one are no change of what is measured.
    is_changed = subprocess.run([*git, "diff", "--quiet", "HEAD", *root], capture_output=True).returncode == 1
    commit = (done.stdout.strip() or "unknown") + "+" * is_changed
    names = (DISTRIBUTION, "numpy", "scipy", "torch", "pycolmap")
    versions = [f"{name} {version(name)}" for name in names if name == DISTRIBUTION or is_installed(name)]
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    processor = [*models, platform.machine()][0]
    title = next(titles[arguments.name] for _, titles in PAGES.values() if arguments.name in titles)
    return (
        f"# {title}\n\n{subject_of(arguments.name)}{share}\n\n    {shlex.join(command)}\n\n"
        f"{date.today().isoformat()}, commit `{commit}`. {processor}, {os.cpu_count()} "
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
