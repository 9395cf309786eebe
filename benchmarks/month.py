"""Simulated months: forty captures of five images after a calibration, with and without a bump of the camera.

False alarms and delays are measured on poses: an arm with systematic errors returns to five poses of the calibration
with its repeatability, and the camera poses have the errors of an absolute pose from 300 points. One month is rendered
and verified with `jcr verify`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.page import mm_deg, number, table
from jcr.calibration.drift import Change, Located, Reference, check_series
from jcr.capture.formats import capture_json
from jcr.estimation.absolute_pose import absolute_pose
from jcr.estimation.arms import ROBOT_NAMES, arm_named
from jcr.estimation.problem import pose_problem
from jcr.estimation.robot_noise import REACH, smooth_errors
from jcr.estimation.solve import solve
from jcr.geometry import apply, inverse, retract, scale_translation, step_between
from jcr.pipeline.options import TOLERANCE
from jcr.pipeline.run import calibrate
from jcr.pipeline.verify import Verification, exceeds, verify_run
from jcr.pipeline.verify_history import WINDOW
from jcr.records import Capture
from simulation.arms import PRESETS, PresetName, bend, table_center, views
from simulation.capture import encode_jpeg, pinhole
from simulation.poses import random_hand_eye
from simulation.problems import INTRINSICS, bent_problem, disturbed, shown_points
from simulation.render import render
from simulation.scene_faults import pushed
from simulation.scenes import Scene, make_scene

MONTHS, CAPTURES, IMAGES, CALIBRATION = 40, 40, 5, 12
"""Months without a bump, captures of a month, images of a capture and of the calibration."""
BUMP_AT, BUMPS_MM, BUMPED_MONTHS = 20, (1.0, 2.0, 5.0), 10
DEG_PER_MM = 0.15
"""Rotation of a bump with each millimetre: 2 mm and 0.3°."""
POINTS, PIXEL_STD, POINT_STD_M = 300, 0.3, 2e-4
JOINT_JITTER = np.radians(0.02)
"""Differences of the joints (rad) when the arm returns to a pose; the controller reports them."""
REMASTERED = np.radians(0.15)
"""Change of each joint's zero (rad), one sigma."""


def run(every: int = 1) -> str:
    """Return the page in Markdown, of one month in `every`: claims, then the tables."""
    quiet = [month(seed) for seed in range(0, MONTHS, every)]
    bumped = {mm: [month(seed, mm) for seed in range(0, BUMPED_MONTHS, every)] for mm in BUMPS_MM}
    with TemporaryDirectory(prefix="jcr-month-") as folder:
        shown = rendered(Path(folder))
    return "\n".join([*_claims(quiet, bumped, shown), *_tables(quiet, bumped, shown)]) + "\n"


def _claims(
    quiet: Sequence["Month"], bumped: Mapping[float, Sequence["Month"]], shown: Verification
) -> Iterator[str]:
    captures, alarms = (
        sum(one.captures for one in quiet),
        [change for one in quiet for _, change in one.alarms],
    )
    months = sum(bool(one.alarms) for one in quiet)
    matter, share = sum(map(_matters, alarms)), 100 * len(alarms) / captures
    yield (
        f"> {len(alarms)} false alarms in {captures} captures of months in which nothing moved (in {months} of "
        f"{len(quiet)} months): {share:.2f} per hundred captures, stated 0.1 at most. {matter} of them exceed the "
        "default tolerance, so that `jcr verify` would reject the calibration."
    )
    parts = []
    for mm, months in bumped.items():
        found = np.array(_delays(months))
        later = f"{(found < 1).sum()} of {len(months)} with its first capture"
        late = f", the last with capture {int(found.max()) + 1}" if np.isfinite(found).all() else ""
        parts.append(f"{mm:g} mm {later}{late if found.max() > 0 else ''}")
    yield f"> Bumps of the camera are found: {'; '.join(parts)}."
    yield f"> The rendered month: {shown.finding}."


