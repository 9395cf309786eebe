"""Effects on one camera: a focal length that varies, a rolling shutter, a thin prism, intrinsics that are wrong.

Each is a hypothesis of estimation/hypotheses.py, tested beside a focal length that is wrong by one factor in all images.
The images are adjusted with the effect free, which shows its size and the motion of the camera that comes with it.
"""

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.adjust import adjust_case, focal_of_each
from jcr.calibration.case import Case, some_points
from jcr.camera import parameter_names, parameters
from jcr.distributions import f as f_distribution
from jcr.estimation.hypotheses import (
    Alternatives,
    Row,
    ScoreTest,
    alternatives,
    beyond_prior,
    differences,
    first_x,
    nuisances_of,
    spanned,
    test_combinations,
)
from jcr.estimation.intrinsics_prior import TYPICAL, CameraPrior
from jcr.estimation.problem import OF_IMAGE, PRISM, State
from jcr.estimation.solve import Solution
from jcr.estimation.wrist import recon_frame
from jcr.findings import Concerns, Finding, FindingKind
from jcr.geometry import step_between
from jcr.records import Intrinsics

LOG_P = float(np.log(1e-6))
"""Logarithm of the probability of a false alarm of one effect, over all places of a change."""
LOG_P_GIVEN = float(np.log(1e-4))
"""LOG_P of given intrinsics: one hypothesis of a camera, whose finding also needs a difference that matters."""
MATERIAL = 0.5
"""Standard deviations by which an effect must move the camera on some axis to be reported."""
OF_FIRST_STEP = 0.2
"""Share of MATERIAL that the first step towards a fault must reach before it is adjusted."""
MOST_POINTS = 800
"""Largest number of points that take part: more show a fault no better."""
MOST_BYTES, BYTES_PER_IMAGE = 100_000_000, 16 * OF_IMAGE
"""Limits on the derivatives of all observations by the nuisances of each image: 58 000 observations of 200 images need
740 MB, and the equations several times that."""
LEAST_PX = {
    FindingKind.ROLLING_SHUTTER: 3.0,
    FindingKind.ROLLING_SHUTTER_BY_IMAGE: 3.0,
    FindingKind.CENTRE_SAGS: 3.0,
    FindingKind.THIN_PRISM: 1.0,
}
"""Smallest size (px) that is reported; smaller effects are remaining errors of the distortion model."""
OFF, OFF_CENTRE = 0.01, 0.015
"""Differences of focal length and principal point from given ones, in focal lengths, that are a fault: factory values
and calibrations of another day are off by 0.3 to 0.9 % and a few pixels."""
OF_EACH = {FindingKind.FOCUS_BY_IMAGE, FindingKind.ROLLING_SHUTTER_BY_IMAGE}
"""Effects that differ from image to image."""
SIGNED = {FindingKind.FOCUS_BY_DISTANCE, FindingKind.ZOOM}
"""Effects whose size has a sign."""
SURE = 2.0
"""Smallest size, in standard deviations, of effects that differ from image to image: of many images smaller ones
are improbable wherever the noise is estimated a little too small."""
MIN_IMAGES = 6
"""Fewest images with which effects of single images, and the sizes of errors beside effects of poses, are known."""
LEAST_PART = 2
"""Fewest images before and after a change."""
ASPECT = ("fx", "p1", "p2")
"""Parameters that are tested of estimated intrinsics, which have one focal length and no tangential distortion."""
CONCERNS: dict[FindingKind, Concerns] = {
    FindingKind.THIN_PRISM: "intrinsics",
    FindingKind.CENTRE_SAGS: "mount",
}
"""Remedy of effects that other images do not help against."""
FOCUS = {FindingKind.FOCUS_BY_DISTANCE, FindingKind.FOCUS_BY_IMAGE, FindingKind.ZOOM}
"""Effects of a focal length that differs between images, of which one is named."""
NEARLY_ALL = 0.9
"""Share of the squared differences of focal lengths that a simpler effect must explain."""
INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


