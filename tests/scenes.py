"""Records of problems with a known answer: captures without images, samples, and reconstructions without a back end."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.calibration.record import Calibration
from jcr.geometry import apply, fit_similarity, inverse, transform
from jcr.records import (
    Capture,
    Intrinsics,
    PointCloud,
    Pointmaps,
    PosePairs,
    Reconstruction,
    RobotNoise,
    Tracks,
    Uncertainty,
)
from simulation.cells import CellProblem
from simulation.problems import INTRINSICS

Change = Callable[[ndarray], ndarray]
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


def carried_capture(problem: CellProblem, given: Intrinsics | None = None) -> tuple[Capture, Reconstruction]:
    """Return capture and reconstruction of a cell of kind carried; `given` None: intrinsics are given exactly."""
    camera = given or problem.cameras[0]
    size = camera.width, camera.height
    capture = capture_of(problem.reported[0], intrinsics=camera, image_size=size, mount="base")
    seen = problem.observations
    tracks = Tracks(
        image=seen.image, x_px=seen.x_px, point=seen.point, points_in_recon=problem.points_in_world
    )
    return capture, reconstruction_of(problem.world_from_rig, intrinsics=camera, tracks=tracks)


def maps_of(points_in_recon: Float[ndarray, "m h w 3"], intrinsics: Intrinsics, **facts: Any) -> Pointmaps:
    """Return black pointmaps at these points, all of them as sure as another."""
    usual = {"confidence": np.ones(points_in_recon.shape[:3])}
    usual |= {"colors": np.zeros(points_in_recon.shape, np.uint8)}
    return Pointmaps(points_in_recon=points_in_recon, intrinsics=intrinsics, **(usual | facts))


def no_depth(shape: tuple[int, ...]) -> dict[str, ndarray]:
    """Return the layers of pointmaps in which no pixel has a depth."""
    nothing = np.zeros(shape)
    return {"confidence": nothing, "reason": nothing.astype(np.uint8), "depth_std": nothing}


def hand_eye_of(on_gripper: Float[ndarray, "4 4"], **facts: Any) -> Calibration:
    """Return a calibration without images, known exactly, whose recon frame is the base in metres."""
    usual = {"scale": 1.0, "resting": np.eye(4), "uncertainty": Uncertainty(covariance=np.zeros((7, 7)))}
    usual |= {"images": (), "robot_noise": RobotNoise(translation=0.0, rotation=0.0, estimated=False)}
    return Calibration(on_gripper=on_gripper, **(usual | facts))


def cloud_of(points_in_base: Float[ndarray, "n 3"], **facts: Any) -> PointCloud:
    """Return a cloud of black points without labels, as sure as all others, of one image from above."""
    nothing, zeros = np.zeros(len(points_in_base)), np.zeros(len(points_in_base), int)
    usual = {"color": np.zeros(points_in_base.shape, np.uint8), "confidence": nothing + 1, "margin": nothing}
    usual |= {"label": zeros, "image": zeros, "camera_centers_in_base": np.array([[0.0, 0.0, 1.0]])}
    return PointCloud(points_in_base=points_in_base, **(usual | facts))


def reference_of(folder: Path) -> Float[ndarray, "4 4"]:
    """Return gripper_from_camera of a capture's reference.json."""
    return np.array(json.loads((folder / "reference.json").read_text())["gripper_from_camera"])


def true_cameras(capture: Capture, made: Reconstruction) -> Float[ndarray, "m 4 4"]:
    """Return base_from_camera of the registered images by their gripper poses and the reference."""
    return capture.base_from_gripper[made.image_index] @ reference_of(capture.folder)


def center_errors(capture: Capture, made: Reconstruction) -> Float[ndarray, " m"]:
    """Return the distances (m) of camera centres from the true ones after the best similarity."""
    true, found = true_cameras(capture, made)[:, :3, 3], made.recon_from_camera[:, :3, 3]
    base_from_recon, scale = fit_similarity(true, found)
    return np.linalg.norm(apply(base_from_recon, scale * found) - true, axis=1)


def rotated(change: Callable[[Rotation], Rotation]) -> Change:
    """Return a change of the rotations of poses."""

    def changed(poses: ndarray) -> ndarray:
        rotation = change(Rotation.from_matrix(poses[:, :3, :3]))
        return transform(rotation.as_matrix(), poses[:, :3, 3])

    return changed


def mirrored(poses: ndarray) -> ndarray:
    return np.diag([1, 1, -1, 1.0]) @ poses @ np.diag([1, 1, -1, 1.0])


MISTAKES: dict[str, tuple[Change, str]] = {
    "inverses": (inverse, "inverse"),
    "reversed": (lambda g: g[::-1].copy(), "reverse order"),
    "late by one": (lambda g: np.roll(g, 1, 0), "one ahead of the images"),
    "left-handed base": (mirrored, "mirrored ones"),
    "transposed": (
        rotated(lambda r: r.inv()),
        "rotation matrix by columns that were taken as rotation matrix",
    ),
    "w first": (
        rotated(lambda r: Rotation.from_quat(r.as_quat()[:, [3, 0, 1, 2]])),
        "quaternion w, x, y, z that were taken as quaternion x, y, z, w",
    ),
    "Euler order": (
        rotated(lambda r: Rotation.from_euler("xyz", r.as_euler("ZYX"))),
        "angles ZYX, R = Rz·Ry·Rx that were taken as angles xyz",
    ),
    "vectors, radians for degrees": (
        rotated(lambda r: Rotation.from_rotvec(np.radians(r.as_rotvec()))),
        "rotation vector in radians that were taken as degrees",
    ),
}
"""Mistakes in writing gripper poses that another reading explains, and how that is named."""
