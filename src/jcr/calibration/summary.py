"""Text of a calibration: the summary on the terminal, and the details of log.txt and `--verbose`."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from jcr.calibration.record import AnyCalibration, Calibration, PublishedCalibration
from jcr.camera import unproject
from jcr.errors import count_of
from jcr.findings import (
    LENGTHS,
    Finding,
    FindingKind,
    joined,
    sentence,
    verdict_of,
    without_consequences,
)
from jcr.number_format import labelled, significant
from jcr.records import (
    GivenIntrinsicsResult,
    Intrinsics,
    LeaveOneOut,
    PointUncertaintyOverImage,
    Uncertainty,
    share_of,
)

NEGLIGIBLE = 0.02
"""Ratio to the largest part of an uncertainty budget up to which a part is not printed (0.04 % of its variance)."""
MOST_LINES, LEAST_ACTIONS = 14, 4
"""Largest number of lines of the terminal's summary, including two that the caller adds, report and next command; and
number of lines that causes, remedies and warnings may have in any case, of which the last may count those left out."""
EXTRAPOLATED = 2.0
"""Ratio of the errors in the corner and at the centre from which three quarters or more of the corner's variance are
due to the intrinsics; with 1.5 it is more than half, with 3 eight ninths."""
UNDETERMINED = 0.5
"""Ratio of the error in the corner and the working distance from which the corner is not determined: an error of half of
the distance is no measurement. It is at most 0.13 in twelve of fourteen real captures and above 2.5 in the other two, so
± 50 % changes nothing."""
BACKEND_NAMES = {"colmap": "COLMAP", "dust3r": "DUSt3R", "mast3r": "MASt3R", "da3": "Depth Anything 3"}
PARTS = {
    "random robot errors": "robot_random",
    "systematic robot errors": "robot_systematic",
    "intrinsics": "intrinsics",
    "images": "images",
    "faults found": "faults",
}
"""Printed name of each field of an uncertainty budget."""


def verdict_in_words(findings: Iterable[Finding]) -> str:
    """Return the verdict of the findings in capitals, with the number of further warnings unless it is a rejection."""
    findings = without_consequences(tuple(findings))
    verdict = verdict_of(findings)
    told = FindingKind.NOT_EXACT_ENOUGH, FindingKind.NOT_CHECKED
    warnings = sum(one.severity == "warns" and one.kind not in told for one in findings)
    if verdict == "rejected" or not warnings:
        return verdict.upper()
    return f"{verdict.upper()}, with {count_of(warnings, 'warning')}"


def corner_is_missed(content: AnyCalibration) -> bool:
    """Test whether the accuracy of a point in the worst corner of the image misses the required one."""
    required, uncertainty = content.requirement, content.uncertainty
    if required is None or uncertainty is None or uncertainty.corner is None:
        return False
    return uncertainty.corner.within_95_mm > required.translation_mm


def corner_in_words(content: AnyCalibration) -> str:
    """Return why the corners of the image miss the required accuracy, and the remedy; empty if it is not the distortion.

    Errors of the transform move points at one distance alike; a corner that is less exact by EXTRAPOLATED or more has
    its error from the intrinsics.
    """
    if (
        not corner_is_missed(content)
        or content.uncertainty is None
        or (seen := content.uncertainty.seen) is None
    ):
        return ""
    if seen.corners.within_95_mm < EXTRAPOLATED * seen.within_95_mm:
        return ""
    return (
        "in the corners the distortion is extrapolated, because no or few features are near them; move textured objects "
        "into the corners of the images"
    )


def summary(content: AnyCalibration, most: int = MOST_LINES) -> str:
    """Return the summary for the terminal: verdict, transform, accuracy and warnings, in at most `most` - 2 lines.

    There are more if LEAST_ACTIONS warnings and remedies need them. The caller adds the two other lines. For a rejected
    calibration, cause and remedy replace transform and accuracy.
    """
    limit = ""
    if (required := content.requirement) is not None:
        unmet = ", not met in the corners" if required.met and corner_is_missed(content) else ""
        limit = f" ({required.translation_mm:g} mm and {required.rotation_deg:g}° required{unmet})"
    backend = BACKEND_NAMES.get(content.backend, content.backend)
    used = f"{content.images_used} of {count_of(len(content.images), 'image')}"
    # The times of depth and map follow in log.txt; the first line is the same before and after these stages.
    seconds = sum(content.timings_s.get(stage, 0.0) for stage in ("decide", "reconstruct", "calibrate"))
    lines = [f"{verdict_in_words(content.findings)}{limit}. {used}, {backend}, {seconds:.0f} s"]
    if isinstance(content, Calibration) and content.converged:
        lines += _result(content)
    if isinstance(content, Calibration):
        lines += left_out_lines(content)
    if isinstance(content, PublishedCalibration):
        lines += _published(content)
    return "\n".join([*lines, *actions(content.findings, max(most - 2 - len(lines), LEAST_ACTIONS))]) + "\n"


def _result(content: Calibration) -> list[str]:
    """Return the lines of an accepted calibration: transform with standard deviations, accuracy, and intrinsics.

    The accuracy is the bound on 95 % of the errors of a point that the camera sees.
    """
    uncertainty = content.uncertainty
    offset = " ".join(significant(size) for size in uncertainty.translation_std_mm)
    rotation = " ".join(significant(size) for size in uncertainty.rotation_std_deg)
    tested = [] if content.held_out is None else [f"leave-one-out: {leave_one_out_text(content.held_out)}"]
    used = [LENGTHS[one.name] for one in content.lengths if one.used and one.name != "network"]
    sources = joined(["the robot", *used]) if used else "the robot alone"
    tested.append(f"scale ±{uncertainty.scale_std_percent:.2g} %, from {sources}")
    lines = [
        *_transform(content),
        f"  1σ: {offset} mm, {rotation}°",
        *labelled(
            "Accuracy",
            accuracy_in_words(uncertainty),
            *filter(None, [corner_in_words(content)]),
            "; ".join(tested),
        ),
    ]
    return [*lines, *(labelled("Intrinsics", *pair) if (pair := pair_in_words(content)) else ())]


def accuracy_in_words(uncertainty: Uncertainty) -> str:
    """Return the bound on 95 % of the errors of a point at the image centre and in the worst corner, in words."""
    if (seen := uncertainty.seen) is None:
        return "unknown"
    bound = f"{significant(seen.within_95_mm)} mm, {significant(seen.rotation_95_deg)}° (95 %)"
    accuracy = f"a point at {significant(1e-3 * seen.distance_mm)} m: {bound}"
    if uncertainty.corner is None:
        return accuracy
    return f"{accuracy} at the image centre; {corner_bound(seen)} in the corner"


def corner_bound(seen: PointUncertaintyOverImage) -> str:
    """Return the bound on 95 % of the errors of a point in the worst corner, or that the corner is not determined."""
    bound_mm = seen.corners.within_95_mm
    return "not determined" if bound_mm > UNDETERMINED * seen.distance_mm else f"{significant(bound_mm)} mm"


def left_out_lines(content: AnyCalibration) -> list[str]:
    """Return lines with up to two images that the calibration does not use, and why; empty if it uses all."""
    left_out = [f"{one.image}: {one.reason}" for one in content.images if not one.used]
    more = [f"and {len(left_out) - 2} more (--verbose)"] if len(left_out) > 2 else []
    return labelled("Left out", *left_out[:2], *more)


def pair_in_words(content: Calibration) -> list[str]:
    """Return up to two lines: the intrinsics that belong to the transform, and the error of a point with the given ones.

    The list is empty without intrinsics, and has no second line for a rejected calibration.
    """
    if (camera := content.intrinsics) is None:
        return []
    given = content.with_given_intrinsics
    origin, used = intrinsics_origin(content), intrinsics_in_words(camera)
    use = [f"{origin}: {used}; use them together with the transform"]
    if given is not None and content.converged and (mm := mixed_pair_mm(content)) is not None:
        pair = f"with the given ones (fx {given.intrinsics.fx:.1f}) and this transform"
        use.append(f"{pair} a point is up to {significant(mm)} mm off (jcr docs exports)")
    return use


def intrinsics_origin(content: AnyCalibration) -> str:
    """Return the origin of the calibration's intrinsics in words: given, refined, estimated, or used if not recorded."""
    source, camera = content.intrinsics_source, content.intrinsics
    if source == "given" and camera is not None and camera.std is not None:
        return "given, refined"
    return source or "used"


