"""Hand-eye solvers, images and global alignment beside other methods."""

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.page import apart, mm_deg, table
from jcr.backends import ReconstructOptions, reconstruct
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.calibration.case import of_images
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.capture.read import read_capture
from jcr.errors import RejectedError
from jcr.estimation.intrinsics_prior import FIXED, camera_with_prior
from jcr.estimation.problem import wrist_arm, wrist_problem
from jcr.estimation.solve import recon_frame, solve
from jcr.geometry import (
    Similarity,
    fit_similarity,
    inverse,
    nearest_rotation,
    rotation_between_deg,
    scale_translation,
    transform,
)
from jcr.paper.hand_eye import SCALES
from jcr.paper.hand_eye import solve as solve_published
from jcr.pointmaps.global_alignment.align import global_align
from jcr.pointmaps.pair_predictions import complete_pairs
from simulation.capture import SimulateOptions, simulate
from simulation.pairs import PairErrors, pairs_of_capture, synthetic_pairs, write_pairs
from simulation.problems import INTRINSICS, HandEyeProblem, error, hand_eye_problem, observed
from simulation.scenes import SceneName
from simulation.truth import read_truth

Poses = Float[ndarray, "n 4 4"]
Answer = tuple[Float[ndarray, "4 4"], float]
"""gripper_from_camera and metres per unit of the reconstruction."""

# Solvers of others.

