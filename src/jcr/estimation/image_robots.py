"""Images and robots together: what the images show of the rigs, tied to the arms that moved them.

The rigs that an arm moves obey `base_from_gripper[i] · X = base_from_world · S_λ(world_from_rig[i])`
(estimation/pose_equations.py), with one X and one base_from_world an arm and one λ for the whole scene. Where the camera
stands fixed and what it sees is carried by the gripper, the roles are exchanged: the world is the carried thing, and the
equation is that of the inverse poses, with base_from_camera in place of X and gripper_from_world in place of
base_from_world; the errors are still those of the reported poses. Every other transform of a cell follows from these
and from what the images show.

The images' evidence enters the mixed model of estimation/mixed_model.py as camera poses do. together.py finds where
everything is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.linalg import block_diag

from jcr.estimation.cholesky import cholesky, inverse_of, over
from jcr.estimation.images import ImageEvidence
from jcr.estimation.mixed_model import Equations, left_out, solve
from jcr.estimation.model_error import expressed, polynomials_of
from jcr.estimation.pose_equations import (
    SCALE,
    UNKNOWNS,
    Poses,
    columns_of_arm,
    pose_by_pose,
    residuals,
    residuals_by_camera,
    weak_prior,
)
from jcr.estimation.scene import Scene, stepped
from jcr.estimation.systematic import Region
from jcr.geometry import Transform, retract, step_between
from jcr.records import Budget, ModelError, RobotNoise

TINY_STEP = 1e-6
"""m, rad, or standard deviations of what is small: for derivatives by differences."""


@dataclass(frozen=True, kw_only=True)
class ArmPoses:
    """The reported poses of one arm, and the rigs that it moves."""

    rigs: Int[ndarray, " n"]
    base_from_gripper: Poses
    systematic: Float[ndarray, "s s"]
    """Covariance of their systematic errors at 1 rad."""
    start: tuple[Transform, Transform]
    """X and the transform from the world, scaled, to the frame in which X is sought."""
    exchanged: bool = False
    """The camera stands still and the arm carries what it sees."""
    bent: Float[ndarray, "s b"] | None = None
    """Errors of one standard deviation each that were found of the poses (estimation/pose_effects.py)."""


@dataclass(frozen=True, kw_only=True)
class Placed:
    """Where everything is, in metres."""

    x: Float[ndarray, "a 4 4"]
    """Of each arm: gripper_from_rig, or base_from_camera where roles are exchanged."""
    scale: float
    """Metres per unit of the world."""
    z: Float[ndarray, "a 4 4"]
    """Of each arm: base_from_world, or gripper_from_world; of the scaled world."""
    scene: Scene


@dataclass(frozen=True, kw_only=True)
class Adjusted:
    """Images and robots together, averaged over the sizes of the robots' errors."""

    placed: Placed
    covariance: Float[ndarray, "p p"]
    """Of steps as `after_step` takes them."""
    budget: Budget
    """Of the first arm's X and scale, by what they come from."""
    most_likely: Placed
    """Before the averaging, where `equations` and the evidence are."""
    log_sizes: Float[ndarray, " c"]
    """Of the robots' errors, most likely (components.py)."""
    equations: Equations
    """At the most likely place, in the order of `covariance`."""
    given: "Given"

    @property
    def noise(self) -> RobotNoise:
        """Errors of the gripper poses, the same of all arms."""
        return self.equations.noise(self.log_sizes)

    @property
    def first_camera_column(self) -> int:
        """Columns before it are those of the arms, from it on those of `given.free`."""
        return self.given.arm_unknowns

    def leave_one_out(self) -> Float[ndarray, "m 6"]:
        """Steps from the reported to the adjusted gripper poses (m, rad), each by an adjustment without that pose."""
        random = self.noise.translation, self.noise.rotation
        return left_out(solve(self.equations, self.log_sizes), random)[0]

    def intrinsics_covariance(self, c: int) -> Float[ndarray, "q q"]:
        """Of the parameters of a camera, in the order of camera.parameters."""
        own, directions = self._intrinsics_of(c)
        return directions @ self.covariance[own, own] @ directions.T

    def intrinsics_cross(self, c: int) -> Float[ndarray, "7 q"]:
        """Of the first arm's X and scale with the parameters of a camera."""
        own, directions = self._intrinsics_of(c)
        return self.covariance[:7, own] @ directions.T

    def model_error(self) -> ModelError | None:
        """What the first camera's model leaves of its distortion; None where its intrinsics are exact."""
        evidence = self.given.evidence
        problem, freedom = evidence.problem, evidence.problem.freedom
        count = polynomials_of(freedom.intrinsics[0])
        begin = freedom.model_error_columns.start
        if count == 0 or len(freedom.model_error_std) < count:
            return None
        first = self.first_camera_column
        own = slice(first + begin, first + begin + count)
        rows = problem.layout.camera == 0
        return ModelError(
            likeliest=self.placed.scene.camera_steps[begin : begin + count],
            covariance=self.covariance[own, own],
            expressed=expressed(freedom.start[0], freedom.intrinsics[0], problem.observations.x_px[rows]),
        )

    def _intrinsics_of(self, c: int) -> tuple[slice, Float[ndarray, "q e"]]:
        """The columns of a camera's intrinsics, and the directions that they are of."""
        freedom, first = self.given.evidence.problem.freedom, self.first_camera_column
        columns = freedom.intrinsics_columns[c]
        return slice(first + columns.start, first + columns.stop), freedom.intrinsics[c].directions

    def transform(self, of: Callable[[Placed], Transform]) -> tuple[Transform, Float[ndarray, "6 6"]]:
        """A transform that follows from where everything is, and the covariance of its step."""
        found, j = of(self.placed), self.derivative(of)
        return found, j @ self.covariance @ j.T

    def derivative(self, of: Callable[[Placed], Transform]) -> Float[ndarray, "6 p"]:
        """Of the step of such a transform."""
        found = of(self.placed)
        size = TINY_STEP * np.ones(len(self.covariance))
        std = np.sqrt(np.diag(self.covariance))
        cameras = self.first_camera_column
        size[cameras:] = np.minimum(1e-2 * std[cameras:], 1e-2) + 1e-9
        j = np.empty((6, len(size)))
        for k, step in enumerate(np.diag(size)):
            ahead, behind = (of(after_step(self.placed, way * step, self.given)) for way in (1, -1))
            j[:, k] = (step_between(found, ahead) - step_between(found, behind)) / (2 * size[k])
        return j


