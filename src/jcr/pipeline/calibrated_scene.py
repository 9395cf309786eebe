"""Calibrated scene of a run: new images are located in it, and compared with it."""

import json
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jcr.calibration.drift import Located
from jcr.camera import project
from jcr.capture.checks import far_faults
from jcr.capture.folder import require_decided
from jcr.capture.formats import bag
from jcr.capture.formats.capture_json import origin
from jcr.capture.images import read_image, require_unlike
from jcr.errors import InputError, RejectedError, count_of
from jcr.geometry import apply, inverse, motion_length, require_rigid
from jcr.pipeline.stages import fingerprint
from jcr.pipeline.verify_history import NewCapture
from jcr.records import Capture, CellCamera
from jcr.records.reconstruction_npz import read_npz, write_npz
from jcr.result import RunResult
from jcr.sfm.register import ImageFeatures, KnownImages, Registration, features, registrations

FOUND_PX = 2.0
"""Largest distance (px) of a point of the scene from a feature at which the point counts as seen."""
PLACE_M, LEAST_POINTS, CHANGED = 0.1, 20, 0.1
"""Side (m) of the cubes in which the scene is compared, the fewest points of a cube, and the share of points left below
which the scene has changed there. In six real captures views from other poses keep 12 % or more in each unchanged cube;
where objects were pushed away at most 8 % are met by chance. With 0.15 one of the six has a false place, with 0.05 half
of the true ones are missed. JPEG takes faint features away: of nine captures whose other half was verified, quality 100
gave one with a false place, 60 two, and 25 three."""
MOST_PLACES = 3
FEATURES, FORMAT = "features.npz", "jcr.features/1"
"""File of the features of the calibration's images, which a verification finds once; half of its time otherwise."""
Image = UInt8[ndarray, "h w 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class NewImages:
    """New images of the wrist camera with the gripper poses at which they were taken."""

    images: Sequence[str]
    pixels: Sequence[Image]
    base_from_gripper: Float[ndarray, "n 4 4"]
    joints: Float[ndarray, "n dof"] | None = None

    @staticmethod
    def of(
        images: Sequence[ArrayLike | Path | str],
        base_from_gripper: ArrayLike,
        joints: ArrayLike | None = None,
    ) -> "NewImages":
        """Return n RGB images (h,w,3) uint8 or image files with their gripper poses (n,4,4) and joint angles (n,dof).

        Raises InputError unless there is an image for each rigid pose in metres.
        """
        pixels = [read_image(Path(one)) if isinstance(one, str | Path) else np.asarray(one) for one in images]
        names = [
            Path(one).name if isinstance(one, str | Path) else f"image {k}" for k, one in enumerate(images)
        ]
        for name, image in zip(names, pixels, strict=True):
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
                raise InputError(f"{name}: {image.dtype} of shape {image.shape}; give RGB (h, w, 3) of uint8")
        poses = np.asarray(base_from_gripper, np.float64)
        angles = None if joints is None else np.asarray(joints, np.float64)
        has_angles = angles is None or len(angles) == len(pixels)
        if not pixels or poses.shape != (len(pixels), 4, 4) or not has_angles:
            raise InputError(
                f"base_from_gripper: shape {poses.shape} for {count_of(len(pixels), 'image')}; give a pose (4, 4), and "
                "joint angles, if any, for each"
            )
        for name, pose in zip(names, poses, strict=True):
            require_rigid(pose, f"base_from_gripper of {name}")
        far_faults(poses[:, :3, 3], "base_from_gripper", names)
        return NewImages(images=names, pixels=pixels, base_from_gripper=poses, joints=angles)

    @cached_property
    def digests(self) -> tuple[str, ...]:
        """Hash of each image with its pose, by which it is known again."""
        return tuple(fingerprint(*one) for one in zip(self.pixels, self.base_from_gripper, strict=True))


def new_images(new: Capture, camera: CellCamera | None = None) -> NewImages:
    """Return the images of a new capture, or of one of its cameras; raise InputError if its poses are undecided."""
    new = require_decided(new)
    own = camera or new
    return NewImages(
        images=own.images,
        pixels=[read_image((own.folder or new.folder) / image) for image in own.images],
        base_from_gripper=new.base_from_gripper,
        joints=new.joints,
    )


def name_of(capture: Capture) -> str:
    """Return the name of a capture: that of its folder, or of the recording from which it was made."""
    path = capture.source or origin(capture.folder)
    return (path if path.is_dir() or path.suffix in bag.BAG_SUFFIXES else path.parent).absolute().name


def require_new(then: Capture | CellCamera, old: Sequence[Image], new: NewImages) -> None:
    """Raise InputError if new images have another size than those of the calibration, or if one is among `old`."""
    for name, image in zip(new.images, new.pixels, strict=True):
        if image.shape[1::-1] != then.image_size:
            (height, width), (wide, high) = image.shape[:2], then.image_size
            raise InputError(
                f"{name}: has {width}x{height} pixels, the calibration is for {wide}x{high}; take them with "
                "the same camera and resolution"
            )
    pixels = dict(zip(new.images, new.pixels, strict=True))
    require_unlike(pixels, zip(then.images, old, strict=True), "the calibration")


@lru_cache(maxsize=2)
def old_scene(out: Path, digest: str) -> "OldScene":
    """Return the calibrated scene of a run; a process that verifies again need not look for its features again."""
    return OldScene(RunResult(out), digest)


def _kept_features(file: Path, digest: str, count: int) -> tuple[ImageFeatures, ...] | None:
    """Return the features of the `count` images of a calibration from a file of its run folder; None if it has none."""
    if not file.is_file():
        return None
    with read_npz(file, FORMAT) as (about, arrays):
        if json.loads(about)["digest"] != digest:
            return None
        parts = ([arrays[f"{name}{k}"] for name in ("x_px", "rays", "descriptors")] for k in range(count))
        return tuple(ImageFeatures(x_px, rays, d.astype(np.float32)) for x_px, rays, d in parts)


class OldScene:
    """Calibrated scene of a run: its images with features, in which new images are located."""

    def __init__(self, run: RunResult, digest: str) -> None:
        _, capture, reconstruction = run.of_wrist_camera()
        self.capture, self.tracks, camera = capture, reconstruction.tracks, reconstruction.intrinsics
        self.similarity = run.found.base_from_recon
        self.pixels = [read_image(capture.folder / name) for name in capture.images]
        old = [self.pixels[row] for row in reconstruction.image_index]
        found = _kept_features(run.out / FEATURES, digest, len(old))
        if found is None:
            with ThreadPoolExecutor(os.cpu_count()) as threads:
                found = tuple(threads.map(lambda image: features(image, camera), old))
            parts = {f"{name}{k}": part for k, one in enumerate(found) for name, part in vars(one).items()}
            halves = {
                name: part.astype(np.float16) if "desc" in name else part for name, part in parts.items()
            }
            write_npz(run.out / FEATURES, {"format": FORMAT, "digest": digest}, halves)
        self.known = KnownImages(camera, reconstruction.recon_from_camera, found)
        self.seen = np.zeros((len(old), len(self.tracks.points_in_recon)), bool)
        """Whether each image shows each point of the tracks."""
        self.seen[self.tracks.image, self.tracks.point] = True

    def located(self, name: str, new: NewImages) -> NewCapture:
        """Return new images with their camera poses in the scene; raise RejectedError if none can be located."""
        camera = self.known.camera
        with ThreadPoolExecutor(os.cpu_count()) as threads:
            found = list(threads.map(lambda image: registrations(self.known, image, camera)[0], new.pixels))
        rows = [row for row, (one, _) in enumerate(found) if one is not None]
        counts = {image: count for image, (one, count) in zip(new.images, found, strict=True) if one is None}
        lost = [
            f"{name} shares {count_of(n, 'point')} with the calibrated scene" for name, n in counts.items()
        ]
        if not rows:
            raise RejectedError(
                f"cannot tell: {'; '.join(lost)}; take images of the scene that was calibrated on, or calibrate images "
                "of another one (jcr verify --new-scene)"
            )
        placed = [one for one, _ in found if one is not None]
        left, places = self._left(placed)
        if places:
            at = ", ".join(f"({x:.2f}, {y:.2f}, {z:.2f})" for x, y, z in places)
            lost.append(
                f"the scene looks different near {at} m (base frame): if objects moved, the map is wrong there (blur, "
                f"shadows and strong compression look alike); {100 * (left or 0):.0f} % of the scene is as before, and "
                "this part tests the calibration"
            )
        located = Located(
            base_from_gripper=tuple(new.base_from_gripper[rows]),
            recon_from_camera=tuple(one.pose.a_from_camera for one in placed),
            covariance=tuple(one.pose.covariance for one in placed),
            joints=None if new.joints is None else tuple(new.joints[rows]),
        )
        images = tuple(new.images[row] for row in rows)
        return NewCapture(
            name=name,
            digests=new.digests,
            images=images,
            notes=tuple(lost),
            scene_left=left,
            located=located,
        )

    def _left(self, placed: Sequence[Registration]) -> tuple[float | None, list[Float[ndarray, "3"]]]:
        """Return the share of the scene that located images show unchanged, and where it has changed (m, base frame).

        The points of an image are compared with those that the old image from the nearest view shows. The share is
        None with too few points.
        """
        points, camera, old = self.tracks.points_in_recon, self.known.camera, self.known.recon_from_camera
        expected, found = np.zeros(len(points)), np.zeros(len(points))
        for one in placed:
            pose = one.pose.a_from_camera
            nearest = int(np.argmin(motion_length(inverse(old) @ pose)))
            in_camera = apply(inverse(pose), points)
            ahead = in_camera[:, 2] > 1e-6
            x_px = project(camera, np.where(ahead[:, None], in_camera, [0.0, 0.0, 1.0]))
            inside = ahead & ((x_px >= 0) & (x_px < [camera.width, camera.height])).all(1)
            expected += inside & self.seen[nearest]
            found += inside & (KDTree(one.x_px).query(x_px)[0] < FOUND_PX)
        if expected.sum() < LEAST_POINTS:
            return None, []
        in_base = self.similarity(points)
        cube, of_cube = np.unique(np.floor(in_base / PLACE_M), axis=0, return_inverse=True)
        before, now = (np.bincount(of_cube.ravel(), part, len(cube)) for part in (expected, found))
        changed = np.flatnonzero((before >= LEAST_POINTS) & (now < CHANGED * before))
        largest = changed[np.argsort(-before[changed])][:MOST_PLACES]
        middles = [np.average(in_base[own], axis=0, weights=expected[own])
                   for own in (of_cube.ravel() == k for k in largest)]  # fmt: skip
        # Texture that is new may hide no point; a place counts at most for what it showed.
        return float(np.minimum(now, before).sum() / before.sum()), middles
