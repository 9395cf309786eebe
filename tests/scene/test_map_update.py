"""Images added to a calibrated run, of scenes in which a thing was taken away or put down."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from jcr.calibration.record import Calibration
from jcr.camera import rays, resized, undistortion
from jcr.capture.added_capture import read_added, with_added_images, write_added
from jcr.capture.formats import capture_json
from jcr.capture.images import encode_png, read_image
from jcr.capture.read import read_capture
from jcr.depth.added_images import extend
from jcr.files import write_bytes
from jcr.geometry import apply, inverse, scale_translation, transform
from jcr.records import Capture, Reconstruction, Tracks, Uncertainty
from jcr.scene.cloud import point_cloud
from jcr.scene.options import CloudOptions, MapOptions
from refusal import refused
from scenes import hand_eye_of, maps_of, reconstruction_of
from simulation.capture import SimulateOptions, simulate
from simulation.problems import shown_points
from simulation.render import View, render
from simulation.scenes import Scene, make_scene
from simulation.truth import Truth, read_truth, true_depth

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap

pytestmark = pytest.mark.gl

SCALE = 0.37
"""Metres per unit of the reconstruction."""
SIZE = 240, 180
VIEWS = 10


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("capture") / "sim"
    return read_capture(simulate(folder, SimulateOptions(scene="measuring", images=VIEWS, seed=3)))


@pytest.fixture(scope="module")
def truth(capture: Capture) -> Truth:
    return read_truth(capture.folder)


def scene_of(truth: Truth, without: str = "") -> Scene:
    """The true scene, with one thing taken away."""
    scene = make_scene("measuring", truth.seed)
    return replace(scene, objects=tuple(thing for thing in scene.objects if thing.name != without))


@pytest.fixture(scope="module")
def whole(truth: Truth, capture: Capture) -> list[View]:
    """Views of the whole scene from the first eight places: images and true depth of the capture."""
    images = [read_image(capture.folder / name) for name in capture.images[:8]]
    return [View(image, true_depth(truth, k), None) for k, image in enumerate(images)]


def known_reconstruction(truth: Truth, rendered: list[View]) -> tuple[Reconstruction, Calibration]:
    """What a back end would find of the first views of a scene, in a frame and unit of its own."""
    views = len(rendered)
    pinhole = resized(truth.intrinsics, *SIZE)
    base_from_camera = truth.base_from_camera[:views]
    base_from_recon = transform(
        cv2.Rodrigues(np.array([0.3, -0.5, 0.2]))[0].astype(float), np.array([0.2, 0.1, 0.3])
    )
    recon_from_camera = scale_translation(inverse(base_from_recon) @ base_from_camera, 1 / SCALE)
    points, confidence, colors = [], [], []
    for view, recon_from in zip(rendered, recon_from_camera, strict=True):
        assert view.depth is not None
        depth = cv2.resize(view.depth, SIZE, interpolation=cv2.INTER_NEAREST) / SCALE
        points.append(apply(recon_from, depth[..., None] * rays(pinhole)))
        confidence.append((depth > 0).astype(float))
        colors.append(undistortion(truth.intrinsics, pinhole)(view.image))
    points_in_recon = np.stack(points)
    some = np.random.default_rng(0).choice(np.flatnonzero(np.ravel(confidence)), 2000, replace=False)
    x = points_in_recon.reshape(-1, 3)[some]
    image, point, x_px = shown_points(x, recon_from_camera, [pinhole] * views, 0.0, np.random.default_rng(0))
    tracks = Tracks(image=image, x_px=x_px, point=point, points_in_recon=x)
    maps = maps_of(points_in_recon, pinhole, confidence=np.stack(confidence), colors=np.stack(colors))
    facts = {"intrinsics": truth.intrinsics, "tracks": tracks, "backend": "truth", "pointmaps": maps}
    known = {
        "scale": SCALE, "resting": base_from_recon, "uncertainty": Uncertainty(covariance=1e-10 * np.eye(7)),
    }  # fmt: skip
    return reconstruction_of(recon_from_camera, **facts), hand_eye_of(truth.gripper_from_camera, **known)


def beside(truth: Truth, row: int, count: int) -> np.ndarray:
    """Camera places 7 cm apart, the first that of an image: near enough for their images to be compared."""
    aside = transform(np.eye(3), np.array([[0.07, 0, 0]]) * np.arange(count)[:, None])
    return truth.base_from_camera[row] @ aside


def added_views(
    folder: Path, truth: Truth, capture: Capture, scene: Scene, base_from_camera: np.ndarray
) -> Capture:
    """Images of a scene from new places, added to a run in `folder`."""
    new = folder / f"new{len(list(folder.glob('new*')))}"
    names = tuple(f"{k}.png" for k in range(len(base_from_camera)))
    for name, view in zip(
        names, render(scene, truth.intrinsics, base_from_camera, with_truth=False), strict=True
    ):
        write_bytes(new / name, encode_png(view.image))
    poses = base_from_camera @ inverse(truth.gripper_from_camera)
    capture_json.write(new, replace(capture, images=names, base_from_gripper=poses, joints=None, depths=None))
    return with_added_images(read_added(folder, capture), new)


def extended(before: Reconstruction, hand_eye: Calibration, capture: Capture, new: Capture) -> Reconstruction:
    x, base_from_recon = hand_eye.gripper_from_camera, hand_eye.base_from_recon
    return extend(before, x, base_from_recon, len(capture), new, lambda stage, fraction: None)


def mapped(
    truth: Truth, capture: Capture, reconstruction: Reconstruction, hand_eye: Calibration
) -> "SceneMap":
    from jcr.scene.build import build_scene

    box = tuple(truth.workspace_in_base.ravel().tolist())
    cloud = point_cloud(capture, reconstruction, hand_eye, options=CloudOptions(confidence_percentile=0.0))
    return build_scene(cloud, MapOptions(workspace=box, cell=0.015))


def within(truth: Truth, name: str, count: int = 4000) -> np.ndarray:
    """Points in the inner half of a thing's box, well above the table."""
    thing = next(thing for thing in truth.objects if thing.name == name)
    low, high = np.array([-0.25, -0.25, -0.1]), np.array([0.25, 0.25, 0.4])
    x = np.random.default_rng(0).uniform(low, high, (count, 3)) * thing.box_size
    return x @ thing.base_from_box[:3, :3].T + thing.base_from_box[:3, 3]


