"""Captures that something is wrong with, without images: gripper poses, image observations, and the truth.

What is reported is what a user would have; what was is what the fault made of it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from jcr.camera import NO_DISTORTION, parameter_names, parameters, project, with_parameters, zoomed
from jcr.estimation.equation import predict
from jcr.estimation.intrinsics_prior import ESTIMATED, FIXED, camera_with_prior
from jcr.estimation.known_scale import fit_known_scale
from jcr.estimation.wrist import adjust_wrist
from jcr.geometry import apply, inverse, rotation_exp, transform
from jcr.records import Capture, Intrinsics, Reconstruction, Tracks
from simulation.arms import EFFECTIVE_NOISE, EFFECTIVE_POSES
from simulation.poses import gripper_poses, random_hand_eye
from simulation.problems import TARGET_IN_BASE, disturbed

INTRINSICS = Intrinsics(620.0, 620.0, 319.5, 239.5, 640, 480, NO_DISTORTION)
"""What the user believes the camera to be."""
LOOSE = (3.0, 3.0)
"""m, rad: gripper poses by which structure from motion is hardly held."""
POINTS, NOISE_PX = 500, 0.4
"""On the table and what stands on it, and one sigma of their observations."""
LOW, HIGH = np.array([0.2, -0.3, 0.0]), np.array([0.8, 0.3, 0.15])


@dataclass(frozen=True, kw_only=True)
class Faults:
    """What is wrong; nothing, by default."""

    focal_by_distance: float = 0.0
    """Relative growth of the focal length from the nearest view to the farthest."""
    focal_scatter: float = 0.0
    """Relative, one sigma, between images."""
    zoom: float = 0.0
    """Relative, in the second half of the capture."""
    intrinsics: tuple[tuple[str, float], ...] = ()
    """Names of its parameters, and by how much the true one is more than the believed one."""
    rolling_px: float = 0.0
    """By how much the last row is shifted against the first in x."""
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """s1 to s4 of OpenCV's thin prism."""
    centre_sags_px: float = 0.0
    """By how much optics on springs move the image when gravity is along it, in x and in y alike."""
    slip: tuple[float, float] = (0.0, 0.0)
    """m, rad about random axes: the camera moves on the gripper."""
    slip_after: float = 0.5
    """Share of the images before it."""
    drift: tuple[float, float] = (0.0, 0.0)
    """m, rad about random axes: the motion of the camera on the gripper from the first image to the last, evenly."""
    base_moved: tuple[float, float] = (0.0, 0.0)
    """m, rad about random axes: the robot's base is pushed midway."""
    pose_scale: float = 1.0
    """Of the reported positions."""
    lengths: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """By which the reported positions are too long along each axis of the base, relative: a lift, a rail, a gantry."""
    tilt_by_reach: float = 0.0
    """rad per m: a stand leans towards a gripper as far away as it is, horizontally, which no reported pose shows."""
    sag: float = 0.0
    """rad by which a level tool rotates towards the floor; of one that points down nothing."""
    delay_s: float = 0.0
    """By which poses are read late while the arm moves."""
    view_s: float = 2.0
    """From one view to the next, of an arm that moves."""
    robot_noise: tuple[float, float] = (3e-4, 0.001)
    """m, rad: one sigma per axis, white."""

    @property
    def is_bent(self) -> bool:
        """Whether poses are wrong by where they are."""
        return any(self.lengths) or bool(self.tilt_by_reach or self.sag)


@dataclass(frozen=True, kw_only=True)
class FaultyCapture:
    """What a user would have, and what was."""

    base_from_gripper: Float[ndarray, "n 4 4"]
    """As reported."""
    tracks: Tracks
    """Its points are where they are in the base, up to the noise of a first estimate."""
    base_from_camera: Float[ndarray, "n 4 4"]
    """Where the cameras were."""
    gripper_from_camera: Float[ndarray, "4 4"]
    """Before a slip; of poses that are bent the effective one."""
    gripper_from_camera_after: Float[ndarray, "4 4"]
    """After it; of poses that are bent that of the true ones."""
    intrinsics: Intrinsics
    """As believed."""


