"""Pose-primed mapping: poses that are roughly right, of another X, exchanged, shuffled; images that nothing ties."""

from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from jcr.features.stage import Matched
from jcr.features.verify import write_geometries, write_keypoints
from jcr.geometry import Transforms, nearest_rotation, rotation_between_deg, rotation_exp, transform
from jcr.sfm.mapping import adjust_robustly, camera_of, enter, map_incrementally, quiet_colmap
from jcr.sfm.pose_primed import map_from_cameras, map_from_gripper_poses, poses_of, with_missing_images
from points_of_a_table import IMAGES, INTRINSICS, PointsOfATable, matched_pairs_of, matcher_of_points

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
    return map_from_gripper_poses(
        database,
        camera_of(INTRINSICS, True),
        matched.gate,
        matched.geometries,
        base_from_gripper,
        lambda model, scale_px: adjust_robustly(model, True, 1e-3, scale_px),
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


def rough_cameras(table: PointsOfATable) -> dict[int, Transforms]:
    """Return the cameras by a hand-eye transform that is 12 mm and 1° off."""
    off = transform(rotation_exp(np.radians([0.6, -0.6, 0.53])), np.array([8e-3, -8e-3, 4e-3]))
    return dict(enumerate(table.base_from_camera @ off))


def adjust(model: pycolmap.Reconstruction, scale_px: float) -> None:
    adjust_robustly(model, True, 1e-3, scale_px)


def test_an_initial_x_may_be_12_mm_and_a_degree_off(tmp_path: Path, table: PointsOfATable):
    matched = matched_pairs_of(table, table.base_from_gripper)
    database = database_of(tmp_path, table, matched)
    exact = map_from_cameras(
        database, camera_of(INTRINSICS, True), dict(enumerate(table.base_from_camera)), adjust
    )
    rough = map_from_cameras(database, camera_of(INTRINSICS, True), rough_cameras(table), adjust)
    assert rough.num_reg_images() == IMAGES
    assert rough.num_points3D() > 0.99 * exact.num_points3D()
    assert off_mm(table, rough) < 1.0


def test_shuffled_poses_prime_no_map(tmp_path: Path, table: PointsOfATable):
    matched = matched_pairs_of(table, table.base_from_gripper)
    shuffled = table.base_from_gripper[np.random.default_rng(0).permutation(IMAGES)]
    assert begun_model(database_of(tmp_path, table, matched), matched, shuffled) is None


def test_images_that_nothing_ties_to_the_others_are_left_out(tmp_path: Path, table: PointsOfATable):
    """Twenty images and ten others, without a common match: gripper poses alone would hold them together."""
    matched = matched_pairs_of(table, table.base_from_gripper)
    apart = {key: one for key, one in matched.geometries.items() if (key[0] < 20) == (key[1] < 20)}
    database = database_of(tmp_path, table, replace(matched, geometries=apart))
    model = map_from_cameras(database, camera_of(INTRINSICS, True), rough_cameras(table), adjust)
    assert sorted(model.reg_image_ids()) == list(range(1, 21))


def test_cameras_that_no_match_ties_make_a_model_without_images(tmp_path: Path, table: PointsOfATable):
    matched = matched_pairs_of(table, table.base_from_gripper)
    apart = {key: one for key, one in matched.geometries.items() if key == (0, 1)}
    database = database_of(tmp_path, table, replace(matched, geometries=apart))
    cameras = {row: pose for row, pose in rough_cameras(table).items() if row in (0, 5, 9)}
    assert map_from_cameras(database, camera_of(INTRINSICS, True), cameras, adjust).num_reg_images() == 0


def test_missing_images_are_added_from_the_map_s_own_x(tmp_path: Path, table: PointsOfATable):
    matched = matched_pairs_of(table, table.base_from_gripper)
    database, camera = database_of(tmp_path, table, matched), camera_of(INTRINSICS, True)
    some = {row: pose for row, pose in rough_cameras(table).items() if row not in (4, 11, 12, 29)}
    model = map_from_cameras(database, camera, some, adjust)
    reported = table.base_from_gripper.copy()
    reported[11] = reported[25]  # a stale pose
    whole = with_missing_images(database, model, reported, matcher_of_points(table), adjust)
    assert sorted(image_id - 1 for image_id in whole.reg_image_ids()) == [k for k in range(IMAGES) if k != 11]
    assert off_mm(table, whole) < 1.0


def test_an_image_of_few_matches_is_completed_by_points_of_the_map(tmp_path: Path, table: PointsOfATable):
    matched = matched_pairs_of(table, table.base_from_gripper)
    few = {}
    for key, geometry in matched.geometries.items():
        if 11 not in key:
            few[key] = geometry
        elif key == (10, 11):
            few[key] = deepcopy(geometry)
            few[key].inlier_matches = geometry.inlier_matches[:40]
    database = database_of(tmp_path, table, replace(matched, geometries=few))
    cameras = {row: pose for row, pose in rough_cameras(table).items() if row != 11}
    model = map_from_cameras(database, camera_of(INTRINSICS, True), cameras, adjust)
    model = with_missing_images(database, model, table.base_from_gripper, matcher_of_points(table), adjust)
    assert model.num_reg_images() == IMAGES
    ids = [
        {
            int(table.ids[one.image_id - 1][one.point2D_idx])
            for one in model.point3D(tracked.point3D_id).track.elements
        }
        for tracked in model.image(12).points2D
        if tracked.has_point3D()
    ]
    assert len(ids) > 200 and all(len(one) == 1 for one in ids)
    assert off_mm(table, model) < 1.0
