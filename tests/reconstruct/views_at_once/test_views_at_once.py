"""Predictions refined by colour, held against the robot, and what flows on; on a printed plane with known cameras."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy import ndarray
from PIL import Image
from scipy.spatial.transform import Rotation

from jcr.camera import project, rays
from jcr.errors import InputError
from jcr.geometry import (
    apply,
    apply_similarity,
    fit_similarity,
    inverse,
    retract,
    rotation_between_deg,
    transform,
)
from jcr.reconstruct.hub import Weights
from jcr.records import Capture, Intrinsics, Reconstruction, Tracks

pytestmark = pytest.mark.slow  # draws, and torch
COUNT, INTRINSICS = 6, Intrinsics(420.0, 420.0, 199.5, 149.5, 400, 300)
X = transform(
    Rotation.from_euler("xyz", [10, -20, 40], degrees=True).as_matrix(), np.array([0.03, -0.05, 0.08])
)


def base_from_camera() -> ndarray:
    """Cameras around a place on the plane z = 0."""
    rng = np.random.default_rng(2)
    azimuth = np.linspace(0, 1.5 * np.pi, COUNT)
    far = np.array([0.4, 0.65, 0.5, 0.7, 0.45, 0.6])
    eyes = far[:, None] * np.stack([0.45 * np.cos(azimuth), 0.45 * np.sin(azimuth), np.full(COUNT, 0.9)], -1)
    target = np.column_stack([rng.uniform(-0.05, 0.05, (COUNT, 2)), np.zeros(COUNT)])
    forward = (target - eyes) / np.linalg.norm(target - eyes, axis=1, keepdims=True)
    right = (
        np.cross(forward, [0.0, 0.0, 1.0])
        / np.linalg.norm(np.cross(forward, [0.0, 0.0, 1.0]), axis=1)[:, None]
    )
    level = np.stack([right, np.cross(forward, right), forward], -1)
    return transform(level @ Rotation.from_euler("z", rng.uniform(-1, 1, (COUNT, 1))).as_matrix(), eyes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of a printed plane."""
    place = tmp_path_factory.mktemp("plane")
    rng = np.random.default_rng(0)
    layers = [
        cv2.resize(rng.uniform(0, 1, (n, n)), (1500, 1500), interpolation=cv2.INTER_CUBIC)
        for n in (40, 100, 250)
    ]
    print_ = np.sum(layers, axis=0)
    print_ = (255 * (print_ - print_.min()) / np.ptp(print_)).astype(np.uint8)
    # Print pixels from metres on the plane: 1500 over 1.5 m, its middle at the origin.
    pixel_from_plane = np.array([[1000.0, 0, 749.5], [0, 1000.0, 749.5], [0, 0, 1]])
    for k, pose in enumerate(base_from_camera()):
        camera_from_plane = inverse(pose)[:3][:, [0, 1, 3]]
        image_from_print = INTRINSICS.matrix @ camera_from_plane @ np.linalg.inv(pixel_from_plane)
        image = cv2.warpPerspective(
            print_, image_from_print, (INTRINSICS.width, INTRINSICS.height), flags=cv2.INTER_AREA
        )
        image = np.clip(image + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)
        Image.fromarray(image).convert("RGB").save(place / f"{k}.png")
    return place


@pytest.fixture(scope="module")
def capture(folder: Path) -> Capture:
    rng = np.random.default_rng(5)
    noise = rng.normal(0, 1, (COUNT, 6)) * ([2e-4] * 3 + [4e-4] * 3)
    gripper = retract(base_from_camera() @ inverse(X), noise)
    return Capture(
        folder=folder,
        images=tuple(f"{k}.png" for k in range(COUNT)),
        base_from_gripper=gripper,
        image_size=(400, 300),
        intrinsics=INTRINSICS,
    )


