"""Images that the mapper left out, and least-squares matching of tracks, on scenes that are known exactly."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import project, unproject
from jcr.features.matchers import Matcher
from jcr.features.pair_search import MatchedPairs, match_with_robot
from jcr.features.pair_verification import Key
from jcr.geometry import (
    Transforms,
    apply,
    inverse,
    nearest_rotation,
    rotation_between_deg,
    rotation_exp,
    transform,
)
from jcr.records import Intrinsics, Tracks
from jcr.sfm.missing_images import nearer_to_robot, with_missing_images
from jcr.sfm.model import (
    adjust_robustly,
    colmap_camera,
    poses_of,
    quiet_colmap,
    triangulated_model,
    write_database,
)
from jcr.sfm.track_refinement import align_tracks

pytestmark = pytest.mark.slow


INTRINSICS = Intrinsics(500.0, 500.0, 319.5, 239.5, 640, 480)
IMAGES, STEP_M, HEIGHT_M = 30, 0.1, 0.5
GRIPPER_FROM_CAMERA = transform(rotation_exp(np.array([0.1, -0.2, 0.4])), np.array([0.03, -0.05, 0.04]))


class PointsOfATable:
    """Features that match without error, of points along a table; a camera sees a fifth of its length."""

    every_pair, farthest = 12, 0.7

    def __init__(self, needs_upright: bool) -> None:
        rng = np.random.default_rng(0)
        self.needs_upright = needs_upright
        points = rng.uniform([-0.3, -0.3, -0.06], [3.2, 0.3, 0.06], (3600, 3))
        down = transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
        self.base_from_camera = np.stack(
            [
                transform(np.eye(3), np.array([STEP_M * k, 0.0, HEIGHT_M]))
                @ down
                @ transform(rotation_exp(rng.normal(scale=0.15, size=3)), np.zeros(3))
                for k in range(IMAGES)
            ]
        )
        self.ids: list[ndarray] = []
        self.x_px: list[Float[ndarray, "_ 2"]] = []
        for pose in self.base_from_camera:
            x_px = project(INTRINSICS, apply(inverse(pose), points))
            seen = np.flatnonzero(((x_px > 0) & (x_px < [639, 479])).all(1))
            self.ids.append(seen)
            self.x_px.append(x_px[seen] + rng.normal(scale=0.3, size=(len(seen), 2)))
        of_point = rng.normal(size=(len(points), 32)).astype(np.float32)
        of_point /= np.linalg.norm(of_point, axis=1, keepdims=True)
        self.descriptors = [of_point[seen] for seen in self.ids]
        self.asked: dict[bool, list[Key]] = {True: [], False: []}

        self.base_from_gripper: Transforms = self.base_from_camera @ inverse(GRIPPER_FROM_CAMERA)

    def common(self, key: Key) -> Int[ndarray, "m 2"]:
        """Return rows of the points that two images see."""
        first, second = (self.ids[k] for k in key)
        return np.stack(np.intersect1d(first, second, return_indices=True)[1:], 1)

    def matches(self, pairs: Sequence[Key], rolls: ndarray) -> list[ndarray]:
        return [self.common(key) for key in pairs]


def matcher_of_points(features: PointsOfATable) -> Matcher:
    """Return the matcher of these features."""
    return Matcher(features, colmap_camera(INTRINSICS, True), True, 0)


def matched_pairs_of(features: PointsOfATable, base_from_gripper: Transforms) -> MatchedPairs:
    """Return the pairs of all images, by these gripper poses."""
    matcher = matcher_of_points(features)
    names = [f"{k}.png" for k in range(IMAGES)]
    return match_with_robot(matcher, base_from_gripper, INTRINSICS, names)


@pytest.fixture(autouse=True)
def quiet():
    with quiet_colmap():
        yield


@pytest.fixture(scope="module")
def table() -> PointsOfATable:
    return PointsOfATable(needs_upright=False)


@pytest.fixture(scope="module")
def matched(table: PointsOfATable) -> MatchedPairs:
    return matched_pairs_of(table, table.base_from_gripper)


def begun(
    folder: Path, table: PointsOfATable, matched: MatchedPairs, missing: tuple[int, ...]
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


def test_missing_images_are_added_by_the_map_x(tmp_path: Path, table: PointsOfATable, matched: MatchedPairs):
    database, model = begun(tmp_path, table, matched, (4, 11, 12, 29))
    reported = table.base_from_gripper.copy()
    reported[11] = reported[25]  # a stale pose
    whole = with_missing_images(database, model, reported, matcher_of_points(table))
    assert sorted(image_id - 1 for image_id in whole.reg_image_ids()) == [k for k in range(IMAGES) if k != 11]
    assert off_mm(table, whole) < 1.0


def test_images_not_tied_to_the_map_stay_out(tmp_path: Path, table: PointsOfATable, matched: MatchedPairs):
    """Twenty images and ten others, without a common match: gripper poses alone would hold them together."""
    apart = {key: one for key, one in matched.geometries.items() if (key[0] < 20) == (key[1] < 20)}
    database, model = begun(tmp_path, table, replace(matched, geometries=apart), tuple(range(20, 30)))
    reported = table.base_from_gripper
    assert with_missing_images(database, model, reported, matcher_of_points(table)) is model


CAMERA = Intrinsics(300.0, 302.0, 158.0, 121.0, 320, 240, (-0.08, 0.05, 0.001, -0.001, 0.0))
DISTANCE = (0.85, 1.0, 1.2)
"""The second is the median: the reference of every track."""
ROTATION = rotation_exp(np.array([[0.25, 0.1, 0.3], [0.0, 0.0, 0.0], [-0.1, 0.3, -1.2]]))
RECON_FROM_CAMERA = transform(ROTATION, -np.array(DISTANCE)[:, None] * ROTATION[:, :, 2])
"""They look at the origin, and stand above the plane z = 0."""
GAIN, OFFSET, NOISE = (0.8, 1.0, 1.1), (20.0, 0.0, -15.0), 1.0


def texture(x: Float[ndarray, "*n 2"], seed: int) -> Float[ndarray, "*n"]:
    """Greys of the plane: waves of 5 to 40 pixels' length in the reference."""
    random = np.random.default_rng(seed)
    angle, length = random.uniform(0, np.pi, 60), random.uniform(5, 40, 60) / 300
    wave = 2 * np.pi / length * np.stack([np.cos(angle), np.sin(angle)])
    return 120 + 9 * np.sin(x @ wave + random.uniform(0, 2 * np.pi, 60)).sum(-1)


