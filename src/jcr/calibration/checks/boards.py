"""Check of boards and tags beside features: images that show them, size and bend."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.case import Case, CheckResult
from jcr.estimation.solve import Solution, size_of_boards
from jcr.findings import Finding, FindingKind
from jcr.geometry import apply
from jcr.records import BoardFound, Boards


def check_boards(case: Case) -> CheckResult:
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
        return CheckResult(tuple(findings))
    found = board_found(case.adjusted, boards)
    if boards.size_std is None and hand_eye.before is not None:
        side = 1e-3 * found.side_mm, 1e-3 * found.side_std_mm
        findings.append(
            Finding.of(FindingKind.BOARD_SIDE, "informs", value=side[0], std=side[1], board=boards.spec)
        )
    return CheckResult(tuple(findings), replace(hand_eye, board=found))


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
