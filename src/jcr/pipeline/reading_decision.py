"""Decision between readings of gripper poses by the images: camera poses without the robot, misfit of each reading."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations, islice
from math import comb
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.checks.convention import BETTER, FITTED, of_camera
from jcr.capture.checks import require_frames, require_motion
from jcr.capture.folder import count_differs
from jcr.capture.options import tolerated
from jcr.capture.pairing import LARGEST_SHIFT, other_orders
from jcr.capture.readings import text_of, undecided
from jcr.cell.moving_parts import with_moving_parts
from jcr.errors import InputError, RejectedError, count_of, first_few
from jcr.estimation.observability import observability
from jcr.estimation.outlier_rejection import pair_angles
from jcr.estimation.pose_misfit import MM_PER_DEG, NO_FIT, NO_ROBOT, Misfit, angle_gap, pose_misfit
from jcr.geometry import Poses, inverse, rotation_angle
from jcr.number_format import significant
from jcr.progress import Progress, silent
from jcr.records import Capture, Reading, Reconstruction

LEAST_MISFIT = 0.3
"""Misfit (mm) below which two readings are not told apart: 0.1 mm and 0.04°, the best of structure from motion."""
FEWEST_TO_DECIDE = 5
"""Smallest number of images by which a reading is taken; four fit some of a hundred readings by chance."""
SAME_ROW = 1e-3
"""Largest difference (m, and of the entries of a rotation) of two poses of an arm at rest."""
FITTED_ANYWAY = 10
"""Number of readings that are fitted although none can be that of a robot, so that a message says how far off it is."""
MOST_CHOICES = 3000
"""Largest number of choices of rows that are tried where rows and images differ in number."""


class _Fit(NamedTuple):
    """Reading with the misfit of its poses at the registered images."""

    reading: Reading
    poses: Poses
    """Poses of all images of the capture, (n,4,4)."""
    misfit: Misfit

    @property
    def is_of_camera(self) -> bool:
        """Whether gripper_from_camera is almost the identity, as for a board's poses that a camera measured."""
        return self.misfit is not NO_FIT and of_camera(self.misfit.x, self.reading.inverted) is not None


def decided_by_images(
    capture: Capture, board: str | None = None, seed: int = 0, progress: Progress = silent
) -> tuple[Capture, Reconstruction | None]:
    """Return a capture whose reading is decided, and the reconstruction without poses if a run can use it.

    `board` is the value of the option --board. A capture without `candidates` is returned as it is. Raises InputError
    as `decide`, or if the images cannot be reconstructed; the message then lists the readings.
    """
    if not capture.candidates:
        return capture, None
    readings = [reading for reading, _ in capture.candidates]
    try:
        with TemporaryDirectory(prefix="jcr-moving-") as moving:
            seen = with_moving_parts(capture, Path(moving)) if capture.mount == "base" else capture
            made, has_failed = _from_images_alone(seen, board, seed, progress)
    except RejectedError as error:
        if len(capture.candidates[0][1]) != len(capture):
            raise count_differs(capture) from None
        raise InputError(
            f"{undecided(str(capture.source), readings)}; the images do not tell: {error.what}"
        ) from None
    decided = decide(capture, made.recon_from_camera, made.image_index)
    # A run tests given intrinsics unless they failed here, and uses a board; its rows are those of all images.
    is_of_run = board is None and (capture.intrinsics is None or has_failed) and len(decided) == len(capture)
    return decided, made if is_of_run else None


def _from_images_alone(
    capture: Capture, board: str | None, seed: int, progress: Progress
) -> tuple[Reconstruction, bool]:
    """Return the reconstruction without poses: from the board if it is given and seen, else from features.

    Given intrinsics with which fewer than half of the images register may be wrong, and are then estimated. If far
    more images register with estimated ones (`registered_with`), the second value is true, and a warning states it.
    Raises RejectedError if the images cannot be reconstructed.
    """
    from jcr.boards.marker import reconstruct_marker
    from jcr.sfm.colmap import MOST_ALONE, intrinsics_not_used, reconstruct_alone, registered_with

    if board is not None:
        with suppress(RejectedError):
            return reconstruct_marker(capture, board, progress), False
    if capture.intrinsics is None:
        return reconstruct_alone(capture, seed, progress), False
    made, of = None, min(len(capture), MOST_ALONE)
    with suppress(RejectedError):
        made = reconstruct_alone(capture, seed, progress)
    before = 0 if made is None else len(made.image_index)
    if made is not None and 2 * before >= of:
        return made, False
    try:
        free = reconstruct_alone(replace(capture, intrinsics=None, intrinsics_std=None), seed, progress)
    except RejectedError:
        if made is None:
            raise
        return made, False
    if made is not None and len(free.image_index) <= before:
        return made, False
    if (found := registered_with(before, len(free.image_index), of)) is None:
        return free, False
    return replace(free, warnings=(*free.warnings, intrinsics_not_used(found))), True


