"""Equations of images: bundle adjustment, and the evidence about rigs and cameras that images give by themselves.

Reprojection errors under a Cauchy loss, over intrinsics, nuisances of images, mounts, rigs and points. The points are
eliminated (elimination.py); the rest is a small dense system. The evidence excludes the reported poses, even where these
keep the rigs in place while the images are adjusted, so that nothing is counted twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.elimination import Normal, cholesky, inverse_of, over, with_fixed_points, without_points
from jcr.estimation.intrinsics_prior import size_of
from jcr.estimation.pixel_noise import pixel_noise, refined_noise
from jcr.estimation.problem import Problem, State, similarities, similarities_of_rigs, stepped
from jcr.estimation.projection import (
    ProjectedObservations,
    by_points,
    derivatives,
    shape_residuals,
    view_of,
)
from jcr.geometry import step_between
from jcr.least_squares import damped_gauss_newton, one_blas_thread

ROUNDS = 3
"""Number of adjustments of images alone, between which the sizes of errors are estimated."""
SIZES_SETTLED = 0.01
"""Relative change of the sizes of errors, of pixels and of robots, that ends the rounds."""
ENOUGH = 1e-5
"""Change of the cost, in squared standard deviations, that ends an adjustment."""
STEPS = 60
FAINT = 1e-6
"""Information added to every column (1/m², 1/rad²): an image without observations is anywhere within a kilometre."""


class RigInformation(NamedTuple):
    """Twice a cost that is quadratic in the steps of the first rigs from a reference: sᵀ H s + 2 gᵀ s."""

    world_from_rig: Float[ndarray, "m 4 4"]
    information: Float[ndarray, "r r"]
    gradient: Float[ndarray, " r"]

    def steps(self, state: State) -> Float[ndarray, " r"]:
        """Return the steps of the rigs of a state from the reference."""
        return step_between(self.world_from_rig, state.world_from_rig[: len(self.world_from_rig)]).ravel()


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageEvidence:
    """Normal distribution of the columns of the images about a state, without the reported poses."""

    problem: Problem
    state: State
    view: ProjectedObservations
    information: Float[ndarray, "d d"]
    """Information, including that of the priors of intrinsics and nuisances, and a negligible one of the world's
    similarity."""
    gradient: Float[ndarray, " d"]
    """Gradient of half the squared distance."""

    @cached_property
    def weight(self) -> Float[ndarray, " k"]:
        """Weight of each observation, 1/px²."""
        return weights_of(self.problem, self.state, self.view)

    @cached_property
    def rigs(self) -> tuple[Float[ndarray, "s e"], Float[ndarray, " s"], Float[ndarray, "s s"]]:
        """Steps of the arms' rigs with each free column and to their mean, signs reversed, and their covariance."""
        by_arm, free = self.problem.by_arm, self.problem.free
        root = cholesky(self.information[np.ix_(by_arm, by_arm)])
        coupling = self.information[np.ix_(by_arm, free)]
        solved = over(root, np.column_stack([coupling, self.gradient[by_arm]]))
        return solved[:, :-1], solved[:, -1], inverse_of(root)


@one_blas_thread
def adjust_images(problem: Problem, state: State) -> State:
    """Adjust images of exact cameras alone; the rigs keep their mean place, rotation and extent."""
    unseen = information_along(similarities_of_rigs(state.world_from_rig), 1.0)
    world = RigInformation(state.world_from_rig, unseen, np.zeros(len(unseen)))
    for _ in range(ROUNDS):
        state = with_pixel_noise(problem, state, view_of(problem, state))
        state = adjusted_images(problem, state, [world])
    return state


def with_pixel_noise(problem: Problem, state: State, view: ProjectedObservations) -> State:
    """Return the state with the pixel errors that its residuals show.

    Groups of observations, and observations by their stated variances, are distinguished where an estimate was made
    before.
    """
    layout, residual_px, depth, before = problem.layout, view.residual_px, view.depth, state.pixel_noise
    if before is None or (layout.groups == 1 and not layout.states_variances):
        noise = pixel_noise(layout, residual_px, depth, np.ones(layout.groups))
    else:
        by, known = by_points(problem, state, view), None
        if problem.boards is not None:
            shape = state.camera_steps[problem.columns.boards]
            known = problem.boards.point_information(state.world_from_rig, shape, len(state.points_in_world))
        noise = refined_noise(layout, before, residual_px, depth, by, problem.seen.starts, known)
    return replace(state, pixel_noise=noise)


def weights_of(problem: Problem, state: State, view: ProjectedObservations) -> Float[ndarray, " k"]:
    """Return the weight of each observation, 1/px²."""
    assert state.pixel_noise is not None
    return state.pixel_noise.weights(view.residual_px, view.depth, problem.layout)


def adjusted_images(problem: Problem, state: State, known: Sequence[RigInformation]) -> State:
    """Adjust the columns of the images with the weights that observations have at the start.

    `known` is information about the rigs beside that of the images and `known_rigs`.
    """
    view = view_of(problem, state)
    weight, known = weights_of(problem, state, view), [*_known_rigs(problem), *known]

    def step(
        now: tuple[State, ProjectedObservations], _: None, damping: float
    ) -> tuple[State, ProjectedObservations]:
        normal = _normal_equations(problem, *now, weight, known, damping)
        scale = 1 / np.sqrt(np.maximum(normal.hessian.diagonal(), FAINT))
        # Along the similarity of the world the step is the smallest one.
        scaled = scale[:, None] * normal.hessian * scale + 1e-12 * np.eye(len(scale))
        along = scale * over(cholesky(scaled), (scale * normal.right)[:, None])[:, 0]
        points = normal.stepped(now[0].points_in_world, along)
        tried = replace(stepped(problem, now[0], None, along), points_in_world=points)
        return tried, view_of(problem, tried)

    return damped_gauss_newton(
        lambda _: None,
        step,
        lambda now: _cost(problem, *now, weight, known),
        (state, view),
        enough=lambda _: ENOUGH,
        iterations=STEPS,
    )[0][0]


