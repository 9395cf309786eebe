"""Is it one camera in all images? A focus that moves, a zoom, a rolling shutter, intrinsics that are a little wrong.

Each is a hypothesis of estimation/score_test.py, tested beside a focal length that is wrong by one factor in all images.
The images are adjusted with the one of least p free, which shows its value and what it does to the camera's place; then
the next is tested beside it. Whether intrinsics that were given can be those of the images at all is asked last. A
capture's own camera and a further one of a cell are tested alike (imaged.py).
"""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.adjust import adjust_case, focal_of_each
from jcr.calibration.case import Case, Checked, of_points
from jcr.calibration.checks.given_intrinsics import intrinsics_contradiction
from jcr.calibration.checks.imaged import Imaged, of_case
from jcr.camera import parameter_names, parameters
from jcr.estimation.image_robots import Adjusted
from jcr.estimation.model_error import TYPICAL
from jcr.estimation.scene import OF_IMAGE, PRISM
from jcr.estimation.score_test import (
    Alternatives,
    Tested,
    alternatives,
    beyond_prior,
    differences,
    nuisances_of,
    spanned,
    tested,
)
from jcr.geometry import step_between
from jcr.records import Finding, Intrinsics, Kind, Mend, Tracks

LOG_P = float(np.log(1e-6))
"""Chance of any one alarm where there is nothing, before it is divided by the number of places of a change."""
MATERIAL = 0.5
"""Standard deviations by which a fault must move the camera's place on some axis to be reported."""
OF_FIRST_STEP = 0.2
"""Share of that which the first step towards a fault must go, for the adjustments that follow take long."""
AT_ONCE = 2
"""Faults named of one capture."""
MOST_POINTS, WELL_SEEN = 800, 3
"""Points that take part, first those in this many images: more tell a fault no better, and take time."""
MOST_BYTES, BYTES_PER_IMAGE = 100_000_000, 16 * OF_IMAGE
"""Of the derivatives of all observations by the nuisances of each image: of 58 000 observations by 200 images they were
740 MB, and the equations several times that."""
LEAST_PX = {
    Kind.ROLLING_SHUTTER: 3.0,
    Kind.ROLLING_SHUTTER_BY_IMAGE: 3.0,
    Kind.CENTRE_SAGS: 3.0,
    Kind.THIN_PRISM: 1.0,
}
"""What is measured in pixels and smaller is what a distortion model leaves over."""
OF_EACH = {Kind.FOCUS_BY_IMAGE, Kind.ROLLING_SHUTTER_BY_IMAGE}
SURE = 2.0
"""Standard deviations of what differs from image to image: of hundreds of images the chance of less is small for any
noise that is estimated a little too small. Of a dozen images what is that improbable is larger."""
MIN_IMAGES = 5
LEAST_PART = 2
"""Images before and after a change."""
ASPECT = ("fx", "p1", "p2")
"""Of estimated intrinsics, whose focal length is one and whose tangential distortion is none: what is tested."""
MENDS: dict[Kind, Mend] = {Kind.THIN_PRISM: "intrinsics", Kind.CENTRE_SAGS: "mount"}
"""What would help where other images would not."""
FOCUS = {Kind.FOCUS_BY_DISTANCE, Kind.FOCUS_BY_IMAGE, Kind.ZOOM}
"""Of a focal length that differs between images, one is named."""
NEARLY_ALL = 0.9
"""Of the squares of what the focal length differs by."""
INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


def check_camera(case: Case) -> Checked:
    """What the used images show against one camera with the intrinsics that they were reconstructed with.

    With `focus` "varies" a focal length of each image is free already and is no finding.
    """
    imaged = of_case(_of_fewer_points(case))
    faults = camera_faults(imaged)
    if not imaged.is_given:
        return Checked(faults)
    if faults and not any(one.kind is Kind.INTRINSICS for one in faults):
        return Checked(faults)
    checked = intrinsics_contradiction(case)
    return replace(checked, findings=with_contradiction(faults, checked.findings))


def with_contradiction(
    faults: tuple[Finding, ...], contradiction: tuple[Finding, ...]
) -> tuple[Finding, ...]:
    """What was found of one camera, where its given intrinsics are contradicted as a whole: with the parameters that a
    test of these named, if it did."""
    named = [one for one in faults if contradiction and one.kind is Kind.INTRINSICS]
    whole = [replace(one, shift=contradiction[0].shift, intrinsics_shift=None) for one in named]
    return (*(one for one in faults if one not in named), *(whole or contradiction))


@dataclass(frozen=True)
class _Hypothesis:
    kind: Kind
    free: Float[ndarray, "e p"]
    """The combinations that it is about."""
    beside: Float[ndarray, "e q"]
    """What is free with it and shows nothing."""
    _: KW_ONLY
    places: int = 1
    """That were searched."""
    after: int = 0
    """Image before a change."""

    @property
    def both(self) -> Float[ndarray, "e r"]:
        """All that it frees."""
        return np.concatenate([self.beside, self.free], axis=1)


