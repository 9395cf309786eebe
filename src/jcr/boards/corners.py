"""Addition of the corners of boards or tags to the tracks of a reconstruction made from features.

A body is a board or a single tag. The cameras are known up to one similarity, so that corners are triangulated like
other points. The bundle adjustment takes the board's shape and size as a prior (estimation/boards.py). If a body moved
between images, the position that most images agree on is used.
"""

from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.boards.detection import FEWEST_POINTS, boards, most_seen
from jcr.boards.proposal import board_in_view
from jcr.camera import project, unproject
from jcr.capture.images import read_image
from jcr.geometry import apply, inverse, nearest_to_lines
from jcr.progress import Progress, silent
from jcr.records import Boards, Body, Capture, Intrinsics, Reconstruction, Tracks

FEWEST_IMAGES = 2
"""Least number of images that must show a body; each of its corners needs as many to be triangulated."""
SAME_PLACE = 0.006
"""Largest rms distance of detected corners from the projected triangulated ones, as a share of the image's width."""
MOST_PAIRS = 100
"""Largest number of image pairs from which a body is triangulated in the search for the images that agree."""


def with_boards(
    capture: Capture, reconstruction: Reconstruction, spec: str, progress: Progress = silent
) -> Reconstruction:
    """Add the corners of the board or tags that `spec` (the value of --board) names to the tracks of a reconstruction.

    Corners are detected in the registered images and triangulated in the recon frame. `progress` is called with stage
    and finished fraction; None: no display. Without any detected corner, the tracks only record that no board was
    found. Raises InputError for a name that means no board.
    """
    readings = boards(spec)
    progress("board", 0.0)
    images = [read_image(capture.folder / capture.images[row]) for row in reconstruction.image_index]
    board, sightings = most_seen(readings, images)
    progress("board", 1.0)
    bodies, elsewhere = [], set[int]()
    tracks, cameras = reconstruction.tracks, reconstruction.recon_from_camera
    for number in sorted({s.body for shown in sightings for s in shown}):
        own = [(k, s) for k, shown in enumerate(sightings) for s in shown if s.body == number]
        x_in_body = {i: x for _, s in own for i, x in zip(s.index, s.x_in_body, strict=True)}
        corner = {i: c for c, i in enumerate(sorted(x_in_body))}
        x_px = np.full((len(images), len(corner), 2), np.nan)
        for k, s in own:
            x_px[k, [corner[i] for i in s.index]] = s.x_px
        shown = np.flatnonzero(np.isfinite(x_px[..., 0]).sum(1) >= FEWEST_POINTS)
        agreeing = _at_one_place(x_px, shown, cameras, reconstruction.intrinsics)
        elsewhere |= set(shown.tolist()) - set(agreeing.tolist())
        if len(agreeing) >= FEWEST_IMAGES:
            tracks, kept, point = _with_corners(tracks, x_px, agreeing, cameras, reconstruction.intrinsics)
            bodies.append(Body(number, point, np.stack([x_in_body[i] for i in corner])[kept]))
    found = Boards(
        spec=spec if board is readings[0] else board.name,
        side=board.side,
        size_std=board.size_std,
        bodies=tuple(bodies),
        elsewhere=tuple(sorted(elsewhere)),
        proposed=None if bodies else board_in_view(images),
    )
    notes = reconstruction.notes
    if board is not readings[0]:
        notes = (*notes, f"the board is read as {board.name}")
    return replace(reconstruction, tracks=replace(tracks, boards=found), notes=notes)