Combinations = Float[ndarray, "e p"]
"""Combinations of the columns of hypotheses.Alternatives."""


@dataclass(frozen=True, kw_only=True)
class CameraAdjustment:
    """Camera of an adjustment, and the function that adjusts its images again with more of it free."""

    adjusted: Solution
    adjust: Callable[[CameraPrior, Combinations | None, Float[ndarray, "s b"] | None], Solution]
    """Adjust all images with another prior of this camera's intrinsics, with combinations of its columns free, and with
    errors of one standard deviation of the gripper poses."""
    names: Sequence[str]
    """Names of its images."""
    is_given: bool
    """Whether the intrinsics were given; else the reconstruction estimated them."""
    prior: CameraPrior
    std: Float[ndarray, "6"]
    """Standard deviations of the camera's pose; 0 where it is rejected."""
    answer: Callable[[Solution], tuple[Float[ndarray, "4 4"], float]]
    """Function that returns the camera's pose by an adjustment, and the scale."""
    camera: int = 0
    """Number of the camera among the adjusted ones."""
    place: Callable[[State], Float[ndarray, "4 4"]] = first_x
    """Function that returns the camera's pose on its parent."""
    arm: int | None = 0
    """Number of the arm whose gripper poses are tested with the camera; None where another camera's test has them."""
    free: Combinations | None = None
    """Combinations that are free in `adjusted`."""

    @property
    def rows_of_arm(self) -> slice:
        """Rows of the equations of the gripper poses that are those of the arm."""
        counts = [6 * len(one.rigs) for one in self.adjusted.problem.arms]
        begin = sum(counts[: self.arm])
        return slice(begin, begin + counts[self.arm or 0])

    @property
    def images(self) -> Int[ndarray, " m"]:
        """Rows of the camera's images among the adjusted ones."""
        assert self.adjusted.problem.observations is not None
        return np.flatnonzero(self.adjusted.problem.observations.camera == self.camera)

    @property
    def x_px(self) -> Float[ndarray, "k 2"]:
        """Pixels of the points that were observed in its images."""
        assert self.adjusted.problem.observations is not None
        return self.adjusted.problem.observations.x_px[self.adjusted.problem.camera_rows[self.camera]]


def of_case(case: Case) -> CameraAdjustment:
    """Return the capture's own camera."""
    assert case.adjusted is not None

    def answer(adjusted: Solution) -> tuple[Float[ndarray, "4 4"], float]:
        return adjusted.state.x[0], recon_frame(adjusted, case.tracks)[0]

    return CameraAdjustment(
        adjusted=case.adjusted,
        adjust=lambda prior, combinations, bent: adjust_case(
            case, prior=prior, combinations=combinations, confirmed_errors=bent
        ),
        names=[case.names[row] for row in case.used],
        is_given=case.capture.intrinsics is not None,
        prior=case.camera,
        std=np.sqrt(np.diag(case.hand_eye.covariance)[:6]) * case.hand_eye.converged,
        answer=answer,
        free=focal_of_each(case) if case.options.focus == "varies" else None,
    )


@dataclass(frozen=True)
class CameraEffect:
    """Combinations of the columns of hypotheses.Alternatives that one effect frees."""

    kind: FindingKind
    free: Float[ndarray, "e p"]
    """Combinations that the effect consists of."""
    beside: Float[ndarray, "e q"]
    """Combinations that are free beside it and are no part of it."""
    _: KW_ONLY
    unit: float = 1.0
    """Factor from the estimates to the size that is reported."""
    places: int = 1
    """Number of places that were searched."""
    after: int = 0
    """Number of the image before a change."""

    def with_parameters(self, before: int, now: int) -> "CameraEffect":
        """Return the effect on a camera of `now` parameters, the first of which are the `before` that it has now."""
        more = np.zeros((now - before, 1))
        free, beside = (
            np.concatenate([of[:before], more.repeat(of.shape[1], axis=1), of[before:]])
            for of in (self.free, self.beside)
        )
        return replace(self, free=free, beside=beside)

    @property
    def both(self) -> Float[ndarray, "e r"]:
        """All combinations that are freed."""
        return np.concatenate([self.beside, self.free], axis=1)