class Fake:
    """A model that knows the truth, but for errors; of a second pass, the cameras that it is shown."""

    def __init__(self, rotation_deg: float = 0.8, bend: float = 0.02, better_again: bool = True) -> None:
        self.errors, self.better_again, self.shown = (rotation_deg, bend), better_again, []

    def __call__(self, views):
        from jcr.reconstruct.views_at_once.da3 import grid_of
        from jcr.reconstruct.views_at_once.interface import Predicted

        self.shown.append(views.recon_from_camera)
        rotation_deg, bend = self.errors
        if views.recon_from_camera is not None and self.better_again:
            bend = 0.0
        rng = np.random.default_rng(1)
        grid = grid_of(views.size)
        intrinsics = grid.grid_intrinsics(INTRINSICS)
        poses, ray = base_from_camera(), rays(intrinsics)
        y, x = np.mgrid[-1 : 1 : 1j * grid.size[1], -1 : 1 : 1j * grid.size[0]]
        depth = np.stack([-pose[2, 3] / (ray @ pose[2, :3]) for pose in poses])
        depth *= np.stack([1 + bend * (a * x + b * y + c * x * y) for a, b, c in rng.normal(size=(COUNT, 3))])
        step = rng.normal(size=(COUNT, 6)) * ([0.01] * 3 + [np.radians(rotation_deg)] * 3)
        recon = inverse(poses[0]) @ retract(poses, step)
        recon[:, :3, 3] *= 2
        pinholes = np.tile([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy], (COUNT, 1))
        points = (2 * depth[..., None] * ray).astype(np.float32)
        return Predicted(
            grid=grid,
            x_in_camera=points,
            confidence=np.ones(depth.shape, np.float32),
            pinholes=pinholes,
            recon_from_camera=recon,
            is_metric=False,
        )


def options(predict, **changes):
    from jcr.reconstruct.views_at_once.views_at_once import Cost, ViewsOptions

    made = ViewsOptions(
        backend="da3",
        load=lambda weights, device: predict,
        weights=Weights(Path("weights"), "weights", "Apache-2.0"),
        cost=Cost(0.1, 0.1, 1.0, 0.1),
    )
    return replace(made, **changes)


@pytest.fixture(scope="module")
def found(capture: Capture) -> Reconstruction:
    """By one pass of the model."""
    from jcr.reconstruct.views_at_once.views_at_once import reconstruct_views_at_once

    return reconstruct_views_at_once(capture, options(Fake()))


def test_matches_by_colour_put_predicted_cameras_right_and_show_how_surely(
    capture: Capture, found: Reconstruction
) -> None:
    from jcr.calibration.stage import calibrate

    assert found.evidence is not None and "refined" in found.notes[1]
    truth = base_from_camera()
    base, scale = fit_similarity(truth[:, :3, 3], found.recon_from_camera[:, :3, 3])
    assert scale == pytest.approx(0.5, rel=0.02), "the model's own unit stays"
    off = apply_similarity(base, scale, found.recon_from_camera[:, :3, 3]) - truth[:, :3, 3]
    assert np.linalg.norm(off, axis=1).max() < 5e-4, "10 mm as predicted"
    rotated = rotation_between_deg(base[:3, :3] @ found.recon_from_camera[:, :3, :3], truth[:, :3, :3])
    assert np.max(rotated) < 0.05, "0.8° as predicted"
    std = np.sqrt(np.diag(found.evidence.covariance)).reshape(-1, 6)
    assert (std[0] == 0).all()
    # The covariance is that in the frame of the first camera; so are these errors.
    first = found.recon_from_camera[0]
    recon_from_base = first[:3, :3] @ truth[0, :3, :3].T
    off = scale * (found.recon_from_camera[:, :3, 3] - first[:3, 3])
    off -= (truth[:, :3, 3] - truth[0, :3, 3]) @ recon_from_base.T
    assert 0.3 < scale * np.sqrt((std[1:, :3] ** 2).mean()) / np.sqrt((off[1:] ** 2).mean()) < 4

    # The depth is bent back: the plane is one plane.
    in_base = apply_similarity(base, scale, found.dense.points_in_recon.reshape(-1, 3).astype(float))
    assert np.abs(in_base[:, 2]).max() < 4e-3, "20 mm as predicted"

    hand_eye = calibrate(capture, found)
    assert hand_eye.converged
    assert np.linalg.norm(hand_eye.gripper_from_camera[:3, 3] - X[:3, 3]) < 2e-3
    assert rotation_between_deg(hand_eye.gripper_from_camera[:3, :3], X[:3, :3]) < 0.1
    assert len(found.tracks.image) > 1000 and not found.tracks.from_pointmaps


def test_an_unknown_focal_length_is_adjusted(capture: Capture) -> None:
    from jcr.reconstruct.preprocess import ImageGrid, prepare_images
    from jcr.reconstruct.views_at_once.refine import refine

    def whole(size):
        return ImageGrid(size, size, (0, 0), size)

    images = prepare_images(replace(capture, intrinsics=None), whole)
    from jcr.reconstruct.views_at_once.interface import Views

    predicted = Fake(rotation_deg=0.3, bend=0.0)(Views(images.colors, None))
    guess = replace(INTRINSICS, fx=INTRINSICS.fx * 1.03, fy=INTRINSICS.fy * 1.03)
    refined = refine(predicted, images, guess)
    assert refined is not None
    assert refined.pinhole.fx == pytest.approx(INTRINSICS.fx, rel=0.01)