def test_a_thing_taken_away_leaves_the_map(truth: Truth, capture: Capture, whole: list[View], tmp_path: Path):
    before, hand_eye = known_reconstruction(truth, whole[:6])
    places = np.concatenate([beside(truth, 0, 2), beside(truth, 4, 2)])
    new = added_views(tmp_path, truth, capture, scene_of(truth, without="toolbox"), places)
    after = extended(before, hand_eye, capture, new)
    assert len(after.recon_from_camera) == 10
    # The last images of the capture found no place; the new ones are no such image.
    assert after.image_index.tolist() == [0, 1, 2, 3, 4, 5, 10, 11, 12, 13]
    x = within(truth, "toolbox")
    old, fresh = mapped(truth, capture, before, hand_eye), mapped(truth, capture, after, hand_eye)
    assert (old.query(x, unknown="occupied").occupancy > 0.5).mean() > 0.85  # there is air under the handle
    assert (fresh.query(x, unknown="occupied").occupancy < 0.5).mean() > 0.8
    stayed = within(truth, "box")
    assert (fresh.query(stayed, unknown="occupied").occupancy > 0.5).mean() > 0.98


def test_an_unchanged_scene_loses_nothing_and_the_new_depth_is_right(truth, capture, whole, tmp_path):
    before, hand_eye = known_reconstruction(truth, whole)
    new = added_views(tmp_path, truth, capture, scene_of(truth), truth.base_from_camera[8:9])
    after = extended(before, hand_eye, capture, new)
    known = before.dense.confidence > 0
    assert (after.dense.confidence[:8][known] > 0).mean() > 0.98
    depth = SCALE * apply(inverse(after.recon_from_camera[8]), after.dense.points_in_recon[8])[..., 2]
    true = cv2.resize(true_depth(truth, 8), SIZE, interpolation=cv2.INTER_NEAREST)
    found = (after.dense.confidence[8] > 0) & (true > 0)
    assert found.mean() > 0.3
    assert np.median(np.abs(depth / true - 1)[found]) < 0.005


def test_added_images_are_kept_and_wrong_ones_refused(truth: Truth, capture: Capture, tmp_path: Path):
    assert len(read_added(tmp_path, capture)) == 0
    added = added_views(tmp_path, truth, capture, scene_of(truth), truth.base_from_camera[:1])
    assert len(read_added(tmp_path, capture)) == 0  # not yet part of the run
    write_added(added, capture)
    again = read_added(tmp_path, capture)
    assert again.images == added.images
    assert np.allclose(again.base_from_gripper, truth.base_from_gripper[:1])
    with refused("added before"):
        with_added_images(again, tmp_path / "new0")
    small = tmp_path / "small"
    write_bytes(small / "0.png", encode_png(np.zeros((30, 40, 3), np.uint8)))
    one = Capture(folder=small, images=("0.png",), base_from_gripper=np.eye(4)[None], image_size=(40, 30))
    capture_json.write(small, one)
    with refused("40x30"):
        with_added_images(again, small)
    with refused("another folder"):
        read_added(tmp_path, replace(capture, folder=tmp_path))
    (tmp_path / "added" / again.images[0]).unlink()
    with refused("no such image"):
        read_added(tmp_path, capture)
