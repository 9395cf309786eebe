"""Tests of effects on one camera: varying focal length, rolling shutter, sagging lens, thin prism, wrong intrinsics.

Each effect is a score test (estimation/hypotheses.py) with a common focal length error free in both hypotheses. For a
significant effect, an adjustment with the effect as additional parameters gives its size and the shift of the camera.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.adjust import adjust_case
from jcr.calibration.case import Case, some_points
from jcr.camera import parameter_names, parameters
from jcr.distributions import f as f_distribution
from jcr.estimation.hypotheses import (
    Alternatives,
    Row,
    ScoreTest,
    alternatives,
    differences,
    first_x,
    test_combinations,
)
from jcr.estimation.intrinsics_prior import ESTIMATED, TYPICAL, CameraPrior
from jcr.estimation.problem import OF_IMAGE, PRISM, Problem, State, spanned
from jcr.estimation.solve import Solution
from jcr.findings import Concerns, Finding, FindingKind, joined
from jcr.geometry import step_between
from jcr.records import Intrinsics
from jcr.rounding import significant

LOG_P = float(np.log(1e-6))
"""Logarithm of the p-value up to which an effect is significant, corrected for the number of tested change points."""
LOG_P_GIVEN = float(np.log(1e-4))
"""LOG_P for wrong given intrinsics: a single hypothesis, which must also exceed OFF or MATERIAL."""
MATERIAL = 0.5
"""Smallest shift of the camera, in standard deviations on at least one axis, for which an effect is reported."""
OF_FIRST_STEP = 0.2
"""Fraction of MATERIAL that the linearized shift must reach before the images are adjusted with an effect."""
MOST_POINTS = 800
"""Largest number of points in these tests; more points do not make them more sensitive."""
MOST_BYTES, BYTES_PER_IMAGE = 100_000_000, 16 * OF_IMAGE
"""Largest size (bytes) of the Jacobian by the parameters of each image, and its size per observation and image: 58 000
observations of 200 images would need 740 MB, and the equations several times that."""
LEAST_PX = {
    FindingKind.ROLLING_SHUTTER: 3.0,
    FindingKind.ROLLING_SHUTTER_BY_IMAGE: 3.0,
    FindingKind.CENTRE_SAGS: 3.0,
    FindingKind.THIN_PRISM: 1.0,
}
"""Smallest reported size of each effect (px); smaller ones are remaining errors of the distortion model."""
OFF = 0.01, 0.01, 0.015, 0.015
"""Differences of fx, fy, cx, cy from given ones, relative to the focal length, up to which Wald's test is not applied:
factory values and calibrations of another day are off by 0.3 to 0.9 % and a few pixels."""
OF_EACH = {FindingKind.FOCUS_BY_IMAGE, FindingKind.ROLLING_SHUTTER_BY_IMAGE}
"""Effects with a separate parameter for each image."""
SURE = 2.0
"""Smallest reported size, in standard deviations, of an effect with a parameter per image: with many images, smaller
ones become significant as soon as the noise is slightly underestimated."""
MIN_IMAGES = 6
"""Fewest images with which effects other than wrong intrinsics, and effects on the gripper poses, are tested."""
LEAST_PART = 2
"""Fewest images before and after a change of the focal length."""
ASPECT = ("fx", "p1", "p2")
"""Parameters that are tested of estimated intrinsics, for which fx = fy and p1 = p2 = 0 was assumed."""
CONCERNS: dict[FindingKind, Concerns] = {
    FindingKind.THIN_PRISM: "intrinsics",
    FindingKind.CENTRE_SAGS: "mount",
    FindingKind.INTRINSICS: "intrinsics",
}
"""Part of the capture that the remedy of an effect changes (Finding.concerns); for other effects, the images."""
FOCUS = {FindingKind.FOCUS_BY_DISTANCE, FindingKind.FOCUS_BY_IMAGE, FindingKind.ZOOM}
"""Effects of a focal length that differs between images; at most one is reported, and its size is signed."""
NEARLY_ALL = 0.9
"""Fraction of the squared focal-length differences that a simpler effect must explain to replace FOCUS_BY_IMAGE."""
INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
PAIRS = (
    (("fx", "fy"), "focal lengths of", " px", 1),
    (("cx", "cy"), "a principal point of", " px", 1),
    (("k1", "k2"), "a distortion k1, k2 of", "", 3),
    (("p1", "p2"), "a distortion p1, p2 of", "", 4),
)
"""Parameters that the message states together: their names, words, unit and number of decimals."""
NAMED = 4.0
"""Difference of a parameter, in standard deviations, from which the message states its value (4: p = 6e-5)."""
Combinations = Float[ndarray, "e p"]
"""Additional parameters of a camera: each column is one parameter, a combination of the e candidate parameters (columns)
of hypotheses.Alternatives."""


@dataclass(frozen=True)
class CameraEffect:
    """Possible effect on one camera, such as a rolling shutter: its kind, its parameters and nuisance parameters."""

    kind: FindingKind
    free: Combinations
    """Parameters of the effect, which are 0 without it."""
    beside: Float[ndarray, "e q"]
    """Nuisance parameters, which are free with and without the effect."""
    _: KW_ONLY
    unit: float = 1.0
    """Factor by which the estimated parameters are multiplied for the reported size."""
    places: int = 1
    """Number of change points that were tested, by which the p-value is multiplied."""
    after: int = 0
    """Index of the last image before a change of the focal length."""

    @property
    def both(self) -> Float[ndarray, "e r"]:
        """Matrix (e,r) of all r parameters: columns of the nuisance parameters, then of the effect's parameters."""
        return np.concatenate([self.beside, self.free], axis=1)


