"""A calibration in words: what terminal, log.txt and report say of it alike, each thing put into words once."""

from typing import TYPE_CHECKING

import numpy as np

from jcr.records import Attempt, DepthCheck, HeldOut, Requirement, ScaleCheck
from jcr.rounding import significant

if TYPE_CHECKING:
    from jcr.calibration.calibration_json import (
        CalibrationFile,
        HeldOutError,
        NetworkScale,
        UncertaintyBudget,
    )

CLEAR = 0.01
"""Chance of residuals by random errors alone, below which systematic ones are spoken of."""
SURE = 2.5
"""Standard deviations from which a joint's offset, or a ratio of angles, is named."""
NOTABLE_RATIO = 0.003
NOTABLE_ERRORS = 0.03, 0.003
"""mm, degrees; real arms err by more, and of less nobody need hear."""
SHORT = "not as exact as needed"
SCALE_FROM_ROBOT = (
    "the scale comes from the robot's positions alone: if all of them are wrong by one factor, no image shows it, and ± "
    "does not include it; the size of a board or --known-length would show it"
)
NOTHING = 0.02
"""Of the largest part of a budget: its square is nothing beside that of the whole."""


def summary(content: "CalibrationFile") -> str:
    """What was found, what was left out, and what would help."""
    lines = found(content)
    lines += [f"  not used: {image.image}: {image.reason}" for image in content.images if not image.used]
    if content.next_poses:
        then = " ".join(significant(1e3 * std) for std in content.next_poses[-1].expected_std[:3])
        near = ", ".join(pose.like for pose in content.next_poses)
        if (
            content.uncertainty is not None
            and content.uncertainty.budget is not None
            and not more_images_help(content.uncertainty.budget)
        ):
            lines.append(
                "most of ± comes from systematic robot errors: more images of the same region will hardly help; images "
                "of another region of the workspace, or the joint angles (capture.json: joints and robot), would"
            )
        required = content.requirement
        reach = required is not None and bool(required.more_images)
        lines.append(
            f"{len(content.next_poses)} more views, like {near} but rotated (next_poses in calibration.json), "
            f"would give ± {then} mm{', within what is needed' if reach else ''}"
        )
    return "\n".join(lines) + "\n"


def found(content: "CalibrationFile") -> list[str]:
    """The transform and how sure it is, a line each; of a failure its reason."""
    uncertainty, scale = content.uncertainty, content.scale
    if uncertainty is None or scale is None:
        return [f"no calibration: {content.doubt}"]
    with np.printoptions(precision=6, suppress=True):
        matrix = str(np.array(content.parent_from_camera)).splitlines()
    x, y, z = uncertainty.translation_std_mm
    rx, ry, rz = uncertainty.rotation_std_deg
    lines = [
        f"{content.mount}_from_camera ({content.images_used} of {len(content.images)} images, "
        f"back end {content.backend})",
        *(f"  {row}" for row in matrix),
        f"  ± {x:.2f} {y:.2f} {z:.2f} mm, {rx:.3f} {ry:.3f} {rz:.3f} ° (1 σ; worst {uncertainty.worst})",
        *([] if content.requirement is None else [f"  {reached_in_words(content.requirement)}"]),
        f"scale {scale:.6g} m per unit ± {uncertainty.scale_std_percent:.2g} %",
    ]
    if uncertainty.budget is not None:
        parts = "; ".join(f"{name} {size}" for name, size in budget_in_words(uncertainty.budget).items())
        lines.insert(-1, f"  from: {parts}")
    if content.scale_check is not None:
        lines.append(f"  {scale_in_words(content.scale_check)}")
    if content.depth_check is not None:
        lines.append(depth_in_words(content.depth_check))
    lines += robot_in_words(content)
    if (held_out := content.held_out) is not None:
        lines.append(f"leave-one-out error: {missed(held_out)}{pixels(held_out)} ({held_out.how})")
    return lines


def reached_in_words(required: Requirement) -> str:
    """What 95 % of the errors stay below, and whether that is what was asked."""
    where = f" {significant(required.distance_mm, 3)} mm ahead of the camera" if required.distance_mm else ""
    asked = "asked for" if required.asked else "needed to grasp"
    return (
        f"95 % of errors are below {significant(required.reached_mm)} mm{where} and "
        f"{significant(required.reached_deg)}°; {needed(required)} are {asked}"
    )


def needed(required: Requirement) -> str:
    """The numbers that must be reached."""
    return f"{required.translation_mm:g} mm and {required.rotation_deg:g}°"


def shortfall(content: "CalibrationFile") -> str | None:
    """That the calibration is not as exact as is required, and what would help; None where it is."""
    if (required := content.requirement) is None or required.is_met:
        return None
    if required.more_images is not None:
        more = (
            f"add {required.more_images} image{'s' * (required.more_images > 1)} at the poses of next_poses"
        )
    elif (
        content.uncertainty is not None
        and content.uncertainty.budget is not None
        and not more_images_help(content.uncertainty.budget)
    ):
        more = "most of it comes from systematic robot errors: name the arm (--robot) or add its joint angles"
    else:
        more = "a dozen more images would not be enough; move closer to the scene, or use a better camera or robot"
    return f"{SHORT}: {reached_in_words(required)}; {more}"


def angles_in_words(ratio: float, std: float) -> list[str]:
    """What camera angles over gripper angles say, where they are clearly not 1; which X it is does not matter."""
    if abs(ratio - 1) <= max(SURE * std, NOTABLE_RATIO):
        return []
    more = "more" if ratio > 1 else "less"
    return [
        f"the camera rotates {100 * abs(ratio - 1):.2f} ± {100 * std:.2f} % {more} than the "
        f"gripper: the focal length or "
        "the robot's joints are off"
    ]


