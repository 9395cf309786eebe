"""The lens: OpenCV's five-coefficient distortion, whether it has an inverse over the frame, and undistortion.

Pixel (0, 0) is the centre of the top-left pixel, so an image of width w spans [-0.5, w - 0.5].
Model and coefficients: OpenCV, "Camera Calibration and 3D Reconstruction".
"""

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.records import Intrinsics

WITHIN_FOLD = 0.9
"""Share of the distance at which a distortion folds over, up to which its inverse is used."""
NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)
_WIDEST_TANGENT = 10.0
"""Rays farther than 84° from the optical axis are beyond this model."""


def distort(lens: Intrinsics, x_normalized: Float[ndarray, "*batch 2"]) -> Float[ndarray, "*batch 2"]:
    """Pixels (...,2) of rays (x/z, y/z) (...,2)."""
    k1, k2, p1, p2, k3 = lens.distortion
    x, y = x_normalized[..., 0], x_normalized[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            lens.fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + lens.cx,
            lens.fy * (y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)) + lens.cy,
        ],
        axis=-1,
    )


def undistort(lens: Intrinsics, x_px: Float[ndarray, "*batch 2"]) -> Float[ndarray, "*batch 2"]:
    """Rays (x/z, y/z) (...,2) of pixels (...,2): Newton's method, exact where the lens does not fold over."""
    target = (x_px - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
    unit = replace(lens, fx=1.0, fy=1.0, cx=0.0, cy=0.0)
    x = target
    for _ in range(30):
        error = distort(unit, x) - target
        if np.abs(error).max(initial=0.0) < 1e-13:
            break
        x = x - np.linalg.solve(_jacobian(lens, x), error[..., None])[..., 0]
    return x


def _jacobian(lens: Intrinsics, x_normalized: Float[ndarray, "*batch 2"]) -> Float[ndarray, "*batch 2 2"]:
    """Derivative of the distorted by the undistorted normalised coordinates."""
    k1, k2, p1, p2, k3 = lens.distortion
    x, y = x_normalized[..., 0], x_normalized[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    mixed = slope * x * y + 2 * (p1 * x + p2 * y)
    out = np.empty((*x.shape, 2, 2))
    out[..., 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    out[..., 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    out[..., 0, 1] = out[..., 1, 0] = mixed
    return out


@lru_cache(maxsize=64)  # every stage asks for the same lens
def fold_distance_px(lens: Intrinsics) -> float | None:
    """How far from the principal point the distortion folds over inside the frame; None when it never does.

    Rays are followed outwards until they leave the frame. Where the Jacobian's determinant reaches zero
    before, two rays share one pixel and the pixels beyond have no ray at all.
    """
    edges = np.array([[-0.5, -0.5], [lens.width - 0.5, lens.height - 0.5]])
    (left, top), (right, bottom) = (edges - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
    to_corners = np.arctan2([top, top, bottom, bottom], [left, right, left, right])
    angle = np.append(np.arange(0, 2 * np.pi, np.radians(2)), to_corners)
    radius = np.linspace(0, _WIDEST_TANGENT, 4001)
    rays = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    slope = _jacobian(lens, rays)
    folded = slope[..., 0, 0] * slope[..., 1, 1] <= slope[..., 0, 1] * slope[..., 1, 0]
    x_px = distort(lens, rays)
    outside = ((x_px < -0.5) | (x_px > [lens.width - 0.5, lens.height - 0.5])).any(-1)
    # A ray that is still in the frame at the widest angle counts as folded there.
    first_folded, first_outside = (
        np.where(event.any(0), event.argmax(0), len(radius) - 1) for event in (folded, outside)
    )
    bad = first_folded <= first_outside
    if not bad.any():
        return None
    at_fold = x_px[first_folded[bad], bad.nonzero()[0]]
    return float(np.linalg.norm(at_fold - [lens.cx, lens.cy], axis=-1).min())


def usable_lens(lens: Intrinsics | None) -> tuple[Intrinsics | None, tuple[str, ...]]:
    """Given intrinsics, without a distortion that has no inverse, and a note that says so.

    With such a distortion images do not register.
    """
    if lens is None or (fold := fold_distance_px(lens)) is None:
        return lens, ()
    note = (
        f"the stored distortion folds over at {fold:.0f} px from the centre: not used; "
        "calibrate the lens again with points out to the corners, or give zero distortion"
    )
    return replace(lens, distortion=NO_DISTORTION), (note,)


def resized(lens: Intrinsics, width: int, height: int) -> Intrinsics:
    """The same camera with its image resized to `width` x `height` pixels."""
    sx, sy = width / lens.width, height / lens.height
    return replace(
        lens,
        fx=lens.fx * sx,
        fy=lens.fy * sy,
        cx=(lens.cx + 0.5) * sx - 0.5,
        cy=(lens.cy + 0.5) * sy - 0.5,
        width=width,
        height=height,
    )


def pinhole_inside(lens: Intrinsics, long_side_px: int) -> Intrinsics:
    """The largest undistorted pinhole grid whose every pixel lies in the frame, its long side as asked.

    Of a distortion that folds over, what lies within the fold: a rectangle of the frame's shape.
    """
    corners = np.array([[-0.5, -0.5], [lens.width - 0.5, lens.height - 0.5]])
    if (fold_px := fold_distance_px(lens)) is not None:
        centre, half = np.array([lens.cx, lens.cy]), np.array([lens.width, lens.height]) / 2
        reach = WITHIN_FOLD * fold_px * half / np.linalg.norm(half)
        corners = np.clip(np.stack([centre - reach, centre + reach]), *corners)
    (u0, v0), (u1, v1) = corners
    u, v = np.linspace(u0, u1, 100), np.linspace(v0, v1, 100)
    left, right = (undistort(lens, np.stack([0 * v + x, v], -1))[:, 0] for x in (u0, u1))
    top, bottom = (undistort(lens, np.stack([u, 0 * u + y], -1))[:, 1] for y in (v0, v1))
    x0, x1 = float(left.max()), float(right.min())
    y0, y1 = float(top.max()), float(bottom.min())
    scale = long_side_px / max((x1 - x0) * lens.fx, (y1 - y0) * lens.fy)
    width, height = round((x1 - x0) * lens.fx * scale), round((y1 - y0) * lens.fy * scale)
    fx, fy = width / (x1 - x0), height / (y1 - y0)
    return Intrinsics(fx, fy, -x0 * fx - 0.5, -y0 * fy - 0.5, width, height)


def rays(pinhole: Intrinsics) -> Float[ndarray, "h w 3"]:
    """Directions with z = 1 of every pixel of an undistorted grid, in the camera frame."""
    u, v = np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height))
    x, y = (u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def undistort_image(
    image: UInt8[ndarray, "h w 3"], lens: Intrinsics, pinhole: Intrinsics
) -> UInt8[ndarray, "h2 w2 3"]:
    """The image resampled to an undistorted grid; averaged over areas where the grid is coarser."""
    factor = max(1, round(lens.fx / pinhole.fx))
    fine = resized(pinhole, factor * pinhole.width, factor * pinhole.height)
    u, v = np.moveaxis(distort(lens, rays(fine)[..., :2]).astype(np.float32), -1, 0)
    # In whole grey levels, averages of two by two would all be rounded up from a half.
    resampled = cv2.remap(image.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    small = cv2.resize(resampled, (pinhole.width, pinhole.height), interpolation=cv2.INTER_AREA)
    return np.rint(small).astype(np.uint8)
