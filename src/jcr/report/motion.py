"""The section on what the motions show of the calibration, and which gripper poses would show more."""

import json
from collections.abc import Sequence
from html import escape

import numpy as np

from jcr.capture.robot_poses import CONVENTIONS, OF_ARM, numbers_from_poses, units_of
from jcr.handeye.observability import WEAK
from jcr.records import Excitation, NextPose
from jcr.report.markup import filled
from jcr.report.transform import copy_button
from jcr.results import PosesResult, RunResult
from jcr.rounding import significant

ANY_CONVENTION = "quat-xyzw"
PARTS = ("translation x", "translation y", "translation z", "rotation x", "rotation y", "rotation z", "scale")
"""Of a direction, in records.COVARIANCE_ORDER."""
NAMED = 0.4
"""Share of a unit direction from which a part is named."""
GENERAL = 0.4
"""Excitation that general motions reach: the full length of a bar."""


def motion_section(result: RunResult | PosesResult) -> str:
    """Excitation of the seven directions, standard deviations of their parts, and the poses to add."""
    calibration = result.calibration
    observed, uncertainty = calibration.observability, calibration.uncertainty
    says = "<p>The motions show every direction of the calibration: offset, orientation and scale.</p>"
    if not observed.observable:
        pairs = zip(observed.unobservable, observed.advice, strict=False)
        items = "".join(
            f"<li><b>{escape(name)}</b>{'; remedy: ' if remedy else ''}{escape(remedy)}</li>"
            for name, remedy in pairs
        )
        says = f"<p>The motions leave unseen:</p><ul>{items}</ul>"
    spreads = ""
    if uncertainty is not None:
        offset = _spreads("translation along", uncertainty.translation_std_mm, " mm")
        turn = _spreads("rotation about", uncertainty.rotation_std_deg, "°")
        spreads = (
            f'<h3>What that leaves uncertain</h3><div class="columns">{offset}{turn}</div>'
            '<p class="soft">One standard deviation, axes of the gripper frame; scale '
            f"±{significant(uncertainty.scale_std_percent)}\u00a0%.</p>"
        )
    found = result.hand_eye.plan.excitation
    bars = "" if found is None else excitation_bars(found)
    return filled("motion.html", says=says, bars=bars, spreads=spreads, next_poses=_next_poses(result))


def excitation_bars(found: Excitation) -> str:
    """A bar each principal direction, least seen first, with a tick at what counts as unseen."""
    tick, rows = 100 * WEAK / GENERAL, []
    for value, direction in zip(found.value, np.abs(found.direction), strict=True):
        parts = [PARTS[k] for k in np.argsort(-direction) if direction[k] > NAMED]
        name = ", ".join(parts) or PARTS[int(direction.argmax())]
        kind = "used" if value >= WEAK else "rejected"
        bar = f'<i style="width:{min(100 * value / GENERAL, 100):.1f}%"></i><b style="left:{tick:.1f}%"></b>'
        rows.append(
            f'<tr class="{kind}"><th>{name}</th><td><div class="track">{bar}</div></td>'
            f"<td>{significant(float(value))}</td></tr>"
        )
    return (
        '<h3>How far the motions show each direction</h3><p class="soft">By how many metres one metre along it '
        "moves the gripper positions that the calibration predicts (0.3 m for a radian); least seen first. General "
        'motions reach about 0.4; left of the tick a direction counts as unseen.</p><table class="spread"><tbody>'
        f"{''.join(rows)}</tbody></table>"
    )


def _spreads(name: str, std: Sequence[float], unit: str) -> str:
    """A bar each axis, as wide as ± one standard deviation against the largest of them."""
    rows = []
    for axis, value in zip("xyz", std, strict=True):
        half = 50 * value / (max(std) or 1.0)
        bar = f'<i style="left:{50 - half:.1f}%;width:{2 * half:.1f}%"></i><b></b>'
        rows.append(
            f'<tr><th>{name} {axis}</th><td><div class="track centred">{bar}</div></td>'
            f"<td>±{significant(value)}{unit}</td></tr>"
        )
    return f'<table class="spread"><tbody>{"".join(rows)}</tbody></table>'


def _next_poses(result: RunResult | PosesResult) -> str:
    """The proposed gripper poses, what each would leave uncertain, ready to copy."""
    poses, told = result.hand_eye.next_poses, result.calibration.next_poses
    if not poses:
        return ""
    convention = _convention(result)
    rows = "".join(
        _next_pose(number, pose, like.like, convention)
        for number, (pose, like) in enumerate(zip(poses, told, strict=True), 1)
    )
    columns = ", ".join(CONVENTIONS[convention].columns)
    matrix = convention in ("franka", "matrix")
    written = f"the matrix by {'columns' if convention == 'franka' else 'rows'}" if matrix else columns
    notation = f"{written} ({units_of(convention)}), as {convention} writes poses"
    green = " The 3D view shows them in green." if isinstance(result, RunResult) else ""
    return (
        '<h3>Poses to add</h3><p class="soft">Gripper poses that would make a seen point most exact, one after the '
        f"other, in reach of those of the capture; look that the arm is free to go there.{green} Numbers: "
        f"{escape(notation)}; matrix copies base_from_gripper (m).</p>"
        '<div class="scroll"><table><thead><tr><th></th><th>pose</th><th>from</th><th>by</th><th>then a seen point, '
        "95\u00a0%</th>"
        f"<th>the camera, 1\u00a0σ</th></tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _convention(result: RunResult | PosesResult) -> str:
    """How the capture's robot writes poses; a quaternion where neither its file nor its arm tells."""
    if not isinstance(result, RunResult):
        return ANY_CONVENTION
    capture = result.capture
    return capture.pose_convention or OF_ARM.get(capture.robot or "") or ANY_CONVENTION


def _next_pose(number: int, pose: NextPose, near: str, convention: str) -> str:
    std = pose.expected_std
    numbers = numbers_from_poses(pose.base_from_gripper[None], convention)[0]
    written = ", ".join(f"{value:.4f}" for value in numbers)
    matrix = json.dumps(pose.base_from_gripper.round(6).tolist())
    shown = "" if len(numbers) == 16 else f"<code>{written}</code> "
    cells = (
        f"{shown}{copy_button(written, f'pose {number}')} "
        f"{copy_button(matrix, f'pose {number} as a matrix').replace('>copy<', '>matrix<')}",
        escape(near),
        f"{1e3 * pose.moved_m:.0f}\u00a0mm, {np.degrees(pose.turned_rad):.0f}°",
        f"{significant(pose.within_95_mm)}\u00a0mm, {significant(pose.rotation_95_deg)}°",
        f"±{significant(1e3 * float(std[:3].max()))}\u00a0mm, "
        f"±{significant(float(np.degrees(std[3:6].max())))}°, ±{significant(100 * float(std[6]))}\u00a0%",
    )
    return f"<tr><th>{number}</th>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
