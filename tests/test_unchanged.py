"""A second run of unchanged input makes nothing, whatever its format; changed input is read and run again."""

import json
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import capture_writers as writers
import jcr
from conftest import shrunk_capture
from jcr.backends import ReconstructOptions
from jcr.capture.images import read_image
from jcr.cli import dispatch
from jcr.pipeline import backend_selection
from jcr.pipeline.stages import begun
from jcr.records import Capture, Reconstruction
from jcr.result import RunOptions
from scenes import reconstruction_of
from simulation.problems import hand_eye_problem
from simulation.ros_bag import write_bag

pytestmark = pytest.mark.slow

COUNT, SECONDS = 8, 2.0
PROBLEM = hand_eye_problem(np.random.default_rng(0), COUNT, robot_noise=(2e-4, 5e-4))


@pytest.fixture(scope="module")
def capture(tabletop: Path, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Eight small images, with gripper poses of a problem whose camera poses are known."""
    folder = shrunk_capture(tabletop, tmp_path_factory.mktemp("small") / "capture", COUNT, 160)
    file = folder / "capture.json"
    content = json.loads(file.read_text())
    for frame, pose in zip(content["frames"], PROBLEM.base_from_gripper, strict=True):
        frame["base_from_gripper"] = pose.tolist()
    file.write_text(json.dumps(content))
    return jcr.read_capture(folder)


@pytest.fixture(autouse=True)
def made(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The back end of each reconstruction that is made; it gives the camera poses of the problem."""
    made = []

    def reconstruct(capture: Capture, options: ReconstructOptions, progress: object) -> Reconstruction:
        made.append(options.backend)
        return reconstruction_of(PROBLEM.recon_from_camera[: len(capture)], backend=options.backend)

    monkeypatch.setattr(backend_selection, "reconstruct", reconstruct)
    monkeypatch.setattr(backend_selection, "view_findings", lambda _: ())
    return made


def lerobot(folder: Path, capture: Capture) -> Path:
    images = [read_image(capture.folder / name) for name in capture.images]
    episode = images, writers.rows_as("rpy", capture.base_from_gripper)
    names, key = ["x", "y", "z", "roll", "pitch", "yaw"], "observation.state"
    return writers.write_lerobot(folder / "set", [episode], "v3.0", key, names, codec=None)


FORMATS: dict[str, Callable[[Path, Capture], Path]] = {
    "capture.json": lambda folder, capture: capture.folder,
    **writers.CORPUS,
    "bag": lambda folder, capture: write_bag(folder / "scan", capture, "mcap", 8.0, fps=10.0, tf_hz=50.0),
    "LeRobot": lerobot,
}
OPTIONS = {
    "poses.npy": ["--pose-convention", "matrix"],
    "poses.txt": ["--pose-convention", "quat:xyzw"],
    "bag": ["--base-frame", "base_link", "--gripper-frame", "tool0", "--frames", str(COUNT)],
}


def stamps_of(folder: Path) -> dict[Path, int]:
    files = (file for file in folder.rglob("*") if file.is_file() and file.name != ".lock")
    return {file: file.stat().st_mtime_ns for file in files}


@pytest.mark.parametrize("format", FORMATS)
def test_the_second_run_makes_nothing(format: str, capture: Capture, tmp_path, made: list[str], capsys):
    path = FORMATS[format](tmp_path / "input", capture)
    path = path.parent if path.is_file() else path
    out = tmp_path / "out"
    command = ["run", str(path), str(out), "--no-map", "--backend", "colmap", *OPTIONS.get(format, [])]
    first = dispatch(command)
    said = capsys.readouterr()
    assert first in (0, 3), said.err
    assert said.out.count("\n") <= 14 and not said.err
    stamps = stamps_of(out)
    start = time.perf_counter()
    assert dispatch(command) == first
    seconds, again = time.perf_counter() - start, capsys.readouterr()
    assert made == ["colmap"] and "unchanged: " in again.err
    assert again.out.splitlines()[1:] == said.out.splitlines()[1:]
    assert stamps_of(out) == stamps
    assert seconds < SECONDS


def test_other_options_of_the_calibration_keep_the_cameras(
    capture: Capture, tmp_path, made: list[str], capsys
):
    command = ["run", str(capture.folder), str(tmp_path), "--no-map", "--backend", "colmap"]
    for options in ([], ["--require", "50", "9"]):
        dispatch([*command, *options])
        assert "unchanged" not in capsys.readouterr().err and made == ["colmap"]


@pytest.mark.parametrize("format", ["poses.csv", "bag"])
def test_edited_input_is_read_and_run_again(format: str, capture: Capture, tmp_path, made: list[str], capsys):
    path, out = tmp_path / "input", tmp_path / "out"
    moved = capture.base_from_gripper.copy()
    moved[:, 0, 3] += 0.1
    command = ["run", "", str(out), "--no-map", "--backend", "colmap", *OPTIONS.get(format, [])]
    for poses in (capture.base_from_gripper, moved):
        written = FORMATS[format](path, replace(capture, base_from_gripper=poses))
        command[1] = str(written.parent if written.is_file() else written)
        dispatch(command)
        os.rename(path, tmp_path / f"{len(made)}")
        assert "unchanged" not in capsys.readouterr().err
    assert made == ["colmap", "colmap"]
    found = jcr.read_capture(out / "capture").base_from_gripper
    assert found[:, 0, 3].mean() == pytest.approx(moved[:, 0, 3].mean(), abs=0.02)


def test_a_corrected_mount_is_reconstructed_anew(capture: Capture, tmp_path: Path):
    """The images of a fixed camera are reconstructed without their background: the old reconstruction was kept."""
    mounts = (replace(capture, mount=mount) for mount in ("gripper", "base"))
    made = {begun(tmp_path, one, RunOptions()).state.made["select"] for one in mounts}
    assert len(made) == 2
