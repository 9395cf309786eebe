"""Score tests of additional camera parameters at the converged adjustment.

The mixed model is written again with columns for fixed parameters: every parameter of a camera, a focal length, a
shear and an offset for each of its images, and a thin prism. A hypothesis is a few combinations of these columns. The
test is Rao's score test (Proc. Cambridge Phil. Soc. 44, 1948): the gain of the cost in one Gauss-Newton step over the
dispersion of the residuals, by F because few residuals determine the robot pose noise. `freed` makes the problem whose
adjustment estimates the combinations.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import parameter_names
from jcr.distributions import f as f_distribution
from jcr.estimation.cholesky import cholesky, over
from jcr.estimation.image_equations import ImageEvidence, evidence
from jcr.estimation.intrinsics_prior import CameraPrior
from jcr.estimation.pose_equations import pose_equations
from jcr.estimation.problem import OF_IMAGE, PRISM, Problem, State, with_free
from jcr.estimation.robot_noise import solve_equations
from jcr.estimation.solve import Solution
from jcr.geometry import Transform
from jcr.records import Intrinsics

WEAK = 0.3, 0.3, 0.2, 0.2
"""Standard deviations that only keep finite what the images cannot see: focal lengths relative, centre per width."""
WEAK_DISTORTION, WEAK_PRISM, WEAK_OF_IMAGE = 1.0, 0.3, (0.05, 0.3, 0.1, 0.1)
"""Standard deviations of the distortion, of a thin prism, and of the nuisances of each image."""

OfImage = Literal["focal", "shear", "x", "y"]
"""Nuisance of each image, in the order of the rows of `Problem.nuisance_directions`."""


@dataclass(frozen=True, kw_only=True)
class Alternatives:
    """Equations of every column that may be freed, with the adjusted unknowns eliminated.

    The columns are the parameters of one camera in `units`, then the nuisances of its images.
    """

    hessian: Float[ndarray, "e e"]
    right: Float[ndarray, " e"]
    place_by_column: Float[ndarray, "6 e"]
    """Derivative of the camera's pose by each column."""
    images: int
    """Number of images of the camera."""
    freedom: int
    """Degrees of freedom of the robots' residuals, by which their noise was estimated: far fewer than the images have.
    """
    dispersion: float
    """Variance of the gradient of a parameter over the variance that the weights state."""
    names: tuple[str, ...]
    """Names of the camera's parameters."""
    units: Float[ndarray, " q"]
    """Unit of each parameter: focal lengths relative, the centre in widths."""
    distance: Float[ndarray, " m"]
    """Median depth of the points of each image (m)."""
    down_in_camera: Float[ndarray, "m 3"]
    """Direction against the base's z axis in the camera of each image."""

    @property
    def columns(self) -> int:
        """Number of columns that may be freed."""
        return len(self.right)

    def of_camera(self, names: tuple[str, ...]) -> Float[ndarray, "e p"]:
        """Return the combinations that are these parameters of the camera."""
        return np.eye(self.columns)[:, [self.names.index(name) for name in names]]

    def of_images(self, nuisance: OfImage, shares: Float[ndarray, "m p"]) -> Float[ndarray, "e p"]:
        """Return the combinations that move a nuisance of each image by its share."""
        out = np.zeros((self.columns, shares.shape[1]))
        first = len(self.names) + get_args(OfImage).index(nuisance) * self.images
        out[first : first + self.images] = shares
        return out


@dataclass(frozen=True)
class ScoreTest:
    """Result of a test of some combinations."""

    log_p: float
    """Logarithm of the probability of this gain or a larger one by chance."""
    covariance: Float[ndarray, "p p"]
    """Covariance of the combinations."""
    shift: Float[ndarray, "6"]
    """Step of the camera's pose that comes with it, axes of its parent."""


def first_x(state: State) -> Transform:
    """Return gripper_from_camera of the arm's first wrist camera."""
    return state.x[0]