@dataclass(frozen=True)
class EffectsState:
    """Adjustment of the images with effects on the camera and on the gripper poses free."""

    imaged: CameraAdjustment
    found: tuple[CameraEffect, ...]
    adjusted: Solution
    poses: tuple[Row, ...] = ()
    """Effects on the gripper poses."""

    @staticmethod
    def start(imaged: CameraAdjustment) -> "EffectsState":
        """Return the adjustment as it is; a focal length of each image is free where the user asked for that."""
        if (free := imaged.free) is None:
            return EffectsState(imaged, (), imaged.adjusted)
        varies = CameraEffect(FindingKind.FOCUS_BY_IMAGE, free, np.zeros((len(free), 0)))
        return EffectsState(imaged, (varies,), imaged.adjusted)

    def with_free(self, found: Sequence[CameraEffect], poses: Sequence[Row]) -> "EffectsState":
        """Adjust again with these effects free: the sizes of all errors change with them.

        Raises LinAlgError where the images then determine nothing any more.
        """
        columns = [one.prior_std * one.columns[self.imaged.rows_of_arm] for one in poses]
        bent = np.concatenate(columns, axis=1) if columns else None
        adjusted = self.imaged.adjust(self.imaged.prior, all_combinations(found), bent)
        return replace(self, found=tuple(found), adjusted=adjusted, poses=tuple(poses))

    @cached_property
    def equations(self) -> Alternatives:
        """Equations of the columns that may be freed."""
        return self.equations_with(None)

    def equations_with(self, model_error_std: float | None) -> Alternatives:
        """Return these equations for a size of the camera-model error; None: as estimated."""
        imaged = self.imaged
        return alternatives(self.adjusted, imaged.prior, imaged.camera, imaged.place, model_error_std)

    @property
    def camera(self) -> Intrinsics:
        """Adjusted intrinsics."""
        return self.adjusted.images.view.cameras[self.imaged.camera]

    @property
    def total(self) -> Float[ndarray, " e"]:
        """Displacement of the columns that may be freed from their initial values."""
        problem, imaged = self.adjusted.problem, self.imaged
        of_camera = beyond_prior(self.adjusted, imaged.prior, imaged.camera) / self.equations.units
        of_all = problem.nuisances(self.adjusted.images.state)
        return np.r_[of_camera, of_all[nuisances_of(imaged.images, problem.n_images)]]


def all_combinations(effects: Sequence[CameraEffect]) -> Float[ndarray, "e r"] | None:
    """Return the combinations that all effects free; None without an effect."""
    return np.concatenate([one.both for one in effects], axis=1) if effects else None


def of_fewer_points(case: Case) -> Case:
    """Return the case adjusted with no more points than the tests need."""
    tracks, most = case.tracks, MOST_BYTES // (BYTES_PER_IMAGE * len(case.used))
    few = len(np.unique(tracks.point)) <= MOST_POINTS and len(tracks.image) <= most
    if len(case.used) < MIN_IMAGES or few:
        return case
    fewer = replace(case, chosen_tracks=some_points(tracks, most, MOST_POINTS))
    free = focal_of_each(case) if case.options.focus == "varies" else None
    return replace(fewer, adjusted=adjust_case(fewer, combinations=free))


