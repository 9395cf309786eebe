"""Images that the mapper left out: added where points confirm the cameras that the map's own X predicts."""

from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from jcr.features.stage import Matched
from jcr.geometry import nearest_rotation, rotation_between_deg
from jcr.sfm.missing_images import with_missing_images
from jcr.sfm.model import (
    adjust_robustly,
    colmap_camera,
    poses_of,
    quiet_colmap,
    triangulated_model,
    write_database,
)
from points_of_a_table import IMAGES, INTRINSICS, PointsOfATable, matched_pairs_of, matcher_of_points

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def quiet():
    with quiet_colmap():
        yield


@pytest.fixture(scope="module")
def table() -> PointsOfATable:
    return PointsOfATable(minds_roll=False)


@pytest.fixture(scope="module")
def matched(table: PointsOfATable) -> Matched:
    return matched_pairs_of(table, table.base_from_gripper)


def begun(
    folder: Path, table: PointsOfATable, matched: Matched, missing: tuple[int, ...]
) -> tuple[Path, pycolmap.Reconstruction]:
    """Return a database of the matches and a map without some images."""
    camera = colmap_camera(INTRINSICS, True)
    database = write_database(folder, camera, table.x_px, matched.geometries)
    cameras = {row: pose for row, pose in enumerate(table.base_from_camera) if row not in missing}
    return database, triangulated_model(database, camera, cameras)


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


def test_missing_images_are_added_from_the_map_s_own_x(
    tmp_path: Path, table: PointsOfATable, matched: Matched
):
    database, model = begun(tmp_path, table, matched, (4, 11, 12, 29))
    reported = table.base_from_gripper.copy()
    reported[11] = reported[25]  # a stale pose
    whole = with_missing_images(database, model, reported, matcher_of_points(table))
    assert sorted(image_id - 1 for image_id in whole.reg_image_ids()) == [k for k in range(IMAGES) if k != 11]
    assert off_mm(table, whole) < 1.0


def test_images_that_nothing_ties_to_the_map_stay_out(
    tmp_path: Path, table: PointsOfATable, matched: Matched
):
    """Twenty images and ten others, without a common match: gripper poses alone would hold them together."""
    apart = {key: one for key, one in matched.geometries.items() if (key[0] < 20) == (key[1] < 20)}
    database, model = begun(tmp_path, table, replace(matched, geometries=apart), tuple(range(20, 30)))
    reported = table.base_from_gripper
    assert with_missing_images(database, model, reported, matcher_of_points(table)) is model


def test_an_image_of_few_matches_is_completed_by_points_of_the_map(
    tmp_path: Path, table: PointsOfATable, matched: Matched
):
    few = {}
    for key, geometry in matched.geometries.items():
        if 11 not in key:
            few[key] = geometry
        elif key == (10, 11):
            few[key] = deepcopy(geometry)
            few[key].inlier_matches = geometry.inlier_matches[:40]
    database, model = begun(tmp_path, table, replace(matched, geometries=few), (11,))
    model = with_missing_images(database, model, table.base_from_gripper, matcher_of_points(table))
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
