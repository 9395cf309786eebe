"""What is known of a camera before its images are asked: intrinsics that were measured once, or those of any camera."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import parameter_names
from jcr.records import Intrinsics

MEASURED = {
    "f": 5e-3,
    "aspect": 1e-3,
    "cx": 5e-3,
    "cy": 5e-3,
    "k1": 0.02,
    "k2": 0.05,
    "k3": 0.1,
    "p1": 1e-3,
    "p2": 1e-3,
}
"""Standard deviations of intrinsics that were given without any: focal length and its aspect relative, principal point
relative to the width, distortion absolute. Factory values and calibrations of another day are off by 0.3 to 0.9 % and a
few pixels (jcr docs architecture)."""
ESTIMATED = {
    "f": 0.5,
    "aspect": 3e-3,
    "cx": 0.02,
    "cy": 0.02,
    "k1": 0.3,
    "k2": 0.3,
    "k3": 0.3,
    "p1": 3e-3,
    "p2": 3e-3,
}
"""Of a cheap camera that nobody calibrated, about what the reconstruction found."""
FIXED: dict[str, float] = {}
"""Of intrinsics that are exact."""
LEAST = 1e-12
"""A standard deviation below it leaves a parameter as it is."""


@dataclass(frozen=True)
class IntrinsicsPrior:
    """Independent directions in which intrinsics may differ from where they start, with their standard deviations."""

    directions: Float[ndarray, "q c"]
    """In the order of camera.parameters."""
    std: Float[ndarray, " c"]


def prior_of(
    intrinsics: Intrinsics, std: dict[str, float] | Float[ndarray, " q"] = MEASURED
) -> IntrinsicsPrior:
    """The prior about `intrinsics`: relative sizes as in MEASURED, or a standard deviation for each of its `parameters`.

    One that is not a number is that of MEASURED. Coefficients that a distortion model does not have are left out.
    """
    if not isinstance(std, dict):
        usual = prior_of(intrinsics)
        spread = np.sqrt(usual.directions**2 @ usual.std**2)
        std = np.where(np.isnan(std), spread, std)
        free = np.flatnonzero(std > LEAST)
        return IntrinsicsPrior(np.eye(len(std))[:, free], std[free])
    fx, fy, width = intrinsics.fx, intrinsics.fy, intrinsics.width
    moves = {
        "f": {"fx": fx, "fy": fy},
        "aspect": {"fx": fx / 2, "fy": -fy / 2},
        "cx": {"cx": width},
        "cy": {"cy": width},
    }
    names = parameter_names(intrinsics)
    known = {name: value for name, value in std.items() if name in moves or name in names}
    directions = np.zeros((len(names), len(known)))
    for column, name in enumerate(known):
        for parameter, unit in moves.get(name, {name: 1.0}).items():
            directions[names.index(parameter), column] = unit
    return IntrinsicsPrior(directions, np.array(list(known.values())))


def prior_about(found: Intrinsics, given: bool, std: Float[ndarray, " q"] | None = None) -> IntrinsicsPrior:
    """Of a camera whose intrinsics were given, with standard deviations or not, or were found by the reconstruction."""
    if not given:
        return prior_of(found, ESTIMATED)
    return prior_of(found, MEASURED if std is None else std)
