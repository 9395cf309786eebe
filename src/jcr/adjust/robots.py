"""Images and robots together: what the images show of the rigs, tied to the arms that moved them.

The rigs that an arm moves obey `base_from_gripper[i] · X = base_from_world · S_λ(world_from_rig[i])`
(handeye/equation.py), with one X and one base_from_world an arm and one λ for the whole scene. Where the camera stands
fixed and what it sees is carried by the gripper, the roles are exchanged: the world is the carried thing, and the
equation is that of the inverse poses, with base_from_camera in place of X and gripper_from_world in place of
base_from_world; the errors are still those of the reported poses. Every other transform of a cell follows from these
and from what the images show.

The images' evidence enters the mixed model of handeye/components.py as camera poses do. While the images are adjusted,
the reported poses hold the rigs as far as their errors, estimated in between, let them: what they know once X, λ and
base_from_world are eliminated. The evidence is then what the images show without that.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.linalg import block_diag, cho_factor, cho_solve

from jcr.adjust.images import (
    ROUNDS,
    SIZES_SETTLED,
    ImageEvidence,
    RigInformation,
    evidence,
    minimised,
    noise_of,
    posed,
    similarity_held,
    view_of,
    with_model_error_of,
)
from jcr.adjust.model_error import expressed, polynomials_of
from jcr.adjust.scene import Freedom, Observations, Scene, similarities_of_rigs, stepped
from jcr.geometry import inverse, retract, skew, step_between
from jcr.handeye.components import POSES, Equations, most_likely, posterior, solve
from jcr.handeye.equation import PRIOR_STD, SCALE, Poses, predict, residuals, residuals_by_camera
from jcr.handeye.fit import left_out
from jcr.handeye.systematic import Region
from jcr.least_squares import one_blas_thread
from jcr.records import Budget, ModelError

START_NOISE = (1e-3, np.radians(0.2))
"""m, rad; of gripper poses, until it is estimated."""
STEP_SETTLED = 1e-4
"""Squared standard deviations that the arms' unknowns move by in a round, or a step, that ends them."""
STEPS = 30
LARGEST_ROTATION = 0.5
"""rad, and of the logarithm of scale, in one step."""
TINY_STEP = 1e-6
"""m, rad, or standard deviations of what is small: for derivatives by differences."""


@dataclass(frozen=True, kw_only=True)
class ArmPoses:
    """The reported poses of one arm, and the rigs that it moves."""

    rigs: Int[ndarray, " n"]
    base_from_gripper: Poses
    systematic: Float[ndarray, "s s"]
    """Covariance of their systematic errors at 1 rad."""
    start: tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]]
    """X and the transform from the world, scaled, to the frame in which X is sought."""
    exchanged: bool = False
    """The camera stands still and the arm carries what it sees."""
    bent: Float[ndarray, "s b"] | None = None
    """Errors of one standard deviation each that were found of the poses (handeye/bent.py)."""


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
    """Of steps as `moved` takes them."""
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
    def noise(self) -> tuple[float, float]:
        """m, rad per axis: the robots' random errors."""
        sigma_t, sigma_r = np.sqrt(self.equations.variances(self.log_sizes)[:2]).tolist()
        return sigma_t, sigma_r

    @property
    def systematic(self) -> float:
        """rad: size of the robots' systematic errors."""
        return float(np.sqrt(self.equations.variances(self.log_sizes)[2]))

    @property
    def systematic_left(self) -> tuple[float, float]:
        """m, rad per axis: what of these is left in the poses."""
        return self.equations.systematic_left(self.log_sizes)

    @property
    def first_camera_column(self) -> int:
        """Columns before it are those of the arms, from it on those of `given.free`."""
        return _of_robots(self.given.arms)

    def leave_one_out(self) -> Float[ndarray, "m 6"]:
        """Steps from the reported to the adjusted gripper poses (m, rad), each by an adjustment without that pose."""
        missed, _ = left_out(self.equations, solve(self.equations, self.log_sizes), self.noise)
        return missed

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

    def moved(self, step: Float[ndarray, " p"]) -> Placed:
        """Everything after a step: X, log scale, base of the first arm; X and base of others; then the `free` ones."""
        return _moved(self.placed, step, self.given)

    def transform(
        self, of: Callable[[Placed], Float[ndarray, "4 4"]]
    ) -> tuple[Float[ndarray, "4 4"], Float[ndarray, "6 6"]]:
        """A transform that follows from where everything is, and the covariance of its step."""
        found, j = of(self.placed), self.derivative(of)
        return found, j @ self.covariance @ j.T

    def derivative(self, of: Callable[[Placed], Float[ndarray, "4 4"]]) -> Float[ndarray, "6 p"]:
        """Of the step of such a transform."""
        found = of(self.placed)
        size = TINY_STEP * np.ones(len(self.covariance))
        std = np.sqrt(np.diag(self.covariance))
        cameras = self.first_camera_column
        size[cameras:] = np.minimum(1e-2 * std[cameras:], 1e-2) + 1e-9
        j = np.empty((6, len(size)))
        for k, small in enumerate(size):
            step = np.zeros(len(size))
            step[k] = small
            ahead, behind = of(self.moved(step)), of(self.moved(-step))
            j[:, k] = (step_between(found, ahead) - step_between(found, behind)) / (2 * small)
        return j


