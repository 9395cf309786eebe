"""Models of points along a table, from cameras near the true ones."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from jcr.features.stage import Matched
from jcr.geometry import nearest_rotation, retract, rotation_between_deg
from jcr.sfm.model import (
    adjust_robustly,
    colmap_camera,
    model_near_cameras,
    poses_of,
    quiet_colmap,
    write_database,
)
from points_of_a_table import IMAGES, INTRINSICS, PointsOfATable, matched_pairs_of

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


def test_predicted_cameras_are_adjusted_to_the_matches(
    tmp_path: Path, table: PointsOfATable, matched: Matched
):
    """The last image matches nothing."""
    rng, camera = np.random.default_rng(0), colmap_camera(INTRINSICS, True)
    matches = {key: one for key, one in matched.geometries.items() if IMAGES - 1 not in key}
    database = write_database(tmp_path, camera, table.x_px, matches)
    noise = rng.normal(size=(IMAGES, 6)) * ([0.01] * 3 + [0.01] * 3)
    model = model_near_cameras(
        database, camera, dict(enumerate(retract(table.base_from_camera, noise))), True
    )
    assert model.num_reg_images() == IMAGES - 1
    assert off_mm(table, model) < 1.0
