"""The back end `marker`: metric camera poses from a board or tags of known size.

Poses of planar bodies come from estimation/absolute_pose.py.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.boards.detection import FEWEST_POINTS, Board, Sighting, boards, most_seen
from jcr.camera import project, usable_intrinsics
from jcr.capture.images import read_image
from jcr.errors import RejectedError
from jcr.estimation.absolute_pose import absolute_pose
from jcr.estimation.image_equations import adjust_images
from jcr.estimation.intrinsics_prior import FIXED, camera_with_prior
from jcr.estimation.problem import wrist_arm, wrist_problem
from jcr.geometry import apply, inverse
from jcr.progress import Progress, silent
from jcr.records import Boards, Body, Capture, Intrinsics, Reconstruction, Tracks

WORST_PX = 3.0
"""Largest rms reprojection error of a body's points; above it the board is bent, or another one."""
GATE_PX = 10.0
"""Largest reprojection error of a point that takes part in a pose; all points of a bent board stay below it."""
FEWEST_FOR_INTRINSICS = 4
"""Least number of images of a board that determine intrinsics."""


Pose = tuple[float, Float[ndarray, "4 4"]]
"""Pose of a body in one image: rms reprojection error (px) of its points, and camera_from_body."""


def reconstruct_marker(capture: Capture, look_for: str, progress: Progress = silent) -> Reconstruction:
    """Reconstruct cameras from a board or tags, in metres, or in sides of a square or tag if its size is unknown.

    The recon frame is that of the board or tag that most images show. `look_for` names the board in a form of
    `detection.KINDS`. `progress` is called with stage and finished fraction; None: no display. Unknown intrinsics are
    calibrated from the board. Raises InputError for a name that means no board, and RejectedError when fewer than three
    images show it (four, if intrinsics are unknown).
    """
    readings = boards(look_for)
    images = [read_image(capture.folder / name) for name in capture.images]
    progress("board", 0.0)
    board, seen = most_seen(readings, images)
    progress("board", 1.0)
    seen = [[s for s in sightings if len(s.index) >= FEWEST_POINTS] for sightings in seen]
    notes = [] if board is readings[0] else [f"the board is read as {board.name}"]
    given, warnings = usable_intrinsics(capture.intrinsics)
    intrinsics, intrinsics_notes = intrinsics_by_board(given, capture.image_size, board, seen)
    notes += intrinsics_notes
    poses = [{s.body: pose for s in sightings if (pose := pose_of_body(s, intrinsics))} for sightings in seen]
    recon_from_camera, recon_from_body = locate_cameras_and_bodies(poses)
    rows = np.array(sorted(recon_from_camera), dtype=int)
    if len(rows) < 3:
        raise RejectedError(
            f"{len(rows)} of {len(capture)} images show {look_for} well enough",
            "check its size and kind, that it lies flat and wholly in view, or use a back end that needs no marker",
        )
    if missing := [name for row, name in enumerate(capture.images) if row not in recon_from_camera]:
        notes.append(f"the board is not seen, or not sharply, in {', '.join(missing)}")
    sightings = [[s for s in seen[row] if s.body in recon_from_body and s.body in poses[row]] for row in rows]
    cameras = np.stack([recon_from_camera[row] for row in rows])
    stated = Boards(spec=board.name, side=board.side, size_std=board.size_std, bodies=())
    tracks = _tracks(sightings, recon_from_body, stated)
    if len(recon_from_body) > 1:
        # Images are adjusted alone: the arm's poses, which a problem has, are not used.
        start, camera = (np.eye(4), 1.0, np.eye(4)), camera_with_prior(intrinsics, FIXED)
        free = replace(tracks, boards=None)
        problem, state = wrist_problem(wrist_arm(cameras), start, cameras, camera, free)
        cameras = adjust_images(problem, state).world_from_rig
    return Reconstruction(
        image_index=rows,
        recon_from_camera=cameras,
        intrinsics=intrinsics,
        tracks=tracks,
        backend="marker",
        is_metric=board.size_std is not None,
        metric_std=board.size_std,
        notes=tuple(notes),
        warnings=warnings,
    )


