"""Check of the gripper poses of images that an accepted calibration does not use."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.checks.capture import SAME
from jcr.capture.images import read_image
from jcr.estimation.absolute_pose import CameraPose
from jcr.estimation.equation import predict
from jcr.findings import Finding, FindingKind
from jcr.geometry import step_between
from jcr.records import Capture, HandEye, Reconstruction
from jcr.sfm.register import register


def left_out_poses(capture: Capture, made: Reconstruction, hand_eye: HandEye) -> tuple[Finding, ...]:
    """Return the findings of exchanged poses and of poses that their images contradict.

    The matching leaves out images whose poses contradict it; registered by their features alone, they show the gripper
    pose. Images that cannot be registered have no finding.
    """
    shown = _shown_poses(capture, made, hand_eye)
    is_pose_of: dict[int, int] = {}
    findings = []
    for row, pose in shown.items():
        metres, radians = np.linalg.norm(
            step_between(capture.base_from_gripper, pose).reshape(-1, 2, 3), axis=2
        ).T
        fits = (metres < SAME[0]) & (radians < SAME[1])
        if fits[row]:
            continue
        if fits.any():
            is_pose_of[row] = int(np.where(fits, metres, np.inf).argmin())
        off = {"value": float(metres[row]), "rotation": float(radians[row])}
        image = capture.images[row]
        findings.append(Finding.of(FindingKind.POSE_CONTRADICTS_IMAGE, "warns", "poses", image, **off))
    pairs = [(i, j) for i, j in is_pose_of.items() if i < j and is_pose_of.get(j) == i]
    swapped = [
        Finding.of(FindingKind.POSES_SWAPPED, "rejects", "poses", capture.images[i], capture.images[j])
        for i, j in pairs
    ]
    named = {image for one in swapped for image in one.images}
    return (*swapped, *(finding for finding in findings if finding.images[0] not in named))


def _shown_poses(
    capture: Capture, made: Reconstruction, hand_eye: HandEye
) -> dict[int, Float[ndarray, "4 4"]]:
    """Return base_from_gripper, by row, of each image that is left out, from its camera pose among the others."""
    used = set(made.image_index[hand_eye.inliers].tolist())
    camera = dict(zip(made.image_index.tolist(), made.recon_from_camera, strict=True))
    unseen = [row for row in range(len(capture)) if row not in camera]
    if unseen:
        older, new = (
            [read_image(capture.folder / capture.images[row]) for row in rows]
            for rows in (made.image_index, unseen)
        )
        places = zip(unseen, register(made, older, new), strict=True)
        camera |= {row: place.a_from_camera for row, place in places if isinstance(place, CameraPose)}
    x, scale, z = hand_eye.gripper_from_camera, hand_eye.scale, hand_eye.base_from_recon
    return {row: predict(x, scale, z, one[None])[0] for row, one in camera.items() if row not in used}
