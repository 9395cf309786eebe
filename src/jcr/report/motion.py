"""Section of observability and uncertainty in the report."""

from collections.abc import Iterator, Sequence

import numpy as np

from jcr.calibration.summary import given_in_words, seen_in_words
from jcr.estimation.observability import WEAK, Excitation, excitation
from jcr.number_format import significant
from jcr.report.render import Content
from jcr.result import RunResult

COMPONENTS = (
    "translation x",
    "translation y",
    "translation z",
    "rotation x",
    "rotation y",
    "rotation z",
    "scale",
)
"""Names of the seven components of a direction, in records.COVARIANCE_ORDER."""
NAMED_FROM = 0.4
"""Absolute value from which a component of a unit direction is named."""
GENERAL = 0.4
"""Excitation that is drawn as a bar of full length; general motions reach it."""

Bar = tuple[str, float, float, str]
"""Bar of a chart: name, left end and width (percent of the chart), and number as text."""


def motion_section(result: RunResult) -> Content:
    """Return the section on motion: bars of excitation and of standard deviations.

    Excitation is how strongly the motions determine gripper_from_camera and scale (seven parameters), by direction.
    """
    calibration, spreads, seen = result.calibration, list[list[Bar]](), list[str]()
    observed, uncertainty = calibration.observability, calibration.uncertainty
    if uncertainty is not None:
        spreads.append(list(_spreads("translation along", uncertainty.translation_std_mm, " mm")))
        spreads.append(list(_spreads("rotation about", uncertainty.rotation_std_deg, "°")))
        if (at := uncertainty.seen) is not None:
            distance = significant(1e-3 * at.distance_mm)
            seen.append(f"At {distance} m: {seen_in_words(at)} (95 % of the errors).")
            if (kept := calibration.with_given_intrinsics) is not None:
                seen.append(f"{given_in_words(kept).capitalize()}.")
    gripper = result.capture.base_from_gripper[[image.used for image in calibration.images]]
    bars = []
    if len(gripper) > 1:
        bars = list(excitation_bars(excitation(gripper, result.found.gripper_from_camera)))
    return {
        "unobservable": list(zip(observed.unobservable, observed.advice, strict=False)),
        "is_observable": observed.observable,
        "tick": f"{100 * WEAK / GENERAL:.1f}",
        "excitation": bars,
        "seen": seen,
        "spreads": spreads,
        "scale_percent": "" if uncertainty is None else significant(uncertainty.scale_std_percent),
    }


def excitation_bars(found: Excitation) -> Iterator[tuple[str, str, float, str]]:
    """Yield a bar (CSS class, name, length in percent, number) for each direction of the seven parameters.

    The direction that the motions determine least comes first. The name lists the direction's components above 0.4, the
    number is its excitation, and an excitation of 0.4 or more has length 100.
    """
    for value, direction in zip(found[0], np.abs(found[1]), strict=True):
        parts = [COMPONENTS[k] for k in np.argsort(-direction) if direction[k] > NAMED_FROM]
        name = ", ".join(parts) or COMPONENTS[int(direction.argmax())]
        kind = "used" if value >= WEAK else "rejected"
        yield kind, name, min(100 * float(value) / GENERAL, 100.0), significant(float(value))


def _spreads(name: str, std: Sequence[float], unit: str) -> Iterator[Bar]:
    """Yield a bar for each axis x, y, z, as wide as ± its standard deviation in `std` relative to the largest."""
    for axis, value in zip("xyz", std, strict=True):
        half = 50 * value / (max(std) or 1.0)
        yield f"{name} {axis}", 50 - half, 2 * half, f"±{significant(value)}{unit}"
