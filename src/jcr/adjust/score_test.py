"""What else the images could show: parameters beside those that were adjusted, tested where the adjustment ended.

The mixed model is written once more with columns for what was fixed: every parameter of the camera, a focal length, a
shear and an offset for each image by itself, and a thin prism. A hypothesis is a few combinations of these columns. How
much freeing them would lower
the cost, at one Gauss-Newton step, over the dispersion of the residuals, is Rao's score test (Rao, Proc. Cambridge Phil.
Soc. 44, 1948), here beside F, for the robot pose noise was estimated from few residuals. The same step shows how large
they are and how far X would move; the adjustment with them free (`freed`) is what they come to.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.adjust.images import ImageEvidence, evidence
from jcr.adjust.intrinsics_prior import IntrinsicsPrior
from jcr.adjust.robots import Adjusted, equations_of
from jcr.adjust.scene import OF_IMAGE, PRISM, Freedom, NuisancePrior
from jcr.camera import parameter_names, parameters
from jcr.distributions import f as f_distribution
from jcr.handeye.components import POSES, solve
from jcr.records import Intrinsics

WEAK = {"fx": 0.3, "fy": 0.3, "cx": 0.2, "cy": 0.2}
"""Standard deviations that only keep finite what the images cannot see: focal lengths relative, centre per width."""
WEAK_DISTORTION, WEAK_SHEAR, WEAK_FOCAL, WEAK_OFFSET, WEAK_PRISM = 1.0, 0.3, 0.05, 0.1, 0.3


@dataclass(frozen=True, kw_only=True)
class Alternatives:
    """The equations of every column that may be freed; what was adjusted is eliminated.

    The columns are the parameters of the wrist camera in `units`, then the nuisances in the order of NuisancePrior.
    """

    hessian: Float[ndarray, "e e"]
    right: Float[ndarray, " e"]
    x_by_column: Float[ndarray, "6 e"]
    """How far X moves with each column."""
    images: int
    dispersion: float
    """Variance of what pulls at a parameter, over what the weights say."""
    names: tuple[str, ...]
    """Of the camera's parameters."""
    units: Float[ndarray, " q"]
    """What each of them counts in: focal lengths in themselves, the centre in widths."""
    distance: Float[ndarray, " m"]
    """Median depth of the points of each image (m)."""
    down_in_camera: Float[ndarray, "m 3"]
    """Of each image, the direction against the base's z axis."""

    @property
    def columns(self) -> int:
        """That may be freed."""
        return len(self.right)

    @property
    def freedom(self) -> int:
        """Of the robot's residuals, by which its noise was estimated: fewer than the images have by far."""
        return max(6 * self.images - POSES, 1)

    def of_camera(self, names: tuple[str, ...]) -> Float[ndarray, "e p"]:
        """Combinations: these parameters of the camera."""
        return np.eye(self.columns)[:, [self.names.index(name) for name in names]]

    def common_focal(self) -> Float[ndarray, "e 1"]:
        """Combination: both focal lengths by one factor."""
        return self.of_camera(("fx", "fy")).sum(1, keepdims=True)

    def focal_of_images(self, shares: Float[ndarray, "m p"]) -> Float[ndarray, "e p"]:
        """Combinations: the logarithm of each image's focal length moves by its share."""
        return self._of_images(0, shares)

    def shear_of_images(self, shares: Float[ndarray, "m p"]) -> Float[ndarray, "e p"]:
        """Combinations: x of each image moves by its share of the focal length over its height."""
        return self._of_images(1, shares)

    def offset_by_gravity(self) -> Float[ndarray, "e 2"]:
        """Combinations: the offset of each image in x by gravity along x, in y by gravity along y."""
        x, y = self.down_in_camera[:, :2].T
        return np.concatenate([self._of_images(2, x[:, None]), self._of_images(3, y[:, None])], axis=1)

    def prism(self) -> Float[ndarray, "e 4"]:
        """Combinations: the coefficients of a thin prism."""
        return np.eye(self.columns)[:, -PRISM:]

    def _of_images(self, block: int, shares: Float[ndarray, "m p"]) -> Float[ndarray, "e p"]:
        out = np.zeros((self.columns, shares.shape[1]))
        first = len(self.names) + block * self.images
        out[first : first + self.images] = shares
        return out


@dataclass(frozen=True)
class Tested:
    """What freeing some combinations would do."""

    log_p: float
    """Of a gain like this or larger where there is nothing."""
    covariance: Float[ndarray, "p p"]
    """Of the combinations."""
    shift: Float[ndarray, "6"]
    """The step of X that comes with it, gripper axes."""