def intrinsics_in_words(camera: Intrinsics) -> str:
    """Return focal lengths and principal point (px) in words."""
    return " ".join(f"{name} {getattr(camera, name):.1f}" for name in ("fx", "fy", "cx", "cy"))


def mixed_pair_mm(content: Calibration) -> float | None:
    """Return the largest error (mm) of points at the working distance by the estimated transform and given intrinsics.

    Compared are the points of the same pixels by the estimated intrinsics, at the image centre and in the corners. None
    if the calibration has only one pair of transform and intrinsics.
    """
    given, camera, seen = content.with_given_intrinsics, content.intrinsics, content.uncertainty.seen
    if given is None or camera is None or seen is None:
        return None
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [0.5, 0.5]])
    x_px = corners * [camera.width - 1, camera.height - 1]
    rays = [unproject(one, x_px) for one in (camera, given.intrinsics)]
    points = [seen.distance_mm * ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays]
    return float(np.linalg.norm(points[1] - points[0], axis=1).max())


def _transform(content: Calibration | PublishedCalibration) -> list[str]:
    """Return two lines: the name of the transform, and its translation (m) and quaternion."""
    matrix = content.parent_from_camera
    quat_xyzw = Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True)
    x, q = (" ".join(f"{number:8.5f}" for number in part) for part in (matrix[:3, 3], quat_xyzw))
    return [f"{content.mount}_from_camera (optical frame; m, quaternion xyzw)", f"  {x}   {q}"]


