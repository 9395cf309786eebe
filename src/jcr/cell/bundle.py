"""Bundle adjustment of a cell's images by themselves: rigid groups of cameras, one scene, one similarity left open.

A rig is what moves as one: the wrist of an arm at one instant, with all cameras on it, or a fixed camera. Whose rigs
they are is not asked here; the robots have their say in ties.py. Until then the scene has no metre and no base, and what
the images leave open is exactly one similarity.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.stats import chi2

from jcr.adjust.elimination import (
    Derivatives,
    Normal,
    Sightings,
    point_blocks,
    with_points_held,
    without_points,
)
from jcr.adjust.intrinsics_prior import IntrinsicsPrior
from jcr.camera import by_parameters, by_point, parameters, project, with_parameters
from jcr.geometry import retract, skew, step_between
from jcr.least_squares import loss_weight, one_blas_thread
from jcr.records import Intrinsics

LOSS_SCALE = 2.0
"""Cauchy loss: observations count half at this many sigma."""
CELLS = 8
"""Across the width of an image: so near each other features share errors."""
MIN_SIGMA_PX = 0.05
RATIOS = (0.25, 100.0)
"""Of the variances of other cameras' observations to that of the first's: of few points that only one other sees, a
camera seems as good as its weight makes it."""
FAR_OFF = 6.0
"""Median residuals; seven sigma."""
ENOUGH = 1e-5
"""Of the cost, which is in squared standard deviations."""
ROUNDS, STEPS = 8, 40


@dataclass(frozen=True)
class Pictures:
    """Which rig and which camera each image is of, and what is seen in them."""

    rig: Int[ndarray, " n"]
    camera: Int[ndarray, " n"]
    picture: Int[ndarray, " k"]
    """Of each observation; no point twice in one image."""
    x_px: Float[ndarray, "k 2"]
    """In the original image, distorted."""
    point: Int[ndarray, " k"]


@dataclass(frozen=True)
class Scene:
    """Where everything is; `world` has any origin and unit."""

    world_from_rig: Float[ndarray, "m 4 4"]
    rig_from_camera: Float[ndarray, "c 4 4"]
    cameras: tuple[Intrinsics, ...]
    points_in_world: Float[ndarray, "p 3"]


@dataclass(frozen=True)
class Freedom:
    """What may move beside rigs and points."""

    lenses: tuple[IntrinsicsPrior, ...]
    """One a camera, about where its parameters start."""
    mounts: Bool[ndarray, " c"]
    """Cameras whose place on the rig is sought; that of others is exact."""

    @property
    def lens_columns(self) -> list[slice]:
        """Of each camera."""
        ends = np.cumsum([0, *(len(lens.std) for lens in self.lenses)])
        return [slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]

    @property
    def lenses_end(self) -> int:
        """Column after the last of the intrinsics."""
        return sum(len(lens.std) for lens in self.lenses)

    @property
    def mount_columns(self) -> list[slice | None]:
        """Of each camera; None where it does not move."""
        begin, out = self.lenses_end, list[slice | None]()
        for free in self.mounts:
            out.append(slice(begin, begin + 6) if free else None)
            begin += 6 * int(free)
        return out

    @property
    def first_rig(self) -> int:
        """Column; six for each rig follow."""
        return self.lenses_end + 6 * int(self.mounts.sum())


@dataclass(frozen=True)
class Imaged:
    """What the images alone say, up to one similarity of the world."""

    scene: Scene
    freedom: Freedom
    covariance: Float[ndarray, "d d"]
    """Of steps: intrinsics in the directions of their priors, mounts (rig axes), rigs (world axes); nothing along the
    similarity."""
    sigma_px: Float[ndarray, " c"]
    """Of one image coordinate, by camera."""
    reprojection_px: Float[ndarray, " n"]
    """Median of each image; not a number where it took no part."""


@one_blas_thread
def adjust_images(
    scene: Scene, pictures: Pictures, freedom: Freedom, held: Float[ndarray, "r r"] | None = None
) -> Imaged:
    """Least reprojection error under a Cauchy loss over intrinsics, mounts, rigs and points, from a start that is near.

    Points that fewer than two images see are left out. `held` is information on steps of the first rigs from where
    they start, where others than these images know them; the similarity is then theirs.
    """
    seen = np.bincount(pictures.point, minlength=len(scene.points_in_world))
    order = np.lexsort((pictures.rig[pictures.picture], pictures.point))
    order = order[seen[pictures.point[order]] >= 2]
    kept, point = np.unique(pictures.point[order], return_inverse=True)
    pictures = replace(pictures, picture=pictures.picture[order], x_px=pictures.x_px[order], point=point)
    scene = replace(scene, points_in_world=scene.points_in_world[kept])
    started = [parameters(camera) for camera in scene.cameras]
    problem = _Problem(
        pictures,
        freedom,
        scene.world_from_rig,
        held,
        started,
        chi2.ppf(0.5, np.maximum(2 * np.bincount(point) - 3, 1)),
        Sightings.of(point, pictures.rig[pictures.picture], len(scene.world_from_rig)),
    )
    view = _view(scene, pictures)
    errors, damping = _pixel_errors(scene, view, problem), 1e-4
    for _ in range(ROUNDS):
        before = errors.sigma_px
        scene, view, damping = _minimised(scene, view, problem, _weights(view, errors, problem), damping)
        errors = _pixel_errors(scene, view, problem, errors)
        if np.abs(np.log(errors.sigma_px / before)).max() < 0.01:
            break
    hessian = _normal(scene, view, problem, _weights(view, errors, problem), 0.0).hessian
    length = np.linalg.norm(view.residual, axis=1)
    median_px = np.full(len(pictures.rig), np.nan)
    for k in np.unique(pictures.picture):
        median_px[k] = np.median(length[pictures.picture == k])
    covariance = _without_similarity(hessian, scene, freedom) if held is None else _inverted(hessian)
    return Imaged(scene, freedom, covariance, errors.sigma_px, median_px)


@dataclass(frozen=True)
class _Problem:
    """What stays fixed; observations sorted by point, then by rig."""

    pictures: Pictures
    freedom: Freedom
    rigs: Float[ndarray, "m 4 4"]
    """Where they start."""
    held: Float[ndarray, "r r"] | None
    started: list[Float[ndarray, " q"]]
    """Parameters of the cameras."""
    median_square: Float[ndarray, " p"]
    """Median of a point's sum of squared residuals where an image coordinate's variance is 1: of the 2n errors of n
    views its position takes up 3."""
    seen: Sightings
    """By rigs."""


@dataclass(frozen=True)
class _View:
    """Every observation's point as one scene has it."""

    from_rig: Float[ndarray, "k 3"]
    """From the rig to the point, world axes."""
    from_camera: Float[ndarray, "k 3"]
    """From the camera to the point, rig axes."""
    in_camera: Float[ndarray, "k 3"]
    residual: Float[ndarray, "k 2"]
    """Projected minus observed, px."""


