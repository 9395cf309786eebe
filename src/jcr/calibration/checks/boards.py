"""Checks of boards: not found, moved between images, stretched or bent; size estimated by the robot."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.bundle_adjustment import solved
from jcr.calibration.case import Case
from jcr.distributions import f as f_distribution
from jcr.estimation.boards import FEWEST_CORNERS, STRETCH_STD, STRETCHED_STD
from jcr.estimation.projection import by_points
from jcr.estimation.solve import Solution, size_of_boards
from jcr.findings import Finding, FindingKind
from jcr.geometry import skew

LIKELY, STRETCHED = 2.0, 4.0
"""Stretch of a board, in standard deviations of a printer's stretch, from which it is estimated without a prior; and the
estimate, in its standard deviations together with the printer's, from which the board counts as stretched (p = 6e-5)."""
LOG_P_MOVED = float(np.log(1e-6))
"""Logarithm of the p-value up to which a board counts as moved."""
LEAST_MOVED_PX = 0.3
"""Smallest shift of a board's corners (px) that counts as a motion; smaller ones hardly change a calibration."""
MOST_MOTIONS = 3
"""Largest number of motions of boards that are tested in turn."""
BENT_M = 2e-3
"""Height of a board's highest corner over its lowest one (m) from which it is reported as bent; ten real boards of 100
to 250 mm have up to 3.6 mm."""


def check_boards(case: Case) -> Case:
    """Return the case with findings on boards: not found, moved, stretched, bent, or of a size that was estimated.

    A case without the option --board is unchanged.
    """
    boards = case.model.tracks.boards
    if boards is None:
        return case
    findings = list[Finding]()
    if not boards.bodies and not boards.elsewhere:
        names = {"board": boards.spec} | ({"proposed": boards.proposed} if boards.proposed else {})
        findings.append(Finding.of(FindingKind.BOARD_NOT_FOUND, "warns", "reconstruction", **names))
    if boards.elsewhere:
        elsewhere = [case.names[row] for row in boards.elsewhere]
        findings.append(Finding.of(FindingKind.BOARD_MOVED, "warns", "images", *elsewhere, board=boards.spec))
    if case.solution is None or case.solution.problem.boards is None:
        return case.found(*findings)
    adjusted, shapes = case.solution, case.solution.problem.boards
    if boards.is_stretched:
        stretch, std = stretch_of(adjusted)
        size = {"value": abs(stretch), "std": std, "board": boards.spec}
        findings.append(Finding.of(FindingKind.BOARD_STRETCHED, "warns", "none", **size))
    shape = adjusted.state.camera_steps[adjusted.problem.columns.boards]
    height = adjusted.state.scale * np.exp(shape[0]) * (shapes.by_shape[:, 2] @ shape)
    bend = max(float(np.ptp(height[shapes.body == k])) for k in np.unique(shapes.body))
    if bend > BENT_M:
        findings.append(Finding.of(FindingKind.BOARD_BENT, "informs", "none", value=bend, board=boards.spec))
    if boards.size_std is None and case.numbers.source == "images":
        size, by_unknown = size_of_boards(adjusted)
        side = boards.side * float(np.exp(size))
        std = side * float(np.sqrt(by_unknown @ adjusted.covariance @ by_unknown))
        sides = {"value": side, "std": std, "board": boards.spec}
        findings.append(Finding.of(FindingKind.BOARD_SIDE, "informs", "none", **sides))
    return case.found(*findings)


def check_board_shapes(case: Case) -> Case:
    """Return the case without the corners of boards that moved, and without the prior on the shape of stretched ones.

    A board moved if its position in the scene differs between images (`images_of_motion`). Its corners are left out in
    the smaller group of images, which `Boards.elsewhere` then lists. A board is stretched if its print has different
    scales along its two sides. The images are then adjusted again. `check_boards` reports both errors.
    """
    for _ in range(MOST_MOTIONS):
        tracks, adjusted = case.model.tracks, case.solution
        if adjusted is None or adjusted.problem.boards is None or tracks.boards is None:
            return case
        away = case.used[images_of_motion(adjusted)]
        if not len(away):
            break
        rest = tracks.only(~(tracks.on_board[tracks.point] & np.isin(tracks.image, away)))
        elsewhere = tuple(sorted({*tracks.boards.elsewhere, *away.tolist()}))
        rest = replace(rest, boards=replace(tracks.boards, elsewhere=elsewhere))
        case = solved(case, replace(case.model, tracks=rest))
    tracks, adjusted = case.model.tracks, case.solution
    if tracks.boards is None or adjusted is None or abs(stretch_of(adjusted)[0]) < LIKELY * STRETCH_STD:
        return case
    stretched = replace(tracks, boards=replace(tracks.boards, is_stretched=True))
    free = solved(case, replace(case.model, tracks=stretched))
    assert free.solution is not None
    stretch, std = stretch_of(free.solution)
    return free if abs(stretch) > STRETCHED * float(np.hypot(std, STRETCH_STD)) else case


