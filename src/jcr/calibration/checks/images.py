"""Checks of images and reconstruction: too few images used, reconstruction in pieces, static or blurred images."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from jcr.calibration.case import MIN_IMAGES, Case
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.capture.images import BLURRED_EDGE, EDGES_AT, edge_width, read_image, show_one_view
from jcr.estimation.closed_form import initial_estimate
from jcr.estimation.outlier_rejection import least_trimmed
from jcr.estimation.pose_equations import predicted_gripper_poses
from jcr.features.sift import SIFT_DISTANCE, detect, grey_of
from jcr.findings import Finding, FindingKind, verdict_of
from jcr.geometry import inverse, largest_motion, scale_translation, step_between
from jcr.records import Capture

SAME = (10e-3, float(np.radians(1.0)))
"""Largest difference (m, rad) of a reported from a predicted gripper pose for which both count as the same pose."""
MOST_IN_PIECES = 2 / 3
"""Smallest fraction of the images outside the largest piece that must belong to other pieces."""
STILL = (20e-3, np.radians(5.0))
"""Motion of the gripper (m, rad) from which the images of a wrist camera must differ."""
REPETITIVE = 0.9
"""Fraction of features with similar ones elsewhere in the image from which wrong matches are likely."""
TWINS, MIN_TWINS, APART_PX, TWINS_AT = 3, 100, 8.0, 640
"""Similar features that make a feature repetitive, fewest features of an image, smallest distance of two distinct
features (px), and long side of the shrunk image (px)."""
BLURRED_CAUSE = 1 / 4
"""Fraction of blurred images above which blur counts as the cause of a rejection."""


def check_mount(case: Case) -> Case:
    """Return the case with a finding if the poses of a rejected fixed camera fit a camera on the gripper."""
    if case.carries == "camera" or verdict_of(case.calibration.findings) != "rejected":
        return case
    on_gripper = solve_hand_eye(case.base_from_gripper, case.recon_from_camera, camera_errors="none")
    camera = {"camera": case.capture.camera_name}
    return (
        case.found(Finding.of(FindingKind.WRONG_MOUNT, "rejects", "mount", **camera))
        if on_gripper.converged
        else case
    )


def check_pieces(case: Case) -> Case:
    """Return the case with a finding if the reconstruction is in pieces: groups of images that contradict each other.

    With the hand-eye transform of the largest group, each image gives a value of base_from_recon. The values agree
    within a piece; wrong gripper poses give scattered values instead. Values agree if the gripper poses that they
    predict differ by at most SAME. Accepted calibrations are not tested.
    """
    gripper, camera = case.moving, case.recon_from_camera
    if case.calibration.converged or not case.is_open or len(gripper) < MIN_IMAGES + MIN_IMAGES:
        return case
    agree, _ = least_trimmed(gripper, camera)
    for _ in range(4):  # concentration steps (Rousseeuw and Van Driessen 1999)
        x, scale, z = initial_estimate(gripper[agree], camera[agree])
        off = np.linalg.norm(
            step_between(gripper, predicted_gripper_poses(x, scale, z, camera)) / np.repeat(SAME, 3), axis=1
        )
        agree = off <= np.sort(off)[max(MIN_IMAGES, len(off) // 2) - 1]
    x, scale, z = initial_estimate(gripper[agree], camera[agree])
    each = gripper @ x @ inverse(scale_translation(camera, scale))
    predicted = each[:, None] @ scale_translation(camera, scale) @ inverse(x)
    off = np.linalg.norm(step_between(gripper, predicted).reshape(*predicted.shape[:2], 2, 3), axis=-1)
    near = (off < SAME).all(-1)
    largest = near[int(near.sum(1).argmax())]
    others = np.flatnonzero(~largest)
    in_pieces = near[np.ix_(others, others)].sum(1) >= MIN_IMAGES
    if largest.sum() < MIN_IMAGES or in_pieces.sum() < max(MIN_IMAGES, MOST_IN_PIECES * len(others)):
        return case
    names = [case.names[row] for row in others[in_pieces]]
    counts = {"value": float(len(names)), "of": float(len(gripper))}
    return case.found(Finding.of(FindingKind.PIECES, "rejects", "reconstruction", *names, **counts))


def check_remarks(case: Case) -> Case:
    """Return the case with findings on unused images, on an arm model that does not fit, and the back end's warnings.

    An arm model that the gripper poses do not fit is not used (`RobotErrorPrior.unused`).
    """
    texts, every, used = case.reconstruction.warnings, len(case.capture), len(case.used)
    warnings = [Finding.of(FindingKind.RECONSTRUCTION, "warns", text=text) for text in texts]
    if used < every / 2 and not any(one.kind is FindingKind.FEW_USED for one in case.motions):
        registered = len(case.names)
        counts = {"of": float(every), "lost": float(every - registered), "wrong": float(registered - used)}
        kind = FindingKind.HALF_UNUSED
        warnings.insert(0, Finding.of(kind, "warns", "images", value=float(used), **counts))
    return case.found(*filter(None, [case.robot.unused]), *warnings)


def view_findings(capture: Capture) -> tuple[Finding, ...]:
    """Return findings on the images alone: static although the gripper moves, blurred, or with repetitive texture."""
    first = read_image(capture.folder / capture.images[0])
    metres, radians = largest_motion(capture.base_from_gripper)
    # The image of a fixed camera shows mostly what does not move.
    is_still = capture.mount == "gripper" and (metres > STILL[0] or radians > STILL[1])
    width, images = {}, capture.images
    for name in images:
        image = read_image(capture.folder / name)
        width[name] = edge_width(image)
        is_still = is_still and show_one_view(first, image)
    findings = []
    if is_still:
        details = {"rotation": radians}
        findings.append(Finding.of(FindingKind.STATIC_IMAGES, "rejects", "images", value=metres, **details))
    blurred = tuple(name for name, share in width.items() if share > BLURRED_EDGE)
    if blurred:
        edge_px = max(*capture.image_size, EDGES_AT) * float(np.median([width[name] for name in blurred]))
        findings.append(
            Finding.of(
                FindingKind.BLURRED, "warns", "images", *blurred, value=edge_px, of=float(len(capture))
            )
        )
    some = [images[row] for row in np.linspace(0, len(images) - 1, 4).astype(int)]
    share = float(np.median([share_of_twins(read_image(capture.folder / name)) for name in some]))
    if share > REPETITIVE:
        findings.append(Finding.of(FindingKind.REPETITIVE, "informs", "images", value=share))
    return tuple(findings)


def share_of_twins(image: UInt8[ndarray, "h w 3"]) -> float:
    """Return the fraction of an image's SIFT features that have three or more (TWINS) similar features elsewhere in it.

    Features are similar if their descriptors differ by less than SIFT_DISTANCE / 2; "elsewhere" means farther than
    APART_PX. The image (RGB) is first reduced to a long side of TWINS_AT. The result is 0 with fewer than MIN_TWINS
    features.
    """
    height, width = image.shape[:2]
    shrunk = min(1.0, TWINS_AT / max(height, width))
    x_px, descriptors = detect(grey_of(image, (round(shrunk * width), round(shrunk * height))))
    if len(x_px) < MIN_TWINS:
        return 0.0
    is_twin = descriptors @ descriptors.T > 1 - (SIFT_DISTANCE / 2) ** 2 / 2
    is_twin &= np.linalg.norm(x_px[:, None] - x_px[None], axis=-1) > APART_PX
    return float((is_twin.sum(1) >= TWINS).mean())


def as_causes(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings on a rejected calibration's images, of which some now have the severity "rejects".

    These are repetitive texture, and blur of more than a fraction BLURRED_CAUSE of the images.
    """
    return tuple(
        replace(one, severity="rejects")
        if one.kind is FindingKind.REPETITIVE
        or (one.kind is FindingKind.BLURRED and len(one.images) > BLURRED_CAUSE * float(one.details["of"]))
        else one
        for one in findings
    )