@dataclass(frozen=True)
class _PixelErrors:
    """Errors of image observations."""

    sigma_px: Float[ndarray, " c"]
    """Of one coordinate, by camera."""
    inflation: float = 1.0
    """Of the variance of what many observations say together, because neighbours share errors; one for all cameras, for
    where points follow the few observations of one its own residuals do not show it."""


def _view(scene: Scene, pictures: Pictures) -> _View:
    rig, camera = pictures.rig[pictures.picture], pictures.camera[pictures.picture]
    pose, mount = scene.world_from_rig[rig], scene.rig_from_camera[camera]
    from_rig = scene.points_in_world[pictures.point] - pose[:, :3, 3]
    from_camera = np.einsum("kji,kj->ki", pose[:, :3, :3], from_rig) - mount[:, :3, 3]
    in_camera = np.einsum("kji,kj->ki", mount[:, :3, :3], from_camera)
    x_px = np.empty((len(camera), 2))
    for c, lens in enumerate(scene.cameras):
        x_px[camera == c] = project(lens, in_camera[camera == c])
    return _View(from_rig, from_camera, in_camera, x_px - pictures.x_px)


def _pixel_errors(
    scene: Scene, view: _View, problem: _Problem, before: _PixelErrors | None = None
) -> _PixelErrors:
    """From the median point none of whose observations is far off, and from cells of the images.

    As in calibration/bundle.py; the ratio between cameras from their sums of squares over what is left of them after
    the points took their part (their leverage), for a camera whose residuals are small because points follow it is
    not the better one. The images of a fixed camera show the same features with the same errors: their cells are one.
    """
    pictures, count = problem.pictures, len(scene.cameras)
    camera = pictures.camera[pictures.picture]
    square = (view.residual**2).sum(1)
    ratio = np.ones(count)
    if before is not None:
        weight = _weights(view, replace(before, inflation=1.0), problem)
        left = 1 - _leverage(scene, view, problem, weight)
        for c in range(count):
            rows = camera == c
            if rows.any():
                tame = weight[rows] * before.sigma_px[c] ** 2
                ratio[c] = (tame @ square[rows]) / max(2 * float(tame @ left[rows]), 1e-12)
        ratio = np.clip(ratio / max(ratio[0], 1e-12), *RATIOS)
    relative = square / ratio[camera]
    far = relative > FAR_OFF**2 * np.median(relative)
    squares = np.bincount(pictures.point, relative) / problem.median_square
    clean = np.bincount(pictures.point, far) == 0
    factor = float(np.median(squares[clean] if clean.any() else squares))
    sigma_px = np.maximum(np.sqrt(factor * ratio), MIN_SIGMA_PX)
    pull = _weights(view, _PixelErrors(sigma_px), problem)[:, None] * view.residual
    width = np.array([lens.width for lens in scene.cameras])[camera]
    column, row = (CELLS * pictures.x_px / width[:, None]).astype(int).T
    keys = np.stack([pictures.rig[pictures.picture], camera, row, column])
    _, cell = np.unique(keys, axis=1, return_inverse=True)
    sums = sum(float((np.bincount(cell.ravel(), along) ** 2).sum()) for along in pull.T)
    return _PixelErrors(sigma_px, max(1.0, sums / max(float((pull**2).sum()), 1e-300)))


