"""Effects on one camera: a focal length that varies, a rolling shutter, a thin prism, intrinsics that are wrong.

Each is a hypothesis of estimation/hypotheses.py, tested beside a focal length that is wrong by one factor in all images.
The images are adjusted with the effect free, which shows its size and the motion of the camera that comes with it.
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
from jcr.estimation.intrinsics_prior import TYPICAL, CameraPrior
from jcr.estimation.problem import OF_IMAGE, PRISM, Problem, State, spanned
from jcr.estimation.solve import Solution
from jcr.findings import Concerns, Finding, FindingKind, joined
from jcr.geometry import step_between
from jcr.records import Intrinsics
from jcr.rounding import significant

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
OFF = 0.01, 0.01, 0.015, 0.015
"""Differences of focal lengths and principal point from given ones, in focal lengths, that are a fault: factory values
and calibrations of another day are off by 0.3 to 0.9 % and a few pixels."""
OF_EACH = {FindingKind.FOCUS_BY_IMAGE, FindingKind.ROLLING_SHUTTER_BY_IMAGE}
"""Effects that differ from image to image."""
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
    FindingKind.INTRINSICS: "intrinsics",
}
"""Remedy of effects that other images do not help against."""
FOCUS = {FindingKind.FOCUS_BY_DISTANCE, FindingKind.FOCUS_BY_IMAGE, FindingKind.ZOOM}
"""Effects of a focal length that differs between images, of which one is named; their sizes have a sign."""
NEARLY_ALL = 0.9
"""Share of the squared differences of focal lengths that a simpler effect must explain."""
INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
PAIRS = (
    (("fx", "fy"), "focal lengths of", " px", 1),
    (("cx", "cy"), "a principal point of", " px", 1),
    (("k1", "k2"), "a distortion k1, k2 of", "", 3),
    (("p1", "p2"), "a distortion p1, p2 of", "", 4),
)
"""Parameters that are named together: names, words, unit and decimals."""
NAMED = 4.0
"""Standard deviations from which a parameter is named by itself (4: p = 6e-5)."""
Combinations = Float[ndarray, "e p"]
"""Combinations of the columns of hypotheses.Alternatives."""


@dataclass(frozen=True)
class CameraEffect:
    """Combinations of the columns of hypotheses.Alternatives that one effect frees."""

    kind: FindingKind
    free: Combinations
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

    @property
    def both(self) -> Float[ndarray, "e r"]:
        """All combinations that are freed."""
        return np.concatenate([self.beside, self.free], axis=1)


@dataclass(frozen=True, kw_only=True)
class CameraAdjustment:
    """Adjustment of images with effects on one camera and on gripper poses free."""

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
    camera: int = 0
    """Number of the camera among the adjusted ones."""
    place: Callable[[State], Float[ndarray, "4 4"]] = first_x
    """Function that returns the camera's pose on its parent."""
    arm: int | None = 0
    """Number of the arm whose gripper poses are tested with the camera; None where another camera's test has them."""
    found: tuple[CameraEffect, ...] = ()
    """Effects on the camera that are free."""
    poses: tuple[Row, ...] = ()
    """Effects on the gripper poses that are free."""

    @cached_property
    def equations(self) -> Alternatives:
        """Equations of the columns that may be freed."""
        return self.equations_with(None)

    def equations_with(self, model_error_std: float | None) -> Alternatives:
        """Return these equations for a size of the camera-model error; None: as estimated."""
        return alternatives(self.adjusted, self.camera, self.place, model_error_std)

    @property
    def intrinsics(self) -> Intrinsics:
        """Adjusted intrinsics."""
        return self.adjusted.images.view.cameras[self.camera]

    @property
    def combinations(self) -> Combinations | None:
        """Combinations that all effects free; None without an effect."""
        return np.concatenate([one.both for one in self.found], axis=1) if self.found else None

    @property
    def log_p_of_given(self) -> float:
        """Logarithm of the probability of the estimated focal lengths and centre if the given ones were exact.

        This is Wald's test; it is 0 for differences below OFF, and for intrinsics that were not given.
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
        """Adjust again with these effects free: the sizes of all errors change with them.

        Raises LinAlgError where the images then determine nothing any more.
        """
        free = replace(self, found=tuple(found), poses=tuple(poses))
        own = rows_of_arm(self.adjusted.problem, self.arm or 0)
        errors = [one.prior_std * one.columns[own] for one in poses]
        bent = np.concatenate(errors, axis=1) if errors else None
        return replace(free, adjusted=self.adjust(self.prior, free.combinations, bent))

    def test(
        self, free: Combinations, beside: Float[ndarray, "e q"], equations: Alternatives | None = None
    ) -> ScoreTest:
        """Return the test of combinations beside others and those of the effects that are free."""
        nothing = np.zeros((len(free), 1))
        known = spanned(np.concatenate([nothing, *(one.both for one in self.found)], axis=1))
        together = np.concatenate([known, beside], axis=1)
        return test_combinations(equations or self.equations, free, together)

    def log_p(self, one: CameraEffect, equations: Alternatives | None = None) -> float:
        """Return the logarithm of the probability of an effect's gain by chance, times the places searched."""
        return self.test(one.free, one.beside, equations).log_p + float(np.log(one.places))

    def estimates(self, one: CameraEffect) -> Float[ndarray, " p"]:
        """Return the estimates of the combinations of an effect that is free."""
        return np.linalg.lstsq(one.both, self.equations.total, rcond=None)[0][one.beside.shape[1] :]