@dataclass(frozen=True)
class RigsGivenCameras:
    """What the images show of the rigs that arms move, with everything else of the scene where it is."""

    follow: Float[ndarray, "s e"]
    """By how much the rigs step back with each free column."""
    step: Float[ndarray, " s"]
    """To where they are likeliest, with the sign reversed."""
    covariance: Float[ndarray, "s s"]


@dataclass(frozen=True, kw_only=True)
class KnownLength:
    """A length that is known beside the robot's positions: a normal prior of the scale."""

    log_scale: float
    """What the logarithm of the metres per unit of the world is by it; of boards, of the metres per metre as stated."""
    std: float
    of_boards: bool = False
    """The size of the boards in the world is an unknown too, and its logarithm is added to that of the scale."""


@dataclass(frozen=True, kw_only=True)
class Given:
    """What the mixed model of a scene is made of."""

    evidence: ImageEvidence
    arms: tuple[ArmPoses, ...]
    noise: tuple[float, float] | None
    """m, rad: of the gripper poses, at least."""
    lengths: tuple[KnownLength, ...] = ()

    @cached_property
    def by_arm(self) -> Int[ndarray, " s"]:
        """Columns of the evidence: rigs that arms move, in the order of the residuals."""
        moving = np.concatenate([arm.rigs for arm in self.arms])
        return (self.evidence.problem.freedom.first_rig + 6 * moving[:, None] + np.arange(6)).ravel()

    @cached_property
    def free(self) -> Int[ndarray, " e"]:
        """Columns of the evidence that are unknowns here: cameras, mounts, and rigs that no arm moves."""
        return np.setdiff1d(np.arange(len(self.evidence.gradient)), self.by_arm)

    @cached_property
    def rigs(self) -> RigsGivenCameras:
        """What the images alone show of the rigs that arms move."""
        images, by_arm, free = self.evidence, self.by_arm, self.free
        root = cholesky(images.information[np.ix_(by_arm, by_arm)])
        coupling = images.information[np.ix_(by_arm, free)]
        solved = over(root, np.column_stack([coupling, images.gradient[by_arm]]))
        return RigsGivenCameras(solved[:, :-1], solved[:, -1], inverse_of(root))

    @property
    def arm_unknowns(self) -> int:
        """X and base_from_world of each arm, and one scale: 12 a + 1."""
        return 12 * len(self.arms) + 1


@dataclass(frozen=True)
class ReportedPoses:
    """The residuals of the reported poses of all arms, linear about where everything is; n poses, s = 6n."""

    residual: Float[ndarray, " s"]
    jacobian: Float[ndarray, "s u"]
    """By the arms' unknowns."""
    by_rig: Float[ndarray, "n 6 6"]
    """Of each pose by a step of its rig."""