def _by_rig(scene: Scene, view: _View, problem: _Problem) -> Float[ndarray, "k 2 3"]:
    """Derivative of every observation by its point, rig axes."""
    camera = problem.pictures.camera[problem.pictures.picture]
    out = np.empty((len(camera), 2, 3))
    for c, lens in enumerate(scene.cameras):
        rows = camera == c
        out[rows] = by_point(lens, view.in_camera[rows]) @ scene.rig_from_camera[c, :3, :3].T
    return out


def _by_world(by_rig: Float[ndarray, "k 2 3"], scene: Scene, problem: _Problem) -> Float[ndarray, "k 2 3"]:
    """The same, world axes."""
    rig = problem.pictures.rig[problem.pictures.picture]
    return by_rig @ np.swapaxes(scene.world_from_rig[rig, :3, :3], 1, 2)


def _leverage(
    scene: Scene, view: _View, problem: _Problem, weight: Float[ndarray, " k"]
) -> Float[ndarray, " k"]:
    """Of each observation on itself through its point, mean of its two coordinates."""
    j = np.sqrt(weight)[:, None, None] * _by_world(_by_rig(scene, view, problem), scene, problem)
    inverse = np.linalg.inv(point_blocks(j, problem.seen.starts))[problem.pictures.point]
    return np.minimum(np.einsum("kai,kij,kaj->k", j, inverse, j) / 2, 1.0)