def with_effect_free(state: EffectsState, best: CameraEffect) -> EffectsState | None:
    """Adjust with one more effect free, or with the simpler one that explains nearly the same.

    Return None where the first step towards the effect moves the camera too little, or where the images then determine
    nothing.
    """
    alone = test_combinations(state.equations, best.both, _all(state))
    is_given = best.kind is FindingKind.INTRINSICS and state.imaged.is_given
    if not is_given and not (np.abs(alone.shift) > OF_FIRST_STEP * MATERIAL * state.imaged.std).any():
        return None
    try:
        after = state.with_free((*state.found, best), state.poses)
        simple = _simpler(after) if best.kind is FindingKind.FOCUS_BY_IMAGE else None
        return after if simple is None else state.with_free((*state.found, simple), state.poses)
    except np.linalg.LinAlgError:
        return None


def is_material(found: Finding, after: EffectsState) -> bool:
    """Return whether an effect is large enough to be a fault and moves the camera.

    Given intrinsics that are contradicted are a fault in any case: users have them elsewhere.
    """
    if found.value is not None and found.std is not None:
        least = SURE * found.std if found.kind in OF_EACH else -np.inf
        if found.value < max(least, LEAST_PX.get(found.kind, -np.inf)):
            return False
    if found.kind is FindingKind.INTRINSICS and is_far_off(after):
        return True
    std = after.imaged.std
    if not std.any():
        # A rejected calibration is uncertain by the effect: the uncertainty that remains beside the effects counts.
        std = np.sqrt(np.diag(after.adjusted.transform(after.imaged.place)[1]))
    assert found.shift is not None
    return bool((np.abs(found.shift[:6]) > MATERIAL * std).any())


def contradicted_intrinsics(state: EffectsState, dismissed: Sequence[CameraEffect]) -> CameraEffect | None:
    """Return the effect of given intrinsics that the images contradict; None where they agree.

    The score test compares with intrinsics that are off by what is usual, and the adjustment may have left those that
    were given. Here its estimate is compared with them (Wald's test), where nothing else explains the images.
    """
    is_dismissed = any(one.kind is FindingKind.INTRINSICS for one in dismissed)
    if state.found or is_dismissed or _log_p_of_given(state) > LOG_P_GIVEN:
        return None
    return next(one for one in _hypotheses(state) if one.kind is FindingKind.INTRINSICS)


def is_far_off(state: EffectsState) -> bool:
    """Return whether focal length or principal point differ from given ones by OFF."""
    if not state.imaged.is_given:
        return False
    given = state.imaged.prior.intrinsics
    off = np.abs(parameters(state.camera) - parameters(given))[:4]
    return bool((off > given.fx * np.array([OFF, OFF, OFF_CENTRE, OFF_CENTRE])).any())


def _log_p_of_given(state: EffectsState) -> float:
    """Return the logarithm of the probability of the estimated intrinsics if the given ones were exact; 0 near them."""
    if not is_far_off(state):
        return 0.0
    by = (parameters(state.camera) - parameters(state.imaged.prior.intrinsics))[:4]
    covariance = state.adjusted.intrinsics_covariance(state.imaged.camera)[:4, :4]
    size = np.sqrt(np.diag(covariance))
    ratio = (by / size) @ np.linalg.pinv(covariance / np.outer(size, size), rcond=1e-9) @ (by / size) / 4
    return float(f_distribution.logsf(float(ratio), 4, state.equations.freedom))


def camera_finding(after: EffectsState, before: EffectsState) -> Finding:
    """Return the last camera effect that was freed as a finding."""
    best = after.found[-1]
    alone = test_combinations(before.equations, best.both, _all(before))
    last = test_combinations(after.equations, best.free, np.concatenate([_all(before), best.beside], axis=1))
    log_chance = alone.log_p + np.log(best.places)
    if best.kind is FindingKind.INTRINSICS:
        log_chance = min(log_chance, _log_p_of_given(before))
    p = float(np.exp(max(log_chance, -700)))
    size = _of_intrinsics(after, last) if best.kind is FindingKind.INTRINSICS else _size(after, last)
    (then, scale), (now, new_scale) = (after.imaged.answer(one.adjusted) for one in (before, after))
    moved = parameters(after.camera) - parameters(before.camera)
    return Finding(
        kind=best.kind,
        severity="warns",
        p=p,
        shift=(*step_between(then, now).tolist(), float(np.log(new_scale / scale))),
        intrinsics_shift=tuple(moved.tolist()),
        **size,
    )