def image(camera: int, seed: int = 0) -> UInt8[ndarray, "h w"]:
    """What a camera sees of the plane, with its gain, offset and noise."""
    pose = RECON_FROM_CAMERA[camera]
    pixels = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1)
    ray = unproject(CAMERA, pixels) @ pose[:3, :3].T
    on_plane = pose[:3, 3] - (pose[2, 3] / ray[..., 2:]) * ray
    grey = GAIN[camera] * texture(on_plane[..., :2], seed) + OFFSET[camera]
    grey += NOISE * np.random.default_rng(camera).standard_normal(grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def greys() -> UInt8[ndarray, "m h w"]:
    return np.stack([image(camera) for camera in range(3)])


@pytest.fixture(scope="module")
def exact() -> Tracks:
    """Points of the plane that all three cameras see, and where they see them."""
    points = np.random.default_rng(1).uniform(-0.35, 0.35, (300, 3)) * [1, 0.7, 0]
    seen = np.stack([project(CAMERA, apply(inverse(pose), points)) for pose in RECON_FROM_CAMERA])
    whole = ((seen > 14) & (seen < [305, 225])).all((0, 2))
    n = int(whole.sum())
    assert n > 100
    return Tracks(
        image=np.repeat(np.arange(3), n), x_px=seen[:, whole].reshape(-1, 2), point=np.tile(np.arange(n), 3),
        points_in_recon=points[whole],
    )  # fmt: skip


def disturbed(tracks: Tracks, px: float) -> Tracks:
    """Keypoints as features are found, those of the reference exact; and points as keypoints give them."""
    random = np.random.default_rng(2)
    error = px * random.standard_normal(tracks.x_px.shape) * (tracks.image != 1)[:, None]
    x = tracks.points_in_recon
    return replace(
        tracks, x_px=tracks.x_px + error, points_in_recon=x + 0.002 * random.standard_normal(x.shape)
    )


def test_observations_are_where_the_reference_is_seen(greys: UInt8[ndarray, "m h w"], exact: Tracks):
    start = disturbed(exact, 0.5)
    found = align_tracks(greys, start, RECON_FROM_CAMERA, CAMERA)
    other, error = exact.image != 1, found.x_px - exact.x_px
    moved = (found.x_px != start.x_px).any(1)
    assert not moved[~other].any()
    assert moved[other].mean() > 0.95
    assert np.sqrt(np.mean(error[moved] ** 2)) < 0.035
    for camera in (0, 2):  # half a pixel of a resized image, or a bend that is left out, would move all alike
        assert np.abs(error[moved & (exact.image == camera)].mean(0)).max() < 0.005


def test_what_shows_something_else_keeps_its_keypoint(greys: UInt8[ndarray, "m h w"], exact: Tracks):
    start = disturbed(exact, 0.5)
    occluded = np.stack([image(0, seed=5), greys[1], np.full_like(greys[2], 90)])
    found = align_tracks(occluded, start, RECON_FROM_CAMERA, CAMERA)
    kept = (found.x_px == start.x_px).all(1)
    assert kept[start.image == 0].mean() > 0.95
    assert kept[start.image == 2].all()


def test_a_map_of_few_images_is_kept_since_no_transform_follows_from_them():
    model, none = pycolmap.Reconstruction(), Matcher.__new__(Matcher)
    poses = np.broadcast_to(np.eye(4), (3, 4, 4))
    assert nearer_to_robot(Path("never-read"), model, poses, np.eye(4), none) is model