OPENCV_METHODS = {
    "Tsai": cv2.CALIB_HAND_EYE_TSAI,
    "Park": cv2.CALIB_HAND_EYE_PARK,
    "Horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "Andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "Daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}


def opencv(method: str, base_from_gripper: Poses, recon_from_camera: Poses, scale: float) -> Answer:
    """Solve by one of OpenCV's five methods, which cannot estimate the scale and are given it."""
    camera_from_recon = inverse(scale_translation(recon_from_camera, scale))
    rotation, translation = cv2.calibrateHandEye(
        list(base_from_gripper[:, :3, :3]),
        list(base_from_gripper[:, :3, 3]),
        list(camera_from_recon[:, :3, :3]),
        list(camera_from_recon[:, :3, 3]),
        method=OPENCV_METHODS[method],
    )
    # With wrong poses among them some methods answer with a reflection.
    return transform(nearest_rotation(rotation), translation[:, 0]), scale


def grid_search(base_from_gripper: Poses, recon_from_camera: Poses) -> Answer:
    """Solve by the paper's method, with its search over λ from 1 to 4."""
    return solve_published(base_from_gripper, recon_from_camera, SCALES)


def andreff_with_scale(base_from_gripper: Poses, recon_from_camera: Poses) -> Answer:
    """Solve linearly for rotation, translation and scale at once (Andreff, Horaud and Espiau, IJRR 2001)."""
    a = inverse(base_from_gripper[:-1]) @ base_from_gripper[1:]
    b = inverse(recon_from_camera[:-1]) @ recon_from_camera[1:]
    unit = np.linalg.norm(b[:, :3, 3]) / np.linalg.norm(a[:, :3, 3])
    rows = np.zeros((len(a), 12, 13))
    for k in range(len(a)):
        rows[k, :9, :9] = np.eye(9) - np.kron(a[k, :3, :3], b[k, :3, :3])
        rows[k, 9:, :9] = np.kron(np.eye(3), b[k, :3, 3] / unit)
        rows[k, 9:, 9:12] = np.eye(3) - a[k, :3, :3]
        rows[k, 9:, 12] = -a[k, :3, 3]
    null = np.linalg.svd(rows.reshape(-1, 13))[2][-1]
    # The null vector is (R, t/λ, 1/λ) up to a factor that makes det R = 1.
    null = null / np.cbrt(np.linalg.det(null[:9].reshape(3, 3)))
    return transform(nearest_rotation(null[:9].reshape(3, 3)), null[9:12] / null[12]), float(
        1 / (null[12] * unit)
    )


# Simulated poses.

COUNTS, TRIALS, MANY, WRONG = (3, 5, 8, 12), 20, 15, (1, 3, 5)
"""Numbers of images, captures per cell, images among which some have another's pose, and how many."""
NOISE, VISION = (5e-4, float(np.radians(0.1))), (2e-4, float(np.radians(0.02)))
"""m, rad per axis of the gripper poses, and of the camera poses, as structure from motion leaves them."""
SCALE = 2.0
"""Metres per unit, inside the only range that the paper's grid search covers."""
PAPER_SOLVERS: dict[str, Callable[[Poses, Poses], Answer]] = {
    "paper's grid search": grid_search,
    "Andreff with scale": andreff_with_scale,
}
"""Solvers of camera and gripper poses alone, which estimate the scale."""


def _answers(problem: HandEyeProblem, seed: int) -> Iterator[tuple[str, Answer | None]]:
    """Yield the answer of every method, None where one of OpenCV's gives up, as some do with wrong poses."""
    gripper, camera = problem.base_from_gripper, problem.recon_from_camera
    solved = solve_hand_eye(gripper, camera)
    yield "jcr, poses only", (solved.gripper_from_camera, solved.scale)
    used = solved.inliers
    tracks = of_images(observed(problem, np.random.default_rng(seed), 300, 0.3), used)
    fit = solved.gripper_from_camera, solved.scale, solved.base_from_recon.rigid
    exact = camera_with_prior(INTRINSICS, FIXED)
    adjusted = solve(*wrist_problem(wrist_arm(gripper[used]), fit, camera[used], exact, tracks))
    yield "jcr, bundle adjustment", (adjusted.state.x[0], recon_frame(adjusted, tracks)[0])
    for name, method in PAPER_SOLVERS.items():
        yield name, method(gripper, camera)
    for name in OPENCV_METHODS:
        try:
            answer = opencv(name, gripper, camera, problem.scale)
        except cv2.error:
            answer = None
        yield f"OpenCV {name}, scale given", answer


def _problem(seed: int, count: int, wrong: int) -> HandEyeProblem:
    """Return a problem in which `wrong` images have another one's gripper pose."""
    problem = hand_eye_problem(np.random.default_rng(seed), count, robot_noise=NOISE, camera_noise=VISION)
    rescaled = scale_translation(problem.recon_from_camera, problem.scale / SCALE)
    problem = replace(problem, recon_from_camera=rescaled, scale=SCALE)
    bad = np.sort(np.random.default_rng(seed).choice(count, wrong, replace=False))
    other = (bad + 1) % count if wrong == 1 else np.roll(bad, 1)
    problem.base_from_gripper[bad] = problem.base_from_gripper[other]
    return problem


def solvers_page(seeds: Sequence[int]) -> Iterator[str]:
    """Yield the claim and the table of the solvers; each seed gives a capture of a cell."""
    rows: dict[str, list[str]] = defaultdict(list)
    for count, wrong in (*((count, 0) for count in COUNTS), *((MANY, wrong) for wrong in WRONG)):
        errors: Errors = defaultdict(list)
        for seed in seeds:
            problem = _problem(seed, count, wrong)
            for name, answer in _answers(problem, seed):
                errors[name].append((np.inf, np.inf) if answer is None else mm_deg(error(problem, *answer)))
        for name, found in errors.items():
            (mm, deg), rms = np.median(found, axis=0), np.sqrt(np.square(found).mean(0))[0]
            rows[name].append(f"{mm:.2f} / {rms:.2f} / {deg:.3f}")
    parts = [
        f"{name} {rows[name][len(COUNTS) - 1]}" for name in ("jcr, bundle adjustment", "paper's grid search")
    ]
    yield (
        f"> Simulated poses, robot pose noise 0.5 mm and 0.1°, {COUNTS[-1]} images, median and rms mm and median °: "
        f"{'; '.join(parts)}; with {WRONG[-1]} wrong poses among {MANY}: jcr {rows['jcr, bundle adjustment'][-1]}."
    )
    yield from ("", f"{len(seeds)} captures a cell: median mm / rms mm / median °.", "")
    heads = [*(f"{count} images" for count in COUNTS), *(f"{wrong} wrong of {MANY}" for wrong in WRONG)]
    yield from table(" | ".join(["method", *heads]), ([name, *cells] for name, cells in rows.items()))


# Images, as in the paper's table I.

SCENES: tuple[SceneName, ...] = ("light8", "light7", "dark")
CAPTURES, FEW = 20, 12
"""Captures, and images of each."""
WEBCAM = {"noise": 3.0, "blur": 0.7, "vignetting": 0.35, "jpeg_quality": 75, "robot_noise": (0.5, 0.1)}
"""Grey levels, pixels, share, percent; mm and degrees per axis."""
PUBLISHED = PairErrors(warp=0.04, bend=0.01, pair_rotation_deg=0.6)
"""Errors of the size that DUSt3R's paper publishes (arXiv 2312.14132): 3.6 % mean error of depth, 3.5 % there on DTU;
second views rotated by 1.0° (rms), medians of 1.0° to 1.3° there on most of 7-Scenes."""
Errors = dict[str, list[tuple[float, float]]]
"""mm and degrees of every capture by method; NaN where there is no result."""


def images_page(seeds: Sequence[int]) -> Iterator[str]:
    """Yield the claim and the table of simulated images, a capture a seed."""
    errors: dict[str, Errors] = {name: defaultdict(list) for name in ("COLMAP", "simulated predictions")}
    accepted: dict[str, int] = defaultdict(int)
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            options = SimulateOptions(scene=SCENES[seed % len(SCENES)], images=FEW, seed=seed, **WEBCAM)
            made, pairs = simulate(Path(folder) / "capture", options), Path(folder) / "pairs.npz"
            write_pairs(pairs, pairs_of_capture(made, errors=PUBLISHED, seed=seed)[0])
            choices = ReconstructOptions(backend="colmap"), ReconstructOptions(predictions=pairs)
            for (source, found), choice in zip(errors.items(), choices, strict=True):
                converged, of_methods = _methods(made, choice)
                accepted[source] += converged
                for name in ("jcr", *PAPER_SOLVERS):
                    found[name].append(of_methods.get(name, (np.nan, np.nan)))
    rows, parts = [], []
    for source, methods in errors.items():
        for name, found in methods.items():
            (mm, deg), rms = np.nanmedian(found, axis=0), np.sqrt(np.nanmean(np.square(found), axis=0))[0]
            results = np.isfinite(found).all(1).sum()
            verdicts = f"{accepted[source]} of {len(found)}" if name == "jcr" else ""
            rows.append([source, name, results, verdicts, f"{mm:.2f}", f"{rms:.2f}", f"{deg:.3f}"])
            parts.append(f"{name} on {source} {mm:.2f} and {rms:.2f} mm")
    yield f"> {FEW} images of plain tables by a webcam, median and rms: {'; '.join(parts)}."
    yield from ("", f"Simulated scenes {', '.join(SCENES)}, {len(seeds)} captures.", "")
    yield from table("reconstruction | method | results | accepted | median mm | rms mm | median °", rows)


def _methods(made: Path, choice: ReconstructOptions) -> tuple[bool, dict[str, tuple[float, float]]]:
    """Return whether jcr accepts a reconstruction of a capture, and the errors of jcr and the paper's solvers on it."""
    capture, truth = read_capture(made), read_truth(made)
    true, found = truth.gripper_from_camera, {}
    try:
        made_of = reconstruct(capture, choice)
        # The scale lies in the only range that the paper's grid covers.
        centers = truth.base_from_camera[made_of.image_index, :3, 3]
        unit = fit_similarity(centers, made_of.recon_from_camera[:, :3, 3])[1]
        rescaled = scale_translation(made_of.recon_from_camera, unit / SCALE)
        for name, solver in PAPER_SOLVERS.items():
            found[name] = apart(solver(capture.base_from_gripper[made_of.image_index], rescaled)[0], true)
        hand_eye = calibrate_reconstruction(capture, made_of)
    except RejectedError:
        return False, found
    return hand_eye.converged, found | {"jcr": apart(hand_eye.gripper_from_camera, true)}


# Global alignment.

SIZES, IMAGES, STEPS, FEW_STEPS = ((128, 96), (512, 384)), 10, 300, 3


def alignment_page() -> Iterator[str]:
    """Yield the claim and the table of processor seconds and errors of global alignment, ours and the published one."""
    import torch  # without which the other peers run

    from jcr.paper.alignment import align

    torch.set_num_threads(1)
    rows, spent = [], {}
    for size in SIZES:
        predictions, truth = synthetic_pairs(complete_pairs(IMAGES), size)
        # 300 steps at the larger size take a quarter of an hour: extrapolated from a few.
        steps = STEPS if size == SIZES[0] else FEW_STEPS
        for name, method, done in (
            ("jcr.global_align", global_align, STEPS),
            (f"Adam, {STEPS} steps", lambda pairs, n=steps: align(pairs, n), steps),
        ):
            begun = time.process_time()
            found = method(predictions)
            spent[name] = (time.process_time() - begun) * STEPS / done
            mm, deg = camera_errors(truth.base_from_camera, found.recon_from_camera)
            errors = [f"{mm:.2f}", f"{deg:.3f}"] if done == STEPS else ["", ""]
            rows.append([f"{size[0]}x{size[1]}", name, f"{spent[name]:.1f}", *errors])
    ours_s, published_s = spent.values()
    yield (
        f"> Global alignment of {IMAGES * (IMAGES - 1)} pairs at 512x384 takes {ours_s:.1f} s of processor; "
        f"{STEPS} steps of Adam, a reimplementation of the published method, would take {published_s / ours_s:.0f} "
        "times as long on this processor."
    )
    yield from ("", *table("pairs of | method | processor, s | cameras off: mm | °", rows))


def camera_errors(base_from_camera: Poses, recon_from_camera: Poses) -> tuple[float, float]:
    """Return mean distance (mm) and angle (degrees) of the cameras from the truth, after the best similarity."""
    true, found = base_from_camera[:, :3, 3], recon_from_camera[:, :3, 3]
    base_from_recon, scale = fit_similarity(true, found)
    off = np.linalg.norm(Similarity(base_from_recon, scale)(found) - true, axis=1)
    rotations = base_from_recon[:3, :3] @ recon_from_camera[:, :3, :3]
    angle = rotation_between_deg(rotations, base_from_camera[:, :3, :3])
    return 1e3 * float(off.mean()), float(angle.mean())


def run(every: int = 1) -> str:
    """Return the page in Markdown, with one in `every` of the captures of solvers and images."""
    parts = {
        "Hand-eye solvers": solvers_page(range(max(TRIALS // every, 1))),
        "Images": images_page(range(max(CAPTURES // every, 1))),
        "Global alignment": alignment_page(),
    }
    claims, lines = [], []
    for title, part in parts.items():
        claim, *rest = part
        claims.append(claim)
        lines += ["", f"## {title}", *rest]
    return "\n".join([*claims, *lines]) + "\n"
