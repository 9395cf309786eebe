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
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.linalg import block_diag, cho_factor, cho_solve, solve_triangular

from jcr.adjust.acceleration import Acceleration
from jcr.adjust.elimination import Normal
from jcr.adjust.images import (
    SIZES_SETTLED,
    ImageEvidence,
    ImageProblem,
    RigInformation,
    cost,
    evidence,
    linearised,
    minimised,
    noise_of,
    posed,
    similarity_held,
    view_of,
    with_model_error_of,
)
from jcr.adjust.model_error import expressed, polynomials_of
from jcr.adjust.pixel_noise import PixelNoise
from jcr.adjust.scene import Freedom, Observations, Scene, similarities_of_rigs, stepped, with_freedom
from jcr.geometry import inverse, retract, skew, step_between
from jcr.handeye.components import most_likely
from jcr.handeye.equation import PRIOR_STD, SCALE, Poses, predict, residuals, residuals_by_camera
from jcr.handeye.equation import UNKNOWNS as POSES
from jcr.handeye.mixed_model import Equations, left_out, solve
from jcr.handeye.posterior import posterior
from jcr.handeye.systematic import Region
from jcr.least_squares import one_blas_thread
from jcr.records import Budget, ModelError

START_NOISE = (1e-3, np.radians(0.2))
"""m, rad; of gripper poses, until it is estimated."""
ROUNDS = 25
"""Of an adjustment, with the sizes of errors estimated in each."""
STEP_SETTLED = 0.01
"""Standard deviations that an arm's unknown moves by in a round that ends them."""
ROUNDING = 1e-9
"""Of a cost."""
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
        missed, _ = left_out(solve(self.equations, self.log_sizes), self.noise)
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


@dataclass(frozen=True)
class RigsGivenCameras:
    """What the images show of the rigs that arms move, with everything else of the scene where it is."""

    follow: Float[ndarray, "s e"]
    """By how much the rigs step back with each free column."""
    step: Float[ndarray, " s"]
    """To where they are likeliest, with the sign reversed."""
    covariance: Float[ndarray, "s s"]


@dataclass(frozen=True, kw_only=True)
class Given:
    """What the mixed model of a scene is made of."""

    evidence: ImageEvidence
    arms: tuple[ArmPoses, ...]
    noise: tuple[float, float] | None
    """m, rad: of the gripper poses, at least."""

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
        own = images.information[np.ix_(by_arm, by_arm)]
        size = 1 / np.sqrt(own.diagonal())
        factor = cho_factor(size[:, None] * own * size, lower=True)
        coupling = images.information[np.ix_(by_arm, free)]
        solved = size[:, None] * cho_solve(
            factor, size[:, None] * np.column_stack([coupling, images.gradient[by_arm], np.diag(1 / size)])
        )
        return RigsGivenCameras(
            solved[:, : len(free)], solved[:, len(free)], solved[:, len(free) + 1 :] * size
        )


@one_blas_thread
def adjust(
    scene: Scene,
    observations: Observations,
    freedom: Freedom,
    arms: Sequence[ArmPoses],
    noise: tuple[float, float] | None = None,
    prior: RigInformation | None = None,
    near: Adjusted | None = None,
) -> Adjusted:
    """Adjust images and robots from a scene that is near.

    Points that fewer than two images see are left out. `noise` (m, rad) is that of the gripper poses, at least; it is
    estimated with the rest, and all arms are taken to be equally exact. `prior` is what others than the images and the
    robots know of the first rigs. `near` is an adjustment of the same rigs, points and arms in which other things were
    free, or in which more points took part: it begins from there, and of the scene the numbers count alone.
    """
    scene, problem = posed(scene, observations, freedom, prior)
    if near is not None:
        return _settled(*_begun(near, problem), tuple(arms), noise, near.log_sizes)
    placed = Placed(
        x=np.stack([arm.start[0] for arm in arms]),
        scale=1.0,
        z=np.stack([arm.start[1] for arm in arms]),
        scene=scene,
    )
    white = np.tile(np.repeat(noise or START_NOISE, 3) ** 2.0, sum(len(arm.rigs) for arm in arms))
    pixels = noise_of(scene, view_of(scene, problem), problem)
    scene, *_ = minimised(scene, problem, pixels, _rig_information(placed, arms, np.diag(white)))
    return _settled(replace(placed, scene=scene), problem, pixels, tuple(arms), noise)


def _begun(near: Adjusted, problem: ImageProblem) -> tuple[Placed, ImageProblem, PixelNoise]:
    """Everything where an adjustment put it, as far as the freedom of another problem lets it be there."""
    before, scene = near.given.evidence.problem, near.placed.scene
    sizes = before.freedom.model_error_std
    if len(sizes) == len(problem.freedom.model_error_std):
        problem = problem.with_model_error(sizes)
    points = scene.points_in_world[np.searchsorted(before.points, problem.points)]
    scene = with_freedom(replace(scene, points_in_world=points), before.freedom, problem.freedom)
    return replace(near.placed, scene=scene), problem, near.given.evidence.noise


