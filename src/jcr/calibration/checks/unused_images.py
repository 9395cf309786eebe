"""Check of the reported gripper poses of images that a calibration does not use: exchanged poses, or all moved alike."""

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from jcr.calibration.case import MIN_IMAGES, Case
from jcr.calibration.checks.effects import POLICIES, of_step
from jcr.calibration.checks.images import SAME
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.record import Calibration
from jcr.capture.images import read_image
from jcr.estimation.absolute_pose import CameraPose
from jcr.estimation.observability import observability
from jcr.estimation.pose_equations import predicted_gripper_poses
from jcr.findings import Finding, FindingKind
from jcr.geometry import ARM, Transform, inverse, motion_length, step_between
from jcr.records import Capture, Reconstruction
from jcr.sfm.register import register

NEARER = 0.1
"""Ratio of two distances from the pose that an image shows, to another image's reported pose and to its own, below
which the other pose belongs to the image."""
STEPS = FindingKind.SLIP, FindingKind.BASE_MOVED
"""Findings of a motion of the camera or TCP, constant in gripper axes, and of the base, constant in base axes."""


def check_pairing(case: Case) -> Case:
    """Return the case with findings on unused images whose gripper poses are exchanged or all differ by one motion.

    The robust fit rejects such poses one by one, so a calibration from the other images may be accepted. Images with a
    merely wrong pose give no finding here. If the used images do not agree, half of the capture may
    (`_step_beyond_half`).
    """
    kinds = {one.kind for one in case.calibration.findings}
    if kinds & {FindingKind.FEW_AGREE, FindingKind.POSES_CONTRADICT_IMAGES}:
        return case.found(*_step_beyond_half(case)) if case.carries == "camera" else case
    if FindingKind.UNOBSERVABLE in kinds or len(case.capture) - len(case.used) < 2:
        return case
    # Bundle adjustment moves the cameras of wrong gripper poses towards these poses; the fit to camera poses does not.
    found = left_out_poses(case.capture, case.reconstruction, case.fit)
    return case.found(*found)


def _step_beyond_half(case: Case) -> list[Finding]:
    """Return the finding that all images to one end of the capture are moved alike; empty if they are not.

    A single step leaves the first or the second half of the images without it, which then gives a calibration alone.
    """
    gripper, every = case.moving, np.arange(len(case.moving))
    size = max(MIN_IMAGES, (len(every) + 1) // 2)
    for half in (every[:size], every[-size:]):
        if not observability(gripper[half]).observable:  # a fit would find any scale
            continue
        fit = solve_hand_eye(gripper[half], case.recon_from_camera[half], camera_errors="none")
        if fit.converged and fit.inliers.all():
            found = left_out_poses(case.capture, case.reconstruction, fit, half)
            if steps := [one for one in found if one.kind in STEPS]:
                return steps
    return []


def left_out_poses(
    capture: Capture, made: Reconstruction, hand_eye: Calibration, used: Int[ndarray, " u"] | None = None
) -> tuple[Finding, ...]:
    """Return findings about unused images whose gripper poses are exchanged, or all moved alike.

    Unused images without a camera pose in `made` are registered by their features alone. Camera pose and hand-eye
    transform then give the true gripper pose. A reported pose is contradicted if it differs from the true one by more
    than SAME. `used` are the rows of the registered images that `hand_eye` uses; None: its inliers. Poses are exchanged
    if two or more images show poses that are reported for other unused images. All other contradicted poses give one
    finding if they are moved alike (`_one_step`). Images that cannot be registered give no finding.
    """
    shows, belongs_to = dict[int, Transform](), dict[int, int]()
    calibrated = set(made.image_index[hand_eye.inliers if used is None else used].tolist())
    camera = dict(zip(made.image_index.tolist(), made.recon_from_camera, strict=True))
    unseen = [row for row in range(len(capture)) if row not in camera]
    if unseen:
        older, new = (
            [read_image(capture.folder / capture.images[row]) for row in rows]
            for rows in (made.image_index, unseen)
        )
        places = zip(unseen, register(made, older, new), strict=True)
        camera |= {row: place.a_from_camera for row, place in places if isinstance(place, CameraPose)}
    x, scale, z, right = (
        hand_eye.parent_from_camera,
        hand_eye.scale,
        hand_eye.body_from_recon.rigid,
        {*calibrated},
    )
    moving = inverse(capture.base_from_gripper) if capture.mount == "base" else capture.base_from_gripper
    for row in (row for row in camera if row not in calibrated):
        pose = predicted_gripper_poses(x, scale, z, camera[row][None])[0]
        by = np.linalg.norm(step_between(moving, pose).reshape(-1, 2, 3), axis=2)
        if (by[row] < SAME).all():
            right.add(row)
            continue
        shows[row] = pose
        distance = by @ (1.0, ARM)
        if distance.min() < NEARER * distance[row]:
            belongs_to[row] = int(distance.argmin())
    shown = {row: other for row, other in belongs_to.items() if other not in right}
    exchanged = {*shown, *shown.values()} if len(shown) >= 2 else set[int]()
    findings = []
    if exchanged:
        names = [capture.images[row] for row in sorted(exchanged)]
        findings.append(Finding.of(FindingKind.POSES_SWAPPED, "rejects", "poses", *names))
    moved = {row: pose for row, pose in sorted(shows.items()) if row not in exchanged}
    if capture.mount == "gripper" and (step := _one_step(capture, moved)) is not None:
        return *findings, step
    return tuple(findings)


def _one_step(capture: Capture, shows: dict[int, Transform]) -> Finding | None:
    """Return the finding that the images to one end of a capture are moved alike; None unless two or more all are.

    `shows` has the gripper pose that each contradicted image shows (base_from_gripper), by row of the capture. A motion
    that is constant in gripper axes is one of the camera or of the TCP, in base axes one of the base.
    """
    rows, n = list(shows), len(capture)
    at_end = (
        len(rows) >= 2 and rows == list(range(rows[0], rows[-1] + 1)) and (rows[0] == 0 or rows[-1] == n - 1)
    )
    if not at_end:
        return None
    place = rows[-1] + 1 if rows[0] == 0 else rows[0]
    reported, shown = capture.base_from_gripper[rows], np.stack(list(shows.values()))
    spreads = []
    for kind, motions in zip(STEPS, (inverse(reported) @ shown, shown @ inverse(reported)), strict=True):
        apart = float(motion_length(inverse(motions[0]) @ motions).max())
        metres, radians = np.linalg.norm(step_between(np.eye(4), motions[0]).reshape(2, 3), axis=1).tolist()
        spreads.append((apart / float(motion_length(motions[0])), kind, metres, radians))
    spread, kind, metres, radians = min(spreads, key=lambda one: one[0])
    if spread > NEARER:
        return None
    severity, details = of_step(metres, radians, place, n)
    return Finding.of(
        kind, severity, POLICIES[kind].concerns, *capture.images[place - 1 : place + 1], **details
    )
