"""Captures with faults of camera, mount and robot: the poses that are reported, and the optics of each image.

The faults act on point observations (`faulty_capture`) and on rendered images (simulation.image_faults) alike.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from jcr.camera import parameter_names, parameters, project, unproject, with_parameters, zoomed
from jcr.estimation.intrinsics_prior import ESTIMATED, FIXED, camera_with_prior
from jcr.estimation.pose_equations import fit_known_scale, predicted_gripper_poses
from jcr.estimation.problem import wrist_arm, wrist_problem
from jcr.estimation.solve import solve
from jcr.geometry import inverse, rotation_exp, transform
from jcr.records import Capture, Intrinsics, Reconstruction, Tracks
from simulation.arms import EFFECTIVE_NOISE, EFFECTIVE_POSES
from simulation.poses import gripper_poses, random_hand_eye
from simulation.problems import TARGET_IN_BASE, disturbed, shown_points

Poses = Float[ndarray, "n 4 4"]
INTRINSICS = Intrinsics(620.0, 620.0, 319.5, 239.5, 640, 480)
"""Believed intrinsics."""
LOOSE = (3.0, 3.0)
"""m, rad: gripper poses by which structure from motion is hardly held."""
POINTS, NOISE_PX = 500, 0.4
"""Points on the table and what stands on it, and standard deviation of their observations."""
LOW, HIGH = np.array([0.2, -0.3, 0.0]), np.array([0.8, 0.3, 0.15])
"""Corners of the box (m) that holds the points."""


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Errors of camera, mount and robot; none by default."""

    focal_by_distance: float = 0.0
    """Relative growth of the focal length from the nearest view to the farthest."""
    focal_scatter: float = 0.0
    """Relative standard deviation of the focal length between images."""
    zoom: float = 0.0
    """Relative growth of the focal length in the second half of the capture."""
    intrinsics: tuple[tuple[str, float], ...] = ()
    """Names of parameters, and the true value of each minus the believed one."""
    rolling_px: float = 0.0
    """Shift of the last row against the first in x."""
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Coefficients s1 to s4 of OpenCV's thin prism."""
    centre_scatter_px: float = 0.0
    """Standard deviation of the principal point between images, as an image stabiliser leaves it."""
    slip: tuple[float, float] = (0.0, 0.0)
    """Step (m, rad) of the camera on the gripper along and about random axes."""
    slip_after: float = 0.5
    """Share of the images before the slip."""
    drift: tuple[float, float] = (0.0, 0.0)
    """Even motion (m, rad) of the camera on the gripper from the first image to the last."""
    base_moved: tuple[float, float] = (0.0, 0.0)
    """Step (m, rad) of the robot's base midway, along and about random axes."""
    pose_scale: float = 1.0
    """Factor on the reported positions."""
    lengths: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Relative excess of the reported positions along each axis of the base: a lift, a rail, a gantry."""
    tilt_by_reach: float = 0.0
    """Lean (rad per m) of a stand towards the gripper, by its horizontal distance; no reported pose shows it."""
    sag: float = 0.0
    """Rotation (rad) of a level tool towards the floor; a tool that points down does not rotate."""
    delay_s: float = 0.0
    """Delay of the poses while the arm moves."""
    view_s: float = 2.0
    """Time from one view to the next."""
    robot_noise: tuple[float, float] = (3e-4, 0.001)
    """Standard deviation (m, rad) of independent errors per axis."""

    @property
    def is_bent(self) -> bool:
        """Presence of errors that depend on the pose."""
        return any(self.lengths) or bool(self.tilt_by_reach or self.sag)


@dataclass(frozen=True, kw_only=True)
class FaultyCapture:
    """Observations of a capture as a user has them, and the truth."""

    base_from_gripper: Float[ndarray, "n 4 4"]
    """Reported poses."""
    tracks: Tracks
    """Tracks whose points are in the base frame."""
    base_from_camera: Float[ndarray, "n 4 4"]
    """True poses of the cameras."""
    gripper_from_camera: Float[ndarray, "4 4"]
    """Transform before a slip; the effective one where poses are bent."""
    gripper_from_camera_after: Float[ndarray, "4 4"]
    """Transform after a slip; that of the true poses where reported ones are bent."""
    intrinsics: Intrinsics
    """Believed intrinsics."""


def faulty_capture(rng: np.random.Generator, images: int = 12, faults: Faults = Faults()) -> FaultyCapture:
    """Draw varied views of a table with relief, in the order in which an arm would go through them."""
    x = random_hand_eye(rng)
    true = gripper_poses("varied", images, TARGET_IN_BASE, x, rng)
    mounts, pushes = moved_parts(x, images, faults, rng)
    cameras = pushes @ true @ mounts
    reported = disturbed(reported_poses(true, faults), faults.robot_noise, rng)
    points = rng.uniform(LOW, HIGH, (POINTS, 3))
    depth = np.median(
        np.einsum("nij,pj->npi", inverse(cameras)[:, 2:], np.insert(points, 3, 1.0, 1))[..., 0], 1
    )
    optics = optics_of(faults, INTRINSICS, depth, rng)
    image, point, x_px = shown_points(
        points, cameras, [INTRINSICS] * images, NOISE_PX, rng, pixels=lambda k, at: optics[k].taken(at)
    )
    effective, last = x, mounts[-1]
    if faults.is_bent:
        captures = -(-EFFECTIVE_POSES // images)
        others = [gripper_poses("varied", images, TARGET_IN_BASE, x, rng) for _ in range(captures)]
        effective, last = effective_transform(np.concatenate(others), x, faults), x
    return FaultyCapture(
        base_from_gripper=reported,
        tracks=Tracks(image=image, x_px=x_px, point=point, points_in_recon=points),
        base_from_camera=cameras,
        gripper_from_camera=effective,
        gripper_from_camera_after=last,
        intrinsics=INTRINSICS,
    )


# Mount and robot.


def moved_parts(
    x: Float[ndarray, "4 4"], count: int, faults: Faults, rng: np.random.Generator
) -> tuple[Poses, Poses]:
    """Draw gripper_from_camera of each image after slip or drift of the camera, and the motion of the robot's base."""
    axes = rng.normal(size=(2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)

    def step(size: tuple[float, float], share: Float[ndarray, " n"]) -> Poses:
        about, along = (share[:, None] * one for one in axes)
        return transform(rotation_exp(size[1] * about), size[0] * along)

    order = np.arange(count)
    if any(faults.drift):
        mounts = x @ step(faults.drift, np.linspace(-0.5, 0.5, count))
    else:
        mounts = x @ step(faults.slip, 1.0 * (order >= round(faults.slip_after * count)))
    return mounts, step(faults.base_moved, 1.0 * (order >= count / 2))


def reported_poses(true: Poses, faults: Faults) -> Poses:
    """Return the poses that a robot with these faults reports, without independent errors."""
    reported = _late(true, faults.delay_s, faults.view_s) if faults.delay_s else true
    reach = reported[:, :3, 3] * [1.0, 1.0, 0.0]
    lean = faults.tilt_by_reach * np.cross([0.0, 0.0, 1.0], reach)
    gravity = -reported[:, 2, :3]
    sag = faults.sag * np.cross([0.0, 0.0, 1.0], gravity)
    straight = (
        transform(rotation_exp(-lean), np.zeros(3)) @ reported @ transform(rotation_exp(-sag), np.zeros(3))
    )
    straight[:, :3, 3] *= faults.pose_scale * (1 + np.array(faults.lengths))
    return straight


def effective_transform(true: Poses, x: Float[ndarray, "4 4"], faults: Faults) -> Float[ndarray, "4 4"]:
    """Fit the gripper_from_camera by which reported poses best predict cameras that are mounted by `x`."""
    fit = fit_known_scale(reported_poses(true, faults), true @ x, (x, np.eye(4)), EFFECTIVE_NOISE)
    return fit.gripper_from_camera


def _late(true: Poses, delay_s: float, view_s: float) -> Poses:
    """Return the poses, `delay_s` later, of an arm that moves through `true` without a stop, one every `view_s`."""
    at = view_s * np.arange(len(true))
    position = CubicSpline(at, true[:, :3, 3])(at + delay_s)
    rotation = RotationSpline(at, Rotation.from_matrix(true[:, :3, :3]))(at + delay_s)
    return transform(rotation.as_matrix(), position)


# Camera.


@dataclass(frozen=True, kw_only=True)
class Optics:
    """Real camera of one image beside the believed one."""

    believed: Intrinsics
    real: Intrinsics
    faults: Faults
    shift_px: Float[ndarray, "2"]

    def taken(self, x_in_camera: Float[ndarray, "k 3"]) -> Float[ndarray, "k 2"]:
        """Return the pixels at which the real camera shows points."""
        x_px = project(self.real, x_in_camera)
        x_px[:, 0] += self._rolled(x_px)
        return x_px + self._bent(x_in_camera[:, :2] / x_in_camera[:, 2:]) + self.shift_px

    def believed_from_px(self, x_px: Float[ndarray, "h w 2"]) -> Float[ndarray, "h w 2"]:
        """Return where the believed camera has the content of a pixel of the real one, the prism to first order."""
        x_px = x_px - self.shift_px
        ray = unproject(self.real, x_px)
        x_px = x_px - self._bent(ray[..., :2] / ray[..., 2:])
        x_px[..., 0] -= self._rolled(x_px)
        return project(self.believed, unproject(self.real, x_px))

    def _rolled(self, x_px: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n"]:
        """Shift (px) by a rolling shutter."""
        return self.faults.rolling_px * (x_px[..., 1] / self.believed.height - 0.5)

    def _bent(self, ray: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n 2"]:
        """Displacements (px) of rays (x, y, 1) by OpenCV's thin prism."""
        s, r2 = self.faults.prism, (ray**2).sum(-1)
        return self.real.fx * np.stack([s[0] * r2 + s[1] * r2**2, s[2] * r2 + s[3] * r2**2], axis=-1)


def optics_of(
    faults: Faults,
    believed: Intrinsics,
    depth: Float[ndarray, " n"],
    rng: np.random.Generator,
) -> list[Optics]:
    """Draw the optics of each image; `depth` (m) is the distance of its scene."""
    count = len(depth)
    share = (depth - depth.mean()) / max(float(np.ptp(depth)), 1e-9)
    focal = np.exp(faults.focal_by_distance * share + faults.focal_scatter * rng.normal(size=count))
    focal *= np.where(np.arange(count) < count / 2, 1.0, 1 + faults.zoom)
    off = dict(faults.intrinsics)
    real = with_parameters(
        believed, parameters(believed) + np.array([off.get(name, 0.0) for name in parameter_names(believed)])
    )
    shift = np.zeros((count, 2))
    if faults.centre_scatter_px:
        shift = faults.centre_scatter_px * rng.normal(size=(count, 2))
    return [
        Optics(believed=believed, real=zoomed(real, float(one)), faults=faults, shift_px=by)
        for one, by in zip(focal, shift, strict=True)
    ]


# Structure from motion.


def reconstructed(found: FaultyCapture, estimated: bool) -> tuple[Capture, Reconstruction]:
    """Return the capture, and the reconstruction that structure from motion gives of its observations.

    The intrinsics are the believed ones, or `estimated`.
    """
    cameras, m = found.base_from_camera, len(found.base_from_camera)
    start = np.eye(4), 1.0, np.eye(4)
    free = camera_with_prior(found.intrinsics, ESTIMATED if estimated else FIXED)
    sfm = solve(*wrist_problem(wrist_arm(cameras), start, cameras, free, found.tracks, noise=LOOSE))
    state = sfm.state
    intrinsics, x = sfm.problem.intrinsics(state)[0], state.x[0]
    rigs = predicted_gripper_poses(x, state.scale, state.z[0], state.world_from_rig)
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
