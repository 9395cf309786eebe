"""`benchmarks run`: the whole job on a small simulated capture, each run a process of its own."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.page import apart, table
from jcr.calibration.known_transform import read_hand_eye
from jcr.capture.read import read_capture
from jcr.errors import InputError

REPEATS = 1
CAPTURE = Path("examples/tabletop")


def run() -> str:
    """Markdown: error, median seconds of each stage and of the whole, and peak memory of the process."""
    if not (CAPTURE / "capture.json").is_file():
        raise InputError(f"bench run: {CAPTURE} is not here; run it in the root of the project")
    true = read_hand_eye(CAPTURE).gripper_from_camera
    whole, peak, stages, found = [], [], [], true
    for _ in range(REPEATS):
        with tempfile.TemporaryDirectory() as out:
            seconds, mib = _measured("run", str(CAPTURE), out, "--quiet")
            whole.append(seconds)
            peak.append(mib)
            stages.append(json.loads((Path(out) / "calibration.json").read_text())["timings_s"])
            found = read_hand_eye(Path(out)).gripper_from_camera
    off_mm, off_deg = apart(found, true)
    helped = [_measured("--help")[0] for _ in range(5)]
    images = len(read_capture(CAPTURE))
    medians = {name: np.median([stage[name] for stage in stages]) for name in stages[0]}
    medians["whole process"] = np.median(whole)
    lines = [
        f"> Bundled capture, exact robot poses, {images} images: {off_mm:.2f} mm and {off_deg:.3f}° off the truth, "
        f"report and map included in {np.median(whole):.0f} s and {np.median(peak) / 1024:.1f} GiB.",
        "",
        f"`jcr run {CAPTURE} OUT`, median of {REPEATS} runs",
        "",
        *table("stage | s", [[name, f"{seconds:.1f}"] for name, seconds in medians.items()]),
        "",
        f"Peak memory {np.median(peak):.0f} MiB (resident set). `jcr --help`: {np.median(helped):.2f} s.",
    ]
    return "\n".join(lines) + "\n"


def _measured(*arguments: str) -> tuple[float, float]:
    """Seconds and peak resident MiB of one jcr process."""
    begun = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "jcr", *arguments], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"jcr {' '.join(arguments)} ended with status {process.returncode}")
    return time.perf_counter() - begun, usage.ru_maxrss / 1024
