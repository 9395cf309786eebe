"""File format depth.npz: the estimated depth of the pixels of each image, 8.25 bytes a pixel.

The points follow from depth and the camera poses of reconstruction.npz; colours come from the images.
"""

from dataclasses import asdict
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from jcr.depth.densify import pointmaps_of, undistorted
from jcr.geometry import apply, inverse
from jcr.records import Capture, Intrinsics, Pointmaps, Reconstruction
from jcr.records.reconstruction_npz import read_npz, require_shapes, write_npz

DEPTH_FILE = "depth.npz"
FORMAT = "jcr.depth/3"
"""Version of the format; a file of another version is rejected."""
MISSING_COLOUR = 128
"""Grey value that replaces the colours where the images are no longer available."""


class DepthHeader(BaseModel):
    """Header of the file depth.npz, in JSON: version and intrinsics."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    format: str
    intrinsics: Intrinsics


def write_depth(path: Path, reconstruction: Reconstruction) -> None:
    """Write depth z, its std and origin, and confidence of a reconstruction's pointmaps to a file depth.npz.

    After an error there is no incomplete file.
    """
    dense = reconstruction.dense
    assert dense.reason is not None and dense.depth_std is not None
    about = {"format": FORMAT, "intrinsics": asdict(dense.intrinsics)}
    camera_from_recon = inverse(reconstruction.recon_from_camera)
    depth = np.stack(
        [apply(pose, x)[..., 2] for pose, x in zip(camera_from_recon, dense.points_in_recon, strict=True)]
    ).astype(np.float32)
    arrays = {
        "depth": depth,
        "relative_std": (dense.depth_std / depth).astype(np.float16),
        "confidence": dense.confidence.astype(np.float16),
        "matched": np.packbits(dense.reason & 1),
        "filled": np.packbits(dense.reason >> 1),
    }
    write_npz(path, about, arrays)


def read_depth(path: Path, reconstruction: Reconstruction, capture: Capture | None) -> Pointmaps:
    """Read the pointmaps of a reconstruction, coloured by the images of the capture, or grey without a capture.

    The points are computed from the file's depths and the camera poses of `reconstruction`. Raises InputError for a
    file that is damaged, of another version, or of other images.
    """
    with read_npz(path, FORMAT) as (text, file):
        pinhole = DepthHeader.model_validate_json(text, strict=True).intrinsics
        shape = len(reconstruction.image_index), pinhole.height, pinhole.width
        depth, std, confidence = (file[name] for name in ("depth", "relative_std", "confidence"))
        require_shapes(
            {"depth": (depth, shape), "relative_std": (std, shape), "confidence": (confidence, shape)}
        )
        if (confidence < 0).any() or (std < 0).any() or (depth[confidence > 0] <= 0).any():
            raise ValueError("a depth, its standard deviation or its confidence is negative")
        matched, filled = (np.unpackbits(file[k], count=int(np.prod(shape))) for k in ("matched", "filled"))
        if capture is None:
            colors = np.full((*shape, 3), MISSING_COLOUR, np.uint8)
        else:
            names = [capture.images[row] for row in reconstruction.image_index]
            colors = undistorted(capture.folder, names, reconstruction.intrinsics, pinhole)
        reason = (matched | filled << 1).reshape(shape)
        return pointmaps_of(depth, std, confidence, reason, colors, reconstruction.recon_from_camera, pinhole)