def _all(state: EffectsState) -> Float[ndarray, "e r"]:
    """Return a basis of the combinations that are free already."""
    nothing = np.zeros((state.equations.columns, 1))
    return spanned(np.concatenate([nothing, *(one.both for one in state.found)], axis=1))


def best_camera_effect(
    state: EffectsState, dismissed: Sequence[CameraEffect]
) -> tuple[CameraEffect | None, float]:
    """Return the significant camera effect that explains most and the logarithm of its probability by chance.

    The size of the camera-model error absorbs every effect until all of them gain as little: the effects are compared
    with that size at its typical value.
    """
    excluded = {one.kind for one in (*state.found, *dismissed)}
    excluded |= FOCUS if excluded & FOCUS else set()
    limit = {FindingKind.INTRINSICS: LOG_P_GIVEN if state.imaged.is_given else LOG_P}
    likely = [
        one
        for one in _hypotheses(state)
        if one.kind not in excluded and log_p(one, state, state.equations) <= limit.get(one.kind, LOG_P)
    ]
    if not likely:
        return None, 0.0
    typical = state.equations if len(likely) == 1 else state.equations_with(TYPICAL)
    best = min(likely, key=lambda one: log_p(one, state, typical))
    return best, log_p(best, state, state.equations)


def log_p(one: CameraEffect, state: EffectsState, equations: Alternatives) -> float:
    """Return the logarithm of the probability of the effect's gain by chance, times the places searched."""
    beside = np.concatenate([_all(state), one.beside], axis=1)
    return test_combinations(equations, one.free, beside).log_p + float(np.log(one.places))


def _simpler(state: EffectsState) -> CameraEffect | None:
    """Return a focal length that follows distance, or changed once, where that explains nearly all of its scatter."""
    scatter = state.found[-1]
    focal = scatter.free @ _value(scatter, state.total)

    def explained(one: CameraEffect) -> float:
        along = one.free[:, 0]
        return float((along @ focal) ** 2 / ((along @ along) * (focal @ focal)))

    best = max((one for one in _hypotheses(state) if one.kind in FOCUS - {scatter.kind}), key=explained)
    return best if explained(best) > NEARLY_ALL else None


def _value(fault: CameraEffect, total: Float[ndarray, " e"]) -> Float[ndarray, " p"]:
    """Return the estimates of the combinations of an effect."""
    return np.linalg.lstsq(fault.both, total, rcond=None)[0][fault.beside.shape[1] :]


def _hypotheses(state: EffectsState) -> list[CameraEffect]:
    """Return the effects that are tested, with a focal length that is wrong in all images free beside them."""
    equations = state.equations
    m, far = equations.images, np.log(equations.distance)
    focal_px, width = state.imaged.prior.intrinsics.fx, state.camera.width
    common = equations.of_camera(("fx", "fy")).sum(1, keepdims=True)
    # Intrinsics that are wrong in all images include the focal length that shows nothing in the others.
    nothing = np.zeros((equations.columns, 0))
    intrinsics = CameraEffect(FindingKind.INTRINSICS, equations.of_camera(_freed(state)), nothing)
    if m < MIN_IMAGES:
        return [intrinsics]
    of_centre = np.concatenate([common, equations.of_camera(("cx", "cy"))], axis=1)
    down = equations.down_in_camera[:, :, None]
    sag = [equations.of_images("x", down[:, 0]), equations.of_images("y", down[:, 1])]
    by_distance = equations.of_images("focal", (far - far.mean())[:, None])
    sheared, each_sheared = (equations.of_images("shear", shares) for shares in (np.ones((m, 1)), np.eye(m)))
    found = [
        CameraEffect(FindingKind.FOCUS_BY_DISTANCE, by_distance, common),
        CameraEffect(FindingKind.FOCUS_BY_IMAGE, equations.of_images("focal", differences(m)), common),
        CameraEffect(FindingKind.ROLLING_SHUTTER, sheared, common, unit=focal_px),
        CameraEffect(FindingKind.ROLLING_SHUTTER_BY_IMAGE, each_sheared, common, unit=focal_px),
        CameraEffect(FindingKind.CENTRE_SAGS, np.concatenate(sag, axis=1), of_centre, unit=width),
    ]
    steps = range(LEAST_PART, m - LEAST_PART + 1)
    for k in steps:
        after = (np.arange(m) >= k) - (m - k) / m
        free = equations.of_images("focal", after[:, None])
        found.append(CameraEffect(FindingKind.ZOOM, free, common, places=len(steps), after=k - 1))
    if len(state.adjusted.problem.cameras) == 1:  # all images share the glass
        found.append(CameraEffect(FindingKind.THIN_PRISM, np.eye(equations.columns)[:, -PRISM:], of_centre))
    return [*found, intrinsics]


