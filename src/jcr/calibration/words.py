"""Calibration in words: the summary on the terminal, and the details of log.txt and `--verbose`."""

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from jcr.calibration.record import AnyCalibration, Calibration
from jcr.findings import Finding, FindingKind, remedy, sentence, text, verdict_of, without_consequences
from jcr.findings.sentences import network_scale, worst_direction
from jcr.records import (
    Attempt,
    BoardFound,
    Budget,
    DepthCheck,
    LeaveOneOut,
    NextPose,
    Requirement,
    SeenAndCorners,
    Uncertainty,
    WithGivenIntrinsics,
    share_of,
)
from jcr.rounding import significant, with_std

NEGLIGIBLE = 0.02
"""Share of the largest part of a budget below which a part is left out: its square is 0.04 % of the whole."""
MOST_LINES = 14
"""Lines of a summary on the terminal, with the two that name the report and the next command."""
MORE_IMAGES = {FindingKind.UNCERTAIN, FindingKind.LEAVE_ONE_OUT}
"""Kinds whose remedy is more images, which do not help where something else rejects the calibration."""
BACKEND_NAMES = {"colmap": "COLMAP", "dust3r": "DUSt3R", "mast3r": "MASt3R", "da3": "Depth Anything 3"}
SCALE_SOURCES = {"board": "the board", "known length": "the known length", "depth camera": "the depth camera"}


def labelled(label: str, *lines: str) -> list[str]:
    """Return lines behind a label in a column of 12 characters."""
    return [f"{label if k == 0 else '':<12}{line}" for k, line in enumerate(lines)]


def headline(content: AnyCalibration) -> str:
    """Return the verdict, the required accuracy, the images used, the back end and the time, in one line."""
    verdict = verdict_in_words(content.findings)
    limit = "" if content.requirement is None else f" ({_limit(content, content.requirement)})"
    backend = BACKEND_NAMES.get(content.backend, content.backend)
    used = f"{content.images_used} of {len(content.images)} images"
    return f"{verdict}{limit}. {used}, {backend}, {sum(content.timings_s.values()):.0f} s"


def verdict_in_words(findings: Iterable[Finding]) -> str:
    """Return the verdict in capitals, with the number of warnings."""
    findings = without_consequences(tuple(findings))
    verdict = verdict_of(findings)
    warnings = sum(one.severity == "warns" for one in findings)
    if verdict != "accepted with warnings":
        return verdict.upper()
    return f"ACCEPTED with {warnings} warning{'s' * (warnings > 1)}"


def _limit(content: AnyCalibration, required: Requirement) -> str:
    """Return the requirement, and where in the image it is not met."""
    limit = f"limit {required.translation_mm:g} mm, {required.rotation_deg:g}°"
    if not required.met:
        return f"{limit} not met"
    corner = None if content.uncertainty is None else content.uncertainty.corner
    if corner is None or required.at != "seen":
        return limit
    exceeded = [
        size
        for size, is_larger in (
            (f"{significant(corner.within_95_mm)} mm", corner.within_95_mm > required.translation_mm),
            (f"{significant(corner.rotation_95_deg)}°", corner.rotation_95_deg > required.rotation_deg),
        )
        if is_larger
    ]
    return f"{limit} met at the image centre, not in the corner: {', '.join(exceeded)}" if exceeded else limit


def summary(content: AnyCalibration, most: int = MOST_LINES) -> str:
    """Return at most `most` lines, two of which are left to the caller: verdict, transform, accuracy, what to act on.

    A rejected calibration has its cause and remedy instead of the transform.
    """
    lines = [headline(content)]
    if isinstance(content, Calibration) and content.converged:
        lines += _transform(content)
    proposed = _proposed(content.next_poses)
    if content.converged and content.short is None and proposed:
        lines += labelled("To improve", proposed)
    return "\n".join([*lines, *actions(content.findings, most - 2 - len(lines), proposed)]) + "\n"


def _transform(content: Calibration) -> list[str]:
    """Return the transform with its standard deviations, the accuracy and the intrinsics."""
    uncertainty, matrix = content.uncertainty, content.parent_from_camera
    quat_xyzw = Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True)
    x, q = (" ".join(f"{number:8.5f}" for number in part) for part in (matrix[:3, 3], quat_xyzw))
    offset = " ".join(significant(size) for size in uncertainty.translation_std_mm)
    rotation = " ".join(significant(size) for size in uncertainty.rotation_std_deg)
    return [
        f"{content.mount}_from_camera (optical frame; m, quaternion xyzw)",
        f"  {x}   {q}",
        f"  1σ: {offset} mm, {rotation}°",
        *labelled("Accuracy", _accuracy(content, uncertainty), _tested(content, uncertainty)),
        *_intrinsics(content),
    ]


