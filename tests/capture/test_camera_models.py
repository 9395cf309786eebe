"""Intrinsics models through every reader and writer that knows them."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from pydantic import TypeAdapter

from jcr.capture.intrinsics import intrinsics_of_file
from jcr.capture.ros_messages import intrinsics_of_ros
from jcr.export import ros
from jcr.records import Intrinsics
from jcr.records.capture_schema import IntrinsicsEntry
from jcr.records.json_file import validated_content
from refusal import refused

SIZE = (640, 480)
RATIONAL = Intrinsics(
    420.0, 421.0, 322.0, 238.0, *SIZE, (0.3, -0.1, 1e-3, -2e-3, 0.01, 0.25, -0.05, 0.02), "rational"
)
FISHEYE = Intrinsics(260.0, 261.0, 318.0, 241.0, *SIZE, (-0.01, 0.02, -0.01, 0.002), "fisheye")
CAMERAS = [RATIONAL, FISHEYE, Intrinsics(500.0, 500.0, 320.0, 240.0, *SIZE, (0.1, -0.2, 1e-3, 2e-3, 0.05))]


@pytest.mark.parametrize("intrinsics", CAMERAS)
def test_intrinsics_survive_capture_json_camera_info_and_calibration(intrinsics: Intrinsics, tmp_path: Path):
    entry = IntrinsicsEntry.of(intrinsics).model_dump_json(exclude_unset=True)
    assert IntrinsicsEntry.model_validate_json(entry).record(SIZE, "here") == intrinsics
    mount = ros.CameraMount(
        parent="tool0", child="optical", parent_from_child=np.eye(4), intrinsics=intrinsics
    )
    (tmp_path / "camera_info.yaml").write_text(ros.camera_info(mount))
    assert intrinsics_of_file(tmp_path / "camera_info.yaml", SIZE) == intrinsics
    printed = yaml.safe_load((tmp_path / "camera_info.yaml").read_text())
    assert printed["distortion_model"] in ("plumb_bob", "rational_polynomial", "equidistant")
    file = TypeAdapter(Intrinsics)
    assert file.validate_json(file.dump_json(intrinsics), strict=True) == intrinsics


MATRIX = "500 0 320\n0 501 240\n0 0 1\n"
FILES = {
    "ost.txt": f"# oST\n\n[image]\n\nwidth\n640\n\nheight\n480\n\n[wrist]\n\ncamera matrix\n{MATRIX}\ndistortion\n"
    "0.1 -0.2 0.001 0.002 0\n\nrectification\n1 0 0\n0 1 0\n0 0 1\n",
    "kalibr.yaml": "cam0:\n  camera_model: pinhole\n  intrinsics: [500.0, 501.0, 320.0, 240.0]\n"
    "  resolution: [640, 480]\n  distortion_model: radtan\n  distortion_coeffs: [0.1, -0.2, 0.001, 0.002]\n",
    "openicc.json": '{"image_width": 640, "image_height": 480, "intrinsics": {"focal_length": 500.0,'
    '"aspect_ratio": 1.002, '
    '"principal_pt_x": 320.0, "principal_pt_y": 240.0, "radial_distortion_1": 0.1, "radial_distortion_2": -0.2, '
    '"tangential_distortion_1": 0.001, "tangential_distortion_2": 0.002}}',
    "realsense.json": '{"width": 640, "height": 480, "fx": 500.0, "fy": 501.0, "ppx": 320.0, "ppy": 240.0, '
    '"model": "brown_conrady", "coeffs": [0.1, -0.2, 0.001, 0.002, 0]}',
    "cameras.txt": "# Camera list\n1 OPENCV 640 480 500 501 320.5 240.5 0.1 -0.2 0.001 0.002\n",
    "opencv.yml": "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: "
    "[500., 0., 320., 0., 501., 240., 0., 0., 1.]\ndistortion_coefficients: !!opencv-matrix\n  rows: 1\n  cols: 5\n"
    "  dt: d\n  data: [0.1, -0.2, 0.001, 0.002, 0.]\nimage_width: 640\nimage_height: 480\n",
    # As Open3D writes it: by columns.
    "open3d.json": '{"width": 640, "height": 480, "intrinsic_matrix": [500, 0, 0, 0, 501, 0, 320, 240, 1], '
    '"dist_coeffs": [0.1, -0.2, 0.001, 0.002, 0]}',
    "matrix.txt": MATRIX,
}


@pytest.mark.parametrize("name", FILES)
def test_intrinsics_of_other_tools_are_read(name: str, tmp_path: Path):
    (tmp_path / name).write_text(FILES[name])
    found = intrinsics_of_file(tmp_path / name, SIZE)
    assert found is not None and (found.fx, found.fy, found.cx, found.cy) == (500, 501, 320, 240)
    stated = (0.1, -0.2, 0.001, 0.002, 0.0) if name != "matrix.txt" else (0.0,) * 5
    assert found.model == "pinhole" and found.distortion == stated


@pytest.mark.parametrize("intrinsics", CAMERAS)
def test_intrinsics_survive_colmap(intrinsics: Intrinsics, tmp_path: Path):
    import pycolmap

    from jcr.sfm.given import read_model, shared_intrinsics
    from jcr.sfm.model import colmap_camera

    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(colmap_camera(intrinsics, known=True))
    image = pycolmap.Image(name="0.png", camera_id=1, image_id=1)
    image.frame_id = 1
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    model.write_text(str(tmp_path))
    found = shared_intrinsics(read_model(tmp_path), [1], SIZE, "model")
    assert found.model == intrinsics.model and np.allclose(found.distortion, intrinsics.distortion)
    assert np.allclose(
        [found.fx, found.fy, found.cx, found.cy], [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]
    )


@pytest.mark.parametrize(("model", "count", "words"), [
    ("division", 1, "'division' with 1 coefficients; jcr knows plumb_bob"),
    ("rational_polynomial", 14, "with 14 coefficients"),
    ("plumb_bob", 8, "'plumb_bob' with 8"),
])  # fmt: skip
def test_other_camera_models_are_refused_by_name(model: str, count: int, words: str):
    k = [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]
    info = {"width": SIZE[0], "height": SIZE[1], "k": k, "distortion_model": model, "d": [0.1] * count}
    with refused(words):
        intrinsics_of_ros(info, SIZE, "camera_info")


def test_a_capture_names_the_models_that_there_are():
    intrinsics = {"fx": 500, "fy": 500, "cx": 320, "cy": 240}
    entry = IntrinsicsEntry
    with refused("model: 'omni': Input should be 'pinhole', 'rational', 'thin_prism' or 'fisheye'"):
        validated_content(entry, intrinsics | {"model": "omni"}, "capture.json")
    fisheye = validated_content(
        entry, intrinsics | {"model": "fisheye", "distortion": [0.0] * 5}, "capture.json"
    )
    with refused("5 numbers, not the 4 of a fisheye model, k1,k2,k3,k4"):
        fisheye.record(SIZE, "capture.json")