def image_evidence(problem: Problem, state: State) -> ImageEvidence:
    """Return the evidence of the images and of the priors of their cameras about a state."""
    return linearised(problem, state, view_of(problem, state))[0]


def linearised(problem: Problem, state: State, view: ProjectedObservations) -> tuple[ImageEvidence, Normal]:
    """Return the evidence about a state, and the normal equations, which step the points."""
    weight = weights_of(problem, state, view)
    normal = _normal_equations(problem, state, view, weight, _known_rigs(problem), 0.0)
    information = normal.hessian
    information[np.diag_indices(len(information))] += FAINT
    if problem.known_rigs is None:
        # The unit of the world is that of the positions of its rigs. Boards are left out: λ would depend on their size.
        boards, first = problem.boards, problem.columns.first_rig
        rigs = slice(first, len(information) if boards is None else first + 6 * boards.first_rig)
        by_similarity = similarities(problem, state)
        by_similarity[problem.columns.boards] = by_similarity[rigs.stop :] = 0.0
        information += information_along(by_similarity, float(information.diagonal()[rigs].mean()))
    found = ImageEvidence(
        problem=problem, state=state, view=view, information=information, gradient=-normal.right
    )
    return found, normal


def with_model_error_of(images: ImageEvidence) -> tuple[ImageEvidence, float]:
    """Return the evidence with the estimated size of the remaining distortion, and the relative change of that size."""
    state, columns = images.state, [c for c in images.problem.columns.model_error if c.stop > c.start]
    if not columns:
        return images, 0.0
    covariance, change = np.linalg.inv(images.information), 0.0
    information, gradient = images.information.copy(), images.gradient.copy()
    sizes = state.model_error_std.copy()
    cameras = [k for k, c in enumerate(images.problem.columns.model_error) if c.stop > c.start]
    for k, own in zip(cameras, columns, strict=True):
        steps, std = state.camera_steps[own], float(sizes[k])
        likeliest = steps - covariance[own] @ images.gradient
        sizes[k] = size_of(likeliest, covariance[own, own], std)
        added = sizes[k] ** -2.0 - std**-2.0
        information[own, own] += added * np.eye(len(steps))
        gradient[own] += added * steps
        change = max(change, abs(float(np.log(sizes[k] / std))))
    state = replace(state, model_error_std=sizes)
    return replace(images, state=state, information=information, gradient=gradient), change


def median_reprojection_px(problem: Problem, view: ProjectedObservations) -> Float[ndarray, " n"]:
    """Return the median reprojection error of every image; NaN of an image without observations."""
    assert problem.observations is not None
    length, image = np.linalg.norm(view.residual_px, axis=1), problem.observations.image
    out = np.full(problem.n_images, np.nan)
    for k in np.unique(image):
        out[k] = np.median(length[image == k])
    return out


def cost_of_images(images: ImageEvidence, state: State) -> float:
    """Return the cost of another state, with the weights and priors of the evidence."""
    view, sizes = view_of(images.problem, state), images.state.model_error_std
    state = replace(state, model_error_std=sizes)
    return _cost(images.problem, state, view, images.weight, _known_rigs(images.problem))


def information_along(steps: Float[ndarray, "d 7"], strength: float) -> Float[ndarray, "d d"]:
    """Return information of this strength along the steps of a similarity, which nothing else determines."""
    unseen = np.linalg.qr(steps)[0]
    return strength * unseen @ unseen.T


def _cost(
    problem: Problem,
    state: State,
    view: ProjectedObservations,
    weight: Float[ndarray, " k"],
    known: Sequence[RigInformation],
) -> float:
    """Return the cost in squared standard deviations, with these weights of the observations."""
    total = float(weight @ (view.residual_px**2).sum(1))
    total += float(((state.camera_steps / problem.prior_std(state)) ** 2).sum())
    total += float((shape_residuals(problem, state) ** 2).sum())
    for one in known:
        steps = one.steps(state)
        total += float(steps @ one.information @ steps + 2 * one.gradient @ steps)
    return total


def _known_rigs(problem: Problem) -> list[RigInformation]:
    """Return the information of the problem about its rigs."""
    if problem.known_rigs is None:
        return []
    poses, covariance = problem.known_rigs
    assert covariance is not None
    return [RigInformation(poses, np.linalg.inv(covariance), np.zeros(len(covariance)))]


def _normal_equations(
    problem: Problem,
    state: State,
    view: ProjectedObservations,
    weight: Float[ndarray, " k"],
    known: Sequence[RigInformation],
    damping: float,
) -> Normal:
    """Return the normal equations of all columns, the points eliminated."""
    first, std, seen = problem.columns.first_rig, problem.prior_std(state), problem.rows[3]
    weighted = derivatives(problem, state, view, weight)
    hessian, right = with_fixed_points(weighted, seen)
    hessian[range(len(std)), range(len(std))] += std**-2.0
    right[: len(std)] -= state.camera_steps / std**2
    for one in known:
        of_rigs = slice(first, first + len(one.gradient))
        hessian[of_rigs, of_rigs] += one.information
        right[of_rigs] -= one.information @ one.steps(state) + one.gradient
    hessian[np.diag_indices(len(right))] *= 1 + damping
    return without_points(hessian, right, weighted, seen, damping)
