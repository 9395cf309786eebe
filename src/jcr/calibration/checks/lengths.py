"""Known lengths (board, known length, depth camera, network) and a network's focal length, compared with the robot.

Lengths that agree with the robot become priors of the mixed model. Where two lengths contradict each other, the scale
stays the robot's, and a finding names both. The scale of depth cameras is off by a few percent, and their noise grows
with the square of the distance (Khoshelham and Elberink, Sensors 2012).
"""

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.adjust import refined_by
from jcr.calibration.case import Case
from jcr.calibration.checks.boards import board_faults
from jcr.calibration.checks.depth import depth_check
from jcr.calibration.cues import CONTRADICTED, length_cue
from jcr.calibration.hand_eye import judged
from jcr.calibration.record import Calibration
from jcr.estimation.intrinsics_prior import MEASURED, camera_with_prior
from jcr.estimation.problem import SCALE, LinearPrior
from jcr.estimation.solve import Solution, size_of_boards, with_priors
from jcr.findings import Finding, FindingKind
from jcr.records import LengthCheck, LengthName, ScaleCheck
from jcr.rounding import significant

DEPTH_STD, NETWORK_STD = 0.02, 0.05
"""Relative standard deviations of the metre of depth cameras, off by a few percent, and of networks, by up to ten."""
ROBOT_STD = 0.002
"""Relative standard deviation of a factor common to all of a robot's positions, which no pose shows."""
SIGMAS = 3.5
"""Standard deviations of a difference from which two lengths contradict each other."""
LEAST = 0.005
"""Smallest relative difference of two lengths that contradict each other."""
AGREES = 2.0
"""Standard deviations of a difference up to which a length is weighed with the robot's. Between these and SIGMAS neither
is likely, and of positions that are 1 % too long weighing takes the transform from 1.0 mm off to 1.4: the poses give way
by rotating and shifting it, where the whole answer is but too large."""
EXACT = 0.015
"""Relative standard deviation up to which a length can reject a calibration."""
WORTH = 10.0
"""Standard deviations of the robot's scale: a length less exact than that hardly moves it, and is compared alone."""

OF_NETWORK = 1.64
"""Standard deviations between a network's focal length and the given one; a tenth of the networks is farther off."""


@dataclass(frozen=True)
class Length:
    """Logarithm of a length by the robot's positions over its stated value, and its own standard deviation."""

    name: LengthName | Literal["robot"]
    off: float
    std: float


def check_lengths(case: Case) -> Case:
    """Estimate the scale with all known lengths, or report two that contradict each other."""
    hand_eye, lengths = _measured(case)
    converged, robot = hand_eye.converged, Length("robot", 0.0, float(np.sqrt(hand_eye.covariance[6, 6])))
    pair = contradiction([robot, *lengths]) if lengths and converged else None
    of_images = converged and case.adjusted is not None and hand_eye.source == "images"
    weighed = [
        one
        for one in lengths
        if of_images
        and pair is None
        and one.std < WORTH * robot.std
        and abs(one.off) < AGREES * float(np.hypot(one.std, robot.std))
    ]
    checks = (
        LengthCheck(
            name=name,
            robot_longer_percent=100 * float(np.expm1(one.off)),
            std_percent=100 * one.std,
            used=one in weighed,
        )
        for one in lengths
        if (name := one.name) != "robot"
    )
    hand_eye = replace(hand_eye, lengths=tuple(checks))
    compared = any(one.name != "network" for one in lengths) or bool(case.priors)
    alone = not compared and case.reconstruction.metric_std is None
    findings = (Finding.of(FindingKind.SCALE_FROM_ROBOT, "informs"),) * alone
    if pair is not None:
        return case.after((finding_of(*pair, hand_eye), *findings), hand_eye)
    fault = _fault(hand_eye, lengths)
    if weighed:
        return case.after(findings, *_fused(case, hand_eye, weighed, fault))
    if converged and fault.any():
        hand_eye = judged(hand_eye.with_uncertainty(hand_eye.uncertainty.with_error(fault)))
    return case.after(findings, hand_eye)


def _measured(case: Case) -> tuple[Calibration, list[Length]]:
    """Return the calibration with the measurements of lengths, and the lengths."""
    hand_eye, found = case.hand_eye, list[Length]()
    boards, adjusted = case.reconstruction.tracks.boards, case.adjusted
    if (
        adjusted is not None
        and adjusted.problem.boards is not None
        and boards is not None
        and boards.size_std is not None
        and hand_eye.source == "images"
        and not board_faults(case)
    ):
        off, by_unknown = size_of_boards(adjusted)
        together = float(by_unknown @ adjusted.covariance @ by_unknown)
        of_images = max(together - float(adjusted.covariance[SCALE, SCALE].item()), 0.0)
        found.append(Length("board", off, float(np.hypot(np.sqrt(of_images), boards.size_std))))
    if case.options.known_length is not None and not case.priors:
        scale, std = length_cue(case.capture, case.reconstruction, case.options.known_length)
        found.append(Length("known length", float(np.log(hand_eye.scale / scale)), std))
    if hand_eye.converged and (depth := depth_check(case.capture, case.reconstruction, hand_eye)) is not None:
        of_depth = max((depth.std_percent / 100) ** 2 - hand_eye.covariance[6, 6], 0.0)
        std = float(np.hypot(DEPTH_STD, np.sqrt(of_depth)))
        found.append(Length("depth camera", -float(np.log1p(depth.off_percent / 100)), std))
        hand_eye = replace(hand_eye, depth_check=depth)
    # A unit with a stated standard deviation was used for the scale, and is no check of it.
    if case.reconstruction.is_metric and case.reconstruction.metric_std is None:
        # A network's length of 1 is `scale` metres by the robot.
        found.append(Length("network", float(np.log(hand_eye.scale)), NETWORK_STD))
        hand_eye = replace(hand_eye, scale_check=_network_check(hand_eye))
    return hand_eye, found


