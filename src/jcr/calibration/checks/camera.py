"""Effects on one camera: a focal length that varies, a rolling shutter, a thin prism, intrinsics that are wrong.

Each is a hypothesis of estimation/score_test.py, tested beside a focal length that is wrong by one factor in all images.
The images are adjusted with the effect free, which shows its size and the motion of the camera that comes with it.
"""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.adjust import adjust_case, focal_of_each
from jcr.calibration.case import Case, of_points
from jcr.calibration.checks.imaged import Imaged
from jcr.camera import parameter_names, parameters
from jcr.estimation.hypotheses import Row
from jcr.estimation.model_error import TYPICAL
from jcr.estimation.problem import OF_IMAGE, PRISM
from jcr.estimation.score_test import (
    Alternatives,
    ScoreTest,
    alternatives,
    beyond_prior,
    differences,
    nuisances_of,
    spanned,
    test_combinations,
)
from jcr.estimation.solve import Solution
from jcr.findings import Concerns, Finding, FindingKind
from jcr.geometry import step_between
from jcr.records import Intrinsics, Tracks

LOG_P = float(np.log(1e-6))
"""Chance of any one alarm where there is nothing, before it is divided by the number of places of a change."""
MATERIAL = 0.5
"""Standard deviations by which a fault must move the camera's place on some axis to be reported."""
OF_FIRST_STEP = 0.2
"""Share of that which the first step towards a fault must go, for the adjustments that follow take long."""
MOST_POINTS, WELL_SEEN = 800, 3
"""Points that take part, first those in this many images: more tell a fault no better, and take time."""
MOST_BYTES, BYTES_PER_IMAGE = 100_000_000, 16 * OF_IMAGE
"""Of the derivatives of all observations by the nuisances of each image: of 58 000 observations by 200 images they were
740 MB, and the equations several times that."""
LEAST_PX = {
    FindingKind.ROLLING_SHUTTER: 3.0,
    FindingKind.ROLLING_SHUTTER_BY_IMAGE: 3.0,
    FindingKind.CENTRE_SAGS: 3.0,
    FindingKind.THIN_PRISM: 1.0,
}
"""What is measured in pixels and smaller is what a distortion model leaves over."""
OF_EACH = {FindingKind.FOCUS_BY_IMAGE, FindingKind.ROLLING_SHUTTER_BY_IMAGE}
SURE = 2.0
"""Standard deviations of what differs from image to image: of hundreds of images the chance of less is small for any
noise that is estimated a little too small. Of a dozen images what is that improbable is larger."""
MIN_IMAGES = 5
LEAST_PART = 2
"""Images before and after a change."""
ASPECT = ("fx", "p1", "p2")
"""Of estimated intrinsics, whose focal length is one and whose tangential distortion is none: what is tested."""
CONCERNS: dict[FindingKind, Concerns] = {
    FindingKind.THIN_PRISM: "intrinsics",
    FindingKind.CENTRE_SAGS: "mount",
}
"""What would help where other images would not."""
FOCUS = {FindingKind.FOCUS_BY_DISTANCE, FindingKind.FOCUS_BY_IMAGE, FindingKind.ZOOM}
"""Of a focal length that differs between images, one is named."""
NEARLY_ALL = 0.9
"""Of the squares of what the focal length differs by."""
INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


def with_contradiction(
    faults: tuple[Finding, ...], contradiction: tuple[Finding, ...]
) -> tuple[Finding, ...]:
    """What was found of one camera, where its given intrinsics are contradicted as a whole: with the parameters that a
    test of these named, if it did."""
    named = [one for one in faults if contradiction and one.kind is FindingKind.INTRINSICS]
    whole = [replace(one, shift=contradiction[0].shift, intrinsics_shift=None) for one in named]
    return (*(one for one in faults if one not in named), *(whole or contradiction))


@dataclass(frozen=True)
class CameraEffect:
    """Combinations of the columns of score_test.Alternatives that one effect frees."""

    kind: FindingKind
    free: Float[ndarray, "e p"]
    """The combinations that it is about."""
    beside: Float[ndarray, "e q"]
    """What is free with it and shows nothing."""
    _: KW_ONLY
    places: int = 1
    """That were searched."""
    after: int = 0
    """Image before a change."""

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
        """All that it frees."""
        return np.concatenate([self.beside, self.free], axis=1)