@dataclass(frozen=True, kw_only=True)
class CameraAdjustment:
    """Bundle adjustment that estimates all effects confirmed so far on one camera and the gripper poses."""

    adjusted: Solution
    adjust: Callable[[CameraPrior, Combinations | None, Float[ndarray, "s b"] | None], Solution]
    """Function that adjusts all images with another prior of the intrinsics, additional parameters of the camera, and b
    error patterns of the gripper poses (one standard deviation each)."""
    names: Sequence[str]
    """Names of the camera's images."""
    is_given: bool
    """Whether the intrinsics were given; otherwise the reconstruction estimated them."""
    prior: CameraPrior
    std: Float[ndarray, "6"]
    """Standard deviations of the camera's pose (m, rad); 0 for a rejected calibration."""
    camera: int = 0
    """Index of the camera among the adjusted cameras."""
    place: Callable[[State], Float[ndarray, "4 4"]] = first_x
    """Function that returns the camera's pose, in the gripper or base frame, from the state."""
    arm: int | None = 0
    """Index of the arm whose gripper poses are tested with the camera; None if another camera's tests include them."""
    found: tuple[CameraEffect, ...] = ()
    """Confirmed effects on the camera, whose parameters are estimated."""
    poses: tuple[Row, ...] = ()
    """Confirmed effects on the gripper poses, whose parameters are estimated."""

    @cached_property
    def equations(self) -> Alternatives:
        """Equations of all candidate parameters of the camera, for the estimated size of the camera-model error."""
        return self.equations_with(None)

    def equations_with(self, model_error_std: float | None) -> Alternatives:
        """Return the equations of all candidate parameters of the camera, which score tests need.

        `model_error_std` is the size of the camera-model error; None: as the adjustment estimated it.
        """
        return alternatives(self.adjusted, self.camera, self.place, model_error_std)

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics of the camera after the adjustment."""
        return self.adjusted.images.view.cameras[self.camera]

    @property
    def combinations(self) -> Combinations | None:
        """Parameters of all confirmed effects on the camera, with their nuisance parameters; None without effects."""
        return np.concatenate([one.both for one in self.found], axis=1) if self.found else None

    @property
    def log_p_of_given(self) -> float:
        """Logarithm of the p-value of Wald's test that the given focal lengths and principal point are exact.

        It is 0 (p = 1) for differences below OFF (1 to 1.5 % of the focal length), and without given intrinsics.
        """
        given = self.prior.intrinsics
        by = (parameters(self.intrinsics) - parameters(given))[:4]
        if not self.is_given or (np.abs(by) <= given.fx * np.array(OFF)).all():
            return 0.0
        covariance = self.adjusted.intrinsics_covariance(self.camera)[:4, :4]
        size = np.sqrt(np.diag(covariance))
        ratio = (by / size) @ np.linalg.pinv(covariance / np.outer(size, size), rcond=1e-9) @ (by / size) / 4
        return float(f_distribution.logsf(float(ratio), 4, self.equations.freedom))

    def with_free(self, found: Sequence[CameraEffect], poses: Sequence[Row]) -> "CameraAdjustment":
        """Return the adjustment that estimates exactly the camera effects `found` and the pose effects `poses`.

        The sizes of all errors are estimated anew. Raises LinAlgError if the problem becomes singular.
        """
        free = replace(self, found=tuple(found), poses=tuple(poses))
        own = rows_of_arm(self.adjusted.problem, self.arm or 0)
        errors = [one.prior_std * one.columns[own] for one in poses]
        bent = np.concatenate(errors, axis=1) if errors else None
        return replace(free, adjusted=self.adjust(self.prior, free.combinations, bent))

    def test(
        self, free: Combinations, beside: Float[ndarray, "e q"], equations: Alternatives | None = None
    ) -> ScoreTest:
        """Return the score test of the parameters `free`, by default with `self.equations`.

        The parameters `beside` and those of the confirmed effects are nuisance parameters.
        """
        nothing = np.zeros((len(free), 1))
        known = spanned(np.concatenate([nothing, *(one.both for one in self.found)], axis=1))
        together = np.concatenate([known, beside], axis=1)
        return test_combinations(equations or self.equations, free, together)

    def log_p(self, one: CameraEffect, equations: Alternatives | None = None) -> float:
        """Return the logarithm of an effect's p-value after multiplication by the number of tested change points."""
        return self.test(one.free, one.beside, equations).log_p + float(np.log(one.places))

    def estimates(self, one: CameraEffect) -> Float[ndarray, " p"]:
        """Return the estimated parameters of a confirmed effect, without its nuisance parameters."""
        return np.linalg.lstsq(one.both, self.equations.total, rcond=None)[0][one.beside.shape[1] :]


