"""Camera models of OpenCV: projection with derivatives, unprojection, resizing, cropping, undistortion of images.

Models: pinhole with five distortion coefficients, rational with eight, rational with thin prism with twelve ("Camera
Calibration and 3D Reconstruction"), and fisheye with four (Kannala and Brandt, TPAMI 2006). Only `_distorted` depends
on the model. Derivatives are exact: the imaginary part of the distortion after a tiny imaginary step (Squire and Trapp,
SIAM Review 40, 1998).
Pixel (0, 0) is the centre of the top-left pixel, so an image of width w spans [-0.5, w - 0.5]. Arrays keep their
precision: float32 points give float32 pixels.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Inexact, UInt8
from numpy import ndarray

from jcr.records import COEFFICIENTS, Intrinsics

HALF_PIXEL = 0.5
"""Pixel coordinates of COLMAP and nerfstudio, which count from the image corner, minus those of this project (px)."""
USUAL_FOCAL = 0.8
"""Assumed focal length of an unknown camera over the long side of its image (64° wide); wrist cameras: 0.5 to 1.2."""
WITHIN_FOLD = 0.9
"""Share of `fold_distance_px` up to which a distortion is inverted."""
LEAST_FOCAL = 1e-3
"""Smallest estimated focal length, as a share of the given or initial one; no estimate that is accepted is near it."""
NORMALIZED = Intrinsics(1.0, 1.0, 0.0, 0.0, 1, 1)
"""Camera whose pixel coordinates are x/z, y/z."""
Coordinate = Inexact[ndarray, "*batch"] | np.inexact
STEP = 1e-20
"""Length of the imaginary step, whose square is below all rounding."""
_WIDEST_TANGENT = 10.0
"""Tangent of the largest angle of a ray to the optical axis that the models describe, 84°."""
_NEAR_AXIS = 1e-8
"""Lower bound of x² + y² in the formulas of a fisheye, which divide by it; the error is below 1e-8."""
_WIDEST_PINHOLE = 1.7
"""Largest x/z and y/z of an undistorted grid, 60°: beyond, a fisheye's border would be stretched too much."""


def parameter_names(camera: Intrinsics) -> tuple[str, ...]:
    """Return the names of the numbers of `parameters(camera)`: fx, fy, cx, cy and the distortion coefficients."""
    return ("fx", "fy", "cx", "cy", *COEFFICIENTS[camera.model])