def _settled(
    placed: Placed,
    problem: ImageProblem,
    pixels: PixelNoise,
    arms: tuple[ArmPoses, ...],
    noise: tuple[float, float] | None,
    log_sizes: Float[ndarray, " c"] | None = None,
) -> Adjusted:
    """Everything moved at once, and the sizes of errors estimated, in turn until they stay."""
    start, acceleration = placed, Acceleration()
    for _ in range(ROUNDS):
        before, freedom, view = pixels, problem.freedom, view_of(placed.scene, problem)
        pixels = noise_of(placed.scene, view, problem, before)
        images, normal = linearised(placed.scene, view, problem, pixels)
        images, resized = with_model_error_of(images)
        problem, given = images.problem, Given(evidence=images, arms=arms, noise=noise)
        together = _Together.of(placed, given, log_sizes)
        change = np.inf if log_sizes is None else float(np.abs(together.log_sizes - log_sizes).max())
        log_sizes = together.log_sizes
        if max(change, resized, pixels.change(before)) < SIZES_SETTLED and together.size < STEP_SETTLED:
            break
        moved = together.moved(placed, normal)
        if together.cost(moved) <= together.cost(placed) * (1 + ROUNDING):
            begun, ended = _from(start, placed, freedom), _from(start, moved, problem.freedom)
            weight = np.zeros(len(begun))
            weight[np.r_[: len(together.arms), len(together.arms) + given.free]] = 1 / together.std
            placed, problem = _at(start, acceleration.next(begun, ended, weight), given)
        else:
            placed = together.damped(placed)
            acceleration.forget()
    else:
        given = Given(evidence=evidence(placed.scene, problem, pixels), arms=arms, noise=noise)
    return tied(given, placed, log_sizes)


@dataclass(frozen=True, kw_only=True)
class _Together:
    """One Gauss-Newton step of everything: arms, cameras, rigs and points."""

    given: Given
    log_sizes: Float[ndarray, " c"]
    """Of the robots' errors, most likely."""
    arms: Float[ndarray, " u"]
    columns: Float[ndarray, " d"]
    """Of the step, in the order of the evidence."""
    std: Float[ndarray, " p"]
    """Of the arms' unknowns and of what is free beside them."""
    factor: Float[ndarray, "s s"]
    """Lower Cholesky factor of the covariance of the reported poses."""

    @staticmethod
    def of(placed: Placed, given: Given, log_sizes: Float[ndarray, " c"] | None) -> "_Together":
        """Where everything is now."""
        equations, _ = equations_of(placed, given)
        log_sizes, _ = most_likely(equations, log_sizes, SIZES_SETTLED / 3)
        solution, rigs = solve(equations, log_sizes), given.rigs
        robots, step = _of_robots(given.arms), solution.step
        # The rigs go where the images put them beside the cameras, and as far to the reported poses as these weigh.
        left = cho_solve((solution.root, True), equations.residual + equations.jacobian @ step)
        by_rig = of_poses(placed, given.arms)[2]
        columns = np.zeros(len(given.evidence.gradient))
        columns[given.free] = step[robots:]
        columns[given.by_arm] = -rigs.step - rigs.follow @ step[robots:] - rigs.covariance @ (by_rig.T @ left)
        return _Together(
            given=given,
            log_sizes=log_sizes,
            arms=step[:robots],
            columns=columns,
            std=np.sqrt(solution.covariance.diagonal()),
            factor=np.linalg.cholesky(replace(equations, known=None).covariance(log_sizes)),
        )

    @property
    def size(self) -> float:
        """The largest step of an arm's unknown, in standard deviations."""
        return float(np.abs(self.arms / self.std[: len(self.arms)]).max())

    def moved(self, placed: Placed, normal: Normal) -> Placed:
        """Everything after the step; `normal` steps the points."""
        share = _share_of(self.arms)
        problem = self.given.evidence.problem
        scene = stepped(placed.scene, problem.freedom, share * self.columns)
        points = normal.stepped(placed.scene.points_in_world, share * self.columns)
        arms = np.r_[share * self.arms, np.zeros(len(self.given.free))]
        return replace(_moved(placed, arms, self.given), scene=replace(scene, points_in_world=points))

    def cost(self, placed: Placed) -> float:
        """Of a place, with weights and sizes of errors as they are at the start of the step."""
        images = self.given.evidence
        problem, view = images.problem, images.view
        weight = images.noise.weights(view.residual_px, view.depth, problem.layout)
        held = [] if problem.prior is None else [problem.prior]
        residual = of_poses(placed, self.given.arms)[0]
        of_robots = float((solve_triangular(self.factor, residual, lower=True) ** 2).sum())
        return of_robots + cost(placed.scene, view_of(placed.scene, problem), problem, weight, held)

    def damped(self, placed: Placed) -> Placed:
        """Images beside what the reported poses know of the rigs, and then the arms, where a whole step is too long."""
        images = self.given.evidence
        robots = _rig_information(placed, self.given.arms, self.factor @ self.factor.T)
        scene, *_ = minimised(placed.scene, images.problem, images.noise, robots)
        given = replace(self.given, evidence=evidence(scene, images.problem, images.noise))
        return _most_likely(replace(placed, scene=scene), given, self.log_sizes, STEP_SETTLED**2)[0]


