"""Reference transforms of real captures: least squares of the corners of a printed board, apart from the estimator.

OpenCV detects the corners. Unknown are X, the board in the base frame, its size and quadratic shape, an error of each
reported gripper pose, fx, fy, cx, cy and five coefficients of distortion. The variances of pixels and of pose errors
follow by expectation maximisation (Dempster, Laird and Rubin 1977), so that σ of a transform includes both. A
transform belongs to the intrinsics that were found with it: `placed` compares pairs of both.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.optimize import least_squares

from jcr.boards.detection import boards, most_seen
from jcr.camera import parameters, project, unproject, with_parameters
from jcr.capture.images import read_image
from jcr.errors import RejectedError
from jcr.geometry import apply, inverse, retract, rotation_exp, transform
from jcr.records import Capture, Intrinsics

FEWEST_IMAGES, FEWEST_CORNERS = 3, 4
"""Fewest images of a corner and corners of an image."""
LENGTHS_M = {"SIDE": "0.1", "MARKER": "0.07"}
"""Lengths of a board whose size nobody states; its size is estimated in any case."""
ROUNDS = 12
"""Rounds of expectation maximisation; σ changes by less than a percent in the last."""
OUTLIER = 4.0
"""Standard deviations beyond which a corner is left out once: a detector took another thing for it."""
PRIOR = np.array([0.3, 0.3, 0.05, 0.05, 0.5, 0.5, 0.01, 0.01, 0.5])
"""Standard deviations of an ordinary camera about its nominal intrinsics: fx and fy relative to fx, cx and cy relative
to the width, k1, k2, p1, p2, k3. They keep apart what frontal views of a small board do not."""
SHEET_M = 0.003
"""Standard deviation of the height of a sheet's edge over its middle, m."""
SHARES = np.array([0.1, 0.5, 0.9])
"""Shares of width and height at which points are placed."""


