"""Prior distribution of a camera's intrinsics, and of the remaining distortion that its model does not describe."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.polynomial.legendre import legvander2d

from jcr.camera import by_parameters, parameter_names, unproject
from jcr.geometry import Transform
from jcr.records import Intrinsics

MEASURED = {
    "f": 5e-3,
    "aspect": 1e-3,
    "cx": 5e-3,
    "cy": 5e-3,
    "k1 in the corner": 0.03,
    "k2 in the corner": 0.03,
    "k3 in the corner": 0.03,
    "p1": 1e-3,
    "p2": 1e-3,
    "s1": 1e-3,
    "s2": 1e-3,
    "s3": 1e-3,
    "s4": 1e-3,
}
"""Prior standard deviations of given intrinsics without stated ones: focal length and aspect relative, principal point
in image widths; k1 to k3 as displacements of the image corner, as shares of its radius; other coefficients absolute.
Errors of factory values: 0.3 to 0.9 % and a few pixels. The given k1, k2 and k3 of five real captures are 3 % (rms)
from those that features out to the corners show; the largest sums of the three are 3 %. With 1.5 or 4.5 %, simulated
errors in the corner stay within the stated 95 % as often, which is 0.8 or 1.2 to 1.8 times as large."""
ESTIMATED = {
    "f": 0.5,
    "aspect": 3e-3,
    "cx": 0.02,
    "cy": 0.02,
    "k1 in the corner": 0.13,
    "k2 in the corner": 0.06,
    "k3 in the corner": 0.027,
    "p1": 3e-3,
    "p2": 3e-3,
}
"""Prior standard deviations of intrinsics that a reconstruction estimated, for a cheap camera; units of MEASURED.