def rows_of_arm(problem: Problem, arm: int) -> slice:
    """Return the rows of the equations of the gripper poses that are those of an arm."""
    ends = np.cumsum([0, *(6 * len(one.rigs) for one in problem.arms)]).tolist()
    return slice(ends[arm], ends[arm + 1])


def of_case(case: Case) -> CameraAdjustment:
    """Return the capture's own camera, adjusted with no more points than the tests need."""
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
    """Return the significant camera effect that explains most and the logarithm of its probability by chance.

    The size of the camera-model error absorbs every effect until all of them gain as little: the effects are compared
    with that size at its typical value. The score test compares with intrinsics that are off by what is usual, and the
    adjustment may have left those that were given: where nothing else explains the images, it is compared with them.
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
    """Adjust with one more effect free, or with the simpler one that explains nearly the same.

    A focal length that follows distance, or changed once, is simpler than one of each image. Return None where the
    first step towards the effect moves the camera too little, or where the images then determine nothing.
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
            along = one.free[:, 0]
            return float((along @ focal) ** 2 / ((along @ along) * (focal @ focal)))

        simple = max((one for one in hypotheses(after) if one.kind in FOCUS - {best.kind}), key=explained)
        return (
            state.with_free((*state.found, simple), state.poses) if explained(simple) > NEARLY_ALL else after
        )
    except np.linalg.LinAlgError:
        return None


def is_material(found: Finding, after: CameraAdjustment) -> bool:
    """Return whether an effect is large enough to be a fault and moves the camera.

    Given intrinsics that are contradicted are a fault in any case: users have them elsewhere.
    """
    if found.value is not None and found.std is not None:
        least = SURE * found.std if found.kind in OF_EACH else -np.inf
        if found.value < max(least, LEAST_PX.get(found.kind, -np.inf)):
            return False
    if found.kind is FindingKind.INTRINSICS and after.log_p_of_given < 0:
        return True
    std = after.std
    if not std.any():
        # A rejected calibration is uncertain by the effect: the uncertainty that remains beside the effects counts.
        std = np.sqrt(np.diag(after.adjusted.transform(after.place)[1]))
    assert found.shift is not None
    return bool((np.abs(found.shift[:6]) > MATERIAL * std).any())


def hypotheses(state: CameraAdjustment) -> list[CameraEffect]:
    """Return the effects that are tested, with a focal length that is wrong in all images free beside them."""
    equations = state.equations
    m, far = equations.images, np.log(equations.distance)
    focal_px, width = state.prior.intrinsics.fx, state.intrinsics.width
    common = equations.of_camera(("fx", "fy")).sum(1, keepdims=True)
    # Intrinsics that are wrong in all images include the focal length that shows nothing in the others.
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
    if len(state.adjusted.problem.cameras) == 1:  # all images share the glass
        found.append(CameraEffect(FindingKind.THIN_PRISM, np.eye(equations.columns)[:, -PRISM:], of_centre))
    return [*found, intrinsics]


def _freed(state: CameraAdjustment) -> tuple[str, ...]:
    """Return the parameters of the camera model that are tested."""
    return tuple(name for name in (INTRINSICS if state.is_given else ASPECT) if name in state.equations.names)


def camera_finding(after: CameraAdjustment, before: CameraAdjustment) -> Finding:
    """Return the last camera effect that was freed as a finding."""
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
    """Return the fields of a finding that state the size of the last effect: of several estimates their rms.

    A thin prism has the largest displacement among the points; of wrong intrinsics each parameter is stated.
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
    """Return the details of wrong intrinsics: each parameter as found and as given, and those that differ surely."""
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
