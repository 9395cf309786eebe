"""Records of problems with a known answer: captures without images, samples, and reconstructions without a back end."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.records import Capture, PosePairs, Reconstruction, Tracks
from simulation.problems import INTRINSICS

NOTHING = np.zeros(0, int)
NO_TRACKS = Tracks(image=NOTHING, x_px=np.zeros((0, 2)), point=NOTHING, points_in_recon=np.zeros((0, 3)))


def png_names(count: int) -> tuple[str, ...]:
    """Return 0.png, 1.png, …"""
    return tuple(f"{k}.png" for k in range(count))


def capture_of(base_from_gripper: Float[ndarray, "n 4 4"], **facts: Any) -> Capture:
    """Return a capture at these gripper poses, whose images, 640 x 480 pixels, are not there."""
    names = png_names(len(base_from_gripper))
    usual = {"folder": Path(), "images": names, "image_size": (640, 480)}
    return Capture(base_from_gripper=base_from_gripper, **(usual | facts))


def pairs_of(
    base_from_gripper: Float[ndarray, "n 4 4"], recon_from_camera: Float[ndarray, "n 4 4"], **facts: Any
) -> PosePairs:
    """Return samples of these poses; cameras have no metric scale, where `facts` does not say otherwise."""
    usual = {"source": Path("samples.yaml"), "images": png_names(len(base_from_gripper)), "is_metric": False}
    poses = {"base_from_gripper": base_from_gripper, "recon_from_camera": recon_from_camera}
    return PosePairs(**(usual | poses | facts))


def reconstruction_of(recon_from_camera: Float[ndarray, "n 4 4"], **facts: Any) -> Reconstruction:
    """Return a reconstruction with these cameras and no tracks, of every image of a capture."""
    usual = {"image_index": np.arange(len(recon_from_camera)), "intrinsics": INTRINSICS, "tracks": NO_TRACKS}
    return Reconstruction(recon_from_camera=recon_from_camera, **(usual | {"backend": "colmap"} | facts))
