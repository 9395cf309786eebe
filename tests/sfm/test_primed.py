"""The map of many images from the robot's poses: where they are right, roughly right, and wrong in two images."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from jcr.features.stage import Matched
from jcr.features.verify import write_geometries, write_keypoints
from jcr.geometry import Transforms, nearest_rotation, rotation_between_deg
from jcr.sfm.mapping import adjust_robustly, camera_of, enter, map_incrementally, quiet_colmap
from jcr.sfm.placed import poses_of
from jcr.sfm.primed import primed
from points_of_a_table import IMAGES, INTRINSICS, PointsOfATable, matched_pairs_of

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def quiet():
    with quiet_colmap():
        yield


@pytest.fixture(scope="module")
def table() -> PointsOfATable:
    return PointsOfATable(minds_roll=False)


def database_of(folder: Path, table: PointsOfATable, matched: Matched) -> Path:
    database = folder / "database.db"
    enter(database, IMAGES, [INTRINSICS], True, 1600)
    write_keypoints(database, table.x_px)
    write_geometries(database, matched.geometries)
    return database


def begun_model(
    database: Path, matched: Matched, base_from_gripper: Transforms
) -> pycolmap.Reconstruction | None:
    assert matched.gate is not None
    return primed(
        database,
        camera_of(INTRINSICS, True),
        matched.gate,
        matched.geometries,
        base_from_gripper,
        lambda model: adjust_robustly(model, True, 1e-3),
    )


def off_mm(table: PointsOfATable, model: pycolmap.Reconstruction) -> float:
    """Root mean square distance of the cameras from their places."""
    adjust_robustly(model, True)
    rows = sorted(image_id - 1 for image_id in model.reg_image_ids())
    found, true = poses_of(model, rows), table.base_from_camera[rows]
    # The cameras stand on a line: their own rotations say how it is rotated about itself.
    rotation = nearest_rotation((true[:, :3, :3] @ np.swapaxes(found[:, :3, :3], 1, 2)).sum(0))
    assert rotation_between_deg(rotation @ found[:, :3, :3], true[:, :3, :3]).max() < 0.3
    own, centres = found[:, :3, 3] @ rotation.T, true[:, :3, 3]
    own, centres = own - own.mean(0), centres - centres.mean(0)
    scale = (own * centres).sum() / (own**2).sum()
    return 1e3 * float(np.sqrt(((scale * own - centres) ** 2).sum(1).mean()))


def test_cameras_are_where_they_were_though_the_robot_is_some_millimetres_off(
    tmp_path: Path, table: PointsOfATable
):
    rng = np.random.default_rng(0)
    reported = table.base_from_gripper.copy()
    reported[:, :3, 3] += rng.normal(scale=4e-3, size=(IMAGES, 3))
    matched = matched_pairs_of(table, reported)
    model = begun_model(database_of(tmp_path, table, matched), matched, reported)
    assert model is not None and model.num_reg_images() == IMAGES
    assert off_mm(table, model) < 1.0


def test_images_with_each_other_s_poses_are_left_to_the_mapper(tmp_path: Path, table: PointsOfATable):
    reported = table.base_from_gripper.copy()
    reported[[6, 20]] = reported[[20, 6]]
    matched = matched_pairs_of(table, table.base_from_gripper)
    database = database_of(tmp_path, table, matched)
    model = begun_model(database, matched, reported)
    assert model is not None
    assert {7, 21}.isdisjoint(model.reg_image_ids()) and model.num_reg_images() == IMAGES - 2
    camera = camera_of(INTRINSICS, True)
    whole = map_incrementally(database, IMAGES, [camera], True, 0, lambda *_: None, model)
    assert whole is not None and whole.num_reg_images() == IMAGES
    assert off_mm(table, whole) < 1.0
