"""One camera among those of an adjustment, as the checks of a camera take it: that of a capture, or a further one."""

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
"""Of the columns of score_test.Alternatives."""


@dataclass(frozen=True, kw_only=True)
class Imaged:
    """One camera, and how its images are adjusted again with more of it free."""

    adjusted: Solution
    adjust: Callable[[Camera, Combinations | None, Float[ndarray, "s b"] | None], Solution]
    """Adjust all images with another prior of this camera's intrinsics, with combinations of its columns free, and with
    errors of one standard deviation of the gripper poses."""
    names: Sequence[str]
    """Of its images."""
    start: Intrinsics
    """Those that were given, or that the reconstruction found."""
    is_given: bool
    prior: Camera
    std: Float[ndarray, "6"]
    """Of the camera's place; 0 where it is rejected, for then no fault is small."""
    answer: Callable[[Solution], tuple[Float[ndarray, "4 4"], float]]
    """That place as an adjustment has it, and the scale."""
    camera: int = 0
    """Its number among the adjusted."""
    place: Callable[[State], Float[ndarray, "4 4"]] = first_x
    """Where it is on its parent."""
    arm: int | None = 0
    """Number of the arm whose gripper poses are tested with the camera; None where another camera's test has them."""
    free: Combinations | None = None
    """That `adjusted` has free."""

    @property
    def rows_of_arm(self) -> slice:
        """Rows of the equations of the gripper poses that are those of the arm."""
        counts = [6 * len(one.rigs) for one in self.adjusted.problem.arms]
        begin = sum(counts[: self.arm])
        return slice(begin, begin + counts[self.arm or 0])

    @property
    def images(self) -> Int[ndarray, " m"]:
        """Rows of its images among the adjusted."""
        assert self.adjusted.problem.observations is not None
        return np.flatnonzero(self.adjusted.problem.observations.camera == self.camera)

    @property
    def x_px(self) -> Float[ndarray, "k 2"]:
        """Pixels of the points that were observed in its images."""
        assert self.adjusted.problem.observations is not None
        return self.adjusted.problem.observations.x_px[self.adjusted.problem.camera_rows[self.camera]]


def of_case(case: Case) -> Imaged:
    """A capture's own camera."""
    assert case.adjusted is not None

    def answer(adjusted: Solution) -> tuple[Float[ndarray, "4 4"], float]:
        estimate = estimate_of(adjusted, case.tracks)
        return estimate.gripper_from_camera, estimate.scale

    return Imaged(
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
