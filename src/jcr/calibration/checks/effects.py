"""Forward selection of effects that the model lacks, on the camera and on the gripper poses, until none is significant.

In each round the best effect on the camera competes with the best one on the poses (estimation/hypotheses.py). If both
are significant, the cause is the one that makes the other insignificant. Confirmed effects are estimated in all further
tests, and the final adjustment includes those that its model can represent.
"""

from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.calibration.bundle_adjustment import solution_of, solved
from jcr.calibration.case import MATERIAL, Case, with_prism
from jcr.calibration.options import GRASPING
from jcr.calibration.record import Calibration
from jcr.calibration.verdict import poses_agree
from jcr.camera import parameter_names, parameters
from jcr.distributions import f as f_distribution
from jcr.estimation.hypotheses import (
    STRAINS,
    TESTED_IF_GIVEN,
    Examined,
    Test,
    camera_effects,
    confirm,
    explains_by_order,
    pose_effects,
    rank,
    squared_length,
    tested_intrinsics,
)
from jcr.estimation.problem import OF_IMAGE, SCALE, Effect, PoseModel, pose_problem
from jcr.estimation.robot_noise import solve_equations
from jcr.estimation.solve import Solution, solve
from jcr.findings import Concerns, Finding, FindingKind, joined, kinds_of
from jcr.geometry import Poses, step_between
from jcr.number_format import significant

MOST_EFFECTS = 3
"""Largest number of effects that are reported for one capture."""
EXAMINED_FROM = 6
"""Fewest images with which effects other than wrong intrinsics are tested."""
MOST_POINTS = 800
"""Largest number of points in these tests; more points do not make them more sensitive."""
MOST_BYTES, BYTES_PER_IMAGE = 100_000_000, 16 * OF_IMAGE
"""Largest size (bytes) of the Jacobian by the parameters of each image, and its size per observation and image: 58 000
observations of 200 images would need 740 MB, and the equations several times that."""
LARGE_MOTION = GRASPING[0] * 1e-3, float(np.radians(GRASPING[1]))
"""Motion of camera or base (m, rad) above which the calibration is rejected; a smaller one adds to the uncertainty."""
TINY_PX, TINY = 0.5, 0.1
"""Displacement in the corner of the image (px), and change of the calibration in units of LARGE_MOTION, up to which
different focal lengths are a remark and no warning."""
OFF = 0.01, 0.01, 0.015, 0.015
"""Differences of fx, fy, cx, cy from given ones, relative to the focal length, up to which Wald's test is not applied:
factory values and calibrations of another day are off by 0.3 to 0.9 % and a few pixels."""
SURE = 2.0
"""Smallest reported size, in standard deviations, of an effect with a parameter per image: with many images, smaller
ones become significant as soon as the noise is slightly underestimated."""
PAIRS = (
    (("fx", "fy"), "focal lengths of", " px", 1),
    (("cx", "cy"), "a principal point of", " px", 1),
    (("k1", "k2"), "a distortion k1, k2 of", "", 3),
    (("p1", "p2"), "a distortion p1, p2 of", "", 4),
)
"""Parameters that the message states together: their names, words, unit and number of decimals."""
NAMED = 4.0
"""Difference of a parameter, in standard deviations, from which the message states its value (4: p = 6e-5)."""


@dataclass(frozen=True)
class Policy:
    """Significance level, plausible size and finding of one kind of effect."""

    concerns: Concerns
    """Part of the capture that the remedy changes."""
    alpha: float
    """Largest significant p-value, corrected for the number of tested places."""
    largest: tuple[float, float] = (np.inf, np.inf)
    """Largest plausible estimate: (m, rad) of a motion, the norm of the parameters of another effect on the poses, or
    the largest parameter of an effect on the camera, which must be known to half of this, too."""
    least_px: float = 0.0
    """Smallest reported size (px); smaller ones are remaining errors of the distortion model."""


