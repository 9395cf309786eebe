"""`jcr bench limits`: where it breaks. One thing made worse at a time, until the answer is wrong or refused."""

import json
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jcr.calibrate.calibrate import calibrate
from jcr.calibrate.hand_eye import solve_hand_eye
from jcr.capture.images import read_image
from jcr.capture.read import read_capture
from jcr.errors import NotTrustedError
from jcr.geometry import transform
from jcr.reconstruct.colmap import ColmapOptions, reconstruct
from jcr.records import HandEye
from jcr.simulate.capture import SimulateOptions, simulate
from jcr.simulate.problem import HandEyeProblem, error, hand_eye_problem
from jcr.simulate.render import render
from jcr.simulate.scenes import Scene, make_scene
from jcr.simulate.truth import Truth, read_truth

COUNT = 10
SEED = 0
NOISE = (0.5, 0.1)
"""Of the robot, mm and degrees, where it is not what is made worse."""
WRONG_MM, WRONG_DEG = 20.0, 2.0
"""Beyond this an answer is wrong; wrong and trusted is the worst fault there is."""
POSE_TRIALS = 15
"""Simulated pose sets behind a line without pictures."""
PICTURE = (213, 160)
"""Pixels of an example in the figure."""

Change = Callable[[Path], None]


@dataclass(frozen=True)
class Trial:
    """A capture with one thing made worse."""

    what: str
    level: str
    options: SimulateOptions
    change: Change = field(default=lambda folder: None)
    """Done to the capture folder after it was simulated."""


