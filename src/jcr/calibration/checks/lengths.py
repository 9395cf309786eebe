"""Boards, and comparison of known lengths with the robot: boards, a known length, a depth camera, a network's metre.

Lengths that agree with the robot become priors of the mixed model. Where two lengths contradict each other, the scale
stays the robot's, and a finding names both. The scale of depth cameras is off by a few percent, and their noise grows
with the square of the distance (Khoshelham and Elberink, Sensors 2012).
"""

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.adjust import refined_by
from jcr.calibration.case import Case
from jcr.calibration.cues import CONTRADICTED, length_cue
from jcr.calibration.hand_eye import judged
from jcr.calibration.record import Calibration
from jcr.capture.images import read_depth
from jcr.estimation.boards import FEWEST_CORNERS, STRETCH_STD
from jcr.estimation.problem import SCALE, LinearPrior
from jcr.estimation.solve import Solution, size_of_boards, with_priors
from jcr.findings import Finding, FindingKind
from jcr.geometry import apply, inverse
from jcr.records import (
    BoardFound,
    Boards,
    Capture,
    DepthCheck,
    LengthCheck,
    LengthName,
    Reconstruction,
    ScaleCheck,
)

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
STRETCHED = 4.0
"""Standard deviations of a printer's stretch from which a board was not printed at its size."""
MOVED = 4.0
"""Factor from the scatter of a board's corners in an image to their common shift where the board was moved."""
MIN_IMAGES, MIN_FEATURES = 3, 60
"""Fewest images and features at which depth is compared."""
OUTSIDE = 0.3
"""Relative difference from the common one beyond which a depth is that of another surface."""
BINS = 8
"""Bins of distance in which the noise of depth is measured."""
NORMAL = 1.4826
"""Standard deviations of a normal error in its median absolute deviation."""


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
        image, *ends, length_mm = case.options.known_length
        ends_px = np.array(ends).reshape(2, 2)
        scale, std = length_cue(case.capture, case.reconstruction, image, ends_px, length_mm / 1e3)
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


def check_boards(case: Case) -> Case:
    """Report boards that were not found or that moved, and their size by the robot."""
    boards = case.reconstruction.tracks.boards
    assert boards is not None
    findings = list[Finding]()
    if not boards.bodies:
        details = {"board": boards.spec} | ({"proposed": boards.proposed} if boards.proposed else {})
        findings.append(
            Finding(
                kind=FindingKind.BOARD_NOT_FOUND, severity="warns", concerns="reconstruction", details=details
            )
        )
    if boards.elsewhere:
        elsewhere = [case.names[row] for row in boards.elsewhere]
        findings.append(Finding.of(FindingKind.BOARD_MOVED, "warns", "images", *elsewhere, board=boards.spec))
    hand_eye = case.hand_eye
    if case.adjusted is None or case.adjusted.problem.boards is None:
        return case.after(tuple(findings))
    findings += board_faults(case)
    found = board_found(case.adjusted, boards)
    if boards.size_std is None and hand_eye.source == "images":
        side = 1e-3 * found.side_mm, 1e-3 * found.side_std_mm
        findings.append(
            Finding.of(FindingKind.BOARD_SIDE, "informs", value=side[0], std=side[1], board=boards.spec)
        )
    return case.after(tuple(findings), replace(hand_eye, board=found))


def board_faults(case: Case) -> list[Finding]:
    """Return a finding of the fault that an adjustment shows of its boards, whose size is then no known length.

    A board whose sides are stretched was not printed at its size. The corners of a board that was moved are, in some of
    the images, all displaced alike.
    """
    adjusted, boards = case.adjusted, case.reconstruction.tracks.boards
    if boards is None or adjusted is None or adjusted.problem.boards is None:
        return []
    observations, shapes = adjusted.problem.observations, adjusted.problem.boards
    assert observations is not None
    shape = adjusted.state.camera_steps[adjusted.problem.columns.boards]
    stretch = max(shape[shapes.shape_std == STRETCH_STD].tolist(), key=abs, default=0.0)
    if abs(stretch) > STRETCHED * STRETCH_STD:
        return [
            Finding.of(FindingKind.BOARD_STRETCHED, "warns", "none", value=abs(stretch), board=boards.spec)
        ]
    of_corners = np.isin(observations.point, shapes.point)
    residual_px = adjusted.images.view.residual_px[of_corners]
    rows, image, count = np.unique(observations.image[of_corners], return_inverse=True, return_counts=True)
    shift_px = np.stack([np.bincount(image, axis) for axis in residual_px.T], axis=1) / count[:, None]
    scatter_px = np.sqrt(np.median(((residual_px - shift_px[image]) ** 2).sum(1)))
    away = rows[(count >= FEWEST_CORNERS) & (np.linalg.norm(shift_px, axis=1) > MOVED * scatter_px)]
    if not len(away):
        return []
    names = [case.names[row] for row in case.used[away]]
    return [Finding.of(FindingKind.BOARD_MOVED, "warns", "images", *names, board=boards.spec)]