def _matters(change: Change) -> bool:
    """Return whether a change exceeds the default tolerance of a verification."""
    of_robot = np.array([REACH * change.size, 0, 0, change.size, 0, 0])
    return exceeds(of_robot if change.cause == "robot" else change.motion, TOLERANCE)


def _delays(months: Sequence["Month"]) -> list[float]:
    """Return the captures between the first one after the bump and the one with which it was found, infinite if none."""
    return [float(one.alarms[-1][0] - BUMP_AT) if one.alarms else np.inf for one in months]


def _tables(
    quiet: Sequence["Month"], bumped: Mapping[float, Sequence["Month"]], shown: Verification
) -> Iterator[str]:
    yield from ("", "## Nothing moves", "")
    yield f"{CAPTURES} captures a month, {IMAGES} images each, after a calibration from {CALIBRATION} images."
    yield ""
    rows = [[one for one in quiet if one.preset == preset] for preset in get_args(PresetName)]
    yield from table(
        "errors of the arm | months | captures | false alarms | one capture finds 9 of 10 bumps of",
        (
            [own[0].preset, len(own), sum(one.captures for one in own), sum(len(one.alarms) for one in own)]
            + [f"{1e3 * np.median([one.detectable for one in own]):.2f} mm"]
            for own in rows
            if own
        ),
    )
    yield from ("", f"## The camera is bumped before capture {BUMP_AT + 1}", "")
    yield f"By a length and {DEG_PER_MM}° with each millimetre, in random directions."
    yield ""
    head = "bump | found with its 1st capture | with its 1st to 3rd | first capture right | named camera alone | error"
    cells = []
    for mm, months in bumped.items():
        delays, changes = np.array(_delays(months)), [one.alarms[-1][1] for one in months if one.alarms]
        off = [mm_deg(change.motion - one.bump) for one in months if one.alarms and one.bump is not None
               for change in (one.alarms[-1][1],) if change.cause == "camera"]  # fmt: skip
        error = (
            f"{np.median([mm for mm, _ in off]):.2f} mm {np.median([deg for _, deg in off]):.3f}°"
            if off
            else ""
        )
        right = sum(change.first == BUMP_AT for change in changes)
        alone = sum(change.cause == "camera" and not change.rivals for change in changes)
        counts = (delays < 1).sum(), (delays < 3).sum(), right, alone
        cells.append([f"{mm:g} mm", *(f"{n} of {len(months)}" for n in counts), error])
    yield from table(head, cells)
    yield from ("", "## A rendered month", "")
    yield (
        "A UR5e with typical errors returns to five of the calibration's twelve views. Three objects are pushed by 6 cm "
        f"before capture {ARRANGED_AT[0] + 1}, three others before capture {ARRANGED_AT[1] + 1}; the camera is "
        f"bumped by 2 mm and 0.3° before capture {BUMP_AT + 1}, and the joints are set to zero again, 0.15° off, "
        f"before capture {REMASTERED_AT + 1}."
    )
    yield ""
    yield from table(
        "capture | camera mm | camera ° | scene mm | scene ° | odds | found from mm | scene left | images",
        (
            [
                row.name,
                *(number(value, 3) for one in (row.camera, row.scene) for value in mm_deg(one.step)),
                f"{row.odds:.2g}" if row.odds < 1e6 else "> 1e6",
                number(1e3 * row.detectable[0]),
                "" if row.scene_left is None else f"{100 * row.scene_left:.0f} %",
                len(row.images),
            ]
            for row in shown.history
        ),
    )


class Month(NamedTuple):
    """Outcome of one simulated month."""

    preset: PresetName
    captures: int
    alarms: tuple[tuple[int, Change], ...]
    """Number of each capture with which a change was found, and the change."""
    detectable: float
    """Median of the change (m) of the camera that one capture finds nine times in ten."""
    bump: Float[ndarray, "6"] | None


