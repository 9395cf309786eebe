"""Interface of the tests of effects to one camera of an adjustment: that of a capture, or a further one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.adjust import adjust_case, focal_of_each
from jcr.calibration.case import Case
from jcr.estimation.intrinsics_prior import Camera
from jcr.estimation.problem import State
from jcr.estimation.score_test import first_x
from jcr.estimation.solve import Solution
from jcr.estimation.wrist import estimate_of
from jcr.records import Intrinsics

Combinations = Float[ndarray, "e p"]
"""Combinations of the columns of score_test.Alternatives."""


@dataclass(frozen=True, kw_only=True)
class CameraAdjustment:
    """Camera of an adjustment, and the function that adjusts its images again with more of it free."""

    adjusted: Solution
    adjust: Callable[[Camera, Combinations | None, Float[ndarray, "s b"] | None], Solution]
    """Adjust all images with another prior of this camera's intrinsics, with combinations of its columns free, and with
    errors of one standard deviation of the gripper poses."""
    names: Sequence[str]
    """Names of its images."""
    start: Intrinsics
    """Intrinsics that were given, or that the reconstruction estimated."""
    is_given: bool
    prior: Camera
    std: Float[ndarray, "6"]
    """Standard deviations of the camera's pose; 0 where it is rejected."""
    answer: Callable[[Solution], tuple[Float[ndarray, "4 4"], float]]
    """Function that returns the camera's pose by an adjustment, and the scale."""
    camera: int = 0
    """Number of the camera among the adjusted ones."""
    place: Callable[[State], Float[ndarray, "4 4"]] = first_x
    """Function that returns the camera's pose on its parent."""
    arm: int | None = 0
    """Number of the arm whose gripper poses are tested with the camera; None where another camera's test has them."""
    free: Combinations | None = None
    """Combinations that are free in `adjusted`."""

    @property
    def rows_of_arm(self) -> slice:
        """Rows of the equations of the gripper poses that are those of the arm."""
        counts = [6 * len(one.rigs) for one in self.adjusted.problem.arms]
        begin = sum(counts[: self.arm])
        return slice(begin, begin + counts[self.arm or 0])

    @property
    def images(self) -> Int[ndarray, " m"]:
        """Rows of the camera's images among the adjusted ones."""
        assert self.adjusted.problem.observations is not None
        return np.flatnonzero(self.adjusted.problem.observations.camera == self.camera)

    @property
    def x_px(self) -> Float[ndarray, "k 2"]:
        """Pixels of the points that were observed in its images."""
        assert self.adjusted.problem.observations is not None
        return self.adjusted.problem.observations.x_px[self.adjusted.problem.camera_rows[self.camera]]


def of_case(case: Case) -> CameraAdjustment:
    """Return the capture's own camera."""
    assert case.adjusted is not None

    def answer(adjusted: Solution) -> tuple[Float[ndarray, "4 4"], float]:
        estimate = estimate_of(adjusted, case.tracks)
        return estimate.gripper_from_camera, estimate.scale

    return CameraAdjustment(
        adjusted=case.adjusted,
        adjust=lambda prior, combinations, bent: adjust_case(
            case, prior=prior, combinations=combinations, confirmed_errors=bent
        ),
        names=[case.names[row] for row in case.used],
        start=case.reconstruction.intrinsics,
        is_given=case.capture.intrinsics is not None,
        prior=case.camera,
        std=np.sqrt(np.diag(case.hand_eye.covariance)[:6]) * case.hand_eye.converged,
        answer=answer,
        free=focal_of_each(case) if case.options.focus == "varies" else None,
    )
