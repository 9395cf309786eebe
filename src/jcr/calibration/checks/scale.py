"""Measures of the scale beside the robot's positions: a network's, a depth camera's, or none."""

from dataclasses import replace

import numpy as np

from jcr.calibration.case import Case, Checked
from jcr.calibration.checks.depth_camera import depth_check
from jcr.records import Finding, Kind, ScaleCheck

FAR_SCALE = float(np.log(1.2))
"""Metric networks are a few percent off, at times ten; beyond this a unit is wrong or the calibration."""


def check_network_scale(case: Case) -> Checked:
    """How far a network's own metre is from the robot's; a warning where it is far beyond its error."""
    hand_eye = case.hand_eye
    # A network's length of 1 is `scale` metres by the robot.
    std_percent = 100 * float(np.sqrt(hand_eye.covariance[6, 6])) / hand_eye.scale
    check = ScaleCheck(100 * (1 / hand_eye.scale - 1), std_percent)
    hand_eye = replace(hand_eye, scale_evidence=replace(hand_eye.scale_evidence, network=check))
    if abs(np.log(hand_eye.scale)) < max(FAR_SCALE, 3 * np.sqrt(hand_eye.covariance[6, 6])):
        return Checked((), hand_eye)
    far = Finding.of(
        Kind.NETWORK_SCALE, "warns", "poses", value=check.off_percent / 100, std=check.std_percent / 100
    )
    return Checked((far,), hand_eye)


def check_depth_camera(case: Case) -> Checked:
    """A depth camera's lengths and noise by the robot."""
    hand_eye = case.hand_eye
    depth = depth_check(case.capture, case.reconstruction, hand_eye)
    return Checked((), replace(hand_eye, scale_evidence=replace(hand_eye.scale_evidence, depth=depth)))


def check_scale_source(case: Case) -> Checked:
    """That the scale comes from the robot's positions alone, where it does."""
    measured = case.options.known_height is not None or case.options.known_length is not None
    if (
        measured
        or case.reconstruction.metric_std is not None
        or case.hand_eye.scale_evidence.depth is not None
    ):
        return Checked()
    return Checked((Finding.of(Kind.SCALE_FROM_ROBOT, "informs"),))