@dataclass(frozen=True)
class _State:
    """The images adjusted with some hypotheses free."""

    imaged: Imaged
    found: tuple[_Hypothesis, ...]
    adjusted: Adjusted

    @staticmethod
    def of(imaged: Imaged, found: tuple[_Hypothesis, ...]) -> "_State":
        """Adjusted again: while what was found distorted the images, the robot pose noise was another one."""
        combinations = np.concatenate([one.both for one in found], axis=1)
        return _State(imaged, found, imaged.adjust(imaged.prior, combinations))

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
        return self.adjusted.given.evidence.scene.cameras[self.imaged.camera]

    @property
    def total(self) -> Float[ndarray, " e"]:
        """How far the columns that may be freed are from where they start."""
        evidence, imaged = self.adjusted.given.evidence, self.imaged
        of_camera = beyond_prior(self.adjusted, imaged.prior, imaged.camera) / self.equations.units
        of_all = evidence.scene.nuisances(evidence.problem.freedom)
        return np.r_[of_camera, of_all[nuisances_of(imaged.images, len(evidence.problem.observations.rig))]]


def camera_faults(imaged: Imaged) -> tuple[Finding, ...]:
    """What speaks against one camera in all its images, at most AT_ONCE of it."""
    if len(imaged.names) < MIN_IMAGES:
        return ()
    found = ()
    if (free := imaged.free) is not None:  # a focal length of each image, as the user asked
        found = (_Hypothesis(Kind.FOCUS_BY_IMAGE, free, np.zeros((len(free), 0))),)
    state = _State(imaged, found, imaged.adjusted)
    named: list[Finding] = []
    dismissed: list[_Hypothesis] = []
    while len(named) < AT_ONCE:
        best = _most_likely(state, dismissed)
        if best is None:
            break
        alone = tested(state.equations, best.both, _all(state))
        far = (np.abs(alone.shift) > OF_FIRST_STEP * MATERIAL * imaged.std).any()
        after = _with(state, best) if far else None
        if after is not None and is_material(found := _finding(after, state, alone), imaged.std):
            named.append(found)
            state = after
        else:
            dismissed.append(best)
    return tuple(named)


def _of_fewer_points(case: Case) -> Case:
    """The case as adjusted, of no more points than are needed."""
    tracks, most = case.tracks, MOST_BYTES // (BYTES_PER_IMAGE * len(case.used))
    few = len(np.unique(tracks.point)) <= MOST_POINTS and len(tracks.image) <= most
    if len(case.used) < MIN_IMAGES or few:
        return case
    fewer = replace(case, chosen_tracks=of_some(tracks, most))
    free = focal_of_each(case) if case.options.focus == "varies" else None
    return replace(fewer, adjusted=adjust_case(fewer, combinations=free))


def _with(state: _State, best: _Hypothesis) -> _State | None:
    """Adjusted with one more hypothesis free, or with the simpler one that explains nearly the same; None where the
    images then show nothing any more."""
    try:
        after = _State.of(state.imaged, (*state.found, best))
        simple = _simpler(after) if best.kind is Kind.FOCUS_BY_IMAGE else None
        return after if simple is None else _State.of(state.imaged, (*state.found, simple))
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


def _finding(after: _State, before: _State, alone: Tested) -> Finding:
    """The last hypothesis that was freed, as a finding."""
    best = after.found[-1]
    last = tested(after.equations, best.free, np.concatenate([_all(before), best.beside], axis=1))
    p = float(np.exp(max(alone.log_p + np.log(best.places), -700)))
    size = _of_intrinsics(after, last) if best.kind is Kind.INTRINSICS else _size(after, last)
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


def _all(state: _State) -> Float[ndarray, "e r"]:
    """The combinations that are free already; of those that are the same, one."""
    nothing = np.zeros((state.equations.columns, 1))
    return spanned(np.concatenate([nothing, *(one.both for one in state.found)], axis=1))


def _most_likely(state: _State, dismissed: Sequence[_Hypothesis]) -> _Hypothesis | None:
    """Of the hypotheses whose p is small enough the one that explains most.

    What the camera's model leaves grows with whatever is wrong, until every explanation gains as little. Which of them
    is the right one shows where it may not.
    """
    likely = [
        one
        for one in _hypotheses(state)
        if not any(_alike(one, other) for other in (*state.found, *dismissed))
        and _log_p(one, state, state.equations) <= LOG_P
    ]
    if len(likely) < 2:
        return likely[0] if likely else None
    of_a_good_camera = state.equations_with(TYPICAL)
    return min(likely, key=lambda one: _log_p(one, state, of_a_good_camera))


def _log_p(one: _Hypothesis, state: _State, equations: Alternatives) -> float:
    beside = np.concatenate([_all(state), one.beside], axis=1)
    return tested(equations, one.free, beside).log_p + float(np.log(one.places))


def _alike(one: _Hypothesis, other: _Hypothesis) -> bool:
    return one.kind == other.kind or {one.kind, other.kind} <= FOCUS