def first_reading(capture: Capture) -> Capture:
    """Return an undecided capture with the poses of its first reading, for measures of its motion; it stays undecided.

    Raises InputError if poses and images differ in number.
    """
    poses = capture.candidates[0][1]
    if len(poses) != len(capture):
        raise count_differs(capture)
    rows = np.flatnonzero(np.isfinite(poses).all((1, 2)))
    require_motion(poses[rows], str(capture.source))
    return replace(capture.of_rows(rows), base_from_gripper=poses[rows])


def decide(capture: Capture, recon_from_camera: Poses, image_index: Int[ndarray, " m"]) -> Capture:
    """Return the capture with the reading of its poses that fits the camera poses, decisively better than all others.

    `recon_from_camera` are the camera poses of the images with the indices `image_index`, in any frame and unit. Raises
    InputError if rows and images differ in number, if no reading fits, if several do, or if the poses fit in another
    order; the message states what fits, which is never taken.
    """
    if capture.mount == "base":
        # Seen from what the gripper carries, a fixed camera moves by the inverse poses.
        inverted = tuple((reading, inverse(poses)) for reading, poses in capture.candidates)
        capture = replace(capture, mount="gripper", candidates=inverted)
        decided = _fitting(capture, recon_from_camera, image_index)
        return replace(decided, mount="base", base_from_gripper=inverse(decided.base_from_gripper))
    decided = _fitting(capture, recon_from_camera, image_index)
    if decided.reading is None or not decided.reading.inverted:
        return decided
    note = (
        "the poses fit as the base in the gripper frame; if the camera is beside the robot and watches the gripper, "
        "calibrate with --mount base instead"
    )
    return replace(decided, notes=(*decided.notes, note))


def _fitting(capture: Capture, recon_from_camera: Poses, image_index: Int[ndarray, " m"]) -> Capture:
    """Return the capture of a camera on the gripper with the reading that fits; raise InputError as `decide`."""
    if len(capture.candidates[0][1]) != len(capture):
        raise _rows_of_images(capture, recon_from_camera, image_index)
    fits = _ranked(capture.candidates, recon_from_camera, image_index)
    own = [fit for fit in fits if not fit.is_of_camera]
    if fits[0].is_of_camera and not (own and own[0].misfit.is_of_robot):
        raise _poses_of_camera(capture, fits[0])
    return _taken(capture, own, recon_from_camera, image_index)


def _taken(
    capture: Capture, fits: Sequence[_Fit], recon_from_camera: Poses, image_index: Int[ndarray, " m"]
) -> Capture:
    """Return the capture with the best of its readings; raise InputError if it does not fit, or another one does."""
    best, where = fits[0], str(capture.source)
    others = [fit for fit in fits[1:] if _differ(best, fit)]
    size = max(best.misfit.mm, LEAST_MISFIT)
    if not best.misfit.is_of_robot or (others and others[0].misfit.mm < BETTER * size):
        _refuse_order(capture, best, recon_from_camera, image_index)
        if not best.misfit.is_of_robot:
            raise InputError(
                f"{where}: the poses fit the images in no reading; the best is {text_of(best.reading)}, which disagrees "
                f"by {_size(best.misfit)}: check that poses and images are of one capture and in one order, and that "
                "--mount base is given if, and only if, the camera is beside the robot"
            )
        rivals = [best, *(fit for fit in others if fit.misfit.mm < BETTER * size)]
        sizes = ", ".join(_size(fit.misfit) for fit in rivals[:6])
        raise InputError(
            f"{undecided(where, [fit.reading for fit in rivals])}, as the robot's manual has it, and do not try them in "
            f"turn: the images fit them all ({sizes}); or add images, rotated by 20° or more about other axes"
        )
    known = int(np.isfinite(best.poses[image_index]).all((1, 2)).sum())
    if known < FEWEST_TO_DECIDE:
        raise InputError(
            f"{undecided(where, [fit.reading for fit in fits[:6]])}; {count_of(known, 'image')}: too few to decide, "
            f"{FEWEST_TO_DECIDE} are needed"
        )
    observed = observability(best.poses[np.isfinite(best.poses).all((1, 2))], best.misfit.x)
    if not observed.observable and capture.candidates[1:]:
        raise InputError(
            f"{undecided(where, [fit.reading for fit in fits[:6]])}, as the robot's manual has it; these motions do not "
            f"show it: {observed.advice[0]}"
        )
    has_pose = np.isfinite(best.poses).all((1, 2))
    rows, lost = np.flatnonzero(has_pose), [capture.images[k] for k in np.flatnonzero(~has_pose).tolist()]
    if len(lost) > tolerated(len(capture)):
        raise InputError(
            f"{where}: the rows of {first_few(lost)} hold no pose as {text_of(best.reading)}; correct them"
        )
    require_frames(len(rows), where)
    require_motion(best.poses[rows], where)
    reading = replace(
        best.reading,
        decided_by="images",
        misfit_mm=round(best.misfit.mm, 3),
        next_best=text_of(others[0].reading) if others else None,
        next_misfit_mm=round(others[0].misfit.mm, 3) if others and np.isfinite(others[0].misfit.mm) else None,
    )
    notes = [f"left out: {where}: the rows of {first_few(lost)} hold no pose"] if lost else []
    chosen = replace(capture.of_rows(rows), others=capture.others, base_from_gripper=best.poses[rows])
    return replace(chosen, reading=reading, candidates=(), notes=(*capture.notes, *notes))