@dataclass(frozen=True)
class State:
    """Adjustment of the images with effects on the camera and on the gripper poses free."""

    imaged: Imaged
    found: tuple[CameraEffect, ...]
    adjusted: Solution
    poses: tuple[Row, ...] = ()
    """Effects on the gripper poses."""

    @staticmethod
    def start(imaged: Imaged) -> "State":
        """Return the adjustment as it is; a focal length of each image is free where the user asked for that."""
        if (free := imaged.free) is None:
            return State(imaged, (), imaged.adjusted)
        varies = CameraEffect(FindingKind.FOCUS_BY_IMAGE, free, np.zeros((len(free), 0)))
        return State(imaged, (varies,), imaged.adjusted)

    def with_free(self, found: Sequence[CameraEffect], poses: Sequence[Row]) -> "State":
        """Adjust again with these effects free: the sizes of all errors change with them.

        Raises LinAlgError where the images then determine nothing any more.
        """
        combinations = np.concatenate([one.both for one in found], axis=1) if found else None
        columns = [one.prior_std * one.columns[self.imaged.rows_of_arm] for one in poses]
        bent = np.concatenate(columns, axis=1) if columns else None
        adjusted = self.imaged.adjust(self.imaged.prior, combinations, bent)
        return replace(self, found=tuple(found), adjusted=adjusted, poses=tuple(poses))

    @cached_property
    def equations(self) -> Alternatives:
        """Of what may be freed beside."""
        return self.equations_with(None)

    def equations_with(self, model_error_std: float | None) -> Alternatives:
        """The same where what the cameras' models leave is of this size."""
        imaged = self.imaged
        return alternatives(self.adjusted, imaged.prior, imaged.camera, imaged.place, model_error_std)

    @property
    def camera(self) -> Intrinsics:
        """As adjusted."""
        return self.adjusted.images.view.cameras[self.imaged.camera]

    @property
    def total(self) -> Float[ndarray, " e"]:
        """How far the columns that may be freed are from where they start."""
        problem, imaged = self.adjusted.problem, self.imaged
        of_camera = beyond_prior(self.adjusted, imaged.prior, imaged.camera) / self.equations.units
        of_all = problem.nuisances(self.adjusted.images.state)
        return np.r_[of_camera, of_all[nuisances_of(imaged.images, problem.n_images)]]


def of_fewer_points(case: Case) -> Case:
    """Return the case adjusted with no more points than the tests need."""
    tracks, most = case.tracks, MOST_BYTES // (BYTES_PER_IMAGE * len(case.used))
    few = len(np.unique(tracks.point)) <= MOST_POINTS and len(tracks.image) <= most
    if len(case.used) < MIN_IMAGES or few:
        return case
    fewer = replace(case, chosen_tracks=of_some(tracks, most))
    free = focal_of_each(case) if case.options.focus == "varies" else None
    return replace(fewer, adjusted=adjust_case(fewer, combinations=free))


def freed(state: State, best: CameraEffect) -> State | None:
    """Adjust with one more effect free, or with the simpler one that explains nearly the same.

    Return None where the first step towards the effect moves the camera too little, or where the images then determine
    nothing.
    """
    alone = test_combinations(state.equations, best.both, _all(state))
    if not (np.abs(alone.shift) > OF_FIRST_STEP * MATERIAL * state.imaged.std).any():
        return None
    try:
        after = state.with_free((*state.found, best), state.poses)
        simple = _simpler(after) if best.kind is FindingKind.FOCUS_BY_IMAGE else None
        return after if simple is None else state.with_free((*state.found, simple), state.poses)
    except np.linalg.LinAlgError:
        return None


def is_material(found: Finding, std: Float[ndarray, "6"]) -> bool:
    """Whether what was freed is large enough to be a fault, and moves the calibration."""
    if found.value is not None and found.std is not None:
        least = SURE * found.std if found.kind in OF_EACH else -np.inf
        if found.value < max(least, LEAST_PX.get(found.kind, -np.inf)):
            return False
    assert found.shift is not None
    return bool((np.abs(found.shift[:6]) > MATERIAL * std).any())


