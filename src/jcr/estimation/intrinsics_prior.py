"""Cameras with the prior distribution of their intrinsics."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import parameter_names
from jcr.geometry import Transform
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
    "s1": 1e-3,
    "s2": 1e-3,
    "s3": 1e-3,
    "s4": 1e-3,
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
"""Standard deviations of intrinsics that a reconstruction estimated, of a cheap camera."""
PRISM = {"cx": 0.02, "cy": 0.02, "p1": 0.03, "p2": 0.03, "s1": 0.1, "s2": 0.1, "s3": 0.1, "s4": 0.1}
"""Standard deviations of what a thin prism trades against, once the images show one: 23 px of a real camera are 0.05.
A board's intrinsics without prism terms know the principal point to 3 px, with these terms to 39 px."""
DECENTRING = 1e-3
"""Standard deviation of the thin prism coefficients of a camera that nobody calibrated: as large as the tangential
distortion of factory calibrations."""
FIXED: Mapping[str, float] = {}
"""Standard deviations of exact intrinsics: no parameter is free."""
LEAST = 1e-12
"""Standard deviation below which a parameter is fixed."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraPrior:
    """A camera, independent directions in which its intrinsics may differ, and their standard deviations."""

    intrinsics: Intrinsics
    """Middle of the prior."""
    directions: Float[ndarray, "q c"]
    """Directions of the parameters, in the order of camera.parameters."""
    std: Float[ndarray, " c"]
    mount_free: bool = False
    """Whether its pose on the rig is estimated."""


def camera_with_prior(
    intrinsics: Intrinsics, std: Mapping[str, float] | Float[ndarray, " q"] = MEASURED
) -> CameraPrior:
    """Return the camera with relative standard deviations as in MEASURED, or one for each of its `parameters`.

    One that is not a number is that of MEASURED. Coefficients that the distortion model does not have are left out.
    """
    if isinstance(std, ndarray):
        usual = camera_with_prior(intrinsics)
        std = np.where(np.isnan(std), np.sqrt(usual.directions**2 @ usual.std**2), std)
        free = np.flatnonzero(std > LEAST)
        return CameraPrior(intrinsics=intrinsics, directions=np.eye(len(std))[:, free], std=std[free])
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
    return CameraPrior(intrinsics=intrinsics, directions=directions, std=np.array(list(known.values())))


def camera_about(found: Intrinsics, given: bool, std: Float[ndarray, " q"] | None = None) -> CameraPrior:
    """Return a camera whose intrinsics were given, with standard deviations or not, or were estimated."""
    if not given:
        return camera_with_prior(found, ESTIMATED)
    return camera_with_prior(found, MEASURED if std is None else std)


def decentring(camera: Intrinsics, x: Transform) -> Float[ndarray, "r 2"]:
    """Return the steps of X, log scale and intrinsics that no image distinguishes from a thin prism in x and in y.

    To second order in the image, a prism that displaces x by s · r² is p2 = s with the principal point moved by
    2 · s · fx and the camera rotated by 2 · s about its y axis; in y alike. One standard deviation each, r = 7 + q: that
    of DECENTRING or, where the estimated tangential distortion is larger, its size, since one defect of the optics
    causes both.
    """
    names = parameter_names(camera)
    out = np.zeros((7 + len(names), 2))
    for column, (tangential, centre, focal, axis) in enumerate(
        (("p2", "cx", camera.fx, x[:3, 1]), ("p1", "cy", camera.fy, -x[:3, 0]))
    ):
        size = max(DECENTRING, abs(camera.distortion[names.index(tangential) - 4]))
        out[3:6, column] = 2 * size * axis
        out[7 + names.index(centre), column] = 2 * size * focal
        out[7 + names.index(tangential), column] = size
    return out
