"""`benchmarks bag`: frames chosen from a minute of a robot's bag, with time and memory, and the bag itself."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.simulated.ros_bag import FPS, TF_HZ, nearest_view, write_bag
from jcr.capture.read import read_capture
from jcr.errors import InputError
from jcr.records import Capture

CAPTURE = Path("examples/tabletop")
SECONDS = 60.0
JITTER = 2e-5
"""m per axis (and rad at ARM) of noise in the transforms of the bench: an encoder's last digit."""


def run() -> str:
    """Markdown: what was recorded, which frames were taken, how long it took and how much memory."""
    if not (CAPTURE / "capture.json").is_file():
        raise InputError(f"bench bag: {CAPTURE} is not here; run it in the root of the project")
    capture = read_capture(CAPTURE)
    rows = [_row(capture, compressed, frames) for compressed, frames in ((True, 12), (True, 8), (False, 12))]
    _, size, frames, stops, off, seconds, memory = rows[0]
    lines = [
        f"> From {SECONDS:.0f} s of MCAP with {size} of JPEG, {frames} frames are chosen at {stops} different stops, "
        f"{off} or less from them, in {seconds} and {memory}.",
        "",
        f"{SECONDS:.0f} s of MCAP at {FPS:.0f} fps of 640x480, tf at {TF_HZ:.0f} Hz with {1e3 * JITTER:.2g} mm of "
        f"noise. The arm stops at {len(capture)} views and moves between them as long; moving frames are blurred by "
        "their speed. Time and memory (resident set) are of a process of its own, start of Python included.",
        "",
        "| images | size | frames chosen | different stops among them | farthest from its stop | time | peak memory |",
        "|---|---|---|---|---|---|---|",
        *("| " + " | ".join(row) + " |" for row in rows),
    ]
    return "\n".join(lines) + "\n"


def _row(capture: Capture, compressed: bool, frames: int) -> tuple[str, ...]:
    with tempfile.TemporaryDirectory() as scratch:
        bag = write_bag(
            Path(scratch) / "scan", capture, "mcap", SECONDS, compressed=compressed, jitter=JITTER
        )
        size = sum(file.stat().st_size for file in bag.iterdir()) / 2**20
        script = (
            "import sys, jcr; from jcr.capture.options import ReadOptions\n"
            "options = ReadOptions(base_frame='base_link', gripper_frame='tool0', frames=int(sys.argv[3]))\n"
            "jcr.read_capture(sys.argv[1], options, into=sys.argv[2])"
        )
        arguments = [str(bag), str(Path(scratch) / "frames"), str(frames)]
        begun = time.perf_counter()
        process = subprocess.Popen([sys.executable, "-c", script, *arguments])
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - begun
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise RuntimeError("reading the bag failed")
        content = json.loads((Path(scratch) / "frames" / "capture.json").read_text())
    poses = np.array([frame["base_from_gripper"] for frame in content["frames"]])
    off_mm, off_deg, view = nearest_view(poses, capture.base_from_gripper)
    return (
        "JPEG" if compressed else "raw",
        f"{size:.0f} MiB",
        f"{len(poses)} of {round(SECONDS * FPS)}",
        f"{len(set(view.tolist()))}",
        f"{off_mm.max():.3f} mm, {off_deg.max():.4f}°",
        f"{seconds:.1f} s",
        f"{usage.ru_maxrss / 1024:.0f} MiB",
    )
