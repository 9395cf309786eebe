"""Checks of known lengths (board, depth camera, network) against the robot, and of a network's focal length.

Lengths that agree with the robot become priors of the scale. If two lengths contradict each other, the scale stays that
of the robot, and a finding names both. Depth cameras have scale errors of a few percent, and noise that grows with the
square of the distance (Khoshelham and Elberink, Sensors 2012).
"""

from dataclasses import replace
from itertools import combinations
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.bundle_adjustment import solved
from jcr.calibration.case import MIN_IMAGES, Case
from jcr.calibration.record import Calibration
from jcr.calibration.verdict import with_uncertainty
from jcr.capture.images import read_depth_images
from jcr.estimation.intrinsics_prior import MEASURED, camera_with_prior
from jcr.estimation.problem import SCALE, LinearPrior
from jcr.estimation.solve import size_of_boards
from jcr.findings import Finding, FindingKind
from jcr.geometry import apply, inverse
from jcr.number_format import significant
from jcr.records import Capture, DepthCheck, LengthCheck, Reconstruction

DEPTH_STD, NETWORK_STD = 0.02, 0.05
"""Relative standard deviations of the scale of depth cameras (errors of a few percent) and networks (up to 10 %)."""
ROBOT_STD = 0.002
"""Relative standard deviation of a common scale error of all robot positions, which the poses cannot show."""
SIGMAS = 3.5
"""Difference of two lengths, in standard deviations, above which they contradict each other."""
LEAST_CONTRADICTION = 0.005
"""Relative difference of two lengths above which they contradict each other; SIGMAS must be exceeded too."""
AGREES = 2.0
"""Difference of a length from the robot's, in standard deviations, below which the length is a prior of the scale. At a
larger difference a prior does harm: with robot positions 1 % too long, it increases the error of the transform from 1.0
to 1.4 mm, because the adjustment rotates and shifts the transform."""
MISPRINTED = 0.1
"""Largest relative difference that a board's print or a mistyped side explains better than an error of the robot, whose
positions have a common scale error of ROBOT_STD; larger ones come from units."""
EXACT_LENGTH = 0.015
"""Largest relative standard deviation with which a length can reject a calibration."""
WORTH = 10.0
"""Largest ratio of a length's standard deviation to that of the robot's scale for which the length is a prior; a less
exact one hardly changes the scale and is only compared."""

OF_NETWORK = 1.64
"""Reported difference of a network's from the given focal length (standard deviations); one in ten correct ones."""
MIN_FEATURES = 60
"""Fewest features with which depth images are compared with the robot."""
OUTSIDE = 0.3
"""Log ratio of a measured to a predicted depth, relative to the median one, above which the surfaces differ."""
BINS = 8
"""Number of distance bins in which the noise of depths is estimated."""
NORMAL = 1.4826
"""Ratio of the standard deviation of a normal distribution to its median absolute deviation."""


def check_lengths(case: Case) -> Case:
    """Return the case with known lengths as priors of the scale, or with a finding that two lengths contradict.

    A known length comes from a board, a depth camera or a network; the robot's positions count as another length. Two
    of them contradict if they differ by more than SIGMAS standard deviations and by more than LEAST_CONTRADICTION. The
    comparison is recorded in `Calibration.lengths`.
    """
    depth, lengths = _measured(case)
    converged, percent = case.calibration.converged, case.calibration.uncertainty.scale_std_percent
    robot = LengthCheck(name="robot", robot_longer_percent=0.0, std_percent=percent)

    def sigmas(pair: tuple[LengthCheck, LengthCheck]) -> float:
        """Return the difference of two lengths, divided by its standard deviation."""
        return abs(pair[0].off - pair[1].off) / float(np.hypot(pair[0].std, pair[1].std))

    pair = max(combinations([robot, *lengths], 2), key=sigmas, default=None) if converged else None
    if pair is not None and (sigmas(pair) <= SIGMAS or abs(pair[0].off - pair[1].off) <= LEAST_CONTRADICTION):
        pair = None
    of_images = converged and case.numbers.source == "images"
    weighed = [
        one
        for one in lengths
        if of_images and pair is None and one.std < WORTH * robot.std and sigmas((one, robot)) < AGREES
    ]
    compared = any(one.name != "network" for one in lengths) or bool(case.pose_model.priors)
    alone = not compared and case.reconstruction.metric_std is None
    findings = [Finding.of(FindingKind.SCALE_FROM_ROBOT, "informs")] * alone
    if pair is not None:
        findings.insert(0, _contradiction(*pair, case.calibration))
    # The difference of the most exact length from the robot, as far as it exceeds their uncertainties, is a fault.
    best, fault = min(lengths, key=lambda one: one.std, default=robot), np.zeros((7, 7))
    beyond = best.off**2 - best.std**2 - robot.std**2
    if pair is None and converged and best.std < EXACT_LENGTH and beyond > 0:
        shift = _shift(float(np.sqrt(beyond)), case.calibration)
        fault = np.outer(shift, shift)
    before = case.numbers.scale
    if weighed:
        case = solved(case, replace(case.model, lengths=_priors(case, weighed)))
    if depth is not None:
        # The scale error of the depth images refers to the scale of the result.
        percent = 100 * ((1 + depth.off_percent / 100) * before / case.numbers.scale - 1)
        depth = replace(depth, off_percent=percent)
    checked = tuple(replace(one, used=one in weighed) for one in lengths)
    numbers = with_uncertainty(case.numbers, case.numbers.uncertainty.with_error(fault))
    return replace(case, numbers=replace(numbers, lengths=checked, depth_check=depth)).found(*findings)