def _published(content: PublishedCalibration) -> list[str]:
    """Return the lines of a calibration by the published method: transform, scale and residuals of the paper."""
    found = content.residuals
    sizes = f"δt {significant(1e3 * found.translation)} mm, δR {significant(found.rotation)} (paper, eq. 16)"
    scale = f"{content.scale:.6g} m per unit of the reconstruction"
    return [
        *_transform(content),
        *labelled("Residuals", sizes, "small ones do not prove accuracy"),
        *labelled("Scale", scale),
    ]


def actions(findings: Sequence[Finding], most: int) -> list[str]:
    """Return the lines with cause and remedy of a rejection, then the warnings; at most `most` lines.

    `findings` are sorted (`strongest_first`). Faults that displace the result come before the remedy of a missed
    accuracy, because they may be its cause. If lines are left out, the last line states their number.
    """
    findings, lines = without_consequences(findings), list[str]()
    if verdict_of(findings) == "rejected":
        cause, *findings = findings
        lines = labelled("Cause", cause.text) + labelled("Remedy", *filter(None, [cause.remedy]))

    def order(one: Finding) -> tuple[bool, bool]:
        return one.shift is None or one.severity == "informs", one.kind is not FindingKind.NOT_EXACT_ENOUGH

    for one in sorted(findings, key=order):
        if one.kind is FindingKind.NOT_EXACT_ENOUGH:
            # Other lines of the summary state the required and the reached accuracy.
            lines += labelled("Remedy", one.remedy)
        elif one.severity != "informs":
            lines += labelled("WARNING", sentence(one))
        elif one.kind is FindingKind.BOARD_SIDE:  # the answer to a SIDE in --board
            lines += labelled("Note", sentence(one))
    if len(lines) <= most:
        return lines
    hidden = f"{count_of(len(lines) - most + 1, 'more line')} with --verbose and in the report"
    return [*lines[: most - 1], *labelled("", hidden)]


def details(content: AnyCalibration) -> list[str]:
    """Return the lines of `--verbose` and log.txt: transform, uncertainty, `facts`, use of images, findings, notes."""
    lines = [f"jcr {content.version}, back end {content.backend}"]
    if isinstance(content, Calibration):
        uncertainty, held_out = content.uncertainty, content.held_out
        with np.printoptions(precision=6, suppress=True):
            matrix = str(np.array(content.parent_from_camera)).splitlines()
        lines += [f"{content.mount}_from_camera", *(f"  {row}" for row in matrix)]
        lines.append(f"largest uncertainty {worst_direction(content)}")
        if uncertainty.seen is not None and uncertainty.joint is not None:
            lines.append(seen_in_words(uncertainty.seen))
        if content.with_given_intrinsics is not None:
            lines.append(given_in_words(content.with_given_intrinsics))
        lines.append(f"scale {content.scale:.6g} m per unit ± {uncertainty.scale_std_percent:.2g} %")
        if held_out is not None:
            lines.append(f"leave-one-out error: {leave_one_out_text(held_out)} ({held_out.how})")
    if isinstance(content, PublishedCalibration):
        lines += ["method of the paper", *_published(content)]
    for title, block in facts(content).items():
        lines += [f"{title}: {name}: {value}" for name, value in block.items()]
    lines += [f"{image.image}: {image.reason or 'used'}" for image in content.images]
    said = {sentence(one): one for one in content.findings}
    for words, one in said.items():
        lines.append(f"{one.severity}: {words}{'' if one.p is None else f' (p = {one.p:.0e})'}")
    return [*lines, *(f"note: {note}" for note in content.notes if note not in said)]


def log(content: AnyCalibration) -> str:
    """Return the text of log.txt: the summary with every warning, then the details."""
    return summary(content, 1000) + "\n" + "\n".join(details(content)) + "\n"