def parameters(camera: Intrinsics) -> Float[ndarray, " p"]:
    """Return the vector fx, fy, cx, cy, distortion coefficients of the camera."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


def with_parameters(camera: Intrinsics, values: Float[ndarray, " p"]) -> Intrinsics:
    """Return a camera of the same model and image size with the p `values`, in the order of `parameters`."""
    fx, fy, cx, cy, *distortion = values.tolist()
    # A step from a poor initial estimate may pass 0, where no camera is.
    fx, fy = max(fx, LEAST_FOCAL * camera.fx), max(fy, LEAST_FOCAL * camera.fy)
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion))


def is_distorted(camera: Intrinsics) -> bool:
    """Test whether the camera has a distortion; a fisheye always has."""
    return camera.model == "fisheye" or any(camera.distortion)


def with_thin_prism(camera: Intrinsics) -> Intrinsics:
    """Return a pinhole or rational camera converted to the thin prism model, with the same projection."""
    padded = [*camera.distortion, *[0.0] * (len(COEFFICIENTS["thin_prism"]) - len(camera.distortion))]
    numbers = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
    return Intrinsics(*numbers, tuple(padded), "thin_prism")


def without_distortion(camera: Intrinsics) -> Intrinsics:
    """Return the pinhole camera without distortion that has the same focal lengths and principal point."""
    return Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)


def project(camera: Intrinsics, x_in_camera: Float[ndarray, "*batch 3"]) -> Float[ndarray, "*batch 2"]:
    """Return the pixels (x, y) (...,2) of points (...,3) in the camera frame; points with z ≤ 0 give meaningless pixels.

    Pixel (0, 0) is the centre of the top-left pixel, here and in all functions of this module.
    """
    x, y, z = x_in_camera[..., 0], x_in_camera[..., 1], x_in_camera[..., 2]
    if is_distorted(camera):
        x, y = _distorted(camera.model, camera.distortion, x / z, y / z)
        return np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], axis=-1)
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=-1)


def unproject(camera: Intrinsics, x_px: Float[ndarray, "*batch 2"]) -> Float[ndarray, "*batch 3"]:
    """Return the rays (...,3) with z = 1 in the camera frame of pixels (...,2), by Newton's method.

    They are exact for pixels nearer to the principal point than `fold_distance_px`, or for all pixels of the image if
    it is None. Rays of other pixels are not valid.
    """
    found = target = (x_px - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    for _ in range(30 if is_distorted(camera) else 0):
        x, y = found[..., 0], found[..., 1]
        error = np.stack(_distorted(camera.model, camera.distortion, x, y), axis=-1) - target
        before, found = found, found - np.linalg.solve(_slopes(camera, x, y), error[..., None])[..., 0]
        # Pixels beyond the widest angle have no ray in front of the camera; they get the nearest one.
        radius = np.linalg.norm(found, axis=-1, keepdims=True)
        found = found / np.maximum(radius / _WIDEST_TANGENT, 1.0)
        if np.abs(found - before).max(initial=0.0) < 1e-13:
            break
    return np.concatenate([found, np.ones_like(found[..., :1])], axis=-1)


def by_point(camera: Intrinsics, x_in_camera: Float[ndarray, "*batch 3"]) -> Float[ndarray, "*batch 2 3"]:
    """Return the derivatives (...,2,3) of the pixel of `project` by the coordinates of the point in the camera frame.

    The rows are pixel x and y, the columns x, y, z of the point, which must be in front of the camera (z > 0).
    """
    depth = x_in_camera[..., 2]
    x, y = x_in_camera[..., 0] / depth, x_in_camera[..., 1] / depth
    out = np.empty((*x.shape, 2, 3), x.dtype)
    out[..., :2] = _slopes(camera, x, y) / depth[..., None, None]
    out[..., 0, :2] *= camera.fx
    out[..., 1, :2] *= camera.fy
    out[..., 2] = -(out[..., 0] * x[..., None] + out[..., 1] * y[..., None])
    return out


def by_parameters(
    camera: Intrinsics, x_in_camera: Float[ndarray, "*batch 3"]
) -> Float[ndarray, "*batch 2 p"]:
    """Return the derivatives (...,2,p) of the pixel of `project` by the p numbers of `parameters(camera)`.

    The rows are pixel x and y, the columns fx, fy, cx, cy and the distortion coefficients. Points have z > 0.
    """
    x, y = x_in_camera[..., 0] / x_in_camera[..., 2], x_in_camera[..., 1] / x_in_camera[..., 2]
    out = np.zeros((*x.shape, 2, 4 + len(camera.distortion)), x.dtype)
    out[..., 0, 0], out[..., 1, 1] = _distorted(camera.model, camera.distortion, x, y)
    out[..., 0, 2] = out[..., 1, 3] = 1.0
    for k, along in enumerate(1j * STEP * np.eye(len(camera.distortion))):
        x_out, y_out = _distorted(camera.model, (camera.distortion + along).tolist(), x, y)
        out[..., 0, 4 + k], out[..., 1, 4 + k] = (
            camera.fx * np.imag(x_out) / STEP,
            camera.fy * np.imag(y_out) / STEP,
        )
    return out


def _distorted(
    model: str, distortion: Sequence[float | complex], x: Coordinate, y: Coordinate
) -> tuple[Coordinate, Coordinate]:
    """Return the distorted coordinates x and y of rays (x, y, 1), before focal lengths and principal point.

    `distortion` holds the coefficients of the `model` of Intrinsics. Coefficients and coordinates may be complex.
    """
    r2 = x * x + y * y
    if model == "fisheye":
        k1, k2, k3, k4 = distortion
        r = np.sqrt(np.maximum(r2, _NEAR_AXIS))
        angle = np.arctan(r)
        a2 = angle * angle
        radial = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))) / r
        return x * radial, y * radial
    k1, k2, p1, p2, k3, *more = distortion
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if more:
        k4, k5, k6 = more[:3]
        radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    x_out = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    y_out = y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    if model != "thin_prism":
        return x_out, y_out
    s1, s2, s3, s4 = more[3:]
    return x_out + r2 * (s1 + s2 * r2), y_out + r2 * (s3 + s4 * r2)


def _slopes(camera: Intrinsics, x: Coordinate, y: Coordinate) -> Float[ndarray, "*batch 2 2"]:
    """Return the derivatives (...,2,2) of the coordinates that `_distorted` returns by x and y (columns)."""
    out = np.empty((*x.shape, 2, 2), x.dtype)
    for column, moved in enumerate(((x + 1j * STEP, y), (x, y + 1j * STEP))):
        x_out, y_out = _distorted(camera.model, camera.distortion, *moved)
        out[..., 0, column], out[..., 1, column] = np.imag(x_out) / STEP, np.imag(y_out) / STEP
    return out


@lru_cache(maxsize=64)  # called many times for the same camera
def fold_distance_px(camera: Intrinsics) -> float | None:
    """Return the distance (px) from the principal point at which the distortion folds over; None if it never does.

    At a fold the determinant of the distortion's Jacobian is zero: two rays share a pixel, pixels beyond have no ray.
    """
    edges = np.array([[-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]])
    (left, top), (right, bottom) = unproject(without_distortion(camera), edges)[:, :2]
    to_corners = np.arctan2([top, top, bottom, bottom], [left, right, left, right])
    angle = np.append(np.arange(0, 2 * np.pi, np.radians(2)), to_corners)
    radius = np.linspace(0, _WIDEST_TANGENT, 4001)[:, None]
    for count in (400, len(radius)):  # the first rays leave the frame of most cameras
        x, y = radius[:count] * np.cos(angle), radius[:count] * np.sin(angle)
        slopes = _slopes(camera, x, y)
        folded = slopes[..., 0, 0] * slopes[..., 1, 1] <= slopes[..., 0, 1] * slopes[..., 1, 0]
        x_px = project(camera, np.stack([x, y, np.ones_like(x)], axis=-1))
        outside = ((x_px < -0.5) | (x_px > [camera.width - 0.5, camera.height - 0.5])).any(-1)
        if (folded | outside)[:-1].any(0).all():
            break
    # A ray that is still in the frame at the widest angle counts as folded there.
    first_folded, first_outside = (
        np.where(event.any(0), event.argmax(0), count - 1) for event in (folded, outside)
    )
    bad = first_folded <= first_outside
    if not bad.any():
        return None
    at_fold = x_px[first_folded[bad], bad.nonzero()[0]]
    return float(np.linalg.norm(at_fold - [camera.cx, camera.cy], axis=-1).min())


def usable_intrinsics(camera: Intrinsics | None) -> tuple[Intrinsics | None, tuple[str, ...]]:
    """Return given intrinsics (or None) and warnings; distortion that folds over inside the image is set to zero."""
    # A fisheye's border, beyond the widest angle, may have pixels without rays; the rest of the image is usable.
    if camera is None or camera.model == "fisheye" or (fold := fold_distance_px(camera)) is None:
        return camera, ()
    warning = (
        f"the stored distortion folds over at {fold:.0f} px from the centre: not used; "
        "calibrate the intrinsics again with points out to the corners, or give zero distortion"
    )
    return without_distortion(camera), (warning,)


def guessed_intrinsics(size: tuple[int, int], focal: float = USUAL_FOCAL) -> Intrinsics:
    """Return a pinhole with square pixels for images of `size` (width, height); `focal` is relative to the long side.

    The principal point is the image centre.
    """
    (width, height), focal_px = size, focal * max(size)
    return Intrinsics(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, width, height)


def resized(camera: Intrinsics, width: int, height: int) -> Intrinsics:
    """Return the camera with its image resized to `width` x `height` pixels; its distortion does not change."""
    sx, sy = width / camera.width, height / camera.height
    return replace(
        camera,
        fx=camera.fx * sx,
        fy=camera.fy * sy,
        cx=(camera.cx + 0.5) * sx - 0.5,
        cy=(camera.cy + 0.5) * sy - 0.5,
        width=width,
        height=height,
    )


def cropped(camera: Intrinsics, left: int, top: int, width: int, height: int) -> Intrinsics:
    """Return the camera with `width` x `height` pixels cut out of its image, from column `left` and row `top` on."""
    return replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=width, height=height)


def zoomed(camera: Intrinsics, factor: float) -> Intrinsics:
    """Return the camera with both focal lengths multiplied by a factor; image size and principal point do not change."""
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def pinhole_inside(camera: Intrinsics, long_side_px: int) -> Intrinsics:
    """Return the undistorted pinhole camera that sees the largest view whose pixels are all inside the camera's image.

    Its long side has `long_side_px` pixels. If the distortion folds over, the view is a rectangle of the image's shape
    within 0.9 times `fold_distance_px`. The view extends at most 60° from the optical axis in x and in y.
    """
    corners = np.array([[-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]])
    if (fold_px := fold_distance_px(camera)) is not None:
        centre, half = np.array([camera.cx, camera.cy]), np.array([camera.width, camera.height]) / 2
        reach = WITHIN_FOLD * fold_px * half / np.linalg.norm(half)
        corners = np.clip(np.stack([centre - reach, centre + reach]), *corners)
    (u0, v0), (u1, v1) = corners
    u, v = np.linspace(u0, u1, 100), np.linspace(v0, v1, 100)
    left, right = (unproject(camera, np.stack([0 * v + x, v], -1))[:, 0] for x in (u0, u1))
    top, bottom = (unproject(camera, np.stack([u, 0 * u + y], -1))[:, 1] for y in (v0, v1))
    x0, x1 = max(float(left.max()), -_WIDEST_PINHOLE), min(float(right.min()), _WIDEST_PINHOLE)
    y0, y1 = max(float(top.max()), -_WIDEST_PINHOLE), min(float(bottom.min()), _WIDEST_PINHOLE)
    scale = long_side_px / max((x1 - x0) * camera.fx, (y1 - y0) * camera.fy)
    width, height = round((x1 - x0) * camera.fx * scale), round((y1 - y0) * camera.fy * scale)
    fx, fy = width / (x1 - x0), height / (y1 - y0)
    return Intrinsics(fx, fy, -x0 * fx - 0.5, -y0 * fy - 0.5, width, height)


def rays(pinhole: Intrinsics) -> Float[ndarray, "h w 3"]:
    """Return the ray with z = 1 of the centre of every pixel of an undistorted camera, in the camera frame."""
    u, v = np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height))
    return unproject(pinhole, np.stack([u, v], axis=-1).astype(np.float64))


def undistortion(
    camera: Intrinsics, pinhole: Intrinsics
) -> Callable[[UInt8[ndarray, "h w 3"]], UInt8[ndarray, "h2 w2 3"]]:
    """Return a function that resamples images of a camera to those of an undistorted pinhole camera.

    Both cameras have the same camera frame. The image is interpolated bilinearly, with border pixels repeated outside,
    and averaged over areas if the pinhole camera has fewer pixels per angle. The lookup table is computed once.
    """
    factor = max(1, round(camera.fx / pinhole.fx))
    fine = resized(pinhole, factor * pinhole.width, factor * pinhole.height)
    u, v = (
        np.ascontiguousarray(place)
        for place in np.moveaxis(project(camera, rays(fine)), -1, 0).astype(np.float32)
    )

    def undistorted(image: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "h2 w2 3"]:
        # Integer grey levels would bias the averages of 2 x 2 pixels, whose halves are rounded up.
        resampled = cv2.remap(
            image.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        small = cv2.resize(resampled, (pinhole.width, pinhole.height), interpolation=cv2.INTER_AREA)
        return np.rint(small).astype(np.uint8)

    return undistorted
