"""Remaining error of a camera's model: displacements of pixels that its coefficients do not describe."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from numpy.polynomial.legendre import legvander2d

from jcr.camera import by_parameters, unproject
from jcr.estimation.intrinsics_prior import CameraPrior
from jcr.records import Intrinsics, ModelError

DEGREE = 5
"""Total degree of the polynomials."""
TYPICAL = 1e-4
"""Middle of the weak prior of the size of each polynomial, in widths of the image."""
UPDATES, SETTLED = 100, 1e-3
"""Most updates of the size, and the relative change of its square that ends them."""
WORTH = 2.0
"""Polynomials that the typical size counts for, beside those that the images determine."""


def displacements(
    cameras: Sequence[CameraPrior],
    counts: Sequence[int],
    x_px: Float[ndarray, "k 2"],
    camera: Int[ndarray, " k"],
) -> Float[ndarray, "k 2 e"]:
    """Return the displacement of each observation by each of the `counts` polynomials of each camera.

    The unit of a polynomial is the width of the image. Displacements that the intrinsics can express are taken out.
    """
    blocks = [np.zeros((len(camera), 2, 0))]
    for c, (one, count) in enumerate(zip(cameras, counts, strict=True)):
        if count == 0:
            continue
        rows = np.flatnonzero(camera == c)
        by_prior = by_parameters(one.intrinsics, unproject(one.intrinsics, x_px[rows])) @ one.directions
        block = np.zeros((len(camera), 2, count))
        polynomials = _polynomials(x_px[rows], one.intrinsics)
        basis = np.linalg.qr(by_prior.reshape(2 * len(rows), -1))[0]
        flat = polynomials.reshape(2 * len(rows), -1)
        block[rows] = (flat - basis @ (basis.T @ flat)).reshape(polynomials.shape)
        blocks.append(block)
    return np.concatenate(blocks, axis=2)


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


def expressed(camera: CameraPrior, x_px: Float[ndarray, "k 2"]) -> Float[ndarray, "q e"]:
    """Return the part of each polynomial over these pixels that the camera's parameters express."""
    intrinsics = camera.intrinsics
    by_prior = by_parameters(intrinsics, unproject(intrinsics, x_px)) @ camera.directions
    rows, polynomials = 2 * len(x_px), _polynomials(x_px, intrinsics)
    fit = np.linalg.lstsq(by_prior.reshape(rows, -1), polynomials.reshape(rows, -1), rcond=None)[0]
    return camera.directions @ fit


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


def polynomials_of(camera: CameraPrior) -> int:
    """Return the number of displacements of a camera; 0 where its intrinsics are exact."""
    return (DEGREE + 1) * (DEGREE + 2) if len(camera.std) else 0


def _polynomials(x_px: Float[ndarray, "k 2"], camera: Intrinsics) -> Float[ndarray, "k 2 e"]:
    """Return the displacements (px) of x, then of y, by products of Legendre polynomials, one image width each."""
    u, v = ((2 * x_px - [camera.width - 1, camera.height - 1]) / max(camera.width, camera.height)).T
    every = legvander2d(u, v, [DEGREE, DEGREE]).reshape(-1, DEGREE + 1, DEGREE + 1)
    i, j = np.nonzero(np.add.outer(np.arange(DEGREE + 1), np.arange(DEGREE + 1)) <= DEGREE)
    kept = every[:, i, j]
    return np.kron(camera.width * np.eye(2), kept[:, None]).reshape(len(kept), 2, -1)
