"""Bundle adjustment of images, and what they alone show of their rigs and cameras: one similarity of the world is open.

Reprojection errors under a Cauchy loss, over intrinsics, nuisances of single images, mounts, rigs and points. Points are
eliminated (elimination.py); the rest is a small dense system, solved by Levenberg-Marquardt: least_squares.py without
that elimination would hold a matrix of thousands of points. Where the images are weak, what the robots report may hold
the rigs while everything moves (together.py); `evidence` is what is left without it, so that nothing counts twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.cholesky import cholesky, over
from jcr.estimation.elimination import Normal, with_fixed_points, without_points
from jcr.estimation.model_error import size_of
from jcr.estimation.pixel_noise import PixelNoise, common_share, left_of_points, pixel_noise, variance_ratios
from jcr.estimation.projection import (
    ImageProblem,
    View,
    by_points,
    derivatives,
    shape_information,
    shape_residuals,
    view_of,
)
from jcr.estimation.scene import (
    Freedom,
    Observations,
    RigInformation,
    Scene,
    at_start,
    information_along,
    similarities,
    similarities_of_rigs,
    stepped,
)
from jcr.geometry import apply, inverse, scale_translation
from jcr.least_squares import one_blas_thread

ROUNDS = 12
"""Of an adjustment, with the sizes of errors estimated in between."""
SIZES_SETTLED = 0.01
"""Relative change of the sizes of errors, of pixels and of robots, from one round to the next that ends them."""
ENOUGH = 1e-5
"""Of the cost, which is in squared standard deviations: what less than it would gain, nobody sees."""
STEPS = 60
START_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-10, 1e8
FAINT = 1e-6
"""Information that every column has (1/m², 1/rad²): an image that shows nothing is anywhere within a kilometre."""


@dataclass(frozen=True, kw_only=True)
class ImageEvidence:
    """What the images alone show, a normal distribution about a scene in the order of Freedom's columns."""

    scene: Scene
    problem: ImageProblem
    information: Float[ndarray, "d d"]
    """Priors of intrinsics and nuisances included; of the similarity as much as keeps it from being infinite, which is
    nothing beside what it is tied by."""
    gradient: Float[ndarray, " d"]
    """Of half the squared distance, at the scene."""
    noise: PixelNoise
    view: View

    @property
    def weight(self) -> Float[ndarray, " k"]:
        """Of each observation (1/px²)."""
        return self.noise.weights(self.view.residual_px, self.view.depth, self.problem.layout)

    def rig_covariance(self) -> Float[ndarray, "r r"]:
        """Of steps of the rigs, r = 6m, in the frame of the first and at one size of the world, everything else
        eliminated: those of the first rig are 0."""
        freedom, rigs = self.problem.freedom, self.scene.world_from_rig
        unseen, others = similarities(self.scene, freedom), slice(freedom.first_rig + 6, None)
        gauge = np.zeros((7, len(unseen)))
        gauge[:6, freedom.first_rig : others.start] = np.eye(6)
        gauge[6, freedom.first_rig :].reshape(-1, 6)[:, :3] = rigs[:, :3, 3] - rigs[0, :3, 3]
        to_gauge = (np.eye(len(unseen)) - unseen @ np.linalg.solve(gauge @ unseen, gauge))[others]
        covariance = np.zeros((6 * len(rigs), 6 * len(rigs)))
        covariance[6:, 6:] = to_gauge @ np.linalg.solve(self.information, to_gauge.T)
        return (covariance + covariance.T) / 2


@one_blas_thread
def adjust_images(scene: Scene, observations: Observations, freedom: Freedom) -> ImageEvidence:
    """Adjust images alone, from a scene that is near: the first rig stays where it is, depths keep their median.

    Points that fewer than two images see are left out.
    """
    scene, problem = posed(scene, observations, freedom)
    start, view = scene.world_from_rig, view_of(scene, problem)
    noise, depth, damping = noise_of(scene, view, problem), view.depth, START_DAMPING
    unseen = information_along(similarities_of_rigs(start), 1.0)
    world = RigInformation(start, unseen, np.zeros(len(unseen)))
    for _ in range(ROUNDS):
        before = noise
        scene, view, damping = minimised(scene, problem, noise, [world], damping)
        noise = noise_of(scene, view, problem, before)
        images, change = with_model_error_of(evidence(scene, problem, noise))
        problem = images.problem
        if max(noise.change(before), change) < SIZES_SETTLED:
            break
    unit = float(np.median(np.abs(depth / view.depth)))
    back = inverse(scale_translation(scene.world_from_rig[0], unit))
    steps = scene.camera_steps.copy()
    steps[problem.freedom.board_columns][:1] += np.log(unit)
    scene = replace(
        scene,
        camera_steps=steps,
        world_from_rig=start[0] @ back @ scale_translation(scene.world_from_rig, unit),
        rig_from_camera=scale_translation(scene.rig_from_camera, unit),
        points_in_world=apply(start[0] @ back, unit * scene.points_in_world),
    )
    return evidence(scene, problem, noise)


