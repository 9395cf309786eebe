"""Checks of boards: not found, moved between images, printed at a wrong size; size estimated by the robot."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.case import Case
from jcr.estimation.boards import FEWEST_CORNERS, STRETCH_STD
from jcr.estimation.solve import Solution, size_of_boards
from jcr.findings import Finding, FindingKind
from jcr.geometry import apply
from jcr.records import BoardFound, Boards

STRETCHED = 4.0
"""Estimated stretch of a board, in standard deviations of a printer's stretch, from which its size counts as wrong."""
MOVED = 4.0
"""Ratio of the mean shift of a board's corners in an image to their scatter, from which the board counts as moved."""


def check_boards(case: Case) -> Case:
    """Return the case with findings on boards: not found, moved, stretched in print, or of a size that was estimated."""
    boards = case.reconstruction.tracks.boards
    if boards is None:
        return case
    findings = list[Finding]()
    if not boards.bodies and not boards.elsewhere:
        names = {"board": boards.spec} | ({"proposed": boards.proposed} if boards.proposed else {})
        findings.append(Finding.of(FindingKind.BOARD_NOT_FOUND, "warns", "reconstruction", **names))
    if boards.elsewhere:
        elsewhere = [case.names[row] for row in boards.elsewhere]
        findings.append(Finding.of(FindingKind.BOARD_MOVED, "warns", "images", *elsewhere, board=boards.spec))
    hand_eye = case.hand_eye
    if case.adjusted is None or case.adjusted.problem.boards is None:
        return case.after(tuple(findings))
    findings += board_faults(case)
    found = board_found(case.adjusted, boards)
    if boards.size_std is None and hand_eye.source == "images":
        side = {"value": 1e-3 * found.side_mm, "std": 1e-3 * found.side_std_mm}
        findings.append(Finding.of(FindingKind.BOARD_SIDE, "informs", "none", **side, board=boards.spec))
    return case.after(tuple(findings), replace(hand_eye, board=found))


def board_faults(case: Case) -> list[Finding]:
    """Return a finding if the adjusted boards are faulty (stretched in print, or moved); else an empty list.

    A board is stretched if its two sides have different scales. It was moved if the residuals of its corners in one
    image have a mean much larger than their scatter. The size of a faulty board must not set the scale.
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
    """Return the record of the adjusted boards: size, residuals, flatness, and positions in the base frame."""
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
    """Return a point as a tuple of three numbers."""
    return float(x[0]), float(x[1]), float(x[2])
