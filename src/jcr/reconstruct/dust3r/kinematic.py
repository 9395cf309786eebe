"""Kinematic alignment: the cameras are not free, they are base_from_gripper[i] · gripper_from_camera.

The unknowns of global alignment's cameras, 6 per image and only up to a similarity, become one
`gripper_from_camera` and small corrections of the gripper poses under the robot's own noise. The robot's
motion then sets the metric scale inside the alignment, pair scales included, instead of after it.
"""

import time
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import InputError
from jcr.geometry import inverse, nearest_rotation, rotation_log, skew, transform
from jcr.progress import Progress
from jcr.reconstruct.dust3r.align_equations import Layout, adjoint
from jcr.reconstruct.dust3r.align_fast import (
    FINE_TOLERANCE,
    Problem,
    dense_alignment,
    gauss_newton,
    moved,
    solve_free,
)
from jcr.reconstruct.dust3r.align_observations import weight_is_log
from jcr.reconstruct.dust3r.alignment import (
    Alignment,
    AlignOptions,
    check_connected,
    check_options,
    pinhole_of,
)
from jcr.reconstruct.dust3r.pairs import PairPredictions

VAGUE = 10.0
"""One-sigma prior (m, rad) of gripper_from_camera: says nothing, yet keeps unobservable motions solvable."""

STRAIN = 4.0
"""Standard deviations by which a gripper pose may move before the user is told."""


@dataclass(frozen=True)
class KinematicOptions:
    """How camera poses are tied to the gripper poses."""

    robot_translation: float = 0.0005
    """One-sigma noise of the gripper positions per axis, metres; 0 holds them."""
    robot_rotation: float = 0.0017
    """One-sigma noise of the gripper orientations per axis, radians; 0 holds them."""
    align: AlignOptions = field(default_factory=AlignOptions)


@dataclass(frozen=True)
class KinematicAlignment:
    """A reconstruction in the robot's base frame, in metres, with the hand-eye transform that made it."""

    gripper_from_camera: Float[ndarray, "4 4"]
    scale: float
    """Metres per unit of the free alignment, which is the geometric mean of the pairs' units."""
    base_from_gripper: Float[ndarray, "n 4 4"]
    """Corrected within the robot's noise."""
    covariance: Float[ndarray, "7 7"]
    """Of gripper_from_camera and log scale, in the order of `records.COVARIANCE_ORDER`."""
    alignment: Alignment
    """Here the recon frame is the base frame, in metres."""


class HandEyeCameras:
    """Cameras on a gripper: base_from_camera[i] = base_from_gripper[i] · gripper_from_camera."""

    def __init__(
        self,
        base_from_gripper: Float[ndarray, "n 4 4"],
        gripper_from_camera: Float[ndarray, "4 4"],
        options: KinematicOptions,
    ) -> None:
        self.measured = base_from_gripper
        self.base_from_gripper = base_from_gripper
        self.gripper_from_camera = gripper_from_camera
        spread = np.repeat([options.robot_translation, options.robot_rotation], 3)
        self.held = spread == 0
        self.information = np.where(self.held, 0.0, 1.0 / np.where(self.held, 1.0, spread) ** 2)
        self.normal = np.zeros((0, 0))

    @property
    def recon_from_camera(self) -> Float[ndarray, "n 4 4"]:
        """In the base frame."""
        return self.base_from_gripper @ self.gripper_from_camera

    def step(
        self, layout: Layout, hessian: Float[ndarray, "p p"], gradient: Float[ndarray, " p"]
    ) -> Float[ndarray, " p"]:
        """Solve the reduced normal equations, move the cameras, and return the step of all unknowns.

        Unknowns in turn: a twist of gripper_from_camera and one of each gripper pose, both in gripper axes,
        then what `layout` has beside cameras. Either twist moves camera i by Ad(base_from_gripper[i]) of it.
        """
        images = layout.images
        rest = layout.size - 6 * images
        to_base = adjoint(self.base_from_gripper)
        jacobian = np.zeros((layout.size, 6 + layout.size))
        for k in range(images):
            rows = slice(6 * k, 6 * k + 6)
            jacobian[rows, :6] = to_base[k]
            jacobian[rows, 6 + 6 * k : 12 + 6 * k] = to_base[k]
        jacobian[6 * images :, 6 + 6 * images :] = np.eye(rest)
        prior = np.concatenate([np.full(6, VAGUE**-2), np.tile(self.information, images), np.zeros(rest)])
        free = np.concatenate([np.ones(6, bool), np.tile(~self.held, images), np.ones(rest, bool)])
        pull = np.concatenate([np.zeros(6), (self.information * self.deviation()).ravel(), np.zeros(rest)])

        self.normal = (jacobian.T @ hessian @ jacobian + np.diag(prior))[np.ix_(free, free)]
        full = np.zeros(6 + layout.size)
        full[free] = -np.linalg.solve(self.normal, (jacobian.T @ gradient + pull)[free])
        self.gripper_from_camera = moved(self.gripper_from_camera[None], full[None, :6])[0]
        correction = moved(np.tile(np.eye(4), (images, 1, 1)), full[6 : 6 + 6 * images].reshape(-1, 6))
        self.base_from_gripper = self.base_from_gripper @ correction
        return jacobian @ full

    def deviation(self) -> Float[ndarray, "n 6"]:
        """How far the gripper poses have moved from the measured ones, in gripper axes."""
        gap = inverse(self.measured) @ self.base_from_gripper
        return np.concatenate([gap[:, :3, 3], rotation_log(gap[:, :3, :3])], axis=1)