def faulty_capture(rng: np.random.Generator, images: int = 12, faults: Faults = Faults()) -> FaultyCapture:
    """Varied views of a table with relief, in the order in which an arm would go through them."""
    x = random_hand_eye(rng)
    true = gripper_poses("varied", images, TARGET_IN_BASE, x, rng)
    axes = rng.normal(size=(2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    slipped = x @ _motion(faults.slip, axes)
    first = round(faults.slip_after * images)
    mounted = np.stack([x if k < first else slipped for k in range(images)])
    if any(faults.drift):
        mounted = np.stack(
            [x @ _motion(faults.drift, share * axes) for share in np.linspace(-0.5, 0.5, images)]
        )
        slipped = mounted[-1]
    cameras = true @ mounted
    if any(faults.base_moved):
        pushed = np.arange(images) >= images / 2
        cameras = np.where(pushed[:, None, None], _motion(faults.base_moved, axes) @ cameras, cameras)
    reported = late(true, faults.delay_s, faults.view_s) if faults.delay_s else true
    reported = disturbed(_bent(reported, faults), faults.robot_noise, rng)
    reported[:, :3, 3] *= faults.pose_scale
    points = rng.uniform(LOW, HIGH, (POINTS, 3))
    depth = np.median(apply_all(inverse(cameras), points)[..., 2], axis=1)
    share = (depth - depth.mean()) / max(float(np.ptp(depth)), 1e-9)
    focal = np.exp(faults.focal_by_distance * share + faults.focal_scatter * rng.normal(size=images))
    focal *= np.where(np.arange(images) < images / 2, 1.0, 1 + faults.zoom)
    off = dict(faults.intrinsics)
    camera = with_parameters(
        INTRINSICS,
        parameters(INTRINSICS) + np.array([off.get(name, 0.0) for name in parameter_names(INTRINSICS)]),
    )
    image, point, pixels = [], [], []
    for k in range(images):
        x_in_camera = apply(inverse(cameras[k]), points)
        x_px = project(zoomed(camera, float(focal[k])), x_in_camera)
        x_px[:, 0] += faults.rolling_px * (x_px[:, 1] / INTRINSICS.height - 0.5)
        x_px += camera.fx * _through_prism(x_in_camera[:, :2] / x_in_camera[:, 2:], faults.prism)
        x_px -= faults.centre_sags_px * cameras[k, 2, :2]  # gravity, along -z of the base, in camera axes
        inside = (
            (x_px > 0).all(1)
            & (x_px < [INTRINSICS.width, INTRINSICS.height]).all(1)
            & (x_in_camera[:, 2] > 0)
        )
        seen = np.flatnonzero(inside)
        image.append(np.full(len(seen), k))
        point.append(seen)
        pixels.append(x_px[seen] + NOISE_PX * rng.normal(size=(len(seen), 2)))
    tracks = Tracks(
        image=np.concatenate(image),
        x_px=np.concatenate(pixels),
        point=np.concatenate(point),
        points_in_recon=points,
    )
    if faults.is_bent:
        x, slipped = _effective(x, images, faults, rng), x
    return FaultyCapture(
        base_from_gripper=reported,
        tracks=tracks,
        base_from_camera=cameras,
        gripper_from_camera=x,
        gripper_from_camera_after=slipped,
        intrinsics=INTRINSICS,
    )


def _motion(size: tuple[float, float], axes: Float[ndarray, "2 3"]) -> Float[ndarray, "4 4"]:
    """Return a rotation about the first axis and a translation along the second of this size (m, rad)."""
    return transform(rotation_exp(size[1] * axes[0]), size[0] * axes[1])


def _through_prism(x: Float[ndarray, "p 2"], s: tuple[float, float, float, float]) -> Float[ndarray, "p 2"]:
    """Displacements of rays (x, y, 1), OpenCV's thin prism distortion."""
    r2 = (x**2).sum(1)
    return np.stack([s[0] * r2 + s[1] * r2**2, s[2] * r2 + s[3] * r2**2], axis=1)


def _bent(true: Float[ndarray, "n 4 4"], faults: Faults) -> Float[ndarray, "n 4 4"]:
    """What an arm reports that is bent, or carries a tool that is."""
    reach = true[:, :3, 3] * [1.0, 1.0, 0.0]
    lean = faults.tilt_by_reach * np.cross([0.0, 0.0, 1.0], reach)
    gravity = -true[:, 2, :3]
    sag = faults.sag * np.cross([0.0, 0.0, 1.0], gravity)
    reported = transform(rotation_exp(-lean), np.zeros(3)) @ true @ transform(rotation_exp(-sag), np.zeros(3))
    reported[:, :3, 3] *= 1 + np.array(faults.lengths)
    return reported


def _effective(
    x: Float[ndarray, "4 4"], images: int, faults: Faults, rng: np.random.Generator
) -> Float[ndarray, "4 4"]:
    """The transform that best predicts the camera from what such an arm reports at other poses of the same views."""
    captures = -(-EFFECTIVE_POSES // images)
    others = [gripper_poses("varied", images, TARGET_IN_BASE, x, rng) for _ in range(captures)]
    true = np.concatenate(others)
    fit = fit_known_scale(_bent(true, faults), true @ x, (x, np.eye(4)), EFFECTIVE_NOISE)
    return fit.gripper_from_camera


def apply_all(a_from_b: Float[ndarray, "n 4 4"], x_in_b: Float[ndarray, "p 3"]) -> Float[ndarray, "n p 3"]:
    """Points under each of the transforms."""
    return x_in_b @ np.swapaxes(a_from_b[:, :3, :3], 1, 2) + a_from_b[:, None, :3, 3]


def late(true: Float[ndarray, "n 4 4"], delay_s: float, view_s: float) -> Float[ndarray, "n 4 4"]:
    """Poses of an arm that moves through these without a stop, one every `view_s`, `delay_s` later."""
    at = view_s * np.arange(len(true))
    later = at + delay_s
    position = CubicSpline(at, true[:, :3, 3])(later)
    rotation = RotationSpline(at, Rotation.from_matrix(true[:, :3, :3]))(later)
    return transform(rotation.as_matrix(), position)


def reconstructed(found: FaultyCapture, estimated: bool) -> tuple[Capture, Reconstruction]:
    """Return the capture, and the reconstruction that structure from motion gives of its observations.

    The intrinsics are the believed ones, or `estimated`.
    """
    cameras, m = found.base_from_camera, len(found.base_from_camera)
    start = np.eye(4), 1.0, np.eye(4)
    free = camera_with_prior(found.intrinsics, ESTIMATED if estimated else FIXED)
    sfm = adjust_wrist(cameras, start, cameras, free, found.tracks, noise=LOOSE)
    state = sfm.state
    intrinsics, x = sfm.problem.intrinsics(state)[0], state.x[0]
    rigs = predict(x, state.scale, state.z[0], state.world_from_rig)
    capture = Capture(
        folder=Path("."),
        images=tuple(f"{k:02d}.png" for k in range(m)),
        base_from_gripper=found.base_from_gripper,
        image_size=(INTRINSICS.width, INTRINSICS.height),
        intrinsics=None if estimated else found.intrinsics,
    )
    return capture, Reconstruction(
        image_index=np.arange(m),
        recon_from_camera=rigs @ x,
        intrinsics=intrinsics,
        tracks=found.tracks,
        backend="simulated",
    )
