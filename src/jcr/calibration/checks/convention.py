"""Diagnosis of a rejected calibration: other readings and orders of the gripper poses, and poses of the camera.

A reading or an order that fits is reported, and never applied.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.case import Case
from jcr.calibration.verdict import judged
from jcr.capture.notations import EULERS, NUMBERS, in_words, rotations_of
from jcr.capture.notations import numbers_of as written_in
from jcr.capture.pairing import AS_NUMBERS, AS_TEXT, other_orders
from jcr.capture.readings import options_of, text_of
from jcr.estimation.outlier_rejection import pair_angles
from jcr.estimation.pose_misfit import NO_ROBOT, Misfit, angle_gap, pose_misfit
from jcr.findings import Finding, FindingKind
from jcr.geometry import Poses, Transform, inverse, rotation_angle, transform
from jcr.records import Reading

FITTED = 60
"""Largest number of readings, ranked by screw congruence, that are fitted; each takes 10 to 70 ms."""
USUAL = 9
"""Number of first readings that are fitted before all others: inverses, mirrored poses, and other orders."""
SAME_ANGLE = np.radians(0.1)
"""Step (rad) to which differences of angles are rounded for the ranking, so that usual mistakes come first among equals;
many readings differ by names of axes only, which leaves all angles equal."""
FITS_MM = 3.0
"""Misfit (mm) up to which the given poses count as correct: the noise of a low-cost arm."""
BETTER = 3.0
"""Ratio of the misfits of two readings of the same poses above which the images decide between them."""
BOARD = (0.01, np.radians(2.0))
"""Largest gripper_from_camera (m, rad) that counts as none; no camera of a real arm is nearer to the gripper's frame."""
INVERTED_BOARD = 0.03
"""Largest translation (m) that counts as none for inverse poses. A board's pose in the camera is one; its errors of some
millimetres, and a scale that is observed badly, move the camera by 7 to 23 mm in a real capture."""
MIRRORED = "mirrored ones (the images are mirrored, or the base's axes are left-handed)"
INVERSES = "their inverses (gripper_from_base was given)"
AT_SOURCE = "correct them at their source"
_Alternative = tuple[str, str, Poses, Int[ndarray, " k"], Mapping[str, str | float]]
"""Words, remedy, poses in the other reading or order, the index of the camera pose of each, and the fields of
ReadOptions that read a file so."""


def check_convention(case: Case) -> Case:
    """Return the case with a finding if its poses are the camera's own, or if they fit the images in another reading.

    Another reading is looked for if the calibration is rejected and no wrong size of a board explains that.
    """
    capture, camera, rows = case.capture, case.recon_from_camera, case.reconstruction.image_index
    found = case.calibration
    if capture.reading is not None:
        own = of_camera(found.parent_from_camera, capture.reading.inverted)
        if own is not None:
            return case.found(own)
    by_board = any(one.kind is FindingKind.BOARD_SIZE for one in found.findings)
    if found.converged or judged(case.fit, case.fit.findings).converged or by_board:
        return case
    poses = case.of_arm(capture.base_from_gripper)
    untaken = [(reading, case.of_arm(other)) for reading, other in capture.untaken]
    return case.found(*better_reading(poses, camera, case.observable, capture.images, rows, untaken))


def of_camera(gripper_from_camera: Transform, is_inverted: bool) -> Finding | None:
    """Return the finding that camera and gripper frame coincide, as where a board's poses were read; None otherwise.

    `is_inverted`: the gripper poses are inverses of what was written, as a board's pose in the camera would be.
    """
    metres = float(np.linalg.norm(gripper_from_camera[:3, 3]))
    radians = float(rotation_angle(gripper_from_camera[:3, :3]))
    if metres > (INVERTED_BOARD if is_inverted else BOARD[0]) or radians > BOARD[1]:
        return None
    return Finding.of(FindingKind.POSES_OF_CAMERA, "rejects", "poses", value=metres, rotation=radians)


def inverted_pair(misfit: Misfit, text: str) -> Finding:
    """Return the finding that either the gripper's or the marker's poses are inverted, which pairs of poses do not tell.

    If one of them is inverted, so that G⁻¹·X = Z·C fits, then G·Z = X·C⁻¹ fits as well: the other one may be inverted,
    and X and Z exchange their roles. `misfit` is that of the inverse gripper poses, `text` states it.
    """
    here, there = (float(np.linalg.norm(one[:3, 3])) for one in (misfit.x, misfit.z))
    return Finding.of(FindingKind.INVERTED_PAIR, "rejects", "poses", value=here, other=there, fits=text)