LARGEST_FOCUS, LARGEST_SHEAR, LARGEST_PRISM = 0.3, 0.1, 0.2
"""Largest plausible change of a focal length (relative; a zoom of 1.3), shear of an image by its shutter (focal lengths;
an image read in 30 ms by a camera 0.3 m away that moves by 1 m/s), and prism coefficient. Real lenses stay far below."""
PLAUSIBLE = {"fx": 0.3, "fy": 0.3, "cx": 0.25, "cy": 0.25, "k1": 2.0, "k2": 5.0, "p1": 0.05, "p2": 0.05}
"""Largest plausible difference of each intrinsic from the given or first one: focal lengths relative, principal point in
image widths. Tangential distortions of real lenses are below 0.01."""
OF_STRAIN = 1e-6
"""Significance level of effects of the arm: in 132 simulated captures of 8 to 20 images without such effects, 72 of
them by arms with joint offsets up to 1° and link errors of 1 mm, no p-value is below 1e-5."""
POLICIES = {
    FindingKind.SLIP: Policy("mount", 1e-4, (0.12, np.radians(45.0))),
    FindingKind.BASE_MOVED: Policy("poses", 1e-4, (0.2, np.radians(20.0))),
    FindingKind.DRIFT: Policy("mount", 1e-4, (0.03, np.radians(10.0))),
    FindingKind.DELAY: Policy("poses", 1e-4, (1.0, np.inf)),
    FindingKind.LENGTHS: Policy("robot", OF_STRAIN, (0.1, np.inf)),
    FindingKind.BASE_LEANS: Policy("robot", OF_STRAIN, (0.3, np.inf)),
    FindingKind.TOOL_SAGS: Policy("robot", OF_STRAIN, (0.3, np.inf)),
    FindingKind.FOCUS_BY_DISTANCE: Policy("images", 1e-6, (LARGEST_FOCUS, np.inf)),
    FindingKind.FOCUS_BY_IMAGE: Policy("images", 1e-6, (LARGEST_FOCUS, np.inf)),
    FindingKind.ZOOM: Policy("images", 1e-6, (LARGEST_FOCUS, np.inf)),
    FindingKind.ROLLING_SHUTTER: Policy("images", 1e-6, (LARGEST_SHEAR, np.inf), least_px=3.0),
    FindingKind.THIN_PRISM: Policy("intrinsics", 1e-6, (LARGEST_PRISM, np.inf), least_px=1.0),
    FindingKind.INTRINSICS: Policy("intrinsics", 1e-6),
}
"""Effects that are tested, by the kind of their finding."""
ALPHA_IF_GIVEN = 1e-4
"""Policy.alpha of wrong intrinsics that were given: a single hypothesis, which must also exceed OFF or MATERIAL."""
FOCUS = {FindingKind.FOCUS_BY_DISTANCE, FindingKind.FOCUS_BY_IMAGE, FindingKind.ZOOM}
"""Effects of a focal length that differs between images; at most one is reported, and its size is signed."""
NEARLY_ALL = 0.9
"""Fraction of the squared focal-length differences that a simpler effect must explain to replace FOCUS_BY_IMAGE."""
CONFIRMED_AT_MOST = {True: 2, False: 3}
"""Number of kinds of effects that are confirmed, on the camera (True), each by an adjustment, and on the poses."""


def check_effects(case: Case) -> Case:
    """Return the case with findings on effects that the model lacks, such as rolling shutter, camera slip or arm sag.

    With adjusted images, the calibration then includes the effects as parameters. Only the findings are added if the
    tests also use consecutive rejected images (`with_rejected_runs`). A fit to camera poses is tested only for effects
    of the image order.
    """
    if not case.is_open:
        return case
    longer, in_order = case, with_rejected_runs(case.model.used)
    if (in_order != case.model.used).any():
        # A slip of the camera may reject consecutive images, which are then used again.
        longer = replace(case, model=replace(case.model, used=in_order))
        with suppress(np.linalg.LinAlgError):
            if case.solution is not None:
                longer = replace(longer, solution=solution_of(case, longer.model))
    # Of tracks from pointmaps the camera is not tested: the network used intrinsics of its own.
    if longer.solution is None or case.model.tracks.from_pointmaps:
        poses = case.base_from_gripper, case.recon_from_camera
        found = effects_of_fit(*poses, case.calibration, case.names, case.pose_model)
        return case.found(*found)
    confirmed, findings = effects(examined_case(longer))
    return case.found(*findings) if longer is not case else _adopted(case, confirmed, findings)


