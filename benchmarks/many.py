"""`benchmarks many`: more and more images of 640x480 pixels, in seconds and peak memory."""

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.page import apart
from jcr.calibration.known_transform import read_hand_eye
from jcr.calibration.stage import calibrate
from jcr.capture.read import read_capture
from jcr.sfm.colmap import reconstruct_colmap
from simulation.capture import SimulateOptions, simulate

SIZES = (8, 16, 32)


def run() -> str:
    """Markdown: a process for every number of images, SIFT, the robot's gate on, without dense depth."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "capture"
        simulate(capture, SimulateOptions(images=max(SIZES), robot_noise=(0.2, 0.05), truth="scene"))
        for count in SIZES:
            command = [
                sys.executable,
                "-c",
                f"from benchmarks.many import one; one({str(capture)!r}, {count})",
            ]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            found.append(json.loads(done.stdout.splitlines()[-1]))
    return table(found)


def table(found: Sequence[dict[str, float]]) -> str:
    """Markdown of what the processes printed."""
    seconds = {one["images"]: one["cpu_s"] for one in found}
    most = max(seconds)
    lines = [
        f"> From {most // 4} to {most} images processor time grows {seconds[most] / seconds[most // 4]:.1f} times, the "
        "number of pairs matched in proportion to the images.",
        "",
        "Simulated tables, 640x480, SIFT, the robot's gate on; reconstruction without dense depth, and calibration, in "
        "a process of its own each. Processor seconds are of all threads.",
        "",
        "| images | registered | reconstruct, s | calibrate, s | processor, s | peak memory, GB | off, mm |",
        "|---" * 7 + "|",
        *(
            f"| {one['images']} | {one['registered']} | {one['reconstruct_s']:.0f} | {one['calibrate_s']:.0f} | "
            f"{one['cpu_s']:.0f} | {one['peak_gb']:.2f} | {one['off_mm']:.2f} |"
            for one in found
        ),
    ]
    return "\n".join(lines) + "\n"


def one(folder: str, count: int) -> None:
    """Reconstruct and calibrate the first images of a capture, and print what it took as JSON."""
    capture = read_capture(Path(folder))
    capture = replace(
        capture, images=capture.images[:count], base_from_gripper=capture.base_from_gripper[:count]
    )
    begun = time.perf_counter()
    made = reconstruct_colmap(capture)
    mapped = time.perf_counter()
    hand_eye = calibrate(capture, made)
    done = time.perf_counter()
    used = resource.getrusage(resource.RUSAGE_SELF)
    reference = read_hand_eye(Path(folder) / "reference.json").gripper_from_camera
    facts = {
        "images": len(capture),
        "registered": len(made.image_index),
        "reconstruct_s": mapped - begun,
        "calibrate_s": done - mapped,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_gb": 1024 * used.ru_maxrss / 1e9,
        "off_mm": apart(hand_eye.gripper_from_camera, reference)[0],
    }
    sys.stdout.write(json.dumps(facts) + "\n")