def posed(
    scene: Scene, observations: Observations, freedom: Freedom, prior: RigInformation | None = None
) -> tuple[Scene, ImageProblem]:
    """Where an adjustment starts: with the points that two or more observations show, and cameras where their priors
    have their middle."""
    problem = ImageProblem.of(scene, observations, freedom, prior)
    seen = replace(scene, points_in_world=scene.points_in_world[problem.points])
    return at_start(seen, problem.freedom), problem


def noise_of(scene: Scene, view: View, problem: ImageProblem, before: PixelNoise | None = None) -> PixelNoise:
    """Of the observations at a scene; their groups are distinguished where an estimate was made before, and so
    are observations by what their matches state."""
    layout, residual_px, depth = problem.layout, view.residual_px, view.depth
    if before is None or (layout.groups == 1 and not layout.states_variances):
        return pixel_noise(layout, residual_px, depth, np.ones(layout.groups))
    by, known = by_points(scene, view, problem), shape_information(scene, problem)
    left = left_of_points(layout, before, residual_px, depth, by, problem.seen.starts, known)
    ratio = variance_ratios(layout, before, residual_px, depth, left)
    return pixel_noise(layout, residual_px, depth, ratio, common_share(layout, residual_px, left, ratio))


def minimised(
    scene: Scene,
    problem: ImageProblem,
    noise: PixelNoise,
    known: Sequence[RigInformation],
    damping: float = START_DAMPING,
) -> tuple[Scene, View, float]:
    """Levenberg-Marquardt with the weights that observations have at the start; also the damping at the end.

    `known` is what is known of the rigs beside the images and the problem's prior.
    """
    view = view_of(scene, problem)
    weight = noise.weights(view.residual_px, view.depth, problem.layout)
    known = [*_prior_of(problem), *known]
    least = cost(scene, view, problem, weight, known)
    for _ in range(STEPS):
        normal = _normal_equations(scene, view, problem, weight, known, damping)
        tried = _after_step(scene, problem, normal)
        tried_view = view_of(tried, problem)
        tried_cost = cost(tried, tried_view, problem, weight, known)
        gained = least - tried_cost
        if gained >= 0:
            scene, view, least, damping = tried, tried_view, tried_cost, max(damping / 10, LEAST_DAMPING)
        else:
            damping *= 10
        if abs(gained) < ENOUGH:
            break
        if damping > MOST_DAMPING:
            return scene, view, START_DAMPING
    return scene, view, damping


def evidence(scene: Scene, problem: ImageProblem, noise: PixelNoise) -> ImageEvidence:
    """What the images and the priors of their cameras show about a scene, whoever helped to find it."""
    return linearised(scene, view_of(scene, problem), problem, noise)[0]


def linearised(
    scene: Scene, view: View, problem: ImageProblem, noise: PixelNoise
) -> tuple[ImageEvidence, Normal]:
    """The same, and the equations that it is made of, which step the points."""
    weight = noise.weights(view.residual_px, view.depth, problem.layout)
    normal = _normal_equations(scene, view, problem, weight, _prior_of(problem), 0.0)
    information = normal.hessian
    information[np.diag_indices(len(information))] += FAINT
    if problem.prior is None:
        # A unit of the world that is that of its rigs' places, all alike: what λ is counted in. Boards take no part: λ
        # would then be of their size too, and no longer that of the cameras and points.
        boards, first = problem.observations.boards, problem.freedom.first_rig
        rigs = slice(first, len(information) if boards is None else first + 6 * boards.first_rig)
        by_similarity = similarities(scene, problem.freedom)
        by_similarity[problem.freedom.board_columns] = by_similarity[rigs.stop :] = 0.0
        information += information_along(by_similarity, float(information.diagonal()[rigs].mean()))
    found = ImageEvidence(
        scene=scene, problem=problem, information=information, gradient=-normal.right, noise=noise, view=view
    )
    return found, normal


