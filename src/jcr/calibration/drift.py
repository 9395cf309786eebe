"""Sequential test whether camera, scene or robot changed since a calibration, by later images of the calibrated scene.

All later captures and the images of the calibration are one linear model of the reported poses. A change at capture k is
an additional effect on all captures from k on. Its Bayes factor against "no change" has a g-prior (Zellner 1986) on the
size of the change and is averaged over the error sizes. The sum of the Bayes factors of all k is Shiryaev and Roberts'
statistic: without a change its mean grows by 1 with each capture, so that alarms above ODDS are at least ODDS captures
apart on average (Pollak, Ann. Statist. 13, 1985).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from pydantic import Field
from scipy.linalg import block_diag
from scipy.special import chndtrinc, logsumexp

from jcr.distributions import chi2
from jcr.estimation.elimination import cholesky, log_root_determinant, lower
from jcr.estimation.pose_equations import pose_residuals, weak_prior
from jcr.estimation.problem import ROTATION, TRANSLATION, UNKNOWNS, columns_of_arm
from jcr.estimation.robot_noise import REACH, TYPICAL, Equations, LogSizes, most_likely, of_poses
from jcr.geometry import Poses, Transform, retract, skew
from jcr.records.json_fields import Covariance6, Matrix, Numbers, Part, Spread

ODDS = 1000.0
"""Sum of the Bayes factors from which a change is reported: at most 0.1 false alarms per hundred captures."""
PRIOR_SIZES = 4.0 ** np.array([1, 2, 3, 5, 7, 9])
"""Prior variances of a change over that of its estimate, averaged: changes of 2 to 512 σ. The small ones
matter for what is just found, the large ones for the cause of an obvious change; twice or half of all changes what is
found by 3 %."""
ROBOT_SIZES = TYPICAL[2] * np.array([0.3, 1.0, 3.0, 10.0])
"""Sizes σ_s (rad) of a change of the robot's systematic errors: from typical ones of good arms to 1° in each joint."""
CLEAR_CAUSE = 5.0
"""Difference of log evidence from which two causes are distinguished (150 to 1)."""
POWER = 0.9
"""Probability of detecting a change of the size `detectable`."""
VIEWS_ALIKE = 0.3
"""Distance of two views (as robot_noise.ALIKE) with the correlation e^(−1/2) of the errors that the points of the scene
cause; half or twice of it changes the detectable drift by less than 5 %."""
LEVELS, FINE, WIDE = (-2.0, 0.0, 2.0), (-2.0, -1.0, 0.0, 1.0, 2.0), 0.5
"""Grid of log error sizes along each axis, in standard deviations from the mode; a finer one for larger ones."""
CHANGE_STD = (0.1, 0.3)
"""Prior standard deviations (m, rad) of a change that is adopted; they exceed those that can be located."""
BEFORE, COARSE = 4, 0.05
"""Number of captures before the newest from which error sizes are estimated, and the last step (log) of their estimate:
the grid is coarser."""
EQUAL = np.repeat([1e-3, np.radians(0.1)], 3)
"""Steps (m, rad) of equal weight in the choice of poses: at 0.5 m they move a point equally far."""
MOST_OLD = 30
"""Largest number of images of the calibration that are used; their errors are then a small part of a new image's."""
MOTION_SETTLED, ITERATIONS = 1e-6, 10
"""Largest step (m, rad) at which the iterations end, and largest number of iterations."""

Cause = Literal["camera", "scene", "robot", "image"]
"""Change of gripper_from_camera, of base_from_scene, or of the errors of all reported poses; or one wrong pose."""


class Located(Part):
    """Images of one capture whose camera poses in the calibrated scene are known."""

    base_from_gripper: tuple[Matrix, ...]
    recon_from_camera: tuple[Matrix, ...]
    covariance: tuple[Covariance6, ...]
    """Covariances of steps of the camera poses (geometry.retract): translation in recon units, rotation (rad)."""
    joints: tuple[Numbers, ...] | None = None
    """Joint angles (rad) at the images; None: unknown."""

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.base_from_gripper)