def robot_in_words(content: "CalibrationFile") -> list[str]:
    """What the poses tell of the robot itself, where they tell it clearly."""
    lines = []
    errors = content.robot_errors
    notable = errors is not None and (
        errors.translation_mm > NOTABLE_ERRORS[0] or errors.rotation_deg > NOTABLE_ERRORS[1]
    )
    if errors is not None and notable and errors.p is not None and errors.p < CLEAR:
        chance = f"p = {errors.p:.1g}" if errors.p > 1e-6 else "p < 1e-6"
        off = [
            (k, joint)
            for k, joint in enumerate(errors.joints or [], start=1)
            if abs(joint.offset_deg) > SURE * joint.std_deg
        ]
        if off:
            named = _joined([f"{k}" for k, _ in off])
            sizes = _joined([f"{joint.offset_deg:+.2f} ± {joint.std_deg:.2f}°" for _, joint in off])
            lines.append(f"robot: joint{'s' * (len(off) > 1)} {named} seem off by {sizes} ({chance})")
        else:
            lines.append(
                f"robot: neighbouring poses have similar errors, {errors.translation_mm:.2g} mm and "
                f"{errors.rotation_deg:.2g}° per axis ({chance}): joint offsets or link errors"
            )
    if (angles := content.angle_ratio) is not None:
        lines += angles_in_words(angles.ratio, angles.std)
    return lines


def _joined(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def more_images_help(budget: "UncertaintyBudget") -> bool:
    """Whether more images of the same region shrink the uncertainty, which is then mostly not systematic."""
    others = [budget.robot_random, budget.intrinsics, budget.images]
    return budget.robot_systematic.translation_mm**2 < sum(share.translation_mm**2 for share in others)


def budget_in_words(budget: "UncertaintyBudget") -> dict[str, str]:
    """What the uncertainty comes from, largest first, each with its size; negligible parts are left out."""
    named = {
        "random robot errors": budget.robot_random,
        "systematic robot errors": budget.robot_systematic,
        "intrinsics": budget.intrinsics,
        "images": budget.images,
    }
    ranked = sorted(named.items(), key=lambda item: -item[1].translation_mm)
    least_mm, least_deg = (
        NOTHING * max(getattr(share, unit) for share in named.values())
        for unit in ("translation_mm", "rotation_deg")
    )
    return {
        name: f"{share.translation_mm:.2f} mm {share.rotation_deg:.3f}°"
        for name, share in ranked
        if share.translation_mm > least_mm or share.rotation_deg > least_deg
    }


def log(content: "CalibrationFile") -> str:
    """log.txt: which back ends were tried, how long each stage took, what was found, what the user should know."""
    tried = [
        f"attempt {k}: {attempt_in_words(attempt, len(content.images))}"
        for k, attempt in enumerate(content.attempts, start=1)
    ]
    lines = [
        f"jcr {content.version}, back end {content.backend}",
        *tried,
        *(f"{stage}: {seconds:.2f} s" for stage, seconds in content.timings_s.items()),
        *found(content),
        *(f"{image.image}: {image.reason or 'used'}" for image in content.images),
        *(f"warning: {warning}" for warning in content.warnings),
        *(f"note: {note}" for note in content.notes),
    ]
    return "\n".join(lines) + "\n"


def attempt_in_words(attempt: Attempt, images: int) -> str:
    """The back end, what it registered of this many images, whether it was kept, and how long it took."""
    registered = (
        "nothing" if attempt.images_registered is None else f"{attempt.images_registered} of {images} images"
    )
    verdict = "kept" if attempt.why_not is None else f"not kept ({attempt.why_not})"
    times = f"reconstruct {attempt.reconstruct_s:.2f} s, calibrate {attempt.calibrate_s:.2f} s"
    features = f" with {attempt.features}" if attempt.features else ""
    return f"{attempt.backend}{features} registered {registered}, {verdict}; {times}"


def missed(held_out: "HeldOut | HeldOutError") -> str:
    """By how much images left out are missed."""
    return f"{significant(held_out.translation_mm)} mm and {significant(held_out.rotation_deg)}°"


def pixels(held_out: "HeldOut | HeldOutError") -> str:
    """The same in their images, to follow it; empty where no image tells."""
    return "" if held_out.reprojection_px is None else f", {significant(held_out.reprojection_px)} px"


def depth_in_words(check: DepthCheck) -> str:
    """What the robot says of a depth camera: its scale, and its noise near and far."""
    off, std = check.off_percent, check.std_percent
    size = f"are {abs(off):.2g} ± {std:.1g} % too {'long' if off > 0 else 'short'} compared with the robot's"
    if abs(off) < 2 * std:
        size = f"agree with the robot's ({off:+.2g} ± {std:.1g} %)"
    noise = " and ".join(
        f"{significant(1e3 * float(np.hypot(check.noise_m, check.noise_per_m * z**2)))} mm at {z:.2f} m"
        for z in check.distances_m
    )
    return f"depth camera: its lengths {size}; noise {noise} (1 σ); the map uses corrected depth"


def scale_in_words(check: "ScaleCheck | NetworkScale") -> str:
    """How far a network's own scale is from the robot's, and how sure that is."""
    off, std = check.off_percent, check.std_percent
    if abs(off) < 2 * std:
        return f"the network's own metre agrees with the robot's ({off:+.2g} ± {std:.2g} %)"
    if off > 100:
        return f"the network's own lengths are {1 + off / 100:.3g} times the robot's"
    direction = "long" if off > 0 else "short"
    return f"the network's own lengths are {abs(off):.3g} ± {std:.2g} % too {direction} compared with the robot's"