@dataclass(frozen=True, kw_only=True)
class Given:
    """What the mixed model of a scene is made of."""

    evidence: ImageEvidence
    arms: tuple[ArmPoses, ...]
    noise: tuple[float, float] | None
    """m, rad: of the gripper poses, at least."""

    @property
    def by_arm(self) -> Int[ndarray, " s"]:
        """Columns of the evidence: rigs that arms move, in the order of the residuals."""
        moving = np.concatenate([arm.rigs for arm in self.arms])
        return (self.evidence.problem.freedom.first_rig + 6 * moving[:, None] + np.arange(6)).ravel()

    @property
    def free(self) -> Int[ndarray, " e"]:
        """Columns of the evidence that are unknowns here: cameras, mounts, and rigs that no arm moves."""
        return np.setdiff1d(np.arange(len(self.evidence.gradient)), self.by_arm)


@one_blas_thread
def adjust(
    scene: Scene,
    observations: Observations,
    freedom: Freedom,
    arms: Sequence[ArmPoses],
    noise: tuple[float, float] | None = None,
    prior: RigInformation | None = None,
    scale: float = 1.0,
) -> Adjusted:
    """Adjust images and robots from a scene that is near.

    Points that fewer than two images see are left out. `noise` (m, rad) is that of the gripper poses, at least; it is
    estimated with the rest, and all arms are taken to be equally exact. `prior` is what others than the images and the
    robots know of the first rigs. `scale` is about that of the scene (metres per unit).
    """
    scene, problem = posed(scene, observations, freedom, prior)
    placed = Placed(
        x=np.stack([arm.start[0] for arm in arms]),
        scale=1.0,
        z=np.stack([arm.start[1] for arm in arms]),
        scene=scene,
    )
    white = np.tile(np.repeat(noise or START_NOISE, 3) ** 2.0, sum(len(arm.rigs) for arm in arms))
    robots = _rig_information(placed, arms, np.diag(white))
    pixels, damping, log_sizes = noise_of(scene, view_of(scene, problem), problem), 1e-4, None
    given = Given(evidence=evidence(scene, problem, pixels), arms=tuple(arms), noise=noise)
    for _ in range(ROUNDS):
        before = pixels, log_sizes
        scene, view, damping = minimised(placed.scene, problem, pixels, robots, damping)
        pixels = noise_of(scene, view, problem, pixels)
        images, resized = with_model_error_of(evidence(scene, problem, pixels))
        problem, given = images.problem, replace(given, evidence=images)
        placed, log_sizes, moved = _most_likely(replace(placed, scene=scene), given, log_sizes, STEP_SETTLED)
        equations, _ = equations_of(placed, given)
        robots = _rig_information(placed, arms, replace(equations, known=None).covariance(log_sizes))
        change = np.inf if before[1] is None else float(np.abs(log_sizes - before[1]).max())
        if max(change, resized, pixels.change(before[0])) < SIZES_SETTLED and moved < STEP_SETTLED:
            break
    return tied(given, placed, log_sizes)


def tied(given: Given, placed: Placed, log_sizes: Float[ndarray, " c"] | None = None) -> Adjusted:
    """Evidence and arms together, averaged over the sizes of the robots' errors, from a place that is near."""
    placed, log_sizes, _ = _most_likely(placed, given, log_sizes, 1e-12)
    equations, region = equations_of(placed, given)
    log_sizes, information = most_likely(equations, log_sizes)
    found = posterior(equations, log_sizes, information, region)
    return Adjusted(
        placed=_moved(placed, found.step, given),
        covariance=found.covariance,
        budget=found.budget,
        most_likely=placed,
        log_sizes=log_sizes,
        equations=equations,
        given=given,
    )