def _accuracy(content: Calibration, uncertainty: Uncertainty) -> str:
    """Return the bounds of 95 % of the errors, at the centre and in the corner, or as `--require-at` has it."""
    required = content.requirement
    if required is None:
        return "unknown"
    bound = f"{significant(required.reached_mm)} mm, {significant(required.reached_deg)}° (95 %)"
    if required.at == "camera":
        return f"the camera's own place: {bound}"
    if required.at == "scene":
        return f"mapped points: {bound}"
    at = f"a point at {significant(1e-3 * required.distance_mm)} m: {bound}"
    if (corner := uncertainty.corner) is None:
        return at
    return f"{at} at the image centre; {significant(corner.within_95_mm)} mm in the corner"


def _tested(content: Calibration, uncertainty: Uncertainty) -> str:
    """Return the leave-one-out error, and the scale's standard deviation with its sources."""
    parts = [] if content.held_out is None else [f"leave-one-out: {leave_one_out_text(content.held_out)}"]
    used = [SCALE_SOURCES[one.name] for one in content.lengths if one.used and one.name in SCALE_SOURCES]
    sources = " and ".join(["the robot", *used]) if used else "the robot alone"
    return "; ".join([*parts, f"scale ±{uncertainty.scale_std_percent:.2g} %, from {sources}"])


def _intrinsics(content: Calibration) -> list[str]:
    """Return the intrinsics that belong to the transform; nothing where poses alone were given."""
    camera = content.intrinsics
    if camera is None:
        return []
    given = content.with_given_intrinsics is not None
    how = "used" if camera.std is None else "given, refined" if given else "estimated"
    numbers = " ".join(f"{name} {getattr(camera, name):.1f}" for name in ("fx", "fy", "cx", "cy"))
    return labelled("Intrinsics", f"{how}: {numbers}; use them together with the transform")


def actions(findings: Sequence[Finding], most: int, proposed: str = "") -> list[str]:
    """Return cause and remedy of a rejection, then warnings, on at most `most` lines.

    `proposed` are the images to add; they take the place of that remedy.
    """
    findings, lines = without_consequences(findings), list[str]()
    if verdict_of(findings) == "rejected":
        cause, *others = findings
        findings = [one for one in others if cause.kind in MORE_IMAGES or one.kind not in MORE_IMAGES]
        lines = [
            *labelled("Cause", text(cause)),
            *labelled("Remedy", *filter(None, [_remedy(cause, proposed)])),
        ]
    for one in findings:
        if (
            one.kind is FindingKind.NOT_EXACT_ENOUGH
        ):  # the verdict states the requirement, another line the accuracy
            lines += labelled("WARNING", f"the limit is not met; {_remedy(one, proposed)}")
        elif one.severity != "informs":
            lines += labelled("WARNING", sentence(one))
    if len(lines) <= most:
        return lines
    return [
        *lines[: most - 1],
        *labelled("", f"{len(lines) - most + 1} more with --verbose and in the report"),
    ]


def _remedy(finding: Finding, proposed: str) -> str:
    """Return the remedy of a finding; where this is more images, those proposed."""
    is_images = finding.kind is FindingKind.NOT_EXACT_ENOUGH and finding.concerns == "images"
    return proposed if is_images and proposed else remedy(finding)


def _proposed(poses: Sequence[NextPose]) -> str:
    """Return the gripper poses to add, and the accuracy expected with all of them; empty where none is proposed."""
    if not poses:
        return ""
    last = poses[-1]
    then = f"; expected {significant(last.within_95_mm)} mm, {significant(last.rotation_95_deg)}° (95 %)"
    count = f"{len(poses)} image{'s' * (len(poses) > 1)}"
    return f"add {count} (poses in calibration.json, next_poses){then}"


def details(content: AnyCalibration) -> list[str]:
    """Return the lines of `--verbose` and log.txt: attempts, times, matrix, budget, comparisons, images, findings."""
    tried = (
        f"attempt {k}: {attempt_in_words(attempt, len(content.images))}"
        for k, attempt in enumerate(content.attempts, start=1)
    )
    findings = (
        f"{one.severity}: {sentence(one)}{'' if one.p is None else f' (p = {one.p:.0e})'}"
        for one in content.findings
    )
    informs = {sentence(one) for one in content.findings}
    return [
        f"jcr {content.version}, back end {content.backend}",
        *tried,
        *(f"{stage}: {seconds:.2f} s" for stage, seconds in content.timings_s.items()),
        *_sizes(content),
        *(f"{image.image}: {image.reason or 'used'}" for image in content.images),
        *findings,
        *(f"note: {note}" for note in content.notes if note not in informs),
    ]