def examined_case(case: Case) -> Examined:
    """Return the solution of a case in the form that the tests of effects need (hypotheses.Examined).

    A case with more than MOST_POINTS points, or too many observations for MOST_BYTES of memory, is adjusted again with
    a random subset of its points. This applies to cases with EXAMINED_FROM or more used images.
    """
    tracks, most, solution = (
        case.model.observations,
        MOST_BYTES // (BYTES_PER_IMAGE * len(case.used)),
        case.solution,
    )
    is_many = len(np.unique(tracks.point)) > MOST_POINTS or len(tracks.image) > most
    if len(case.used) >= EXAMINED_FROM and is_many:
        fewer = min(most, case.model.most)
        solution = solution_of(case, replace(case.model, most=fewer, most_points=MOST_POINTS))
    assert solution is not None
    found = case.calibration
    return Examined(
        solution=solution,
        names=[case.names[row] for row in case.used],
        std=np.sqrt(np.diag(found.covariance)[:6]) * found.converged,
        is_given=case.capture.intrinsics is not None,
    )


def effects_of_fit(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    hand_eye: Calibration,
    names: Sequence[str],
    model: PoseModel,
) -> tuple[Finding, ...]:
    """Return a finding of the most significant effect of the image order on a fit to camera poses, or an empty tuple.

    Both pose arrays (n,4,4) are those of the fit `hand_eye` in the order of the images, whose names are `names`.
    `model` is that of the fit.
    """
    start = hand_eye.parent_from_camera, hand_eye.scale, hand_eye.body_from_recon.rigid
    problem, state = pose_problem(base_from_gripper, recon_from_camera, start, model)
    used = with_rejected_runs(hand_eye.inliers)
    solution = solve(replace(problem, used=used), state, averaged=False)
    examined = Examined(
        solution=solution,
        names=[names[k] for k in np.flatnonzero(used).tolist()],
        std=np.sqrt(np.diag(hand_eye.covariance)[:6]) * hand_eye.converged,
        camera=None,
    )
    # Errors of camera poses resemble effects of the arm, which only a bundle adjustment separates from them.
    return effects(examined, kinds_of("strain"), at_most=1)[1]


def with_rejected_runs(used: Bool[ndarray, " n"]) -> Bool[ndarray, " n"]:
    """Return the mask of the used images, extended by rejected images next to another rejected image in image order."""
    rejected = np.pad(~used, 1)
    return used | rejected[:-2] | rejected[2:]


def effects(
    model: Examined, passed: Collection[FindingKind] = (), at_most: int = MOST_EFFECTS
) -> tuple[tuple[Effect, ...], tuple[Finding, ...]]:
    """Return the confirmed effects on the tested camera and arm, and one finding for each.

    Each round adds the most significant effect on the camera or on the poses; of two, the one that explains the other.
    The rounds end if no effect is significant or `at_most` are found. Effects of the kinds `passed`, and of kinds that
    `model` includes already, are not tested.
    """
    findings, confirmed = list[Finding](), model.effects
    passed = {*passed, *(one.kind for one in confirmed)}
    while len(findings) < at_most:
        of_camera, of_poses = (_best(model, passed, camera) for camera in (True, False))
        best = of_camera or of_poses
        if best is None:
            break
        if of_camera is not None and of_poses is not None:
            # Each is tested again with the other one estimated. The cause is the effect that stays significant; if both
            # or neither does, it is the one with the smaller p-value.
            (camera, _), (pose, _) = of_camera, of_poses
            assert camera.solution is not None
            left = _best(replace(model, solution=camera.solution), passed, False)
            poses_remain = left is not None and left[0].effect.kind is pose.effect.kind
            ((_, log_p),) = rank(model.with_effects(*model.effects, pose.effect), [camera.effect])
            camera_remains = log_p <= np.log(POLICIES[camera.effect.kind].alpha)
            is_pose = pose.log_p < camera.log_p if poses_remain == camera_remains else poses_remain
            best = of_poses if is_pose else of_camera
        test, found = best
        findings.append(found)
        passed.add(test.effect.kind)
        confirmed = (*model.effects, test.effect)
        if len(findings) == at_most:
            break
        found_with = test.solution
        model = model.with_effects(*confirmed) if found_with is None else replace(model, solution=found_with)
    return confirmed, tuple(findings)