def rows_of_arm(problem: Problem, arm: int) -> slice:
    """Return the rows of the arm with this index among the gripper pose equations: 6 per pose, arm after arm."""
    ends = np.cumsum([0, *(6 * len(one.rigs) for one in problem.arms)]).tolist()
    return slice(ends[arm], ends[arm + 1])


def of_case(case: Case) -> CameraAdjustment:
    """Return the case's adjustment in the form that the tests of effects need; many points are reduced to a subset."""
    tracks, most = case.tracks, MOST_BYTES // (BYTES_PER_IMAGE * len(case.used))
    free, is_many = case.free_focus, len(np.unique(tracks.point)) > MOST_POINTS or len(tracks.image) > most
    if len(case.used) >= MIN_IMAGES and is_many:
        case = replace(case, chosen_tracks=some_points(tracks, most, MOST_POINTS))
        case = replace(case, adjusted=adjust_case(case, combinations=free))
    assert case.adjusted is not None
    varies = []
    if free is not None:
        varies = [CameraEffect(FindingKind.FOCUS_BY_IMAGE, free, np.zeros((len(free), 0)))]
    return CameraAdjustment(
        adjusted=case.adjusted,
        adjust=lambda prior, combinations, errors: adjust_case(
            case, prior=prior, combinations=combinations, confirmed_errors=errors
        ),
        names=[case.names[row] for row in case.used],
        is_given=case.capture.intrinsics is not None,
        prior=case.camera,
        std=np.sqrt(np.diag(case.hand_eye.covariance)[:6]) * case.hand_eye.converged,
        found=tuple(varies),
    )


def best_camera_effect(
    state: CameraAdjustment, dismissed: Sequence[CameraEffect]
) -> tuple[CameraEffect | None, float]:
    """Return the most significant camera effect and the logarithm of its p-value; (None, 0) without one.

    Effects in `dismissed` are not tested. Several significant effects are tested again with a typical size of the
    camera-model error, because the estimated size includes part of each effect. If no effect is significant, given
    intrinsics are compared with the adjusted ones by Wald's test.
    """
    excluded = {one.kind for one in (*state.found, *dismissed)}
    excluded |= FOCUS if excluded & FOCUS else set()
    limit = {FindingKind.INTRINSICS: LOG_P_GIVEN if state.is_given else LOG_P}
    tested = [(one, state.log_p(one)) for one in hypotheses(state) if one.kind not in excluded]
    likely = [(one, log_p) for one, log_p in tested if log_p <= limit.get(one.kind, LOG_P)]
    if len(likely) > 1:
        typical = state.equations_with(TYPICAL)
        return min(likely, key=lambda pair: state.log_p(pair[0], typical))
    if not likely and not state.found and FindingKind.INTRINSICS not in excluded:
        likely = [(tested[-1][0], state.log_p_of_given)] * (state.log_p_of_given <= LOG_P_GIVEN)
    return likely[0] if likely else (None, 0.0)


