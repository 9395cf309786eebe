"""Eye-to-hand calibration: a fixed camera observes an object in the gripper.

In the frame of the object the camera moves like a wrist camera moves in the base frame. With inverse gripper poses, a
fixed camera is therefore calibrated like a wrist camera. Robot errors are errors of the gripper poses, not of their
inverses, so the result and its covariance are estimated again with the actual poses (estimation/pose_equations.py).

The static background is removed from the images, because the background often has more features than the object. A
pixel's background is the colour that many images share. Each image keeps the pixels that differ from the background and
fades to grey elsewhere, smoothly, because a sharp border would produce features.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from jcr.calibration.adjust import with_adjusted_images
from jcr.calibration.case import MIN_OBSERVATIONS, Case
from jcr.calibration.hand_eye import JUDGED, solve_hand_eye
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.calibration.robot_errors import robot_errors
from jcr.calibration.stage import OF_ADJUSTMENT, with_checks, with_requirement
from jcr.capture.images import encode_png, read_image
from jcr.files import write_bytes
from jcr.findings import Finding, FindingKind, kinds_of
from jcr.geometry import inverse
from jcr.records import Capture, Reconstruction

AGAIN = kinds_of("camera", "order", "strain", "lengths").union(
    JUDGED, {FindingKind.NOT_SETTLED, FindingKind.JOINT_OFFSETS}
)
"""Kinds of findings of an adjustment, which are derived again for the gripper poses as reported."""
LEVELS = 14.0
"""Smallest difference (of 255) between different colours; noise and JPEG artefacts are smaller at reduced size."""
REDUCED = 320
"""Width (px) at which images are compared."""
LEAST_SHARE, LEAST = 0.3, 3
"""Smallest share and number of images that must agree on a background pixel."""
GREY = 128
"""Grey level of the removed background."""
GROWN, SOFT = 0.012, 0.008
"""Dilation of the moving part, and sigma of the blur of its border, as shares of the image width."""


def eye_to_hand(capture: Capture, moving: Path | None = None) -> Capture:
    """Return the capture of a fixed camera as a capture of a camera that moves around the carried object.

    Gripper poses are inverted. Robot name, URDF and joints are removed, since they belong to the original poses. Images
    without the static background are written to the folder `moving` and used; None: the original images are used.
    """
    if moving is not None:
        images = moving_parts([read_image(capture.folder / name) for name in capture.images])
        for name, image in zip(capture.images, images, strict=True):
            write_bytes(moving / name, encode_png(image))  # PNG whatever the name
    return replace(
        capture,
        folder=moving or capture.folder,
        base_from_gripper=inverse(capture.base_from_gripper),
        mount="gripper",
        others=(),
        joints=None,
        robot=None,
        urdf=None,
    )


def refined(
    capture: Capture,
    reconstruction: Reconstruction,
    found: Calibration,
    options: CalibrateOptions,
) -> Calibration:
    """Return the calibration of a fixed camera, refined from `found`, with the gripper poses as reported.

    `found` was computed with inverse gripper poses (`eye_to_hand`). A rejected calibration is not refined; it gets the
    finding WRONG_MOUNT if the camera turns out to be on the gripper.
    """
    rows = reconstruction.image_index
    if not found.converged:
        on_gripper = solve_hand_eye(
            capture.base_from_gripper[rows], reconstruction.recon_from_camera, camera_errors="none"
        )
        why = Finding.of(FindingKind.WRONG_MOUNT, "rejects", "mount", camera=capture.camera_name)
        return (found.with_findings(why) if on_gripper.converged else found).on_fixed_camera()
    # Findings on images and motions stay. Those of the adjustment are derived again with the poses as reported.
    kept = tuple(one for one in found.findings if one.kind not in AGAIN)
    registered = tuple(found.images[row] for row in rows)
    case = Case(
        capture=capture,
        reconstruction=reconstruction,
        options=options,
        robot=robot_errors(capture, options).of(rows),
        hand_eye=replace(
            found, images=registered, source="poses", findings=kept, lengths=(), depth_check=None
        ),
        carries="scene",
    )
    if found.source == "poses" or case.tracks.from_pointmaps or len(case.tracks.image) < MIN_OBSERVATIONS:
        return found.on_fixed_camera()
    case = with_requirement(with_checks(with_adjusted_images(case), OF_ADJUSTMENT))
    images = dict(zip(rows.tolist(), case.hand_eye.images, strict=True))
    every = tuple(images.get(row, one) for row, one in enumerate(found.images))
    return replace(case.hand_eye, images=every).on_fixed_camera()


def moving_parts(images: Sequence[UInt8[ndarray, "h w 3"]]) -> list[UInt8[ndarray, "h w 3"]]:
    """Return the images of a fixed camera with the static background faded to grey; moving parts keep their colour.

    The background of a pixel is its most frequent colour over the images; a pixel without a frequent colour counts as
    moving.
    """
    height, width = images[0].shape[:2]
    small = min(REDUCED, width), max(1, round(height * min(REDUCED, width) / width))
    reduced = np.stack(
        [cv2.resize(image, small, interpolation=cv2.INTER_AREA).astype(np.float32) for image in images]
    )
    # For each pixel, the number of images that have the same colour as each image (n,h,w), and the most frequent colour.
    agreeing = np.stack([(np.abs(reduced - one).max(-1) < LEVELS).sum(0) for one in reduced])
    background = np.take_along_axis(reduced, agreeing.argmax(0)[None, ..., None], axis=0)[0]
    known = agreeing.max(0) >= max(LEAST, LEAST_SHARE * len(images))
    out = []
    for image, small_image in zip(images, reduced, strict=True):
        moves = (np.abs(small_image - background).max(-1) > LEVELS) | ~known
        mask = cv2.morphologyEx(moves.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
        grown = max(1, round(GROWN * small[0]))
        mask = cv2.dilate(mask, np.ones((2 * grown + 1, 2 * grown + 1), np.uint8))
        share = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
        share = cv2.GaussianBlur(share, (0, 0), SOFT * width)[..., None]
        out.append(np.rint(GREY + share * (image.astype(np.float32) - GREY)).astype(np.uint8))
    return out
