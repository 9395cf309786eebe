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

from jcr.cli.output import Output
from jcr.errors import InputError
from jcr.extras import DISTRIBUTION, is_installed


@dataclass(frozen=True)
class Bench:
    """A row of the table of benches, a module of this package each."""

    what: str
    timed: bool = False
    """Measures time, so that nothing else may run beside it."""
    draws: bool = False
    """Writes images beside its page."""
    of_captures: bool = False
    """Asks for the folder of captures."""
    of_boards: bool = False
    """And takes --boards."""
    keeps_runs: bool = False
    """Takes --runs."""
    measures: tuple[str, ...] = ()
    """Files and folders whose change makes its page old, beside the bench's own."""
    long: str = ""
    """What `--long` measures more of, for which `all` has no time."""


SOLVER = (
    "src/jcr/handeye",
    "src/jcr/adjust",
    "src/jcr/calibration",
    "src/jcr/camera.py",
    "src/jcr/geometry.py",
    "src/jcr/least_squares.py",
)
FEATURES = (
    "src/jcr/match",
    "src/jcr/reconstruct/colmap.py",
    "src/jcr/reconstruct/sfm.py",
    "src/jcr/attempts.py",
)
DEPTH = ("src/jcr/depth", "src/jcr/reconstruct/pointmaps.py")
MAP = ("src/jcr/represent", "src/jcr/mapping.py")
READING = ("src/jcr/capture",)
WHOLE = (*SOLVER, *FEATURES, *DEPTH, *MAP, *READING, "src/jcr/pipeline.py", "src/jcr/report")