@pytest.mark.parametrize("better", [True, False])
def test_a_second_pass_is_shown_the_robots_cameras_and_stands_where_it_is_better(
    capture: Capture, found: Reconstruction, better: bool
) -> None:
    from jcr.reconstruct.views_at_once.views_at_once import reconstruct_views_at_once

    predict = Fake(better_again=better)
    twice = reconstruct_views_at_once(capture, options(predict, takes_poses=True))
    assert predict.shown[0] is None and len(predict.shown) == 2
    between = inverse(predict.shown[1][0]) @ predict.shown[1]
    true = inverse(base_from_camera()[0]) @ base_from_camera()
    assert np.abs(between - true).max() < 5e-3
    note = next(note for note in twice.notes if note.startswith("second pass"))
    if not better:
        assert note.endswith("not kept")
    assert found.evidence is not None and twice.evidence is not None
    # Its cameras are the robot's: those of the images alone stay.
    np.testing.assert_array_equal(twice.evidence.recon_from_camera, found.evidence.recon_from_camera)


def test_a_view_that_the_robot_contradicts_is_named(capture: Capture) -> None:
    from jcr.reconstruct.views_at_once.views_at_once import reconstruct_views_at_once

    rotated, shifted = capture.base_from_gripper.copy(), capture.base_from_gripper.copy()
    rotated[2] = retract(rotated[2], np.array([0, 0, 0, 0.25, 0.15, 0.25]))
    shifted[3, :3, 3] += [0.0, 0.05, 0.03]  # which no angle shows
    for gripper, said in (
        (rotated, "2.png: its angles to the other views"),
        (shifted, "3.png: its matches lie"),
    ):
        found = reconstruct_views_at_once(replace(capture, base_from_gripper=gripper), options(Fake()))
        named = [text for text in found.warnings if "check its pose" in text]
        assert len(named) == 1 and named[0].startswith(said), named


def test_what_does_not_fit_the_memory_is_refused_before_it_is_begun(capture: Capture) -> None:
    from jcr.reconstruct.views_at_once.views_at_once import reconstruct_views_at_once

    with pytest.raises(InputError, match=r"--backend da3 with 6 images needs .* raise --memory-gb"):
        reconstruct_views_at_once(capture, options(Fake(), memory_gb=0.3))


def test_single_views_take_their_cameras_and_fit_their_depth(capture: Capture) -> None:
    from jcr.reconstruct.views_at_once.single_views import SingleViewsOptions, reconstruct_single_views

    # Cameras and points as structure from motion has them: exact, few, in a unit of its own.
    unit, truth = 3.0, inverse(base_from_camera()[0]) @ base_from_camera()
    rng = np.random.default_rng(0)
    on_plane = np.column_stack([rng.uniform(-0.2, 0.2, (400, 2)), np.zeros(400)])
    in_recon = apply(inverse(base_from_camera()[0]), on_plane)
    seen = [project(INTRINSICS, apply(inverse(pose), in_recon)) for pose in truth]
    inside = np.array(
        [((px > 1) & (px < [INTRINSICS.width - 2, INTRINSICS.height - 2])).all(1) for px in seen]
    )
    image, point = np.nonzero(inside)
    recon_from_camera = truth.copy()
    recon_from_camera[:, :3, 3] *= unit
    sparse = Reconstruction(
        image_index=np.arange(COUNT),
        recon_from_camera=recon_from_camera,
        intrinsics=INTRINSICS,
        tracks=Tracks(
            image=image, x_px=np.array(seen)[image, point], point=point, points_in_recon=unit * in_recon
        ),
        backend="colmap",
    )

    def one_by_one(views):
        found = Fake(bend=0.02)(views)
        # In metres but for a tenth, and without cameras.
        points = found.x_in_camera * np.float32(0.5 * 1.1)
        return replace(found, x_in_camera=points, recon_from_camera=None, is_metric=True)

    made = SingleViewsOptions(
        load=lambda weights, device: one_by_one,
        weights=Weights(Path("w"), "w", "MIT"),
        cameras=lambda capture, progress: sparse,
    )
    found = reconstruct_single_views(capture, made)
    base, scale = fit_similarity(base_from_camera()[:, :3, 3], found.recon_from_camera[:, :3, 3])
    assert found.is_metric and scale == pytest.approx(1 / 1.1, rel=0.02), (
        "its metre is kept, to be held against the robot's"
    )
    in_base = apply_similarity(base, float(scale), found.dense.points_in_recon.reshape(-1, 3).astype(float))
    assert np.median(np.abs(in_base[:, 2])) < 1e-3, "10 mm as predicted"
    assert len(found.tracks.image) == len(image)
