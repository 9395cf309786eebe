"""Test the back ends that take pointmaps from a file or from DUSt3R's network."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy import ndarray
from PIL import Image
from scipy.spatial.transform import Rotation

from jcr.camera import rays
from jcr.geometry import apply, fit_similarity, inverse, rotation_between_deg, transform
from jcr.hub import Weights
from jcr.pointmaps import predictions
from jcr.pointmaps.image_grid import PreparedImages
from jcr.pointmaps.pair_predictions import complete_pairs, pairs_from_arrays
from jcr.pointmaps.predictions import reconstruct_predictions
from jcr.records import Capture, Intrinsics, Reconstruction
from refusal import refused
from scenes import capture_of
from simulation.pairs import synthetic_pairs

COUNT, WIDTH, HEIGHT = 5, 128, 96
PAIR_ARRAYS = ("edges", "pts3d", "conf", "pts3d_in_other_view", "conf2")


@pytest.fixture(scope="module")
def truth() -> dict[str, Any]:
    """Pairwise predictions of a table scene and its geometry; the grid's principal point is (W/2, H/2)."""
    focal = 0.95 * WIDTH
    grid = Intrinsics(focal, focal, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    pairs, made = synthetic_pairs(complete_pairs(COUNT), (WIDTH, HEIGHT), seed=1, intrinsics=grid)
    points = [
        apply(pose, rays(grid) * z[..., None])
        for pose, z in zip(made.base_from_camera, made.depth, strict=True)
    ]
    return {name: getattr(pairs, name) for name in PAIR_ARRAYS} | {
        "gt_focal": focal,
        "gt_poses": made.base_from_camera,
        "gt_depth": made.depth,
        "rays": rays(grid),
        "points": np.array(points),
    }


@pytest.fixture
def capture(tmp_path: Path, truth: dict[str, Any]) -> Capture:
    """Images five times the size of the grid, with a intrinsics, taken by a camera on a gripper."""
    for k in range(COUNT):
        Image.new("RGB", (5 * WIDTH, 5 * HEIGHT), (40 * k, 0, 0)).save(tmp_path / f"{k}.png")
    gripper_from_camera = transform(
        Rotation.from_rotvec([0.2, 0.1, 1.5]).as_matrix(), np.array([0.03, 0.05, 0.1])
    )
    focal = 5 * truth["gt_focal"]
    intrinsics = Intrinsics(focal, focal, 2.5 * WIDTH + 2, 2.5 * HEIGHT + 2, 5 * WIDTH, 5 * HEIGHT)
    base_from_gripper, size = truth["gt_poses"] @ inverse(gripper_from_camera), (5 * WIDTH, 5 * HEIGHT)
    return capture_of(base_from_gripper, folder=tmp_path, image_size=size, intrinsics=intrinsics)


def pair_arrays(truth: dict[str, Any]) -> dict[str, ndarray]:
    return {name: truth[name] for name in PAIR_ARRAYS}


def pointmap_arrays(truth: dict[str, Any]) -> dict[str, ndarray]:
    """In a frame and at a scale of their own."""
    recon_from_base = transform(
        Rotation.from_rotvec([1.0, -0.5, 0.3]).as_matrix(), np.array([3.0, 1.0, -2.0])
    )
    poses = recon_from_base @ truth["gt_poses"]
    poses[:, :3, 3] *= 2.5
    points = 2.5 * apply(recon_from_base, truth["points"])
    return {"recon_from_camera": poses, "points_in_recon": points, "confidence": np.ones(points.shape[:3])}


def reconstructed(capture: Capture, arrays: dict[str, Any]) -> Reconstruction:
    path = capture.folder / "predictions.npz"
    np.savez(path, **arrays)
    return reconstruct_predictions(capture, path)


def assert_poses(result: Reconstruction, truth: ndarray, millimetres: float, degrees: float) -> None:
    centers = truth[:, :3, 3]
    base_from_recon, scale = fit_similarity(centers, result.recon_from_camera[:, :3, 3])
    found = apply(base_from_recon, scale * result.recon_from_camera[:, :3, 3])
    assert 1e3 * np.linalg.norm(found - centers, axis=1).max() < millimetres
    rotation = base_from_recon[:3, :3] @ result.recon_from_camera[:, :3, :3]
    assert rotation_between_deg(rotation, truth[:, :3, :3]).max() < degrees


def assert_pixels(result: Reconstruction, median_px: float) -> None:
    """Assert that the pointmaps project onto their own pixels."""
    dense = result.dense
    x_in_camera = np.stack(
        [
            apply(inverse(pose), points)
            for pose, points in zip(result.recon_from_camera, dense.points_in_recon, strict=True)
        ]
    )
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    projected = x_in_camera @ dense.intrinsics.matrix.T
    off = projected[..., :2] / projected[..., 2:] - np.stack([u, v], -1)
    assert np.median(np.linalg.norm(off, axis=-1)[dense.confidence > 0]) < median_px


def test_images_are_found_by_name_in_any_order(capture: Capture, truth: dict[str, Any]) -> None:
    order = np.array([3, 0, 4, 1])  # the file's images; image 2 of the capture is missing
    new = np.full(COUNT, -1)
    new[order] = np.arange(4)
    kept = (new[truth["edges"]] >= 0).all(1)
    arrays = {name: values[kept] for name, values in pair_arrays(truth).items()}
    arrays |= {"edges": new[arrays["edges"]], "images": np.array([capture.images[k] for k in order])}
    result = reconstructed(capture, arrays)
    assert result.image_index.tolist() == [0, 1, 3, 4]
    assert (result.dense.colors[:, 0, 0, 0] == [0, 40, 120, 160]).all()
    assert_poses(result, truth["gt_poses"][[0, 1, 3, 4]], millimetres=4, degrees=0.4)

    pointmaps = {name: values[order] for name, values in pointmap_arrays(truth).items()}
    result = reconstructed(capture, pointmaps | {"images": arrays["images"]})
    assert result.image_index.tolist() == [0, 1, 3, 4]
    assert_poses(result, truth["gt_poses"][[0, 1, 3, 4]], millimetres=1e-3, degrees=1e-4)


def test_pointmaps_in_one_frame_keep_their_poses(capture: Capture, truth: dict[str, Any]) -> None:
    result = reconstructed(replace(capture, intrinsics=None), pointmap_arrays(truth))
    assert_poses(result, truth["gt_poses"], millimetres=1e-3, degrees=1e-4)
    assert_pixels(result, median_px=1e-3)
    # Unknown, the camera model comes out of the points.
    assert result.intrinsics.fx == pytest.approx(5 * truth["gt_focal"], rel=1e-4)
    assert result.intrinsics.cx == pytest.approx(2.5 * WIDTH + 2, abs=0.05)


def test_faults_in_a_file_are_named(capture: Capture, truth: dict[str, Any]) -> None:
    pointmaps = pointmap_arrays(truth)
    flipped = pointmaps["recon_from_camera"].copy()
    flipped[2, :3, 0] *= -1
    far = pointmaps["points_in_recon"].copy()
    far[1, 4, 4] = np.inf
    for message, arrays in {
        "without 'edges'": {"points": np.zeros(3)},
        "6 names for 5 images": {**pointmaps, "images": np.array(list("abcdef"))},
        "no image 'x.png' in the capture": {**pointmaps, "images": np.array([*capture.images[:4], "x.png"])},
        "2 images, the capture has 5": {name: values[:2] for name, values in pointmaps.items()},
        "camera_from_recon": {**pointmaps, "recon_from_camera": inverse(pointmaps["recon_from_camera"])},
        "poses and points of one frame": {**pointmaps, "points_in_recon": pointmaps["points_in_recon"][::-1]},
        r"recon_from_camera\[2\]: a reflection": {**pointmaps, "recon_from_camera": flipped},
        r"points_in_recon\[1\] is not finite": {**pointmaps, "points_in_recon": far},
        r"confidence\[0\] is negative": {**pointmaps, "confidence": -pointmaps["confidence"]},
        "array 'grid'": {
            name: values[:, :, :60] if values.ndim > 3 else values for name, values in pointmaps.items()
        }
        | {"confidence": pointmaps["confidence"][:, :, :60]},
        "made from images of 320x240": {
            **pointmaps,
            "grid": np.array([[320, 240], [128, 96], [0, 0], [128, 96]]),
        },
    }.items():
        with refused(message):
            reconstructed(capture, {name: values for name, values in arrays.items() if values is not None})
    with refused("no such file"):
        reconstruct_predictions(capture, capture.folder / "absent.npz")


@pytest.mark.slow
def test_a_network_gives_a_record(capture: Capture, truth: dict[str, Any], monkeypatch: pytest.MonkeyPatch):
    """The dust3r back end around synthetic predictions on the grid it prepared."""
    from jcr.pointmaps.dust3r import dust3r

    made = pairs_from_arrays(pair_arrays(truth), "synthetic")
    weights = Weights(Path("X"), "X", "Y")

    def prepare(capture: Capture) -> PreparedImages:
        return predictions._images(capture, np.arange(COUNT), {}, (WIDTH, HEIGHT), "synthetic")

    monkeypatch.setattr(dust3r, "load_weights", lambda weights, device: None)
    monkeypatch.setattr(dust3r, "prepare_images", prepare)
    monkeypatch.setattr(dust3r, "predict_pairs", lambda *arguments: (made, ("a note",)))
    result = dust3r.reconstruct_dust3r(capture, weights, "cpu", "dust3r")
    assert "a note" in result.notes
    assert result.backend == "dust3r" and "weights X: licence Y" in result.notes
    assert_poses(result, truth["gt_poses"], millimetres=3, degrees=0.3)
    unknown = replace(capture, intrinsics=None)
    found = dust3r.reconstruct_dust3r(unknown, weights, "cpu", "dust3r").intrinsics
    # The principal point stays where the network has it; the focal length is aligned.
    assert found.fx == pytest.approx(5 * truth["gt_focal"], rel=0.01)
    assert (found.cx, found.cy) == pytest.approx((2.5 * WIDTH - 0.5, 2.5 * HEIGHT - 0.5))
