"""`benchmarks first_day`: what a new user types and sees, from captures as robots and tools write them."""

import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import yaml

from benchmarks.simulated.ros_bag import write_bag
from jcr.capture.read import read_capture
from jcr.capture.robot_poses import numbers_from_poses
from jcr.errors import InputError
from jcr.geometry import inverse, rotation_exp, transform
from jcr.records import Capture
from jcr.simulate.capture import SimulateOptions, simulate

TABLETOP = Path("examples/tabletop")
SHOWN = 16
"""Lines of what a command prints, at most."""
Show = Callable[[str], None]
MARKER_NOISE = (1e-3, np.radians(0.15))
"""m, rad per axis of a marker's pose; of the robot half of it."""


def run() -> str:
    """Markdown: commands, what they print, seconds."""
    if not (TABLETOP / "capture.json").is_file():
        raise InputError(f"bench first_day: {TABLETOP} is not here; run it in the root of the project")
    capture = read_capture(TABLETOP)
    parts: list[str] = []
    times: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        for title, make in DIARIES.items():
            folder = Path(scratch) / make.__name__.strip("_")
            folder.mkdir()
            begun = time.perf_counter()
            lines, commands = make(capture, folder)
            parts += [f"## {title}", "", lines, ""]
            for command, options in commands:
                parts.append(_typed(command, options, folder))
            times.append(f"{title}: {len(commands)} commands, {time.perf_counter() - begun:.0f} s")
    head = [
        "> From files as robots write them to a URDF: " + "; ".join(times) + ".",
        "",
        "Each command was run as typed, in a process of its own; what it printed (standard output and error, at most "
        f"{SHOWN} lines of it) is below it with its exit status and seconds, start of Python included. The images are "
        "those of the bundled capture.",
        "",
    ]
    return "\n".join([*head, *parts])


Commands = list[tuple[str, str]]


def _typed(command: str, options: str, folder: Path) -> str:
    """A command of jcr in the folder, as a console shows it."""
    line = f"jcr {command}" + (f" {options}" if options else "")
    begun = time.perf_counter()
    path = os.pathsep.join(filter(None, [str(Path("src").resolve()), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, "-m", "jcr", *shlex.split(line)[1:]],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"PYTHONPATH": path, "COLUMNS": "110"},
    )
    seconds = time.perf_counter() - begun
    printed = [text for text in done.stdout.replace(str(folder) + "/", "").splitlines() if text.strip()]
    if len(printed) > SHOWN:
        printed = [*printed[: SHOWN - 1], f"… {len(printed) - SHOWN + 1} more lines"]
    block = "\n".join([f"$ {line}", *printed])
    return f"```\n{block}\n```\n\nexit status {done.returncode}, {seconds:.1f} s\n"


def _images(capture: Capture, folder: Path) -> None:
    (folder / "scan" / "images").mkdir(parents=True)
    for name in capture.images:
        (folder / "scan" / name).write_bytes((capture.folder / name).read_bytes())
    intrinsics = capture.intrinsics
    assert intrinsics is not None
    info = {
        "image_width": intrinsics.width,
        "image_height": intrinsics.height,
        "camera_matrix": {"rows": 3, "cols": 3, "data": intrinsics.matrix.ravel().tolist()},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": list(intrinsics.distortion)},
    }
    (folder / "scan" / "camera_info.yaml").write_text(yaml.safe_dump(info))


def _ur_csv_in_mm(capture: Capture, folder: Path) -> tuple[str, Commands]:
    _images(capture, folder)
    rows = numbers_from_poses(capture.base_from_gripper, "ur", "mm-rad")
    lines = [
        f"{Path(name).name}," + ",".join(f"{v:.4f}" for v in row)
        for name, row in zip(capture.images, rows, strict=True)
    ]
    (folder / "scan" / "poses.csv").write_text("image,x,y,z,rx,ry,rz\n" + "\n".join(lines) + "\n")
    about = "Copied from the pendant: a table with millimetres and rotation vectors."
    return about, [
        ("check scan", ""),
        ("check scan", "--pose-convention ur --poses-only"),
        ("check scan", "--pose-convention ur --pose-units mm-rad --poses-only"),
        ("calibrate scan out", "--pose-convention ur --pose-units mm-rad"),
        ("export out urdf", ""),
    ]


def _franka_rows_of_16(capture: Capture, folder: Path) -> tuple[str, Commands]:
    _images(capture, folder)
    rows = numbers_from_poses(capture.base_from_gripper, "franka")
    text = "\n".join(" ".join(f"{v:.9f}" for v in row) for row in rows)
    (folder / "scan" / "poses.txt").write_text(text + "\n")
    about = (
        "`O_T_EE` of each image as the Franka Control Interface gives it: 16 numbers by columns, no header."
    )
    return about, [
        ("check scan", "--poses-only"),
        ("calibrate scan out", "--pose-convention franka"),
        ("export out urdf", ""),
    ]