def with_effect_free(state: CameraAdjustment, best: CameraEffect) -> CameraAdjustment | None:
    """Return the adjustment that also estimates the effect `best`; None if the effect hardly moves the camera.

    One focal length per image (FOCUS_BY_IMAGE) is replaced by a simpler effect that explains nearly as much: a focal
    length that follows the distance or changes once. Return None also if the adjustment becomes singular.
    """
    first = state.test(best.both, best.both[:, :0]).shift
    is_given = best.kind is FindingKind.INTRINSICS and state.is_given
    if not is_given and not (np.abs(first) > OF_FIRST_STEP * MATERIAL * state.std).any():
        return None
    try:
        after = state.with_free((*state.found, best), state.poses)
        if best.kind is not FindingKind.FOCUS_BY_IMAGE:
            return after
        focal = best.free @ after.estimates(best)

        def explained(one: CameraEffect) -> float:
            """Return the fraction of the images' squared focal-length differences that a simpler effect explains."""
            along = one.free[:, 0]
            return float((along @ focal) ** 2 / ((along @ along) * (focal @ focal)))

        simple = max((one for one in hypotheses(after) if one.kind in FOCUS - {best.kind}), key=explained)
        return (
            state.with_free((*state.found, simple), state.poses) if explained(simple) > NEARLY_ALL else after
        )
    except np.linalg.LinAlgError:
        return None


def is_material(found: Finding, after: CameraAdjustment) -> bool:
    """Return whether an effect, estimated in `after`, is large and moves the camera by half a standard deviation.

    Given intrinsics that Wald's test rejects are always reported, because the user may use them elsewhere.
    """
    if found.value is not None and found.std is not None:
        least = SURE * found.std if found.kind in OF_EACH else -np.inf
        if found.value < max(least, LEAST_PX.get(found.kind, -np.inf)):
            return False
    if found.kind is FindingKind.INTRINSICS and after.log_p_of_given < 0:
        return True
    std = after.std
    if not std.any():
        # The effect may be why the calibration is rejected, so the uncertainty after its adjustment is the measure.
        std = np.sqrt(np.diag(after.adjusted.transform(after.place)[1]))
    assert found.shift is not None
    return bool((np.abs(found.shift[:6]) > MATERIAL * std).any())


def hypotheses(state: CameraAdjustment) -> list[CameraEffect]:
    """Return the possible effects on the camera; the last one is wrong intrinsics.

    A common error of the focal length is a nuisance parameter of all others. With fewer than MIN_IMAGES images, wrong
    intrinsics is the only effect.
    """
    equations = state.equations
    m, far = equations.images, np.log(equations.distance)
    focal_px, width = state.prior.intrinsics.fx, state.intrinsics.width
    common = equations.of_camera(("fx", "fy")).sum(1, keepdims=True)
    # Wrong intrinsics include the common focal length, which is a nuisance parameter of the other effects.
    nothing = np.zeros((equations.columns, 0))
    intrinsics = CameraEffect(FindingKind.INTRINSICS, equations.of_camera(_freed(state)), nothing)
    if m < MIN_IMAGES:
        return [intrinsics]
    of_centre = np.concatenate([common, equations.of_camera(("cx", "cy"))], axis=1)
    down = equations.down_in_camera[:, :, None]
    sag = np.concatenate([equations.of_images("x", down[:, 0]), equations.of_images("y", down[:, 1])], axis=1)
    by_distance = equations.of_images("focal", (far - far.mean())[:, None])
    sheared, each_sheared = (equations.of_images("shear", shares) for shares in (np.ones((m, 1)), np.eye(m)))
    found = [
        CameraEffect(FindingKind.FOCUS_BY_DISTANCE, by_distance, common, unit=float(np.ptp(far))),
        CameraEffect(FindingKind.FOCUS_BY_IMAGE, equations.of_images("focal", differences(m)), common),
        CameraEffect(FindingKind.ROLLING_SHUTTER, sheared, common, unit=focal_px),
        CameraEffect(FindingKind.ROLLING_SHUTTER_BY_IMAGE, each_sheared, common, unit=focal_px),
        CameraEffect(FindingKind.CENTRE_SAGS, sag, of_centre, unit=width),
    ]
    steps = range(LEAST_PART, m - LEAST_PART + 1)
    for k in steps:
        after = (np.arange(m) >= k) - (m - k) / m
        free = equations.of_images("focal", after[:, None])
        found.append(CameraEffect(FindingKind.ZOOM, free, common, places=len(steps), after=k - 1))
    if len(state.adjusted.problem.cameras) == 1:  # all images have the same lens
        found.append(CameraEffect(FindingKind.THIN_PRISM, np.eye(equations.columns)[:, -PRISM:], of_centre))
    return [*found, intrinsics]