def _weights(view: _View, errors: _PixelErrors, problem: _Problem) -> Float[ndarray, " k"]:
    """Inverse variances under a Cauchy loss; points behind the camera count nothing."""
    camera = problem.pictures.camera[problem.pictures.picture]
    variance = errors.sigma_px[camera] ** 2
    squared = (view.residual**2).sum(1) / variance
    weight = loss_weight("cauchy", squared / LOSS_SCALE**2) / (variance * errors.inflation)
    return (view.in_camera[:, 2] > 1e-9) * weight


def _lens_step(scene: Scene, problem: _Problem) -> Float[ndarray, " l"]:
    """How far the intrinsics have moved from where they began, in the directions of their priors."""
    steps = [
        np.linalg.pinv(free.directions) @ (parameters(camera) - start)
        for free, camera, start in zip(problem.freedom.lenses, scene.cameras, problem.started, strict=True)
    ]
    return np.concatenate(steps)


def _rig_step(scene: Scene, problem: _Problem) -> Float[ndarray, " r"]:
    """How far the held rigs have moved."""
    count = 0 if problem.held is None else len(problem.held) // 6
    return step_between(problem.rigs[:count], scene.world_from_rig[:count]).ravel()


def _lens_std(problem: _Problem) -> Float[ndarray, " l"]:
    return np.concatenate([free.std for free in problem.freedom.lenses])


def _cost(scene: Scene, view: _View, problem: _Problem, weight: Float[ndarray, " k"]) -> float:
    told = _lens_step(scene, problem) / _lens_std(problem)
    pulled = 0.0
    if problem.held is not None:
        moved = _rig_step(scene, problem)
        pulled = float(moved @ problem.held @ moved)
    return float(weight @ (view.residual**2).sum(1)) + float((told**2).sum()) + pulled


def _minimised(
    scene: Scene, view: _View, problem: _Problem, weight: Float[ndarray, " k"], damping: float
) -> tuple[Scene, _View, float]:
    """Levenberg-Marquardt with the weights held."""
    cost = _cost(scene, view, problem, weight)
    for _ in range(STEPS):
        moved = _moved(scene, problem, _normal(scene, view, problem, weight, damping))
        moved_view = _view(moved, problem.pictures)
        new_cost = _cost(moved, moved_view, problem, weight)
        if new_cost <= cost:
            gained, scene, view, cost = cost - new_cost, moved, moved_view, new_cost
            damping = max(damping / 10, 1e-10)
            if gained < ENOUGH:
                break
        else:
            damping *= 10
            if damping > 1e8:
                return scene, view, 1e-4
    return scene, view, damping


def _normal(
    scene: Scene, view: _View, problem: _Problem, weight: Float[ndarray, " k"], damping: float
) -> Normal:
    """In the order of Imaged.covariance."""
    freedom, first = problem.freedom, problem.freedom.first_rig
    camera = problem.pictures.camera[problem.pictures.picture]
    by_rig = _by_rig(scene, view, problem)
    shared = np.zeros((len(camera), 2, first))
    lenses = zip(scene.cameras, freedom.lenses, freedom.lens_columns, freedom.mount_columns, strict=True)
    for c, (lens, free, of_lens, of_mount) in enumerate(lenses):
        mine = camera == c
        shared[mine, :, of_lens] = by_parameters(lens, view.in_camera[mine]) @ free.directions
        if of_mount is not None:
            turned = by_rig[mine] @ skew(view.from_camera[mine])
            shared[mine, :, of_mount] = np.concatenate([-by_rig[mine], turned], axis=2)
    by_world = _by_world(by_rig, scene, problem)
    own = np.concatenate([-by_world, by_world @ skew(view.from_rig)], axis=2)
    root = np.sqrt(weight)[:, None, None]
    weighted = Derivatives(shared * root, own * root, by_world * root, view.residual * root[..., 0])
    hessian, right = with_points_held(weighted, problem.seen)
    lens_std = _lens_std(problem)
    hessian[range(len(lens_std)), range(len(lens_std))] += lens_std**-2.0
    right[: len(lens_std)] -= _lens_step(scene, problem) / lens_std**2
    if problem.held is not None:
        of_held = slice(first, first + len(problem.held))
        hessian[of_held, of_held] += problem.held
        right[of_held] -= problem.held @ _rig_step(scene, problem)
    hessian[np.diag_indices(len(right))] *= 1 + damping
    return without_points(hessian, right, weighted, problem.seen, damping)