def alternatives(
    adjusted: Adjusted, prior: IntrinsicsPrior, model_error_std: float | None = None
) -> Alternatives:
    """The columns and equations about an adjustment of a wrist camera, a rig an image.

    `prior` is what was known of the intrinsics; what was freed beyond it is among the columns. `model_error_std` is how
    large, in widths of the image, what the camera's model leaves may be; None: as large as it was estimated.
    """
    given = adjusted.given
    problem, camera = given.evidence.problem, given.evidence.scene.cameras[0]
    names, units, m = parameter_names(camera), units_of(camera), len(problem.observations.rig)
    freedom, own = problem.freedom, len(prior.std)
    weak = np.r_[weak_of(camera), _weak_nuisances(m)]
    all_free = Freedom(
        intrinsics=(
            IntrinsicsPrior(
                np.column_stack([prior.directions, np.diag(units)]), np.r_[prior.std, weak[: len(names)]]
            ),
        ),
        mounts=freedom.mounts,
        nuisance=NuisancePrior(np.eye(OF_IMAGE * m + PRISM), weak[len(names) :]),
        start=freedom.start,
        model_error_std=freedom.model_error_std
        if model_error_std is None
        else np.full_like(freedom.model_error_std, model_error_std),
    )
    scene = given.evidence.scene
    steps = np.r_[
        scene.camera_steps[:own],
        beyond_prior(adjusted, prior) / units,
        scene.nuisances(freedom),
        scene.camera_steps[freedom.model_error_columns],
    ]
    wider = evidence(
        replace(scene, camera_steps=steps), replace(problem, freedom=all_free), given.evidence.noise
    )
    placed = replace(adjusted.most_likely, scene=wider.scene)
    equations, _ = equations_of(placed, replace(given, evidence=wider))
    solution = solve(equations, adjusted.log_sizes)
    hessian = equations.jacobian.T @ solution.weighed + equations.prior_information
    right = -(solution.weighed.T @ equations.residual + equations.prior_gradient)
    # What was adjusted: X, scale, base_from_world, the camera as far as it was free, and what its model leaves.
    base, end = POSES + own, POSES + all_free.nuisance_columns.stop
    size = 1 / np.sqrt(hessian.diagonal())
    kept, rest = np.r_[0:base, end : len(hessian)], np.arange(base, end)
    scaled = size[kept, None] * hessian[np.ix_(kept, kept)] * size[kept]
    coupling = hessian[np.ix_(kept, rest)]
    by_column = size[kept, None] * np.linalg.solve(scaled, size[kept, None] * coupling)
    depth, image = wider.view.depth, problem.observations.image
    distance = np.array([np.median(depth[image == k]) if (image == k).any() else np.nan for k in range(m)])
    return Alternatives(
        hessian=hessian[np.ix_(rest, rest)] - coupling.T @ by_column,
        right=right[rest] - by_column.T @ right[kept],
        x_by_column=-by_column[:6],
        images=m,
        dispersion=_dispersion(given.evidence),
        names=names,
        units=units,
        distance=np.where(np.isfinite(distance), distance, np.nanmedian(distance)),
        down_in_camera=-(adjusted.placed.z[0] @ adjusted.placed.scene.world_from_rig)[:, 2, :3],
    )


def freed_intrinsics(
    adjusted: Adjusted, prior: IntrinsicsPrior
) -> tuple[Float[ndarray, " q"], Float[ndarray, "q q"]]:
    """The parameters of a wrist camera one Gauss-Newton step on, with another prior about where they started, and their
    covariance."""
    given, start = adjusted.given, adjusted.given.evidence.problem.freedom.start[0]
    problem, scene = given.evidence.problem, given.evidence.scene
    freedom = replace(problem.freedom, intrinsics=(prior,))
    off = parameters(scene.cameras[0]) - parameters(start)
    steps = scene.camera_steps[problem.freedom.nuisance_columns.start :]
    wider = evidence(
        replace(scene, camera_steps=np.r_[np.linalg.pinv(prior.directions) @ off, steps]),
        replace(problem, freedom=freedom),
        given.evidence.noise,
    )
    equations, _ = equations_of(adjusted.most_likely, replace(given, evidence=wider))
    solution = solve(equations, adjusted.log_sizes)
    own = slice(POSES, POSES + len(prior.std))
    covariance = solution.covariance[own, own]
    found = parameters(scene.cameras[0]) + prior.directions @ solution.step[own]
    return found, prior.directions @ covariance @ prior.directions.T


def beyond_prior(adjusted: Adjusted, prior: IntrinsicsPrior) -> Float[ndarray, " q"]:
    """How far the parameters of a wrist camera went by what was freed beside its prior, from where they started."""
    evidence_of, own = adjusted.given.evidence, len(prior.std)
    freedom = evidence_of.problem.freedom
    steps = evidence_of.scene.camera_steps[freedom.intrinsics_columns[0]]
    return freedom.intrinsics[0].directions[:, own:] @ steps[own:]


def units_of(camera: Intrinsics) -> Float[ndarray, " q"]:
    """What its parameters count in: focal lengths in themselves, the centre in widths."""
    distortion = [1.0] * (len(parameter_names(camera)) - 4)
    return np.array([camera.fx, camera.fy, camera.width, camera.width, *distortion])