class Change(Part):
    """Change that was found; it acts on all captures from `first` on."""

    cause: Cause
    rivals: tuple[Cause, ...] = ()
    """Causes that explain the captures nearly as well. Such a change is tested again with the next capture."""
    first: int
    """Index of the first capture after the change."""
    named: int
    """Index of the capture with which the change was found."""
    motion: Numbers = Field(default_factory=lambda: np.zeros(6))
    """Step of gripper_from_camera (gripper axes) or base_from_scene (base axes): m, rad. Zero for the robot."""
    size: Spread = 0.0
    """Size σ_s (rad) of a change of the robot's systematic errors."""


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Calibration, with the poses of its images, against which later captures are tested."""

    x: Transform
    """gripper_from_camera."""
    scale: float
    """Metres per recon unit."""
    z: Transform
    """base_from_recon."""
    base_from_gripper: Poses
    recon_from_camera: Poses
    noise_floor: tuple[float, float] | None = None
    """Lower bounds (m, rad) of the random errors of the poses, if given."""


class SeriesCheck(NamedTuple):
    """Test of the newest of a series of captures together with those before it."""

    log_odds: float
    """Logarithm of the sum of Bayes factors: the evidence for a change of camera or scene at any of the captures."""
    detectable: tuple[float, float]
    """Translation (m) and rotation (rad), in the worst direction, of a change of the camera at the newest capture that
    this test finds with probability POWER."""
    changes: tuple[Change, ...]
    """All changes, with a new one at the end if `log_odds` exceeds the limit."""
    wrong_image: int | None = None
    """Index of the image of the newest capture whose pose contradicts the others; None: there is none."""


class Step(Part):
    """Step of the camera or the scene from the calibration to one capture: m, then rad."""

    step: Numbers
    """Translation and rotation vector, in gripper axes (camera) or base axes (scene)."""
    covariance: Covariance6
    p_value: Spread
    """Chance of a step as large if nothing moved."""


class _Model(NamedTuple):
    """Equations of calibration and later captures with the columns of possible changes."""

    equations: Equations
    capture: Int[ndarray, " s"]
    """Index of the capture of each residual; −1 for those of the calibration."""
    nuisance: Float[ndarray, "s e"]
    """Columns of adopted changes, whitened by their priors."""
    by_camera: Float[ndarray, "s 6"]
    by_scene: Float[ndarray, "s 6"]

    def columns(self, cause: Cause, image: int = 0) -> Float[ndarray, "s q"]:
        """Return the derivative of the residuals by a change; `image` is the index of a wrong pose among all poses."""
        if cause == "robot":
            return _root(self.equations.systematic, self.capture >= 0)
        if cause == "image":
            return np.eye(len(self.capture))[:, 6 * image : 6 * image + 6]
        return self.by_camera if cause == "camera" else self.by_scene

    def by_capture(self, columns: Float[ndarray, "s q"]) -> Float[ndarray, "s c"]:
        """Return the columns apart for each capture, side by side."""
        return np.concatenate(
            [columns * (self.capture == k)[:, None] for k in range(self.capture[-1] + 1)], axis=1
        )


def check_series(
    reference: Reference,
    captures: Sequence[Located],
    systematic: Float[ndarray, "s s"],
    changes: Sequence[Change] = (),
    before: int = 0,
) -> SeriesCheck:
    """Test the newest of `captures` (oldest first) and those before it for a change that `changes` does not contain.

    `systematic` (s,s) is the covariance of systematic errors of all reported poses, those of the calibration first, as
    in Equations. `before` is the number of older captures, which are counted by the indices of changes only. If the
    cause of the last change is not clear, that change is tested again.
    """
    n, decided = len(captures), [one for one in changes if not one.rivals]
    adopted = [one.model_copy(update={"first": one.first - before}) for one in decided]
    begin = min(max([one.named + 1 - before for one in decided], default=0), n - 1)
    data: _Data = reference, captures, systematic, adopted
    model = _model(*data)
    sizes = _sizes(model)
    columns = np.concatenate([model.by_capture(one) for one in (model.by_camera, model.by_scene)], axis=1)
    at = [_Solved.of(model, log_sizes, columns) for log_sizes in sizes]
    share = np.array([one.log_weight for one in at])
    share -= logsumexp(share)
    log_factors, likely = np.full((2, n), -np.inf), share
    for cause, k in product(range(2), range(max(begin, 0), n)):
        # A change before capture k: the sum of the columns of the captures from k on.
        each = [one.summed(np.r_[6 * (n * cause + k) : 6 * n * (cause + 1)]).log_factor for one in at]
        log_factors[cause, k] = logsumexp(share + each)
        # The sizes with a change count, too: a change is no noise.
        likely = np.logaddexp(likely, share + each)
    log_odds = float(logsumexp(log_factors) - np.log(2))
    newest = at[int(likely.argmax())].summed(np.r_[6 * (n - 1) : 6 * n])
    found = SeriesCheck(log_odds, detectable(np.linalg.inv(newest.information)), tuple(decided))
    if log_odds < np.log(ODDS):
        return found
    change = _explained(data, sizes, log_factors)
    wrong = change.first if change.cause == "image" else _wrong_image((*data[:3], [*adopted, change]), sizes)
    if wrong is not None:
        return found._replace(wrong_image=wrong)
    named = {"first": change.first + before, "named": n - 1 + before}
    return found._replace(changes=(*decided, change.model_copy(update=named)))


def step_of(
    reference: Reference,
    capture: Located,
    systematic: Float[ndarray, "s s"],
    cause: Literal["camera", "scene"],
    changes: Sequence[Change] = (),
) -> Step:
    """Return the step of camera or scene from the calibration to one capture, without the other captures.

    The step is in gripper axes (camera) or base axes (scene). `changes` of the other cause are assumed as they are.
    """
    known = [one.model_copy(update={"first": 0}) for one in changes if one.cause != cause]
    model = _model(reference, [capture], systematic, known)
    sizes = _sizes(model)
    motion, at = _iterated((reference, [capture], systematic, known), sizes, cause, 0)
    share = np.array([one.log_weight + one.log_factor for one in at])
    share = np.exp(share - logsumexp(share))
    best = at[int(share.argmax())]
    p_value = float(share @ [chi2.sf(one.squared, 6) for one in at])
    return Step(step=motion, covariance=np.linalg.inv(best.information), p_value=p_value)


def most_telling(
    reference: Reference, candidates: Located, systematic: Float[ndarray, "s s"], count: int
) -> list[tuple[int, tuple[float, float]]]:
    """Return the `count` poses at which new images would tell most about the camera, best first.

    Each is an index of `candidates` with the `detectable` change (m, rad) of the camera by the images up to this one. A
    greedy search reduces the variance of the camera's step, for a scene that may have moved too. `systematic` is the
    covariance of systematic errors at the poses of the calibration, then of the candidates.
    """
    old, chosen, found = (
        len(reference.base_from_gripper),
        list[int](),
        list[tuple[int, tuple[float, float]]](),
    )
    sizes, scene = None, np.diag(np.r_[np.zeros(6), np.repeat(CHANGE_STD, 3) ** -2.0])

    def solved(rows: list[int]) -> _Solved:
        nonlocal sizes
        taken = {name: part and tuple(part[row] for row in rows) for name, part in vars(candidates).items()}
        own = of_poses(systematic, np.r_[:old, old + np.array(rows)])
        model = _model(reference, [Located(**taken)], own, ())
        sizes = sizes or _sizes(model)
        columns = np.concatenate([model.by_camera, model.by_scene], axis=1)
        return _Solved.of(model, sizes[len(sizes) // 2], columns)  # the mode is the middle of the grid

    def variance(rows: list[int]) -> float:
        covariance = np.linalg.inv(solved(rows).information + scene)[:6, :6]
        return float((np.diag(covariance) / EQUAL**2).sum())

    while len(chosen) < min(count, len(candidates)):
        left = [row for row in range(len(candidates)) if row not in chosen]
        chosen.append(min(left, key=lambda row: variance([*chosen, row])))
        information = solved(chosen).information[:6, :6]
        found.append((chosen[-1], detectable(np.linalg.inv(information))))
    return found


@cache
def _critical() -> float:
    """Return χ² of six degrees of freedom at which the Bayes factor of one capture and cause reaches the limit."""
    squared = np.linspace(10.0, 100.0, 9001)
    return float(np.interp(np.log(2 * ODDS), [_log_g_factor(one, 6) for one in squared], squared))


def detectable(covariance: Float[ndarray, "6 6"], critical: float | None = None) -> tuple[float, float]:
    """Return translation (m) and rotation (rad), in the worst direction, that a test detects with probability POWER.

    `covariance` is that of an estimated step. `critical` is the limit of the test's χ² of six degrees of freedom; None:
    that of one capture of a series.
    """
    length = np.sqrt(chndtrinc(critical or _critical(), 6, 1 - POWER))
    worst = [np.sqrt(np.linalg.eigvalsh(covariance[part, part])[-1]) for part in (TRANSLATION, ROTATION)]
    return float(length * worst[0]), float(length * worst[1])


@dataclass(frozen=True)
class _Solved:
    """Model for one choice of error sizes, after all unknowns are eliminated: its evidence, and that of a change."""

    log_weight: float
    """Log evidence without the change, up to a constant."""
    gradient: Float[ndarray, " q"]
    information: Float[ndarray, "q q"]
    size: float | None = None
    """Prior standard deviation of independent parameters; None: a g-prior."""

    @staticmethod
    def of(
        model: _Model, log_sizes: LogSizes, columns: Float[ndarray, "s q"], size: float | None = None
    ) -> "_Solved":
        """Return the solution for log sizes (3,) with `columns`, the derivative of the residuals by the change."""
        equations, p = model.equations, UNKNOWNS + model.nuisance.shape[1]
        root = cholesky(equations.covariance(log_sizes))
        parts = equations.jacobian, model.nuisance, equations.residual, columns
        whole = lower(root, np.column_stack(parts))
        unknown, rest = whole[:, :p], whole[:, p:]
        prior = np.asarray(block_diag(equations.prior_information, np.eye(p - UNKNOWNS)))
        of_unknown = cholesky(unknown.T @ unknown + prior)
        taken = lower(of_unknown, unknown.T @ rest)
        gram = rest.T @ rest - taken.T @ taken
        of_prior, middle, _ = equations.prior
        squares = gram[0, 0] + ((of_prior @ log_sizes - middle) ** 2).sum()
        log_weight = -log_root_determinant(root) - log_root_determinant(of_unknown) - squares / 2
        return _Solved(float(log_weight), gram[0, 1:], gram[1:, 1:], size)

    def summed(self, columns: Int[ndarray, " c"]) -> "_Solved":
        """Return the solution for a step (6) that is the sum of these columns, which are steps of six each."""
        gradient = self.gradient[columns].reshape(-1, 6).sum(0)
        information = (
            self.information[np.ix_(columns, columns)].reshape(-1, 6, len(columns) // 6, 6).sum((0, 2))
        )
        return replace(self, gradient=gradient, information=information)

    @property
    def estimate(self) -> Float[ndarray, " q"]:
        """Parameters of the change by least squares."""
        return -np.linalg.solve(self.information, self.gradient)

    @property
    def squared(self) -> float:
        """χ² of the estimate."""
        return float(-self.gradient @ self.estimate)

    @property
    def log_factor(self) -> float:
        """Logarithm of the Bayes factor of the change against none."""
        if self.size is None:
            return _log_g_factor(self.squared, len(self.gradient))
        # For a prior of independent parameters: information and gradient in units of the prior.
        root = cholesky(np.eye(len(self.gradient)) + self.size**2 * self.information)
        half = lower(root, self.size * self.gradient[:, None])
        return float((half**2).sum() / 2 - log_root_determinant(root))


def _log_g_factor(squared: float, q: int) -> float:
    """Return the log Bayes factor of q parameters whose estimate has χ² `squared`, with g-priors of PRIOR_SIZES."""
    each = squared / 2 * PRIOR_SIZES / (1 + PRIOR_SIZES) - q / 2 * np.log1p(PRIOR_SIZES)
    return float(logsumexp(each) - np.log(len(PRIOR_SIZES)))


_Data = tuple[Reference, Sequence[Located], Float[ndarray, "s s"], Sequence[Change]]
"""Calibration, captures, covariance of systematic errors and adopted changes: arguments of `_model`."""


def _explained(data: _Data, sizes: Sequence[LogSizes], log_factors: Float[ndarray, "2 n"]) -> Change:
    """Return the most likely change: of the camera, the scene, the robot's errors, or one wrong pose.

    `log_factors` are the log Bayes factors of a change of camera or scene at each of the n captures.
    """
    model, last = _model(*data), len(data[1]) - 1
    evidence, made = dict[Cause, float](), dict[Cause, Change]()
    causes: tuple[Cause, ...] = ("camera", "scene")
    for cause, row in zip(causes, log_factors, strict=True):
        first = int(row.argmax())
        motion, at = _iterated(data, sizes, cause, first)
        # Other first captures are nearly as likely; their sum is the evidence of the cause.
        evidence[cause] = _total(at) + float(logsumexp(row) - row[first])
        made[cause] = Change(cause=cause, first=first, named=last, motion=motion)
    first = made[max(evidence, key=evidence.__getitem__)].first
    own = model.columns("robot") * (model.capture >= first)[:, None]
    each = [_total([_Solved.of(model, one, own, size) for one in sizes]) for size in ROBOT_SIZES]
    evidence["robot"] = float(logsumexp(each) - np.log(len(each)))
    made["robot"] = Change(cause="robot", first=first, named=last, size=float(ROBOT_SIZES[np.argmax(each)]))
    if len(each := _image_evidence(data, sizes)):
        evidence["image"] = float(logsumexp(each) - np.log(len(each)))
        made["image"] = Change(cause="image", first=int(each.argmax()), named=last)
    best = max(evidence, key=evidence.__getitem__)
    near = (
        one for one in evidence if one not in (best, "image") and evidence[best] - evidence[one] < CLEAR_CAUSE
    )
    return made[best].model_copy(update={"rivals": tuple(near)})


def _wrong_image(data: _Data, sizes: Sequence[LogSizes]) -> int | None:
    """Return the index of the image of the newest capture whose pose contradicts the rest beside all changes, if any."""
    factors = _image_evidence(data, sizes) - logsumexp(
        [_Solved.of(_model(*data), one, np.zeros((len(data[2]), 0))).log_weight for one in sizes]
    )
    return int(factors.argmax()) if factors.max(initial=-np.inf) > np.log(ODDS) else None


def _image_evidence(data: _Data, sizes: Sequence[LogSizes]) -> Float[ndarray, " k"]:
    """Return the log evidence that the pose of one image of the newest capture is wrong; empty for two images or one."""
    model, count = _model(*data), len(data[1][-1])
    last = range(len(model.capture) // 6 - count, len(model.capture) // 6)
    return np.array([_total([_Solved.of(model, one, model.columns("image", k)) for one in sizes])
                     for k in (last if count > 2 else ())])  # fmt: skip


def _total(at: Sequence[_Solved]) -> float:
    """Return the log evidence of a change, summed over the sizes."""
    return float(logsumexp([one.log_weight + one.log_factor for one in at]))


def _iterated(
    data: _Data, sizes: Sequence[LogSizes], cause: Cause, first: int
) -> tuple[Float[ndarray, "6"], list[_Solved]]:
    """Return the step of camera or scene from capture `first` on, and the solutions linearised there, one per size."""

    def linearised(motion: Float[ndarray, "6"], sizes: Sequence[LogSizes]) -> list[_Solved]:
        model = _model(*data, Change(cause=cause, first=first, named=first, motion=motion))
        columns = model.columns(cause) * (model.capture >= first)[:, None]
        # Extrapolated to no motion, so that estimate and evidence are those of the whole motion.
        whole = replace(model.equations, residual=model.equations.residual - columns @ motion)
        return [_Solved.of(model._replace(equations=whole), one, columns) for one in sizes]

    motion, likeliest = np.zeros(6), sizes
    for _ in range(ITERATIONS):
        at = linearised(motion, likeliest)
        best = int(np.argmax([one.log_weight + one.log_factor for one in at]))
        step, likeliest = at[best].estimate - motion, [likeliest[best]]
        motion = motion + step
        if np.abs(step).max() < MOTION_SETTLED:
            break
    return motion, linearised(motion, sizes)


def _sizes(model: _Model) -> list[LogSizes]:
    """Return a grid of log error sizes about their mode for the calibration and the captures before the newest.

    Camera and scene are free in each capture, so that a change does not enlarge the sizes.
    """
    free = [model.by_capture(one * np.repeat(CHANGE_STD, 3)) for one in (model.by_camera, model.by_scene)]
    jacobian = np.concatenate([model.equations.jacobian, model.nuisance, *free], axis=1)
    added = jacobian.shape[1] - UNKNOWNS
    whole = replace(
        model.equations,
        jacobian=jacobian,
        prior_information=np.asarray(block_diag(model.equations.prior_information, np.eye(added))),
        prior_gradient=np.zeros(UNKNOWNS + added),
    )
    capture = model.capture[::6]
    last = capture[-1]
    poses = np.flatnonzero((capture < 0) | ((capture < last) & (capture >= last - BEFORE)))
    mode, information = most_likely(whole.of_poses(poses), settled=COARSE)
    values, vectors = np.linalg.eigh(information)
    std = 1 / np.sqrt(values)
    levels = [FINE if one > WIDE else LEVELS for one in std]
    return [mode + vectors @ (std * level) for level in product(*levels)]


def _model(
    reference: Reference,
    captures: Sequence[Located],
    systematic: Float[ndarray, "s s"],
    changes: Sequence[Change],
    tested: Change | None = None,
) -> _Model:
    """Return the equations of calibration and captures, linearised at adopted changes and at the one that is tested."""
    old, arms = len(reference.base_from_gripper), columns_of_arm(0)
    capture = np.repeat(np.arange(-1, len(captures)), [old, *map(len, captures)])
    gripper, camera = (
        np.concatenate([np.stack(getattr(one, name)) for one in (reference, *captures)])
        for name in ("base_from_gripper", "recon_from_camera")
    )
    residual, jacobian = np.zeros((len(gripper), 6)), np.zeros((len(gripper), 6, UNKNOWNS))
    by_camera_pose = np.zeros((len(gripper), 6, 6))
    for k in range(-1, len(captures)):
        at, x, z = capture == k, reference.x, reference.z
        for change in (*changes, *(() if tested is None else (tested,))):
            if k >= change.first:
                x = retract(x, change.motion) if change.cause == "camera" else x
                z = retract(z, change.motion) if change.cause == "scene" else z
        residual[at], jacobian[at] = pose_residuals(x, reference.scale, z, gripper[at], camera[at])
        by_camera_pose[at, :3, :3] = reference.scale * z[:3, :3]
        by_camera_pose[at, :3, 3:] = z[:3, :3] @ skew(camera[at, :3, :3] @ x[:3, :3].T @ x[:3, 3])
        by_camera_pose[at, 3:, 3:] = z[:3, :3]
    is_new = np.repeat(capture >= 0, 6)
    known = np.zeros((len(is_new), len(is_new)))
    known[np.ix_(is_new, is_new)] = _camera_errors(captures, by_camera_pose[capture >= 0])
    equations = Equations(
        residual=residual.ravel(),
        jacobian=jacobian.reshape(-1, UNKNOWNS),
        prior_information=weak_prior(),
        prior_gradient=np.zeros(UNKNOWNS),
        systematic=systematic,
        known=known,
        given=reference.noise_floor,
    )
    by_camera, by_scene = (
        equations.jacobian[:, arms[part]] * is_new[:, None] for part in (slice(0, 6), slice(6, 12))
    )
    model = _Model(equations, np.repeat(capture, 6), np.zeros((len(is_new), 0)), by_camera, by_scene)
    columns = [model.nuisance]
    for change in changes:
        size = change.size if change.cause == "robot" else np.repeat(CHANGE_STD, 3)
        columns.append(model.columns(change.cause) * (model.capture >= change.first)[:, None] * size)
    return model._replace(nuisance=np.concatenate(columns, axis=1))


def _camera_errors(captures: Sequence[Located], by_pose: Float[ndarray, "n 6 6"]) -> Float[ndarray, "s s"]:
    """Return the covariance (s,s) of the residuals, s = 6n, from errors of the n camera poses of all captures.

    The noise of its pixels makes the error of each image. The errors of the scene's points and of the intrinsics recur
    in all images from one view; they are assumed to be as large. Half or twice of it changes the detectable drift by
    less than 10 %, and keeps the mean of many captures from being believed to be exact.
    """
    covariance = np.concatenate([np.stack(one.covariance) for one in captures])
    root = by_pose @ np.linalg.cholesky(covariance)
    gripper = np.concatenate([np.stack(one.base_from_gripper) for one in captures])
    views = np.concatenate(
        [gripper[:, :3, :3].reshape(-1, 9) / np.sqrt(2), gripper[:, :3, 3] / REACH], axis=1
    )
    apart = ((views[:, None] - views) ** 2).sum(-1)
    alike = np.exp(-apart / (2 * VIEWS_ALIKE**2)) + np.eye(len(views))
    n = len(root)
    return np.einsum("ab,aij,bkj->aibk", alike, root, root).reshape(6 * n, 6 * n)


def _root(covariance: Float[ndarray, "s s"], rows: ndarray) -> Float[ndarray, "s q"]:
    """Return columns L with L Lᵀ = covariance in these rows, and 0 in all others; the smallest parts are left out."""
    values, vectors = np.linalg.eigh(covariance[np.ix_(rows, rows)])
    kept = values > 1e-4 * values[-1]
    out = np.zeros((len(covariance), int(kept.sum())))
    out[rows] = vectors[:, kept] * np.sqrt(values[kept])
    return out
