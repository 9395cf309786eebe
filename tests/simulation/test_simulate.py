"""Simulated captures: the truth agrees with the geometry, images with the truth, files with both."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from jcr.errors import InputError
from jcr.geometry import apply, inverse
from jcr.records import Intrinsics
from places import ROOT
from simulation.capture import SimulateOptions, simulate
from simulation.poses import gripper_poses, random_hand_eye
from simulation.render import render
from simulation.scenes import RECIPES, make_scene
from simulation.truth import read_truth, surface_in_workspace, true_depth, true_labels

CAMERA = Intrinsics(610.0, 610.0, 319.5, 239.5, 640, 480)


@pytest.fixture(scope="module")
def simulated(opengl, tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("simulate") / "tabletop", SimulateOptions(seed=1))


@pytest.mark.slow
@pytest.mark.parametrize("name", RECIPES)
def test_objects_stand_on_the_table_and_apart(name):
    for seed in range(3):
        scene = make_scene(name, seed)
        boxes = []
        for thing, true in zip(scene.objects, scene.true_objects, strict=True):
            surface = np.concatenate(
                [apply(thing.base_from_object, part.mesh.vertices) for part in thing.parts]
            )
            assert surface[:, 2].min() == pytest.approx(scene.table_height, abs=1e-12)
            assert surface[:, 2].max() - scene.table_height == pytest.approx(true.height, abs=1e-12)
            in_box = apply(inverse(true.base_from_box), surface)
            np.testing.assert_allclose(np.abs(in_box).max(0), true.box_size / 2, atol=1e-6)
            boxes.append(cv2.convexHull(true.footprint_in_base.astype(np.float32)))
            low, high = scene.workspace_in_base
            assert ((surface >= low) & (surface <= high)).all()
        for k, first in enumerate(boxes):
            assert all(cv2.intersectConvexConvex(first, second)[0] == 0 for second in boxes[:k])


# Dimension of what (translation, rotation, log scale) the poses leave free, scale unknown.
@pytest.mark.gl
@pytest.mark.usefixtures("opengl")
def test_depth_and_labels_are_those_of_the_pixel_centers():
    scene = make_scene("tabletop", 0)
    rng = np.random.default_rng(0)
    gripper_from_camera = random_hand_eye(rng)
    base_from_camera = (
        gripper_poses("varied", 4, scene.table_center_in_base, gripper_from_camera, rng) @ gripper_from_camera
    )
    carton = scene.true_objects[scene.labels.index("carton") - 2]
    x, y = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones(x.shape)], -1)
    for matrix, view in zip(
        base_from_camera, render(scene, CAMERA, base_from_camera, textured=False), strict=True
    ):
        assert view.depth is not None and view.label is not None
        x_in_base = apply(matrix, view.depth[..., None] * rays)
        # 5 µm: a shift of the grid by a twentieth of a pixel would already show as 50 µm.
        np.testing.assert_allclose(x_in_base[view.label == 1][:, 2], scene.table_height, atol=5e-6)
        in_box = apply(inverse(carton.base_from_box), x_in_base[view.label == carton.label])
        assert len(in_box) > 500
        np.testing.assert_allclose((np.abs(in_box) - carton.box_size / 2).max(1), 0.0, atol=5e-6)


@pytest.mark.gl
@pytest.mark.usefixtures("opengl")
def test_images_show_points_where_they_project():
    scene = make_scene("tabletop", 0)
    square, columns, rows = 0.05, 19, 24
    checks = (np.add.outer(np.arange(rows), np.arange(columns)) % 2 * 200 + 30).astype(np.uint8)
    checks = np.repeat(np.kron(checks, np.ones((100, 100), np.uint8))[..., None], 3, axis=-1)
    board = replace(scene.table[0], texture=checks)
    scene = replace(scene, table=(board, scene.table[1]), objects=())
    corners = np.stack(
        np.meshgrid(np.arange(1, columns), np.arange(1, rows), [0.0], indexing="ij"), -1
    ).reshape(-1, 3)
    corners = (corners - [columns / 2, rows / 2, 0]) * square + scene.table_center_in_base
    rng = np.random.default_rng(1)
    still = np.eye(4)
    base_from_camera = gripper_poses("varied", 4, scene.table_center_in_base, still, rng)
    errors = []
    for matrix, view in zip(
        base_from_camera, render(scene, CAMERA, base_from_camera, with_truth=False), strict=True
    ):
        in_camera = apply(inverse(matrix), corners)
        px = in_camera[:, :2] / in_camera[:, 2:] * CAMERA.fx + [CAMERA.cx, CAMERA.cy]
        px = px[((px > 15) & (px < [CAMERA.width - 16, CAMERA.height - 16])).all(1)]
        gray = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)
        corners_px = np.ascontiguousarray(px[:, None], np.float32)
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        seen = cv2.cornerSubPix(gray, corners_px, (6, 6), (-1, -1), criteria)[:, 0]
        errors.append(seen - px)
    error = np.concatenate(errors)
    assert len(error) > 300
    assert np.abs(error.mean(0)).max() < 0.02
    assert np.sqrt((error**2).sum(1).mean()) < 0.1


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
@pytest.mark.usefixtures("opengl")
def test_command_line(tmp_path):
    command = [sys.executable, "-m", "simulation", str(tmp_path / "out"), "--images", "2"]
    assert subprocess.run(command, cwd=ROOT).returncode == 0 and (tmp_path / "out/capture.json").is_file()
    again = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert again.returncode == 2 and again.stderr.startswith("error: ") and again.stderr.count("\n") == 1
    with pytest.raises(InputError, match="--vignetting 2.0: give 0 to 1"):
        simulate(tmp_path / "never", SimulateOptions(vignetting=2.0))
    # A machine without OpenGL: the remedy is named, and nothing is left behind.
    command[3] = str(tmp_path / "blind")
    environment = os.environ | {"MUJOCO_GL": "disable"}
    blind = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment)
    assert blind.returncode == 2 and "apt-get install" in blind.stderr and blind.stderr.count("\n") == 1
    assert not (tmp_path / "blind").exists()