def intrinsics_by_board(
    given: Intrinsics | None, size: tuple[int, int], board: Board, seen: Sequence[Sequence[Sighting]]
) -> tuple[Intrinsics, list[str]]:
    """Return the given intrinsics, or those calibrated from the board's detections `seen` in each image; and notes.

    `size` is the width and height of the images (px). Calibrated are the focal length, principal point and two radial
    coefficients. The notes are for the user. Raises RejectedError if fewer than FEWEST_FOR_INTRINSICS images show the
    board and no intrinsics are given.
    """
    if given is not None:
        return given, []
    shown = [s for sightings in seen for s in sightings]
    images = sum(map(bool, seen))
    if images < FEWEST_FOR_INTRINSICS:
        raise RejectedError(
            f"{images} of {len(seen)} images show {board.name}, {FEWEST_FOR_INTRINSICS} are needed to find the "
            "unknown intrinsics from it",
            "check the board's kind and size, or give the intrinsics",
        )
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO
    x_in_body = [np.asarray(s.x_in_body, np.float32) for s in shown]
    x_px = [np.asarray(s.x_px, np.float32) for s in shown]
    rms_px, matrix, distortion, _, _, std, *_ = cv2.calibrateCameraExtended(
        x_in_body, x_px, size, np.eye(3), np.zeros(5), flags=flags
    )
    fx, fy, cx, cy = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    k1, k2, *_ = distortion.ravel().tolist()
    note = f"the intrinsics come from the board: f = {fx:.1f} ± {std[0, 0]:.1f} px, {rms_px:.2f} px rms"
    return Intrinsics(fx, fy, cx, cy, *size, (k1, k2, 0.0, 0.0, 0.0)), [note]


def pose_of_body(sighting: Sighting, intrinsics: Intrinsics) -> Pose | None:
    """Return (rms reprojection error in px, camera_from_body) of a detected board or tag, or None.

    The result is None if the points are collinear, have an rms error of WORST_PX or more, or fit a second pose nearly
    as well. The translation is in the unit of `Sighting.x_in_body`.
    """
    x = sighting.x_in_body
    if np.linalg.svd(x - x.mean(0), compute_uv=False)[1] < 1e-6:
        return None
    found = absolute_pose(sighting.x_px, x, intrinsics, gate_px=GATE_PX, planar=True)
    if found is None or found.rival is not None:
        return None
    pose = inverse(found.a_from_camera)
    residual_px = project(intrinsics, apply(pose, x)) - sighting.x_px
    rms_px = float(np.sqrt((residual_px**2).sum(1).mean()))
    return (rms_px, pose) if rms_px < WORST_PX else None


def locate_cameras_and_bodies(
    poses: Sequence[dict[int, Pose]],
) -> tuple[dict[int, Float[ndarray, "4 4"]], dict[int, Float[ndarray, "4 4"]]]:
    """Return recon_from_camera by image index, and recon_from_body by number of the board or tag (body).

    The recon frame is that of the body that most images show. `poses` has for each image the pose of each body in it,
    by the body's number. Poses are chained: a camera is located by its body of smallest error, and a body by the camera
    of smallest error. Images and bodies without a chain to this frame are left out.
    """
    counts = Counter(body for bodies in poses for body in bodies)
    cameras: dict[int, Float[ndarray, "4 4"]] = {}
    placed = {max(sorted(counts), key=counts.__getitem__): np.eye(4)} if counts else {}
    while new := [k for k, bodies in enumerate(poses) if k not in cameras and bodies.keys() & placed.keys()]:
        for row in new:
            body = min(poses[row].keys() & placed.keys(), key=lambda b: poses[row][b][0])
            cameras[row] = placed[body] @ inverse(poses[row][body][1])
        for body in counts.keys() - placed.keys():
            if seers := [row for row in cameras if body in poses[row]]:
                row = min(seers, key=lambda r: poses[r][body][0])
                placed[body] = cameras[row] @ poses[row][body][1]
    return cameras, placed


def _tracks(
    sightings: Sequence[Sequence[Sighting]], recon_from_body: dict[int, Float[ndarray, "4 4"]], board: Boards
) -> Tracks:
    """Return the tracks of the corners detected in each image; their shape is a prior of the adjustment.

    `board` names the board or tags. A body that one image shows has no prior.
    """
    seen = [(row, s) for row, shown in enumerate(sightings) for s in shown]
    names = [(s.body, index) for _, s in seen for index in s.index]
    place = {name: k for k, name in enumerate(dict.fromkeys(names))}
    point = np.array([place[name] for name in names])
    x_in_body = np.concatenate([s.x_in_body for _, s in seen])[np.unique(point, return_index=True)[1]]
    body = np.array([number for number, _ in place])
    images = Counter(s.body for _, s in seen)
    corners = {number: np.flatnonzero(body == number) for number in sorted(images) if images[number] > 1}
    return Tracks(
        image=np.repeat([row for row, _ in seen], [len(s.index) for _, s in seen]),
        x_px=np.concatenate([s.x_px for _, s in seen]),
        point=point,
        points_in_recon=np.stack(
            [apply(recon_from_body[n], x) for n, x in zip(body.tolist(), x_in_body, strict=True)]
        ),
        from_board=True,
        boards=replace(board, bodies=tuple(Body(n, own, x_in_body[own]) for n, own in corners.items())),
    )