def facts(content: AnyCalibration) -> dict[str, Mapping[str, str]]:
    """Return blocks of named values as text: {title: {name: value}}, with times, uncertainty, lengths and robot."""
    time = {stage: f"{seconds:.1f} s" for stage, seconds in content.timings_s.items()}
    time["total"] = f"{sum(content.timings_s.values()):.1f} s"
    for k, attempt in enumerate(content.attempts, start=1):
        features = f" with {attempt.features}" if attempt.features else ""
        count = "nothing" if attempt.images_registered is None else f"{attempt.images_registered} images"
        kept = "kept" if attempt.why_not is None else f"not kept ({attempt.why_not})"
        times = f"reconstruct {attempt.reconstruct_s:.2f} s, calibrate {attempt.calibrate_s:.2f} s"
        time[f"attempt {k}"] = f"{attempt.backend}{features} registered {count}, {kept}; {times}"
    depth, robot = dict[str, str](), dict[str, str]()
    if (check := content.depth_check) is not None:
        off = f"{check.off_percent:+.2f} ± {check.std_percent:.2g} %"
        depth["scale error, compared with the robot"] = off
        for z in check.distances_m:
            depth[f"noise at {z:.2f} m, 1 σ"] = f"{significant(1e3 * float(check.std_m(z)))} mm"
        depth["compared"] = f"{check.features} features of {check.images} images"
    if (errors := content.robot_errors) is not None:
        shared = "{translation_mm:.2g} mm {rotation_deg:.2g}° per axis".format_map(errors)
        robot["errors shared by neighbouring poses"] = shared
        for k, joint in enumerate(errors["joints"] or [], start=1):
            robot[f"joint {k} off by"] = "{offset_deg:+.3f} ± {std_deg:.3f}°".format_map(joint)
    lengths = {
        LENGTHS[
            one.name
        ]: f"{one.robot_longer_percent:+.2f} ± {significant(one.std_percent)} % longer by the robot's "
        f"positions, {'part of the scale' if one.used else 'not used'}"
        for one in content.lengths
    }
    budget, parts = None if content.uncertainty is None else content.uncertainty.budget, dict[str, str]()
    if budget is not None:
        shares = {name: share_of(getattr(budget, part)) for name, part in PARTS.items()}
        sizes = {name: np.array([one.translation_mm, one.rotation_deg]) for name, one in shares.items()}
        least = NEGLIGIBLE * np.max(list(sizes.values()), axis=0)
        for name, size in sorted(sizes.items(), key=lambda item: -item[1][0]):
            if (size > least).any():
                parts[name] = f"{size[0]:.2f} mm {size[1]:.3f}°"
    return {
        "Time": time,
        "Uncertainty, 1 σ per axis": parts,
        "Lengths": lengths,
        "Depth camera": depth,
        "Robot": robot,
    }


def worst_direction(content: Calibration) -> str:
    """Return the least certain direction of the translation, e.g. "along the optical axis: ±4.0 mm" (1σ).

    A camera axis is named if it is within 30° of the direction, else the direction is stated in gripper axes.
    """
    variance, vectors = np.linalg.eigh(content.covariance[:3, :3])
    direction, std_mm = vectors[:, 2], 1e3 * float(np.sqrt(variance[2]))
    along = content.parent_from_camera[:3, :3].T @ direction
    k = int(np.abs(along).argmax())
    name = ("the image's x axis", "the image's y axis", "the optical axis")[k]
    if abs(along[k]) < np.cos(np.radians(30)):
        name = f"({', '.join(f'{x:.2f}' for x in direction)}) of the gripper"
    # The standard deviation of an unobservable translation may be metres.
    size = f"{significant(std_mm)} mm" if std_mm < 1000 else f"{significant(std_mm / 1e3)} m"
    return f"along {name}: ±{size}"


def seen_in_words(seen: PointUncertaintyOverImage) -> str:
    """Return a sentence with the point uncertainty (95 %, mm) across the ray, along the ray, and in an image corner."""
    return (
        f"point uncertainty: {significant(seen.lateral_95_mm)} mm across the ray and "
        f"{significant(seen.along_95_mm)} mm along it, {corner_bound(seen)} in a corner of the image, with the "
        "intrinsics of this run and exact gripper poses"
    )


def given_in_words(given: GivenIntrinsicsResult) -> str:
    """Return a sentence with the distance between one point's positions by the given and the estimated intrinsics.

    Each set of intrinsics is used with its own transform. The sentence also states the point uncertainty (95 %, mm)
    with the given ones.
    """
    return (
        f"with the given intrinsics and their transform (with_given_intrinsics) the same point is "
        f"{significant(given.differs_mm)} mm from there, and within {significant(given.seen.within_95_mm)} mm"
    )


def leave_one_out_text(held_out: LeaveOneOut) -> str:
    """Return the leave-one-out error as text, in mm, degrees and, for adjusted images, pixels."""
    px = "" if held_out.reprojection_px is None else f", {significant(held_out.reprojection_px)} px"
    return f"{significant(held_out.translation_mm)} mm, {significant(held_out.rotation_deg)}°{px}"