@dataclass(frozen=True)
class Corners:
    """Observations of the corners of one board, an element each."""

    image: Int[ndarray, " k"]
    corner: Int[ndarray, " k"]
    x_px: Float[ndarray, "k 2"]
    x_in_board: Float[ndarray, "c 3"]
    """Metres as stated, z = 0."""

    def of(self, chosen: Bool[ndarray, " k"]) -> "Corners":
        """Return some of the observations, of corners and images that have enough of each other."""
        kept = replace(self, image=self.image[chosen], corner=self.corner[chosen], x_px=self.x_px[chosen])
        images, shown = np.unique(kept.image, return_counts=True)
        own, seen = np.unique(kept.corner, return_counts=True)
        good = np.isin(kept.image, images[shown >= FEWEST_CORNERS])
        good &= np.isin(kept.corner, own[seen >= FEWEST_IMAGES])
        if not good.all():
            return kept.of(good)
        return replace(kept, corner=np.searchsorted(own, kept.corner), x_in_board=self.x_in_board[own])


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Transform and intrinsics of a capture by the board in its images."""

    gripper_from_camera: Float[ndarray, "4 4"]
    intrinsics: Intrinsics
    covariance: Float[ndarray, "15 15"]
    """Covariance of translation (m) and rotation (rad) of X in camera axes, then of the intrinsics."""
    images: int
    corners: int
    size: float
    """Size of the board over the stated one."""
    noise: Float[ndarray, "2"]
    """Standard deviations of the reported gripper poses, m and rad per axis."""
    rms_px: float


def find_corners(capture: Capture, board: str, rows: Sequence[int] | None = None) -> Corners:
    """Return the corners of the body of a board that is seen most often in the images of a capture, or in some."""
    for word, length in LENGTHS_M.items():
        board = board.replace(word, length)
    chosen = range(len(capture)) if rows is None else rows
    images = [read_image(capture.folder / capture.images[row]) for row in chosen]
    sightings = most_seen(boards(board), images)[1]
    bodies = [s.body for shown in sightings for s in shown]
    body = max(sorted(set(bodies)), key=bodies.count, default=0)
    seen = [(k, s) for k, shown in enumerate(sightings) for s in shown if s.body == body]
    x_in_board = {index: x for _, s in seen for index, x in zip(s.index, s.x_in_body, strict=True)}
    place = {index: c for c, index in enumerate(sorted(x_in_board))}
    corners = Corners(
        np.array([k for k, s in seen for _ in s.index], dtype=int),
        np.array([place[index] for _, s in seen for index in s.index], dtype=int),
        np.concatenate([s.x_px for _, s in seen] or [np.zeros((0, 2))]),
        np.reshape([x_in_board[index] for index in place], (-1, 3)),
    )
    return corners.of(np.ones(len(corners.image), bool))


def nine_pixels(camera: Intrinsics) -> Float[ndarray, "9 2"]:
    """Return pixels over the image, the centre in the middle."""
    return np.stack(np.meshgrid(SHARES * camera.width, SHARES * camera.height), -1).reshape(-1, 2)


def placed(
    x: Float[ndarray, "4 4"], camera: Intrinsics, x_px: Float[ndarray, "k 2"], distance_m: float
) -> Float[ndarray, "k 3"]:
    """Return where on the gripper a transform and its intrinsics place points seen at pixels at a distance."""
    ray = unproject(camera, x_px)
    return apply(x, distance_m * ray / np.linalg.norm(ray, axis=-1, keepdims=True))


def placed_covariance(
    found: Reference, x_px: Float[ndarray, "k 2"], distance_m: float
) -> Float[ndarray, "k 3 3"]:
    """Return the covariance (m²) of `placed` points of a reference."""
    here = placed(found.gripper_from_camera, found.intrinsics, x_px, distance_m)
    columns = []
    for step in np.diag(1e-3 * np.sqrt(np.diag(found.covariance))):
        camera = with_parameters(found.intrinsics, parameters(found.intrinsics) + step[6:])
        there = placed(retract(found.gripper_from_camera, step[:6]), camera, x_px, distance_m)
        columns.append((there - here) / step.sum())
    by = np.stack(columns, axis=-1)
    return by @ found.covariance @ np.swapaxes(by, -1, -2)


def reference(
    base_from_gripper: Float[ndarray, "n 4 4"],
    corners: Corners,
    size: tuple[int, int],
    intrinsics: Intrinsics | None = None,
) -> Reference:
    """Estimate X and intrinsics from the corners of a board; `intrinsics` are where the search begins.

    Raises RejectedError where fewer than FEWEST_IMAGES images show the board.
    """
    if len(used := np.unique(corners.image)) < FEWEST_IMAGES:
        raise RejectedError("too few images share the corners of a board", "name it with --boards")
    gripper = base_from_gripper[used]
    begin_x, begin_board, begin_camera = _begin(gripper, corners, size, intrinsics)
    corners = replace(corners, image=np.searchsorted(used, corners.image))
    middle = corners.x_in_board.mean(0)
    about = corners.x_in_board - middle
    across = about[:, :2] / max(float(np.abs(about[:, :2]).max()), 1e-9)
    shape = np.column_stack([across[:, 0] ** 2, across[:, 0] * across[:, 1], across[:, 1] ** 2])
    unit = PRIOR * np.r_[[begin_camera.fx] * 2, [begin_camera.width] * 2, np.ones(5)]
    std_px, noise = 1.0, np.array([2e-3, 5e-3])
    # X (6), base_from_board (6), intrinsics (9, in units of PRIOR), log size and shape of the board (4), and the error
    # of each used gripper pose (6 each, in units of the noise). All steps are from where the search began.
    values = np.zeros(25 + 6 * len(used))

    def camera_of(values: Float[ndarray, " v"]) -> Intrinsics:
        return with_parameters(begin_camera, parameters(begin_camera) + unit * values[12:21])

    def off_px(values: Float[ndarray, " v"]) -> Float[ndarray, "k 2"]:
        """Return seen minus projected pixels."""
        poses = retract(gripper, values[25:].reshape(-1, 6) * np.repeat(noise, 3))
        in_board = np.exp(values[21]) * about
        in_board[:, 2] += SHEET_M * shape @ values[22:25]
        in_base = apply(retract(begin_board, values[6:12]), in_board + middle)
        camera_from_base = inverse(poses @ retract(begin_x, values[:6]))[corners.image]
        at = np.einsum("kij,kj->ki", camera_from_base[:, :3, :3], in_base[corners.corner])
        return corners.x_px - project(camera_of(values), at + camera_from_base[:, :3, 3])

    def residuals(values: Float[ndarray, " v"]) -> Float[ndarray, " r"]:
        """Return all residuals in standard deviations; the size of the board is free."""
        return np.r_[(off_px(values) / std_px).ravel(), values[12:21], values[22:]]

    def derivatives() -> tuple[Float[ndarray, "r v"], Float[ndarray, "v v"]]:
        """Return the Jacobian by central differences, and the covariance of the values."""
        steps = 1e-5 * np.eye(len(values))
        jacobian = np.stack([(residuals(values + d) - residuals(values - d)) / 2e-5 for d in steps], axis=1)
        return jacobian, np.linalg.inv(jacobian.T @ jacobian)

    for k in range(ROUNDS):
        values = least_squares(residuals, values, method="lm", max_nfev=40 * len(values)).x
        jacobian, covariance = derivatives()
        # The variances that explain pixels and gripper poses best.
        count = 2 * len(corners.image)
        spread = np.einsum("ij,jk,ik->i", jacobian[:count], covariance, jacobian[:count]).sum()
        pixel_std = std_px * np.sqrt((np.sum(residuals(values)[:count] ** 2) + spread) / count)
        squared = (values[25:] ** 2 + np.diag(covariance)[25:]).reshape(-1, 2, 3).mean((0, 2))
        std_px, noise = float(pixel_std), noise * np.sqrt(squared)
        values[25:] /= np.tile(np.repeat(np.sqrt(squared), 3), len(gripper))
        if k == 1:
            off = np.linalg.norm(off_px(values), axis=1)
            good = off < OUTLIER * max(np.sqrt(2) * std_px, 1.5 * float(np.median(off)))
            corners = replace(
                corners, image=corners.image[good], corner=corners.corner[good], x_px=corners.x_px[good]
            )
    chosen = np.r_[0:6, 12:21]
    return Reference(
        gripper_from_camera=retract(begin_x, values[:6]),
        intrinsics=camera_of(values),
        covariance=derivatives()[1][np.ix_(chosen, chosen)] * np.outer(*[np.r_[np.ones(6), unit]] * 2),
        images=len(np.unique(corners.image)),
        corners=len(corners.x_in_board),
        size=float(np.exp(values[21])),
        noise=noise,
        rms_px=float(np.sqrt((off_px(values) ** 2).sum(1).mean())),
    )


def _begin(
    gripper: Float[ndarray, "m 4 4"], corners: Corners, size: tuple[int, int], intrinsics: Intrinsics | None
) -> tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"], Intrinsics]:
    """Return X, base_from_board and intrinsics by OpenCV's calibration and the hand-eye method of Park and Martin."""
    rows = [corners.image == k for k in np.unique(corners.image)]
    middle = (size[0] - 1) / 2, (size[1] - 1) / 2
    camera = intrinsics or Intrinsics(1.0 * size[0], 1.0 * size[0], *middle, *size)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_PRINCIPAL_POINT
    flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    _, matrix, _, rotations, translations = cv2.calibrateCamera(
        [corners.x_in_board[corners.corner[own]].astype(np.float32) for own in rows],
        [corners.x_px[own].astype(np.float32)[:, None] for own in rows],
        size, camera.matrix.copy(), np.zeros(5), flags=flags,
    )  # fmt: skip
    board = np.stack(
        [transform(rotation_exp(r[:, 0]), t[:, 0]) for r, t in zip(rotations, translations, strict=True)]
    )
    rotation, translation = cv2.calibrateHandEye(
        list(gripper[:, :3, :3]), list(gripper[:, :3, 3]), list(board[:, :3, :3]), list(board[:, :3, 3]),
        method=cv2.CALIB_HAND_EYE_PARK,
    )  # fmt: skip
    x = transform(rotation, translation[:, 0])
    places = gripper @ x @ board
    nearest = int(np.linalg.norm(places[:, :3, 3] - np.median(places[:, :3, 3], 0), axis=1).argmin())
    camera = Intrinsics(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *size)
    return x, places[nearest], camera