def _best(model: Examined, passed: Collection[FindingKind], of_camera: bool) -> tuple[Test, Finding] | None:
    """Return Wald's test of the most significant effect that is confirmed, and its finding; None without one.

    `of_camera` True tests effects on the camera, False effects on the reported poses. Kinds in `passed` are not tested.
    There is no effect if the best estimate is implausibly large (`Policy.largest`). There is none either if poses and
    images contradict each other even with the effect estimated: they then have another fault. A motion counts only if
    it is more significant in the true order of the images than in nearly all random orders. An effect on the camera
    needs an adjustment that starts from a solution, and there is none where the solution is astray.
    """
    tests = list[Test]()
    if of_camera and model.solution.is_astray:
        return None
    for one in _promising(model, passed, of_camera):
        with suppress(np.linalg.LinAlgError):
            tests.append(confirm(model, one))
    for test in sorted(tests, key=lambda one: one.log_p):
        kind, log_p = test.effect.kind, test.log_p
        if kind is FindingKind.INTRINSICS:
            test = replace(test, log_p=(log_p := min(log_p, log_p_of_given(model))))
        if log_p > _log_alpha(kind, model):
            continue
        if kind is FindingKind.FOCUS_BY_IMAGE:
            # A focal length that follows the distance or changes once replaces one that explains hardly more.
            focal = test.effect.columns @ test.estimate
            simple = [one.effect.columns[:, 0] for one in tests if one.effect.kind in FOCUS - {kind}]
            if any((one @ focal) ** 2 > NEARLY_ALL * (one @ one) * (focal @ focal) for one in simple):
                continue
        is_motion = test.effect.motion is not None
        if not _is_plausible(test, model) or not poses_agree(test.noise):
            return None
        if is_motion and not explains_by_order(model.pose_scores, test.effect):
            continue
        if (found := finding_of(test, model)) is not None:
            return test, found
    return None


def _is_plausible(test: Test, model: Examined) -> bool:
    """Return whether the estimate of an effect is of a size that arms or lenses have, and determined within that size.

    Few images, or images of a plain object, may fit any optics; such an effect is then no explanation.
    """
    effect, sizes = test.effect, np.abs(test.estimate)
    if not effect.of_camera:
        sizes = np.linalg.norm(test.estimate.reshape(1 + (effect.motion is not None), -1), axis=1)
        return bool((sizes <= POLICIES[effect.kind].largest[: len(sizes)]).all())
    std, most = np.sqrt(np.maximum(np.diag(test.covariance), 0.0)), np.array(POLICIES[effect.kind].largest[0])
    if effect.kind is FindingKind.INTRINSICS:
        most = np.array([PLAUSIBLE[name] for name in tested_intrinsics(model)])
    elif effect.kind is FindingKind.FOCUS_BY_DISTANCE:
        most = most / effect.unit
    elif effect.kind is not FindingKind.FOCUS_BY_IMAGE:
        return bool((sizes <= most).all() and (std <= most / 2).all())
    return bool((sizes <= most).all() and np.median(std / most) <= 0.5)