def _moved(scene: Scene, problem: _Problem, normal: Normal) -> Scene:
    """The scene after one Gauss-Newton step; along the similarity that no image shows, the least one."""
    scale = 1 / np.sqrt(np.maximum(normal.hessian.diagonal(), 1e-300))
    scaled = scale[:, None] * normal.hessian * scale
    scaled[range(len(scale)), range(len(scale))] += 1e-12
    step = scale * np.linalg.solve(scaled, scale * normal.right)
    points = normal.stepped(scene.points_in_world, step)
    return replace(stepped(scene, problem.freedom, step), points_in_world=points)


def stepped(scene: Scene, freedom: Freedom, step: Float[ndarray, " d"]) -> Scene:
    """Intrinsics, mounts and rigs after a step in the order of Imaged.covariance."""
    cameras = tuple(
        with_parameters(camera, parameters(camera) + free.directions @ step[columns])
        for camera, free, columns in zip(scene.cameras, freedom.lenses, freedom.lens_columns, strict=True)
    )
    mounts = scene.rig_from_camera.copy()
    for c, columns in enumerate(freedom.mount_columns):
        if columns is not None:
            mounts[c] = retract(mounts[c], step[columns])
    rigs = retract(scene.world_from_rig, step[freedom.first_rig :].reshape(-1, 6))
    return Scene(rigs, mounts, cameras, scene.points_in_world)


def similarities(scene: Scene, freedom: Freedom) -> Float[ndarray, "d 7"]:
    """Steps of everything that a similarity of the world makes, which no image shows; scale first."""
    first = freedom.first_rig
    out = np.zeros((first + 6 * len(scene.world_from_rig), 7))
    position = scene.world_from_rig[:, :3, 3]
    rigs = np.zeros((len(position), 6, 7))
    rigs[:, :3, 0], rigs[:, :3, 1:4] = position, np.eye(3)
    rigs[:, :3, 4:], rigs[:, 3:, 4:] = -skew(position), np.eye(3)
    out[first:] = rigs.reshape(-1, 7)
    for c, columns in enumerate(freedom.mount_columns):
        if columns is not None:
            out[columns.start : columns.start + 3, 0] = scene.rig_from_camera[c, :3, 3]
    return out


def _without_similarity(
    hessian: Float[ndarray, "d d"], scene: Scene, freedom: Freedom
) -> Float[ndarray, "d d"]:
    """The covariance of what is seen, with nothing along the similarity that is not."""
    size = 1 / np.sqrt(np.maximum(hessian.diagonal(), 1e-300))
    scaled = size[:, None] * hessian * size
    unseen = np.linalg.qr(similarities(scene, freedom) / size[:, None])[0]
    inverse = np.linalg.inv(scaled + unseen @ unseen.T) - unseen @ unseen.T
    inverse = (inverse + inverse.T) / 2
    return size[:, None] * inverse * size


def _inverted(hessian: Float[ndarray, "d d"]) -> Float[ndarray, "d d"]:
    size = 1 / np.sqrt(np.maximum(hessian.diagonal(), 1e-300))
    inverse = np.linalg.inv(size[:, None] * hessian * size)
    return size[:, None] * (inverse + inverse.T) / 2 * size