def month(seed: int, bump_mm: float = 0.0) -> Month:
    """Simulate a month of captures at five poses of the calibration, with a bump before capture BUMP_AT, if any.

    With a bump, the month begins WINDOW captures before it and ends when a change is found.
    """
    presets = get_args(PresetName)
    preset, arm = presets[seed % len(presets)], arm_named(ROBOT_NAMES[seed % len(ROBOT_NAMES)])
    rng = np.random.default_rng([seed, 77])
    problem = bent_problem(arm, preset, CALIBRATION, seed)
    # The reconstruction lies where its cameras say on average.
    cameras = scale_translation(problem.recon_from_camera, problem.scale)
    each = cameras @ inverse(problem.base_from_camera)
    recon_from_base = retract(each[0], step_between(np.repeat(each[:1], len(each), 0), each).mean(0))
    start = problem.gripper_from_camera, problem.scale, inverse(recon_from_base)
    fit = solve(*pose_problem(problem.base_from_gripper, problem.recon_from_camera, start)).state
    reference = Reference(
        x=fit.x[0],
        scale=fit.scale,
        z=fit.z[0],
        base_from_gripper=problem.base_from_gripper,
        recon_from_camera=problem.recon_from_camera,
    )
    rows = rng.permutation(CALIBRATION)[:IMAGES]
    recurring, covariance = _camera_errors(
        problem.base_from_camera[rows], recon_from_base, problem.scale, table_center(arm), rng
    )
    direction = rng.normal(size=(2, 3))
    direction *= [[1e-3 * bump_mm], [np.radians(DEG_PER_MM * bump_mm)]] / np.linalg.norm(direction, axis=1)[
        :, None
    ]
    bump, captures, alarms, noticed = (
        direction.ravel(),
        list[Located](),
        list[tuple[int, Change]](),
        list[float](),
    )
    changes, first = (), BUMP_AT - WINDOW if bump_mm else 0
    for n in range(first, CAPTURES):
        joints = problem.joints[rows] + JOINT_JITTER * rng.normal(size=(IMAGES, arm.dof))
        x = problem.physical_gripper_from_camera
        x = retract(x, bump) if n >= BUMP_AT else x
        camera = scale_translation(recon_from_base @ problem.bent.true(joints) @ x, 1 / problem.scale)
        own = np.linalg.cholesky(covariance) @ rng.normal(size=(IMAGES, 6, 1))
        captures.append(
            Located(
                base_from_gripper=tuple(disturbed(problem.bent.reported(joints), PRESETS[preset].white, rng)),
                recon_from_camera=tuple(retract(camera, recurring + own[..., 0])),
                covariance=tuple(covariance),
            )
        )
        series = captures[-WINDOW:]
        poses = np.concatenate([reference.base_from_gripper, *(one.base_from_gripper for one in series)])
        test = check_series(reference, series, smooth_errors(poses), changes, len(captures) - len(series))
        noticed.append(test.detectable[0])
        if test.wrong_image is not None or len(test.changes) > len(changes):
            change = Change(cause="image", first=len(captures) - 1, named=len(captures) - 1)
            change = change if test.wrong_image is not None else test.changes[-1]
            alarms.append((n, change.model_copy(update={"first": first + change.first})))
            if bump_mm and n >= BUMP_AT:
                break
        changes = test.changes
    return Month(preset, len(captures), tuple(alarms), float(np.median(noticed)), bump if bump_mm else None)


def _camera_errors(
    base_from_camera: Float[ndarray, "k 4 4"],
    recon_from_base: Float[ndarray, "4 4"],
    scale: float,
    table: Float[ndarray, "3"],
    rng: np.random.Generator,
) -> tuple[Float[ndarray, "k 6"], Float[ndarray, "k 6 6"]]:
    """Return the errors (steps) of located camera poses that the points of the scene cause, and the covariances."""
    x_in_base = table + rng.uniform([-0.25, -0.25, 0.0], [0.25, 0.25, 0.12], (POINTS, 3))
    image, point, x_px = shown_points(
        x_in_base, base_from_camera, [INTRINSICS] * len(base_from_camera), PIXEL_STD, rng
    )
    std = POINT_STD_M / scale
    true = apply(recon_from_base, x_in_base) / scale
    found, spread = true + std * rng.normal(size=true.shape), np.tile(std**2 * np.eye(3), (POINTS, 1, 1))
    steps, covariances = [], []
    for k, place in enumerate(base_from_camera):
        own = point[image == k]
        pose = absolute_pose(x_px[image == k], found[own], INTRINSICS, spread[own], gate_px=3.0)
        assert pose is not None
        expected = scale_translation(recon_from_base @ place, 1 / scale)
        steps.append(step_between(expected, pose.a_from_camera))
        covariances.append(pose.covariance)
    return np.array(steps), np.array(covariances)