def _promising(model: Examined, passed: Collection[FindingKind], of_camera: bool) -> list[Effect]:
    """Return the possible effects to confirm, the smallest p-value of the score test first; one per kind of effect.

    `of_camera` True selects effects on the camera, False effects on the reported poses. At most CONFIRMED_AT_MOST are
    returned. Kinds in `passed` are left out.

    An effect on the camera must be significant in the score test; effects on the poses are only ranked by it. Wrong
    given intrinsics are compared with the adjusted ones instead, because the model includes their errors.
    """
    if of_camera and model.camera is not None:
        passed = {*passed, *(FOCUS if FOCUS & {*passed} else ())}
        ranked = rank(model, [one for one in camera_effects(model, EXAMINED_FROM) if one.kind not in passed])
        likely = [one for one, log_p in ranked if log_p <= _log_alpha(one.kind, model)]
        if not likely and not any(one.of_camera for one in model.effects):
            limit = _log_alpha(FindingKind.INTRINSICS, model)
            is_off = log_p_of_given(model) <= limit
            likely = [one for one, _ in ranked if one.kind is FindingKind.INTRINSICS and is_off]
    elif not of_camera and model.arm is not None and len(model.poses[0]) >= EXAMINED_FROM:
        likely = [
            one for one, _ in rank(model, [one for one in pose_effects(model) if one.kind not in passed])
        ]
    else:
        return []
    best: dict[FindingKind, Effect] = {}
    for one in likely:
        best.setdefault(one.kind, one)
    return list(best.values())[: CONFIRMED_AT_MOST[of_camera]]


def _log_alpha(kind: FindingKind, model: Examined) -> float:
    """Return the natural logarithm of the largest p-value at which an effect of this kind is significant.

    The p-value is `Policy.alpha` of the kind, or ALPHA_IF_GIVEN for wrong intrinsics that were given.
    """
    is_given = kind is FindingKind.INTRINSICS and model.is_given
    return float(np.log(ALPHA_IF_GIVEN if is_given else POLICIES[kind].alpha))


def log_p_of_given(model: Examined) -> float:
    """Return the natural log of the p-value of Wald's test that the given focal lengths and principal point are exact.

    The statistic is compared with an F distribution. The result is 0 (p = 1) without given intrinsics. It is also 0 if
    fx, fy, cx and cy all differ by at most OFF (1 to 1.5 % of the focal length).
    """
    assert model.camera is not None
    given = model.solution.problem.cameras[model.camera].intrinsics
    by = (parameters(model.intrinsics) - parameters(given))[:4]
    if not model.is_given or (np.abs(by) <= given.fx * np.array(OFF)).all():
        return 0.0
    ratio = squared_length(by, model.solution.intrinsics_covariance(model.camera)[:4, :4])[0] / len(by)
    return float(f_distribution.logsf(ratio, 4, model.pose_scores.freedom))


