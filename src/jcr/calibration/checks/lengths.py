"""Comparison of known lengths with the robot's positions: boards, a known length, a depth camera, a network's metre.

Lengths that agree with the robot become priors of the mixed model. Where two lengths contradict each other, the scale
stays the robot's, and a finding names both.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.adjust import refined_by
from jcr.calibration.case import Case, CheckResult
from jcr.calibration.checks.depth_camera import depth_check
from jcr.calibration.cues import CONTRADICTED, length_cue
from jcr.estimation.equation import SCALE
from jcr.estimation.hand_eye import judged
from jcr.estimation.problem import LinearPrior
from jcr.estimation.solve import Solution, size_of_boards, with_priors
from jcr.findings import Finding, FindingKind
from jcr.records import HandEye, LengthCheck, LengthName, ScaleCheck

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
Name = LengthName | Literal["robot"]


@dataclass(frozen=True)
class Length:
    """Logarithm of a length by the robot's positions over its stated value, and its own standard deviation."""

    name: Name
    off: float
    std: float

    def agrees_with(self, other: "Length") -> bool:
        """Return whether the difference of two lengths is usual."""
        return abs(self.off - other.off) < AGREES * float(np.hypot(self.std, other.std))


def check_lengths(case: Case) -> CheckResult:
    """Estimate the scale with all known lengths, or report two that contradict each other."""
    hand_eye, lengths = _measured(case)
    if not lengths:
        return CheckResult(_from_robot_alone(case, hand_eye), hand_eye)
    robot = Length("robot", 0.0, float(np.sqrt(hand_eye.covariance[6, 6])))
    pair = contradiction([robot, *lengths]) if hand_eye.converged else None
    is_made_of_images = hand_eye.converged and case.adjusted is not None and hand_eye.before is not None
    weighed = [
        one
        for one in lengths
        if is_made_of_images and pair is None and one.std < WORTH * robot.std and one.agrees_with(robot)
    ]
    checks = tuple(
        LengthCheck(
            name=one.name,
            robot_longer_percent=100 * float(np.expm1(one.off)),
            std_percent=100 * one.std,
            used=one in weighed,
        )
        for one in lengths
        if one.name != "robot"
    )
    hand_eye = replace(hand_eye, lengths=checks)
    if pair is not None:
        others = [one for one in (robot, *lengths) if one not in pair]
        found = finding_of(*pair, others, hand_eye)
        return CheckResult((found, *_from_robot_alone(case, hand_eye)), hand_eye)
    fault = _fault(hand_eye, lengths)
    if weighed:
        return _fused(case, hand_eye, weighed, fault)
    if hand_eye.converged and fault.any():
        hand_eye = judged(hand_eye.with_fault(fault))
    return CheckResult(_from_robot_alone(case, hand_eye), hand_eye)


def _measured(case: Case) -> tuple[HandEye, list[Length]]:
    """Return the calibration with the measurements of lengths, and the lengths."""
    hand_eye, found = case.hand_eye, list[Length]()
    boards, adjusted = case.reconstruction.tracks.boards, case.adjusted
    if adjusted is not None and boards is not None and hand_eye.before is not None:
        found.extend(_of_boards(adjusted, boards.size_std))
    if case.options.known_length is not None and not case.priors:
        image, *ends, length_mm = case.options.known_length
        ends_px = np.array(ends).reshape(2, 2)
        scale, std = length_cue(case.capture, case.reconstruction, image, ends_px, length_mm / 1e3)
        found.append(Length("known length", float(np.log(hand_eye.scale / scale)), std))
    if hand_eye.converged and (depth := depth_check(case.capture, case.reconstruction, hand_eye)) is not None:
        off_std = np.hypot(
            DEPTH_STD, np.sqrt(max((depth.std_percent / 100) ** 2 - hand_eye.covariance[6, 6], 0.0))
        )
        found.append(Length("depth camera", -float(np.log1p(depth.off_percent / 100)), float(off_std)))
        hand_eye = replace(hand_eye, depth=depth)
    # A unit with a stated standard deviation was used for the scale, and is no check of it.
    if case.reconstruction.is_metric and case.reconstruction.metric_std is None:
        # A network's length of 1 is `scale` metres by the robot.
        found.append(Length("network", float(np.log(hand_eye.scale)), NETWORK_STD))
        hand_eye = replace(hand_eye, network=_network_check(hand_eye))
    return hand_eye, found


def _of_boards(adjusted: Solution, size_std: float | None) -> Iterator[Length]:
    """Yield the size of the boards, where it is known and they were adjusted."""
    if size_std is None or adjusted.problem.boards is None:
        return
    off, by_unknown = size_of_boards(adjusted)
    together = float(by_unknown @ adjusted.covariance @ by_unknown)
    of_images = max(together - float(adjusted.covariance[SCALE, SCALE].item()), 0.0)
    yield Length("board", off, float(np.hypot(np.sqrt(of_images), size_std)))