def _freed(state: CameraAdjustment) -> tuple[str, ...]:
    """Return the names of the parameters that the effect "wrong intrinsics" tests; for estimated ones fx, p1, p2.

    A given distortion that folds over was not used, which its prior shows; it is not tested either.
    """
    prior = state.prior
    std = np.sqrt(prior.directions**2 @ prior.std**2)
    loose = {
        name
        for name, one in zip(state.equations.names, std, strict=True)
        if one >= ESTIMATED.get(name, np.inf)
    }
    tested = (name for name in INTRINSICS if name not in loose - {"cx", "cy"}) if state.is_given else ASPECT
    return tuple(name for name in tested if name in state.equations.names)


def camera_finding(after: CameraAdjustment, before: CameraAdjustment) -> Finding:
    """Return the finding of the last camera effect in `after`; `before` is the adjustment without that effect.

    The shift of the finding is the change of camera pose and scale from `before` to `after`.
    """
    best, place = after.found[-1], after.place
    alone = before.test(best.both, best.both[:, :0])
    last = replace(after, found=before.found).test(best.free, best.beside, after.equations)
    log_p = alone.log_p + np.log(best.places)
    if best.kind is FindingKind.INTRINSICS:
        log_p = min(log_p, before.log_p_of_given)
    step = step_between(place(before.adjusted.state), place(after.adjusted.state)).tolist()
    growth = float(np.log(after.adjusted.state.scale / before.adjusted.state.scale))
    changed = after.names[best.after : best.after + 2] if best.kind is FindingKind.ZOOM else ()
    return Finding.of(
        best.kind,
        "warns",
        CONCERNS.get(best.kind, "images"),
        *changed,
        p=float(np.exp(max(log_p, -700))),
        shift=(*step, growth),
        intrinsics_shift=tuple((parameters(after.intrinsics) - parameters(before.intrinsics)).tolist()),
        **_size(after, last.covariance),
    )


def _size(after: CameraAdjustment, covariance: Float[ndarray, "p p"]) -> dict[str, Any]:
    """Return the fields of a finding that state the size of the last confirmed effect, and its standard deviation.

    The size is the rms of the effect's parameters; for a thin prism it is the largest displacement of a point (px); for
    wrong intrinsics each parameter is stated. `covariance` is that of the effect's parameters.
    """
    best, std = after.found[-1], np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if best.kind is FindingKind.INTRINSICS:
        units = dict(zip(after.equations.names, after.equations.units, strict=True))
        stds = {name: float(one * units[name]) for name, one in zip(_freed(after), std, strict=True)}
        return _intrinsics(after, stds)
    value = after.estimates(best)
    if best.kind is FindingKind.THIN_PRISM:
        moved = after.adjusted.problem.prism @ value
        k = int(np.linalg.norm(moved, axis=1).argmax())
        size = float(np.linalg.norm(moved[k]))
        along = moved[k] / max(size, 1e-12) @ after.adjusted.problem.prism[k]
        return {"value": size, "std": float(np.sqrt(along @ covariance @ along))}
    typical, count = best.unit * float(np.median(std)), len(value)
    if best.kind in OF_EACH:
        return {"value": best.unit * float(np.sqrt(value @ value / after.equations.images)), "std": typical}
    size = value[0] if best.kind in FOCUS else np.sqrt(np.mean(value**2))
    return {"value": best.unit * float(size), "std": typical / float(np.sqrt(count))}


def _intrinsics(after: CameraAdjustment, std: Mapping[str, float]) -> dict[str, float | str]:
    """Return the `details` of the finding of wrong intrinsics: estimated, given and significantly different values.

    `std` holds the standard deviation of each tested parameter.
    """
    names, shown = parameter_names(after.intrinsics), list[str]()
    given, now = (
        dict(zip(names, parameters(one).tolist(), strict=True))
        for one in (after.prior.intrinsics, after.intrinsics)
    )
    for pair, what, unit, digits in PAIRS:
        surest = max((std[name] for name in pair if name in std), default=0.0)
        if any(abs(now[name] - given[name]) > NAMED * std[name] for name in pair if name in std):
            found, was = (", ".join(f"{of[name]:.{digits}f}" for name in pair) for of in (now, given))
            before = "is given" if after.is_given else "was estimated first"
            shown.append(f"{what} ({found}) ± {significant(surest)}{unit} where ({was}) {before}")
    unsure = "other intrinsics than those used, no one of them surely by itself"
    details: dict[str, float | str] = {"source": "images", "shown": joined(shown or [unsure])}
    details |= {} if after.is_given else {"estimated": 1.0}
    for name in filter(now.__contains__, INTRINSICS):
        details |= {name: now[name], f"{name}_given": given[name]}
    return details | {f"{name}_std": one for name, one in std.items()}