def finding_of(test: Test, model: Examined) -> Finding | None:
    """Return the finding of a significant effect, which `test` found in `model`; None if it is small.

    A small effect changes the camera's pose by less than half a standard deviation (MATERIAL) along each axis. An
    effect on the images is also small below `Policy.least_px`, or below SURE standard deviations if each image has a
    parameter. Given intrinsics that Wald's test rejects are always reported, because the user may use them elsewhere.
    """
    effect, kind, std, estimate = test.effect, test.effect.kind, model.std, test.estimate
    after = None if test.solution is None else replace(model, solution=test.solution)
    policy, severity, images = POLICIES[kind], "warns", ()
    known, shift, moves = dict[str, Any](), test.shift, [test.shift]
    if after is not None:
        known = _size_of_camera_effect(test, after)
        by = (parameters(after.intrinsics) - parameters(model.intrinsics)).tolist()
        known |= {"intrinsics_shift": tuple(by)}
        if kind is not FindingKind.INTRINSICS:
            least = SURE * known["std"] if kind is FindingKind.FOCUS_BY_IMAGE else -np.inf
            if known["value"] < max(least, policy.least_px or -np.inf):
                return None
        if kind is FindingKind.INTRINSICS and log_p_of_given(after) < 0:
            std = np.zeros(6)
        elif not std.any():
            # The effect may be why the calibration is rejected, so the uncertainty after its adjustment is the measure.
            std = np.sqrt(np.diag(after.solution.transform(after.place)[1]))
        images = after.names[effect.place - 1 : effect.place + 1] if effect.place else ()
    elif effect.motion is not None:
        # The shift of the finding is the effect on gripper_from_camera; for a motion of the base, that on the fit.
        moves = [estimate]
        shift = np.r_[{FindingKind.SLIP: estimate, FindingKind.DRIFT: estimate / 2}.get(kind, shift[:6]), 0.0]
        metres, radians = np.linalg.norm(estimate.reshape(2, 3), axis=1).tolist()
        known = {"value": metres, "rotation": radians}
        if effect.place:
            images = model.names[effect.place - 1 : effect.place + 1]
            severity, known = of_step(metres, radians, effect.place, len(model.names))
    elif kind is FindingKind.DELAY:
        known = {"value": float(estimate[0]), "std": float(np.sqrt(test.covariance[0, 0]))}
    else:
        moves = [shift, straight_shift(model.solution, effect.unit * effect.columns)]
        known, shift = _size_of_strain(test), None
    if not any((np.abs(one[:6]) > MATERIAL * std).any() for one in moves):
        return None
    p = float(np.exp(max(test.log_p, -700)))
    known |= {"p": p, "shift": None if shift is None else tuple(shift.tolist())}
    return Finding.of(kind, severity, policy.concerns, *images, **known)


def of_step(
    metres: float, radians: float, place: int, images: int
) -> tuple[Literal["warns", "rejects"], dict[str, Any]]:
    """Return severity and details of the finding of a motion (m, rad) before the image `place` of so many `images`."""
    count, longer = max((place, "before"), (images - place, "after"))
    is_large = metres > LARGE_MOTION[0] or radians > LARGE_MOTION[1]
    details = {"value": metres, "rotation": radians, "longer": longer, "count": float(count)}
    return "rejects" if is_large else "warns", details


def _size_of_strain(test: Test) -> dict[str, Any]:
    """Return the fields of a finding for the size of an effect of the arm: keyword arguments of `Finding.of`.

    They are `value` and its standard deviation `std`. A strain is a relative length error, a lean is in rad per metre
    of reach, and a sag is in rad. Strain and sag also have a unit axis `x`, `y`, `z` in the `frame` "base" or
    "gripper".
    """
    estimate, covariance = test.estimate, test.covariance
    if test.effect.kind is FindingKind.BASE_LEANS:
        return {"value": float(estimate[0]), "std": float(np.sqrt(covariance[0, 0]))}
    if test.effect.kind is FindingKind.TOOL_SAGS:
        value = float(np.linalg.norm(estimate))
        axis, frame = estimate / value, "gripper"
        std = float(np.sqrt(axis @ covariance @ axis))
    else:
        values, vectors = np.linalg.eigh(np.einsum("k,kab->ab", estimate, STRAINS))
        k = int(np.abs(values).argmax())
        axis, frame = vectors[:, k] * np.sign(vectors[np.abs(vectors[:, k]).argmax(), k]), "base"
        by = np.einsum("a,kab,b->k", axis, STRAINS, axis)
        # The strain has trace 0: the two other axes have minus half of it each.
        value, std = 1.5 * float(values[k]), 1.5 * float(np.sqrt(by @ covariance @ by))
    return {"value": value, "std": std, "frame": frame, **dict(zip("xyz", axis.tolist(), strict=True))}