def trials() -> list[Trial]:
    """Everything that is made worse, each from harmless to hopeless."""
    plain = SimulateOptions(images=COUNT, seed=SEED, robot_noise=NOISE)
    return [
        *(Trial("images", f"{n}", replace(plain, images=n)) for n in (3, 4, 5, 8)),
        Trial("texture", "wood and prints", plain),
        Trial("texture", "plain table, textured objects", replace(plain, scene="light8")),
        Trial("texture", "none", replace(plain, texture=False)),
        *(Trial("motion blur", f"{px} px", plain, _blurred(px)) for px in (5, 11, 21)),
        *(
            Trial("pixel noise", f"σ {sigma:g} of 255", replace(plain, noise=sigma))
            for sigma in (5.0, 15.0, 40.0)
        ),
        *(Trial("focal length given", f"x {factor:g}", plain, _focal(factor)) for factor in (0.95, 1.2)),
        Trial("focal length given", "none", replace(plain, unknown_intrinsics=True)),
        *(
            Trial("robot noise", f"{mm:g} mm, {mm / 5:g}°", replace(plain, robot_noise=(mm, mm / 5)))
            for mm in (1.0, 3.0, 10.0)
        ),
        *(Trial("objects moved midway", f"{n}", plain, _redrawn(_moved(n), COUNT // 2)) for n in (1, 3, 8)),
        Trial("glossy table", "shine 1", plain, _redrawn(_glossy, 0)),
    ]


def run() -> str:
    """Markdown, with what is made worse down the page; `figure` draws its examples."""
    lines = [
        f"{COUNT} images of the simulated tabletop (seed {SEED}), COLMAP back end, robot noise {NOISE[0]:g} mm and "
        f"{NOISE[1]:g}° unless named. **wrong** is more than {WRONG_MM:g} mm or {WRONG_DEG:g}° off; wrong and trusted "
        "at once is what must not happen.",
        "",
        "| made worse | to | images used | answer | off: mm | ° | error / σ | reason given |",
        "|---" * 8 + "|",
        *(_line(trial) for trial in trials()),
        "",
        f"Least rotation: views that turn by so much about random axes, {COUNT} poses, no pictures, "
        f"{POSE_TRIALS} draws.",
        "",
        "| turned by | trusted | of those wrong | median off when trusted: mm | median ±σ: mm |",
        "|---" * 5 + "|",
        *_rotation_lines(),
    ]
    return "\n".join(lines) + "\n"


def _line(trial: Trial) -> str:
    with tempfile.TemporaryDirectory() as folder:
        made = simulate(Path(folder) / "capture", trial.options)
        trial.change(made)
        capture, truth = read_capture(made), read_truth(made)
        try:
            reconstruction = reconstruct(capture, ColmapOptions(dense=False))
            found = calibrate(capture, reconstruction)
        except NotTrustedError as refusal:
            return f"| {trial.what} | {trial.level} | 0 | refused | | | | {_short(str(refusal))} |"
    problem = HandEyeProblem(
        capture.base_from_gripper,
        reconstruction.recon_from_camera,
        truth.gripper_from_camera,
        found.scale,  # the unit of structure from motion is nobody's: its error is not counted
        truth.base_from_gripper,
    )
    mm, deg, sigmas = _off(problem, found)
    says = "trusted" if found.converged else "not trusted"
    wrong = ", **wrong**" if mm > WRONG_MM or deg > WRONG_DEG else ""
    reason = "" if found.converged else _short(found.warnings[0])
    return (
        f"| {trial.what} | {trial.level} | {found.inliers.sum()} | {says}{wrong} | {mm:.2f} | {deg:.3f} | "
        f"{sigmas:.1f} | {reason} |"
    )


def _off(problem: HandEyeProblem, found: HandEye) -> tuple[float, float, float]:
    """mm, degrees, and the root mean square of the six errors in reported standard deviations."""
    off = error(problem, found.gripper_from_camera, found.scale)[:6]
    sigmas = float(np.sqrt(off @ np.linalg.solve(found.covariance[:6, :6], off) / 6))
    return 1e3 * float(np.linalg.norm(off[:3])), float(np.degrees(np.linalg.norm(off[3:]))), sigmas


def _short(text: str) -> str:
    return text.split(";")[0].split(" (")[0]


def _rotation_lines() -> Iterable[str]:
    for degrees in (0.0, 1.0, 3.0, 6.0, 12.0, 25.0):
        trusted, wrong, off, std = 0, 0, [], []
        for seed in range(POSE_TRIALS):
            problem = hand_eye_problem(
                np.random.default_rng(seed),
                COUNT,
                "translation",
                robot_noise=(NOISE[0] / 1e3, float(np.radians(NOISE[1]))),
                camera_noise=(2e-4, float(np.radians(0.02))),
                deviation=float(np.radians(degrees)),
            )
            found = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
            if not found.converged:
                continue
            mm, deg, _ = _off(problem, found)
            trusted += 1
            wrong += mm > WRONG_MM or deg > WRONG_DEG
            off.append(mm)
            std.append(1e3 * np.sqrt(np.diag(found.covariance)[:3].max()))
        middle = f"{np.median(off):.1f} | {np.median(std):.1f}" if off else "| "
        yield f"| {degrees:g}° | {trusted} of {POSE_TRIALS} | {wrong} | {middle} |"


def _pictures(folder: Path) -> list[Path]:
    return sorted((folder / "images").iterdir())


def _blurred(length_px: int) -> Change:
    """A wrist that moves while it takes the picture, each time in another direction."""

    def change(folder: Path) -> None:
        for k, path in enumerate(_pictures(folder)):
            angle = 2.4 * k
            line = np.zeros((length_px, length_px), np.float32)
            middle = length_px // 2
            reach = middle * np.array([np.cos(angle), np.sin(angle)])
            ends = np.rint([middle - reach, middle + reach]).astype(int)
            cv2.line(line, ends[0].tolist(), ends[1].tolist(), 1.0)
            image = read_image(path)[..., ::-1]
            cv2.imwrite(str(path), cv2.filter2D(image, -1, line / line.sum()))

    return change


def _focal(factor: float) -> Change:
    def change(folder: Path) -> None:
        content: dict[str, Any] = json.loads((folder / "capture.json").read_text())
        for key in ("fx", "fy"):
            content["intrinsics"][key] *= factor
        (folder / "capture.json").write_text(json.dumps(content))

    return change


def _redrawn(other: Callable[[Scene], Scene], first: int) -> Change:
    """Pictures from number `first` on show another scene from the same places."""

    def change(folder: Path) -> None:
        truth: Truth = read_truth(folder)
        scene = other(make_scene("tabletop", truth.seed))
        views = render(scene, truth.intrinsics, truth.base_from_camera[first:], with_truth=False)
        for path, view in zip(_pictures(folder)[first:], views, strict=True):
            cv2.imwrite(str(path), view.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])

    return change


def _moved(count: int) -> Callable[[Scene], Scene]:
    """Somebody pushed the first few objects 6 cm aside."""

    def other(scene: Scene) -> Scene:
        pushed = [
            replace(
                thing,
                base_from_object=transform(np.eye(3), np.array([0.04, 0.045, 0.0])) @ thing.base_from_object,
            )
            if k < count
            else thing
            for k, thing in enumerate(scene.objects)
        ]
        return replace(scene, objects=tuple(pushed))

    return other


def _glossy(scene: Scene) -> Scene:
    return replace(scene, table=tuple(replace(part, shine=1.0) for part in scene.table))
