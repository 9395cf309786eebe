"""Is it one camera in all images? A focus that moves, a zoom, a rolling shutter, intrinsics that are a little wrong.

Each is a hypothesis of `nuisance.py`, tested beside a focal length that is wrong by the same factor in all images. The
one with the least p is named, with its value and what it would do to the answer; then the next beside it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.bundle import Adjusted
from jcr.calibration.nuisance import SHEAR, Nuisance, Tested, nuisance, nuisance_columns, spanned, tested
from jcr.camera import parameter_names, parameters, with_parameters
from jcr.geometry import step_between
from jcr.records import Finding, Intrinsics, Kind, Tracks

LOG_P = float(np.log(1e-6))
"""Chance of any one alarm where there is nothing, before it is divided by the number of places of a change."""
MATERIAL = 0.5
"""Standard deviations that the answer would move by on an axis: what does less is nobody's worry."""
OF_FIRST_STEP = 0.2
"""Share of that which the first step towards a fault must go, for the adjustments that follow take long."""
AT_ONCE = 2
"""Faults named of one capture."""
MOST_POINTS, WELL_SEEN = 800, 3
"""Points that take part, first those in this many images: more tell a fault no better, and take time."""
LEAST_SHEAR_PX = 3.0
"""From top to bottom; less of it than this is what a distortion model leaves over."""
MIN_IMAGES = 5
LEAST_PART = 2
"""Images before and after a change."""
ASPECT = ("fx", "p1", "p2")
"""Of estimated intrinsics, whose focal length is one and whose tangential distortion is none: what is held."""
MOST_ROUNDS, SETTLED = 8, 3e-4
"""Adjustments with a fault corrected, and its change by which they end: a fifth of a pixel at an image's edge."""
FOCUS = {"distance", "scatter", "zoom"}
"""Of a focal length that differs between images, one is named."""
NEARLY_ALL = 0.9
"""Of the squares of what the focal length differs by."""
LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


@dataclass(frozen=True)
class CameraFaults:
    """What is wrong with the camera, and the adjustment that allows for it."""

    faults: tuple[Finding, ...]
    adjusted: Adjusted
    """With what was found allowed for."""
    more_covariance: Float[ndarray, "6 6"]
    """Of its X, for what was found is not known exactly."""


@dataclass(frozen=True)
class _Hypothesis:
    kind: str
    free: Float[ndarray, "e p"]
    """What it says."""
    beside: Float[ndarray, "e q"]
    """What is free with it and tells nothing."""
    places: int = 1
    """That were searched."""
    after: int = 0
    """Image before a change."""

    @property
    def of_lens(self) -> bool:
        """The same intrinsics would be right for all images."""
        return self.kind in ("lens", "aspect")

    @property
    def both(self) -> Float[ndarray, "e r"]:
        """All that it frees."""
        return np.concatenate([self.beside, self.free], axis=1)


Readjust = Callable[[Tracks, Intrinsics], Adjusted]
"""The adjustment once more, of observations that were corrected, with other intrinsics."""


def camera_faults(
    adjusted: Adjusted,
    tracks: Tracks,
    readjust: Readjust,
    covariance: Float[ndarray, "7 7"],
    held: bool,
    images: Sequence[str],
    focus_varies: bool = False,
    seed: int = 0,
) -> CameraFaults:
    """What the images say against one camera with these intrinsics, and the adjustment that allows for it.

    `covariance` is that of the answer, `held` whether intrinsics were given, `images` the names of those adjusted, in
    the order in which they were taken. With `focus_varies` a focal length of each image is allowed for and not named.
    """
    m = len(adjusted.bundle.base_from_gripper)
    if m < MIN_IMAGES:
        return CameraFaults((), adjusted, np.zeros((6, 6)))
    std, used, all_tracks = np.sqrt(np.diag(covariance)[:6]), adjusted.bundle.camera, tracks
    if len(np.unique(tracks.point)) > MOST_POINTS:
        tracks = _some(tracks, seed)
        adjusted = readjust(tracks, used)
    given = adjusted.problem.intrinsics
    found: list[_Hypothesis] = []
    named: list[Finding] = []
    equations, total = nuisance(adjusted, used), np.zeros(nuisance_columns(used, m))
    if focus_varies:
        found.append(next(one for one in _hypotheses(equations, held) if one.kind == "scatter"))
        adjusted, equations, total = _settled(adjusted, equations, total, found, tracks, readjust, used)
    dismissed: list[_Hypothesis] = []
    while len(named) < AT_ONCE:
        best = _most_likely(equations, held, found, dismissed)
        if best is None:
            break
        before = adjusted
        alone = tested(equations, best.both, _all(found, equations))
        if not (np.abs(alone.shift) > OF_FIRST_STEP * MATERIAL * std).any():
            dismissed.append(best)
            continue
        moved = adjusted, equations, total
        adjusted, equations, total = _settled(
            adjusted, equations, total, [*found, best], tracks, readjust, used
        )
        if best.kind == "scatter" and (simple := _simpler(best, total, equations, held)) is not None:
            best = simple
            adjusted, equations, total = _settled(*moved, [*found, best], tracks, readjust, used)
        at = len(equations.names)
        sheared = np.abs(total[at]) + np.sqrt(np.mean(total[at + 1 + m :] ** 2))
        shift = np.r_[
            step_between(before.bundle.gripper_from_camera, adjusted.bundle.gripper_from_camera),
            np.log(adjusted.scale / before.scale),
        ]
        small = best.kind.startswith("shear") and sheared * used.fx < LEAST_SHEAR_PX
        if small or not (np.abs(shift[:6]) > MATERIAL * std).any():
            adjusted, equations, total = moved
            dismissed.append(best)
            continue
        found.append(best)
        last = tested(equations, best.free, _all(found[:-1], equations, best.beside))
        p = float(np.exp(max(alone.log_p + np.log(best.places), -700)))
        size = _size(best, total, last, equations, given, adjusted.bundle.camera, images)
        named.append(Finding(severity="warns", p=p, shift=tuple(shift.tolist()), **size))
    if not found:
        return CameraFaults((), adjusted, np.zeros((6, 6)))
    if tracks is not all_tracks and focus_varies:
        adjusted = readjust(_corrected(all_tracks, total, adjusted.bundle.camera), adjusted.bundle.camera)
    with_all = tested(equations, _all(found, equations)).shift_covariance
    without = tested(equations, np.zeros((equations.extra, 0))).shift_covariance
    return CameraFaults(tuple(named), adjusted, with_all - without)