def _sizes(content: AnyCalibration) -> list[str]:
    """Return the matrix, the budget of its uncertainty, and the comparisons of lengths; nothing of a failure."""
    if not isinstance(content, Calibration):
        return []
    uncertainty, scale = content.uncertainty, content.scale
    with np.printoptions(precision=6, suppress=True):
        matrix = str(np.array(content.parent_from_camera)).splitlines()
    lines = [f"{content.mount}_from_camera", *(f"  {row}" for row in matrix)]
    lines.append(f"least certain {worst_direction(content.parent_from_camera, uncertainty.covariance)}")
    if uncertainty.budget is not None:
        parts = "; ".join(f"{name} {size}" for name, size in budget_in_words(uncertainty.budget).items())
        lines.append(f"1σ comes from {parts}")
    if uncertainty.seen is not None and uncertainty.joint is not None:
        lines.append(seen_in_words(uncertainty.seen))
    if content.with_given_intrinsics is not None:
        lines.append(given_in_words(content.with_given_intrinsics))
    lines.append(f"scale {scale:.6g} m per unit ± {uncertainty.scale_std_percent:.2g} %")
    if content.scale_check is not None:
        lines.append(network_scale(content.scale_check.off_percent, content.scale_check.std_percent))
    if content.depth_check is not None:
        lines.append(depth_in_words(content.depth_check))
    if content.board is not None:
        lines.append(board_in_words(content.board))
    if content.held_out is not None:
        lines.append(f"leave-one-out error: {leave_one_out_text(content.held_out)} ({content.held_out.how})")
    return lines


def log(content: AnyCalibration) -> str:
    """Return the text of log.txt: the summary with every warning, then the details."""
    return summary(content, 1000) + "\n" + "\n".join(details(content)) + "\n"


def board_in_words(board: BoardFound) -> str:
    """Return the side, the images and the bend of a board beside features."""
    stated = "" if board.stated_mm is None else f", {board.stated_mm:g} mm stated"
    return (
        f"board: sides of {with_std(board.side_mm, board.side_std_mm)} mm by the robot{stated}; "
        f"{board.corners} corners in {board.images} images, {board.rms_px:.2f} px, bent by "
        f"{significant(board.bend_mm)} mm"
    )


def seen_in_words(seen: SeenAndCorners) -> str:
    """Return the parts of the point uncertainty, across the ray, along it, and in the corner of the image."""
    return (
        f"point uncertainty: {significant(seen.lateral_95_mm)} mm across the ray and "
        f"{significant(seen.along_95_mm)} mm along it, {significant(seen.corners.within_95_mm)} mm in a corner of the "
        "image, with the intrinsics of this run and exact gripper poses"
    )


def given_in_words(given: WithGivenIntrinsics) -> str:
    """Return how far apart the given and the estimated intrinsics place a point, each with its own transform."""
    return (
        f"with the given intrinsics and their transform (with_given_intrinsics) the same point is "
        f"{significant(given.differs_mm)} mm from there, and within {significant(given.seen.within_95_mm)} mm"
    )


def budget_in_words(budget: Budget) -> dict[str, str]:
    """Return the size of each part of the uncertainty, largest first; negligible parts are left out."""
    named = {
        "random robot errors": budget.robot_random,
        "systematic robot errors": budget.robot_systematic,
        "intrinsics": budget.intrinsics,
        "images": budget.images,
        "faults found": budget.faults,
    }
    shares = ((name, share_of(part)) for name, part in named.items())
    sizes = [(name, share.translation_mm, share.rotation_deg) for name, share in shares]
    least_mm, least_deg = NEGLIGIBLE * np.array([size[1:] for size in sizes]).max(0)
    return {
        name: f"{mm:.2f} mm {deg:.3f}°"
        for name, mm, deg in sorted(sizes, key=lambda size: -size[1])
        if mm > least_mm or deg > least_deg
    }


def attempt_in_words(attempt: Attempt, images: int) -> str:
    """Return the back end, the images it registered of this many, whether it was kept, and its time."""
    registered = (
        "nothing" if attempt.images_registered is None else f"{attempt.images_registered} of {images} images"
    )
    verdict = "kept" if attempt.why_not is None else f"not kept ({attempt.why_not})"
    times = f"reconstruct {attempt.reconstruct_s:.2f} s, calibrate {attempt.calibrate_s:.2f} s"
    features = f" with {attempt.features}" if attempt.features else ""
    return f"{attempt.backend}{features} registered {registered}, {verdict}; {times}"


def leave_one_out_text(held_out: LeaveOneOut) -> str:
    """Return the leave-one-out error in mm, degrees and, where known, pixels."""
    px = "" if held_out.reprojection_px is None else f", {significant(held_out.reprojection_px)} px"
    return f"{significant(held_out.translation_mm)} mm, {significant(held_out.rotation_deg)}°{px}"


def depth_in_words(check: DepthCheck) -> str:
    """Return the scale of a depth camera against the robot's, and its noise near and far."""
    off, std = check.off_percent, check.std_percent
    size = f"are {abs(off):.2g} ± {std:.1g} % too {'long' if off > 0 else 'short'} compared with the robot's"
    if abs(off) < 2 * std:
        size = f"agree with the robot's ({off:+.2g} ± {std:.1g} %)"
    noise = " and ".join(
        f"{significant(1e3 * float(np.hypot(check.noise_m, check.noise_per_m * z**2)))} mm at {z:.2f} m"
        for z in check.distances_m
    )
    return f"depth camera: its lengths {size}; noise {noise} (1 σ); the map uses corrected depth"
