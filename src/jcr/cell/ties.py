"""The robots' say: each arm ties rigs of the images' scene to its base, and gives it the metre.

The rigs that an arm moves obey `base_from_gripper[i] · X = base_from_world · S_λ(world_from_rig[i])`
(handeye/equation.py), with one X and one base_from_world an arm and one λ for the whole scene. Where the camera stands
fixed and what it sees is carried by the gripper, the roles are exchanged: the world is the carried thing, and the
equation is that of the inverse poses, with base_from_camera in place of X and gripper_from_world in place of
base_from_world; the errors are still those of the reported poses. Every other transform of the cell follows from these
and from what the images say.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.adjust.intrinsics_prior import off_by
from jcr.cell.bundle import Imaged, Scene, stepped
from jcr.geometry import inverse, retract, skew, step_between
from jcr.handeye.components import Equations, most_likely, posterior, solve
from jcr.handeye.equation import PRIOR_STD, SCALE, Poses, predict, residuals, residuals_by_camera
from jcr.handeye.systematic import Region
from jcr.least_squares import one_blas_thread

LARGEST_TURN = 0.5
"""rad, and of the logarithm of scale, in one step."""
STEPS = 30
TINY_STEP = 1e-6
"""m, rad, or standard deviations of what is small: for derivatives by differences."""


@dataclass(frozen=True)
class Tie:
    """One arm and the rigs that it moves."""

    rigs: Int[ndarray, " n"]
    base_from_gripper: Poses
    """As reported."""
    systematic: Float[ndarray, "s s"]
    """Covariance of their systematic errors at 1 rad."""
    start: tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]]
    """X and the transform from the world, scaled, to the frame in which X is sought."""
    exchanged: bool = False
    """The camera stands still and the arm carries what it sees."""


@dataclass(frozen=True)
class Placed:
    """Where everything is, in metres."""

    x: Float[ndarray, "a 4 4"]
    """Of each arm: gripper_from_rig, or base_from_camera where roles are exchanged."""
    scale: float
    """Metres per unit of the world."""
    z: Float[ndarray, "a 4 4"]
    """Of each arm: base_from_world, or gripper_from_world; of the scaled world."""
    scene: Scene


@dataclass(frozen=True)
class Answer:
    """The cell as robots and images have it together."""

    placed: Placed
    covariance: Float[ndarray, "p p"]
    """Of steps as `moved` takes them."""
    noise: tuple[float, float]
    """m, rad per axis: the robots' random errors."""
    systematic_left: tuple[float, float]
    imaged: Imaged
    free: Int[ndarray, " e"]
    """Columns of Imaged.covariance that are unknowns here: intrinsics, mounts, and rigs that no arm moves."""

    def moved(self, step: Float[ndarray, " p"]) -> Placed:
        """Everything after a step: X, log scale, base of the first arm; X and base of others; then the `free` ones."""
        return _moved(self.placed, step, self.imaged, self.free)

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
        lenses = 12 * len(self.placed.x) + 1
        size[lenses:] = np.minimum(1e-2 * std[lenses:], 1e-2) + 1e-9
        j = np.empty((6, len(size)))
        for k, small in enumerate(size):
            step = np.zeros(len(size))
            step[k] = small
            ahead, behind = of(self.moved(step)), of(self.moved(-step))
            j[:, k] = (step_between(found, ahead) - step_between(found, behind)) / (2 * small)
        return j


@one_blas_thread
def tied(
    imaged: Imaged, ties: Sequence[Tie], scale: float, noise: tuple[float, float] | None = None
) -> Answer:
    """The cell from its images and the arms' poses, averaged over the sizes of the robots' errors.

    `scale` is where the search starts; `noise` (m, rad) is that of the gripper poses, at least. All arms are taken to be
    equally exact.
    """
    first = imaged.freedom.first_rig
    moving = np.concatenate([tie.rigs for tie in ties])
    by_arm = (first + 6 * moving[:, None] + np.arange(6)).ravel()
    free = np.setdiff1d(np.arange(len(imaged.covariance)), by_arm)
    placed = Placed(
        np.stack([tie.start[0] for tie in ties]),
        scale,
        np.stack([tie.start[1] for tie in ties]),
        imaged.scene,
    )
    given = _Given(imaged, tuple(ties), by_arm, free, noise)
    log_sizes = None
    for _ in range(STEPS):
        equations, _ = _equations(placed, given)
        log_sizes, _ = most_likely(equations, log_sizes)
        solution = solve(equations, log_sizes)
        of_robots = 12 * len(ties) + 1
        step = np.r_[solution.step[:of_robots], np.zeros(len(free))]
        turns = np.r_[SCALE, *(_columns(arm)[[3, 4, 5, 9, 10, 11]] for arm in range(len(ties)))]
        step *= min(1.0, LARGEST_TURN / max(float(np.abs(step[turns]).max()), 1e-300))
        placed = _moved(placed, step, imaged, free)
        if float(((solution.information_root.T @ step) ** 2).sum()) < 1e-12:
            break
    equations, region = _equations(placed, given)
    log_sizes, information = most_likely(equations, log_sizes)
    found = posterior(equations, log_sizes, information, region)
    sigma_t, sigma_r = np.sqrt(equations.variances(log_sizes)[:2]).tolist()
    return Answer(
        _moved(placed, found.step, imaged, free),
        _with_lenses_off(found.covariance, imaged, 12 * len(ties) + 1),
        (sigma_t, sigma_r),
        equations.systematic_left(log_sizes),
        imaged,
        free,
    )


