"""Given cameras without points: features are triangulated, the same bit for bit each time."""

from pathlib import Path

import numpy as np
import pytest

from capture_writers import write_colmap
from jcr.camera import project
from jcr.capture.read import read_capture
from jcr.geometry import apply, inverse
from jcr.sfm.given import reconstruct_given
from scenes import reference_of

pytestmark = pytest.mark.slow


def test_the_same_cameras_give_the_same_points(tabletop: Path, tmp_path: Path):
    capture = read_capture(tabletop)
    capture = capture.of_rows(range(4))
    x = reference_of(tabletop)
    cameras = capture.base_from_gripper @ x
    model = write_colmap(tmp_path, capture, cameras) / "sparse" / "0"
    first, second = (reconstruct_given(capture, model) for _ in range(2))
    np.testing.assert_allclose(first.recon_from_camera, cameras, atol=1e-9)
    for name in ("image", "x_px", "point", "points_in_recon"):
        np.testing.assert_array_equal(getattr(first.tracks, name), getattr(second.tracks, name))
    tracks = first.tracks
    assert len(tracks.points_in_recon) > 200
    for row, camera in enumerate(cameras):
        own = tracks.image == row
        seen = apply(inverse(camera), tracks.points_in_recon[tracks.point[own]])
        off = np.linalg.norm(project(first.intrinsics, seen) - tracks.x_px[own], axis=1)
        assert np.median(off) < 1.0
