"""A calibration in words: what terminal, log.txt and report say of it alike, each thing put into words once."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.calibration.calibration_json import CalibrationFile, GivenIntrinsicsKept
from jcr.calibration.uncertainty_json import SeenAndCorners, UncertaintyBudget
from jcr.findings import is_explained, sentence, verdict_of
from jcr.findings.sentences import network_scale, reached_in_words
from jcr.records import Attempt, BoardFound, DepthCheck, LeaveOneOut
from jcr.rounding import significant, with_std

NOTHING = 0.02
"""Of the largest part of a budget: its square is nothing beside that of the whole."""


def summary(content: CalibrationFile) -> str:
    """What was found, what was left out, and what would help."""
    lines = found(content)
    lines += [f"  not used: {image.image}: {image.reason}" for image in content.images if not image.used]
    if content.next_poses and not is_explained(content.findings):
        last = content.next_poses[-1]
        # Files of earlier versions expect of the camera alone.
        then = f"the camera ± {' '.join(significant(1e3 * std) for std in last.expected_std[:3])} mm"
        if last.within_95_mm is not None and last.rotation_95_deg is not None:
            seen = f"{significant(last.within_95_mm)} mm and {significant(last.rotation_95_deg)}°"
            then = f"a seen point within {seen} (95 % of errors), {then}"
        near = ", ".join(pose.like for pose in content.next_poses)
        if content.mostly_systematic:
            lines.append(
                "most of ± comes from systematic robot errors: more images of the same region will hardly help; images "
                "of another region of the workspace, or the joint angles (capture.json: joints and robot), would"
            )
        required = content.requirement
        reach = required is not None and bool(required.more_images)
        lines.append(
            f"{len(content.next_poses)} more views, like {near} but rotated (next_poses in calibration.json), "
            f"would give {then}{', within what is needed' if reach else ''}"
        )
    return "\n".join(lines) + "\n"


def found(content: CalibrationFile) -> list[str]:
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
        f"  x y z (m), qx qy qz qw: {_as_quaternion(np.array(content.parent_from_camera))}",
        f"  ± {x:.2f} {y:.2f} {z:.2f} mm, {rx:.3f} {ry:.3f} {rz:.3f} ° (1 σ; worst {uncertainty.worst})",
    ]
    if uncertainty.budget is not None:
        parts = "; ".join(f"{name} {size}" for name, size in budget_in_words(uncertainty.budget).items())
        lines.append(f"  from: {parts}")
    if content.requirement is not None:
        lines.append(f"  {reached_in_words(content.requirement)}")
    if (seen := uncertainty.seen) is not None and uncertainty.joint is not None:
        lines.append(f"  {seen_in_words(seen)}")
    if content.with_given_intrinsics is not None:
        lines.append(f"  {given_in_words(content.with_given_intrinsics)}")
    lines.append(f"scale {scale:.6g} m per unit ± {uncertainty.scale_std_percent:.2g} %")
    if content.scale_check is not None:
        lines.append(f"  {network_scale(content.scale_check.off_percent, content.scale_check.std_percent)}")
    if content.depth_check is not None:
        lines.append(depth_in_words(content.depth_check))
    if content.board is not None:
        lines.append(board_in_words(content.board))
    if (held_out := content.held_out) is not None:
        lines.append(
            f"leave-one-out error: {leave_one_out_text(held_out)}{pixels(held_out)} ({held_out.how})"
        )
    return lines


def board_in_words(board: BoardFound) -> str:
    """What a board beside features came to."""
    stated = "" if board.stated_mm is None else f", {board.stated_mm:g} mm stated"
    return (
        f"board: sides of {with_std(board.side_mm, board.side_std_mm)} mm by the robot{stated}; "
        f"{board.corners} corners in {board.images} images, {board.rms_px:.2f} px, bent by "
        f"{significant(board.bend_mm)} mm"
    )


def seen_in_words(seen: SeenAndCorners) -> str:
    """What the uncertainty of a point that the camera sees is made of, and where it is largest."""
    return (
        f"of a seen point: {significant(seen.lateral_95_mm)} mm across the ray and {significant(seen.along_95_mm)} mm "
        f"along it, {significant(seen.corners.within_95_mm)} mm in a corner of the image, with the intrinsics of this "
        "run and exact gripper poses"
    )


def given_in_words(given: GivenIntrinsicsKept) -> str:
    """How far the given intrinsics lead from the estimated ones where it matters."""
    return (
        f"with the given intrinsics and their transform (with_given_intrinsics) the same point is "
        f"{significant(given.differs_mm)} mm from there, and within {significant(given.seen.within_95_mm)} mm"
    )


def verdict_in_words(content: CalibrationFile) -> str:
    """The verdict, with the first reason where it is rejected or accepted with warnings."""
    reasons = [sentence(one) for one in content.findings if one.severity != "informs"]
    return ": ".join((verdict_of(content.findings), *reasons[:1]))


def _as_quaternion(matrix: Float[ndarray, "4 4"]) -> str:
    quat_xyzw = Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True)
    return " ".join(f"{number:.6f}" for number in (*matrix[:3, 3], *quat_xyzw))


def budget_in_words(budget: UncertaintyBudget) -> dict[str, str]:
    """What the uncertainty comes from, largest first, each with its size; negligible parts are left out."""
    named = {
        "random robot errors": budget.robot_random,
        "systematic robot errors": budget.robot_systematic,
        "intrinsics": budget.intrinsics,
        "images": budget.images,
    }
    if budget.faults is not None:
        named["faults found"] = budget.faults
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


def log(content: CalibrationFile) -> str:
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


def leave_one_out_text(held_out: LeaveOneOut) -> str:
    """By how much images left out are missed."""
    return f"{significant(held_out.translation_mm)} mm and {significant(held_out.rotation_deg)}°"


def pixels(held_out: LeaveOneOut) -> str:
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