def _network_check(hand_eye: Calibration) -> ScaleCheck:
    std_percent = 100 * float(np.sqrt(hand_eye.covariance[6, 6])) / hand_eye.scale
    return ScaleCheck(100 * (1 / hand_eye.scale - 1), std_percent)


def contradiction(lengths: list[Length]) -> tuple[Length, Length] | None:
    """Return the two lengths that contradict each other most surely; None where none do."""

    def sigmas(pair: tuple[Length, Length]) -> float:
        return abs(pair[0].off - pair[1].off) / float(np.hypot(pair[0].std, pair[1].std))

    worst = max(combinations(lengths, 2), key=sigmas)
    return worst if sigmas(worst) > SIGMAS and abs(worst[0].off - worst[1].off) > LEAST else None


def finding_of(one: Length, other: Length, hand_eye: Calibration) -> Finding:
    """Return the finding that two lengths contradict each other; the robot is the first where it is one of them."""
    off, std = other.off - one.off, float(np.hypot(one.std, other.std))
    of_robot = one.name == "robot"
    if of_robot and other.name == "network":
        check = _network_check(hand_eye)
        value, std = check.off_percent / 100, check.std_percent / 100
        return Finding.of(FindingKind.NETWORK_SCALE, "warns", "poses", value=value, std=std)
    exact = max(one.std, other.std) < EXACT and abs(off) >= CONTRADICTED[1]
    found = Finding.of(
        FindingKind.BOARD_SIZE if of_robot and other.name == "board" else FindingKind.SCALES,
        "rejects" if exact and of_robot else "warns",
        "poses",
        value=float(np.expm1(off)),
        std=std,
        one=one.name,
        other=other.name,
    )
    if not of_robot or other.std >= EXACT:
        return found
    return replace(found, shift=tuple(_shift(off, hand_eye).tolist()))


def _shift(off: float, hand_eye: Calibration) -> Float[ndarray, "7"]:
    """Return the change of a calibration if the robot's positions were too long by exp(off)."""
    return -off * np.r_[hand_eye.gripper_from_camera[:3, 3], np.zeros(3), 1.0]


def _fault(hand_eye: Calibration, lengths: list[Length]) -> Float[ndarray, "7 7"]:
    """Return the covariance of the difference of the most exact length from the robot beyond their uncertainties."""
    best = min(lengths, key=lambda one: one.std, default=Length("robot", 0.0, EXACT))
    beyond = best.off**2 - best.std**2 - float(hand_eye.covariance[6, 6])
    if best.std >= EXACT or beyond <= 0:
        return np.zeros((7, 7))
    shift = _shift(float(np.sqrt(beyond)), hand_eye)
    return np.outer(shift, shift)


def _fused(
    case: Case, hand_eye: Calibration, lengths: list[Length], fault: Float[ndarray, "7 7"]
) -> tuple[Calibration, Solution]:
    """Return calibration and adjustment with the lengths as priors of the scale."""
    assert case.adjusted is not None
    log_scale, boards = float(np.log(case.adjusted.most_likely.scale)), case.reconstruction.tracks.boards
    by_scale = np.eye(case.adjusted.problem.unknowns)[SCALE.start]
    known = []
    for one in lengths:
        if one.name == "board" and boards is not None and boards.size_std is not None:
            size, by_unknown = size_of_boards(case.adjusted)
            value = float(by_unknown @ case.adjusted.problem.coordinates(case.adjusted.state)) - size
            known.append(LinearPrior(by_unknown, value, float(np.hypot(boards.size_std, ROBOT_STD))))
        else:
            known.append(LinearPrior(by_scale, log_scale - one.off, float(np.hypot(one.std, ROBOT_STD))))
    adjusted = with_priors(case.adjusted, known)
    refined = refined_by(case, adjusted)
    refined = refined.with_uncertainty(refined.uncertainty.with_error(fault))
    for one in hand_eye.findings:
        refined = refined.with_finding(one)
    depth = hand_eye.depth_check
    if depth is not None:
        # What is measured with depth images is in the metre that the map has.
        percent = 100 * ((1 + depth.off_percent / 100) * hand_eye.scale / refined.scale - 1)
        depth = replace(depth, off_percent=percent)
    measured = {name: getattr(hand_eye, name) for name in ("findings", "scale_check", "lengths", "board")}
    return judged(replace(refined, depth_check=depth, **measured)), adjusted


def check_predicted_focal(case: Case) -> Case:
    """Report that a network's focal length contradicts the one that was given; their difference is uncertainty."""
    given, predicted = case.capture.intrinsics, case.reconstruction.predicted_focal
    if given is None or predicted is None:
        return case
    focal, relative_std = predicted
    off = focal / given.fx - 1
    if abs(off) < OF_NETWORK * np.hypot(relative_std, MEASURED["f"]):
        return case
    sizes = f"{focal:.0f} ± {significant(focal * relative_std)} px where {given.fx:.0f} is given"
    details = {
        "source": "pointmaps",
        "shown": f"a focal length of {sizes}",
        "fx": focal,
        "fx_given": given.fx,
    }
    by_focal = camera_with_prior(case.reconstruction.intrinsics, {"f": abs(off)})
    moved = tuple((by_focal.directions @ by_focal.std).tolist())
    found = Finding.of(FindingKind.INTRINSICS, "warns", "intrinsics", **details)
    return case.after((replace(found, shift=(0.0,) * 7, intrinsics_shift=moved),))