@dataclass(frozen=True)
class _Given:
    imaged: Imaged
    ties: tuple[Tie, ...]
    by_arm: Int[ndarray, " s"]
    """Columns of Imaged.covariance: rigs that arms move, in the order of the residuals."""
    free: Int[ndarray, " e"]
    noise: tuple[float, float] | None


def _columns(arm: int) -> Int[ndarray, "12"]:
    """Of an arm's X and base among the unknowns."""
    return np.delete(np.arange(13), SCALE) if arm == 0 else np.arange(1 + 12 * arm, 13 + 12 * arm)


def _equations(placed: Placed, given: _Given) -> tuple[Equations, Region]:
    """Residuals of the reported gripper poses, linear in all unknowns; what the images say of the rigs is in them."""
    ties, covariance = given.ties, given.imaged.covariance
    rows, robots = len(given.by_arm), 12 * len(ties) + 1
    residual, jacobian, by_rig = np.zeros(rows), np.zeros((rows, robots)), np.zeros((rows, rows))
    systematic, begin = np.zeros((rows, rows)), 0
    for arm, tie in enumerate(ties):
        rigs = placed.scene.world_from_rig[tie.rigs]
        x, z = placed.x[arm], placed.z[arm]
        reported = inverse(tie.base_from_gripper) if tie.exchanged else tie.base_from_gripper
        of_arm, by_unknown = residuals(x, placed.scale, z, reported, rigs)
        by_its_rig = residuals_by_camera(x, placed.scale, z, rigs)
        if tie.exchanged:
            predicted = predict(x, placed.scale, z, rigs)
            of_arm = step_between(tie.base_from_gripper, inverse(predicted))
            by_unknown, by_its_rig = (_by_inverse(predicted) @ part for part in (by_unknown, by_its_rig))
        size = 6 * len(tie.rigs)
        mine = slice(begin, begin + size)
        residual[mine] = of_arm.ravel()
        flat = by_unknown.reshape(size, 13)
        jacobian[mine, SCALE] = flat[:, SCALE]
        jacobian[mine, _columns(arm)] = np.delete(flat, SCALE, axis=1)
        for k in range(len(tie.rigs)):
            at = slice(begin + 6 * k, begin + 6 * k + 6)
            by_rig[at, at] = by_its_rig[k]
        systematic[mine, mine] = tie.systematic
        begin += size
    by_arm, free = given.by_arm, given.free
    of_free = _inverted(covariance[np.ix_(free, free)])
    together = covariance[np.ix_(by_arm, free)]
    by_free = by_rig @ together @ of_free
    known = by_rig @ (covariance[np.ix_(by_arm, by_arm)] - together @ of_free @ together.T) @ by_rig.T
    count = robots + len(free)
    prior = np.zeros((count, count))
    prior[range(7), range(7)] = PRIOR_STD**-2.0
    for arm in range(1, len(ties)):
        own = _columns(arm)[:6]
        prior[own, own] = PRIOR_STD[:6] ** -2.0
    prior[robots:, robots:] = of_free
    region = Region.of_unknowns(np.delete(jacobian, SCALE, axis=1), count)
    return (
        Equations(
            residual,
            np.concatenate([jacobian, by_free], axis=1),
            prior,
            np.zeros(count),
            (known + known.T) / 2,
            region.left(systematic),
            given.noise,
        ),
        region,
    )


def _by_inverse(a_from_b: Poses) -> Float[ndarray, "n 6 6"]:
    """Matrices that take steps of transforms to those of their inverses."""
    rotation_t = np.swapaxes(a_from_b[:, :3, :3], 1, 2)
    out = np.zeros((len(a_from_b), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = -rotation_t
    out[:, :3, 3:] = -rotation_t @ skew(a_from_b[:, :3, 3])
    return out


def _inverted(covariance: Float[ndarray, "e e"]) -> Float[ndarray, "e e"]:
    """Of a covariance whose rows are of different units, and in part exact."""
    size = np.sqrt(np.maximum(covariance.diagonal(), 1e-24))
    scaled = covariance / np.outer(size, size) + 1e-9 * np.eye(len(size))
    return np.linalg.inv(scaled) / np.outer(size, size)


def _moved(placed: Placed, step: Float[ndarray, " p"], imaged: Imaged, free: Int[ndarray, " e"]) -> Placed:
    arms = len(placed.x)
    own = np.stack([step[_columns(arm)] for arm in range(arms)])
    of_images = np.zeros(len(imaged.covariance))
    of_images[free] = step[12 * arms + 1 :]
    return Placed(
        retract(placed.x, own[:, :6]),
        float(placed.scale * np.exp(step[6])),
        retract(placed.z, own[:, 6:]),
        stepped(placed.scene, imaged.freedom, of_images) if of_images.any() else placed.scene,
    )


def _with_lenses_off(covariance: Float[ndarray, "p p"], imaged: Imaged, first: int) -> Float[ndarray, "p p"]:
    """With what features of the images leave wrong in the intrinsics, and all that follows them."""
    freedom = imaged.freedom
    off = np.zeros((freedom.lenses_end, freedom.lenses_end))
    for free, camera, columns in zip(freedom.lenses, imaged.scene.cameras, freedom.lens_columns, strict=True):
        off[columns, columns] = off_by(free, camera)
    own = slice(first, first + len(off))
    follows = np.linalg.solve(covariance[own, own], covariance[own]).T
    return covariance + follows @ off @ follows.T