def _most_likely(
    placed: Placed, given: Given, log_sizes: Float[ndarray, " c"] | None, settled: float
) -> tuple[Placed, Float[ndarray, " c"], float]:
    """The arms' unknowns at the likeliest sizes of errors, and how far they moved in squared standard deviations.

    It ends with a step of less than `settled` of these.
    """
    robots, total = _of_robots(given.arms), 0.0
    rotations = np.r_[SCALE, *(_columns(arm)[[3, 4, 5, 9, 10, 11]] for arm in range(len(given.arms)))]
    for _ in range(STEPS):
        equations, _ = equations_of(placed, given)
        log_sizes, _ = most_likely(equations, log_sizes, SIZES_SETTLED / 3)
        solution = solve(equations, log_sizes)
        step = np.r_[solution.step[:robots], np.zeros(len(given.free))]
        step *= min(1.0, LARGEST_ROTATION / max(float(np.abs(step[rotations]).max()), 1e-300))
        placed = _moved(placed, step, given)
        moved = float(((solution.information_root.T @ step) ** 2).sum())
        total += moved
        if moved < settled:
            break
    assert log_sizes is not None
    return placed, log_sizes, total


def _of_robots(arms: Sequence[ArmPoses]) -> int:
    """Unknowns of the arms: X and base_from_world of each, one scale."""
    return 12 * len(arms) + 1


def _columns(arm: int) -> Int[ndarray, "12"]:
    """Of an arm's X and base among the unknowns."""
    return np.delete(np.arange(POSES), SCALE) if arm == 0 else np.arange(1 + 12 * arm, POSES + 12 * arm)


def of_poses(
    placed: Placed, arms: Sequence[ArmPoses]
) -> tuple[Float[ndarray, " s"], Float[ndarray, "s u"], Float[ndarray, "s s"], Float[ndarray, "s s"]]:
    """Residuals of the reported poses, their derivatives by the arms' unknowns and by the rigs, and the covariance of
    systematic errors at 1 rad."""
    rows, begin = 6 * sum(len(arm.rigs) for arm in arms), 0
    residual, jacobian = np.zeros(rows), np.zeros((rows, _of_robots(arms)))
    by_rig, systematic = np.zeros((rows, rows)), np.zeros((rows, rows))
    for k, arm in enumerate(arms):
        rigs = placed.scene.world_from_rig[arm.rigs]
        x, z = placed.x[k], placed.z[k]
        reported = inverse(arm.base_from_gripper) if arm.exchanged else arm.base_from_gripper
        of_arm, by_unknown = residuals(x, placed.scale, z, reported, rigs)
        by_its_rig = residuals_by_camera(x, placed.scale, z, rigs)
        if arm.exchanged:
            predicted = predict(x, placed.scale, z, rigs)
            of_arm = step_between(arm.base_from_gripper, inverse(predicted))
            by_unknown, by_its_rig = (_by_inverse(predicted) @ part for part in (by_unknown, by_its_rig))
        size = 6 * len(arm.rigs)
        mine = slice(begin, begin + size)
        residual[mine] = of_arm.ravel()
        flat = by_unknown.reshape(size, POSES)
        jacobian[mine, SCALE] = flat[:, SCALE]
        jacobian[mine, _columns(k)] = np.delete(flat, SCALE, axis=1)
        for n, own in enumerate(by_its_rig):
            at = slice(begin + 6 * n, begin + 6 * n + 6)
            by_rig[at, at] = own
        systematic[mine, mine] = arm.systematic
        begin += size
    return residual, jacobian, by_rig, systematic


def _prior(arms: Sequence[ArmPoses]) -> Float[ndarray, "u u"]:
    """Information that keeps finite what the motions cannot see of the arms' unknowns."""
    prior = np.zeros((_of_robots(arms), _of_robots(arms)))
    prior[range(7), range(7)] = PRIOR_STD**-2.0
    for k in range(1, len(arms)):
        own = _columns(k)[:6]
        prior[own, own] = PRIOR_STD[:6] ** -2.0
    return prior


@dataclass(frozen=True)
class RigsGivenCameras:
    """What the images show of the rigs that arms move, with everything else of the scene where it is."""

    follow: Float[ndarray, "s e"]
    """By how much the rigs step back with each free column."""
    step: Float[ndarray, " s"]
    """To where they are likeliest, with the sign reversed."""
    covariance: Float[ndarray, "s s"]