def _some(tracks: Tracks, seed: int) -> Tracks:
    """The observations of a random choice of the points that most images see."""
    count = np.bincount(tracks.point, minlength=len(tracks.points_in_recon))
    order = np.random.default_rng(seed).permutation(len(count))
    enough = order[np.argsort(count[order] < WELL_SEEN, kind="stable")]
    chosen = np.zeros(len(count), bool)
    chosen[enough[count[enough] >= 2][:MOST_POINTS]] = True
    rows = chosen[tracks.point]
    return replace(tracks, image=tracks.image[rows], x_px=tracks.x_px[rows], point=tracks.point[rows])


def _all(
    found: Sequence[_Hypothesis], equations: Nuisance, more: Float[ndarray, "e q"] | None = None
) -> Float[ndarray, "e r"]:
    """The combinations that are free already; of those that say the same, one."""
    parts = [one.both for one in found] + ([] if more is None else [more])
    return spanned(np.concatenate([np.zeros((equations.extra, 1)), *parts], axis=1))


def _most_likely(
    equations: Nuisance, held: bool, found: Sequence[_Hypothesis], dismissed: Sequence[_Hypothesis]
) -> _Hypothesis | None:
    """The hypothesis of least p, if that is little enough to be believed."""
    before, result = _all(found, equations), None
    for candidate in _hypotheses(equations, held):
        if any(_alike(candidate, one) for one in (*found, *dismissed)):
            continue
        beside = np.concatenate([before, candidate.beside], axis=1)
        log_p = tested(equations, candidate.free, beside).log_p + np.log(candidate.places)
        if result is None or log_p < result[0]:
            result = log_p, candidate
    return None if result is None or result[0] > LOG_P else result[1]


def _alike(one: _Hypothesis, other: _Hypothesis) -> bool:
    return one.kind == other.kind or {one.kind, other.kind} <= FOCUS


def _simpler(
    scatter: _Hypothesis, total: Float[ndarray, " e"], equations: Nuisance, held: bool
) -> _Hypothesis | None:
    """A focal length that follows distance, or changed once, where that explains nearly all that it scatters."""
    focal = scatter.free @ np.linalg.lstsq(scatter.both, total, rcond=None)[0][scatter.beside.shape[1] :]
    best = None
    for candidate in _hypotheses(equations, held):
        if candidate.kind not in FOCUS or candidate.kind == scatter.kind:
            continue
        along = candidate.free[:, 0]
        explained = float((along @ focal) ** 2 / ((along @ along) * (focal @ focal)))
        if best is None or explained > best[0]:
            best = explained, candidate
    return best[1] if best is not None and best[0] > NEARLY_ALL else None


def _settled(
    adjusted: Adjusted,
    equations: Nuisance,
    total: Float[ndarray, " e"],
    found: Sequence[_Hypothesis],
    tracks: Tracks,
    readjust: Readjust,
    used: Intrinsics,
) -> tuple[Adjusted, Nuisance, Float[ndarray, " e"]]:
    """The adjustment with what was found corrected in its observations and intrinsics, until it moves no more.

    Not in one step: the robot pose noise was estimated with the fault in it, and the cameras are far from where
    they were.
    """
    free, lens = _all(found, equations), any(one.of_lens for one in found)
    intrinsics = adjusted.problem.intrinsics
    for _ in range(MOST_ROUNDS):
        step = tested(equations, free)
        by = free @ step.value
        if lens:
            # From where they are now: what was known of them before is what the images contradict.
            camera = adjusted.bundle.camera
            intrinsics = with_parameters(
                camera, parameters(camera) + equations.units * by[: len(equations.names)]
            )
        total = total + by
        adjusted = readjust(_corrected(tracks, total, intrinsics), intrinsics)
        equations = nuisance(adjusted, used)
        if np.abs(by if lens else by[len(equations.names) :]).max() < SETTLED:
            break
    return adjusted, equations, total


