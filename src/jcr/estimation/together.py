"""Where images and robots together put everything: arms, cameras, rigs and points step at once.

In rounds: the sizes of the errors of pixels and poses are estimated, then everything takes one Gauss-Newton step, and
acceleration.py shortens the way. While only the images are adjusted, the reported poses keep the rigs as far as their
errors, estimated in between, let them: by what they show once X, λ and base_from_world are eliminated. The evidence is
then what the images show without that.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.acceleration import Acceleration
from jcr.estimation.cholesky import cholesky, inverse_of, lower, over
from jcr.estimation.components import most_likely
from jcr.estimation.elimination import Normal
from jcr.estimation.image_robots import (
    Adjusted,
    ArmPoses,
    Given,
    KnownLength,
    Placed,
    after_step,
    equations_of,
    reported_poses,
)
from jcr.estimation.images import (
    SIZES_SETTLED,
    cost_of_images,
    evidence,
    linearised,
    minimised,
    noise_of,
    posed,
    with_model_error_of,
)
from jcr.estimation.mixed_model import solve
from jcr.estimation.pixel_noise import PixelNoise
from jcr.estimation.pose_equations import SCALE, columns_of_arm, pose_by_pose, share_within_limits, weak_prior
from jcr.estimation.posterior import posterior
from jcr.estimation.projection import ImageProblem, view_of
from jcr.estimation.scene import (
    Freedom,
    Observations,
    RigInformation,
    Scene,
    information_along,
    similarities_of_rigs,
    stepped,
    with_freedom,
)
from jcr.geometry import step_between
from jcr.least_squares import one_blas_thread

START_NOISE = (1e-3, float(np.radians(0.2)))
"""m, rad; of gripper poses, until it is estimated."""
ROUNDS = 25
"""Of an adjustment, with the sizes of errors estimated in each."""
STEP_SETTLED = 0.01
"""Standard deviations that an arm's unknown moves by in a round that ends them."""
ROUNDING = 1e-9
"""Of a cost."""
STEPS = 30
ARMS_SETTLED = 1e-12
"""Squared standard deviations of a step of the arms alone that ends them."""


