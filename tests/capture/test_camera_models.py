"""Intrinsics models through every reader and writer that knows them."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

import jcr
from jcr.capture import camera_info
from jcr.capture.formats import capture_json, colmap
from jcr.capture.plain_files import validated
from jcr.export import ros
from jcr.intrinsics_json import IntrinsicsAndStd
from jcr.records import Intrinsics

SIZE = (640, 480)
RATIONAL = Intrinsics(
    420.0, 421.0, 322.0, 238.0, *SIZE, (0.3, -0.1, 1e-3, -2e-3, 0.01, 0.25, -0.05, 0.02), "rational"
)
FISHEYE = Intrinsics(260.0, 261.0, 318.0, 241.0, *SIZE, (-0.01, 0.02, -0.01, 0.002), "fisheye")
CAMERAS = [RATIONAL, FISHEYE, Intrinsics(500.0, 500.0, 320.0, 240.0, *SIZE, (0.1, -0.2, 1e-3, 2e-3, 0.05))]


@pytest.mark.parametrize("intrinsics", CAMERAS)
def test_intrinsics_survive_capture_json_camera_info_and_calibration_json(
    intrinsics: Intrinsics, tmp_path: Path
):
    entry = camera_info.IntrinsicsEntry.of(intrinsics).model_dump_json(exclude_unset=True)
    assert camera_info.IntrinsicsEntry.model_validate_json(entry).record(SIZE, "here") == intrinsics
    mount = ros.CameraMount(
        parent="tool0", child="optical", parent_from_child=np.eye(4), intrinsics=intrinsics
    )
    (tmp_path / "camera_info.yaml").write_text(ros.camera_info(mount))
    assert camera_info.read_camera_info(tmp_path / "camera_info.yaml", SIZE) == intrinsics
    printed = yaml.safe_load((tmp_path / "camera_info.yaml").read_text())
    assert printed["distortion_model"] in ("plumb_bob", "rational_polynomial", "equidistant")
    file = IntrinsicsAndStd.model_validate(vars(intrinsics) | {"distortion": list(intrinsics.distortion)})
    assert IntrinsicsAndStd.model_validate_json(file.model_dump_json()).record() == intrinsics


@pytest.mark.parametrize("intrinsics", CAMERAS)
def test_intrinsics_survive_colmap(intrinsics: Intrinsics, tmp_path: Path):
    import pycolmap

    from jcr.sfm.mapping import camera_of

    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera_of(intrinsics, known=True))
    image = pycolmap.Image(name="0.png", camera_id=1, image_id=1)
    image.frame_id = 1
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    model.write_text(str(tmp_path))
    found = colmap.read_intrinsics(tmp_path, SIZE)
    assert found.model == intrinsics.model and np.allclose(found.distortion, intrinsics.distortion)
    assert np.allclose(
        [found.fx, found.fy, found.cx, found.cy], [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]
    )


@pytest.mark.parametrize(
    ("model", "count", "words"),
    [
        ("thin_prism", 12, "'thin_prism' with 12 coefficients; jcr knows plumb_bob"),
        ("rational_polynomial", 14, "with 14 coefficients"),
        ("plumb_bob", 8, "'plumb_bob' with 8"),
    ],
)
def test_other_camera_models_are_refused_by_name(model: str, count: int, words: str):
    k = [500.0, 0, 320, 0, 500, 240, 0, 0, 1]
    with pytest.raises(jcr.InputError, match=words):
        camera_info.intrinsics_of_ros(k, model, [0.1] * count, SIZE, SIZE, "camera_info")


def test_a_capture_names_the_models_that_there_are():
    intrinsics = {"fx": 500, "fy": 500, "cx": 320, "cy": 240}
    entry = camera_info.IntrinsicsEntry
    with pytest.raises(
        jcr.InputError, match="model: Input should be 'pinhole', 'rational', 'thin_prism' or 'fisheye'"
    ):
        validated(entry, intrinsics | {"model": "omni"}, "capture.json")
    fisheye = validated(entry, intrinsics | {"model": "fisheye", "distortion": [0.0] * 5}, "capture.json")
    with pytest.raises(jcr.InputError, match="5 numbers, not the 4 of a fisheye model, k1,k2,k3,k4"):
        fisheye.record(SIZE, "capture.json")


def through(intrinsics: Intrinsics, image: np.ndarray, original: Intrinsics) -> np.ndarray:
    """The image that a camera with another intrinsics takes from the same place."""
    from jcr.camera import project, unproject

    u, v = np.meshgrid(np.arange(intrinsics.width), np.arange(intrinsics.height))
    x_px = project(original, unproject(intrinsics, np.stack([u, v], -1).astype(float))).astype(np.float32)
    return cv2.remap(image, x_px[..., 0], x_px[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["rational", "fisheye"])
def test_a_capture_through_another_intrinsics_gives_the_same_calibration(
    model: str, tabletop: Path, tmp_path: Path
):
    whole = jcr.read_capture(tabletop)
    capture = replace(whole, images=whole.images[:8], base_from_gripper=whole.base_from_gripper[:8])
    original = capture.intrinsics
    assert original is not None
    distortion = {"rational": RATIONAL.distortion, "fisheye": FISHEYE.distortion}[model]
    intrinsics = Intrinsics(520.0, 520.0, 322.0, 239.0, *SIZE, distortion, model)
    for name in capture.images:
        image = through(intrinsics, cv2.imread(str(tabletop / name)), original)
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / name), image)
    capture_json.write(tmp_path, replace(capture, intrinsics=intrinsics))
    result = jcr.calibrate(jcr.read_capture(tmp_path), tmp_path / "out", backend="colmap")
    truth = np.array(json.loads((tabletop / "reference.json").read_text())["gripper_from_camera"])
    off = np.linalg.inv(truth) @ result.hand_eye.gripper_from_camera
    assert result.converged and result.hand_eye.intrinsics is not None
    assert result.hand_eye.intrinsics.model == model
    assert np.linalg.norm(off[:3, 3]) < 1e-3
    assert np.degrees(np.arccos((np.trace(off[:3, :3]) - 1) / 2)) < 0.1