def weak_of(camera: Intrinsics) -> Float[ndarray, " q"]:
    """Standard deviations of its parameters, in their units, that only keep finite what the images cannot see."""
    return np.array([WEAK.get(name, WEAK_DISTORTION) for name in parameter_names(camera)])


def focal_lengths(camera: Intrinsics, images: int) -> Float[ndarray, "e p"]:
    """The combinations of columns of `Alternatives` that give every image a focal length of its own."""
    q = len(parameter_names(camera))
    out = np.zeros((q + OF_IMAGE * images + PRISM, images))
    out[:2, 0] = 1.0
    out[q : q + images, 1:] = differences(images)
    return out


def differences(count: int) -> Float[ndarray, "n d"]:
    """An orthonormal basis of what differs between this many, whose sum is 0."""
    return np.linalg.svd(np.eye(count) - 1 / count)[0][:, : count - 1]


def freed(freedom: Freedom, combinations: Float[ndarray, "e p"], camera: Intrinsics) -> Freedom:
    """A wrist camera's freedom with combinations of the columns of `Alternatives` free too.

    Parameters of the camera, in the units of `camera`, and of its images are freed each by themselves.
    """
    q, own = len(parameter_names(camera)), freedom.intrinsics[0]
    of_camera, of_images = spanned(combinations[:q]), spanned(combinations[q:])
    weak = _weak_nuisances((len(of_images) - PRISM) // OF_IMAGE)
    return replace(
        freedom,
        intrinsics=(
            IntrinsicsPrior(
                np.column_stack([own.directions, units_of(camera)[:, None] * of_camera]),
                np.r_[own.std, _std(of_camera, weak_of(camera))],
            ),
        ),
        nuisance=NuisancePrior(of_images, _std(of_images, weak)),
    )


def _weak_nuisances(images: int) -> Float[ndarray, " r"]:
    """Standard deviations of nuisances that only keep finite what the images cannot see."""
    of_images = np.repeat([WEAK_FOCAL, WEAK_SHEAR, WEAK_OFFSET, WEAK_OFFSET], images)
    return np.r_[of_images, np.full(PRISM, WEAK_PRISM)]


def _std(combinations: Float[ndarray, "n p"], of_each: Float[ndarray, " n"]) -> Float[ndarray, " p"]:
    """Of combinations, where each of what they combine has one."""
    return 1 / np.sqrt(((combinations / of_each[:, None]) ** 2).sum(0))


def spanned(combinations: Float[ndarray, "e p"]) -> Float[ndarray, "e r"]:
    """An orthonormal basis of what the combinations free; some may say the same."""
    u, size, _ = np.linalg.svd(combinations, full_matrices=False)
    return u[:, size > 1e-9 * size.max(initial=1e-300)]


def tested(
    equations: Alternatives, free: Float[ndarray, "e p"], beside: Float[ndarray, "e q"] | None = None
) -> Tested:
    """The test of freeing the combinations `free`, with those of `beside` free under both hypotheses."""
    beside = np.zeros((equations.columns, 0)) if beside is None else beside
    q, both = beside.shape[1], np.concatenate([beside, free], axis=1)
    fewer, more = spanned(beside), spanned(both)
    without, gain_without, _ = _step(equations, fewer)
    step, gain, covariance = _step(equations, more)
    spread, p = equations.dispersion, max(more.shape[1] - fewer.shape[1], 1)
    to_value = np.linalg.pinv(both)[q:] @ more
    return Tested(
        float(f_distribution.logsf(max(gain - gain_without, 0.0) / spread / p, p, equations.freedom)),
        spread * to_value @ covariance @ to_value.T,
        equations.x_by_column @ (more @ step - fewer @ without),
    )


def _step(
    equations: Alternatives, free: Float[ndarray, "e r"]
) -> tuple[Float[ndarray, " r"], float, Float[ndarray, "r r"]]:
    """How far these combinations go where they are free, what it gains, and the covariance."""
    covariance = np.linalg.inv(free.T @ equations.hessian @ free)
    right = free.T @ equations.right
    step = covariance @ right
    return step, float(right @ step), covariance


def _dispersion(images: ImageEvidence) -> float:
    """Of the weighted residuals, and no less than that of their sums over cells of the images (cluster sampling;
    Liang and Zeger, Biometrika 73, 1986)."""
    problem, view = images.problem, images.view
    weight = images.noise.weights(view.residual_px, view.depth, problem.layout)
    pull = weight[:, None] * view.residual_px
    taken = 3 * len(problem.points) + 6 * len(problem.seen.rows)
    share = max(1 - taken / (2 * len(weight)), 0.1)
    scale = 2 * weight.sum() * share
    clustered = sum(float((np.bincount(problem.layout.cell, along) ** 2).sum()) for along in pull.T)
    return max(float((pull**2).sum()), clustered) / scale
