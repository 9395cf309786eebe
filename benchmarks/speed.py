"""Processor time and memory of jobs and stages beside COLMAP alone, and growth with the number of images."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.page import apart, of_rows, table
from jcr.errors import InputError

CAPTURE = Path("examples/tabletop")
REPEATS = 3
SIZES, OBSERVED = (12, 50, 200), (15, 50, 100)
"""Numbers of rendered images, and of images of simulated observations."""
ALONE, ALL, CALIBRATED = "COLMAP alone", "`jcr run`", "`jcr calibrate`"
REJECTED = "`jcr run`, poses in another order (rejected)"
STAGES = ("reconstruct", "calibrate", "densify", "map", "report")


class Spent(NamedTuple):
    """Resources of one process."""

    processor_s: float
    """Processor time of all threads, in the program and in the system."""
    wall_s: float
    peak_mib: float
    """Resident set."""


def run() -> str:
    """Return the page in Markdown: medians of a few rounds in which every job runs once, a process each."""
    if not (CAPTURE / "capture.json").is_file():
        raise InputError(f"bench speed: {CAPTURE} is not here; run it in the root of the project")
    spent: dict[str, list[Spent]] = defaultdict(list)
    stages: list[dict[str, float]] = []
    off = 0.0, 0.0
    for number in range(REPEATS):
        with tempfile.TemporaryDirectory() as place:
            for name, one in _jobs(Path(place), number == 0):
                spent[name].append(one)
            stages.append(json.loads((Path(place) / "stages.json").read_text()))
            off = _off(Path(place) / "whole", CAPTURE)
    of = {name: Spent(*np.median(each, axis=0).tolist()) for name, each in spent.items()}
    alone, grown = of[ALONE].processor_s, _growth()
    growth = grown[-1][2].processor_s / grown[-2][2].processor_s
    lines = [
        f"> `jcr run` on {CAPTURE} takes {of[ALL].processor_s:.1f} s of processor, "
        f"{of[ALL].processor_s / alone:.1f} times COLMAP alone on the same images, {of[ALL].wall_s:.0f} s of time and "
        f"{of[ALL].peak_mib / 1024:.1f} GiB, and is {off[0]:.2f} mm and {off[1]:.3f}° off the truth; `jcr calibrate` "
        f"{of[CALIBRATED].processor_s / alone:.1f} times.",
        f"> From {SIZES[-2]} to {SIZES[-1]} images processor time grows {growth:.1f} times; a rejected capture takes "
        f"{of[REJECTED].processor_s / of[ALL].processor_s:.1f} times `jcr run` of the accepted one.",
        "",
        f"Medians of {REPEATS} rounds, and one first run after installation. *COLMAP alone*: features, exhaustive "
        "matching and mapping, with its defaults.",
        "",
        *table(
            "job | processor, s | times COLMAP | wall, s | peak, GiB",
            (
                [name, f"{cpu:.1f}", f"{cpu / alone:.2f}", f"{wall:.1f}", f"{peak / 1024:.2f}"]
                for name, (cpu, wall, peak) in of.items()
            ),
        ),
        "",
        *table(
            "stage of `jcr run` | processor, s",
            ([name, f"{np.median([one[name] for one in stages]):.2f}"] for name in STAGES),
        ),
        "",
        "Rendered images of 640x480, SIFT, reconstruction without dense depth, and calibration:",
        "",
        *table(
            "images | registered | processor, s | peak, MiB | off, mm",
            (
                [count, registered, f"{one.processor_s:.2f}", f"{one.peak_mib:.2f}", f"{mm:.2f}"]
                for count, (registered, mm), one in grown
            ),
        ),
        "",
        "Calibration of simulated observations, 500 points over the table, no reconstruction:",
        "",
        *table("images | observations | processor, s", map(_calibration, OBSERVED)),
    ]
    return "\n".join(lines) + "\n"


def _off(result: Path, capture: Path) -> tuple[float, float]:
    """Return the distance (mm, degrees) of a run's transform from the truth."""
    from jcr.calibration.difference import read_hand_eye

    return apart(*(read_hand_eye(path).gripper_from_camera for path in (result, capture / "reference.json")))


def _jobs(place: Path, is_first: bool) -> Iterator[tuple[str, Spent]]:
    """Run every job once, the first run after installation in the first round alone."""
    jcr, kept = [sys.executable, "-m", "jcr"], place / "kept"
    yield ALONE, _spent(_call(f"colmap_alone({str(place)!r})"))
    yield ALL, _spent([*jcr, "run", str(CAPTURE), str(place / "whole"), "--quiet"])
    _spent(_call(f"run_by_stage({str(place)!r})"))
    yield CALIBRATED, _spent([*jcr, "calibrate", str(CAPTURE), str(kept), "--quiet"])
    (kept / "calibration.json").unlink()
    again = _spent([*jcr, "calibrate", str(CAPTURE), str(kept), "--quiet"])
    yield f"{CALIBRATED}, reconstruction kept", again
    if is_first:
        fresh = os.environ | {"NUMBA_CACHE_DIR": str(place / "numba")}
        first = _spent([*jcr, "run", str(CAPTURE), str(place / "first"), "--quiet"], 0, fresh)
        yield f"{ALL}, first after installation", first
    wrong = place / "wrong"
    shutil.copytree(CAPTURE, wrong)
    content = json.loads((wrong / "capture.json").read_text())
    poses = [frame["base_from_gripper"] for frame in content["frames"]]
    for frame, row in zip(content["frames"], np.random.default_rng(0).permutation(len(poses)), strict=True):
        frame["base_from_gripper"] = poses[row]
    (wrong / "capture.json").write_text(json.dumps(content))
    yield REJECTED, _spent([*jcr, "run", str(wrong), str(place / "rejected"), "--quiet"], 3)
    missing = [*jcr, "calibrate", str(place / "nothing"), str(place / "none")]
    yield f"{CALIBRATED} of a missing folder", _spent(missing, status=2)


