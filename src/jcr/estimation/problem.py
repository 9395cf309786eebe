"""Estimation problem, its state, and the layout of the columns of its equations.

A rig is a rigid body that carries cameras or corners: the wrist of an arm at one image, a fixed camera, or a board.
The frame `world` has an arbitrary origin and unit, since images determine the rigs up to one similarity.
Rigs that an arm moves satisfy `base_from_gripper[i] · X = Z · S_λ(world_from_rig[i])`, S_λ scaling translations.
For a fixed camera and an arm that carries the scene, X is base_from_camera, Z is gripper_from_world, and
gripper_from_base takes the place of base_from_gripper.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.linalg import block_diag, orth

from jcr.camera import parameters, unproject, with_parameters
from jcr.distributions import chi2
from jcr.estimation.boards import BoardShapes, shapes_of
from jcr.estimation.elimination import Sightings
from jcr.estimation.intrinsics_prior import POLYNOMIALS, TYPICAL, CameraPrior, unmodelled
from jcr.estimation.pixel_noise import Layout, PixelNoise
from jcr.estimation.robot_noise import of_poses, smooth_errors
from jcr.findings import FindingKind
from jcr.geometry import Poses, Transform, by_similarity, inverse, retract, scale_translation
from jcr.records import Intrinsics, Tracks

TRANSLATION, ROTATION, SCALE = slice(0, 3), slice(3, 6), slice(6, 7)
BASE_TRANSLATION, BASE_ROTATION = slice(7, 10), slice(10, 13)
"""Columns of the 13 unknowns of one arm: X, log scale, Z; the first seven are in records.COVARIANCE_ORDER."""
UNKNOWNS = 13
"""Number of unknowns of a problem with one arm and exact cameras: X (6), log scale (1), Z (6)."""


def columns_of_arm(arm: int) -> Int[ndarray, "12"]:
    """Return the 12 columns of an arm's X (gripper_from_camera) and Z (base_from_world) among the unknowns.

    X and Z have six columns each: translation, then rotation. `arm` counts from 0; column 6 is the shared log scale.
    """
    first = 12 * arm
    return np.r_[:6, 7:13] if arm == 0 else np.arange(first + 1, first + 13)


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Observations of points: rig and camera of each of n images; image, point and pixel of each of k observations.

    A rig is a set of cameras that move together.
    """

    rig: Int[ndarray, " n"]
    """Rig of each image."""
    camera: Int[ndarray, " n"]
    """Camera of each image."""
    image: Int[ndarray, " k"]
    """Image of each observation."""
    x_px: Float[ndarray, "k 2"]
    """Pixel of each observation in the original, distorted image."""
    point: Int[ndarray, " k"]
    """Row of each observation's point."""
    std_px: Float[ndarray, " k"]
    """Stated standard deviation of one pixel coordinate of each observation, up to a common factor."""
    point_rows: Int[ndarray, " p"] | None = None
    """Row of each point among the points before some were removed; None: none were removed."""