def with_model_error_of(images: ImageEvidence) -> tuple[ImageEvidence, float]:
    """The evidence with displacements as large as it shows them, and the relative change of that."""
    columns, std = images.problem.freedom.model_error_columns, images.problem.freedom.model_error_std
    if len(std) == 0:
        return images, 0.0
    covariance = np.linalg.inv(images.information)
    steps = images.scene.camera_steps[columns]
    likeliest = steps - covariance[columns] @ images.gradient
    size = size_of(likeliest, covariance[columns, columns], std)
    information, gradient = images.information.copy(), images.gradient.copy()
    change = size**-2.0 - std**-2.0
    information[columns, columns] += np.diag(change)
    gradient[columns] += change * steps
    resized = images.problem.with_model_error(size)
    found = replace(images, problem=resized, information=information, gradient=gradient)
    return found, abs(float(np.log(size[0] / std[0])))


def median_reprojection_px(view: View, problem: ImageProblem) -> Float[ndarray, " n"]:
    """Median reprojection error of every image; not a number where it took no part."""
    length = np.linalg.norm(view.residual_px, axis=1)
    image = problem.observations.image
    out = np.full(len(problem.observations.rig), np.nan)
    for k in np.unique(image):
        out[k] = np.median(length[image == k])
    return out


def cost(
    scene: Scene,
    view: View,
    problem: ImageProblem,
    weight: Float[ndarray, " k"],
    known: Sequence[RigInformation],
) -> float:
    """In squared standard deviations, with these weights of the observations, and of what is `known` of the rigs."""
    total = float(weight @ (view.residual_px**2).sum(1))
    total += float(((scene.camera_steps / problem.freedom.std) ** 2).sum())
    total += float((shape_residuals(scene, problem) ** 2).sum())
    for one in known:
        steps = one.steps(scene)
        total += float(steps @ one.information @ steps + 2 * one.gradient @ steps)
    return total


def cost_of_images(scene: Scene, images: ImageEvidence) -> float:
    """Of another scene, with the weights that the evidence was made with, and the problem's prior."""
    problem = images.problem
    return cost(scene, view_of(scene, problem), problem, images.weight, _prior_of(problem))


def _prior_of(problem: ImageProblem) -> list[RigInformation]:
    return [] if problem.prior is None else [problem.prior]


def _normal_equations(
    scene: Scene,
    view: View,
    problem: ImageProblem,
    weight: Float[ndarray, " k"],
    known: Sequence[RigInformation],
    damping: float,
) -> Normal:
    """The normal equations in the order of Freedom's columns, without the points."""
    freedom, first, cameras = problem.freedom, problem.freedom.first_rig, len(problem.freedom.std)
    weighted = derivatives(scene, view, problem, weight)
    hessian, right = with_fixed_points(weighted, problem.rows_seen)
    hessian[range(cameras), range(cameras)] += freedom.std**-2.0
    right[:cameras] -= scene.camera_steps / freedom.std**2
    for one in known:
        of_rigs = slice(first, first + len(one.gradient))
        hessian[of_rigs, of_rigs] += one.information
        right[of_rigs] -= one.information @ one.steps(scene) + one.gradient
    hessian[np.diag_indices(len(right))] *= 1 + damping
    return without_points(hessian, right, weighted, problem.rows_seen, damping)


def _after_step(scene: Scene, problem: ImageProblem, normal: Normal) -> Scene:
    """The scene after one Gauss-Newton step; along the similarity that no image shows, the least one."""
    scale = 1 / np.sqrt(np.maximum(normal.hessian.diagonal(), FAINT))
    scaled = scale[:, None] * normal.hessian * scale
    scaled[np.diag_indices(len(scale))] += 1e-12
    step = scale * over(cholesky(scaled), (scale * normal.right)[:, None])[:, 0]
    points = normal.stepped(scene.points_in_world, step)
    return replace(stepped(scene, problem.freedom, step), points_in_world=points)