k1 to k3 are displacements of the image corner, as shares of its radius; together they have a standard deviation of
15 %. Published calibrations (EuRoC, TUM RGB-D, KITTI, OpenCV's stereo sample) displace the corner by 13 % rms.
"""
PRISM = {"cx": 0.02, "cy": 0.02, "p1": 3e-3, "p2": 3e-3, "s1": 0.01, "s2": 0.01, "s3": 0.01, "s4": 0.01}
"""Prior standard deviations of a free thin prism and the parameters correlated with it; 23 px of a camera are 0.05. A
prism, the principal point and a rotation of the camera move the pixels nearly alike: with 0.03 and 0.1 a real camera has
its principal point 132 px from the given one, with these 53 px, at the same points in the middle of its images. The
tangential coefficients of real lenses are below 0.01."""
DECENTRING = 1e-3
"""Standard deviation of thin prism coefficients that were not calibrated, from tangential distortion of new cameras."""
FIXED: Mapping[str, float] = {}
"""Prior of exact intrinsics: no parameter is free."""
EXACT_BELOW = 1e-12
"""Prior standard deviation below which an intrinsic parameter is fixed."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraPrior:
    """Normal prior of a camera's intrinsics: mean, and independent directions with a standard deviation each."""

    intrinsics: Intrinsics
    """Mean of the prior."""
    directions: Float[ndarray, "q c"]
    """Directions (columns) of change; the q rows are in the order of camera.parameters."""
    std: Float[ndarray, " c"]
    """Standard deviation along each direction."""
    mount_free: bool = False
    """Whether the camera's pose on its rig is estimated."""

    @property
    def parameter_std(self) -> Float[ndarray, " q"]:
        """Standard deviation of each of the q intrinsics, in the order and units of camera.parameters."""
        return np.sqrt(self.directions**2 @ self.std**2)


def camera_with_prior(
    intrinsics: Intrinsics, std: Mapping[str, float] | Float[ndarray, " q"] = MEASURED
) -> CameraPrior:
    """Return the prior of a camera with mean `intrinsics` and standard deviations `std`.

    `std` is a mapping with keys and units as in MEASURED or ESTIMATED; parameters without a key are exact. Or it is one
    number for each element of `camera.parameters`, in its unit; NaN stands for the value of MEASURED, 0 for an exact
    parameter. Coefficients that the distortion model does not have are ignored.
    """
    if isinstance(std, ndarray):
        std = np.where(np.isnan(std), camera_with_prior(intrinsics).parameter_std, std)
        free = np.flatnonzero(std > EXACT_BELOW)
        return CameraPrior(intrinsics=intrinsics, directions=np.eye(len(std))[:, free], std=std[free])
    fx, fy, width = intrinsics.fx, intrinsics.fy, intrinsics.width
    moves = {
        "f": {"fx": fx, "fy": fy},
        "aspect": {"fx": fx / 2, "fy": -fy / 2},
        "cx": {"cx": width},
        "cy": {"cy": width},
    }
    corner = float(np.hypot(width, intrinsics.height)) / (2 * fx)
    moves |= {f"k{k} in the corner": {f"k{k}": corner ** (-2 * k)} for k in (1, 2, 3)}
    names = parameter_names(intrinsics)
    known = {name: value for name, value in std.items() if name in moves or name in names}
    directions = np.zeros((len(names), len(known)))
    for column, name in enumerate(known):
        for parameter, unit in moves.get(name, {name: 1.0}).items():
            directions[names.index(parameter), column] = unit
    return CameraPrior(intrinsics=intrinsics, directions=directions, std=np.array(list(known.values())))


def camera_about(
    found: Intrinsics, given: bool, std: Float[ndarray, " q"] | None = None, distortion_given: bool = True
) -> CameraPrior:
    """Return the prior of a camera: the intrinsics `found` as its mean, with standard deviations by their source.

    `given`: the user gave the intrinsics, and `std` has their standard deviations (camera.parameters; None: MEASURED).
    Otherwise a reconstruction estimated them, with the standard deviations ESTIMATED. `distortion_given` False: given
    intrinsics whose distortion was estimated, which has those of ESTIMATED.
    """
    if not given:
        return camera_with_prior(found, ESTIMATED)
    if distortion_given:
        return camera_with_prior(found, MEASURED if std is None else std)
    unknown = camera_with_prior(
        found, {**ESTIMATED, **{name: MEASURED[name] for name in ("f", "aspect", "cx", "cy")}}
    )
    return unknown if std is None else camera_with_prior(found, np.r_[std[:4], unknown.parameter_std[4:]])


def decentring(camera: Intrinsics, x: Transform) -> Float[ndarray, "r 2"]:
    """Return the steps of gripper_from_camera `x`, log scale and q intrinsics that images confuse with a thin prism.

    Column 0 is for a prism that displaces along x, column 1 along y. The 7 + q rows are translation, rotation (gripper
    axes), log scale and camera.parameters, with p1 and p2 among them. To second order, a prism that displaces
    normalised x by s · radius² equals three changes. They are p2 = s, the principal point moved by 2 · s · fx, and the
    camera rotated by 2 · s about its y axis. s is one standard deviation: DECENTRING, or the estimated tangential
    distortion if larger, because one defect of the optics causes both.
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
"""Total degree of the polynomials of the remaining distortion, and their number (21 for x, 21 for y)."""
TYPICAL = 1e-4
"""Middle of the weak prior on the size of the remaining distortion, in image widths."""
UPDATES, SIZE_SETTLED = 100, 1e-3
"""Largest number of updates of the remaining distortion's size, and the relative change of its square that ends them."""
WORTH = 2.0
"""Weight of the weak prior on the remaining distortion's size, as a number of polynomials."""


def unmodelled(
    camera: Intrinsics, directions: Float[ndarray, "q c"], x_px: Float[ndarray, "k 2"]
) -> tuple[Float[ndarray, "k 2 e"], Float[ndarray, "q e"]]:
    """Return what e polynomials of distortion displace beyond the camera model, and the part that intrinsics express.

    The polynomials (POLYNOMIALS, Legendre) have a coefficient of one image width. The second result is the change of
    the q intrinsics (camera.parameters) along `directions` (columns) that fits each polynomial best at the pixels
    `x_px` (least squares). The first is the remaining displacement (px) of the k pixels.
    """
    by_prior = (by_parameters(camera, unproject(camera, x_px)) @ directions).reshape(2 * len(x_px), -1)
    every = polynomials(x_px, camera)
    fit = np.linalg.lstsq(by_prior, every.reshape(len(by_prior), -1), rcond=None)[0]
    return every - (by_prior @ fit).reshape(every.shape), directions @ fit


FARTHEST = 10
"""Place, from the farthest, of the point whose radius counts as the last observed one: single points are wrong matches.
With 5 or 15, no stated bound of 40 simulated captures changes by 1 %."""


def reach_px(camera: Intrinsics, x_px: Float[ndarray, "k 2"]) -> float:
    """Return the distance (px) from the principal point within which all pixels but the FARTHEST lie."""
    radius = np.sort(np.linalg.norm(x_px - [camera.cx, camera.cy], axis=1))
    return float(radius[-min(FARTHEST, len(radius))])


def rays_by_reach(
    camera: Intrinsics, x_px: Float[ndarray, "*k 2"], reach_px: float
) -> Float[ndarray, "*k 3"]:
    """Return the rays with z = 1 of pixels if the distortion did not change, as a share, beyond `reach_px`.

    The share is that of the last observed pixel on the same radius. A lens need not follow its polynomial beyond: from
    boards in the middle of the images, four of ten real captures fit one that folds over before the corner.
    """
    centre = np.array([camera.cx, camera.cy])
    beyond = np.maximum(np.linalg.norm(x_px - centre, axis=-1, keepdims=True) / reach_px, 1.0)
    near_px, without = (
        centre + (x_px - centre) / beyond,
        replace(camera, distortion=(0.0,) * len(camera.distortion)),
    )
    far, near = (np.linalg.norm(unproject(without, at)[..., :2], axis=-1) for at in (x_px, near_px))
    out = unproject(camera, near_px)
    out[..., :2] *= (far / np.maximum(near, 1e-12))[..., None]
    return out


def size_of(likeliest: Float[ndarray, " e"], covariance: Float[ndarray, "e e"], std: float) -> float:
    """Return the likeliest size (image widths) of the distortion that one camera's model cannot express.

    The size is the prior standard deviation of the e polynomial coefficients. The method is MacKay's fixed-point
    iteration. `likeliest` and `covariance` of the coefficients were estimated under a prior of size `std`.
    """
    posterior = np.linalg.inv(covariance)
    right = posterior @ likeliest
    # The prior is subtracted; the images measure the coefficients independently along these directions.
    known, directions = np.linalg.eigh(posterior - np.eye(len(likeliest)) * std**-2.0)
    # Far from the solution the images' information may be negative along a direction, which then determines nothing.
    known, right = np.maximum(known, 0.0), np.where(known > 0, directions.T @ right, 0.0)
    variance = std**2
    for _ in range(UPDATES):
        information = known + 1 / variance
        determined = float((known / information).sum())
        squares = float(((right / information) ** 2).sum())
        before, variance = variance, (squares + WORTH * TYPICAL**2) / (determined + WORTH)
        if abs(np.log(variance / before)) < SIZE_SETTLED:
            break
    return float(np.sqrt(variance))


def polynomials(x_px: Float[ndarray, "k 2"], camera: Intrinsics) -> Float[ndarray, "k 2 e"]:
    """Return the displacements (px) of k pixels by e polynomials with a coefficient of one image width.

    The polynomials are products of Legendre polynomials in both pixel coordinates, of total degree ≤ DEGREE. The
    coordinates are 0 at the image centre and ±1 at the ends of the longer side. The first half displaces along x, the
    second half along y.
    """
    u, v = ((2 * x_px - [camera.width - 1, camera.height - 1]) / max(camera.width, camera.height)).T
    every = legvander2d(u, v, [DEGREE, DEGREE]).reshape(-1, DEGREE + 1, DEGREE + 1)
    i, j = np.nonzero(np.add.outer(np.arange(DEGREE + 1), np.arange(DEGREE + 1)) <= DEGREE)
    kept = every[:, i, j]
    return np.kron(camera.width * np.eye(2), kept[:, None]).reshape(len(kept), 2, -1)
