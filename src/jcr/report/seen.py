"""Section of the point uncertainty: contours over an image."""

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.record import as_estimate
from jcr.calibration.words import given_in_words, seen_in_words
from jcr.capture.images import read_image
from jcr.estimation.point_uncertainty import point_covariance, within_95
from jcr.report.figures import Figure, Shape
from jcr.report.raster import image_url
from jcr.report.render import Section
from jcr.rounding import significant
from jcr.run_folder import RunResult

ACROSS = 640
"""Pixels of the drawn image."""
GRID = 32
"""Points across the image at which the uncertainty is computed."""
LEVELS = (1.25, 1.6, 2.0, 3.0, 5.0, 8.0)
"""Contours, in multiples of the least value."""
SHORTEST = 8
"""Points of a contour that is drawn."""


def seen_section(result: RunResult) -> Section | None:
    """Return contours of the 95 % bound of a point's error over an image; None without intrinsics."""
    uncertainty, hand_eye = result.calibration.uncertainty, result.hand_eye
    if uncertainty is None or uncertainty.seen is None or hand_eye.intrinsics_cross is None:
        return None
    kept = result.calibration.with_given_intrinsics
    distance_m = 1e-3 * uncertainty.seen.distance_mm
    content = {
        "distance": significant(distance_m),
        "seen": seen_in_words(uncertainty.seen),
        "figure": _figure(result, distance_m),
        "std": " ".join(significant(value) for value in uncertainty.translation_std_mm),
        "kept": "" if kept is None else f"{given_in_words(kept).capitalize()}.",
    }
    return Section("seen", content)


def _figure(result: RunResult, distance_m: float) -> Figure:
    """Return the image with contours in millimetres, each with its number."""
    used = result.image_index[result.hand_eye.inliers]
    pixels = read_image(result.capture.folder / result.capture.images[used[len(used) // 2]])
    width, height = ACROSS, round(ACROSS * pixels.shape[0] / pixels.shape[1])
    small = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    field = cv2.resize(_field_mm(result, distance_m), (width, height), interpolation=cv2.INTER_CUBIC)
    least = float(field.min())
    shapes = [Shape("image", {"href": image_url(small), "width": width, "height": height})]
    for times in LEVELS:
        if times * least < field.max():
            shapes += _contour(field, times * least)
    v, u = np.unravel_index(int(field.argmin()), field.shape)
    shapes.append(Shape("text", {"class": "level", "x": u, "y": v}, f"{significant(least)} mm"))
    label = f"95 % of the errors of a point at {significant(distance_m)} m, in millimetres, over an image"
    return Figure(label, shapes, float(height), width=float(width))


def _field_mm(result: RunResult, distance_m: float) -> Float[ndarray, "h w"]:
    """Return the 95 % bound (mm) of the error of points on a grid over the image."""
    estimate = as_estimate(result.calibration)
    intrinsics = estimate.intrinsics
    assert intrinsics is not None
    rows = max(round(GRID * intrinsics.height / intrinsics.width), 2)
    u, v = np.meshgrid(
        np.linspace(0, intrinsics.width - 1, GRID), np.linspace(0, intrinsics.height - 1, rows)
    )
    x_px = np.stack([u, v], axis=-1)
    covariance = point_covariance(estimate, intrinsics, x_px, distance_m)
    return 1e3 * np.array([[within_95(one) for one in row] for row in covariance])


def _contour(field: Float[ndarray, "h w"], level: float) -> Iterator[Shape]:
    """Yield lines along which the field has one value, and the value in the middle of each line."""
    height, width = field.shape
    found, _ = cv2.findContours((field < level).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    for outline in found:
        points = outline[:, 0]
        inside = ((points > 0) & (points < [width - 1, height - 1])).all(1)
        # Where the line follows the border of the image it is none.
        starts = np.flatnonzero(inside & ~np.roll(inside, 1)) if not inside.all() else [0]
        for start in starts:
            along, is_inside = np.roll(points, -start, axis=0), np.roll(inside, -start)
            along = along[: len(along) if is_inside.all() else int(np.argmin(is_inside))][::4]
            if len(along) < SHORTEST:
                continue
            x, y = along[len(along) // 2]
            yield Shape("polyline", {"class": "contour", "points": " ".join(f"{u},{v}" for u, v in along)})
            yield Shape("text", {"class": "level", "x": x, "y": y}, significant(level))
