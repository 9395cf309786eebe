"""`benchmarks batch`: many small captures by one process and by two, and the memory while they run."""

import json
import multiprocessing
import os
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.simulated.problem import hand_eye_problem
from jcr.batch import BatchOptions, batch
from jcr.camera import rays
from jcr.geometry import apply, inverse, scale_translation
from jcr.pipeline import RunOptions
from jcr.reconstruct.backends import ReconstructOptions
from jcr.records import Intrinsics

CAPTURES, MANY, IMAGES = 32, 200, 6
"""MANY with --long."""
INTRINSICS = Intrinsics(30.0, 30.0, 15.5, 11.5, 32, 24)


def run(long: bool = False) -> str:
    """Markdown: seconds for all captures, and resident memory of all processes after each quarter of them."""
    count = MANY if long else CAPTURES
    with tempfile.TemporaryDirectory(prefix="jcr-batch-") as name:
        folder = Path(name)
        captures = [_capture(folder / f"capture{k:03d}", seed=k) for k in range(count)]
        rows = {processes: _measured(captures, folder / f"out{processes}", processes) for processes in (1, 2)}
    seconds = {processes: row[0] for processes, row in rows.items()}
    lines = [
        f"> {count} small captures take {seconds[1]:.0f} s by one process and {seconds[2]:.0f} s by two.",
        "",
        f"{count} captures of {IMAGES} images of {INTRINSICS.width}x{INTRINSICS.height}, pointmaps given (`--backend "
        "predictions --calibrate-only`); memory is the resident set of the command and of its workers together",
        "",
        "| processes | s | times one process | MiB after a quarter | half | three quarters | all |",
        "|---|---|---|---|---|---|---|",
    ]
    for processes, (took, memory) in rows.items():
        quarters = " | ".join(f"{memory[count * k // 4]:.0f}" for k in range(1, 5))
        lines.append(f"| {processes} | {took:.1f} | {seconds[1] / took:.2f} | {quarters} |")
    return "\n".join(lines) + "\n"


def _measured(captures: list[Path], out: Path, processes: int) -> tuple[float, dict[int, float]]:
    """Seconds of a batch, and MiB of all its processes by the number of captures done."""
    memory: dict[int, float] = {}

    def watch(stage: str, fraction: float) -> None:
        pids = [os.getpid(), *(child.pid for child in multiprocessing.active_children())]
        memory[round(fraction * len(captures))] = sum(_resident_mib(pid) for pid in pids if pid)

    reconstruct = ReconstructOptions(predictions=captures[0] / "pointmaps.npz")
    options = BatchOptions(processes=processes, calibrate_only=True)
    begun = time.perf_counter()
    rows = batch(captures, out, RunOptions(reconstruct=reconstruct), options, watch)
    took = time.perf_counter() - begun
    if any(row.status == "failed" for row in rows):
        raise RuntimeError(next(row.reason for row in rows if row.status == "failed"))
    return took, memory


def _resident_mib(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _capture(folder: Path, seed: int) -> Path:
    """A capture before a table z = 0, all of the same views, each with gripper poses of its own noise."""
    (folder / "images").mkdir(parents=True)
    problem = hand_eye_problem(np.random.default_rng(0), IMAGES)
    noisy = hand_eye_problem(np.random.default_rng(0), IMAGES, robot_noise=(1e-4 * (1 + seed), 1e-5))
    draw = np.random.default_rng(seed)
    frames = []
    for k, pose in enumerate(noisy.base_from_gripper):
        pixels = draw.integers(0, 255, (INTRINSICS.height, INTRINSICS.width, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"images/{k}.png")
        frames.append({"image": f"images/{k}.png", "base_from_gripper": pose.tolist()})
    intrinsics = {key: getattr(INTRINSICS, key) for key in ("fx", "fy", "cx", "cy")}
    (folder / "capture.json").write_text(json.dumps({"frames": frames, "intrinsics": intrinsics}))
    if seed == 0:
        _write_pointmaps(
            folder / "pointmaps.npz", problem.true_base_from_gripper @ problem.gripper_from_camera
        )
    return folder


def _write_pointmaps(path: Path, base_from_camera: np.ndarray) -> None:
    """Where every pixel of every view meets the table, in the first camera's frame and half metres."""
    seen = rays(INTRINSICS).reshape(-1, 3) @ np.swapaxes(base_from_camera[:, :3, :3], 1, 2)
    centers = base_from_camera[:, None, :3, 3]
    points = centers - centers[..., 2:] / np.minimum(seen[..., 2:], -1e-3) * seen
    recon_from_base = inverse(base_from_camera[0])
    shape = (len(base_from_camera), INTRINSICS.height, INTRINSICS.width)
    np.savez(
        path,
        recon_from_camera=scale_translation(recon_from_base @ base_from_camera, 2.0),
        points_in_recon=(2.0 * apply(recon_from_base, points.reshape(-1, 3))).reshape(*shape, 3),
        confidence=np.ones(shape),
    )