def _at_one_place(
    x_px: Float[ndarray, "m c 2"],
    images: Int[ndarray, " i"],
    cameras: Float[ndarray, "m 4 4"],
    intrinsics: Intrinsics,
) -> Int[ndarray, " a"]:
    """Return the indices of the largest set of `images` that see the board at one position; empty if no two agree.

    `x_px` are the pixels of the c corners in the m registered images, NaN where not detected; `cameras` are
    recon_from_camera. `images` are the indices of those that show the board. Images agree if their rms distance from
    the projected triangulated corners is below SAME_PLACE image widths.
    """
    best, limit_px = np.zeros(0, int), SAME_PLACE * intrinsics.width

    def agreeing(by: Int[ndarray, " b"]) -> Int[ndarray, " a"]:
        """Return the rows of images whose corners agree with the position triangulated from the images `by`."""
        points, rows = _triangulated(x_px[by], cameras[by], intrinsics), list[int]()
        for k in images.tolist():
            x_in_camera = apply(inverse(cameras[k]), points)
            off = ((project(intrinsics, x_in_camera) - x_px[k]) ** 2).sum(1)
            shared = np.isfinite(off)
            ahead = (x_in_camera[shared, 2] > 0).all()
            if shared.sum() >= FEWEST_POINTS and ahead and off[shared].mean() < limit_px**2:
                rows.append(k)
        return np.array(rows, dtype=int)

    pairs = np.array(list(combinations(images.tolist(), 2)), int).reshape(-1, 2)
    if len(pairs) > MOST_PAIRS:
        pairs = pairs[np.random.default_rng(0).permutation(len(pairs))[:MOST_PAIRS]]
    for pair in pairs:
        best = max(best, agreeing(pair), key=len)
        if len(best) == len(images):
            return best
    return agreeing(best) if len(best) else best


def _triangulated(
    x_px: Float[ndarray, "b c 2"], cameras: Float[ndarray, "b 4 4"], intrinsics: Intrinsics
) -> Float[ndarray, "c 3"]:
    """Return the c corners in the recon frame, triangulated from b images; NaN for one in fewer than FEWEST_IMAGES.

    `x_px` are pixels of the distorted images, NaN where a corner was not detected; `cameras` are recon_from_camera.
    """
    points = np.full((x_px.shape[1], 3), np.nan)
    shown = np.isfinite(x_px[..., 0])
    for c in np.flatnonzero(shown.sum(0) >= FEWEST_IMAGES):
        own = shown[:, c]
        ray = np.einsum("bij,bj->bi", cameras[own, :3, :3], unproject(intrinsics, x_px[own, c]))
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        points[c] = nearest_to_lines(cameras[own, :3, 3], ray)
    return points


def _with_corners(
    tracks: Tracks,
    x_px: Float[ndarray, "m c 2"],
    images: Int[ndarray, " a"],
    cameras: Float[ndarray, "m 4 4"],
    intrinsics: Intrinsics,
) -> tuple[Tracks, Int[ndarray, " k"], Int[ndarray, " k"]]:
    """Return the tracks with a board's corners in some images added, the k corners added, and their indices in them.

    `x_px` are the pixels of the c corners in the m registered images, NaN where not detected. `images` are the indices
    of the images whose corners are added; `cameras` are recon_from_camera of all m.
    """
    points = _triangulated(x_px[images], cameras[images], intrinsics)
    shown = np.isfinite(x_px[images, :, 0]) & np.isfinite(points[:, 0])
    kept = np.flatnonzero(shown.any(0))
    row = np.zeros(len(points), int)
    row[kept] = len(tracks.points_in_recon) + np.arange(len(kept))
    image, corner = np.nonzero(shown)
    std = tracks.std_px
    if std is not None:
        std = np.concatenate([std, np.full(len(image), np.median(std))])
    longer = replace(
        tracks,
        image=np.concatenate([tracks.image, images[image]]),
        x_px=np.concatenate([tracks.x_px, x_px[images[image], corner]]),
        point=np.concatenate([tracks.point, row[corner]]),
        points_in_recon=np.vstack(
            [tracks.points_in_recon, points[kept].astype(tracks.points_in_recon.dtype)]
        ),
        std_px=std,
    )
    return longer, kept, row[kept]