def better_reading(
    base_from_gripper: Poses,
    recon_from_camera: Float[ndarray, "m 4 4"],
    observable: bool = True,
    names: Sequence[str] | None = None,
    rows: Int[ndarray, " m"] | None = None,
    untaken: Sequence[tuple[Reading, Poses]] = (),
) -> tuple[Finding, ...]:
    """Return a finding of the reading or order of the poses that fits much better than the given one; else nothing.

    Its misfit must be below that of the given poses divided by BETTER, and that of a working robot. There is no finding
    if the given poses fit already (FITS_MM). The finding only warns unless the motions are `observable`, because
    degenerate motions may fit another reading by chance.

    `rows` holds the index of the gripper pose of each of the m camera poses; None: both arrays have the same order and
    length, as pairs of poses without images have. `names` are the images' names, by which other programs sort. `untaken`
    are other readings of the same numbers; without them, numbers are made from the poses.
    """
    is_pairs, rows = rows is None, np.arange(len(base_from_gripper)) if rows is None else rows
    given = pose_misfit(base_from_gripper[rows], recon_from_camera)
    if given.mm < FITS_MM:
        return ()
    angles, ranked = pair_angles(recon_from_camera), list[tuple[float, _Alternative]]()
    for k, one in enumerate(_alternatives(base_from_gripper, rows, names, untaken)):
        if len(one[3]) > 3:
            gap = angle_gap(pair_angles(one[2]), angles[np.ix_(one[3], one[3])])
            if gap <= NO_ROBOT:  # a reading whose rotations differ more cannot fit
                ranked.append((0 if k < USUAL else round(gap / SAME_ANGLE), one))
    ranked.sort(key=lambda pair: pair[0])
    fits = [(pose_misfit(one[2], recon_from_camera[one[3]]), one) for _, one in ranked[:FITTED]]
    if not fits:
        return ()
    least = min(fit.mm for fit, _ in fits)
    fit, (words, remedy, poses, _, read) = next(pair for pair in fits if pair[0].mm < 1.05 * least + 0.01)
    if not fit.is_of_robot or fit.mm * BETTER >= given.mm:
        return ()
    texts = [
        f"{1e3 * one.metres:.1f} mm and {np.degrees(one.radians):.2f}° per axis over {count} images"
        if np.isfinite(one.mm)
        else "no fit"
        for one, count in ((fit, len(poses)), (given, len(rows)))
    ]
    if is_pairs and words == INVERSES:
        return (inverted_pair(fit, texts[0]),)
    is_inverse = words == INVERSES or any(one.inverted and text_of(one) == words for one, _ in untaken)
    if found := of_camera(fit.x, is_inverse):
        return (found,)
    details = {"reading": words, "remedy": remedy, "fits": texts[0], "given": texts[1], **read}
    severity = "rejects" if observable else "warns"
    return (Finding.of(FindingKind.POSE_CONVENTION, severity, "poses", value=fit.metres, **details),)


def _alternatives(
    every: Poses,
    rows: Int[ndarray, " m"],
    names: Sequence[str] | None,
    untaken: Sequence[tuple[Reading, Poses]],
) -> Iterator[_Alternative]:
    """Yield other readings and orders of all gripper poses `every`, usual mistakes first; other arguments as above."""
    own, each = every[rows], np.arange(len(rows))
    if not untaken:
        yield (INVERSES, "add --pose-inverted", inverse(own), each, {"pose_inverted": 1.0})
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    flip = "switch off the driver's mirroring or flip the images back, or correct the sign of one axis of the poses"
    yield (MIRRORED, flip, mirror @ own @ mirror, each, {})
    for reading, poses in untaken:
        known = np.flatnonzero(np.isfinite(poses[rows]).all((1, 2)))
        options: dict[str, str | float] = {"pose_convention": reading.notation}
        options |= {"pose_inverted": 1.0} if reading.inverted else {}
        yield (text_of(reading), f"give {options_of(reading)}", poses[rows][known], known, options)
    for how, order in other_orders(names or [f"{k:04d}" for k in range(len(every))]):
        inside = order[rows] >= 0
        remedy = "add a column image with the images' names" if how in (AS_TEXT, AS_NUMBERS) else AT_SOURCE
        yield (how, remedy, every[order[rows][inside]], each[inside], {})
    for taken, meant, in_degrees in () if untaken else _mistakes():
        numbers = written_in(own[:, :3, :3], taken)
        read = rotations_of(np.degrees(numbers) if in_degrees else numbers, meant)
        were = (
            "in radians that were taken as degrees" if in_degrees else f"that were taken as {in_words(taken)}"
        )
        remedy = (
            AT_SOURCE if in_degrees else f"{AT_SOURCE}; from a file, --pose-convention {meant} reads them"
        )
        options = {} if in_degrees else {"pose_convention": meant}
        yield (f"{in_words(meant)} {were}", remedy, transform(read, own[:, :3, 3]), each, options)


def _mistakes() -> Iterator[tuple[str, str, bool]]:
    """Yield the notation that was taken, the one that was meant, and whether degrees were taken for radians."""
    yield from (("matrix", "matrix:columns", False), ("rotvec", "rotvec", True))
    for one in NUMBERS:
        for other in NUMBERS:
            if other != one and NUMBERS[one] == NUMBERS[other] and not one.startswith("matrix"):
                yield one, other, False
    for one in EULERS:
        yield one, one, True