def _share_of(step: Float[ndarray, " p"]) -> float:
    """Of a step of the arms' unknowns that rotates nothing too far."""
    return min(1.0, LARGEST_ROTATION / max(float(np.abs(step[_rotations(len(step))]).max()), 1e-300))


def tied(given: Given, placed: Placed, log_sizes: Float[ndarray, " c"] | None = None) -> Adjusted:
    """Evidence and arms together, averaged over the sizes of the robots' errors, from a place that is near."""
    placed, log_sizes = _most_likely(placed, given, log_sizes, 1e-12)
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
) -> tuple[Placed, Float[ndarray, " c"]]:
    """The arms' unknowns at the likeliest sizes of errors, to a step of less than `settled` squared standard
    deviations."""
    robots = _of_robots(given.arms)
    for _ in range(STEPS):
        equations, _ = equations_of(placed, given)
        log_sizes, _ = most_likely(equations, log_sizes, SIZES_SETTLED / 3)
        solution = solve(equations, log_sizes)
        step = np.r_[solution.step[:robots], np.zeros(len(given.free))]
        step *= _share_of(step[:robots])
        placed = _moved(placed, step, given)
        if float(((solution.information_root.T @ step) ** 2).sum()) < settled:
            break
    assert log_sizes is not None
    return placed, log_sizes


def _of_robots(arms: Sequence[ArmPoses]) -> int:
    """Unknowns of the arms: X and base_from_world of each, one scale."""
    return 12 * len(arms) + 1


def _columns(arm: int) -> Int[ndarray, "12"]:
    """Of an arm's X and base among the unknowns."""
    return np.delete(np.arange(POSES), SCALE) if arm == 0 else np.arange(1 + 12 * arm, POSES + 12 * arm)


def _rotations(unknowns: int) -> Int[ndarray, " r"]:
    """Rotations among the unknowns of arms, and the scale."""
    arms = (unknowns - 1) // 12
    return np.r_[SCALE, *(_columns(arm)[[3, 4, 5, 9, 10, 11]] for arm in range(arms))]


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


def equations_of(placed: Placed, given: Given) -> tuple[Equations, Region]:
    """Residuals of the reported gripper poses, linear in all unknowns; what the images show of the rigs is in them."""
    images, free = given.evidence, given.free
    residual, jacobian, by_rig, systematic = of_poses(placed, given.arms)
    rigs = given.rigs
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
            residual=residual - by_rig @ step,
            jacobian=np.concatenate([jacobian, -by_rig @ follow], axis=1),
            prior_information=(prior + prior.T) / 2,
            prior_gradient=gradient,
            known=(known + known.T) / 2,
            systematic=region.left(systematic),
            given=given.noise,
            bent=_bent(given.arms, region),
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


def _from(start: Placed, placed: Placed, freedom: Freedom) -> Float[ndarray, " n"]:
    """How far everything is from where it started: the arms' unknowns, the columns of the evidence, points, and the
    logarithm of the size of what cameras' models leave."""
    own = np.concatenate([step_between(start.x, placed.x), step_between(start.z, placed.z)], axis=1)
    arms = np.zeros(1 + own.size)
    arms[SCALE] = np.log(placed.scale / start.scale)
    for arm, step in enumerate(own):
        arms[_columns(arm)] = step
    before, scene = start.scene, placed.scene
    columns = np.zeros(freedom.first_rig)
    columns[: len(freedom.std)] = scene.camera_steps - before.camera_steps
    mounts = step_between(before.rig_from_camera, scene.rig_from_camera)
    columns[len(freedom.std) :] = mounts[freedom.mounts].ravel()
    rigs = step_between(before.world_from_rig, scene.world_from_rig)
    points = scene.points_in_world - before.points_in_world
    return np.concatenate([arms, columns, rigs.ravel(), points.ravel(), np.log(freedom.model_error_std[:1])])


def _at(start: Placed, away: Float[ndarray, " n"], given: Given) -> tuple[Placed, ImageProblem]:
    """Everything so far from where it started, and the problem with that size of what cameras' models leave."""
    problem = given.evidence.problem
    freedom = problem.freedom
    ends = np.cumsum([_of_robots(given.arms), len(given.evidence.gradient), start.scene.points_in_world.size])
    arms, columns, points, size = np.split(away, ends)
    scene = stepped(start.scene, freedom, columns)
    scene = replace(scene, points_in_world=scene.points_in_world + points.reshape(-1, 3))
    placed = _moved(start, np.r_[arms, np.zeros(len(given.free))], given)
    resized = np.repeat(np.exp(size), len(freedom.model_error_std))
    return replace(placed, scene=scene), problem.with_model_error(resized)


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