def rigs_given_cameras(given: Given) -> RigsGivenCameras:
    """From the evidence of the images alone."""
    images, by_arm, free = given.evidence, given.by_arm, given.free
    own = images.information[np.ix_(by_arm, by_arm)]
    size = 1 / np.sqrt(own.diagonal())
    factor = cho_factor(size[:, None] * own * size, lower=True)
    coupling = images.information[np.ix_(by_arm, free)]
    solved = size[:, None] * cho_solve(
        factor, size[:, None] * np.column_stack([coupling, images.gradient[by_arm], np.diag(1 / size)])
    )
    return RigsGivenCameras(solved[:, : len(free)], solved[:, len(free)], solved[:, len(free) + 1 :] * size)


def equations_of(placed: Placed, given: Given) -> tuple[Equations, Region]:
    """Residuals of the reported gripper poses, linear in all unknowns; what the images show of the rigs is in them."""
    images, free = given.evidence, given.free
    residual, jacobian, by_rig, systematic = of_poses(placed, given.arms)
    rigs = rigs_given_cameras(given)
    follow, step = rigs.follow, rigs.step
    coupling = images.information[np.ix_(given.by_arm, free)]
    known = by_rig @ rigs.covariance @ by_rig.T
    robots = _of_robots(given.arms)
    count = robots + len(free)
    prior, gradient = np.zeros((count, count)), np.zeros(count)
    prior[:robots, :robots] = _prior(given.arms)
    prior[robots:, robots:] = images.information[np.ix_(free, free)] - coupling.T @ follow
    gradient[robots:] = images.gradient[free] - coupling.T @ step
    region = Region.of_unknowns(np.delete(jacobian, SCALE, axis=1), count)
    return (
        Equations(
            residual - by_rig @ step,
            np.concatenate([jacobian, -by_rig @ follow], axis=1),
            (prior + prior.T) / 2,
            gradient,
            (known + known.T) / 2,
            region.left(systematic),
            given.noise,
            _bent(given.arms, region),
        ),
        region,
    )


def _bent(arms: Sequence[ArmPoses], region: Region) -> Float[ndarray, "s s"] | None:
    """Covariance of what the errors that were found leave in the poses of all arms; None where none were."""
    if all(arm.bent is None for arm in arms):
        return None
    each = [np.zeros((6 * len(arm.rigs), 0)) if arm.bent is None else arm.bent for arm in arms]
    columns = np.asarray(block_diag(*each))
    return region.left(columns @ columns.T)


def _rig_information(
    placed: Placed, arms: Sequence[ArmPoses], covariance: Float[ndarray, "s s"]
) -> RigInformation:
    """What reported poses with errors of this covariance know of the rigs, X, scale and bases eliminated."""
    residual, jacobian, by_rig, _ = of_poses(placed, arms)
    factor = cho_factor(covariance, lower=True)
    weighed = cho_solve(factor, np.column_stack([jacobian, by_rig, residual]))
    u, s = jacobian.shape[1], len(residual)
    eliminated = np.linalg.solve(jacobian.T @ weighed[:, :u] + _prior(arms), jacobian.T @ weighed[:, u:])
    projected = weighed[:, u:] - weighed[:, :u] @ eliminated
    information, gradient = by_rig.T @ projected[:, :s], by_rig.T @ projected[:, s]
    count = 6 * len(placed.scene.world_from_rig)
    rows = (6 * np.concatenate([arm.rigs for arm in arms])[:, None] + np.arange(6)).ravel()
    of_all, gradient_of_all = np.zeros((count, count)), np.zeros(count)
    of_all[np.ix_(rows, rows)] = (information + information.T) / 2
    gradient_of_all[rows] = gradient
    now = placed.scene.world_from_rig
    of_all += similarity_held(similarities_of_rigs(now), float(of_all.diagonal().mean()))
    return RigInformation(now, of_all, gradient_of_all)


def _by_inverse(a_from_b: Poses) -> Float[ndarray, "n 6 6"]:
    """Matrices that take steps of transforms to those of their inverses."""
    rotation_t = np.swapaxes(a_from_b[:, :3, :3], 1, 2)
    out = np.zeros((len(a_from_b), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = -rotation_t
    out[:, :3, 3:] = -rotation_t @ skew(a_from_b[:, :3, 3])
    return out


def _moved(placed: Placed, step: Float[ndarray, " p"], given: Given) -> Placed:
    arms = len(placed.x)
    own = np.stack([step[_columns(arm)] for arm in range(arms)])
    of_images = np.zeros(len(given.evidence.gradient))
    of_images[given.free] = step[_of_robots(given.arms) :]
    freedom = given.evidence.problem.freedom
    return Placed(
        x=retract(placed.x, own[:, :6]),
        scale=float(placed.scale * np.exp(step[6])),
        z=retract(placed.z, own[:, 6:]),
        scene=stepped(placed.scene, freedom, of_images) if of_images.any() else placed.scene,
    )
