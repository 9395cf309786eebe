"""How far apart two calibrations are."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import step_between


@dataclass(frozen=True)
class Difference:
    """From one gripper_from_camera to a reference, in gripper axes."""

    translation_m: Float[ndarray, "3"]
    rotation_vector: Float[ndarray, "3"]
    """rad: R_reference = exp(r)·R."""
    sigmas: Float[ndarray, "6"] | None
    """Size on each axis in the standard deviations that the first one reports; None where it reports none."""


def difference(
    gripper_from_camera: Float[ndarray, "4 4"],
    covariance: Float[ndarray, "7 7"] | None,
    reference: Float[ndarray, "4 4"],
) -> Difference:
    """The difference of a reference from a calibration, whose covariance is in records.COVARIANCE_ORDER."""
    step = step_between(gripper_from_camera, reference)
    sigmas = None if covariance is None else np.abs(step) / np.sqrt(np.diag(covariance)[:6])
    return Difference(step[:3], step[3:], sigmas)