def _of_intrinsics(after: EffectsState, last: ScoreTest) -> dict[str, Any]:
    """Return the fields of a finding that state the intrinsics which the images show."""
    units = dict(zip(after.equations.names, after.equations.units, strict=True))
    std = np.sqrt(np.maximum(np.diag(last.covariance), 0.0))
    given, now = parameters(after.imaged.prior.intrinsics), parameters(after.camera)
    found: dict[str, float] = {} if after.imaged.is_given else {"estimated": 1.0}
    for name, old, new in zip(parameter_names(after.camera), given, now, strict=True):
        if name in INTRINSICS:
            found |= {name: float(new), f"{name}_given": float(old)}
    found |= {f"{name}_std": float(std[k] * units[name]) for k, name in enumerate(_freed(after))}
    return {"concerns": "intrinsics", "details": found}


def _size(after: EffectsState, last: ScoreTest) -> dict[str, Any]:
    """Return the fields of a finding that state the size of the effect: of several estimates their rms."""
    fault, value = after.found[-1], _value(after.found[-1], after.total)
    unit = fault.unit
    if fault.kind is FindingKind.FOCUS_BY_DISTANCE:
        unit = float(np.ptp(np.log(after.equations.distance)))
    std = float(np.median(np.sqrt(np.maximum(np.diag(last.covariance), 0.0))))
    if fault.kind is FindingKind.THIN_PRISM:
        size, error = _largest_px(after, value, last.covariance)
    elif fault.kind in OF_EACH:
        size, error = unit * float(np.sqrt(value @ value / after.equations.images)), unit * std
    else:
        rms = value[0] if fault.kind in SIGNED else np.sqrt(np.mean(value**2))
        size, error = unit * float(rms), unit * std / float(np.sqrt(len(value)))
    changed = after.imaged.names[fault.after : fault.after + 2] if fault.kind is FindingKind.ZOOM else ()
    concerns = CONCERNS.get(fault.kind, "images")
    return {"concerns": concerns, "value": size, "std": error, "images": tuple(changed)}


def _largest_px(
    after: EffectsState, value: Float[ndarray, "4"], covariance: Float[ndarray, "4 4"]
) -> tuple[float, float]:
    """Return the largest displacement by a thin prism among the points, and its standard deviation."""
    by = after.adjusted.problem.prism
    moved = np.linalg.norm(by @ value, axis=1)
    k = int(moved.argmax())
    along = (by[k] @ value / max(float(moved[k]), 1e-12)) @ by[k]
    return float(moved[k]), float(np.sqrt(along @ covariance @ along))


def _freed(state: EffectsState) -> tuple[str, ...]:
    """Return the parameters of the camera model that are tested."""
    tested_names = INTRINSICS if state.imaged.is_given else ASPECT
    return tuple(name for name in tested_names if name in state.equations.names)