def _size_of_camera_effect(test: Test, after: Examined) -> dict[str, Any]:
    """Return the keyword arguments of `Finding.of` for the size of an effect on the camera, and its standard deviation.

    The size `value` is the effect's parameter, for one of each image the rms: px, or a relative change of the focal
    length. A single focal-length parameter keeps its sign. For a thin prism the size is the largest displacement of a
    point (px). For wrong intrinsics each parameter is stated instead. `after` is the adjustment with the effect.
    """
    effect, value, std = test.effect, test.estimate, np.sqrt(np.maximum(np.diag(test.covariance), 0.0))
    problem = after.solution.problem
    if effect.kind is FindingKind.INTRINSICS:
        return _intrinsics(after, std)
    if effect.kind is FindingKind.THIN_PRISM:
        moved = problem.prism @ value
        k = int(np.linalg.norm(moved, axis=1).argmax())
        size = float(np.linalg.norm(moved[k]))
        along = moved[k] / max(size, 1e-12) @ problem.prism[k]
        return {"value": size, "std": float(np.sqrt(along @ test.covariance @ along))}
    size = value[0] if effect.kind in FOCUS else abs(value[0])
    if effect.kind is FindingKind.FOCUS_BY_IMAGE:
        size = np.sqrt(value @ value / len(after.names))
    return {"value": effect.unit * float(size), "std": effect.unit * float(np.median(std))}


def _intrinsics(after: Examined, stds: Float[ndarray, " p"]) -> dict[str, Any]:
    """Return the `details` of the finding of wrong intrinsics: estimated, given and significantly different values.

    `after` is the adjustment with the effect. `stds` holds the standard deviation of each tested parameter
    (`tested_intrinsics`). Those of fx and fy are relative, those of cx and cy are in image widths.
    """
    assert after.camera is not None
    camera, shown = after.solution.problem.cameras[after.camera].intrinsics, list[str]()
    names = parameter_names(camera)
    given, now = (
        dict(zip(names, parameters(one).tolist(), strict=True)) for one in (camera, after.intrinsics)
    )
    units = {"fx": camera.fx, "fy": camera.fy, "cx": camera.width, "cy": camera.width}
    tested = zip(tested_intrinsics(after), stds, strict=True)
    std = {name: float(one) * units.get(name, 1.0) for name, one in tested}
    before = "is given" if after.is_given else "was estimated first"
    for pair, what, unit, digits in PAIRS:
        if any(abs(now[name] - given[name]) > NAMED * std[name] for name in pair if name in std):
            found, was = (", ".join(f"{of[name]:.{digits}f}" for name in pair) for of in (now, given))
            surest = significant(max(std[name] for name in pair if name in std))
            shown.append(f"{what} ({found}) ± {surest}{unit} where ({was}) {before}")
    unsure = "other intrinsics than the used ones, but no single parameter is certain"
    details: dict[str, Any] = {"source": "images", "shown": joined(shown or [unsure])}
    for name in filter(now.__contains__, TESTED_IF_GIVEN):
        details |= {name: now[name], f"{name}_given": given[name]}
    details |= {f"{name}_std": one for name, one in std.items()}
    return details if after.is_given else details | {"estimated": 1.0}