def _measured(case: Case) -> tuple[DepthCheck | None, list[LengthCheck]]:
    """Return scale and noise of the depth images, and the comparison of each known length of the case."""
    hand_eye, found, depth = case.calibration, list[LengthCheck](), None
    boards, adjusted, variance = case.model.tracks.boards, case.solution, hand_eye.covariance[6, 6]
    is_known = boards is not None and hand_eye.source != "poses" and not boards.is_stretched
    size_std = boards.size_std if boards is not None and is_known else None
    if adjusted is not None and adjusted.problem.boards is not None and size_std is not None:
        off, by_unknown = size_of_boards(adjusted)
        together = float(by_unknown @ adjusted.covariance @ by_unknown)
        of_images = max(together - float(adjusted.covariance[SCALE, SCALE].item()), 0.0)
        found.append(_length("board", off, float(np.hypot(np.sqrt(of_images), size_std))))
    if hand_eye.converged and (depth := depth_check(case.capture, case.reconstruction, hand_eye)) is not None:
        of_depth = max((depth.std_percent / 100) ** 2 - variance, 0.0)
        std = float(np.hypot(DEPTH_STD, np.sqrt(of_depth)))
        found.append(_length("depth camera", -float(np.log1p(depth.off_percent / 100)), std))
    # A metric unit with a standard deviation is a prior of the scale already, and no independent check.
    if case.reconstruction.is_metric and case.reconstruction.metric_std is None:
        # A length of 1 m in the network's reconstruction is `scale` metres by the robot.
        found.append(_length("network", float(np.log(hand_eye.scale)), NETWORK_STD))
    return depth, found


def _length(name: Literal["board", "depth camera", "network"], off: float, std: float) -> LengthCheck:
    """Return the comparison of a length from `LengthCheck.off` and `LengthCheck.std`."""
    return LengthCheck(name=name, robot_longer_percent=100 * float(np.expm1(off)), std_percent=100 * std)


def _contradiction(one: LengthCheck, other: LengthCheck, hand_eye: Calibration) -> Finding:
    """Return the finding that two lengths contradict each other; a length by the robot must be `one`.

    A board that contradicts the robot by up to MISPRINTED was printed or stated at a wrong size. The finding then
    warns, because the result is that of the robot alone. At a larger difference the finding rejects if both lengths are
    exact (EXACT_LENGTH).
    """
    off, std = other.off - one.off, float(np.hypot(one.std, other.std))
    size: dict[str, Any] = {"value": float(np.expm1(off)), "std": std}
    if one.name == "robot" and other.name == "network":
        size = {"value": float(np.expm1(-off)), "std": one.std / hand_eye.scale}
        return Finding.of(FindingKind.NETWORK_SCALE, "warns", "poses", **size)
    if one.name != "robot" or other.name != "board":
        return Finding.of(FindingKind.SCALES, "warns", "poses", **size, one=one.name, other=other.name)
    if abs(off) <= MISPRINTED:
        return Finding.of(FindingKind.BOARD_SIZE, "warns", "none", **size)
    if other.std < EXACT_LENGTH:
        size["shift"] = tuple(_shift(off, hand_eye).tolist())
    severity = "rejects" if max(one.std, other.std) < EXACT_LENGTH else "warns"
    return Finding.of(FindingKind.BOARD_SIZE, severity, "poses", **size)


def _shift(off: float, hand_eye: Calibration) -> Float[ndarray, "7"]:
    """Return the correction (COVARIANCE_ORDER) of a calibration from robot positions too large by a factor exp(off).

    Translation and scale shrink by that factor.
    """
    return -off * np.r_[hand_eye.parent_from_camera[:3, 3], np.zeros(3), 1.0]


def _priors(case: Case, lengths: list[LengthCheck]) -> tuple[LinearPrior, ...]:
    """Return the known lengths as priors of the scale, for the unknowns of the case's solution."""
    found, boards, known = case.solution, case.model.tracks.boards, list[LinearPrior]()
    assert found is not None
    for one in lengths:
        row, std = np.eye(found.problem.unknowns)[SCALE.start], one.std
        value = float(np.log(found.most_likely.scale)) - one.off
        if one.name == "board" and boards is not None and boards.size_std is not None:
            size, row = size_of_boards(found)
            value = float(row @ found.problem.coordinates(found.state)) - size
            std = boards.size_std
        known.append(LinearPrior(row, value, float(np.hypot(std, ROBOT_STD))))
    return tuple(known)


