"""`benchmarks speed`: processor time of every stage, beside COLMAP alone on the same images in the same minutes."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jcr.errors import InputError

CAPTURE = Path("examples/tabletop")
REPEATS = 3
IMAGES = (15, 36, 50, 100)
ALONE, ALL_OF_IT, CALIBRATED, KEPT, STARTED = (
    "COLMAP alone",
    "`jcr run`",
    "`jcr calibrate`",
    "`jcr calibrate`, reconstruction kept",
    "`jcr calibrate` of a folder that is not there",
)
STAGES: tuple[str, ...] = ("reconstruct", "calibrate", "densify", "map", "report")


@dataclass(frozen=True)
class Spent:
    """What one process took."""

    processor_s: float
    """Of all threads, in the program and in the system."""
    wall_s: float
    peak_mib: float


def run() -> str:
    """Markdown: medians of a few rounds in which every job runs once, a process each."""
    if not (CAPTURE / "capture.json").is_file():
        raise InputError(f"bench speed: {CAPTURE} is not here; run it in the root of the project")
    spent: dict[str, list[Spent]] = {}
    stages: list[dict[str, float]] = []
    for _ in range(REPEATS):
        with tempfile.TemporaryDirectory() as place:
            for name, one in _jobs(Path(place)):
                spent.setdefault(name, []).append(one)
            stages.append(json.loads((Path(place) / "stages.json").read_text()))
    grown = [_calibration(count) for count in IMAGES]
    return page(spent, stages, grown)


def page(
    spent: Mapping[str, list[Spent]],
    stages: list[dict[str, float]],
    grown: list[tuple[int, int, float]],
) -> str:
    """Markdown of what was measured."""
    of = {name: _median(each) for name, each in spent.items()}
    alone = of[ALONE].processor_s
    times = {name: one.processor_s / alone for name, one in of.items()}
    lines = [
        f"> `jcr run` on {CAPTURE} takes {of[ALL_OF_IT].processor_s:.1f} s of processor, {times[ALL_OF_IT]:.1f} times "
        f"COLMAP alone on the same images; `jcr calibrate` {times[CALIBRATED]:.1f} times.",
        "",
        f"Medians of {REPEATS} rounds in which every job ran once, a process each. Processor seconds: of all threads, "
        "in the program and in the system. *COLMAP alone*: features, exhaustive matching and mapping, with its options.",
        "",
        "| job | processor, s | times COLMAP | wall, s | peak, MiB |",
        "|---" * 5 + "|",
        *(
            f"| {name} | {one.processor_s:.1f} | {times[name]:.2f} | {one.wall_s:.1f} | {one.peak_mib:.0f} |"
            for name, one in of.items()
        ),
        "",
        "| stage of `jcr run` | processor, s |",
        "|---|---|",
        *(f"| {name} | {np.median([one[name] for one in stages]):.2f} |" for name in STAGES),
        "",
        "Calibration of simulated observations, 500 points over the table, no reconstruction:",
        "",
        "| images | observations | processor, s |",
        "|---|---|---|",
        *(f"| {images} | {observations} | {seconds:.2f} |" for images, observations, seconds in grown),
    ]
    return "\n".join(lines) + "\n"


def _jobs(place: Path) -> Iterator[tuple[str, Spent]]:
    """Every job once."""
    program, command = [sys.executable, "-c"], [sys.executable, "-m", "jcr"]
    jcr = [*command, "calibrate"]
    kept = str(place / "kept")
    yield (
        ALONE,
        _spent([*program, f"from benchmarks.speed import colmap_alone; colmap_alone({str(place)!r})"]),
    )
    yield ALL_OF_IT, _spent([*command, "run", str(CAPTURE), str(place / "whole"), "--quiet"])
    by_stage = f"from benchmarks.speed import run_by_stage; run_by_stage({str(place)!r})"
    _spent([*program, f"from jcr.cli import wait_asleep; wait_asleep(); {by_stage}"])
    yield CALIBRATED, _spent([*jcr, str(CAPTURE), kept, "--quiet"])
    (place / "kept" / "calibration.json").unlink()
    yield KEPT, _spent([*jcr, str(CAPTURE), kept, "--quiet"])
    yield STARTED, _spent([*jcr, str(place / "nothing"), str(place / "none")], status=2)


def _spent(command: list[str], status: int = 0) -> Spent:
    """Of one process, which must end with this status."""
    begun = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, ended, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(ended)
    if process.returncode != status:
        raise RuntimeError(f"{' '.join(command)} ended with status {process.returncode}")
    return Spent(usage.ru_utime + usage.ru_stime, time.perf_counter() - begun, usage.ru_maxrss / 1024)


def _median(each: list[Spent]) -> Spent:
    return Spent(*np.median([(one.processor_s, one.wall_s, one.peak_mib) for one in each], axis=0).tolist())


def colmap_alone(place: str) -> None:
    """In a process of its own: features, exhaustive matching and mapping of the capture's images by COLMAP."""
    import pycolmap

    images, database, cpu = Path(place) / "images", Path(place) / "database.db", pycolmap.Device.cpu
    shutil.copytree(CAPTURE / "images", images)
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE, device=cpu)
    pycolmap.match_exhaustive(database, device=cpu)
    (models := Path(place) / "models").mkdir()
    pycolmap.incremental_mapping(database, images, models)


def run_by_stage(place: str) -> None:
    """In a process of its own: what `jcr run` does, and the processor seconds of its stages in a file."""
    import jcr
    from jcr import attempts, stages
    from jcr.report import html

    spent = dict.fromkeys(STAGES, 0.0)
    parts = (
        (attempts, "reconstruct", "reconstruct"),
        (attempts, "calibrate", "calibrate"),
        (stages, "densify", "densify"),
        (stages, "mapped", "map"),
        (html, "report_html", "report"),
    )
    for module, function, name in parts:
        setattr(module, function, _timed(getattr(module, function), spent, name))
    jcr.run(CAPTURE, Path(place) / "run")
    (Path(place) / "stages.json").write_text(json.dumps(spent))


def _timed(function: Callable, spent: dict[str, float], name: str) -> Callable:
    """The function, whose processor seconds are added up under a name."""

    def timed(*arguments, **options):
        begun = time.process_time()
        found = function(*arguments, **options)
        spent[name] += time.process_time() - begun
        return found

    return timed


def _calibration(images: int) -> tuple[int, int, float]:
    """Images, observations, and the processor seconds of their calibration."""
    from benchmarks.attack import reconstructed
    from jcr.calibration.stage import calibrate
    from simulation.faults import faulty_capture

    seconds, count = [], 0
    for seed in range(REPEATS):
        made = reconstructed(faulty_capture(np.random.default_rng([seed, images]), images), False)
        count = len(made[1].tracks.image)
        begun = time.process_time()
        calibrate(*made)
        seconds.append(time.process_time() - begun)
    return images, count, float(np.median(seconds))
