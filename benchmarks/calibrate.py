"""`benchmarks calibrate`: hand-eye solvers on the same simulated poses, for accuracy and time."""

import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from benchmarks.figure import blank, png
from benchmarks.page import mm_deg, table
from benchmarks.peers import OPENCV_METHODS, andreff_with_scale, grid_search, opencv
from jcr.calibration.case import of_images
from jcr.estimation.hand_eye import solve_hand_eye
from jcr.estimation.wrist import adjust_wrist, recon_frame
from jcr.files import write_bytes
from jcr.geometry import scale_translation
from jcr.records import HandEye
from simulation.problems import INTRINSICS, HandEyeProblem, error, hand_eye_problem, observed

COUNTS = (3, 5, 8, 10, 12, 15)
NOISES = ((0.0, 0.0), (5e-4, np.radians(0.1)), (2e-3, np.radians(0.5)))
"""m, rad per axis of the gripper poses."""
VISION = (2e-4, np.radians(0.02))
"""m, rad per axis of the camera poses, as structure from motion leaves them."""
SCALE = 2.0
"""Inside the only range that the paper's grid search covers."""
TRIALS = 4
MANY = 15
"""Images among which some have a wrong pose."""
WRONG = (0, 1, 2, 3, 4, 5)
GRID = "paper's grid search"

Solver = Callable[[HandEyeProblem, int], tuple[np.ndarray, float]]
Distances = dict[tuple[str, tuple[float, float], int], Float[ndarray, "t 3"]]
"""By method, robot pose noise and number of images."""
Spoilt = dict[tuple[str, int], Float[ndarray, "t 3"]]
"""By method and number of wrong images."""


def run(out: Path | None = None) -> str:
    """Markdown tables: accuracy over noise and image count, with outliers, and time; a figure goes to `out`."""
    trials, image = TRIALS, "calibrate.png"
    distances = {
        (name, noise, count): _all_errors(solver, noise, count, 0, trials)
        for noise in NOISES
        for count in COUNTS
        for name, solver in _solvers().items()
    }
    spoilt = {
        (name, wrong): _all_errors(solver, NOISES[1], MANY, wrong, trials)
        for wrong in WRONG
        for name, solver in _solvers().items()
    }
    if out is not None:
        write_bytes(out / image, _figure(distances, spoilt))
    named = {wrong: _named(wrong, trials) for wrong in WRONG}
    lines = [
        *_claims(distances, spoilt, named, trials),
        "",
        *_accuracy(distances, trials, image),
        "",
        *_outliers(spoilt, named, trials),
        *_time(),
    ]
    return "\n".join(lines) + "\n"


def _claims(distances: Distances, spoilt: Spoilt, named: dict[int, int], trials: int) -> list[str]:
    def middle(errors: Float[ndarray, "t 3"]) -> str:
        mm, deg, _ = np.median(errors, axis=0)
        return f"{mm:.2f} mm, {deg:.3f}°"

    ours, papers = ("jcr, bundle adjustment", GRID)
    at = {name: middle(distances[name, NOISES[1], 10]) for name in (ours, papers)}
    most = max(wrong for wrong in WRONG if named[wrong] == trials)
    others = min(
        np.median(errors[:, 0])
        for (name, wrong), errors in spoilt.items()
        if wrong == most and "jcr" not in name
    )
    return [
        f"> Simulated poses, robot pose noise 0.5 mm and 0.1°, 10 images: {at[ours]} off (median), the paper's grid "
        f"search {at[papers]}.",
        f"> {most} wrong gripper poses among {MANY} images are all identified, and no others, in {named[most]} of "
        f"{trials} captures, and the translation is then {np.median(spoilt[ours, most][:, 0]):.2f} mm off; every other "
        f"method is off by {others:.0f} mm or more.",
    ]