def _call(function: str) -> list[str]:
    """Return the command that calls a function of this module in a process of its own."""
    return [sys.executable, "-c", f"from benchmarks import speed; speed.{function}"]


def _spent(command: list[str], status: int = 0, environment: dict[str, str] | None = None) -> Spent:
    """Run one process, which must end with this status."""
    begun = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    _, ended, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(ended)
    if process.returncode != status:
        raise RuntimeError(f"{' '.join(command)} ended with status {process.returncode}")
    return Spent(usage.ru_utime + usage.ru_stime, time.perf_counter() - begun, usage.ru_maxrss / 1024)


def colmap_alone(place: str) -> None:
    """Extract features, match exhaustively and map the capture's images by COLMAP, in a process of its own."""
    import pycolmap

    images, database, cpu = Path(place) / "images", Path(place) / "database.db", pycolmap.Device.cpu
    shutil.copytree(CAPTURE / "images", images)
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE, device=cpu)
    pycolmap.match_exhaustive(database, device=cpu)
    (models := Path(place) / "models").mkdir()
    pycolmap.incremental_mapping(database, images, models)


def run_by_stage(place: str) -> None:
    """Run all stages in a process of its own, and write the processor seconds of each into stages.json."""
    import jcr
    from jcr.pipeline import backend_selection
    from jcr.pipeline.stages import STAGES as FUNCTIONS

    spent: dict[str, float] = dict.fromkeys(STAGES, 0.0)
    # The stage that reconstructs also calibrates, to select the back end.
    for function, name in (("reconstruct", "reconstruct"), ("calibrate_reconstruction", "calibrate")):
        setattr(backend_selection, function, _timed(getattr(backend_selection, function), spent, name))
    for name in STAGES[2:]:
        stage = FUNCTIONS[name]
        FUNCTIONS[name] = stage._replace(function=_timed(stage.function, spent, name))
    jcr.run(CAPTURE, Path(place) / "run")
    (Path(place) / "stages.json").write_text(json.dumps(spent))


def _timed(function: Callable, spent: dict[str, float], name: str) -> Callable:
    """Return the function with its processor seconds added up under a name."""

    def timed(*arguments, **options):
        begun = time.process_time()
        found = function(*arguments, **options)
        spent[name] += time.process_time() - begun
        return found

    return timed


def _growth() -> list[tuple[int, tuple[int, float], Spent]]:
    """Return number of images, registered ones with the error in mm, and resources, for more and more images."""
    from simulation.capture import SimulateOptions, simulate

    found = []
    with tempfile.TemporaryDirectory() as folder:
        capture, facts = Path(folder) / "capture", Path(folder) / "facts.json"
        simulate(capture, SimulateOptions(images=max(SIZES), robot_noise=(0.2, 0.05), truth="scene"))
        for count in SIZES:
            spent = _spent(_call(f"reconstruct_first({str(capture)!r}, {count}, {str(facts)!r})"))
            found.append((count, tuple(json.loads(facts.read_text())), spent))
    return found


def reconstruct_first(folder: str, count: int, facts: str) -> None:
    """Reconstruct and calibrate the first images of a capture; write images registered and error in mm to `facts`."""
    from jcr.calibration.calibrate import calibrate_reconstruction
    from jcr.calibration.difference import read_hand_eye
    from jcr.capture.read import read_capture
    from jcr.sfm.colmap import reconstruct_colmap

    capture = of_rows(read_capture(Path(folder)), range(count))
    made = reconstruct_colmap(capture)
    reference = read_hand_eye(Path(folder) / "reference.json").gripper_from_camera
    off_mm, _ = apart(calibrate_reconstruction(capture, made).gripper_from_camera, reference)
    Path(facts).write_text(json.dumps([len(made.image_index), off_mm]))


def _calibration(images: int) -> tuple[int, int, str]:
    """Return images, observations, and the median processor seconds of their calibration."""
    from jcr.calibration.calibrate import calibrate_reconstruction
    from simulation.faults import faulty_capture, reconstructed

    seconds, count = [], 0
    for seed in range(REPEATS):
        made = reconstructed(faulty_capture(np.random.default_rng([seed, images]), images), False)
        count = len(made[1].tracks.image)
        begun = time.process_time()
        calibrate_reconstruction(*made)
        seconds.append(time.process_time() - begun)
    return images, count, f"{np.median(seconds):.2f}"