def _ranked(
    candidates: Sequence[tuple[Reading, Poses]],
    recon_from_camera: Float[ndarray, "m 4 4"],
    image_index: Int[ndarray, " m"],
    most_mm: float = np.inf,
    fitted: int | None = None,
) -> list[_Fit]:
    """Return the readings with their misfits, best first; a misfit above `most_mm` does not matter.

    Readings are fitted in the order of their screw congruence, the first `fitted` ones (None: all), until the rest
    cannot be near the best, or none of the rest can be that of a robot: a difference of angles is a misfit by itself.
    The rest has no fit.
    """
    cameras, fits, best, ranked = pair_angles(recon_from_camera), list[_Fit](), np.inf, []
    for reading, poses in candidates:
        at_images = poses[image_index]
        known = np.flatnonzero(np.isfinite(at_images).all((1, 2)))
        gap = np.inf
        if len(known) > 2:
            gap = angle_gap(pair_angles(at_images[known]), cameras[np.ix_(known, known)])
        ranked.append((gap, reading, poses, known))
    for gap, reading, poses, known in sorted(ranked, key=lambda one: one[0]):
        # Of two rotations that differ, each has half of the error.
        least_mm = MM_PER_DEG * float(np.degrees(gap)) / 2
        is_hopeless = (
            gap > NO_ROBOT and len(fits) >= FITTED_ANYWAY and not any(fit.misfit.is_of_robot for fit in fits)
        )
        is_late = fitted is not None and len(fits) >= fitted
        if not least_mm < min(2 * BETTER * max(best, LEAST_MISFIT), most_mm) or is_hopeless or is_late:
            fits.append(_Fit(reading, poses, NO_FIT))
            continue
        fits.append(_Fit(reading, poses, pose_misfit(poses[image_index[known]], recon_from_camera[known])))
        best = min(best, fits[-1].misfit.mm)
    return sorted(fits, key=lambda fit: fit.misfit.mm)


def _differ(one: _Fit, other: _Fit) -> bool:
    """Test whether the poses of two readings differ by more than the misfit of the first, at any image."""
    both = np.isfinite(one.poses).all((1, 2)) & np.isfinite(other.poses).all((1, 2))
    a, b = one.poses[both], other.poses[both]
    turned = np.asarray(rotation_angle(np.swapaxes(a[:, :3, :3], 1, 2) @ b[:, :3, :3]))
    apart = 1e3 * np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1) + MM_PER_DEG * np.degrees(turned)
    return bool(apart.max(initial=0.0) > max(one.misfit.mm, LEAST_MISFIT))


def _poses_of_camera(capture: Capture, best: _Fit) -> InputError:
    """Return the error that only poses of the camera itself fit, as a board's poses do when they are inverted."""
    return InputError(
        f"{capture.source}: as {text_of(best.reading)} the poses are those of the camera itself ({_size(best.misfit)}, "
        "camera and gripper frame within 10 mm and 2°): probably a board's pose that the camera measured, or its inverse"
        ", and not the robot's; give the gripper's poses in the robot's base"
    )


def _refuse_order(
    capture: Capture, best: _Fit, recon_from_camera: Poses, image_index: Int[ndarray, " m"]
) -> None:
    """Raise InputError if the poses of a reading fit in another order, three times better than in the given one."""
    size, moved = max(best.misfit.mm, LEAST_MISFIT), list[tuple[Reading, Poses]]()
    for how, order in other_orders(capture.images):
        for reading, poses in capture.candidates:
            of_order = np.where((order >= 0)[:, None, None], poses[order], np.nan)
            moved.append((replace(reading, next_best=how), of_order))
    ranked = _ranked(moved, recon_from_camera, image_index, size / BETTER, FITTED)
    tried = [fit for fit in ranked if not fit.is_of_camera]
    if tried and tried[0].misfit.is_of_robot and tried[0].misfit.mm * BETTER < size:
        found = tried[0]
        raise InputError(
            f"{capture.source}: the poses fit the images ({_size(found.misfit)}, {text_of(found.reading)}) when they "
            f"are {found.reading.next_best}; correct the order in the file, or add a column with the images' names"
        )


