"""Section of residuals: a bar for each image, and the whole fit before and after bundle adjustment."""

from collections.abc import Sequence

import numpy as np

from jcr.calibration.words import leave_one_out_text
from jcr.geometry import step_between
from jcr.records import HandEye
from jcr.report.images import shown_names
from jcr.report.render import Section
from jcr.rounding import significant
from jcr.run_folder import RunResult

NOTICEABLE = 1.05
"""Times the random noise, from which the noise with systematic errors is named beside it."""


def residuals_section(result: RunResult) -> Section:
    """Return residuals by image and of the whole fit, before and after bundle adjustment."""
    now, before = result.hand_eye, result.hand_eye.before
    fits = [now] if before is None else [now, before]
    names, used = shown_names(result.calibration.images), now.inliers
    columns = []
    mm = [1e3 * fit.translation_residual_m for fit in fits]
    deg = [np.degrees(fit.rotation_residual_rad) for fit in fits]
    for values, unit in ((mm, " mm"), (deg, "°")):
        longest = max(float(value[used].max(initial=0.0)) for value in values) or 1.0
        columns.append([_bar([value[k] for value in values], longest, unit) for k in range(len(used))])
    content = {
        "refined": None if before is None else _refinement(before, now),
        "rows": [
            (bool(used[k]), names[int(row)], [column[k] for column in columns])
            for k, row in enumerate(result.image_index)
        ],
        "noise": _noise(now),
        "whole": _whole(fits[::-1]),
    }
    return Section("residuals", content)


def _refinement(before: HandEye, now: HandEye) -> tuple[str, str]:
    """Return the step (mm, degrees) of the camera on the gripper by bundle adjustment."""
    step = step_between(before.gripper_from_camera, now.gripper_from_camera)
    degrees = float(np.degrees(np.linalg.norm(step[3:])))
    return significant(1e3 * float(np.linalg.norm(step[:3]))), significant(degrees)


def _noise(fit: HandEye) -> dict[str, str | int | None]:
    """Return the robot pose noise and the factor by which the fit reduces residuals."""
    count = 6 * int(fit.inliers.sum())
    noise, together = fit.robot_noise.translation, fit.robot_noise.together[0]
    return {
        "mm": significant(1e3 * noise),
        "together_mm": significant(1e3 * together) if together > NOTICEABLE * noise else None,
        "count": count,
        "factor": f"{np.sqrt(count / max(count - 13, 1)):.2f}",
    }


def _bar(values: Sequence[float], longest: float, unit: str) -> tuple[float, float | None, str]:
    """Return the bar's percent for the first value, the tick's for the second if any, and the number."""
    shares = [min(100 * float(value) / longest, 100.0) for value in values]
    return shares[0], shares[1] if len(shares) > 1 else None, f"{significant(values[0])}{unit}"


def _whole(fits: Sequence[HandEye]) -> dict[str, list[str]]:
    """Return leave-one-out error and mean residuals of each fit."""
    return {
        "error": [leave_one_out_text(fit.leave_one_out) if fit.leave_one_out else "–" for fit in fits],
        "translation": [f"{significant(1e3 * fit.residuals.translation)} mm" for fit in fits],
        "rotation": [significant(fit.residuals.rotation) for fit in fits],
    }
