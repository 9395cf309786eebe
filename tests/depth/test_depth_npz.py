"""depth.npz gives back the pointmaps bit for bit, in at most 30 MB for 30 images."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from jcr.camera import pinhole_inside
from jcr.capture.read import read_capture
from jcr.depth.densify import pointmaps_of, undistorted
from jcr.depth.depth_npz import is_made_from, read_depth, write_depth
from jcr.geometry import rotation_exp, transform
from jcr.records import Reconstruction
from scenes import reconstruction_of


def made(tabletop: Path, rows: int) -> Reconstruction:
    """Return a reconstruction of images of the bundled capture with drawn depth and cameras."""
    capture = read_capture(tabletop)
    assert capture.intrinsics is not None
    rng, index = np.random.default_rng(0), np.arange(rows)
    pinhole = pinhole_inside(capture.intrinsics, 400)
    colors = undistorted(capture.folder, [capture.images[k] for k in index], capture.intrinsics, pinhole)
    shape = colors.shape[:3]
    cameras = transform(rotation_exp(rng.normal(size=(rows, 3))), rng.normal(size=(rows, 3)))
    reason = rng.integers(0, 4, shape).astype(np.uint8)
    dense = pointmaps_of(
        rng.uniform(0.1, 50, shape).astype(np.float32),
        rng.uniform(1e-4, 1e-2, shape).astype(np.float16),
        np.where(reason > 0, rng.uniform(0, 9, shape), 0).astype(np.float16),
        reason,
        colors,
        cameras,
        pinhole,
    )
    return reconstruction_of(cameras, image_index=index, intrinsics=capture.intrinsics, pointmaps=dense)


def test_what_is_read_is_what_was_written(tabletop: Path, tmp_path: Path):
    reconstruction, file = made(tabletop, 3), tmp_path / "depth.npz"
    assert not is_made_from(file, "a")
    write_depth(file, reconstruction, "a")
    assert is_made_from(file, "a") and not is_made_from(file, "b")
    capture, dense = read_capture(tabletop), reconstruction.dense
    found = read_depth(file, replace(reconstruction, pointmaps=None), capture)
    for name in ("points_in_recon", "confidence", "reason", "depth_std", "colors"):
        np.testing.assert_array_equal(getattr(found, name), getattr(dense, name))
    grey = read_depth(file, reconstruction, None)
    assert (grey.colors == 128).all() and (grey.points_in_recon == dense.points_in_recon).all()
