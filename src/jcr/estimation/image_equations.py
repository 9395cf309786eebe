"""Image equations: bundle adjustment, and the normal distribution of rigs and cameras that images alone determine.

Reprojection errors under a Cauchy loss are minimised over intrinsics, parameters of images, mounts, rigs and points.
The points are eliminated (elimination.py); the rest is a small dense system. Reported poses may guide an adjustment, but
`ImageEvidence` never contains them, so that they are not counted twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.boards import CORNER_STD_M
from jcr.estimation.elimination import Normal, cholesky, inverse_of, over, with_fixed_points, without_points
from jcr.estimation.intrinsics_prior import size_of
from jcr.estimation.pixel_noise import pixel_noise, refined_noise
from jcr.estimation.problem import SCALE, Problem, State, similarities_of_rigs, stepped
from jcr.estimation.projection import ProjectedObservations, by_points, derivatives, view_of
from jcr.geometry import step_between
from jcr.least_squares import damped_gauss_newton, one_blas_thread

NOISE_ROUNDS = 3
"""Number of adjustments in `adjust_images`; the pixel noise is estimated before each."""
SIZES_SETTLED = 0.01
"""Relative change of the sizes of errors, of pixels and of robots, that ends the rounds."""
ENOUGH = 1e-5
"""Change of the cost, in squared standard deviations, that ends an adjustment."""
MAX_STEPS = 60
"""Largest number of Gauss-Newton steps of one adjustment."""
FAINT = 1e-6
"""Information added to every column (1/m², 1/rad²): a standard deviation of 1 km for images without observations."""


class RigInformation(NamedTuple):
    """Quadratic cost ½ sᵀ H s + gᵀ s of steps s of the first m rigs from reference poses; s has r = 6m numbers."""

    world_from_rig: Float[ndarray, "m 4 4"]
    """Reference poses."""
    information: Float[ndarray, "r r"]
    """Matrix H of the cost ½ sᵀ H s + gᵀ s; r = 6m."""
    gradient: Float[ndarray, " r"]
    """Vector g of the cost ½ sᵀ H s + gᵀ s."""

    def steps(self, state: State) -> Float[ndarray, " r"]:
        """Return the steps (r,) from the reference poses to the rigs of a state: six numbers of each rig in turn.

        They are translation (unit of the world), then rotation vector (rad), in axes of the world.
        """
        return step_between(self.world_from_rig, state.world_from_rig[: len(self.world_from_rig)]).ravel()


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageEvidence:
    """Normal distribution of the unknowns other than points and arms, from images and priors, without reported poses.

    It is linearised about a state; the d unknowns are in the order of `Problem.columns`.
    """

    problem: Problem
    state: State
    view: ProjectedObservations
    """Observations as the state projects them."""
    weight: Float[ndarray, " k"]
    """Weight (1/px²) of each of k observations at `state`, by the pixel noise and the Cauchy loss."""
    information: Float[ndarray, "d d"]
    """Information matrix with the priors of the cameras, and small information along the similarity of the world."""
    gradient: Float[ndarray, " d"]
    """Gradient of half the cost (squared standard deviations) at the state."""

    @cached_property
    def rigs(self) -> tuple[Float[ndarray, "s e"], Float[ndarray, " s"], Float[ndarray, "s s"]]:
        """Conditional distribution of the steps r of the arms' rigs, given steps f of the columns `Problem.free`.

        Matrix A (s,e), vector b (s,) and covariance (s,s): r has the mean −A f − b, in the order of `Problem.by_arm`.
        """
        by_arm, free = self.problem.by_arm, self.problem.free
        root = cholesky(self.information[np.ix_(by_arm, by_arm)])
        coupling = self.information[np.ix_(by_arm, free)]
        solved = over(root, np.column_stack([coupling, self.gradient[by_arm]]))
        return solved[:, :-1], solved[:, -1], inverse_of(root)


@one_blas_thread
def adjust_images(problem: Problem, state: State) -> State:
    """Return the state after bundle adjustment without reported poses, for cameras with exact intrinsics.

    Rigs (camera poses) and points are adjusted. Mean position, mean rotation and extent of the rigs stay fixed.
    """
    unseen = information_along(similarities_of_rigs(state.world_from_rig), 1.0)
    world = RigInformation(state.world_from_rig, unseen, np.zeros(len(unseen)))
    for _ in range(NOISE_ROUNDS):
        state = with_pixel_noise(problem, state, view_of(problem, state))
        state = adjusted_images(problem, state, world)
    return state


def with_pixel_noise(problem: Problem, state: State, view: ProjectedObservations) -> State:
    """Return the state with the pixel noise estimated from the residuals in `view`, the projection of the state.

    The first estimate has one size for all observations. Later ones distinguish groups (one for each camera, one for
    board corners) and use the observations' stated variances.
    """
    layout, residual_px, depth, before = problem.layout, view.residual_px, view.depth, state.pixel_noise
    if before is None or (layout.groups == 1 and not layout.states_variances):
        noise = pixel_noise(layout, residual_px, depth, np.ones(layout.groups))
    else:
        by, known = by_points(problem, state, view), None
        if (boards := problem.boards) is not None:
            # Information of each corner's point by the shape of its board, for exact poses of the boards.
            size = np.exp(-state.camera_steps[problem.columns.boards.start])
            whitened = (
                size * np.swapaxes(state.world_from_rig[boards.rig, :3, :3], 1, 2) / CORNER_STD_M[:, None]
            )
            known = np.zeros((len(state.points_in_world), 3, 3))
            known[boards.point] = np.swapaxes(whitened, 1, 2) @ whitened
        noise = refined_noise(layout, before, residual_px, depth, by, problem.seen.starts, known)
    return replace(state, pixel_noise=noise)


def weights_of(problem: Problem, state: State, view: ProjectedObservations) -> Float[ndarray, " k"]:
    """Return the weight (1/px²) of each of k observations, by the pixel noise of the state and the Cauchy loss.

    `view` is the projection of the state; points behind or very near a camera have weight 0 (`PixelNoise.weights`).
    """
    assert state.pixel_noise is not None
    return state.pixel_noise.weights(view.residual_px, view.depth, problem.layout)


def adjusted_images(problem: Problem, state: State, guide: RigInformation) -> State:
    """Return the state after bundle adjustment with constant weights, those of the observations at the initial `state`.

    The arms' X, scale and Z stay. `guide` is information about the rigs in addition to that of the images and
    `problem.known_rigs`. Raises LinAlgError if a step is not finite.
    """
    view = view_of(problem, state)
    weight, known = weights_of(problem, state, view), [*_known_rigs(problem), guide]

    def step(
        now: tuple[State, ProjectedObservations], _: None, damping: float
    ) -> tuple[State, ProjectedObservations]:
        normal = _normal_equations(problem, *now, weight, known, damping)
        scale = 1 / np.sqrt(np.maximum(normal.hessian.diagonal(), FAINT))
        # Along the similarity of the world the step is the smallest one.
        scaled = scale[:, None] * normal.hessian * scale + 1e-12 * np.eye(len(scale))
        with np.errstate(over="ignore", invalid="ignore"):
            along = scale * over(cholesky(scaled), (scale * normal.right)[:, None])[:, 0]
        # Far from a solution the equations may be negative along a direction.
        if not np.isfinite(along).all():
            raise np.linalg.LinAlgError("the equations of the images have no solution")
        points = normal.stepped(now[0].points_in_world, along)
        tried = replace(stepped(problem, now[0], None, along), points_in_world=points)
        return tried, view_of(problem, tried)

    return damped_gauss_newton(
        lambda _: None,
        step,
        lambda now: _cost(problem, *now, weight, known),
        (state, view),
        enough=lambda _: ENOUGH,
        iterations=MAX_STEPS,
    )[0][0]


def image_evidence(problem: Problem, state: State) -> ImageEvidence:
    """Return the normal distribution of `Problem.columns` by images and priors, linearised at a state.

    The columns are intrinsics, boards and rigs. The points are eliminated; reported poses are not used.
    """
    return linearised(problem, state, view_of(problem, state))[0]


def linearised(problem: Problem, state: State, view: ProjectedObservations) -> tuple[ImageEvidence, Normal]:
    """Return the evidence of images and priors about a state, and the normal equations from which points are stepped.

    The evidence is the normal distribution of `Problem.columns` (intrinsics, boards, rigs). `view` is the projection of
    the state.
    """
    weight = weights_of(problem, state, view)
    normal = _normal_equations(problem, state, view, weight, _known_rigs(problem), 0.0)
    information = normal.hessian
    information[np.diag_indices(len(information))] += FAINT
    if problem.known_rigs is None:
        # The rigs of cameras fix the unit of the world; boards do not, for λ would then depend on their size.
        boards, first = problem.boards, problem.columns.first_rig
        rigs = slice(first, len(information) if boards is None else first + 6 * boards.first_rig)
        by_similarity = np.zeros((len(information), 7))
        by_similarity[rigs] = similarities_of_rigs(state.world_from_rig)[: rigs.stop - first]
        for mount, columns in zip(state.rig_from_camera, problem.columns.mounts, strict=True):
            if columns is not None:
                by_similarity[columns.start : columns.start + 3, SCALE] = mount[:3, 3, None]
        information += information_along(by_similarity, float(information.diagonal()[rigs].mean()))
    found = ImageEvidence(
        problem=problem,
        state=state,
        view=view,
        weight=weight,
        information=information,
        gradient=-normal.right,
    )
    return found, normal


def with_model_error_of(images: ImageEvidence) -> tuple[ImageEvidence, float]:
    """Return the evidence with a new estimate of the size of each camera's model error.

    The model error is the distortion that the camera model cannot express. The second result is the largest absolute
    change of the natural logarithm of a size; 0 if no model errors are estimated.
    """
    state, change, sizes = images.state, 0.0, images.state.model_error_std.copy()
    columns = {k: own for k, own in enumerate(images.problem.columns.model_error) if own.stop > own.start}
    if not columns:
        return images, 0.0
    covariance = np.linalg.inv(images.information)
    information, gradient = images.information.copy(), images.gradient.copy()
    for k, own in columns.items():
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
    """Return the median length (px) of the reprojection errors of each of n images; NaN for one without observations.

    `view` has the residuals.
    """
    assert problem.observations is not None
    length, image = np.linalg.norm(view.residual_px, axis=1), problem.observations.image
    out = np.full(problem.n_images, np.nan)
    for k in np.unique(image):
        out[k] = np.median(length[image == k])
    return out


def cost_of_images(images: ImageEvidence, state: State) -> float:
    """Return the cost of a state: squared residuals of images, priors and boards in units of their standard deviations.

    Weights and priors are those of `images`.
    """
    view, sizes = view_of(images.problem, state), images.state.model_error_std
    state = replace(state, model_error_std=sizes)
    return _cost(images.problem, state, view, images.weight, _known_rigs(images.problem))


def information_along(steps: Float[ndarray, "d 7"], strength: float) -> Float[ndarray, "d d"]:
    """Return the information matrix with the value `strength` in all directions that the seven columns of `steps` span.

    The columns are those of a similarity of the world. They are orthonormalised first; all other directions have 0.
    """
    unseen = np.linalg.qr(steps)[0]
    return strength * unseen @ unseen.T


def _cost(
    problem: Problem,
    state: State,
    view: ProjectedObservations,
    weight: Float[ndarray, " k"],
    known: Sequence[RigInformation],
) -> float:
    """Return the cost in squared standard deviations: weighted residuals, priors, boards and `known` information.

    `weight` (1/px²) is that of each of k observations in `view`, the projection of the state.
    """
    total = float(weight @ (view.residual_px**2).sum(1))
    total += float(((state.camera_steps / problem.prior_std(state)) ** 2).sum())
    if problem.boards is not None:
        shape = state.camera_steps[problem.columns.boards]
        total += float(
            (problem.boards.residual(state.world_from_rig, state.points_in_world, shape) ** 2).sum()
        )
    for one in known:
        steps = one.steps(state)
        total += float(steps @ one.information @ steps + 2 * one.gradient @ steps)
    return total


def _known_rigs(problem: Problem) -> list[RigInformation]:
    """Return the normal distribution `Problem.known_rigs` as a list with one quadratic cost; an empty list if None.

    The distribution must have a covariance.
    """
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
    """Return the normal equations of the d unknowns in the order of `Problem.columns` (cameras, boards, rigs).

    The points are eliminated. `weight` (1/px²) is that of each of k observations in `view`; `known` is information
    about rigs. `damping` increases the diagonal by this share, as in `without_points`.
    """
    first, std, seen = problem.columns.first_rig, problem.prior_std(state), problem.rows[2]
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