def _corrected(tracks: Tracks, total: Float[ndarray, " e"], camera: Intrinsics) -> Tracks:
    """Observations as a camera without the fault would have made them."""
    at = len(parameters(camera))
    m = (len(total) - at - 1) // 2
    focal, shear = total[at + 1 : at + 1 + m], total[at + 1 + m :]
    centre = np.array([camera.cx, camera.cy])
    about = tracks.x_px - centre
    row = about[:, 1] / camera.height
    about[:, 0] -= camera.fx * row * (total[at] + shear[tracks.image])
    return replace(tracks, x_px=centre + about * np.exp(-focal[tracks.image])[:, None])


def _hypotheses(equations: Nuisance, held: bool) -> list[_Hypothesis]:
    m = equations.images
    far = np.log(equations.distance)
    far = far - far.mean()
    differing = np.linalg.svd(np.eye(m) - 1 / m)[0][:, : m - 1]
    steps = np.arange(LEAST_PART, m - LEAST_PART + 1)
    common, nothing = equations.common_focal(), np.zeros((equations.extra, 0))
    found = [
        _Hypothesis("distance", equations.focal_of_images(far[:, None]), common),
        _Hypothesis("scatter", equations.focal_of_images(differing), common),
        _Hypothesis("shear", equations.of_camera((SHEAR,)), common),
        _Hypothesis("shear of each", equations.shear_of_images(np.eye(m)), common),
    ]
    for k in steps:
        after = (np.arange(m) >= k) - (m - k) / m
        free = equations.focal_of_images(after[:, None])
        found.append(_Hypothesis("zoom", free, common, len(steps), int(k) - 1))
    # A lens that is wrong in all images includes the focal length that tells nothing in the others.
    kind = "lens" if held else "aspect"
    found.append(_Hypothesis(kind, equations.of_camera(_freed(kind, equations)), nothing))
    return found


def _size(
    fault: _Hypothesis,
    total: Float[ndarray, " e"],
    last: Tested,
    equations: Nuisance,
    given: Intrinsics,
    now: Intrinsics,
    images: Sequence[str],
) -> dict[str, Any]:
    """The fields of a finding that say what and how large the fault is."""
    value = np.linalg.lstsq(fault.both, total, rcond=None)[0][fault.beside.shape[1] :]
    std = np.sqrt(np.maximum(np.diag(last.covariance), 0.0))
    if fault.of_lens:
        units = dict(zip(equations.names, equations.units, strict=True))
        names = _freed(fault.kind, equations)
        details = _parameters({name: std[k] * units[name] for k, name in enumerate(names)}, given, now)
        return {"kind": Kind.INTRINSICS, "mend": "intrinsics", "details": details}
    kind, size, error = {
        "distance": (Kind.FOCUS_BY_DISTANCE, value[0], std[0]),
        "scatter": (Kind.FOCUS_BY_IMAGE, np.sqrt(value @ value / equations.images), np.median(std)),
        "zoom": (Kind.ZOOM, value[0], std[0]),
        "shear": (Kind.ROLLING_SHUTTER, abs(value[0]), std[0]),
        "shear of each": (Kind.ROLLING_SHUTTER_BY_IMAGE, np.sqrt(np.mean(value**2)), np.median(std)),
    }[fault.kind]
    unit = float(np.ptp(np.log(equations.distance))) if fault.kind == "distance" else 1.0
    if fault.kind.startswith("shear"):
        unit = given.fx
    between = images[fault.after : fault.after + 2] if fault.kind == "zoom" else ()
    return {
        "kind": kind,
        "mend": "images",
        "value": unit * float(size),
        "std": unit * float(error),
        "images": tuple(between),
    }


def _freed(kind: str, equations: Nuisance) -> tuple[str, ...]:
    """Parameters of the intrinsics that a hypothesis frees, of those that the model has."""
    return tuple(name for name in (LENS if kind == "lens" else ASPECT) if name in equations.names)


def _parameters(std: dict[str, float], given: Intrinsics, now: Intrinsics) -> dict[str, float]:
    """Parameters as they are and as they were given; standard deviations of those that were freed."""
    found: dict[str, float] = {}
    for name, old, new in zip(parameter_names(given), parameters(given), parameters(now), strict=True):
        if name in LENS:
            found |= {name: float(new), f"{name}_given": float(old)}
    return found | {f"{name}_std": float(value) for name, value in std.items()}