def camera_finding(after: State, before: State) -> Finding:
    """Return the last camera effect that was freed as a finding."""
    best = after.found[-1]
    alone = test_combinations(before.equations, best.both, _all(before))
    last = test_combinations(after.equations, best.free, np.concatenate([_all(before), best.beside], axis=1))
    p = float(np.exp(max(alone.log_p + np.log(best.places), -700)))
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


def of_some(tracks: Tracks, most: int) -> Tracks:
    """A random choice of the points that most images see, with no more than `most` observations, and all corners of
    boards."""
    count = np.bincount(tracks.point, minlength=len(tracks.points_in_recon))
    order = np.random.default_rng(0).permutation(len(count))
    enough = order[np.argsort(count[order] < WELL_SEEN, kind="stable")]
    chosen = tracks.on_board
    shown = enough[count[enough] >= 2][:MOST_POINTS]
    chosen[shown[np.cumsum(count[shown]) <= most]] = True
    return of_points(tracks, chosen)


def _all(state: State) -> Float[ndarray, "e r"]:
    """The combinations that are free already; of those that are the same, one."""
    nothing = np.zeros((state.equations.columns, 1))
    return spanned(np.concatenate([nothing, *(one.both for one in state.found)], axis=1))


def best_camera_effect(state: State, dismissed: Sequence[CameraEffect]) -> tuple[CameraEffect | None, float]:
    """Return the significant camera effect that explains most and the logarithm of its probability by chance.

    The size of the camera-model error absorbs every effect until all of them gain as little: the effects are compared
    with that size at its typical value.
    """
    likely = [
        one
        for one in _hypotheses(state)
        if not any(_alike(one, other) for other in (*state.found, *dismissed))
        and log_p(one, state, state.equations) <= LOG_P
    ]
    if not likely:
        return None, 0.0
    typical = state.equations if len(likely) == 1 else state.equations_with(TYPICAL)
    best = min(likely, key=lambda one: log_p(one, state, typical))
    return best, log_p(best, state, state.equations)


def log_p(one: CameraEffect, state: State, equations: Alternatives) -> float:
    """Return the logarithm of the probability of the effect's gain by chance, times the places searched."""
    beside = np.concatenate([_all(state), one.beside], axis=1)
    return test_combinations(equations, one.free, beside).log_p + float(np.log(one.places))


def _alike(one: CameraEffect, other: CameraEffect) -> bool:
    return one.kind == other.kind or {one.kind, other.kind} <= FOCUS


def _simpler(state: State) -> CameraEffect | None:
    """A focal length that follows distance, or changed once, where that explains nearly all that it scatters."""
    scatter = state.found[-1]
    focal = scatter.free @ _value(scatter, state.total)

    def explained(one: CameraEffect) -> float:
        along = one.free[:, 0]
        return float((along @ focal) ** 2 / ((along @ along) * (focal @ focal)))

    best = max((one for one in _hypotheses(state) if one.kind in FOCUS - {scatter.kind}), key=explained)
    return best if explained(best) > NEARLY_ALL else None


def _value(fault: CameraEffect, total: Float[ndarray, " e"]) -> Float[ndarray, " p"]:
    """Of the combinations that a hypothesis is about."""
    return np.linalg.lstsq(fault.both, total, rcond=None)[0][fault.beside.shape[1] :]