def images_of_motion(adjusted: Solution) -> Int[ndarray, " a"]:
    """Return the indices of images in which a board is at another place than in more images; empty if none moved.

    The indices count the adjusted images. Each image gives the motion δ of a board (translation, rotation vector) that
    fits its corners best. Under the alternative hypothesis, δ differs between the images before and after one image, or
    between one image and all others. An F test compares this difference with the scatter of δ within both groups, which
    includes the errors of the camera poses. If several boards or tests are significant, only the most significant one
    counts.
    """
    observations, shapes = adjusted.problem.observations, adjusted.problem.boards
    assert observations is not None and shapes is not None
    view, state = adjusted.images.view, adjusted.images.state
    derivative, best, moved = by_points(adjusted.problem, state, view), LOG_P_MOVED, np.zeros(0, int)
    for body in np.unique(shapes.body):
        corners = np.flatnonzero(np.isin(observations.point, shapes.point[shapes.body == body]))
        rows, image, count = np.unique(observations.image[corners], return_inverse=True, return_counts=True)
        seen = np.flatnonzero(count >= FEWEST_CORNERS)
        n, information, pull = len(seen), np.zeros((len(seen), 6, 6)), np.zeros((len(seen), 6))
        if n < 3:
            continue
        about = state.points_in_world[observations.point[corners]]
        for k, one in enumerate(seen):
            mine = corners[image == one]
            arm = about[image == one] - about.mean(0)
            by = np.concatenate([derivative[mine], -derivative[mine] @ skew(arm)], axis=2).reshape(-1, 6)
            information[k], pull[k] = by.T @ by, -by.T @ view.residual_px[mine].ravel()
        groups = [np.arange(n) < k for k in range(1, n)] + [np.arange(n) == k for k in range(1, n - 1)]
        together = _misfit(information, pull)
        for first in groups:
            within = _misfit(information[first], pull[first]) + _misfit(information[~first], pull[~first])
            ratio = (together - within) / within * (n - 2)
            log_p = f_distribution.logsf(float(ratio), 6, 6 * (n - 2)) + float(np.log(len(groups)))
            fewer = first if 2 * first.sum() <= n else ~first
            # The motion between the groups; each group deviates less from the mean of all images.
            corners_of = np.array([count[seen][first].sum(), count[seen][~first].sum()])
            shift_px = np.sqrt((together - within) * (1 / corners_of).sum())
            if log_p < best and shift_px > LEAST_MOVED_PX:
                best, moved = log_p, rows[seen[fewer]]
    return moved


def _misfit(information: Float[ndarray, "n 6 6"], pull: Float[ndarray, "n 6"]) -> float:
    """Return the sum of squared deviations (px²) of n motions from their mean, both weighted by `information`.

    Each motion δ is a translation, then a rotation vector. `information` (n,6,6) is its inverse covariance A for a
    pixel noise of 1 px, `pull` (n,6) is A δ.
    """
    own = sum(float(b @ np.linalg.lstsq(a, b, rcond=1e-9)[0]) for a, b in zip(information, pull, strict=True))
    a, b = information.sum(0), pull.sum(0)
    return own - float(b @ np.linalg.lstsq(a, b, rcond=1e-9)[0])


def stretch_of(adjusted: Solution) -> tuple[float, float]:
    """Return the relative stretch of a board's x axis over its y axis, and its standard deviation (0.001: 0.1 %).

    Of several boards, the one with the largest absolute stretch counts. Both numbers are 0 if no board is adjusted, or
    if none has enough corners to estimate its stretch.
    """
    shapes, columns = adjusted.problem.boards, adjusted.problem.columns.boards
    if shapes is None or not (ways := np.isin(shapes.shape_std, (STRETCH_STD, STRETCHED_STD))).any():
        return 0.0, 0.0
    shape, own = adjusted.state.camera_steps[columns], adjusted.camera_unknowns(columns)
    k = int(np.where(ways, np.abs(shape), -1.0).argmax())
    return float(shape[k]), float(np.sqrt(adjusted.covariance[own, own][k, k]))