def _simpler(state: _State) -> _Hypothesis | None:
    """A focal length that follows distance, or changed once, where that explains nearly all that it scatters."""
    scatter = state.found[-1]
    focal = scatter.free @ _value(scatter, state.total)

    def explained(one: _Hypothesis) -> float:
        along = one.free[:, 0]
        return float((along @ focal) ** 2 / ((along @ along) * (focal @ focal)))

    best = max((one for one in _hypotheses(state) if one.kind in FOCUS - {scatter.kind}), key=explained)
    return best if explained(best) > NEARLY_ALL else None


def _value(fault: _Hypothesis, total: Float[ndarray, " e"]) -> Float[ndarray, " p"]:
    """Of the combinations that a hypothesis is about."""
    return np.linalg.lstsq(fault.both, total, rcond=None)[0][fault.beside.shape[1] :]


def _hypotheses(state: _State) -> list[_Hypothesis]:
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
        _Hypothesis(Kind.FOCUS_BY_DISTANCE, equations.of_images("focal", far[:, None]), common),
        _Hypothesis(Kind.FOCUS_BY_IMAGE, equations.of_images("focal", differences(m)), common),
        _Hypothesis(Kind.ROLLING_SHUTTER, equations.of_images("shear", np.ones((m, 1))), common),
        _Hypothesis(Kind.ROLLING_SHUTTER_BY_IMAGE, equations.of_images("shear", np.eye(m)), common),
    ]
    for k in steps:
        after = (np.arange(m) >= k) - (m - k) / m
        free = equations.of_images("focal", after[:, None])
        found.append(_Hypothesis(Kind.ZOOM, free, common, places=len(steps), after=int(k) - 1))
    of_centre = np.concatenate([common, equations.of_camera(("cx", "cy"))], axis=1)
    found.append(_Hypothesis(Kind.CENTRE_SAGS, np.concatenate(sag, axis=1), of_centre))
    if len(state.adjusted.given.evidence.scene.cameras) == 1:  # all images share the glass
        found.append(_Hypothesis(Kind.THIN_PRISM, np.eye(equations.columns)[:, -PRISM:], of_centre))
    # Intrinsics that are wrong in all images include the focal length that shows nothing in the others.
    found.append(_Hypothesis(Kind.INTRINSICS, equations.of_camera(_freed(state)), nothing))
    return found


def _of_intrinsics(after: _State, last: Tested) -> dict[str, Any]:
    """The fields of a finding that say which intrinsics the images show."""
    units = dict(zip(after.equations.names, after.equations.units, strict=True))
    std = np.sqrt(np.maximum(np.diag(last.covariance), 0.0))
    given, now = parameters(after.imaged.start), parameters(after.camera)
    found: dict[str, float] = {}
    for name, old, new in zip(parameter_names(after.camera), given, now, strict=True):
        if name in INTRINSICS:
            found |= {name: float(new), f"{name}_given": float(old)}
    found |= {f"{name}_std": float(std[k] * units[name]) for k, name in enumerate(_freed(after))}
    return {"mend": "intrinsics", "details": found}


def _size(after: _State, last: Tested) -> dict[str, Any]:
    """The fields of a finding that say what and how large the fault is."""
    fault, equations = after.found[-1], after.equations
    value = _value(fault, after.total)
    std = np.sqrt(np.maximum(np.diag(last.covariance), 0.0))
    typical, each = float(np.sqrt(np.mean(value**2))), float(np.median(std))
    spread = float(np.ptp(np.log(equations.distance)))
    focal_px, width = after.imaged.start.fx, after.camera.width
    match fault.kind:
        case Kind.FOCUS_BY_DISTANCE:
            size, error = spread * value[0], spread * std[0]
        case Kind.FOCUS_BY_IMAGE:
            size, error = np.sqrt(value @ value / equations.images), each
        case Kind.ZOOM:
            size, error = value[0], std[0]
        case Kind.THIN_PRISM:
            size, error = _largest_px(after, value, last.covariance)
        case Kind.CENTRE_SAGS:
            size, error = width * typical, width * each / np.sqrt(2)
        case _:
            size, error = focal_px * typical, focal_px * each
    changed = after.imaged.names[fault.after : fault.after + 2] if fault.kind is Kind.ZOOM else ()
    mend = MENDS.get(fault.kind, "images")
    return {"mend": mend, "value": float(size), "std": float(error), "images": tuple(changed)}


def _largest_px(
    after: _State, value: Float[ndarray, "4"], covariance: Float[ndarray, "4 4"]
) -> tuple[float, float]:
    """The displacement by a thin prism where it is largest among the points, and its standard deviation."""
    by = after.adjusted.given.evidence.problem.prism
    moved = np.linalg.norm(by @ value, axis=1)
    k = int(moved.argmax())
    along = (by[k] @ value / max(float(moved[k]), 1e-12)) @ by[k]
    return float(moved[k]), float(np.sqrt(along @ covariance @ along))


def _freed(state: _State) -> tuple[str, ...]:
    """Parameters of the intrinsics that are tested, of those that the model has."""
    tested_names = INTRINSICS if state.imaged.is_given else ASPECT
    return tuple(name for name in tested_names if name in state.equations.names)