VIEWS = (0, 3, 5, 7, 10)
"""Views of the calibration to which the arm of the rendered month returns."""
ARRANGED_AT, REMASTERED_AT = (8, 30), 34
"""First captures after three objects are pushed, after three others are, and after the joints are set to zero again."""


def rendered(folder: Path, out: str = "out") -> Verification:
    """Render a month of an arm with typical errors, calibrate, verify each capture, and return the last verification."""
    scene, arm = make_scene("tabletop", 1), arm_named("ur5e")
    draws = [np.random.default_rng([1, 20 + k]) for k in range(5)]
    x, errors = random_hand_eye(draws[0]), PRESETS["typical"]
    bent, camera = bend(arm, errors, draws[1]), pinhole(draws[0])
    joints = views(arm, CALIBRATION, x, draws[0], scene.table_center_in_base)
    bump = np.repeat([2e-3, np.radians(0.3)], 3) * [0.6, -0.64, 0.48, -0.6, 0.64, 0.48]
    bumped, remastered = retract(x, bump), joints + REMASTERED * draws[2].normal(size=arm.dof)

    def reported(rows: Sequence[int]) -> Float[ndarray, "n 4 4"]:
        return disturbed(bent.reported(joints[list(rows)]), errors.white, draws[3])

    def images(place: Path, pictures: Sequence[ndarray], rows: Sequence[int]) -> Capture:
        place.mkdir(parents=True)
        names = tuple(f"{k}.jpg" for k in range(len(pictures)))
        for name, picture in zip(names, pictures, strict=True):
            noisy = np.clip(picture + draws[4].normal(0, 2, picture.shape), 0, 255).astype(np.uint8)
            (place / name).write_bytes(encode_jpeg(noisy, 90))
        size, poses = (camera.width, camera.height), reported(rows)
        capture = Capture(
            folder=place, images=names, base_from_gripper=poses, image_size=size, intrinsics=camera
        )
        capture_json.write(place, capture)
        return capture

    every = [view.image for view in render(scene, camera, bent.true(joints) @ x, with_truth=False)]
    calibrate(images(folder / "calibration", every, range(CALIBRATION)), folder / out)
    second = pushed(scene, CAPTURES, np.eye(4))
    moved = tuple(second.objects[3:6])
    by = np.eye(4)
    by[:3, 3] = 0.05, -0.03, 0.0
    others = (replace(one, base_from_object=by @ one.base_from_object) for one in moved)
    third = replace(second, objects=(*second.objects[:3], *others, *second.objects[6:]))
    states: list[tuple[int, Scene, ndarray, ndarray]] = [
        (0, scene, joints, x),
        (ARRANGED_AT[0], second, joints, x),
        (BUMP_AT, second, joints, bumped),
        (ARRANGED_AT[1], third, joints, bumped),
        (REMASTERED_AT, third, remastered, bumped),
    ]
    captures, shown = dict[str, Capture](), list[ndarray]()
    for n in range(CAPTURES):
        for begin, seen, at, on in states:
            if begin == n:
                poses = bent.true(at[list(VIEWS)]) @ on
                shown = [view.image for view in render(seen, camera, poses, with_truth=False)]
        name = f"day {n + 1:02d}"
        captures[name] = images(folder / name.replace(" ", "-"), shown, VIEWS)
    return verify_run(folder / out, captures)