BENCHES = {
    "run": Bench(
        "the whole job on the bundled capture: error, time and memory",
        True,
        measures=WHOLE,
        long="the median of three",
    ),
    "table1": Bench(
        "hand-eye calibration from few images of three scenes, by the paper and by ours",
        measures=(*SOLVER, *FEATURES, "src/jcr/reconstruct/global_alignment", "src/jcr/simulate"),
        long="two captures behind each line instead of one",
    ),
    "real": Bench(
        "real captures in DIR, against the references stored beside them",
        of_captures=True,
        of_boards=True,
        measures=(
            *SOLVER,
            *FEATURES,
            *READING,
            "src/jcr/reconstruct/direct",
            "src/jcr/reconstruct/marker.py",
            "src/jcr/reconstruct/board.py",
        ),
    ),
    "check_points": Bench(
        "corners of boards that took no part in the calibration, where it puts them in the base: captures in DIR",
        of_captures=True,
        of_boards=True,
        keeps_runs=True,
        measures=(
            *SOLVER,
            *FEATURES,
            *READING,
            "src/jcr/reconstruct/direct",
            "src/jcr/reconstruct/board.py",
            "src/jcr/reconstruct/board_in_view.py",
            "benchmarks/corners.py",
            "benchmarks/board_intrinsics.py",
        ),
    ),
    "seen": Bench(
        "points that the camera sees, in simulation: are they placed as exactly as is said?",
        measures=(*SOLVER, "benchmarks/simulated"),
        long="40 draws of every row instead of 10",
    ),
    "matching": Bench(
        "SIFT, XFeat and ALIKED on real captures in DIR, with the robot's gate and without",
        of_captures=True,
        of_boards=True,
        measures=(*SOLVER, *FEATURES, *READING),
        long="all captures, SIFT with and without the gate, XFeat without it, and ALIKED, too",
    ),
    "cameras": Bench(
        "fixed cameras, several on a wrist, two arms, eye-to-hand: simulated, and withheld images of captures in DIR",
        of_captures=True,
        measures=(*SOLVER, *FEATURES, *READING, "src/jcr/cell", "src/jcr/simulate"),
        long="40 draws of every kind of cell instead of 10",
    ),
    "gate": Bench(
        "scenes that mislead matching, with the robot's gate and without",
        measures=(*SOLVER, *FEATURES, "src/jcr/simulate"),
        long="two draws of every scene instead of one, and XFeat",
    ),
    "many": Bench(
        "seconds and peak memory by number of images",
        measures=(*SOLVER, *FEATURES, *DEPTH, "src/jcr/simulate"),
        long="up to 200 images instead of 32",
    ),
    "calibrate": Bench(
        "hand-eye solvers on the same simulated poses, for accuracy and time",
        draws=True,
        measures=("src/jcr/handeye", "benchmarks/simulated/problem.py"),
        long="15 draws instead of 4",
    ),
    "robots": Bench(
        "arms with systematic errors: is the result within its sigma, and nearer than others'",
        draws=True,
        measures=("src/jcr/handeye", "src/jcr/simulate/robots.py", "benchmarks/simulated/problem.py"),
        long="8 draws of every arm instead of 1",
    ),
    "limits": Bench(
        "where it breaks: one thing made worse at a time",
        draws=True,
        measures=(*SOLVER, *FEATURES, "src/jcr/simulate"),
        long="all levels, not every other one",
    ),
    "attack": Bench(
        "captures with one silent fault: reported, rejected, or wrong; and false alarms",
        measures=(*SOLVER, "benchmarks/simulated"),
        long="three times as many draws of everything",
    ),
    "attack_images": Bench(
        "images with one fault through jcr calibrate: named, rejected, or wrong; and false alarms",
        measures=(
            *SOLVER,
            *FEATURES,
            "src/jcr/reconstruct/direct",
            "src/jcr/simulate",
            "benchmarks/simulated",
        ),
        long="ten draws of every fault instead of one, and 200 captures with nothing wrong instead of 5",
    ),
    "table2": Bench(
        "heights of objects in simulated scenes, from 8 and 10 images",
        measures=(*SOLVER, *FEATURES, *DEPTH, "src/jcr/segment", "src/jcr/simulate"),
        long="five scenes instead of three",
    ),
    "density": Bench(
        "how much of a plain table and its objects a cloud covers, beside COLMAP's points",
        draws=True,
        measures=(*FEATURES, *DEPTH, "src/jcr/simulate"),
    ),
    "depth": Bench(
        "dense depth on simulated scenes: completeness, accuracy, map, by texture and reason",
        True,
        measures=(*FEATURES, *DEPTH, *MAP, "src/jcr/simulate"),
        long="everything plain, too",
    ),
    "map": Bench(
        "the map: accuracy of both presets, training, queries, distances, spheres beside python-fcl",
        True,
        measures=(*MAP, *DEPTH, "src/jcr/simulate"),
    ),
    "predictions": Bench(
        "the whole job from pointmaps with a network's errors: error, honesty, map, time",
        measures=(*SOLVER, "src/jcr/reconstruct/global_alignment", "src/jcr/reconstruct/from_pairs.py", *MAP),
        long="three draws instead of one",
    ),
    "models": Bench(
        "any-view models from predictions with published errors, beside COLMAP and direct alignment",
        measures=(*SOLVER, *FEATURES, "src/jcr/reconstruct/views_at_once", "src/jcr/reconstruct/direct"),
        long="a textured table and errors as on DTU and 7-Scenes, too",
    ),
    "model_cost": Bench(
        "seconds and memory of any-view networks with random weights, beside what is estimated",
        True,
        measures=("src/jcr/reconstruct/views_at_once",),
    ),
    "align": Bench(
        "global alignment: fast against adam, kinematic against free, in error, time and memory",
        True,
        measures=("src/jcr/reconstruct/global_alignment",),
        long="3 draws of every number of images instead of 1, 10 of every calibration instead of 4",
    ),
    "pairs": Bench(
        "predicting pairs with every image encoded once, or with every pair",
        True,
        measures=("src/jcr/reconstruct/dust3r",),
        long="ten images instead of six",
    ),
    "memory": Bench(
        "peak memory against the budget by number of images, COLMAP and small networks",
        measures=(*FEATURES, *DEPTH, *MAP, "src/jcr/memory.py"),
        long="20 and 40 images, too",
    ),
    "bag": Bench(
        "frames chosen from a minute of a robot's MCAP: which, time and memory", True, measures=(*READING,)
    ),
    "samples": Bench(
        "metric samples of a marker beside OpenCV's five methods",
        measures=(*SOLVER, "src/jcr/capture/samples.py"),
    ),
    "first_day": Bench(
        "what a new user types and sees, from files as robots write them to a URDF",
        True,
        measures=(*WHOLE, "src/jcr/cli", "src/jcr/live"),
    ),
    "batch": Bench(
        "many small captures by one process and by two: time, and memory while they run",
        True,
        measures=(*WHOLE, "src/jcr/batch.py"),
        long="200 captures instead of 32",
    ),
}
"""In the order of the README's claims."""
LONG = "_long"
"""Ends the name of a page that --long wrote."""

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
    resume: bool = False
    """For all: leave out the benches whose page is newer than the program's source files."""
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
            sys.stderr.write(f"{outcome.name}: {outcome.trouble or 'done'}, {outcome.seconds or 0.0:.0f} s\n")

    begun = time.perf_counter()
    outcomes = run(names, arguments.out, given, arguments.resume, report)
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
    from benchmarks.freshness import PAGES, changed_since_measured, marked, says_it_is_old
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
        elif bool(changed) is not says_it_is_old(text):
            silent += 1
            lines[-1] += (
                f"; the page does {'not say so' if changed else 'say otherwise'}: python -m benchmarks stale --write"
            )
    if arguments.write:
        write_text(pages / "README.md", with_claims((pages / "README.md").read_text(), pages))
    arguments.output.result("\n".join(lines) + "\n", {"bench": "stale", "changed": facts})
    return int(silent > 0)


def paths_of(page: str) -> tuple[str, ...] | None:
    """What the numbers of a page come from, the bench itself included; None for the index."""
    name = page.removesuffix(LONG)
    return (*BENCHES[name].measures, f"benchmarks/{name}.py") if name in BENCHES else None


def heading(arguments: Arguments) -> str:
    """What a reader needs to judge and repeat the numbers."""
    command = ["python", "-m", "benchmarks", arguments.name, *(["--long"] if arguments.long else [])]
    if arguments.captures is not None:
        # Where they lie is the machine's own affair.
        command += [arguments.captures.name, *(["--boards", *arguments.boards] if arguments.boards else [])]
    from benchmarks.freshness import commit_now

    measured = f"{date.today().isoformat()}, {commit_now(paths_of(arguments.name) or ())}"
    return (
        f"# python -m benchmarks {arguments.name}{' --long' if arguments.long else ''}\n\n"
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