def _ros2_bag(capture: Capture, folder: Path) -> tuple[str, Commands]:
    write_bag(folder / "scan", capture, "mcap", 24.0)
    about = "24 s of an MCAP: images, camera_info and tf, the arm stopping at the twelve poses."
    return about, [
        ("calibrate scan/scan.mcap out", ""),
        ("calibrate scan/scan.mcap out", "--base-frame base_link --gripper-frame tool0"),
        ("export out urdf", ""),
    ]


def _easy_handeye2_samples(capture: Capture, folder: Path) -> tuple[str, Commands]:
    rng = np.random.default_rng(0)
    truth = np.array(yaml.safe_load((capture.folder / "reference.json").read_text())["gripper_from_camera"])

    def shaken(poses: np.ndarray, share: float) -> np.ndarray:
        rotation = rotation_exp(share * MARKER_NOISE[1] * rng.normal(size=(len(poses), 3)))
        shift = share * MARKER_NOISE[0] * rng.normal(size=(len(poses), 3))
        return transform(rotation @ poses[:, :3, :3], poses[:, :3, 3] + shift)

    base_from_camera = capture.base_from_gripper @ truth
    marker = inverse(transform(np.eye(3), np.array([0.45, 0.0, 0.0]))) @ base_from_camera
    samples = []
    pairs = zip(shaken(capture.base_from_gripper, 0.5), inverse(shaken(marker, 1.0)), strict=True)
    for robot, tracking in pairs:
        both = {}
        for name, pose in (("robot", robot), ("tracking", tracking)):
            row = numbers_from_poses(pose[None], "quat-xyzw")[0].tolist()
            both[name] = {
                "translation": dict(zip("xyz", row[:3], strict=True)),
                "rotation": dict(zip("xyzw", row[3:], strict=True)),
            }
        samples.append(both)
    content = {"parameters": {"name": "", "calibration_type": "eye_in_hand"}, "samples": samples}
    (folder / "wrist.samples").write_text(yaml.safe_dump(content))
    about = (
        f"Twelve samples of a marker with {1e3 * MARKER_NOISE[0]:g} mm and {np.degrees(MARKER_NOISE[1]):g}° of noise "
        "per axis, the robot's half of that."
    )
    return about, [("check wrist.samples", ""), ("calibrate wrist.samples out", ""), ("export out urdf", "")]


def _realsense(capture: Capture, folder: Path) -> tuple[str, Commands]:
    simulate(
        folder / "scan", SimulateOptions(seed=3, depth=(3.0, 2.0), robot_noise=(0.2, 0.02), truth="scene")
    )
    about = (
        "A capture as `jcr capture --camera realsense` leaves it, here simulated: aligned depth in `depth/`, lengths "
        "3 % too long, with a noise of 2 mm at 1 m; the robot's 0.2 mm and 0.02°."
    )
    return about, [
        ("check scan", ""),
        ("calibrate scan out --require 2 0.5", ""),
        ("compare out scan", ""),
        ("export out urdf", ""),
    ]


def _opencv_camera(capture: Capture, folder: Path) -> tuple[str, Commands]:
    writer = cv2.VideoWriter(
        str(folder / "wrist.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, capture.image_size
    )
    for name in capture.images[:4]:
        image = np.asarray(cv2.imread(str(capture.folder / name)))
        for step in range(15):
            shift = np.array([[1.0, 0, 40.0 * max(0, 5 - step)], [0, 1.0, 0]])
            writer.write(cv2.warpAffine(image, shift, capture.image_size, borderMode=cv2.BORDER_WRAP))
    writer.release()
    about = "Nothing but a camera (here a recording of one): the command says what it waits for."
    return about, [
        ("board board.pdf", ""),
        ("capture scan", "--camera wrist.avi --poses nobody"),
        ("capture scan", "--camera 0 --poses franka:127.0.0.88"),
    ]


DIARIES: dict[str, Callable[[Capture, Path], tuple[str, Commands]]] = {
    "UR, a CSV in mm": _ur_csv_in_mm,
    "Franka, rows of 16 numbers": _franka_rows_of_16,
    "A ROS 2 bag": _ros2_bag,
    "Samples of easy_handeye2": _easy_handeye2_samples,
    "A RealSense capture with depth": _realsense,
    "Live, and what can go wrong": _opencv_camera,
}