def align_kinematic(
    predictions: PairPredictions,
    base_from_gripper: Float[ndarray, "n 4 4"],
    options: KinematicOptions | None = None,
    gripper_from_camera: Float[ndarray, "4 4"] | None = None,
    progress: Progress | None = None,
) -> KinematicAlignment:
    """Solve for gripper_from_camera and the reconstruction together, gripper poses under the robot's noise.

    The start is a free alignment and a hand-eye transform in closed form, or the one given. Motions that
    leave a direction unobservable show in the covariance. Raises InputError as `align` does, and where there
    are fewer than 3 images, or gripper poses of another number.
    """
    options = options or KinematicOptions()
    begin = time.perf_counter()
    check_options(options.align)
    check_connected(predictions)
    count = predictions.image_count
    if len(base_from_gripper) != count:
        raise InputError(f"{len(base_from_gripper)} gripper poses for {count} images; give one for each")
    if count < 3:
        raise InputError(f"kinematic alignment needs 3 images or more, there are {count}; take more")
    problem = Problem(predictions, pinhole_of(predictions, options.align), weight_is_log(predictions))
    free = solve_free(problem, options.align)
    start, scale = hand_eye_from_motions(base_from_gripper, free.state.recon_from_camera)
    cameras = HandEyeCameras(
        base_from_gripper, start if gripper_from_camera is None else gripper_from_camera, options
    )
    to_metres = np.repeat([scale, 1.0], 3)
    state = replace(
        free.state,
        recon_from_camera=cameras.recon_from_camera,
        log_depth=[log_depth + np.log(scale) for log_depth in free.state.log_depth],
        log_pair_scale=free.state.log_pair_scale + np.log(scale),
        pair_error=free.state.pair_error * to_metres,
    )
    spread = free.pair_spread * to_metres
    solution = gauss_newton(free.images, state, problem.layout, cameras, spread, FINE_TOLERANCE)
    alignment = dense_alignment(problem, solution, begin, progress)
    notes = (*alignment.notes, *_strained(cameras, predictions))
    return KinematicAlignment(
        gripper_from_camera=cameras.gripper_from_camera,
        scale=float(np.exp(solution.state.log_pair_scale.mean())),
        base_from_gripper=cameras.base_from_gripper,
        covariance=_hand_eye_covariance(cameras, len(predictions.edges)),
        alignment=replace(alignment, method="kinematic", notes=notes),
    )


def _strained(cameras: HandEyeCameras, predictions: PairPredictions) -> tuple[str, ...]:
    """A note that names the images whose gripper pose had to move further than the robot's noise explains."""
    sigmas = np.abs(cameras.deviation()) * np.sqrt(cameras.information)
    strained = np.flatnonzero(sigmas.max(axis=1) > STRAIN)
    if not len(strained):
        return ()
    names = [predictions.images[k] if predictions.images else f"#{k}" for k in strained]
    return (
        f"the pictures contradict the gripper poses of {', '.join(names)} by up to {sigmas.max():.0f} times the "
        "robot's noise; these poses are wrong, or --robot-noise is too small",
    )


def hand_eye_from_motions(
    base_from_gripper: Float[ndarray, "n 4 4"], recon_from_camera: Float[ndarray, "n 4 4"]
) -> tuple[Float[ndarray, "4 4"], float]:
    """gripper_from_camera and scale from all motions: rotation after Park and Martin (1994), then one least
    squares for translation and scale (the paper's scale recovery problem, without its grid)."""
    i, j = np.triu_indices(len(base_from_gripper), 1)
    a = inverse(base_from_gripper[i]) @ base_from_gripper[j]
    b = inverse(recon_from_camera[i]) @ recon_from_camera[j]
    rotation = nearest_rotation(rotation_log(a[:, :3, :3]).T @ rotation_log(b[:, :3, :3]))
    moved_by = b[:, :3, 3] @ rotation.T
    left = np.concatenate([a[:, :3, :3] - np.eye(3), -moved_by[:, :, None]], axis=2)
    solution = np.linalg.lstsq(left.reshape(-1, 4), -a[:, :3, 3].ravel(), rcond=1e-10)[0]
    scale = float(solution[3])
    if scale <= 0:
        # Motions that do not show the scale: their lengths at least bound it.
        scale = float(np.linalg.norm(a[:, :3, 3]) / max(np.linalg.norm(moved_by), 1e-12))
    return transform(rotation, solution[:3]), scale


def _hand_eye_covariance(cameras: HandEyeCameras, pairs: int) -> Float[ndarray, "7 7"]:
    """From the twist of gripper_from_camera and the log pair scales to the order of COVARIANCE_ORDER."""
    functional = np.zeros((7, len(cameras.normal)))
    functional[:6, :6] = np.eye(6)
    functional[:3, 3:6] = -skew(cameras.gripper_from_camera[:3, 3])
    functional[6, -pairs:] = 1.0 / pairs
    return functional @ np.linalg.solve(cameras.normal, functional.T)
