"""`jcr bench calibrate`: hand-eye solvers on the same simulated poses, for accuracy and time."""

import time
from collections.abc import Callable

import cv2
import numpy as np

from jcr.bench.peers import OPENCV_METHODS, andreff_with_scale, grid_search, opencv
from jcr.calibrate.bundle import adjust
from jcr.calibrate.calibrate import of_images
from jcr.calibrate.hand_eye import solve_hand_eye
from jcr.geometry import scale_translation
from jcr.records import HandEye
from jcr.simulate.observations import LENS, observed
from jcr.simulate.problem import HandEyeProblem, error, hand_eye_problem

COUNTS = (3, 5, 8, 10, 12, 15)
NOISES = ((0.0, 0.0), (5e-4, np.radians(0.1)), (2e-3, np.radians(0.5)))
"""m, rad per axis of the gripper poses."""
VISION = (2e-4, np.radians(0.02))
"""m, rad per axis of the camera poses, as structure from motion leaves them."""
SCALE = 2.0
"""Inside the only range that the paper's grid search covers."""
TRIALS = 15
GRID_TRIALS = 3
"""The grid search takes a second a time."""

Solver = Callable[[HandEyeProblem, int], tuple[np.ndarray, float]]


def run() -> str:
    """Markdown tables: accuracy over noise and image count, with outliers, and time."""
    return "\n".join([*_accuracy(), *_outliers(), *_time()]) + "\n"


def _solvers() -> dict[str, Solver]:
    def pose_only(problem: HandEyeProblem, seed: int) -> tuple[np.ndarray, float]:
        solved = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
        return solved.gripper_from_camera, solved.scale

    def bundle(problem: HandEyeProblem, seed: int) -> tuple[np.ndarray, float]:
        start = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
        used = start.inliers
        tracks = of_images(observed(problem, np.random.default_rng(seed), 300, 0.3), used)
        adjusted = adjust(
            problem.base_from_gripper[used],
            (start.gripper_from_camera, start.scale, start.base_from_recon),
            problem.recon_from_camera[used],
            LENS,
            tracks,
        )
        return adjusted.bundle.gripper_from_camera, adjusted.scale

    solvers: dict[str, Solver] = {
        "jcr, poses only": pose_only,
        "jcr, bundle adjustment": bundle,
        "paper's grid search": lambda p, seed: grid_search(p.base_from_gripper, p.recon_from_camera),
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


def _accuracy() -> list[str]:
    lines = [
        f"Median error over {TRIALS} simulated captures ({GRID_TRIALS} for the grid search): "
        "mm / degrees / % of scale. "
        f"Vision noise {1e3 * VISION[0]:.1f} mm, {np.degrees(VISION[1]):.2f}°.",
    ]
    for noise in NOISES:
        lines += [
            "",
            f"Robot noise {1e3 * noise[0]:.1f} mm, {np.degrees(noise[1]):.1f}° per axis",
            "",
            "| method | " + " | ".join(f"{count} images" for count in COUNTS) + " |",
            "|---" * (len(COUNTS) + 1) + "|",
        ]
        for name, solver in _solvers().items():
            cells = []
            for count in COUNTS:
                trials = GRID_TRIALS if "grid" in name else TRIALS
                missed = []
                for seed in range(trials):
                    problem = problem_of(seed, count, noise)
                    missed.append(_missed(problem, solver, seed))
                mm, deg, percent = np.median(missed, axis=0)
                cells.append(f"{mm:.2f} / {deg:.3f} / {percent:.2f}")
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def _missed(problem: HandEyeProblem, solver: Solver, seed: int) -> tuple[float, float, float]:
    try:
        x, scale = solver(problem, seed)
    except cv2.error:  # with wrong poses among them some of OpenCV's methods give up
        return np.inf, np.inf, np.inf
    off = error(problem, x, abs(scale))
    return (
        1e3 * float(np.linalg.norm(off[:3])),
        float(np.degrees(np.linalg.norm(off[3:6]))),
        100 * abs(off[6]),
    )


def _outliers() -> list[str]:
    lines = [
        "",
        "15 images, 4 of them with another image's pose, robot noise 0.5 mm, 0.1°: median error",
        "",
        "| method | mm / degrees / % of scale | wrong images named |",
        "|---|---|---|",
    ]
    for name, solver in _solvers().items():
        missed, named = [], 0
        trials = GRID_TRIALS if "grid" in name else TRIALS
        for seed in range(trials):
            problem = problem_of(seed, 15, NOISES[1])
            bad = np.random.default_rng(seed).choice(15, 4, replace=False)
            problem.base_from_gripper[bad] = problem.base_from_gripper[np.roll(bad, 1)]
            missed.append(_missed(problem, solver, seed))
            if name.startswith("jcr"):
                solved: HandEye = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
                named += sorted(np.flatnonzero(~solved.inliers)) == sorted(bad)
        mm, deg, percent = np.median(missed, axis=0)
        told = f"{named} of {trials} captures, none else" if name.startswith("jcr") else "cannot"
        lines.append(f"| {name} | {mm:.2f} / {deg:.3f} / {percent:.2f} | {told} |")
    return lines


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
        ("jcr: closed form, outliers, uncertainty, observability, held-out error", 15,
         lambda: solve_hand_eye(gripper, camera), 21),
        (f"jcr: bundle adjustment, {len(tracks.image)} observations", 15,
         lambda: adjust(gripper, pose_fit, camera, LENS, tracks), 3),
        (f"jcr: bundle adjustment, {len(large_tracks.image)} observations", 36,
         lambda: adjust(large.base_from_gripper, large_fit, large.recon_from_camera, LENS, large_tracks), 1),
        ("paper's grid search: closed form", 15, lambda: grid_search(gripper, camera), 3),
        ("Andreff with scale: closed form", 15, lambda: andreff_with_scale(gripper, camera), 21),
        *(
            (f"OpenCV {name}: closed form, scale given", 15,
             lambda name=name: opencv(name, gripper, camera, SCALE), 21)
            for name in OPENCV_METHODS
        ),
    ]  # fmt: skip
    lines = ["", "Time, median", "", "| what | images | ms |", "|---|---|---|"]
    for name, images, work, repeats in rows:
        taken = []
        for _ in range(repeats):
            begun = time.perf_counter()
            work()
            taken.append(1e3 * (time.perf_counter() - begun))
        lines.append(f"| {name} | {images} | {np.median(taken):.1f} |")
    return lines