def alternatives(
    solution: Solution,
    prior: CameraPrior,
    camera: int = 0,
    place: Callable[[State], Transform] = first_x,
    model_error_std: float | None = None,
) -> Alternatives:
    """Return the columns and equations of one camera about a solution.

    `prior` is the prior of its intrinsics; directions that were freed beside it are among the columns. `place`
    returns the pose of the camera on its parent. `model_error_std` is the size of the remaining distortion of the
    cameras' models, in widths of the image; None: as estimated.
    """
    problem, own = solution.problem, len(prior.std)
    assert problem.observations is not None
    mine = np.flatnonzero(problem.observations.camera == camera)
    wider = _with_all_free(solution, prior, camera, mine, model_error_std)
    # The arms are at the most likely state, the images where the evidence is.
    at, likely = wider.state, solution.most_likely
    equations = pose_equations(
        wider.problem, replace(at, x=likely.x, scale=likely.scale, z=likely.z), wider
    ).equations
    found = solve_equations(equations, solution.log_sizes)
    hessian = equations.jacobian.T @ found.weighed + equations.prior_information
    right = -(found.weighed.T @ equations.residual + equations.prior_gradient)
    begin, columns = problem.arm_unknowns, wider.problem.columns
    of_camera, of_images = columns.intrinsics[camera], columns.nuisance
    rest = begin + np.r_[of_camera.start + own : of_camera.stop, of_images]
    kept = np.setdiff1d(np.arange(len(hessian)), rest)
    coupling = hessian[np.ix_(kept, rest)]
    by_column = over(cholesky(hessian[np.ix_(kept, kept)]), coupling)
    # The camera's pose does not depend on parameters of cameras.
    derivative = solution.derivative(place)
    after = derivative.shape[1] - begin - problem.columns.boards.start
    by_kept = np.zeros((6, len(hessian)))
    by_kept[:, :begin] = derivative[:, :begin]
    by_kept[:, len(hessian) - after :] = derivative[:, derivative.shape[1] - after :]
    # Dispersion of the weighted residuals, at least that of their sums over cells of the images, which are clusters in
    # the sense of Liang and Zeger (Biometrika 73, 1986).
    images, weight = solution.images, solution.images.weight
    pull = weight[:, None] * images.view.residual_px
    taken = 3 * len(images.state.points_in_world) + 6 * len(problem.seen.rows)
    expected = 2 * weight.sum() * max(1 - taken / (2 * len(weight)), 0.1)
    start = problem.intrinsics(images.state)[camera]
    now, rig = solution.state, problem.observations.rig[mine]
    # An image without points is as far away as the others.
    depth, image = wider.view.depth, problem.observations.image
    distance = np.array([np.median(depth[image == k]) if (image == k).any() else np.nan for k in mine])
    return Alternatives(
        hessian=hessian[np.ix_(rest, rest)] - coupling.T @ by_column,
        right=right[rest] - by_column.T @ right[kept],
        place_by_column=-by_kept[:, kept] @ by_column,
        images=len(mine),
        freedom=max(len(equations.residual) - begin, 1),
        dispersion=max(float((pull**2).sum()), problem.layout.squares_of_cells(pull)) / expected,
        names=parameter_names(start),
        units=units_of(start)[0],
        distance=np.where(np.isfinite(distance), distance, np.nanmedian(distance)),
        down_in_camera=-(now.z[0] @ now.world_from_rig[rig] @ now.rig_from_camera[camera])[:, 2, :3],
    )


def nuisances_of(images: Int[ndarray, " m"], count: int) -> Int[ndarray, " r"]:
    """Return the rows of these images among the nuisances of `count` images, and of what all share."""
    return np.r_[(count * np.arange(OF_IMAGE)[:, None] + images).ravel(), OF_IMAGE * count + np.arange(PRISM)]


def _with_all_free(
    solution: Solution,
    prior: CameraPrior,
    camera: int,
    images: Int[ndarray, " m"],
    model_error_std: float | None,
) -> ImageEvidence:
    """Return the evidence of the images where every parameter of a camera and of its images is free."""
    problem, state, own = solution.problem, solution.images.state, len(prior.std)
    start = problem.intrinsics(state)[camera]
    units, weak = units_of(start)
    wider = replace(
        prior,
        directions=np.column_stack([prior.directions, np.diag(units)]),
        std=np.r_[prior.std, weak],
    )
    rows = nuisances_of(images, problem.n_images)
    all_free = with_free(
        problem,
        cameras=with_camera(problem, wider, camera).cameras,
        nuisance_directions=np.eye(len(problem.nuisance_directions))[:, rows],
        nuisance_std=_weak_nuisances(len(images)),
    )
    steps, columns = state.camera_steps, problem.columns
    mine = columns.intrinsics[camera]
    wider_steps = np.r_[
        steps[: mine.start + own],
        beyond_prior(solution, prior, camera) / units,
        steps[mine.stop : columns.nuisance.start],
        problem.nuisances(state)[rows],
        steps[columns.nuisance.stop :],
    ]
    sizes = state.model_error_std
    sizes = sizes if model_error_std is None else np.full_like(sizes, model_error_std)
    return evidence(all_free, replace(state, camera_steps=wider_steps, model_error_std=sizes))