def _solvers() -> dict[str, Solver]:
    def pose_only(problem: HandEyeProblem, seed: int) -> tuple[np.ndarray, float]:
        solved = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
        return solved.gripper_from_camera, solved.scale

    def bundle(problem: HandEyeProblem, seed: int) -> tuple[np.ndarray, float]:
        start = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
        used = start.inliers
        tracks = of_images(observed(problem, np.random.default_rng(seed), 300, 0.3), used)
        adjusted = adjust_wrist(
            problem.base_from_gripper[used],
            (start.gripper_from_camera, start.scale, start.base_from_recon),
            problem.recon_from_camera[used],
            INTRINSICS,
            tracks,
        )
        return adjusted.state.x[0], recon_frame(adjusted, tracks)[0]

    solvers: dict[str, Solver] = {
        "jcr, poses only": pose_only,
        "jcr, bundle adjustment": bundle,
        GRID: lambda p, seed: grid_search(p.base_from_gripper, p.recon_from_camera),
        "Andreff with scale": lambda p, seed: andreff_with_scale(p.base_from_gripper, p.recon_from_camera),
    }
    for name in OPENCV_METHODS:
        solvers[f"OpenCV {name} (scale given)"] = lambda p, seed, name=name: opencv(
            name, p.base_from_gripper, p.recon_from_camera, p.scale
        )
    return solvers


def problem_of(seed: int, count: int, noise: tuple[float, float]) -> HandEyeProblem:
    """A simulated problem whose true scale lies where every method looks for it."""
    problem = hand_eye_problem(np.random.default_rng(seed), count, robot_noise=noise, camera_noise=VISION)
    rescaled = scale_translation(problem.recon_from_camera, problem.scale / SCALE)
    return HandEyeProblem(
        problem.base_from_gripper,
        rescaled,
        problem.gripper_from_camera,
        SCALE,
        problem.true_base_from_gripper,
    )


def _all_errors(
    solver: Solver, noise: tuple[float, float], count: int, wrong: int, trials: int
) -> Float[ndarray, "t 3"]:
    """mm, degrees and percent of scale in every trial."""
    return np.array(
        [_distances(_spoilt(seed, count, noise, wrong)[0], solver, seed) for seed in range(trials)]
    )


def _spoilt(
    seed: int, count: int, noise: tuple[float, float], wrong: int
) -> tuple[HandEyeProblem, Int[ndarray, " wrong"]]:
    """A problem in which this many images have another one's gripper pose, and which these are."""
    problem = problem_of(seed, count, noise)
    bad = np.sort(np.random.default_rng(seed).choice(count, wrong, replace=False))
    if wrong == 1:  # there is no other wrong one to swap with
        problem.base_from_gripper[bad] = problem.base_from_gripper[(bad + 1) % count]
    else:
        problem.base_from_gripper[bad] = problem.base_from_gripper[np.roll(bad, 1)]
    return problem, bad


def _named(wrong: int, trials: int) -> int:
    """In how many trials the solver rejects just the wrong images."""
    right = 0
    for seed in range(trials):
        problem, bad = _spoilt(seed, MANY, NOISES[1], wrong)
        solved: HandEye = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
        right += np.array_equal(np.flatnonzero(~solved.inliers), bad)
    return right


def _accuracy(distances: Distances, trials: int, image: str) -> list[str]:
    lines = [
        f"Median error over {trials} simulated captures (seeds 0 to {trials - 1}): mm / degrees / % of scale. "
        f"Vision noise {1e3 * VISION[0]:.1f} mm, {np.degrees(VISION[1]):.2f}°. OpenCV's methods cannot find the scale "
        "and are given it.",
        "",
        f"![errors by noise, images and wrong poses]({image})",
    ]
    for noise in NOISES:
        lines += ["", f"Robot noise {1e3 * noise[0]:.1f} mm, {np.degrees(noise[1]):.1f}° per axis", ""]
        lines += table(
            " | ".join(["method", *(f"{count} images" for count in COUNTS)]),
            ([name, *(_cell(distances[name, noise, count]) for count in COUNTS)] for name in _solvers()),
        )
    return lines


def _cell(errors: Float[ndarray, "t 3"]) -> str:
    mm, deg, percent = np.median(errors, axis=0)
    return f"{mm:.2f} / {deg:.3f} / {percent:.2f}"


def _distances(problem: HandEyeProblem, solver: Solver, seed: int) -> tuple[float, float, float]:
    try:
        x, scale = solver(problem, seed)
    except cv2.error:  # with wrong poses among them some of OpenCV's methods give up
        return np.inf, np.inf, np.inf
    off = error(problem, x, abs(scale))
    return *mm_deg(off), 100 * abs(off[6])