CELLS = 8
"""Number of cells across an image's width; the features of one cell have correlated errors."""
OF_IMAGE, PRISM = 2, 4
"""Number of parameters of each image (focal, shear), and of the thin prism that all images share (s1 to s4).

Parameters of an image: log of its focal length over its camera's; shear from top to bottom, in focal lengths (rolling
shutter). s1 to s4 are those of OpenCV."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Effect:
    """Possible effect with d parameters, on the reported poses or on one camera, that the model lacks.

    The c coordinates are the residuals of the reported poses (m, rad; base axes), or the camera's e parameters: its
    intrinsics in the units of `rows_of`; then focal lengths and shears of its images; then s1 to s4 of the thin prism.
    """

    kind: FindingKind
    part: int = 0
    """Index of the camera or the arm that has the effect."""
    columns: Float[ndarray, "c d"]
    """Derivative of the c coordinates by the d parameters."""
    nuisance: Float[ndarray, "c q"] | None = None
    """Directions that are free with and without the effect; None: none."""
    motion: Float[ndarray, "c 6"] | None = None
    """Derivative of the residuals by a motion that acts on all images alike; None for other effects."""
    share: Float[ndarray, " n"] | None = None
    """Factor of `motion` at each of n poses, so that `columns` is their product."""
    place: int = 0
    """First image after the change; 0 for an effect that is not a change at one image."""
    places: int = 1
    """Number of alternative rows with this and other places, by which p-values are multiplied."""
    unit: float = 1.0
    """Prior standard deviation of the parameters of adopted errors of poses; for a camera, factor of the stated size."""

    @property
    def of_camera(self) -> bool:
        """Whether the effect is on a camera; otherwise it is on the reported poses."""
        return self.kind.row.group == "camera"

    @property
    def beside(self) -> Float[ndarray, "c q"]:
        """Directions (columns) in the c coordinates that are free with and without the effect; q = 0 for none."""
        return self.columns[:, :0] if self.nuisance is None else self.nuisance

    @property
    def both(self) -> Float[ndarray, "c r"]:
        """Directions (columns) in the c coordinates that are free with the effect: `beside`, then `columns`."""
        return np.concatenate([self.beside, self.columns], axis=1)

    def with_parameters(self, first: int, more: int) -> "Effect":
        """Return an effect on a camera for a camera model with `more` coefficients after the `first` parameters."""
        if not self.of_camera:
            return self
        own, beside = (np.insert(one, [first] * more, 0.0, axis=0) for one in (self.columns, self.beside))
        return replace(self, columns=own, nuisance=beside)


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportedPoses:
    """Reported gripper poses of one arm, and the rigs (camera poses) that it moves."""

    rigs: Int[ndarray, " n"]
    """Rig of each pose."""
    base_from_gripper: Poses
    """Reported pose at each of n images."""
    error_covariance: Float[ndarray, "s s"]
    """Covariance (s,s), s = 6n, of the systematic errors of the n poses for a size σ_s of 1 rad."""
    carries: Literal["camera", "scene"] = "camera"
    """Object that moves with the gripper."""


class LinearPrior(NamedTuple):
    """Linear prior `row · Problem.coordinates(state) = value ± std` on p unknowns; `std` is one standard deviation."""

    row: Float[ndarray, " p"]
    value: float
    std: float


def scale_prior(metres_per_unit: float, std: float) -> LinearPrior:
    """Return the prior that the scale is `metres_per_unit` with the relative standard deviation `std`.

    It is for a problem of one arm with exact cameras, which has UNKNOWNS unknowns.
    """
    return LinearPrior(np.eye(UNKNOWNS)[6], float(np.log(metres_per_unit)), std)


def offset_prior(axis: Float[ndarray, "3"], metres: float, std: float) -> LinearPrior:
    """Return the prior that the camera is at `metres` ± `std` (m) from the gripper's origin along a unit `axis`.

    The axis is in the gripper frame. The prior is for a problem of one arm with exact cameras (UNKNOWNS unknowns).
    """
    return LinearPrior(np.r_[axis, np.zeros(UNKNOWNS - 3)], metres, std)


@dataclass(frozen=True)
class Columns:
    """Layout of the unknowns of the image equations: cameras, model errors, boards, mounts, then six for each rig.

    Model errors are polynomials of distortion; a mount is a camera's pose on its rig.
    """

    cameras: slice
    """Columns of the steps along `Problem.directions`."""
    model_error: tuple[slice, ...]
    """Columns of each camera's remaining distortion; an empty slice if it is not estimated."""
    boards: slice
    """Columns of the boards' shapes."""
    mounts: tuple[slice | None, ...]
    """Six columns of the pose of each camera on its rig; None for a fixed pose."""
    first_rig: int
    """First column of the first rig."""
    count: int
    """Number of all columns."""


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """Estimates of all unknowns of a problem, and of the sizes of its errors."""

    x: Float[ndarray, "a 4 4"]
    """X of each of a arms: gripper_from_rig, or base_from_camera if the arm carries the scene."""
    scale: float
    """Metres per unit of the world."""
    z: Float[ndarray, "a 4 4"]
    """Z of each arm: base_from_world, or gripper_from_world if the arm carries the scene; world scaled to metres."""
    world_from_rig: Float[ndarray, "m 4 4"]
    """Pose of each of m rigs, in the unit of the world."""
    rig_from_camera: Float[ndarray, "c 4 4"] = field(default_factory=lambda: np.eye(4)[None])
    """Pose of each of c cameras on its rig, in the unit of the world."""
    camera_steps: Float[ndarray, " l"] = field(default_factory=lambda: np.zeros(0))
    """Values of the first l columns (cameras, model errors, boards); 0 is the middle of their priors."""
    points_in_world: Float[ndarray, "p 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    model_error_std: Float[ndarray, " g"] = field(default_factory=lambda: np.zeros(0))
    """Size of the remaining distortion of each camera's model, in image widths."""
    pixel_noise: PixelNoise | None = None
    """Sizes of the pixel errors; None before the first estimate."""
    robot_log_sizes: Float[ndarray, " s"] | None = None
    """Logarithms of σ_t (m), σ_r, σ_s (rad) of the robot's errors (robot_noise.py); None before the first estimate."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Estimation problem: reported poses of arms, observations in images or given camera poses, and priors."""

    arms: tuple[ReportedPoses, ...]
    """Reported poses of each arm."""
    n_rigs: int
    """Number of rigs."""
    cameras: tuple[CameraPrior, ...] = ()
    """Prior of each camera; empty without observations."""
    observations: Observations | None = None
    """Observations sorted by point and rig, at least two for each point; None: `known_rigs` has the camera poses."""
    boards: BoardShapes | None = None
    """Shape prior of board corners among the points; None: no boards."""
    effects: tuple[Effect, ...] = ()
    """Effects that are estimated: on cameras as free directions, on reported poses as errors of the poses."""
    freed: Float[ndarray, "r e"] = field(default_factory=lambda: np.zeros((0, 0)))
    """Further free directions of cameras and images for a score test, one column each; rows as in `directions`."""
    freed_std: Float[ndarray, " e"] = field(default_factory=lambda: np.zeros(0))
    """Prior standard deviation along each column of `freed`."""
    known_rigs: tuple[Float[ndarray, "m 4 4"], Float[ndarray, "6*m 6*m"] | None] | None = None
    """Normal distribution of the first m rigs' poses: mean, and covariance (6m,6m) of steps (None: exact)."""
    priors: tuple[LinearPrior, ...] = ()
    """Linear priors on X, scale and cameras."""
    robot_noise_floor: tuple[float, float] | None = None
    """Lower bound on the random errors of the reported poses (m, rad); None: no bound is given."""
    used: Bool[ndarray, " n"] | None = None
    """Mask of the reported poses that are used; None: all. Only for a problem without observations."""

    @cached_property
    def columns(self) -> Columns:
        """Layout of the d unknowns of the image equations: cameras, model errors, boards, mounts, rigs (6 each)."""
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
        """Slice of the rows of `directions` that are the intrinsics of each camera (camera.parameters)."""
        ends = np.cumsum([len(camera.directions) for camera in self.cameras]).tolist()
        return tuple(slice(a, b) for a, b in pairwise([0, *ends]))

    @cached_property
    def directions(self) -> Float[ndarray, "r l"]:
        """Directions (columns) in which the parameters of cameras and images may differ from the means of their priors.

        Rows: intrinsics of each camera (camera.parameters); focal lengths of all images, then shears
        (OF_IMAGE); s1 to s4 of the thin prism. Columns: directions of each camera's prior, those of `effects`, `freed`.
        """
        own = np.asarray(block_diag(*(camera.directions for camera in self.cameras)))
        own = np.pad(own, ((0, OF_IMAGE * self.n_images + PRISM), (0, 0)))
        more = (part for part in (self.of_effects[0], self.freed) if part.size)
        return np.concatenate([own, *more], axis=1)

    @cached_property
    def of_effects(self) -> tuple[Float[ndarray, "r e"], Float[ndarray, " e"]]:
        """Free directions of the effects on cameras, rows as in `directions`, and prior standard deviation of each.

        Directions of intrinsics, and those of the rest, are independent, with the weak prior of `rows_of`.
        """
        count = sum(len(camera.directions) for camera in self.cameras) + OF_IMAGE * self.n_images + PRISM
        columns, std = [np.zeros((count, 0))], [np.zeros(0)]
        for c, camera in enumerate(self.cameras):
            both = [effect.both for effect in self.effects if effect.of_camera and effect.part == c]
            if both:
                (rows, units, weak), every, q = (
                    rows_of(self, c),
                    np.concatenate(both, axis=1),
                    len(camera.directions),
                )
                free = np.asarray(block_diag(*(orth(part, rcond=1e-9) for part in (every[:q], every[q:]))))
                columns.append(np.zeros((count, free.shape[1])))
                columns[-1][rows] = units[:, None] * free
                std.append(1 / np.sqrt(((free / weak[:, None]) ** 2).sum(0)))
        return np.concatenate(columns, axis=1), np.concatenate(std)

    @cached_property
    def bent(self) -> Float[ndarray, "s b"]:
        """Errors of all reported poses (s = 6n rows) by one standard deviation of each parameter of `effects` on them.

        The parameters' prior standard deviation is `Effect.unit`.
        """
        each = (effect.unit * effect.columns for effect in self.effects if not effect.of_camera)
        return np.concatenate([np.zeros((6 * sum(len(arm.rigs) for arm in self.arms), 0)), *each], axis=1)

    @cached_property
    def model_error_counts(self) -> list[int]:
        """Number of distortion polynomials of each camera.

        It is 0 for exact intrinsics and for a camera with POLYNOMIALS observations or fewer, else POLYNOMIALS.
        """
        counts = [POLYNOMIALS * bool(self.directions[own].any()) for own in self.parameters_of]
        seen = np.bincount(self.layout.camera, minlength=len(counts)) if self.observations else counts
        return [count if n > count else 0 for n, count in zip(seen, counts, strict=True)]

    @cached_property
    def layout(self) -> Layout:
        """Camera, group, image cell and stated variance of each observation, from which the pixel noise is estimated.

        A group is the features of one camera, or all board corners.
        """
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
        """Index of the observations, sorted by point, with the rig of each (a rig: cameras that move together)."""
        assert self.observations is not None
        rig = self.observations.rig[self.observations.image]
        return Sightings.of(self.observations.point, rig, self.n_rigs)

    @cached_property
    def rows(self) -> tuple[Int[ndarray, " r"], Int[ndarray, " r"], Sightings]:
        """Order and points of the r rows of the image equations after sorting by point and rig, and their index.

        A row has two residuals. Before sorting, the rows are the observations, then two rows for each board corner; the
        order holds their numbers before sorting.
        """
        assert self.observations is not None
        point, rig = self.observations.point, self.observations.rig[self.observations.image]
        if self.boards is None:
            return np.arange(len(point)), point, self.seen
        both = np.stack([point, rig])
        both = np.concatenate([both, np.repeat([self.boards.point, self.boards.rig], 2, axis=1)], axis=1)
        order = np.lexsort(both[::-1])
        point, rig = both[:, order]
        return order, point, Sightings.of(point, rig, self.n_rigs)

    @cached_property
    def displacements(self) -> Float[ndarray, "k 2 e"]:
        """Derivatives (px) of each observation's predicted pixel by the e model error coefficients (image widths).

        Model errors are polynomials of distortion, camera after camera; derivatives by those of other cameras are 0.
        """
        assert self.observations is not None
        each = zip(self.cameras, self.parameters_of, self.model_error_counts, self.camera_rows, strict=True)
        x_px, columns = self.observations.x_px, [np.zeros((len(self.observations.x_px), 2, 0))]
        for camera, own, count, rows in each:
            columns.append(np.zeros((len(x_px), 2, count)))
            if count:
                columns[-1][rows] = unmodelled(camera.intrinsics, self.directions[own], x_px[rows])[0]
        return np.concatenate(columns, axis=2)

    @cached_property
    def camera_rows(self) -> list[Int[ndarray, "..."]]:
        """For each camera the ascending indices of its observations among the k of `observations`."""
        return [np.flatnonzero(self.layout.camera == c) for c in range(len(self.cameras))]

    @cached_property
    def prism(self) -> Float[ndarray, "k 2 4"]:
        """Derivatives (px) of each observation's pixel x and y by the thin prism coefficients s1 to s4 of OpenCV."""
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
        """Number of images; 0 without observations."""
        return 0 if self.observations is None else len(self.observations.rig)

    @property
    def arm_unknowns(self) -> int:
        """Number of unknowns of the arms: hand-eye transform (6) and base_from_world (6) of each arm, and one scale."""
        return 12 * len(self.arms) + 1

    @cached_property
    def by_arm(self) -> Int[ndarray, " s"]:
        """Columns (of `columns`) of the rigs that arms move: six for each reported pose, in the order of the poses."""
        moving = np.concatenate([arm.rigs for arm in self.arms])
        return (self.columns.first_rig + 6 * moving[:, None] + np.arange(6)).ravel()

    @cached_property
    def free(self) -> Int[ndarray, " e"]:
        """Columns (of `columns`) that are unknowns: cameras, model errors, boards, mounts, rigs that no arm moves."""
        return np.setdiff1d(np.arange(self.columns.count), self.by_arm)

    @property
    def unknowns(self) -> int:
        """Number p of unknowns: those of the arms, then the columns `free`."""
        return self.arm_unknowns + len(self.free)

    def prior_std(self, state: State) -> Float[ndarray, " l"]:
        """Return the prior standard deviations of the first l columns: cameras, model errors, boards.

        The sizes of the model errors are those of `state`.
        """
        each = [np.full(c.stop - c.start, size)
                for c, size in zip(self.columns.model_error, state.model_error_std, strict=True)]  # fmt: skip
        boards = np.zeros(0) if self.boards is None else self.boards.shape_std
        freed = self.of_effects[1], self.freed_std
        return np.concatenate([*(camera.std for camera in self.cameras), *freed, *each, boards])

    def displacement(self, state: State) -> Float[ndarray, " r"]:
        """Return parameters of cameras and images minus their prior means, in the order of the rows of `directions`."""
        return self.directions @ state.camera_steps[self.columns.cameras]

    def intrinsics(self, state: State) -> tuple[Intrinsics, ...]:
        """Return the estimated intrinsics of each camera."""
        off = self.displacement(state)
        return tuple(
            with_parameters(one.intrinsics, parameters(one.intrinsics) + off[own])
            for one, own in zip(self.cameras, self.parameters_of, strict=True)
        )

    def coordinates(self, state: State) -> Float[ndarray, " p"]:
        """Return the p coordinates for linear priors, in the order of the unknowns.

        They are the translation of the first X (m), the log scale, and the steps of cameras, model errors and boards;
        all others are 0.
        """
        out = np.zeros(self.unknowns)
        out[:3], out[SCALE] = state.x[0][:3, 3], np.log(state.scale)
        steps = self.free[self.free < self.columns.boards.stop]
        out[self.arm_unknowns : self.arm_unknowns + len(steps)] = state.camera_steps[steps]
        return out


def with_observations(problem: Problem, state: State) -> tuple[Problem, State]:
    """Return the problem with the observations of all points that have two or more, and its initial state.

    `observations.point` are rows of `state.points_in_world`; points that are left out are removed from state and
    boards. Observations are sorted by point and rig. Only the first observation of a point in an image is kept, and
    points are numbered anew. Intrinsics and boards start at the means of their priors.
    """
    observations, boards = problem.observations, problem.boards
    assert observations is not None
    rig = observations.rig[observations.image]
    order = np.lexsort((observations.image, rig, observations.point))
    point, image = observations.point[order], observations.image[order]
    order = order[np.r_[True, (np.diff(point) != 0) | (np.diff(image) != 0)][: len(order)]]
    count = np.bincount(observations.point[order], minlength=len(state.points_in_world))
    order = order[count[observations.point[order]] >= 2]
    kept, point = np.unique(observations.point[order], return_inverse=True)
    if boards is not None:
        corners = np.flatnonzero(np.isin(boards.point, kept))
        boards = replace(
            boards,
            point=np.searchsorted(kept, boards.point[corners]),
            body=boards.body[corners],
            x_in_body=boards.x_in_body[corners],
            by_shape=boards.by_shape[corners],
        )
    observations = replace(
        observations,
        image=observations.image[order],
        x_px=observations.x_px[order],
        point=point,
        std_px=observations.std_px[order],
        point_rows=kept,
    )
    problem = replace(problem, boards=boards, observations=observations)
    state = replace(
        state,
        points_in_world=state.points_in_world[kept],
        camera_steps=np.zeros(problem.columns.boards.stop),
        model_error_std=np.full(len(problem.cameras), TYPICAL),
    )
    return problem, state


WEAK_INTRINSICS = 0.3, 0.3, 0.2, 0.2
"""Weak prior standard deviations of fx, fy (relative), cx, cy (image widths): they keep unobservable ones finite."""
WEAK_DISTORTION, WEAK_PRISM, WEAK_OF_IMAGE = 1.0, 0.3, (0.05, 0.3)
"""Weak prior standard deviations of distortion, thin prism, and the OF_IMAGE parameters of each image."""


def rows_of(
    problem: Problem, camera: int
) -> tuple[Int[ndarray, " e"], Float[ndarray, " e"], Float[ndarray, " e"]]:
    """Return three vectors for the e parameters of a camera, its m images and the prism: rows, units, weak prior std.

    Rows are those of `Problem.directions`: q intrinsics; focal lengths and shears of the m images; s1 to s4. Units are
    fx and fy for the focal lengths, the image width for the principal point, else 1. The standard deviations are in
    these units. `camera` is the camera's index; the problem must have observations.
    """
    assert problem.observations is not None
    intrinsics, own, n = problem.cameras[camera].intrinsics, problem.parameters_of[camera], problem.n_images
    images, end = np.flatnonzero(problem.observations.camera == camera), problem.parameters_of[-1].stop
    of_images = (n * np.arange(OF_IMAGE)[:, None] + images).ravel()
    rows = np.r_[own, end + of_images, end + OF_IMAGE * n + np.arange(PRISM)]
    units = np.ones(len(rows))
    units[:4] = intrinsics.fx, intrinsics.fy, intrinsics.width, intrinsics.width
    of_each, more = np.repeat(WEAK_OF_IMAGE, len(images)), own.stop - own.start - 4
    of_camera = *WEAK_INTRINSICS, *[WEAK_DISTORTION] * more
    return rows, units, np.r_[of_camera, of_each, np.full(PRISM, WEAK_PRISM)]


OF_OBSERVATIONS = ("model_error_counts", "layout", "seen", "rows", "displacements", "camera_rows", "prism")
"""Cached properties of a problem that depend on its observations."""


def with_free(problem: Problem, **changes: Any) -> Problem:
    """Return the problem with `changes` of its fields: `priors`, `effects`, or free directions (`freed`, `freed_std`).

    The cached properties OF_OBSERVATIONS are kept, although `displacements` would change a little with the directions.
    """
    other = replace(problem, **changes)
    if problem.observations is not None:
        other.__dict__.update({name: getattr(problem, name) for name in OF_OBSERVATIONS})
    return other


def transferred(problem: Problem, state: State, other: Problem) -> State:
    """Return a state of `problem`, converted to the problem `other` with the same rigs and the same points or fewer.

    Camera parameters keep their values as far as the free directions of `other` allow. Poses and error sizes stay.
    """
    before, after = problem.columns, other.columns
    off, along = problem.displacement(state), np.zeros(after.boards.stop)
    middles = zip(problem.cameras, other.cameras, other.parameters_of, strict=True)
    for old, new, own in middles:
        off[own] += parameters(old.intrinsics) - parameters(new.intrinsics)
    # Several steps may lead to these values; the most likely ones are taken.
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
    """Return the state after steps of the arms' unknowns, and of cameras, boards and rigs.

    `arms` holds X (gripper_from_camera), log scale and Z (base_from_world) of the first arm, then X and Z of further
    arms; `columns` (d,) has the order of `Problem.columns`. Six numbers of a transform are translation, then rotation
    (rad), as in geometry.retract. None: no step. Points and sizes of errors stay.
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
    """Return the state after a step of all p unknowns: X, log scale and Z of the arms, then the columns `Problem.free`.

    Steps are those of `stepped`. Points and the rigs that arms move stay.
    """
    columns, arms = np.zeros(problem.columns.count), problem.arm_unknowns
    columns[problem.free] = step[arms:]
    return stepped(problem, state, step[:arms], columns if columns.any() else None)


def similarities_of_rigs(world_from_rig: Float[ndarray, "m 4 4"]) -> Float[ndarray, "r 7"]:
    """Return the derivative of rig steps (r = 6m) by a similarity of the world (geometry.by_similarity).

    The seven columns are translation, rotation about the world's origin, log scale. The rows of each rig are
    translation, then rotation (geometry.retract).
    """
    rigs = np.zeros((len(world_from_rig), 6, 7))
    rigs[:, :3] = by_similarity(world_from_rig[:, :3, 3])
    rigs[:, 3:, ROTATION] = np.eye(3)
    return rigs.reshape(-1, 7)


Start = tuple[Transform, float, Transform]
"""Initial estimate of gripper_from_camera, scale (metres per unit) and base_from_recon."""


def wrist_arm(
    base_from_gripper: Poses, error_covariance: Float[ndarray, "s s"] | None = None
) -> ReportedPoses:
    """Return the reported poses of an arm with a wrist camera: pose i belongs to image (rig) i.

    `error_covariance` (6n,6n) is the covariance of the systematic errors for a size σ_s of 1 rad; None:
    `smooth_errors`. Its rows are position (m), then rotation (rad), pose by pose, in base axes.
    """
    if error_covariance is None:
        error_covariance = smooth_errors(base_from_gripper)
    rigs = np.arange(len(base_from_gripper))
    return ReportedPoses(rigs=rigs, base_from_gripper=base_from_gripper, error_covariance=error_covariance)


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseModel:
    """Assumptions of a fit to n pairs of poses: errors of both, priors of X and scale, and what the gripper moves."""

    camera_covariance: Float[ndarray, "r r"] | None = None
    """Covariance (6n,6n) of steps of the camera poses (geometry.retract; recon axes and unit, rad); None: exact."""
    error_covariance: Float[ndarray, "s s"] | None = None
    """Covariance (6n,6n) of the systematic errors of the gripper poses, as in `wrist_arm`."""
    noise_floor: tuple[float, float] | None = None
    """Lower bound (m, rad) on the random errors of the gripper poses."""
    priors: tuple[LinearPrior, ...] = ()
    """Linear priors on X and scale."""
    carries: Literal["camera", "scene"] = "camera"
    """Object that the gripper moves (ReportedPoses)."""

    def of(self, poses: Int[ndarray, " k"]) -> "PoseModel":
        """Return the model of k of the pairs, given by their indices, in their order."""
        both = (self.camera_covariance, self.error_covariance)
        camera, gripper = (None if one is None else of_poses(one, poses) for one in both)
        return replace(self, camera_covariance=camera, error_covariance=gripper)

    def moving(self, base_from_gripper: Poses) -> Poses:
        """Return the poses of what the gripper moves against the scene: base_from_gripper or its inverse."""
        return inverse(base_from_gripper) if self.carries == "scene" else base_from_gripper


def pose_problem(
    base_from_gripper: Poses, recon_from_camera: Poses, start: Start, model: PoseModel | None = None
) -> tuple[Problem, State]:
    """Return the problem of reported gripper poses and given camera poses, without images, and its initial state.

    `start` is the initial (gripper_from_camera, scale, base_from_recon); `model` None: exact camera poses, no priors.
    """
    (x, scale, z), model = start, model or PoseModel()
    arm = wrist_arm(base_from_gripper, model.error_covariance)
    problem = Problem(
        arms=(replace(arm, carries=model.carries),),
        n_rigs=len(base_from_gripper),
        known_rigs=(recon_from_camera, model.camera_covariance),
        priors=model.priors,
        robot_noise_floor=model.noise_floor,
    )
    return problem, State(x=x[None], scale=scale, z=z[None], world_from_rig=recon_from_camera)


def wrist_problem(
    arm: ReportedPoses,
    start: Start,
    recon_from_camera: Poses,
    camera: CameraPrior,
    tracks: Tracks,
    *,
    noise: tuple[float, float] | None = None,
    effects: tuple[Effect, ...] = (),
) -> tuple[Problem, State]:
    """Return the problem of images and reported poses together, and its initial state; the world is in metres.

    The world is the frame of the reconstruction, scaled by the initial scale. `arm` has one pose per image. `start` is
    the initial (gripper_from_camera, scale, base_from_recon). `tracks` has points and observations in the images of
    `recon_from_camera`. `noise` is a lower bound on the random errors of the poses (m, rad). `effects` are those
    that are estimated.
    """
    (x, scale, z), n = start, len(recon_from_camera)
    points_in_world = scale * tracks.points_in_recon.astype(float)
    twice = np.bincount(tracks.point, minlength=len(points_in_world)) >= 2
    boards, world_from_board = shapes_of(tracks.boards, points_in_world, twice, n)
    each = np.arange(n)
    problem = Problem(
        arms=(arm,),
        n_rigs=n + len(world_from_board),
        cameras=(camera,),
        observations=Observations(
            rig=each,
            camera=np.zeros_like(each),
            image=tracks.image,
            x_px=tracks.x_px,
            point=tracks.point,
            std_px=np.ones(len(tracks.image)) if tracks.std_px is None else tracks.std_px,
        ),
        boards=boards,
        effects=effects,
        robot_noise_floor=noise,
    )
    state = State(
        x=x[None],
        scale=1.0,
        z=z[None],
        world_from_rig=np.concatenate([scale_translation(recon_from_camera, scale), world_from_board]),
        points_in_world=points_in_world,
    )
    return with_observations(problem, state)