@one_blas_thread
def adjust(
    scene: Scene,
    observations: Observations,
    freedom: Freedom,
    arms: Sequence[ArmPoses],
    noise: tuple[float, float] | None = None,
    prior: RigInformation | None = None,
    near: Adjusted | None = None,
    start_noise: tuple[float, float] = START_NOISE,
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
    white = np.tile(np.repeat(noise or start_noise, 3), sum(len(arm.rigs) for arm in arms))
    pixels = noise_of(scene, view_of(scene, problem), problem)
    scene, *_ = minimised(scene, problem, pixels, [_rig_information(placed, arms, np.diag(white))])
    return _settled(replace(placed, scene=scene), problem, pixels, tuple(arms), noise)


def with_lengths(adjusted: Adjusted, lengths: Sequence[KnownLength]) -> Adjusted:
    """An adjustment beside which these lengths are known; the images' evidence stays what it is."""
    given = replace(adjusted.given, lengths=tuple(lengths))
    return _averaged(given, adjusted.most_likely, adjusted.log_sizes)


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
        moved = together.after(placed, normal)
        if together.cost(moved) <= together.cost(placed) * (1 + ROUNDING):
            begun, ended = _away(start, placed, freedom), _away(start, moved, problem.freedom)
            weight = np.zeros(len(begun))
            weight[np.r_[: given.arm_unknowns, given.arm_unknowns + given.free]] = 1 / together.std
            placed, problem = _back(start, acceleration.next(begun, ended, weight), given)
        else:
            placed = together.damped(placed)
            acceleration.forget()
    else:
        given = Given(evidence=evidence(placed.scene, problem, pixels), arms=arms, noise=noise)
    return _averaged(given, placed, log_sizes)


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
    root: Float[ndarray, "s s"]
    """Lower Cholesky factor of the covariance of the reported poses."""

    @staticmethod
    def of(placed: Placed, given: Given, log_sizes: Float[ndarray, " c"] | None) -> "_Together":
        """Where everything is now."""
        equations, _ = equations_of(placed, given)
        log_sizes, _ = most_likely(equations, log_sizes, SIZES_SETTLED / 3)
        solution, rigs = solve(equations, log_sizes), given.rigs
        robots, step = given.arm_unknowns, solution.step
        # The rigs go where the images put them beside the cameras, and as far to the reported poses as these weigh.
        by_rig = reported_poses(placed, given.arms).by_rig
        pull = pose_by_pose(np.swapaxes(by_rig, 1, 2), solution.weighed_left[:, None])[:, 0]
        columns = np.zeros(len(given.evidence.gradient))
        columns[given.free] = step[robots:]
        columns[given.by_arm] = -rigs.step - rigs.follow @ step[robots:] - rigs.covariance @ pull
        return _Together(
            given=given,
            log_sizes=log_sizes,
            arms=step[:robots],
            columns=columns,
            std=np.sqrt(solution.covariance.diagonal()),
            root=cholesky(replace(equations, known=None).covariance(log_sizes)),
        )

    @property
    def size(self) -> float:
        """The largest step of an arm's unknown, in standard deviations."""
        return float(np.abs(self.arms / self.std[: len(self.arms)]).max())

    def after(self, placed: Placed, normal: Normal) -> Placed:
        """Everything after the step; `normal` steps the points."""
        share, problem = share_within_limits(self.arms), self.given.evidence.problem
        scene = stepped(placed.scene, problem.freedom, share * self.columns)
        points = normal.stepped(placed.scene.points_in_world, share * self.columns)
        step = np.r_[share * self.arms, np.zeros(len(self.given.free))]
        return replace(after_step(placed, step, self.given), scene=replace(scene, points_in_world=points))

    def cost(self, placed: Placed) -> float:
        """Of a place, with weights and sizes of errors as they are at the start of the step."""
        residual = reported_poses(placed, self.given.arms).residual
        of_robots = float((lower(self.root, residual[:, None]) ** 2).sum())
        return of_robots + cost_of_images(placed.scene, self.given.evidence)

    def damped(self, placed: Placed) -> Placed:
        """Images beside what the reported poses show of the rigs, and then the arms, where a whole step is too long."""
        images = self.given.evidence
        robots = _rig_information(placed, self.given.arms, self.root)
        scene, *_ = minimised(placed.scene, images.problem, images.noise, [robots])
        given = replace(self.given, evidence=evidence(scene, images.problem, images.noise))
        return _most_likely_arms(replace(placed, scene=scene), given, self.log_sizes, STEP_SETTLED**2)[0]


def _averaged(given: Given, placed: Placed, log_sizes: Float[ndarray, " c"] | None) -> Adjusted:
    """Evidence and arms together, averaged over the sizes of the robots' errors, from a place that is near."""
    placed, log_sizes = _most_likely_arms(placed, given, log_sizes, ARMS_SETTLED)
    equations, region = equations_of(placed, given)
    log_sizes, information = most_likely(equations, log_sizes)
    found = posterior(equations, log_sizes, information, region)
    return Adjusted(
        placed=after_step(placed, found.step, given),
        covariance=found.covariance,
        budget=found.budget,
        most_likely=placed,
        log_sizes=log_sizes,
        equations=equations,
        given=given,
    )


def _most_likely_arms(
    placed: Placed, given: Given, log_sizes: Float[ndarray, " c"] | None, settled: float
) -> tuple[Placed, Float[ndarray, " c"]]:
    """The arms' unknowns at the likeliest sizes of errors, to a step of less than `settled` squared standard
    deviations."""
    robots = given.arm_unknowns
    for _ in range(STEPS):
        equations, _ = equations_of(placed, given)
        log_sizes, _ = most_likely(equations, log_sizes, SIZES_SETTLED / 3)
        solution = solve(equations, log_sizes)
        arms = share_within_limits(solution.step[:robots]) * solution.step[:robots]
        step = np.r_[arms, np.zeros(len(given.free))]
        placed = after_step(placed, step, given)
        if float(((solution.information_root.T @ step) ** 2).sum()) < settled:
            break
    assert log_sizes is not None
    return placed, log_sizes


def _rig_information(placed: Placed, arms: Sequence[ArmPoses], root: Float[ndarray, "s s"]) -> RigInformation:
    """What reported poses show of the rigs, X, scale and bases eliminated; `root` is the lower Cholesky factor of the
    covariance of their errors."""
    poses = reported_poses(placed, arms)
    weighed = over(root, poses.jacobian)
    eliminated = over(cholesky(poses.jacobian.T @ weighed + weak_prior(len(arms))), weighed.T)
    projection, to_rig = inverse_of(root) - weighed @ eliminated, np.swapaxes(poses.by_rig, 1, 2)
    information = pose_by_pose(to_rig, pose_by_pose(to_rig, projection).T)
    count = 6 * len(placed.scene.world_from_rig)
    rows = (6 * np.concatenate([arm.rigs for arm in arms])[:, None] + np.arange(6)).ravel()
    of_all, gradient = np.zeros((count, count)), np.zeros(count)
    of_all[np.ix_(rows, rows)] = (information + information.T) / 2
    gradient[rows] = pose_by_pose(to_rig, (projection @ poses.residual)[:, None])[:, 0]
    now = placed.scene.world_from_rig
    of_all += information_along(similarities_of_rigs(now), float(of_all.diagonal().mean()))
    return RigInformation(now, of_all, gradient)


def _away(start: Placed, placed: Placed, freedom: Freedom) -> Float[ndarray, " n"]:
    """How far everything is from where it started: the arms' unknowns, the columns of the evidence, points, and the
    logarithm of the size of what cameras' models leave."""
    own = np.concatenate([step_between(start.x, placed.x), step_between(start.z, placed.z)], axis=1)
    arms = np.zeros(1 + own.size)
    arms[SCALE] = np.log(placed.scale / start.scale)
    for arm, step in enumerate(own):
        arms[columns_of_arm(arm)] = step
    before, scene = start.scene, placed.scene
    columns = np.zeros(freedom.first_rig)
    columns[: len(freedom.std)] = scene.camera_steps - before.camera_steps
    mounts = step_between(before.rig_from_camera, scene.rig_from_camera)
    columns[len(freedom.std) :] = mounts[freedom.mounts].ravel()
    rigs = step_between(before.world_from_rig, scene.world_from_rig)
    points = scene.points_in_world - before.points_in_world
    return np.concatenate([arms, columns, rigs.ravel(), points.ravel(), np.log(freedom.model_error_std[:1])])


def _back(start: Placed, away: Float[ndarray, " n"], given: Given) -> tuple[Placed, ImageProblem]:
    """Everything so far from where it started, and the problem with that size of what cameras' models leave."""
    problem = given.evidence.problem
    freedom = problem.freedom
    ends = np.cumsum([given.arm_unknowns, len(given.evidence.gradient), start.scene.points_in_world.size])
    arms, columns, points, size = np.split(away, ends)
    scene = stepped(start.scene, freedom, columns)
    scene = replace(scene, points_in_world=scene.points_in_world + points.reshape(-1, 3))
    placed = after_step(start, np.r_[arms, np.zeros(len(given.free))], given)
    resized = np.repeat(np.exp(size), len(freedom.model_error_std))
    return replace(placed, scene=scene), problem.with_model_error(resized)
