"""Estimation problem, its state, and the layout of the columns of its equations.

A rig is a rigid body that carries cameras or corners: the wrist of an arm at one image, a fixed camera, or a board.
`world` has any origin and unit; the images determine the rigs up to one similarity of it. The rigs that an arm moves
obey `base_from_gripper[i] · X = Z · S_λ(world_from_rig[i])`. Where the camera is fixed and the arm carries the scene,
X is base_from_camera, Z is gripper_from_world, and the equation is that of gripper_from_base.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.linalg import block_diag

from jcr.camera import parameters, unproject, with_parameters
from jcr.distributions import chi2
from jcr.estimation.boards import BoardShapes, shapes_of
from jcr.estimation.elimination import Sightings
from jcr.estimation.intrinsics_prior import POLYNOMIALS, TYPICAL, CameraPrior, displacements
from jcr.estimation.pixel_noise import Layout, PixelNoise
from jcr.estimation.robot_noise import smooth_errors
from jcr.geometry import (
    Poses,
    Transform,
    retract,
    scale_translation,
    skew,
    step_between,
)
from jcr.records import Intrinsics, Tracks

TRANSLATION, ROTATION, SCALE = slice(0, 3), slice(3, 6), slice(6, 7)
BASE_TRANSLATION, BASE_ROTATION = slice(7, 10), slice(10, 13)
"""Columns of the 13 unknowns; the first seven are records.COVARIANCE_ORDER."""
UNKNOWNS = 13


def columns_of_arm(arm: int) -> Int[ndarray, "12"]:
    """Return the columns of X and Z of an arm among the unknowns."""
    first = 12 * arm
    return np.r_[:6, 7:13] if arm == 0 else np.arange(first + 1, first + 13)


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Rig and camera of each image, and image, point and pixel of each observation."""

    rig: Int[ndarray, " n"]
    """Rig of each image."""
    camera: Int[ndarray, " n"]
    """Camera of each image."""
    image: Int[ndarray, " k"]
    x_px: Float[ndarray, "k 2"]
    """Pixels of the original, distorted image."""
    point: Int[ndarray, " k"]
    std_px: Float[ndarray, " k"]
    """Stated standard deviation of one coordinate, up to a common factor."""
    point_rows: Int[ndarray, " p"] | None = None
    """Row of each point among those that were given; None: all points."""


CELLS = 8
"""Cells across the width of an image, within which features share errors."""
OF_IMAGE, PRISM = 4, 4
"""Number of parameters of each image, and of those that all images share.

An image has the logarithm of its focal length over its camera's; a shear from top to bottom in focal lengths (rolling
shutter); offsets in x and y, in widths. All images share s1 to s4 of OpenCV's thin prism."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportedPoses:
    """Reported poses of one arm, and the rigs that it moves."""

    rigs: Int[ndarray, " n"]
    base_from_gripper: Poses
    error_covariance: Float[ndarray, "s s"]
    """Covariance (6n,6n) of the systematic errors of the poses where their size is 1 rad."""
    carries: Literal["camera", "scene"] = "camera"
    confirmed_errors: Float[ndarray, "s b"] | None = None
    """Columns of errors that were confirmed, one standard deviation each; None: none."""


class LinearPrior(NamedTuple):
    """A measurement `row · coordinates = value ± std`, the coordinates being those of `Problem.coordinates`."""

    row: Float[ndarray, " p"]
    value: float
    std: float


def scale_prior(metres_per_unit: float, std: float) -> LinearPrior:
    """Return the prior of one arm's problem whose scale is known with a relative standard deviation."""
    return LinearPrior(np.eye(UNKNOWNS)[6], float(np.log(metres_per_unit)), std)


def offset_prior(axis: Float[ndarray, "3"], metres: float, std: float) -> LinearPrior:
    """Return the prior of one arm's problem whose camera is known to be so far along an axis of the gripper frame."""
    return LinearPrior(np.r_[axis, np.zeros(UNKNOWNS - 3)], metres, std)


