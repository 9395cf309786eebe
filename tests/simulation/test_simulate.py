"""Simulated captures: the truth agrees with the geometry, images with the truth, files with both."""

import json
import os
import subprocess
import sys

import cv2
import numpy as np
import pytest

from jcr.errors import InputError
from places import ROOT
from refusal import refused
from simulation.__main__ import main
from simulation.capture import SimulateOptions, simulate
from simulation.truth import read_truth, surface_in_workspace, true_depth, true_labels


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A capture; skips, with the remedy, where nothing can be drawn: `make test` needs no system library."""
    try:
        return simulate(tmp_path_factory.mktemp("simulate") / "tabletop", SimulateOptions(seed=1))
    except InputError as error:
        pytest.skip(str(error))


@pytest.mark.gl
def test_capture_and_truth_agree(simulated):
    truth = read_truth(simulated)
    capture = json.loads((simulated / "capture.json").read_text())
    reference = json.loads((simulated / "reference.json").read_text())
    assert [frame["image"] for frame in capture["frames"]] == list(truth.images)
    reported = np.array([frame["base_from_gripper"] for frame in capture["frames"]])
    np.testing.assert_array_equal(reported, truth.base_from_gripper)
    np.testing.assert_array_equal(reference["gripper_from_camera"], truth.gripper_from_camera)
    np.testing.assert_allclose(reported @ truth.gripper_from_camera, truth.base_from_camera, atol=1e-15)
    for k, image in enumerate(truth.images):
        assert cv2.imread(str(simulated / image)).shape == (480, 640, 3)
        assert true_depth(truth, k).shape == true_labels(truth, k).shape == (480, 640)
    surface = surface_in_workspace(truth)
    # Every object is seen up to its top: none rises above its height, none sinks into the table.
    for thing in truth.objects:
        height = surface.x_in_base[surface.label == thing.label][:, 2] - truth.table_height
        assert height.max() == pytest.approx(thing.height, abs=5e-4)
        assert height.min() > -2e-4
    table = surface.x_in_base[surface.label == 1]
    assert np.abs(table[:, 2] - truth.table_height).max() < 2e-4


@pytest.mark.gl
def test_the_bundled_example_is_what_its_command_makes(simulated, tabletop):
    for name in ("capture.json", "reference.json", "truth/scene.json"):
        bundled, made = (
            # Another processor may round the last bit of a product otherwise.
            json.loads((folder / name).read_text(), parse_float=lambda text: round(float(text), 12))
            for folder in (tabletop, simulated)
        )
        if name == "capture.json":
            assert bundled["source"]["options"].pop("truth") == "scene"
            made["source"]["options"].pop("truth")
        assert bundled == made
    for image in read_truth(tabletop).images:
        bundled, made = (cv2.imread(str(folder / image)).astype(int) for folder in (tabletop, simulated))
        # Another OpenGL may round and filter a little differently.
        assert np.abs(bundled - made).mean() < 2


@pytest.mark.gl
@pytest.mark.usefixtures("simulated")
def test_command_line(tmp_path, monkeypatch):
    command = [sys.executable, "-m", "simulation", str(tmp_path / "out"), "--images", "2"]
    monkeypatch.setattr(sys, "argv", command[2:])
    assert main() == 0 and (tmp_path / "out/capture.json").is_file()
    with refused("--vignetting 2.0: give 0 to 1"):
        simulate(tmp_path / "never", SimulateOptions(vignetting=2.0))
    # A machine without OpenGL: the remedy is named, and nothing is left behind.
    command[3] = str(tmp_path / "blind")
    environment = os.environ | {"MUJOCO_GL": "disable"}
    blind = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment)
    assert blind.returncode == 2 and "apt-get install" in blind.stderr and blind.stderr.count("\n") == 1
    assert not (tmp_path / "blind").exists()