def with_camera(problem: Problem, prior: CameraPrior, camera: int = 0) -> Problem:
    """Return the problem with another prior of a camera's intrinsics."""
    cameras = problem.cameras
    prior = replace(prior, mount_free=cameras[camera].mount_free)
    return replace(problem, cameras=(*cameras[:camera], prior, *cameras[camera + 1 :]))


def beyond_prior(solution: Solution, prior: CameraPrior, camera: int = 0) -> Float[ndarray, " q"]:
    """Return the displacement of a camera's parameters along directions that were freed beside its prior."""
    problem, own = solution.problem, len(prior.std)
    steps = solution.images.state.camera_steps[problem.columns.intrinsics[camera]]
    return problem.cameras[camera].directions[:, own:] @ steps[own:]


def units_of(camera: Intrinsics) -> tuple[Float[ndarray, " q"], Float[ndarray, " q"]]:
    """Return the units of the parameters, focal lengths and widths for the centre, and weak priors' std in these."""
    more = len(parameter_names(camera)) - 4
    units = np.r_[camera.fx, camera.fy, camera.width, camera.width, np.ones(more)]
    return units, np.r_[WEAK, np.full(more, WEAK_DISTORTION)]


def focal_lengths(camera: Intrinsics, images: int) -> Float[ndarray, "e p"]:
    """Return the combinations of columns of `Alternatives` that give every image a focal length of its own."""
    q = len(parameter_names(camera))
    out = np.zeros((q + OF_IMAGE * images + PRISM, images))
    out[:2, 0] = 1.0
    out[q : q + images, 1:] = differences(images)
    return out


def differences(count: int) -> Float[ndarray, "n d"]:
    """Return an orthonormal basis of the zero-sum vectors of length n, shape (n, n - 1)."""
    return np.linalg.svd(np.eye(count) - 1 / count)[0][:, : count - 1]


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
    own = problem.cameras[camera]
    q = len(parameter_names(own.intrinsics))
    of_camera, of_images = spanned(combinations[:q]), spanned(combinations[q:])
    units, weak = units_of(own.intrinsics)
    wider = replace(
        own,
        directions=np.column_stack([own.directions, units[:, None] * of_camera]),
        std=np.r_[own.std, _std(of_camera, weak)],
    )
    directions = np.zeros((OF_IMAGE * n_images + PRISM, of_images.shape[1]))
    directions[nuisances_of(images, n_images)] = of_images
    std = _std(of_images, _weak_nuisances(len(images)))
    return replace(with_camera(problem, wider, camera), nuisance_directions=directions, nuisance_std=std)


def _weak_nuisances(images: int) -> Float[ndarray, " r"]:
    """Return standard deviations of nuisances that only keep unobservable ones finite."""
    return np.r_[np.repeat(WEAK_OF_IMAGE, images), np.full(PRISM, WEAK_PRISM)]


def _std(combinations: Float[ndarray, "n p"], of_each: Float[ndarray, " n"]) -> Float[ndarray, " p"]:
    """Return the standard deviations of combinations of parameters with these standard deviations."""
    return 1 / np.sqrt(((combinations / of_each[:, None]) ** 2).sum(0))


def spanned(combinations: Float[ndarray, "e p"]) -> Float[ndarray, "e r"]:
    """Return an orthonormal basis of the space of the combinations."""
    u, size, _ = np.linalg.svd(combinations, full_matrices=False)
    return u[:, size > 1e-9 * size.max(initial=1e-300)]


def test_combinations(
    equations: Alternatives, free: Float[ndarray, "e p"], beside: Float[ndarray, "e q"]
) -> ScoreTest:
    """Return the test of the combinations `free`, with those of `beside` free under both hypotheses."""
    q, both = beside.shape[1], np.concatenate([beside, free], axis=1)
    fewer, more = spanned(beside), spanned(both)
    (without, gain_without, _), (step, gain, covariance) = (_step(equations, one) for one in (fewer, more))
    spread, p = equations.dispersion, max(more.shape[1] - fewer.shape[1], 1)
    to_value = np.linalg.pinv(both)[q:] @ more
    return ScoreTest(
        float(f_distribution.logsf(max(gain - gain_without, 0.0) / spread / p, p, equations.freedom)),
        spread * to_value @ covariance @ to_value.T,
        equations.place_by_column @ (more @ step - fewer @ without),
    )


def _step(
    equations: Alternatives, free: Float[ndarray, "e r"]
) -> tuple[Float[ndarray, " r"], float, Float[ndarray, "r r"]]:
    """Return the step of these combinations where they are free, its gain, and their covariance."""
    covariance = np.linalg.inv(free.T @ equations.hessian @ free)
    right = free.T @ equations.right
    step = covariance @ right
    return step, float(right @ step), covariance
