"""A finished run as the viewer shows it, read from its folder."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.calibration.calibration_json import CalibrationFile
from jcr.camera import pinhole_inside
from jcr.depth.densify import undistorted
from jcr.depth.options import DepthOptions
from jcr.errors import InputError
from jcr.geometry import apply_similarity, inverse, scale_translation
from jcr.records import Capture, Intrinsics, PointCloud, Reconstruction
from jcr.run_folder import RunFolder
from jcr.scene.scene_map import SceneMap

CLOUD_POINTS = 200_000
"""Most points that are drawn of pointmaps without a map."""
GREY = 128
"""Grey level of images that cannot be read."""


@dataclass(frozen=True, kw_only=True)
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
    intrinsics: Intrinsics
    """Undistorted, of `pixels`."""
    pixels: UInt8[ndarray, "m h w 3"]
    tracks_in_base: Float[ndarray, "p 3"]
    cloud: PointCloud
    scene: SceneMap | None
    notes: tuple[str, ...]
    """What is missing, and why."""


def read_run(out: Path) -> ViewedRun:
    """What a run folder holds; without a map the cloud is that of the pointmaps.

    Raises InputError where there is no run, or one that found no calibration.
    """
    folder = RunFolder(out)
    calibration, reconstruction = folder.calibrated()
    assert calibration.scale is not None  # wherever there is a transform
    base_from_recon, scale = np.array(calibration.base_from_recon), calibration.scale
    base_from_camera = base_from_recon @ scale_translation(reconstruction.recon_from_camera, scale)
    notes, capture = [], None
    try:
        capture = folder.capture()
        base_from_gripper, gripper_image = capture.base_from_gripper, np.arange(len(capture))
    except InputError as error:
        base_from_gripper = base_from_camera @ inverse(np.array(calibration.gripper_from_camera))
        gripper_image = reconstruction.image_index
        notes.append(f"grippers stand where the calibration puts them, not where the robot did: {error}")
    intrinsics, pixels = _undistorted_images(reconstruction, capture)
    scene = None
    if folder.has_map():
        scene = folder.scene()
    else:
        notes.append(f"no map yet: make one with jcr map {out}")
    return ViewedRun(
        name=out.resolve().name,
        calibration=calibration,
        image=reconstruction.image_index,
        base_from_camera=base_from_camera,
        base_from_gripper=base_from_gripper,
        gripper_image=gripper_image,
        intrinsics=intrinsics,
        pixels=pixels,
        tracks_in_base=apply_similarity(base_from_recon, scale, reconstruction.tracks.points_in_recon),
        cloud=_pointmap_cloud(reconstruction, base_from_camera, base_from_recon, scale)
        if scene is None
        else folder.cloud(),
        scene=scene,
        notes=tuple(notes),
    )


def _undistorted_images(
    reconstruction: Reconstruction, capture: Capture | None
) -> tuple[Intrinsics, UInt8[ndarray, "m h w 3"]]:
    """The registered images without distortion, and their camera; grey where neither run nor capture has them."""
    if (dense := reconstruction.pointmaps) is not None:
        return dense.intrinsics, dense.colors
    if capture is not None:
        names = [capture.images[row] for row in reconstruction.image_index]
        return undistorted(capture.folder, names, reconstruction.intrinsics)
    pinhole = pinhole_inside(reconstruction.intrinsics, DepthOptions.pointmap_size_px)
    shape = len(reconstruction.image_index), pinhole.height, pinhole.width, 3
    return pinhole, np.full(shape, GREY, np.uint8)


def _pointmap_cloud(
    reconstruction: Reconstruction,
    base_from_camera: Float[ndarray, "m 4 4"],
    base_from_recon: Float[ndarray, "4 4"],
    scale: float,
) -> PointCloud:
    """All points with any confidence, thinned, without margins; none before there is dense depth."""
    if (dense := reconstruction.pointmaps) is None:
        nothing = np.zeros(0)
        return PointCloud(
            points_in_base=np.zeros((0, 3)),
            color=np.zeros((0, 3), np.uint8),
            confidence=nothing,
            margin=nothing,
            label=np.zeros(0, int),
            image=np.zeros(0, int),
            camera_centers_in_base=base_from_camera[:, :3, 3],
        )
    pixel = np.flatnonzero(dense.confidence > 0)
    if len(pixel) > CLOUD_POINTS:
        pixel = np.random.default_rng(0).choice(pixel, CLOUD_POINTS, replace=False)
    points = dense.points_in_recon.reshape(-1, 3)[pixel].astype(np.float64)
    return PointCloud(
        points_in_base=apply_similarity(base_from_recon, scale, points),
        color=dense.colors.reshape(-1, 3)[pixel],
        confidence=dense.confidence.reshape(-1)[pixel].astype(np.float64),
        margin=np.full(len(pixel), np.nan),
        label=np.zeros(len(pixel), int),
        image=pixel // dense.confidence[0].size if len(dense.confidence) else pixel,
        camera_centers_in_base=base_from_camera[:, :3, 3],
    )
