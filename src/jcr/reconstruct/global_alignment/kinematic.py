"""Kinematic alignment: the cameras are not free, they are base_from_gripper[i] · gripper_from_camera.

The unknowns of global alignment's cameras, 6 per image and only up to a similarity, become one
`gripper_from_camera` and small corrections of the gripper poses under the robot pose noise. The robot's
motion then sets the metric scale inside the alignment, pair scales included, instead of after it.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.closed_form import initial_estimate
from jcr.estimation.systematic import REACH
from jcr.geometry import inverse, retract, scale_translation, skew, step_axes, step_between
from jcr.reconstruct.global_alignment.gauss_newton import (
    FINE_TOLERANCE,
    NORMAL_SQUARE_MEDIAN,
    Problem,
    Solution,
    gauss_newton,
)
from jcr.reconstruct.global_alignment.normal_equations import Layout
from jcr.reconstruct.global_alignment.pairs import PairPredictions
from jcr.reconstruct.global_alignment.pointmap_residuals import State

VAGUE = 10.0
"""One-sigma prior (m, rad) of gripper_from_camera: vague, yet it keeps unobservable motions solvable."""

STRAIN = 5.0
"""Standard deviations by which a gripper pose may move before the user is warned."""
START_NOISE = 0.001
"""Robot pose noise (rad) until it is estimated."""
LEAST_NOISE = 1e-5
"""rad: a tenth of what the best arm repeats."""


class HandEyeCameras:
    """Cameras on a gripper: base_from_camera[i] = base_from_gripper[i] · gripper_from_camera."""

    def __init__(
        self, base_from_gripper: Float[ndarray, "n 4 4"], gripper_from_camera: Float[ndarray, "4 4"]
    ) -> None:
        self.measured = base_from_gripper
        self.base_from_gripper = base_from_gripper
        self.gripper_from_camera = gripper_from_camera
        self.spread = np.repeat([REACH * START_NOISE, START_NOISE], 3)
        """One sigma of the gripper poses' errors, estimated in each step: translation, rotation."""
        self.normal = self.jacobian = np.zeros((0, 0))

    @property
    def recon_from_camera(self) -> Float[ndarray, "n 4 4"]:
        """In the base frame."""
        return self.base_from_gripper @ self.gripper_from_camera

    @property
    def information(self) -> Float[ndarray, "6"]:
        """Inverse variance of the gripper poses' errors."""
        return 1.0 / self.spread**2

    def step(
        self, layout: Layout, hessian: Float[ndarray, "p p"], gradient: Float[ndarray, " p"]
    ) -> Float[ndarray, " p"]:
        """Solve the reduced normal equations, move the cameras, and return the step of all unknowns.

        Unknowns in this order: a step of gripper_from_camera and one of each gripper pose, both in gripper axes, then
        what `layout` has beside cameras. A rotation of the gripper carries the camera along, one of the camera on it
        does not.
        """
        images = layout.images
        rest = layout.size - 6 * images
        to_base = step_axes(self.base_from_gripper[:, :3, :3])
        carried = np.eye(6)
        carried[:3, 3:] = -skew(self.gripper_from_camera[:3, 3])
        jacobian = np.zeros((layout.size, 6 + layout.size))
        for k in range(images):
            rows = slice(6 * k, 6 * k + 6)
            jacobian[rows, :6] = to_base[k]
            jacobian[rows, 6 + 6 * k : 12 + 6 * k] = to_base[k] @ carried
        jacobian[6 * images :, 6 + 6 * images :] = np.eye(rest)
        prior = np.concatenate([np.full(6, VAGUE**-2), np.tile(self.information, images), np.zeros(rest)])
        pull = np.concatenate([np.zeros(6), (self.information * self.deviation()).ravel(), np.zeros(rest)])

        self.normal = jacobian.T @ hessian @ jacobian + np.diag(prior)
        self.jacobian = jacobian[: 6 * images]
        full = -np.linalg.solve(self.normal, jacobian.T @ gradient + pull)
        self.gripper_from_camera = retract(self.gripper_from_camera, full[:6])
        correction = to_base @ full[6 : 6 + 6 * images].reshape(-1, 6, 1)
        self.base_from_gripper = retract(self.base_from_gripper, correction[..., 0])
        variance = np.linalg.inv(self.normal).diagonal()[6 : 6 + 6 * images].reshape(-1, 6)
        self.spread = self._estimated_spread(variance)
        return jacobian @ full

    def _estimated_spread(self, variance: Float[ndarray, "n 6"]) -> Float[ndarray, "6"]:
        """The evidence fixed point, as for the pairs' errors: wrong gripper poses do not count."""
        arm = np.repeat([REACH, 1.0], 3)
        determined = 1.0 - np.median(variance / self.spread**2)
        squared = np.median((self.deviation() / arm) ** 2) / NORMAL_SQUARE_MEDIAN
        return arm * max(np.sqrt(squared / max(determined, 0.05)), LEAST_NOISE)

    def covariance(self) -> Float[ndarray, "r r"]:
        """Of the cameras' steps, r = 6n, from the equations of the last one."""
        return self.jacobian @ np.linalg.solve(self.normal, self.jacobian.T)

    def strain(self) -> Float[ndarray, " n"]:
        """By how many standard deviations of the robot pose noise each gripper pose had to move, at most."""
        return np.abs(self.deviation() * np.sqrt(self.information)).max(axis=1)

    def deviation(self) -> Float[ndarray, "n 6"]:
        """How far the gripper poses have moved from the measured ones, in gripper axes."""
        return step_between(np.eye(4), inverse(self.measured) @ self.base_from_gripper)


def solve_kinematic(
    problem: Problem, free: Solution, base_from_gripper: Float[ndarray, "n 4 4"]
) -> tuple[Solution, HandEyeCameras]:
    """Kinematic alignment, base frame and metres, from a free one; raises as `gauss_newton` does."""
    start, scale, _ = initial_estimate(base_from_gripper, free.state.recon_from_camera)
    cameras = HandEyeCameras(base_from_gripper, start)
    state = replace(rescaled(free.state, scale), recon_from_camera=cameras.recon_from_camera)
    spread = free.pair_spread * np.repeat([scale, 1.0], 3)
    solution = gauss_newton(free.images, state, problem.layout, cameras, spread, FINE_TOLERANCE)
    return solution, cameras


def rescaled(state: State, factor: float) -> State:
    """The same state with all lengths multiplied."""
    return replace(
        state,
        recon_from_camera=scale_translation(state.recon_from_camera, factor),
        log_depth=[log_depth + np.log(factor) for log_depth in state.log_depth],
        log_pair_scale=state.log_pair_scale + np.log(factor),
        pair_error=state.pair_error * np.repeat([factor, 1.0], 3),
    )


def contradictions(cameras: HandEyeCameras, predictions: PairPredictions) -> tuple[str, ...]:
    """A warning that names the images whose gripper pose had to move further than the robot pose noise explains.

    That noise is estimated, and four images or fewer cannot tell a wrong pose from a bad robot.
    """
    strain = cameras.strain()
    if strain.max() <= STRAIN or len(strain) < 5:
        return ()
    names = ", ".join(predictions.names[k] for k in np.flatnonzero(strain > STRAIN))
    return (
        f"the images contradict the gripper poses of {names} by up to {strain.max():.0f} times the "
        "robot pose noise; these poses are wrong",
    )
