"""`benchmarks limits`: where it breaks. One thing made worse at a time, until the result is wrong or rejected."""

import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from benchmarks.figure import blank, png
from benchmarks.simulated.problem import HandEyeProblem, error, hand_eye_problem
from benchmarks.simulated.truth import read_truth
from jcr.calibration.stage import calibrate
from jcr.capture.images import read_image
from jcr.capture.read import read_capture
from jcr.errors import RejectedError
from jcr.files import write_bytes
from jcr.geometry import transform
from jcr.handeye.solve import solve_hand_eye
from jcr.reconstruct.colmap import reconstruct_colmap
from jcr.records import HandEye
from jcr.simulate.capture import SimulateOptions, simulate
from jcr.simulate.render import render
from jcr.simulate.scenes import Scene, make_scene
from jcr.simulate.truth import Truth

COUNT = 10
SEED = 0
NOISE = (0.5, 0.1)
"""Of the robot, mm and degrees, where it is not what is made worse."""
WRONG_MM, WRONG_DEG = 20.0, 2.0
"""Beyond this a result is wrong; wrong and accepted is the worst fault there is."""
POSE_TRIALS = 15
"""Simulated pose sets behind a line without images."""
ROTATIONS = (0.0, 1.0, 3.0, 6.0, 12.0, 25.0)
"""Degrees."""
SURPRISE = 3.0
"""Reported standard deviations beyond which an accepted result is a silent fault."""
IMAGE_SIZE = (213, 160)
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
        *(
            Trial("focal length given", f"x {factor:g}", plain, _focal(factor))
            for factor in (0.95, 1.05, 0.8, 1.2)
        ),
        Trial("focal length given", "none", replace(plain, unknown_intrinsics=True)),
        *(
            Trial("robot pose noise", f"{mm:g} mm, {mm / 5:g}°", replace(plain, robot_noise=(mm, mm / 5)))
            for mm in (1.0, 3.0, 10.0)
        ),
        *(Trial("objects moved midway", f"{n}", plain, _redrawn(_moved(n), COUNT // 2)) for n in (1, 3, 8)),
        Trial("glossy table", "shine 1", plain, _redrawn(_glossy, 0)),
        Trial("path of the wrist", "turntable", replace(plain, pattern="one-axis")),
        Trial("path of the wrist", "orbit at one radius", replace(plain, pattern="orbit")),
        Trial("path of the wrist", "no rotation", replace(plain, pattern="translation")),
    ]


@dataclass(frozen=True)
class Verdict:
    """What came of one trial."""

    trial: Trial
    image: UInt8[ndarray, "h w 3"]
    """One of its images, small."""
    used: int = 0
    mm: float = np.nan
    deg: float = np.nan
    sigmas: float = np.nan
    """Largest error on an axis of translation and rotation in reported standard deviations."""
    std_mm: float = np.nan
    status: int = 3
    """Of `jcr calibrate`: 3 where the answer is rejected."""
    reason: str = ""

    @property
    def wrong(self) -> bool:
        """Off by more than what counts as wrong."""
        return self.mm > WRONG_MM or self.deg > WRONG_DEG

    @property
    def silent(self) -> bool:
        """Trusted, and farther off than it says: the one thing that must not happen."""
        return self.status == 0 and self.sigmas > SURPRISE

    @property
    def result(self) -> str:
        """In words."""
        if np.isnan(self.mm):
            return "rejected"
        words = "accepted" if self.status == 0 else "rejected"
        return words + (", wrong" if self.wrong else "") + (", **silent wrong**" if self.silent else "")


def run(out: Path | None = None, long: bool = False) -> str:
    """Markdown, with what is made worse down the page; what the camera saw goes to an image in `out`."""
    image = "limits_long.png" if long else "limits.png"
    verdicts = [_verdict(trial) for trial in trials()[:: 1 if long else 2]]
    if out is not None:
        write_bytes(out / image, _sheet(verdicts))
    rotations = [_rotation(degrees) for degrees in ROTATIONS]
    silent = [f"{v.trial.what} {v.trial.level}" for v in verdicts if v.silent]
    wrong = [v for v in verdicts if v.wrong and v.status == 0]
    lines = [
        f"> Of {len(verdicts)} captures made worse in one way each, {sum(v.status == 0 for v in verdicts)} are "
        f"accepted; {len(wrong)} of these are off by more than {WRONG_MM:g} mm or {WRONG_DEG:g}°, and "
        + (
            f"{len(silent)} by more than {SURPRISE:g} reported standard deviations on an axis: {', '.join(silent)}."
            if silent
            else f"none by more than {SURPRISE:g} reported standard deviations on any axis."
        ),
        "",
        f"{COUNT} images of the simulated tabletop (seed {SEED}), COLMAP back end, robot pose noise {NOISE[0]:g} mm and "
        f"{NOISE[1]:g}° unless stated. *wrong*: more than {WRONG_MM:g} mm or {WRONG_DEG:g}° off. **silent wrong**: "
        f"exit status 0 and an error of more than {SURPRISE:g} reported standard deviations on an axis (σ), the one "
        "thing that must not happen.",
        "",
        f"![what the camera saw]({image})",
        "",
        "| made worse | to | images used | exit status | result | off: mm | ° | σ | reported ±: mm | said first |",
        "|---" * 10 + "|",
        *map(_line, verdicts),
        "",
        f"Least rotation: views that rotate by so much about random axes, {COUNT} poses, no images, "
        f"{POSE_TRIALS} draws.",
        "",
        "| rotated by | accepted | of those wrong | silent wrong | median off when accepted: mm | median ±σ: mm |",
        "|---" * 6 + "|",
        *rotations,
    ]
    return "\n".join(lines) + "\n"


def _verdict(trial: Trial) -> Verdict:
    with tempfile.TemporaryDirectory() as folder:
        made = simulate(Path(folder) / "capture", trial.options)
        trial.change(made)
        capture, truth = read_capture(made), read_truth(made)
        # The last one: what happens midway has happened.
        image = cv2.resize(read_image(_images(made)[-1]), IMAGE_SIZE, interpolation=cv2.INTER_AREA)
        try:
            reconstruction = reconstruct_colmap(capture)
            found = calibrate(capture, reconstruction)
        except RejectedError as refusal:
            return Verdict(trial, np.asarray(image, np.uint8), reason=_short(str(refusal)))
    problem = HandEyeProblem(
        capture.base_from_gripper,
        reconstruction.recon_from_camera,
        truth.gripper_from_camera,
        found.scale,  # the unit of structure from motion is nobody's: its error is not counted
        truth.base_from_gripper,
    )
    return Verdict(
        trial,
        np.asarray(image, np.uint8),
        int(found.inliers.sum()),
        *_off(problem, found),
        0 if found.converged else 3,
        _short(found.warnings[0]) if found.warnings else "",
    )


def _line(v: Verdict) -> str:
    numbers = "| | | " if np.isnan(v.mm) else f"{v.mm:.2f} | {v.deg:.3f} | {v.sigmas:.1f} | {v.std_mm:.1f}"
    return (
        f"| {v.trial.what} | {v.trial.level} | {v.used} | {v.status} | {v.result} | {numbers} | {v.reason} |"
    )


def _off(problem: HandEyeProblem, found: HandEye) -> tuple[float, float, float, float]:
    """mm, degrees, the largest of the six errors in reported standard deviations, and the largest of these in mm."""
    off = error(problem, found.gripper_from_camera, found.scale)[:6]
    std = np.sqrt(np.diag(found.covariance)[:6])
    return (
        1e3 * float(np.linalg.norm(off[:3])),
        float(np.degrees(np.linalg.norm(off[3:]))),
        float(np.abs(off / std).max()),
        1e3 * float(std[:3].max()),
    )


def _short(text: str) -> str:
    return text.split(";")[0].split(" (")[0]


def _sheet(verdicts: Sequence[Verdict]) -> bytes:
    """PNG: a row for each thing that is made worse, an image for each level, framed by what came of it."""
    kinds = list(dict.fromkeys(v.trial.what for v in verdicts))
    across = max(sum(v.trial.what == kind for v in verdicts) for kind in kinds)
    figure = blank(2.3 * across, 2.1 * len(kinds))
    figure.set_layout_engine("constrained", h_pad=0.07)  # inches: a caption stays with the image above it
    axes = figure.subplots(len(kinds), across, squeeze=False)
    for row, kind in zip(axes, kinds, strict=True):
        chosen = [v for v in verdicts if v.trial.what == kind]
        for axis in row[len(chosen) :]:
            axis.set_visible(False)
        for axis, v in zip(row, chosen, strict=False):
            axis.imshow(v.image)
            axis.set_xticks([])
            axis.set_yticks([])
            color = "tab:red" if v.silent else "tab:green" if v.status == 0 else "tab:orange"
            for spine in axis.spines.values():
                spine.set(color=color, linewidth=3)
            off = "" if np.isnan(v.mm) else f", {v.mm:.1f} mm"
            axis.set_title(f"{kind}: {v.trial.level}", fontsize=7)
            axis.set_xlabel(f"{v.result.replace('**', '')}{off}", fontsize=7)
    return png(figure, 90)


def _rotation(degrees: float) -> str:
    accepted, wrong, silent, off, std = 0, 0, 0, [], []
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
        mm, deg, sigmas, std_mm = _off(problem, found)
        accepted += 1
        wrong += mm > WRONG_MM or deg > WRONG_DEG
        silent += sigmas > SURPRISE
        off.append(mm)
        std.append(std_mm)
    middle = f"{np.median(off):.1f} | {np.median(std):.1f}" if off else "| "
    return f"| {degrees:g}° | {accepted} of {POSE_TRIALS} | {wrong} | {silent} | {middle} |"


def _images(folder: Path) -> list[Path]:
    return sorted((folder / "images").iterdir())


def _blurred(length_px: int) -> Change:
    """A wrist that moves while it takes the image, each time in another direction."""

    def change(folder: Path) -> None:
        for k, path in enumerate(_images(folder)):
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
    """Images from number `first` on show another scene from the same places."""

    def change(folder: Path) -> None:
        truth: Truth = read_truth(folder)
        scene = other(make_scene("tabletop", truth.seed))
        views = render(scene, truth.intrinsics, truth.base_from_camera[first:], with_truth=False)
        for path, view in zip(_images(folder)[first:], views, strict=True):
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