def _outliers(spoilt: Spoilt, named: dict[int, int], trials: int) -> list[str]:
    rows = [[name, *(_cell(spoilt[name, wrong]) for wrong in WRONG)] for name in _solvers()]
    named_in = [f"{named[wrong]} of {trials}" for wrong in WRONG]
    return [
        f"{MANY} images, some of them with another image's gripper pose, robot pose noise 0.5 mm, 0.1°: median error",
        "",
        *table(
            " | ".join(["method", *(f"{wrong} wrong" for wrong in WRONG)]),
            [*rows, ["*captures in which jcr identifies the wrong ones, and no others*", *named_in]],
        ),
    ]


def _figure(distances: Distances, spoilt: Spoilt) -> bytes:
    """PNG: median errors of the translation by robot pose noise, number of images and share of wrong gripper poses."""
    figure = blank(14, 4.4, "constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for name in _solvers():
        style = {"linewidth": 2.5} if name.startswith("jcr") else {"linewidth": 1, "linestyle": "--"}
        label = name.replace(" (scale given)", "*")
        series = (
            ([1e3 * noise[0] for noise in NOISES], [distances[name, noise, 10] for noise in NOISES]),
            (COUNTS, [distances[name, NOISES[1], count] for count in COUNTS]),
            ([100 * wrong / MANY for wrong in WRONG], [spoilt[name, wrong] for wrong in WRONG]),
        )
        for axis, (x, errors) in zip(axes, series, strict=True):
            axis.plot(x, [np.median(e[:, 0]) for e in errors], marker=".", label=label, **style)
    titles = (
        "robot pose noise, mm per axis (10 images)",
        "images (0.5 mm, 0.1°)",
        f"wrong poses, % of {MANY} images (0.5 mm, 0.1°)",
    )
    for axis, title in zip(axes, titles, strict=True):
        axis.set(xlabel=title, yscale="log")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("median error of the translation, mm")
    lines, names = axes[0].get_legend_handles_labels()
    figure.legend(
        lines, names, loc="outside right center", fontsize=7, title="* scale given", title_fontsize=7
    )
    return png(figure, 100)


def _time() -> list[str]:
    problem = problem_of(0, 15, NOISES[1])
    gripper, camera = problem.base_from_gripper, problem.recon_from_camera
    start = solve_hand_eye(gripper, camera)
    pose_fit = (start.gripper_from_camera, start.scale, start.base_from_recon)
    tracks = observed(problem, np.random.default_rng(0), 1000, 0.3)
    large = problem_of(0, 36, NOISES[1])
    large_start = solve_hand_eye(large.base_from_gripper, large.recon_from_camera)
    large_fit = (large_start.gripper_from_camera, large_start.scale, large_start.base_from_recon)
    large_tracks = observed(large, np.random.default_rng(0), 6000, 0.3)
    rows = [
        ("jcr: closed form, outliers, uncertainty, observability, leave-one-out error", 15,
         lambda: solve_hand_eye(gripper, camera), 21),
        (f"jcr: bundle adjustment, {len(tracks.image)} observations", 15,
         lambda: adjust_wrist(gripper, pose_fit, camera, INTRINSICS, tracks), 3),
        (f"jcr: bundle adjustment, {len(large_tracks.image)} observations", 36,
         lambda: adjust_wrist(large.base_from_gripper, large_fit, large.recon_from_camera, INTRINSICS, large_tracks), 1),
        ("paper's grid search: closed form, all values at once", 15, lambda: grid_search(gripper, camera), 21),
        ("Andreff with scale: closed form", 15, lambda: andreff_with_scale(gripper, camera), 21),
        *(
            (f"OpenCV {name}: closed form, scale given", 15,
             lambda name=name: opencv(name, gripper, camera, SCALE), 21)
            for name in OPENCV_METHODS
        ),
    ]  # fmt: skip
    timed = ((name, images, f"{_median_ms(work, repeats):.1f}") for name, images, work, repeats in rows)
    return ["", "Time, median", "", *table("what | images | ms", timed)]


def _median_ms(work: Callable[[], object], repeats: int) -> float:
    taken = []
    for _ in range(repeats):
        begun = time.perf_counter()
        work()
        taken.append(1e3 * (time.perf_counter() - begun))
    return float(np.median(taken))
