"""Section of residuals in the report: a bar for each image, and the residuals of the whole fit."""

import numpy as np

from jcr.calibration.summary import leave_one_out_text
from jcr.number_format import significant
from jcr.report.images import shown_names
from jcr.report.render import Content
from jcr.result import RunResult

NOTICEABLE = 1.05
"""Ratio of noise with systematic errors to random noise, above which the report states both."""


def residuals_section(result: RunResult) -> Content:
    """Return the section on residuals of gripper poses against camera poses (mm, degrees).

    The section contains the residuals of each image as numbers and bars, those of the whole fit, and the robot pose
    noise.
    """
    fit = result.found
    named = zip(shown_names(fit.images), fit.images, strict=True)
    rows = [(name, one) for name, one in named if one.translation_residual_mm is not None]
    used, columns = fit.inliers, []
    for values, unit in (
        (np.array([one.translation_residual_mm for _, one in rows], float), " mm"),
        (np.array([one.rotation_residual_deg for _, one in rows], float), "°"),
    ):
        share = 100 * values / (float(values[used].max(initial=0.0)) or 1.0)
        columns.append(
            [(min(s, 100.0), f"{significant(v)}{unit}") for s, v in zip(share, values, strict=True)]
        )
    noise, together = fit.robot_noise.translation, fit.robot_noise.together[0]
    count = 6 * int(used.sum())
    return {
        "rows": [(one.used, name, [column[k] for column in columns]) for k, (name, one) in enumerate(rows)],
        "noise": {
            "mm": significant(1e3 * noise),
            "together_mm": significant(1e3 * together) if together > NOTICEABLE * noise else None,
            "count": count,
            "factor": f"{np.sqrt(count / max(count - 13, 1)):.2f}",
        },
        "error": leave_one_out_text(fit.held_out) if fit.held_out else "–",
        "translation": f"{significant(1e3 * fit.residuals.translation)} mm",
        "rotation": significant(fit.residuals.rotation),
    }