def _rows_of_images(
    capture: Capture, recon_from_camera: Poses, image_index: Int[ndarray, " m"]
) -> InputError:
    """Return the error that rows and images differ in number, with those that the camera poses leave over."""
    rows, images = len(capture.candidates[0][1]), len(capture)
    more, fewer = max(rows, images), min(rows, images)
    cameras, tried = pair_angles(recon_from_camera), list[tuple[float, int, tuple[int, ...]]]()
    count = comb(more, more - fewer)
    for k, (_, poses) in enumerate(capture.candidates):
        angles = pair_angles(np.nan_to_num(poses))
        choices = combinations(range(more), more - fewer)
        every = islice(choices, MOST_CHOICES)
        if count > MOST_CHOICES:  # only the first and the last places are dropped
            every = ((*range(k), *range(fewer + k, more)) for k in range(more - fewer + 1))
        for dropped in every:
            row, at = _places(rows, images, dropped, image_index)
            if len(at) > 3:
                tried.append((angle_gap(angles[np.ix_(row, row)], cameras[np.ix_(at, at)]), k, dropped))
    fits = []
    for _, k, dropped in sorted(tried)[:40]:
        row, at = _places(rows, images, dropped, image_index)
        poses = capture.candidates[k][1][row]
        if np.isfinite(poses).all():
            misfit = pose_misfit(poses, recon_from_camera[at], share=1.0)
            fits.append((misfit, capture.candidates[k][0], dropped, poses))
    fits.sort(key=lambda one: one[0].mm)
    plain = str(count_differs(capture))
    if not fits or not fits[0][0].is_of_robot:
        return InputError(f"{plain}; in no choice of them the poses fit the images")
    misfit, reading, dropped, chosen = fits[0]
    near = [one for one in fits[1:] if one[0].mm < BETTER * max(misfit.mm, LEAST_MISFIT)]
    # Rows of an arm that did not move are equal, and it does not matter which of them is removed.
    if any(len(one[3]) != len(chosen) or np.abs(one[3] - chosen).max() > SAME_ROW for one in near):
        return InputError(f"{plain}; the images do not show which are too much")
    if rows < images:
        names = first_few([capture.images[k] for k in dropped])
        return InputError(f"{plain}; by the images ({_size(misfit)}), {names} have no pose: remove them")
    numbers = ", ".join(str(k + 1) for k in dropped)
    lag = _lag(capture, dropped)
    remedy, source = "remove it from the file", capture.source
    if source is not None and source.suffix == ".npy":
        left = f"numpy.delete(numpy.load({source.name!r}), {[*dropped]}, 0)"
        remedy = f"remove it with numpy.save({source.name!r}, {left})"
    return InputError(
        f"{plain}; by the images ({_size(misfit)}, {text_of(reading)}), row {numbers} (counted from 1) has no "
        f"image{lag}: {remedy}"
    )


def _places(
    rows: int, images: int, dropped: tuple[int, ...], image_index: Int[ndarray, " m"]
) -> tuple[list[int], list[int]]:
    """Return the rows, and the camera poses that belong to them, if the rows or images `dropped` have no partner."""
    left = [k for k in range(max(rows, images)) if k not in dropped]
    if rows > images:
        return [left[image] for image in image_index.tolist()], list(range(len(image_index)))
    at = {image: k for k, image in enumerate(image_index.tolist())}
    pairs = [(row, at[image]) for row, image in enumerate(left) if image in at]
    return [row for row, _ in pairs], [k for _, k in pairs]


def _lag(capture: Capture, dropped: tuple[int, ...]) -> str:
    """Return words that poses and images are shifted, if the images' names count from another number than 1."""
    first = "".join(c for c in Path(capture.images[0]).stem if c.isdecimal())
    shift = int(first) - 1 - (0 if 0 not in dropped else len(dropped)) if first else 0
    if shift and abs(shift) <= LARGEST_SHIFT:
        by = "one" if abs(shift) == 1 else abs(shift)
        return f" (image {first} has the pose of row {int(first) - shift}: the poses are {by} behind)"
    return ""


def _size(misfit: Misfit) -> str:
    """Return a misfit in words, such as "0.4 mm and 0.03° per axis"."""
    if not np.isfinite(misfit.mm):
        return "no fit"
    return f"{significant(1e3 * misfit.metres)} mm and {significant(float(np.degrees(misfit.radians)))}°"
