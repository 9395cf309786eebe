"""Registration of a new image from features that are known exactly, some of them wrong by a few pixels."""

import numpy as np
import pytest

from jcr.camera import project, unproject
from jcr.geometry import apply, inverse, rotation_exp, step_between, transform
from jcr.records import Intrinsics
from jcr.sfm import register
from jcr.sfm.register import ImageFeatures, KnownImages, registrations

CAMERA = Intrinsics(500.0, 502.0, 321.0, 238.0, 640, 480, (-0.08, 0.05, 0.001, -0.001, 0.0))


def test_a_feature_that_is_six_pixels_off_is_a_mismatch(monkeypatch: pytest.MonkeyPatch):
    """Six of 80 in the new image are off, and six others in one of the five known images; the 74 points are exact."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.3, -0.2, 0.8], [0.3, 0.2, 1.2], (80, 3))
    centres = np.column_stack([np.linspace(-0.2, 0.2, 6), rng.uniform(-0.1, 0.1, 6), np.zeros(6)])
    cameras = transform(rotation_exp(rng.normal(scale=0.05, size=(6, 3))), centres)
    x_px = np.stack([project(CAMERA, apply(inverse(camera), points)) for camera in cameras])
    x_px[5, :6, 0] += 6
    x_px[2, 6:12, 1] += 6
    descriptors = np.eye(80, 128, dtype=np.float32)
    *known, new = (ImageFeatures(seen, unproject(CAMERA, seen)[:, :2], descriptors) for seen in x_px)
    monkeypatch.setattr(register, "features", lambda image, camera: new)
    image = np.zeros((480, 640, 3), np.uint8)
    ((found, count),) = registrations(KnownImages(CAMERA, cameras[:5], tuple(known)), image, CAMERA)
    assert found is not None and count == 74
    assert np.abs(step_between(cameras[5], found.pose.a_from_camera)).max() < 1e-4
    np.testing.assert_array_equal(found.x_px, x_px[5, 6:])
    np.testing.assert_allclose(found.points_in_recon, points[6:], atol=1e-6)
    wrong = (found.row == 2) & (found.row_point < 6)
    assert len(found.row) == 5 * 74 - 6 and not wrong.any()
