"""Localisation of images of further fixed cameras by the board that the gripper carries.

All cameras that watch the gripper see the same board, whose corners are points of the capture's own reconstruction. The
joint adjustment therefore has one board, one pose of it in the gripper, and one error of each reported gripper pose.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import block_diag

from jcr.boards.detection import FEWEST_POINTS, Sighting, boards, most_seen
from jcr.boards.marker import GATE_PX, intrinsics_by_board
from jcr.camera import usable_intrinsics
from jcr.capture.images import read_image
from jcr.errors import RejectedError
from jcr.estimation.absolute_pose import CameraPose, absolute_pose
from jcr.geometry import fit_similarity
from jcr.records import Boards, CellCamera, Intrinsics
from jcr.sfm.register import Registration


def located_by_board(
    shown: Boards, points: Float[ndarray, "p 3"], camera: CellCamera
) -> list[tuple[Registration | None, int]]:
    """Return for each image of a camera its registration by a board, and the number of the board's corners in it.

    `shown` is the board in the capture's reconstruction, whose `points` are in metres in the recon frame. The
    registration is None where the board is not seen well enough. Unknown intrinsics are calibrated from the board; if
    too few images show it, no image is registered.
    """
    readings = boards(shown.spec.split(" ")[0])
    readings = [one for one in readings if one.name == shown.spec] or readings
    assert camera.folder is not None
    board, seen = most_seen(readings, [read_image(camera.folder / name) for name in camera.images])
    seen = [[s for s in sightings if len(s.index) >= FEWEST_POINTS] for sightings in seen]
    counts = [sum(len(s.index) for s in sightings) for sightings in seen]
    try:
        given = usable_intrinsics(camera.intrinsics)[0]
        intrinsics = intrinsics_by_board(given, camera.image_size, board, seen)[0]
    except RejectedError:
        return [(None, count) for count in counts]
    return [
        (_registration(shown, points, sightings, intrinsics), count)
        for sightings, count in zip(seen, counts, strict=True)
    ]


def _registration(
    shown: Boards, points: Float[ndarray, "p 3"], sightings: Sequence[Sighting], camera: Intrinsics
) -> Registration | None:
    """Return the registration of an image by the board or tag with most corners in it; None without a clear pose.

    `shown` is the board in the reconstruction and `points` are its points (m, recon frame); `sightings` are the image's
    detections, and `camera` its intrinsics. All corners that the reconstruction knows are part of the registration.
    """
    row_of = {
        (b.number, *np.round(x, 9)): row
        for b in shown.bodies
        for x, row in zip(b.x_in_body, b.point, strict=True)
    }
    found = [
        (s, [row_of.get((s.body, *np.round(x, 9)), -1) for x in s.x_in_body])
        for s in sightings
        if any(b.number == s.body for b in shown.bodies)
    ]
    if not found:
        return None
    largest = max(found, key=lambda one: len(one[1]))[0]
    pose = absolute_pose(largest.x_px, largest.x_in_body, camera, gate_px=GATE_PX, planar=True)
    if pose is None or pose.rival is not None:
        return None
    body = next(b for b in shown.bodies if b.number == largest.body)
    recon_from_body = fit_similarity(points[body.point], body.x_in_body)[0]
    turn = block_diag(recon_from_body[:3, :3], recon_from_body[:3, :3])
    row = np.concatenate([rows for _, rows in found])
    x_px = np.concatenate([s.x_px for s, _ in found])[row >= 0]
    return Registration(
        pose=CameraPose(
            **vars(pose)
            | {
                "a_from_camera": recon_from_body @ pose.a_from_camera,
                "covariance": turn @ pose.covariance @ turn.T,
            }
        ),
        points_in_recon=points[row[row >= 0]],
        x_px=x_px,
        row=np.zeros(0, int),
        row_x_px=np.zeros((0, 2)),
        row_point=np.zeros(0, int),
        point=row[row >= 0],
    )
