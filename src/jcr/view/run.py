"""A finished run as the viewer shows it, read from its folder."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.calibration.calibration_json import CalibrationFile, read_calibration
from jcr.errors import InputError
from jcr.export.points import read_cloud
from jcr.geometry import apply_similarity, inverse, scale_translation
from jcr.pipeline import read_capture_of
from jcr.reconstruct.reconstruction_npz import read_reconstruction
from jcr.records import Intrinsics, PointCloud, Reconstruction
from jcr.represent.map_file import FILE, load_map
from jcr.represent.scene import SceneMap

CLOUD_POINTS = 200_000
"""Of pointmaps that no map was made of yet, at most."""


@dataclass(frozen=True)
class ViewedRun:
    """Cameras, grippers, points and map of a run, in the base frame."""

    name: str
    calibration: CalibrationFile
    image: Int[ndarray, " m"]
    """Row of `calibration.images` that each registered camera belongs to."""
    base_from_camera: Float[ndarray, "m 4 4"]
    base_from_gripper: Float[ndarray, "n 4 4"]
    """Of all images where the robot's poses are known, else of the registered ones as the calibration puts them."""
    gripper_image: Int[ndarray, " n"]
    """Row of `calibration.images` that each gripper pose belongs to."""
    lens: Intrinsics
    """Undistorted, of `pictures`."""
    pictures: UInt8[ndarray, "m h w 3"]
    tracks_in_base: Float[ndarray, "p 3"]
    cloud: PointCloud
    scene: SceneMap | None
    notes: tuple[str, ...]
    """What is missing, and why."""


def read_run(out: Path) -> ViewedRun:
    """What a run folder holds; without a map the cloud is that of the pointmaps.

    Raises InputError where there is no run, or one that found no calibration.
    """
    calibration = read_calibration(out)
    if calibration.gripper_from_camera is None or calibration.scale is None:
        raise InputError(
            f"{out}: found no calibration to show ({calibration.warnings[0]}); mend the capture, run it again"
        )
    reconstruction = read_reconstruction(out / "reconstruction.npz")
    base_from_recon, scale = np.array(calibration.base_from_recon), calibration.scale
    base_from_camera = base_from_recon @ scale_translation(reconstruction.recon_from_camera, scale)
    notes = []
    try:
        capture = read_capture_of(out)
        base_from_gripper, gripper_image = capture.base_from_gripper, np.arange(len(capture))
    except InputError as error:
        base_from_gripper = base_from_camera @ inverse(np.array(calibration.gripper_from_camera))
        gripper_image = reconstruction.image_index
        notes.append(f"grippers stand where the calibration puts them, not where the robot did: {error}")
    scene = None
    if (out / FILE).is_file():
        scene = load_map(out)
    else:
        notes.append(f"no map yet: make one with jcr map {out}")
    return ViewedRun(
        name=out.resolve().name,
        calibration=calibration,
        image=reconstruction.image_index,
        base_from_camera=base_from_camera,
        base_from_gripper=base_from_gripper,
        gripper_image=gripper_image,
        lens=reconstruction.pointmap_intrinsics,
        pictures=reconstruction.colors,
        tracks_in_base=apply_similarity(base_from_recon, scale, reconstruction.tracks.points_in_recon),
        cloud=_pointmap_cloud(reconstruction, base_from_camera, base_from_recon, scale)
        if scene is None
        else read_cloud(out / "cloud.ply"),
        scene=scene,
        notes=tuple(notes),
    )


def _pointmap_cloud(
    reconstruction: Reconstruction,
    base_from_camera: Float[ndarray, "m 4 4"],
    base_from_recon: Float[ndarray, "4 4"],
    scale: float,
) -> PointCloud:
    """All points with any confidence, thinned; without margins."""
    pixel = np.flatnonzero(reconstruction.confidence > 0)
    if len(pixel) > CLOUD_POINTS:
        pixel = np.random.default_rng(0).choice(pixel, CLOUD_POINTS, replace=False)
    points = reconstruction.points_in_recon.reshape(-1, 3)[pixel].astype(np.float64)
    return PointCloud(
        points_in_base=apply_similarity(base_from_recon, scale, points),
        color=reconstruction.colors.reshape(-1, 3)[pixel],
        confidence=reconstruction.confidence.reshape(-1)[pixel].astype(np.float64),
        margin=np.full(len(pixel), np.nan),
        label=np.zeros(len(pixel), int),
        image=pixel // max(reconstruction.confidence[0].size, 1) if len(reconstruction.confidence) else pixel,
        camera_centers_in_base=base_from_camera[:, :3, 3],
    )