def _adopted(case: Case, effects: Sequence[Effect], findings: Sequence[Finding]) -> Case:
    """Return the case solved with the effects on camera and arm, or with `findings` alone if that one is rejected.

    The effects, which `findings` report, were found with a subset of the points. They are now estimated from all points
    that memory permits. Camera effects are dropped if the calibration then changes by at most half a standard deviation
    (MATERIAL) on each axis. A thin prism becomes part of the intrinsics. Effects of the image order are not adopted.
    """
    kept = [one for one in effects if one.of_camera or one.kind.row.group == "strain"]
    if not kept:
        return case.found(*findings)
    free = sum(one.both.shape[1] for one in kept if one.of_camera)
    model = replace(
        case.model, most=min(case.model.most, MOST_BYTES // (16 * max(free, 1))), effects=tuple(kept)
    )
    prism = [one for one in kept if one.kind is FindingKind.THIN_PRISM]
    if prism and case.reconstruction.intrinsics.model != "fisheye":
        camera, count = with_prism(case), len(parameters(case.reconstruction.intrinsics))
        more = len(parameters(camera.intrinsics)) - count
        rest = (one.with_parameters(count, more) for one in kept if one not in prism)
        model = replace(model, camera=camera, effects=tuple(rest))
    after, before = solved(case, model), case.calibration
    if not after.calibration.converged:
        return case.found(*findings)
    moved = np.abs(step_between(before.parent_from_camera, after.numbers.parent_from_camera))
    std = np.sqrt(np.diag(before.covariance)[:6]) * before.converged
    of_camera = {one.kind for one in kept if one.of_camera} - {FindingKind.INTRINSICS}
    if of_camera and not (moved > MATERIAL * std).any():
        rest = [one for one in kept if one.kind not in of_camera]
        return _adopted(case, rest, [one for one in findings if one.kind not in of_camera])
    size = case.capture.image_size
    return after.found(*(as_remark(_remaining(one, after), moved, size) for one in findings))


def _remaining(found: Finding, after: Case) -> Finding:
    """Return the finding of an effect with the shift that remains after the case `after` includes the effect.

    The X of the case is the effective hand-eye transform, which predicts best from reported gripper poses. The
    remaining shift of an effect of the arm is the difference from the transform for the true poses, and the possible
    error of the scale.
    """
    assert after.solution is not None
    strains, solution = [one for one in after.model.effects if not one.of_camera], after.solution
    if found.kind.row.group == "camera":
        return replace(found, shift=None, intrinsics_shift=None)
    if found.kind not in (one.kind for one in strains):
        return found
    # The shift due to all effects of the arm together belongs to the first finding.
    straight = np.zeros(7)
    if found.kind is strains[0].kind:
        straight = straight_shift(solution, solution.problem.bent)[:7]
    if found.kind is FindingKind.LENGTHS and found.value is not None:
        # One of three axes has another scale; no image shows which scale is the true metre.
        by_scale = solution.equations.jacobian[:, SCALE]
        metre = abs(found.value) / 3 * np.r_[-(solution.poses.region.fit @ by_scale)[:6, 0], 1.0]
        straight = straight + metre * (1 if straight[:6] @ metre[:6] >= 0 else -1)
    return replace(found, shift=tuple(straight.tolist()))


def as_remark(found: Finding, moved: Float[ndarray, "6"], image_size: tuple[int, int]) -> Finding:
    """Return a finding of a tiny difference of focal lengths with the severity "informs"; other findings unchanged.

    Hundreds of images show differences that no user needs to correct. They are tiny if they displace the corner of the
    image by less than TINY_PX and change the calibration by less than TINY times LARGE_MOTION. `moved` is that change
    of gripper_from_camera, translation (m) and rotation vector (rad); `image_size` is width and height (px).
    """
    metres, radians = np.linalg.norm(moved.reshape(2, 3), axis=1) / LARGE_MOTION
    corner_px = float(np.hypot(*image_size)) / 2 * abs(found.value or 0.0)
    is_tiny = found.kind in FOCUS and corner_px < TINY_PX and max(metres, radians) < TINY
    return replace(found, severity="informs") if is_tiny else found


def straight_shift(solution: Solution, columns: Float[ndarray, "s b"]) -> Float[ndarray, " p"]:
    """Return the step of the p unknowns from values for the reported gripper poses to values for the true ones.

    The first seven unknowns are in COVARIANCE_ORDER. `columns` (s,b) are the b confirmed error patterns of the poses,
    one standard deviation each; s = 6 per pose (m, rad; base axes).
    """
    # Confirmed effects of other arms stay as they are.
    own, before = columns.reshape(-1, 6, columns.shape[1]).any((1, 2)), solution.equations.confirmed
    other = ~np.repeat(own, 6)
    confirmed = columns @ columns.T + (0.0 if before is None else np.outer(other, other) * before)
    straight = replace(solution.equations, confirmed=confirmed)
    return solve_equations(straight, solution.log_sizes).step - solution.at_mode.step