def _network_check(hand_eye: HandEye) -> ScaleCheck:
    std_percent = 100 * float(np.sqrt(hand_eye.covariance[6, 6])) / hand_eye.scale
    return ScaleCheck(100 * (1 / hand_eye.scale - 1), std_percent)


def contradiction(lengths: list[Length]) -> tuple[Length, Length] | None:
    """Return the two lengths that contradict each other most surely; None where none do."""

    def sigmas(pair: tuple[Length, Length]) -> float:
        return abs(pair[0].off - pair[1].off) / float(np.hypot(pair[0].std, pair[1].std))

    worst = max(combinations(lengths, 2), key=sigmas)
    return worst if sigmas(worst) > SIGMAS and abs(worst[0].off - worst[1].off) > LEAST else None


def finding_of(one: Length, other: Length, others: list[Length], hand_eye: HandEye) -> Finding:
    """Return the finding that two lengths contradict each other; the robot is the first where it is one of them.

    Where an exact one of the `others` agrees with one of the two alone, the remaining one is wrong.
    """
    off, std = other.off - one.off, float(np.hypot(one.std, other.std))
    if one.name == "robot" and other.name == "network":
        check = _network_check(hand_eye)
        value, of_robot = check.off_percent / 100, check.std_percent / 100
        return Finding.of(FindingKind.NETWORK_SCALE, "warns", "poses", value=value, std=of_robot)
    agreeing = [
        (third.name, right.name)
        for third in others
        for right, wrong in ((one, other), (other, one))
        if third.std < EXACT and third.agrees_with(right) and not third.agrees_with(wrong)
    ]
    is_robot_doubted = one.name == "robot" and not any(right == "robot" for _, right in agreeing)
    exact = max(one.std, other.std) < EXACT and abs(off) >= CONTRADICTED[1]
    found = Finding.of(
        FindingKind.BOARD_SIZE if (one.name, other.name) == ("robot", "board") else FindingKind.SCALES,
        "rejects" if exact and is_robot_doubted else "warns",
        "poses",
        value=float(np.expm1(off)),
        std=std,
        one=one.name,
        other=other.name,
        **(dict(zip(("third", "agrees_with"), agreeing[0], strict=True)) if agreeing else {}),
    )
    if not is_robot_doubted or other.std >= EXACT:
        return found
    return replace(found, shift=tuple(_shift(off, hand_eye).tolist()))


def _shift(off: float, hand_eye: HandEye) -> Float[ndarray, "7"]:
    """Return the change of a calibration if the robot's positions were too long by exp(off)."""
    return -off * np.r_[hand_eye.gripper_from_camera[:3, 3], np.zeros(3), 1.0]


def _from_robot_alone(case: Case, hand_eye: HandEye) -> tuple[Finding, ...]:
    """Return the finding that the scale comes from the robot alone, where nothing but a network was compared with it."""
    compared = any(one.name != "network" for one in hand_eye.lengths)
    if compared or case.priors or case.reconstruction.metric_std is not None:
        return ()
    return (Finding.of(FindingKind.SCALE_FROM_ROBOT, "informs"),)


def _fault(hand_eye: HandEye, lengths: list[Length]) -> Float[ndarray, "7 7"]:
    """Return the covariance of the difference of the most exact length from the robot beyond their uncertainties."""
    best = min(lengths, key=lambda one: one.std)
    beyond = best.off**2 - best.std**2 - float(hand_eye.covariance[6, 6])
    if best.std >= EXACT or beyond <= 0:
        return np.zeros((7, 7))
    shift = _shift(float(np.sqrt(beyond)), hand_eye)
    return np.outer(shift, shift)


def _fused(case: Case, hand_eye: HandEye, lengths: list[Length], fault: Float[ndarray, "7 7"]) -> CheckResult:
    """Return the calibration with the lengths as priors of its scale."""
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
    refined = refined.with_fault(fault)
    for one in hand_eye.findings:
        if one.shift is not None:
            of_camera = one.intrinsics_shift
            shifts = None if of_camera is None else (np.array(one.shift), np.array(of_camera))
            refined = refined.with_fault(one.covariance, shifts)
    depth = hand_eye.depth
    if depth is not None:
        # What is measured with depth images is in the metre that the map has.
        percent = 100 * ((1 + depth.off_percent / 100) * hand_eye.scale / refined.scale - 1)
        depth = replace(depth, off_percent=percent)
    refined = replace(
        refined,
        findings=hand_eye.findings,
        depth=depth,
        network=hand_eye.network,
        lengths=hand_eye.lengths,
        board=hand_eye.board,
    )
    return CheckResult(_from_robot_alone(case, refined), judged(refined), adjusted)