def board_found(adjusted: Solution, boards: Boards) -> BoardFound:
    """Return the boards as an adjustment has them."""
    problem, state, shapes = adjusted.problem, adjusted.state, adjusted.problem.boards
    assert shapes is not None and problem.observations is not None
    size, by_unknown = size_of_boards(adjusted)
    side_mm = 1e3 * boards.side * float(np.exp(size))
    std = float(np.sqrt(by_unknown @ adjusted.covariance @ by_unknown))
    of_corners = np.isin(problem.observations.point, shapes.point)
    shape = state.camera_steps[problem.columns.boards]
    bent = np.column_stack([shapes.x_in_body[:, :2], shapes.bend(shape)])
    bent_mm = 1e3 * state.scale * np.exp(shape[0]) * bent
    numbers = np.unique(shapes.body)
    bends_mm = [float(np.ptp(bent_mm[shapes.body == k, 2])) for k in numbers]
    most = shapes.body == numbers[int(np.argmax(bends_mm))]
    rigs = state.world_from_rig[shapes.first_rig + numbers]
    normals = rigs[:, :3, 2] @ state.z[0][:3, :3].T
    points = apply(state.z[0], state.scale * state.points_in_world[shapes.point])
    return BoardFound(
        spec=boards.spec,
        bodies=len(numbers),
        images=len(np.unique(problem.observations.image[of_corners])),
        corners=len(shapes.point),
        side_mm=side_mm,
        side_std_mm=side_mm * std,
        stated_mm=None if boards.size_std is None else 1e3 * boards.side,
        rms_px=float(np.sqrt((adjusted.images.view.residual_px[of_corners] ** 2).mean())),
        bend_mm=max(bends_mm),
        centres_in_base=tuple(_xyz(points[shapes.body == k].mean(0)) for k in numbers),
        tilts_deg=tuple(np.degrees(np.arccos(np.abs(normals[:, 2]).clip(0, 1))).tolist()),
        shape_mm=tuple(_xyz(one) for one in bent_mm[most].round(3)),
    )


def _xyz(x: Float[ndarray, "3"]) -> tuple[float, float, float]:
    return float(x[0]), float(x[1]), float(x[2])


def depth_check(capture: Capture, reconstruction: Reconstruction, hand_eye: Calibration) -> DepthCheck | None:
    """Return scale and noise of the depth images by the robot; None where too few features have a depth.

    Raises InputError where a depth image cannot be read.
    """
    if capture.depths is None:
        return None
    measured, predicted, image = _pairs(capture, reconstruction, hand_eye.scale, capture.depths)
    off = np.log(measured / predicted)
    rows, count = np.unique(image, return_counts=True)
    rows = rows[count >= MIN_FEATURES // 6]
    if len(rows) < MIN_IMAGES or len(off) < MIN_FEATURES:
        return None
    # An image's features share what its pose is off by, so images are counted and not features.
    medians = np.array([np.median(off[image == row]) for row in rows])
    common = float(np.median(medians))
    spread = NORMAL * float(np.median(np.abs(medians - common)))
    std = np.hypot(1.2533 * spread / np.sqrt(len(rows)), np.sqrt(hand_eye.covariance[6, 6]))
    same = np.abs(off - common) < OUTSIDE
    depth = predicted[same]
    noise_m, noise_per_m = _noise(depth, measured[same] / np.exp(common) - depth)
    near, far = np.percentile(depth, [5, 95])
    return DepthCheck(
        off_percent=100 * float(np.expm1(common)),
        std_percent=100 * float(std),
        noise_m=noise_m,
        noise_per_m=noise_per_m,
        distances_m=(float(near), float(far)),
        images=len(rows),
        features=int(same.sum()),
    )


def _pairs(
    capture: Capture, reconstruction: Reconstruction, scale: float, depths: tuple[str | None, ...]
) -> tuple[Float[ndarray, " k"], Float[ndarray, " k"], Int[ndarray, " k"]]:
    """Return measured depths (m), depths by the robot, and images of all features that have both."""
    tracks = reconstruction.tracks
    parts = []
    for k, row in enumerate(reconstruction.image_index):
        if row >= len(depths) or (name := depths[row]) is None:
            continue
        depth = read_depth(capture.folder / name, capture.image_size)
        seen = np.flatnonzero(tracks.image == k)
        u, v = np.rint(tracks.x_px[seen]).astype(int).T
        inside = (u >= 1) & (v >= 1) & (u < depth.shape[1] - 1) & (v < depth.shape[0] - 1)
        seen, u, v = seen[inside], u[inside], v[inside]
        around = np.stack([depth[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)])
        camera_from_recon = inverse(reconstruction.recon_from_camera[k])
        x_in_camera = apply(camera_from_recon, tracks.points_in_recon[tracks.point[seen]])
        # At the edge of a thing, colour and depth are of different ones.
        whole = (around > 0).all(0) & (np.ptp(around, axis=0) < 0.03 * around[4]) & (x_in_camera[:, 2] > 0)
        parts.append((around[4][whole].astype(float), scale * x_in_camera[whole, 2], np.full(whole.sum(), k)))
    if not parts:
        return np.zeros(0), np.zeros(0), np.zeros(0, int)
    measured, predicted, image = map(np.concatenate, zip(*parts, strict=True))
    return measured, predicted, image


def _noise(depth: Float[ndarray, " k"], residual: Float[ndarray, " k"]) -> tuple[float, float]:
    """Return a (m) and b (1/m) of sigma² = a² + (b z²)² by the spread of the residuals in bins of distance."""
    from scipy.optimize import nnls  # few captures have a depth camera, and it takes 0.1 s

    bins = np.array_split(np.argsort(depth), BINS)
    z = np.array([np.median(depth[rows]) for rows in bins])
    variance = np.array([(NORMAL * np.median(np.abs(residual[rows]))) ** 2 for rows in bins])
    # Relative, for a variance that is estimated is as uncertain as it is large.
    design = np.stack([np.ones(BINS), z**4], 1) / variance[:, None].clip(1e-12)
    (constant, growing), _ = nnls(design, np.ones(BINS))
    return float(np.sqrt(constant)), float(np.sqrt(growing))