class RigGaussian(NamedTuple):
    """Poses of the first rigs, and the covariance of their steps; None: exact."""

    world_from_rig: Float[ndarray, "m 4 4"]
    covariance: Float[ndarray, "r r"] | None = None


@dataclass(frozen=True)
class Columns:
    """Columns of the equations of images; six columns for each rig follow from `first_rig` on."""

    cameras: slice
    """Steps along `Problem.directions`."""
    model_error: tuple[slice, ...]
    boards: slice
    mounts: tuple[slice | None, ...]
    first_rig: int
    count: int


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """Estimates of all unknowns of a problem, and of the sizes of its errors."""

    x: Float[ndarray, "a 4 4"]
    """Transform gripper_from_rig of each arm, or base_from_camera where the arm carries the scene."""
    scale: float
    """Metres per unit of the world."""
    z: Float[ndarray, "a 4 4"]
    """Transform base_from_world of each arm, or gripper_from_world; the world in metres."""
    world_from_rig: Float[ndarray, "m 4 4"]
    rig_from_camera: Float[ndarray, "c 4 4"] = field(default_factory=lambda: np.eye(4)[None])
    camera_steps: Float[ndarray, " l"] = field(default_factory=lambda: np.zeros(0))
    """Steps of the columns before the mounts, from the initial values of the cameras."""
    points_in_world: Float[ndarray, "p 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    model_error_std: Float[ndarray, " g"] = field(default_factory=lambda: np.zeros(0))
    """Size of the remaining distortion of each camera's model, in widths of its image."""
    pixel_noise: PixelNoise | None = None
    """None before the first estimate."""
    robot_log_sizes: Float[ndarray, " s"] | None = None
    """Logarithms of the sizes of the robot's errors; None before the first estimate."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Measurements and priors: reported poses, and observations in images or Gaussian distributions of rigs."""

    arms: tuple[ReportedPoses, ...]
    n_rigs: int
    cameras: tuple[CameraPrior, ...] = ()
    observations: Observations | None = None
    """Sorted by point and rig, every point with at least two; None: the poses of the rigs are in `known_rigs`."""
    boards: BoardShapes | None = None
    freed: Float[ndarray, "r e"] = field(default_factory=lambda: np.zeros((0, 0)))
    """Directions that are free beside the priors of the cameras; rows are those of `directions`."""
    freed_std: Float[ndarray, " e"] = field(default_factory=lambda: np.zeros(0))
    known_rigs: RigGaussian | None = None
    priors: tuple[LinearPrior, ...] = ()
    robot_noise_floor: tuple[float, float] | None = None
    """Lower bound on the random errors of the reported poses (m, rad); None: unknown."""
    used: Bool[ndarray, " n"] | None = None
    """Reported poses that the estimate rests on; None: all. Of a problem without observations only."""

    @cached_property
    def columns(self) -> Columns:
        """Columns of the equations of images."""
        boards = 0 if self.boards is None else len(self.boards.shape_std)
        mounts = [6 * camera.mount_free for camera in self.cameras]
        counts = [self.directions.shape[1], *self.model_error_counts, boards, *mounts]
        ends = np.cumsum(counts).tolist()
        cameras, *each = (slice(end - count, end) for count, end in zip(counts, ends, strict=True))
        own, shape, mounted = each[: len(mounts)], each[len(mounts)], each[len(mounts) + 1 :]
        poses = tuple(one if one.stop > one.start else None for one in mounted)
        return Columns(cameras, tuple(own), shape, poses, ends[-1], ends[-1] + 6 * self.n_rigs)

    @cached_property
    def parameters_of(self) -> tuple[slice, ...]:
        """Rows of `directions` that are the parameters of each camera."""
        ends = np.cumsum([len(camera.directions) for camera in self.cameras]).tolist()
        return tuple(slice(a, b) for a, b in pairwise([0, *ends]))

    @cached_property
    def directions(self) -> Float[ndarray, "r l"]:
        """Directions in which cameras and images may differ from the middle of their priors.

        Rows are the parameters of each camera, the OF_IMAGE parameters of all images one after the other, and the prism.
        """
        own = np.asarray(block_diag(*(camera.directions for camera in self.cameras)))
        own = np.pad(own, ((0, OF_IMAGE * self.n_images + PRISM), (0, 0)))
        return np.concatenate([own, self.freed], axis=1) if self.freed.size else own

    @cached_property
    def images_differ(self) -> bool:
        """Whether images may differ from their cameras."""
        return bool(self.directions[-OF_IMAGE * self.n_images - PRISM :].any())

    @cached_property
    def model_error_counts(self) -> list[int]:
        """Number of displacements of each camera: none of an exact one or of one with too few observations."""
        counts = [POLYNOMIALS * bool(self.directions[own].any()) for own in self.parameters_of]
        seen = np.bincount(self.layout.camera, minlength=len(counts)) if self.observations else counts
        return [count if n > count else 0 for n, count in zip(seen, counts, strict=True)]

    @cached_property
    def layout(self) -> Layout:
        """Groups and cells of the observations, for the estimate of their errors."""
        assert self.observations is not None
        observations, cameras = self.observations, len(self.cameras)
        camera, rig = observations.camera[observations.image], observations.rig[observations.image]
        widths = np.array([one.intrinsics.width for one in self.cameras])
        column, row = (CELLS * observations.x_px / widths[camera, None]).astype(int).T
        _, cell = np.unique(np.stack([rig, camera, row, column]), axis=1, return_inverse=True)
        seen = np.bincount(observations.point)
        corner = np.zeros(len(seen), bool)
        if self.boards is not None:
            corner[self.boards.point] = True
        stated = (observations.std_px / np.median(observations.std_px)) ** 2 if len(camera) else np.ones(0)
        return Layout(
            camera=camera,
            group=np.where(corner[observations.point], cameras, camera),
            groups=cameras + bool(corner.any()),
            point=observations.point,
            cell=cell.ravel(),
            stated_variance=stated,
            median_square=chi2.ppf(0.5, np.maximum(2 * seen - 3 * ~corner, 1)),
        )

    @cached_property
    def seen(self) -> Sightings:
        """Observations of each point by rig."""
        assert self.observations is not None
        rig = self.observations.rig[self.observations.image]
        return Sightings.of(self.observations.point, rig, self.n_rigs)

    @cached_property
    def rows(self) -> tuple[Int[ndarray, " r"], Int[ndarray, " r"], Int[ndarray, " r"], Sightings]:
        """Order of the rows of the equations, which are sorted by point, and their points, rigs and sightings.

        The unsorted rows are the observations, then two rows for each corner of a board.
        """
        assert self.observations is not None
        point, rig = self.observations.point, self.observations.rig[self.observations.image]
        if self.boards is None:
            return np.arange(len(point)), point, rig, self.seen
        both = np.stack([point, rig])
        both = np.concatenate([both, np.repeat([self.boards.point, self.boards.rig], 2, axis=1)], axis=1)
        order = np.lexsort(both[::-1])
        point, rig = both[:, order]
        return order, point, rig, Sightings.of(point, rig, self.n_rigs)

    @cached_property
    def displacements(self) -> Float[ndarray, "k 2 e"]:
        """Displacement of each observation by the remaining distortion of its camera's model, px."""
        assert self.observations is not None
        each = zip(self.cameras, self.parameters_of, self.model_error_counts, self.camera_rows, strict=True)
        x_px, columns = self.observations.x_px, [np.zeros((len(self.observations.x_px), 2, 0))]
        for camera, own, count, rows in each:
            columns.append(np.zeros((len(x_px), 2, count)))
            if count:
                columns[-1][rows] = displacements(camera.intrinsics, self.directions[own], x_px[rows])
        return np.concatenate(columns, axis=2)

    @cached_property
    def camera_rows(self) -> list[Int[ndarray, "..."]]:
        """Observations of each camera."""
        return [np.flatnonzero(self.layout.camera == c) for c in range(len(self.cameras))]

    @cached_property
    def prism(self) -> Float[ndarray, "k 2 4"]:
        """Displacement of each observation by the coefficients of a thin prism, px."""
        assert self.observations is not None
        out = np.zeros((len(self.observations.image), 2, PRISM))
        for camera, rows in zip(self.cameras, self.camera_rows, strict=True):
            intrinsics = camera.intrinsics
            r2 = (unproject(intrinsics, self.observations.x_px[rows])[:, :2] ** 2).sum(1)
            for axis, focal in enumerate((intrinsics.fx, intrinsics.fy)):
                out[rows, axis, 2 * axis] = focal * r2
                out[rows, axis, 2 * axis + 1] = focal * r2**2
        return out

    @property
    def n_images(self) -> int:
        """Number of images."""
        return 0 if self.observations is None else len(self.observations.rig)

    @property
    def arm_unknowns(self) -> int:
        """Number of unknowns of the arms: X and Z of each, and one scale."""
        return 12 * len(self.arms) + 1

    @cached_property
    def by_arm(self) -> Int[ndarray, " s"]:
        """Columns of the rigs that arms move, in the order of the reported poses."""
        moving = np.concatenate([arm.rigs for arm in self.arms])
        return (self.columns.first_rig + 6 * moving[:, None] + np.arange(6)).ravel()

    @cached_property
    def free(self) -> Int[ndarray, " e"]:
        """Columns that are unknowns beside those of the arms: cameras, mounts, and rigs that no arm moves."""
        return np.setdiff1d(np.arange(self.columns.count), self.by_arm)

    @property
    def unknowns(self) -> int:
        """Number of unknowns of the mixed model."""
        return self.arm_unknowns + len(self.free)

    def prior_std(self, state: State) -> Float[ndarray, " l"]:
        """Return the prior standard deviations of the columns before the mounts."""
        each = [np.full(c.stop - c.start, size)
                for c, size in zip(self.columns.model_error, state.model_error_std, strict=True)]  # fmt: skip
        boards = np.zeros(0) if self.boards is None else self.boards.shape_std
        return np.concatenate([*(camera.std for camera in self.cameras), self.freed_std, *each, boards])

    def displacement(self, state: State) -> Float[ndarray, " r"]:
        """Return the displacement of cameras and images from the middle of their priors, as `directions` count it."""
        return self.directions @ state.camera_steps[self.columns.cameras]

    def intrinsics(self, state: State) -> tuple[Intrinsics, ...]:
        """Return the estimated intrinsics of each camera."""
        off = self.displacement(state)
        return tuple(
            with_parameters(one.intrinsics, parameters(one.intrinsics) + off[own])
            for one, own in zip(self.cameras, self.parameters_of, strict=True)
        )

    def coordinates(self, state: State) -> Float[ndarray, " p"]:
        """Return the unknowns that linear priors measure: translation of X and log scale, m; steps of the cameras."""
        out = np.zeros(self.unknowns)
        out[:3], out[SCALE] = state.x[0][:3, 3], np.log(state.scale)
        steps = self.free[self.free < self.columns.boards.stop]
        out[self.arm_unknowns : self.arm_unknowns + len(steps)] = state.camera_steps[steps]
        return out


def with_observations(problem: Problem, state: State, observations: Observations) -> tuple[Problem, State]:
    """Return the problem with the observations of all points that two or more show, and its initial state.

    Observations are sorted by point and rig. The first of several of one point in one image is kept; the points are
    counted again. The cameras start at the middle of their priors.
    """
    rig = observations.rig[observations.image]
    order = np.lexsort((observations.image, rig, observations.point))
    point, image = observations.point[order], observations.image[order]
    order = order[np.r_[True, (np.diff(point) != 0) | (np.diff(image) != 0)][: len(order)]]
    count = np.bincount(observations.point[order], minlength=len(state.points_in_world))
    order = order[count[observations.point[order]] >= 2]
    kept, point = np.unique(observations.point[order], return_inverse=True)
    problem = replace(
        problem,
        boards=None if problem.boards is None else problem.boards.of_points(kept),
        observations=replace(
            observations,
            image=observations.image[order],
            x_px=observations.x_px[order],
            point=point,
            std_px=observations.std_px[order],
            point_rows=kept,
        ),
    )
    state = replace(
        state,
        points_in_world=state.points_in_world[kept],
        camera_steps=np.zeros(problem.columns.boards.stop),
        model_error_std=np.full(len(problem.cameras), TYPICAL),
    )
    return problem, state


WEAK = 0.3, 0.3, 0.2, 0.2
"""Standard deviations that only keep finite what the images cannot see: focal lengths relative, centre per width."""
WEAK_DISTORTION, WEAK_PRISM, WEAK_OF_IMAGE = 1.0, 0.3, (0.05, 0.3, 0.1, 0.1)
"""Standard deviations of the distortion, of a thin prism, and of the parameters of each image."""


def rows_of(
    problem: Problem, camera: int, images: Int[ndarray, " m"], n_images: int
) -> tuple[Int[ndarray, " e"], Float[ndarray, " e"], Float[ndarray, " e"]]:
    """Return the rows of `Problem.directions` of a camera, its images and the prism, their units and weak priors.

    The units are focal lengths and widths for the centre; the standard deviations are in these.
    """
    intrinsics, own, end = (
        problem.cameras[camera].intrinsics,
        problem.parameters_of[camera],
        problem.parameters_of[-1].stop,
    )
    more, m = own.stop - own.start - 4, len(images)
    of_images = (n_images * np.arange(OF_IMAGE)[:, None] + images).ravel()
    rows = np.r_[own, end + of_images, end + OF_IMAGE * n_images + np.arange(PRISM)]
    units = np.ones(len(rows))
    units[:4] = intrinsics.fx, intrinsics.fy, intrinsics.width, intrinsics.width
    of_each = np.repeat(WEAK_OF_IMAGE, m)
    return rows, units, np.r_[WEAK, np.full(more, WEAK_DISTORTION), of_each, np.full(PRISM, WEAK_PRISM)]


def freed(
    problem: Problem,
    combinations: Float[ndarray, "e p"],
    images: Int[ndarray, " m"],
    n_images: int,
    camera: int = 0,
) -> Problem:
    """Return the problem with combinations of the columns of one camera's `Alternatives` free, too.

    Parameters of the camera and of its `images`, of `n_images`, are freed each by themselves.
    """
    rows, units, weak = rows_of(problem, camera, images, n_images)
    q = len(problem.cameras[camera].directions)
    free = np.asarray(block_diag(spanned(combinations[:q]), spanned(combinations[q:])))
    directions = np.zeros((problem.parameters_of[-1].stop + OF_IMAGE * n_images + PRISM, free.shape[1]))
    directions[rows] = units[:, None] * free
    before = problem.freed if problem.freed.size else directions[:, :0]
    return replace(
        problem,
        freed=np.concatenate([before, directions], axis=1),
        freed_std=np.r_[problem.freed_std, 1 / np.sqrt(((free / weak[:, None]) ** 2).sum(0))],
    )


def spanned(combinations: Float[ndarray, "e p"]) -> Float[ndarray, "e r"]:
    """Return an orthonormal basis of the space of the combinations."""
    u, size, _ = np.linalg.svd(combinations, full_matrices=False)
    return u[:, size > 1e-9 * size.max(initial=1e-300)]


OF_OBSERVATIONS = ("model_error_counts", "layout", "seen", "rows", "displacements", "camera_rows", "prism")
"""Cached properties of a problem that depend on its observations."""


def with_free(problem: Problem, **changes: Any) -> Problem:
    """Return the problem with other priors or other free directions of the cameras (`freed`, `freed_std`).

    What depends on the observations is kept, and with it the displacements of the remaining distortion, although the
    cameras may express other ones.
    """
    other = replace(problem, **changes)
    if problem.observations is not None:
        other.__dict__.update({name: getattr(problem, name) for name in OF_OBSERVATIONS})
    return other


def transferred(problem: Problem, state: State, other: Problem) -> State:
    """Return the state in a problem of the same rigs whose cameras have other free directions, or that has fewer points.

    The cameras stay as they are, as far as the directions of the other problem can express that.
    """
    before, after = problem.columns, other.columns
    off, along = problem.displacement(state), np.zeros(after.boards.stop)
    middles = zip(problem.cameras, other.cameras, other.parameters_of, strict=True)
    for old, new, own in middles:
        off[own] += parameters(old.intrinsics) - parameters(new.intrinsics)
    # Of several steps that lead there the most likely ones.
    std = other.prior_std(state)[after.cameras]
    along[after.cameras] = std * (np.linalg.pinv(other.directions * std) @ off)
    for old, new in zip(before.model_error, after.model_error, strict=True):
        if old.stop - old.start == new.stop - new.start:
            along[new] = state.camera_steps[old]
    along[after.boards] = state.camera_steps[before.boards]
    old, new = problem.observations, other.observations
    assert old is not None and new is not None and old.point_rows is not None and new.point_rows is not None
    points = state.points_in_world[np.searchsorted(old.point_rows, new.point_rows)]
    return replace(state, camera_steps=along, points_in_world=points)


def stepped(
    problem: Problem,
    state: State,
    arms: Float[ndarray, " u"] | None = None,
    columns: Float[ndarray, " d"] | None = None,
) -> State:
    """Return the state after a step of the arms' unknowns and one of the columns of the images; points stay.

    `arms` holds X, log scale and Z of the first arm, then X and Z of further arms.
    """
    if columns is not None:
        of, mounts = problem.columns, state.rig_from_camera.copy()
        for c, own in enumerate(of.mounts):
            if own is not None:
                mounts[c] = retract(mounts[c], columns[own])
        state = replace(
            state,
            world_from_rig=retract(state.world_from_rig, columns[of.first_rig :].reshape(-1, 6)),
            rig_from_camera=mounts,
            camera_steps=state.camera_steps + columns[: of.boards.stop],
        )
    if arms is None:
        return state
    own = np.stack([arms[columns_of_arm(arm)] for arm in range(len(state.x))])
    scale = float(state.scale * np.exp(arms[6]))
    return replace(state, x=retract(state.x, own[:, :6]), scale=scale, z=retract(state.z, own[:, 6:]))


def full_step(problem: Problem, state: State, step: Float[ndarray, " p"]) -> State:
    """Return the state after a step of the unknowns of the mixed model."""
    columns, arms = np.zeros(problem.columns.count), problem.arm_unknowns
    columns[problem.free] = step[arms:]
    return stepped(problem, state, step[:arms], columns if columns.any() else None)


def step_to(
    problem: Problem, state: State, other: State
) -> tuple[Float[ndarray, " u"], Float[ndarray, " d"]]:
    """Return the steps of the arms' unknowns and of the columns of the images that lead to another state."""
    own = np.concatenate([step_between(state.x, other.x), step_between(state.z, other.z)], axis=1)
    arms = np.zeros(problem.arm_unknowns)
    arms[SCALE] = np.log(other.scale / state.scale)
    for arm, step in enumerate(own):
        arms[columns_of_arm(arm)] = step
    columns = np.zeros(problem.columns.count)
    columns[: problem.columns.boards.stop] = other.camera_steps - state.camera_steps
    for c, of_mount in enumerate(problem.columns.mounts):
        if of_mount is not None:
            columns[of_mount] = step_between(state.rig_from_camera[c], other.rig_from_camera[c])
    columns[problem.columns.first_rig :] = step_between(state.world_from_rig, other.world_from_rig).ravel()
    return arms, columns


def similarities(problem: Problem, state: State) -> Float[ndarray, "d 7"]:
    """Return the steps of all columns with a similarity of the world, which no image shows; the scale first."""
    out = np.zeros((problem.columns.count, 7))
    out[problem.columns.first_rig :] = similarities_of_rigs(state.world_from_rig)
    out[problem.columns.boards, 0][:1] = 1.0  # the logarithm of their size
    for c, columns in enumerate(problem.columns.mounts):
        if columns is not None:
            out[columns.start : columns.start + 3, 0] = state.rig_from_camera[c, :3, 3]
    return out


def similarities_of_rigs(world_from_rig: Float[ndarray, "m 4 4"]) -> Float[ndarray, "r 7"]:
    """Return the steps of rigs with a similarity of the world; r = 6m."""
    position = world_from_rig[:, :3, 3]
    rigs = np.zeros((len(position), 6, 7))
    rigs[:, :3, 0], rigs[:, :3, 1:4] = position, np.eye(3)
    rigs[:, :3, 4:], rigs[:, 3:, 4:] = -skew(position), np.eye(3)
    return rigs.reshape(-1, 7)


Start = tuple[Transform, float, Transform]
"""Initial estimate of gripper_from_camera, scale and base_from_recon."""
NO_ARM: Start = np.eye(4), 1.0, np.eye(4)
"""Start of a problem of images alone."""


def wrist_arm(
    base_from_gripper: Poses, error_covariance: Float[ndarray, "s s"] | None = None
) -> ReportedPoses:
    """Return an arm that moves rig i at pose i; `error_covariance` None: errors that are smooth over the poses."""
    if error_covariance is None:
        error_covariance = smooth_errors(base_from_gripper)
    rigs = np.arange(len(base_from_gripper))
    return ReportedPoses(rigs=rigs, base_from_gripper=base_from_gripper, error_covariance=error_covariance)


def pose_problem(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    start: Start,
    *,
    camera_covariance: Float[ndarray, "r r"] | None = None,
    error_covariance: Float[ndarray, "s s"] | None = None,
    noise_floor: tuple[float, float] | None = None,
    priors: tuple[LinearPrior, ...] = (),
) -> tuple[Problem, State]:
    """Return the problem of camera poses with the covariance of their steps (None: exact), and its initial state."""
    x, scale, z = start
    problem = Problem(
        arms=(wrist_arm(base_from_gripper, error_covariance),),
        n_rigs=len(base_from_gripper),
        known_rigs=RigGaussian(recon_from_camera, camera_covariance),
        priors=priors,
        robot_noise_floor=noise_floor,
    )
    return problem, State(x=x[None], scale=scale, z=z[None], world_from_rig=recon_from_camera)


def wrist_problem(
    arm: ReportedPoses | None,
    start: Start,
    recon_from_camera: Poses,
    camera: CameraPrior,
    tracks: Tracks,
    *,
    noise: tuple[float, float] | None = None,
    combinations: Float[ndarray, "e p"] | None = None,
) -> tuple[Problem, State]:
    """Return the problem of images and reported poses together, and its initial state; the world is in metres.

    `arm` moves rig i at image i; None: images alone, without boards. `noise` is a lower bound on the random errors of
    the poses (m, rad), and `combinations` of the columns of hypotheses.Alternatives are free.
    """
    x, scale, z = start
    arms, n = () if arm is None else (arm,), len(recon_from_camera)
    points_in_world = scale * tracks.points_in_recon.astype(float)
    twice = np.bincount(tracks.point, minlength=len(points_in_world)) >= 2
    bodies = None if arm is None else tracks.boards
    boards, world_from_board = shapes_of(bodies, points_in_world, twice, n)
    problem = Problem(
        arms=arms,
        n_rigs=n + len(world_from_board),
        cameras=(camera,),
        boards=boards,
        robot_noise_floor=noise,
    )
    state = State(
        x=x[None][: len(arms)],
        scale=1.0,
        z=z[None][: len(arms)],
        world_from_rig=np.concatenate([scale_translation(recon_from_camera, scale), world_from_board]),
        points_in_world=points_in_world,
    )
    each = np.arange(n)
    if combinations is not None:
        problem = freed(problem, combinations, each, n)
    observations = Observations(
        rig=each,
        camera=np.zeros_like(each),
        image=tracks.image,
        x_px=tracks.x_px,
        point=tracks.point,
        std_px=np.ones(len(tracks.image)) if tracks.std_px is None else tracks.std_px,
    )
    return with_observations(problem, state, observations)