def _hypotheses(state: State) -> list[CameraEffect]:
    equations = state.equations
    m = equations.images
    far = np.log(equations.distance)
    far = far - far.mean()
    steps = np.arange(LEAST_PART, m - LEAST_PART + 1)
    common, nothing = (
        equations.of_camera(("fx", "fy")).sum(1, keepdims=True),
        np.zeros((equations.columns, 0)),
    )
    x, y = equations.down_in_camera[:, :2].T
    sag = [equations.of_images("x", x[:, None]), equations.of_images("y", y[:, None])]
    found = [
        CameraEffect(FindingKind.FOCUS_BY_DISTANCE, equations.of_images("focal", far[:, None]), common),
        CameraEffect(FindingKind.FOCUS_BY_IMAGE, equations.of_images("focal", differences(m)), common),
        CameraEffect(FindingKind.ROLLING_SHUTTER, equations.of_images("shear", np.ones((m, 1))), common),
        CameraEffect(FindingKind.ROLLING_SHUTTER_BY_IMAGE, equations.of_images("shear", np.eye(m)), common),
    ]
    for k in steps:
        after = (np.arange(m) >= k) - (m - k) / m
        free = equations.of_images("focal", after[:, None])
        found.append(CameraEffect(FindingKind.ZOOM, free, common, places=len(steps), after=int(k) - 1))
    of_centre = np.concatenate([common, equations.of_camera(("cx", "cy"))], axis=1)
    found.append(CameraEffect(FindingKind.CENTRE_SAGS, np.concatenate(sag, axis=1), of_centre))
    if len(state.adjusted.problem.cameras) == 1:  # all images share the glass
        found.append(CameraEffect(FindingKind.THIN_PRISM, np.eye(equations.columns)[:, -PRISM:], of_centre))
    # Intrinsics that are wrong in all images include the focal length that shows nothing in the others.
    found.append(CameraEffect(FindingKind.INTRINSICS, equations.of_camera(_freed(state)), nothing))
    return found


def _of_intrinsics(after: State, last: ScoreTest) -> dict[str, Any]:
    """The fields of a finding that say which intrinsics the images show."""
    units = dict(zip(after.equations.names, after.equations.units, strict=True))
    std = np.sqrt(np.maximum(np.diag(last.covariance), 0.0))
    given, now = parameters(after.imaged.start), parameters(after.camera)
    found: dict[str, float] = {}
    for name, old, new in zip(parameter_names(after.camera), given, now, strict=True):
        if name in INTRINSICS:
            found |= {name: float(new), f"{name}_given": float(old)}
    found |= {f"{name}_std": float(std[k] * units[name]) for k, name in enumerate(_freed(after))}
    return {"concerns": "intrinsics", "details": found}


def _size(after: State, last: ScoreTest) -> dict[str, Any]:
    """The fields of a finding that say what and how large the fault is."""
    fault, equations = after.found[-1], after.equations
    value = _value(fault, after.total)
    std = np.sqrt(np.maximum(np.diag(last.covariance), 0.0))
    typical, each = float(np.sqrt(np.mean(value**2))), float(np.median(std))
    spread = float(np.ptp(np.log(equations.distance)))
    focal_px, width = after.imaged.start.fx, after.camera.width
    match fault.kind:
        case FindingKind.FOCUS_BY_DISTANCE:
            size, error = spread * value[0], spread * std[0]
        case FindingKind.FOCUS_BY_IMAGE:
            size, error = np.sqrt(value @ value / equations.images), each
        case FindingKind.ZOOM:
            size, error = value[0], std[0]
        case FindingKind.THIN_PRISM:
            size, error = _largest_px(after, value, last.covariance)
        case FindingKind.CENTRE_SAGS:
            size, error = width * typical, width * each / np.sqrt(2)
        case _:
            size, error = focal_px * typical, focal_px * each
    changed = after.imaged.names[fault.after : fault.after + 2] if fault.kind is FindingKind.ZOOM else ()
    concerns = CONCERNS.get(fault.kind, "images")
    return {"concerns": concerns, "value": float(size), "std": float(error), "images": tuple(changed)}


def _largest_px(
    after: State, value: Float[ndarray, "4"], covariance: Float[ndarray, "4 4"]
) -> tuple[float, float]:
    """The displacement by a thin prism where it is largest among the points, and its standard deviation."""
    by = after.adjusted.problem.prism
    moved = np.linalg.norm(by @ value, axis=1)
    k = int(moved.argmax())
    along = (by[k] @ value / max(float(moved[k]), 1e-12)) @ by[k]
    return float(moved[k]), float(np.sqrt(along @ covariance @ along))


def _freed(state: State) -> tuple[str, ...]:
    """Parameters of the intrinsics that are tested, of those that the model has."""
    tested_names = INTRINSICS if state.imaged.is_given else ASPECT
    return tuple(name for name in tested_names if name in state.equations.names)
