"""The section of residuals: a bar each image, and the fit as a whole, before and after features refined it."""

from collections.abc import Sequence
from html import escape

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.words import missed
from jcr.geometry import step_between
from jcr.records import HandEye
from jcr.report.markup import filled
from jcr.report.pictures import shown_names
from jcr.results import PosesResult, RunResult
from jcr.rounding import significant


def residuals_section(result: RunResult | PosesResult) -> str:
    """Residuals image by image and of the whole, before and after the images' features refined the fit."""
    now, before = result.hand_eye, result.hand_eye.before
    rows, used = [], now.inliers
    fits = [now] if before is None else [now, before]
    longest_mm, longest_deg = (
        max(float(residual(fit)[used].max(initial=0.0)) for fit in fits) or 1.0
        for residual in (_residual_mm, _residual_deg)
    )
    names = shown_names(result.calibration.images)
    for k, row in enumerate(result.image_index):
        position = _bar([_residual_mm(fit)[k] for fit in fits], longest_mm, " mm")
        orientation = _bar([_residual_deg(fit)[k] for fit in fits], longest_deg, "°")
        rows.append(
            f'<tr class="{"used" if used[k] else "rejected"}"><th>{escape(names[int(row)])}</th>'
            f"<td>{position}</td><td>{orientation}</td></tr>"
        )
    heads, moved, tick = ["from camera poses"], "", ""
    if before is not None:
        step = step_between(before.gripper_from_camera, now.gripper_from_camera)
        heads = ["from camera poses alone", "with the images' features"]
        moved = (
            "<p>Refining with the images' features moved the camera on the gripper by "
            f"{significant(1e3 * float(np.linalg.norm(step[:3])))} mm and "
            f"{significant(float(np.degrees(np.linalg.norm(step[3:]))))}°.</p>"
        )
        tick = (
            " The upright tick is the same image by camera poses alone, before its features refined the fit."
        )
    return filled(
        "residuals.html",
        noise=_why_noise_is_larger(now),
        tick=tick,
        rows="".join(rows),
        heads="".join(f"<th>{head}</th>" for head in heads),
        whole=_whole(fits[::-1]),
        moved=moved,
    )


def _residual_mm(fit: HandEye) -> Float[ndarray, " n"]:
    return 1e3 * fit.images.translation_residual_m


def _residual_deg(fit: HandEye) -> Float[ndarray, " n"]:
    return np.degrees(fit.images.rotation_residual_rad)


def _why_noise_is_larger(fit: HandEye) -> str:
    """Why the robot pose noise per axis is not the size of the residuals."""
    count = 6 * int(fit.inliers.sum())
    taken = np.sqrt(count / max(count - 13, 1))
    noise, together = fit.robot_noise.translation, fit.robot_noise.together[0]
    return (
        f"The robot pose noise ({significant(1e3 * noise)} mm per axis"
        + (f", {significant(1e3 * together)} mm with systematic errors" if together > 1.05 * noise else "")
        + f") may be more than what these bars suggest: 13 unknowns were fitted to {count} numbers and took part of it "
        f"away (a factor of {taken:.2f}), features pull the poses towards them, and of few images its size is itself "
        "uncertain, which is counted. A bar is the length of three axes together."
    )


def _bar(values: Sequence[float], longest: float, unit: str) -> str:
    """A bar for the first value, a tick for the second if there is one."""
    shares = [min(100 * value / longest, 100) for value in values]
    tick = f'<b style="left:{shares[1]:.1f}%"></b>' if len(shares) > 1 else ""
    return (
        f'<div class="bar"><div class="track"><i style="width:{shares[0]:.1f}%"></i>{tick}</div>'
        f"<span>{significant(values[0])}{unit}</span></div>"
    )


def _whole(fits: Sequence[HandEye]) -> str:
    held_out = [missed(fit.held_out) if fit.held_out else "–" for fit in fits]
    rows = {
        "leave-one-out error": held_out,
        "mean δ<sub>t</sub>": [f"{significant(1e3 * fit.residuals.translation)} mm" for fit in fits],
        "mean δ<sub>R</sub> (Frobenius norm)": [significant(fit.residuals.rotation) for fit in fits],
    }
    return "".join(
        f"<tr><th>{name}</th>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
        for name, cells in rows.items()
    )