def reported_poses(placed: Placed, arms: Sequence[ArmPoses]) -> ReportedPoses:
    """The reported poses of these arms."""
    unknowns, begin, parts = 12 * len(arms) + 1, 0, list[tuple[ndarray, ndarray]]()
    jacobian = np.zeros((6 * sum(len(arm.rigs) for arm in arms), unknowns))
    for k, arm in enumerate(arms):
        at, rigs = (placed.x[k], placed.scale, placed.z[k]), placed.scene.world_from_rig[arm.rigs]
        residual, by_unknown = residuals(*at, arm.base_from_gripper, rigs, arm.exchanged)
        rows = np.arange(begin, begin := begin + residual.size)
        # X, then the scale that all arms share, then Z.
        columns = np.insert(columns_of_arm(k), 6, SCALE.start)
        jacobian[rows[:, None], columns] = by_unknown.reshape(-1, UNKNOWNS)
        parts.append((residual.ravel(), residuals_by_camera(*at, rigs, arm.exchanged)))
    residual, by_rig = (np.concatenate(part) for part in zip(*parts, strict=True))
    return ReportedPoses(residual, jacobian, by_rig)


def equations_of(placed: Placed, given: Given) -> tuple[Equations, Region]:
    """Residuals of the reported gripper poses, linear in all unknowns; what the images show of the rigs is in them."""
    images, free, rigs, robots = given.evidence, given.free, given.rigs, given.arm_unknowns
    poses = reported_poses(placed, given.arms)
    coupling = images.information[np.ix_(given.by_arm, free)]
    known = pose_by_pose(poses.by_rig, pose_by_pose(poses.by_rig, rigs.covariance).T)
    of_free = images.information[np.ix_(free, free)] - coupling.T @ rigs.follow
    region = Region.of_unknowns(np.delete(poses.jacobian, SCALE, axis=1), robots + len(free))
    by_free = -pose_by_pose(poses.by_rig, rigs.follow)
    information, gradient = _of_lengths(placed, given)
    equations = Equations(
        residual=poses.residual - pose_by_pose(poses.by_rig, rigs.step[:, None])[:, 0],
        jacobian=np.concatenate([poses.jacobian, by_free], axis=1),
        prior_information=np.asarray(block_diag(weak_prior(len(given.arms)), (of_free + of_free.T) / 2))
        + information,
        prior_gradient=np.r_[np.zeros(robots), images.gradient[free] - coupling.T @ rigs.step] + gradient,
        known=(known + known.T) / 2,
        systematic=region.left(np.asarray(block_diag(*(arm.systematic for arm in given.arms)))),
        given=given.noise,
        bent=_bent(given.arms, region),
    )
    return equations, region


def size_of_boards(placed: Placed, given: Given) -> tuple[float, Float[ndarray, " p"]]:
    """Logarithm of the metres, by the scale, that a metre of the boards is as stated; and its derivative by the unknowns
    of the mixed model."""
    problem = given.evidence.problem
    boards, column = problem.observations.boards, problem.freedom.board_columns.start
    assert boards is not None
    by_unknown = np.zeros(given.arm_unknowns + len(given.free))
    by_unknown[SCALE] = by_unknown[given.arm_unknowns + int(np.searchsorted(given.free, column))] = 1.0
    return float(np.log(placed.scale * boards.unit) + placed.scene.camera_steps[column]), by_unknown


def _of_lengths(placed: Placed, given: Given) -> tuple[Float[ndarray, "p p"], Float[ndarray, " p"]]:
    """Information and gradient of the lengths that are known."""
    unknowns = given.arm_unknowns + len(given.free)
    information, gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    for length in given.lengths:
        log_scale, by_unknown = float(np.log(placed.scale)), np.zeros(unknowns)
        by_unknown[SCALE] = 1.0
        if length.of_boards:
            log_scale, by_unknown = size_of_boards(placed, given)
        information += np.outer(by_unknown, by_unknown) / length.std**2
        gradient += by_unknown * (log_scale - length.log_scale) / length.std**2
    return information, gradient


def _bent(arms: Sequence[ArmPoses], region: Region) -> Float[ndarray, "s s"] | None:
    """Covariance of what the errors that were found leave in the poses of all arms; None where none were."""
    if all(arm.bent is None for arm in arms):
        return None
    each = [np.zeros((6 * len(arm.rigs), 0)) if arm.bent is None else arm.bent for arm in arms]
    columns = np.asarray(block_diag(*each))
    return region.left(columns @ columns.T)


def after_step(placed: Placed, step: Float[ndarray, " p"], given: Given) -> Placed:
    """Everything after a step of the unknowns of the mixed model: X, log scale, base of the first arm; X and base of
    others; then the `free` ones."""
    own = np.stack([step[columns_of_arm(arm)] for arm in range(len(placed.x))])
    of_images = np.zeros(len(given.evidence.gradient))
    of_images[given.free] = step[given.arm_unknowns :]
    freedom = given.evidence.problem.freedom
    return Placed(
        x=retract(placed.x, own[:, :6]),
        scale=float(placed.scale * np.exp(step[6])),
        z=retract(placed.z, own[:, 6:]),
        scene=stepped(placed.scene, freedom, of_images) if of_images.any() else placed.scene,
    )
