"""The section that draws over an image how exactly a point seen there is placed."""

from html import escape

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.seen import within_95
from jcr.calibration.words import given_in_words, seen_in_words
from jcr.capture.images import read_image
from jcr.report.figures import picture_url
from jcr.report.markup import filled
from jcr.results import RunResult
from jcr.rounding import significant

ACROSS = 640
"""Pixels of the drawn image."""
GRID = 32
"""Points across the image at which the uncertainty is computed."""
LEVELS = (1.25, 1.6, 2.0, 3.0, 5.0, 8.0)
"""Contours, in multiples of the least value."""


def seen_section(result: RunResult) -> str:
    """Contours of what 95 % of the errors of a point are below, over the image in the middle; empty without
    intrinsics."""
    uncertainty, hand_eye = result.calibration.uncertainty, result.hand_eye
    if uncertainty is None or uncertainty.seen is None or hand_eye.estimate.intrinsics_cross is None:
        return ""
    x, y, z = uncertainty.translation_std_mm
    kept = result.calibration.with_given_intrinsics
    return filled(
        "seen.html",
        lead=escape(
            f"95 % of the errors of a point at {significant(1e-3 * uncertainty.seen.distance_mm)} m are below the "
            f"millimetres in the image; {seen_in_words(uncertainty.seen)}."
        ),
        figure=_figure(result, 1e-3 * uncertainty.seen.distance_mm),
        note=escape(
            f"The camera itself is known to ± {significant(x)} {significant(y)} {significant(z)} mm (1 σ): that "
            "matters only with other intrinsics. "
            + ("" if kept is None else f"{given_in_words(kept).capitalize()}.")
        ),
    )


def _figure(result: RunResult, distance_m: float) -> str:
    """The image with contours in millimetres, each with its number."""
    used = result.image_index[result.hand_eye.inliers]
    pixels = read_image(result.capture.folder / result.capture.images[used[len(used) // 2]])
    width, height = ACROSS, round(ACROSS * pixels.shape[0] / pixels.shape[1])
    small = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    field = cv2.resize(_field_mm(result, distance_m), (width, height), interpolation=cv2.INTER_CUBIC)
    least = float(field.min())
    drawn = [_contour(field, times * least) for times in LEVELS if times * least < field.max()]
    v, u = np.unravel_index(int(field.argmin()), field.shape)
    centre = f'<text class="level" x="{u}" y="{v}">{significant(least)} mm</text>'
    label = f"95 % of the errors of a point at {significant(distance_m)} m, in millimetres, over an image"
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(label)}">'
        f'<image href="{picture_url(small, "JPEG")}" width="{width}" height="{height}"/>'
        f"{''.join(drawn)}{centre}</svg>"
    )


def _field_mm(result: RunResult, distance_m: float) -> Float[ndarray, "h w"]:
    lens = result.lens
    rows = max(round(GRID * lens.height / lens.width), 2)
    u, v = np.meshgrid(np.linspace(0, lens.width - 1, GRID), np.linspace(0, lens.height - 1, rows))
    covariance = result.seen_uncertainty(np.stack([u, v], axis=-1), distance_m)
    return 1e3 * np.array([[within_95(one) for one in row] for row in covariance])


def _contour(field: Float[ndarray, "h w"], level: float) -> str:
    """Lines along which the field has one value, and the value where each line begins."""
    height, width = field.shape
    found, _ = cv2.findContours((field < level).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    parts = []
    for line in found:
        points = line[:, 0]
        inside = ((points > 0) & (points < [width - 1, height - 1])).all(1)
        # Where the line follows the border of the image it is none.
        starts = np.flatnonzero(inside & ~np.roll(inside, 1)) if not inside.all() else [0]
        for start in starts:
            along = np.roll(points, -start, axis=0)
            held = np.roll(inside, -start)
            along = along[: len(held) if held.all() else int(np.argmin(held))][::4]
            if len(along) < 8:
                continue
            parts.append(
                f'<polyline class="contour" points="{" ".join(f"{x},{y}" for x, y in along)}"/>'
                f'<text class="level" x="{along[len(along) // 2][0]}" y="{along[len(along) // 2][1]}">'
                f"{significant(level)}</text>"
            )
    return "".join(parts)
