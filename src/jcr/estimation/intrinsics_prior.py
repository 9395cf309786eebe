"""Prior distribution of a camera's intrinsics, and of the error that its model leaves beside them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.polynomial.legendre import legvander2d

from jcr.camera import by_parameters, parameter_names, unproject
from jcr.geometry import Transform
from jcr.records import COVARIANCE_ORDER, Intrinsics, JointCovariance, ModelError

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
relative to the width, distortion absolute. Factory values are off by 0.3 to 0.9 % and a few pixels."""
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
"""Standard deviations of what a thin prism trades against, once the images show one: 23 px of a real camera are 0.05."""
DECENTRING = 1e-3
"""Standard deviation of thin prism coefficients that nobody calibrated: tangential distortion at the factory."""
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


DEGREE, POLYNOMIALS = 5, 42
"""Total degree of the polynomials, and their number."""
TYPICAL = 1e-4
"""Middle of the weak prior of the size of each polynomial, in widths of the image."""
UPDATES, SETTLED = 100, 1e-3
"""Most updates of the size, and the relative change of its square that ends them."""
WORTH = 2.0
"""Polynomials that the typical size counts for, beside those that the images determine."""


def displacements(
    camera: Intrinsics, directions: Float[ndarray, "q c"], x_px: Float[ndarray, "k 2"]
) -> Float[ndarray, "k 2 e"]:
    """Return the displacement of each observation by each polynomial, of one image width.

    Displacements that the intrinsics can express along `directions` are taken out.
    """
    by_prior = by_parameters(camera, unproject(camera, x_px)) @ directions
    basis = np.linalg.qr(by_prior.reshape(2 * len(x_px), -1))[0]
    flat = _polynomials(x_px, camera).reshape(2 * len(x_px), -1)
    return (flat - basis @ (basis.T @ flat)).reshape(len(x_px), 2, -1)


def size_of(likeliest: Float[ndarray, " e"], covariance: Float[ndarray, "e e"], std: float) -> float:
    """Return the size of the displacements of one camera, from their estimate under a prior of size `std`.

    The fixed point of MacKay's update, with a weak prior of the size.
    """
    posterior = np.linalg.inv(covariance)
    right = posterior @ likeliest
    # The images alone count, along directions that they measure independently.
    known, directions = np.linalg.eigh(posterior - np.eye(len(likeliest)) * std**-2.0)
    known, right = np.maximum(known, 0.0), directions.T @ right
    variance = std**2
    for _ in range(UPDATES):
        information = known + 1 / variance
        determined = float((known / information).sum())
        squares = float(((right / information) ** 2).sum())
        before, variance = variance, (squares + WORTH * TYPICAL**2) / (determined + WORTH)
        if abs(np.log(variance / before)) < SETTLED:
            break
    return float(np.sqrt(variance))


def expressed(
    camera: Intrinsics, directions: Float[ndarray, "q c"], x_px: Float[ndarray, "k 2"]
) -> Float[ndarray, "q e"]:
    """Return the part of each polynomial over these pixels that the camera's parameters express along `directions`."""
    by_prior = by_parameters(camera, unproject(camera, x_px)) @ directions
    rows, polynomials = 2 * len(x_px), _polynomials(x_px, camera)
    return (
        directions @ np.linalg.lstsq(by_prior.reshape(rows, -1), polynomials.reshape(rows, -1), rcond=None)[0]
    )


def second_moment_px2(
    left: ModelError, camera: Intrinsics, x_px: Float[ndarray, "*points 2"]
) -> Float[ndarray, "*points 2 2"]:
    """Return the second moment of the displacement at pixels (px²).

    A projection with the camera alone errs by the displacement and by its uncertainty.
    """
    flat = x_px.reshape(-1, 2)
    by = _polynomials(flat, camera) - by_parameters(camera, unproject(camera, flat)) @ left.expressed
    moment = left.covariance + np.outer(left.likeliest, left.likeliest)
    return (by @ moment @ np.swapaxes(by, 1, 2)).reshape(*x_px.shape, 2)


def _polynomials(x_px: Float[ndarray, "k 2"], camera: Intrinsics) -> Float[ndarray, "k 2 e"]:
    """Return the displacements (px) of x, then of y, by products of Legendre polynomials, one image width each."""
    u, v = ((2 * x_px - [camera.width - 1, camera.height - 1]) / max(camera.width, camera.height)).T
    every = legvander2d(u, v, [DEGREE, DEGREE]).reshape(-1, DEGREE + 1, DEGREE + 1)
    i, j = np.nonzero(np.add.outer(np.arange(DEGREE + 1), np.arange(DEGREE + 1)) <= DEGREE)
    kept = every[:, i, j]
    return np.kron(camera.width * np.eye(2), kept[:, None]).reshape(len(kept), 2, -1)


def joint_covariance(
    covariance: Float[ndarray, "7 7"],
    cross: Float[ndarray, "7 q"],
    of_camera: Float[ndarray, "q q"],
    camera: Intrinsics,
) -> JointCovariance:
    """Return the covariance of transform and scale together with that of the intrinsics, from its blocks."""
    together = np.block([[covariance, cross], [cross.T, of_camera]])
    return JointCovariance(covariance=together, order=(*COVARIANCE_ORDER, *parameter_names(camera)))