def check_predicted_focal(case: Case) -> Case:
    """Return the case with a finding if a network's focal length contradicts the given one.

    They contradict if they differ by more than OF_NETWORK standard deviations. The finding adds the difference to the
    covariance of the intrinsics (`Finding.intrinsics_shift`).
    """
    given, predicted = case.capture.intrinsics, case.reconstruction.predicted_focal
    if given is None or predicted is None:
        return case
    focal, relative_std = predicted
    off = focal / given.fx - 1
    if abs(off) < OF_NETWORK * np.hypot(relative_std, MEASURED["f"]):
        return case
    sizes = f"{focal:.0f} ± {significant(focal * relative_std)} px where {given.fx:.0f} is given"
    shown = {"source": "pointmaps", "shown": f"a focal length of {sizes}"}
    by_focal = camera_with_prior(case.reconstruction.intrinsics, {"f": abs(off)})
    moved = tuple((by_focal.directions @ by_focal.std).tolist())
    shifts = {"shift": (0.0,) * 7, "intrinsics_shift": moved}
    found = Finding.of(FindingKind.INTRINSICS, "warns", "intrinsics", **shown, **shifts)
    return case.found(found)


def depth_check(capture: Capture, reconstruction: Reconstruction, hand_eye: Calibration) -> DepthCheck | None:
    """Return scale error and noise of the depth images, measured by the robot; None if too few features have a depth.

    Measured depths are compared with the depths of reconstructed features, which `hand_eye.scale` converts to metres.
    None is also returned without depth images, or
    if too few depths agree with the median. Raises InputError if a depth image cannot be read.
    """
    if capture.depths is None:
        return None
    from scipy.optimize import nnls  # few captures have a depth camera, and it takes 0.1 s

    measured, predicted, image = _depths(capture, reconstruction, hand_eye.scale)
    off = np.log(measured / predicted)
    rows, count = np.unique(image, return_counts=True)
    rows = rows[count >= MIN_FEATURES // 6]
    if len(rows) < MIN_IMAGES or len(off) < MIN_FEATURES:
        return None
    # Features of an image share its pose error, so the standard error follows from the number of images.
    medians = np.array([np.median(off[image == row]) for row in rows])
    common = float(np.median(medians))
    spread = NORMAL * float(np.median(np.abs(medians - common)))
    std = np.hypot(1.2533 * spread / np.sqrt(len(rows)), hand_eye.uncertainty.std[6])
    same = np.abs(off - common) < OUTSIDE
    if same.sum() < MIN_FEATURES:
        # Two groups of depths, of different units or surfaces, have their median between them.
        return None
    depth = predicted[same]
    # The variance of the residuals at depth z is a² + (b z²)², with a and b fitted in bins of z. The rows are divided by
    # the variance, because the error of an estimated variance is proportional to it.
    residual, bins = measured[same] / np.exp(common) - depth, np.array_split(np.argsort(depth), BINS)
    z = np.array([np.median(depth[rows]) for rows in bins])
    variance = np.array([(NORMAL * np.median(np.abs(residual[rows]))) ** 2 for rows in bins])
    design = np.stack([np.ones(BINS), z**4], 1) / variance[:, None].clip(1e-12)
    noise_m, noise_per_m = np.sqrt(nnls(design, np.ones(BINS))[0]).tolist()
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


def _depths(
    capture: Capture, reconstruction: Reconstruction, scale: float
) -> tuple[Float[ndarray, " k"], Float[ndarray, " k"], Int[ndarray, " k"]]:
    """Return measured depths (m), reconstructed depths (m), and image indices of the k features that have both.

    Depths are z coordinates in the camera frame; `scale` is in metres per unit of the reconstruction. The measured one
    is that of the nearest pixel; features at depth edges are left out. Image indices count the registered images.
    """
    tracks, depths = reconstruction.tracks, list(capture.depths or [])
    parts = [np.zeros((3, 0))]
    for k, row in enumerate(reconstruction.image_index):
        if row >= len(depths) or (name := depths[row]) is None:
            continue
        depth = read_depth_images(capture.folder / name, capture.image_size)
        seen = np.flatnonzero(tracks.image == k)
        u, v = np.rint(tracks.x_px[seen]).astype(int).T
        inside = (u >= 1) & (v >= 1) & (u < depth.shape[1] - 1) & (v < depth.shape[0] - 1)
        seen, u, v = seen[inside], u[inside], v[inside]
        around = np.stack([depth[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)])
        camera_from_recon = inverse(reconstruction.recon_from_camera[k])
        z = apply(camera_from_recon, tracks.points_in_recon[tracks.point[seen]])[:, 2]
        # At the edge of an object, colour and depth image may show different surfaces.
        whole = (around > 0).all(0) & (np.ptp(around, axis=0) < 0.03 * around[4]) & (z > 0)
        parts.append(np.stack([around[4][whole], scale * z[whole], np.full(whole.sum(), k)]))
    measured, predicted, image = np.concatenate(parts, axis=1)
    return measured, predicted, image.astype(int)
