"""Live capture with scripted calibrations, for tests of `LiveSession` without a reconstruction."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from numpy import ndarray

from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.record import Calibration
from jcr.capture.images import read_image
from jcr.findings import Finding, FindingKind
from jcr.geometry import rotation_exp, transform
from jcr.live.cameras import Camera, Frame
from jcr.live.folder import LiveFolder
from jcr.live.progress import LiveProgress
from jcr.live.robot import RobotState
from jcr.live.session import Answer, LiveSession, SessionOptions
from jcr.records import LeaveOneOut, PointUncertainty, PointUncertaintyOverImage, Requirement

REQUIRED = (2.0, 0.3)
RATE = 10
"""Images a second of a video."""


def a_hand_eye(met: bool, reached_mm: float = 1.0) -> Calibration:
    """Return an accepted calibration that reaches an accuracy and meets its requirement, or does not."""
    rng = np.random.default_rng(0)
    poses = transform(rotation_exp(0.5 * rng.normal(size=(10, 3))), 0.2 * rng.normal(size=(10, 3)))
    found = solve_hand_eye(poses, poses @ transform(np.eye(3), np.array([0.05, 0.0, 0.1])))
    required = Requirement(
        translation_mm=REQUIRED[0], rotation_deg=REQUIRED[1], distance_mm=500.0,
        reached_mm=min(reached_mm, REQUIRED[0]) if met else max(reached_mm, 1.1 * REQUIRED[0]),
        reached_deg=0.1,
    )  # fmt: skip
    seen = PointUncertainty(
        distance_mm=500.0, within_95_mm=required.reached_mm, lateral_95_mm=0.0, along_95_mm=0.0,
        ray_95_deg=0.0, rotation_95_deg=required.reached_deg,
    )  # fmt: skip
    seen = PointUncertaintyOverImage(**vars(seen), corners=seen)
    return replace(found, requirement=required, uncertainty=replace(found.uncertainty, seen=seen))


@dataclass
class Scripted:
    """Calibration that is accurate from a number of images on; `contradicted` is an image with a wrong pose."""

    live: LiveFolder
    accurate_from: int = 100
    contradicted: str | None = None
    warns: bool = False
    """Whether the calibration at the end has a warning."""
    fault: Exception | None = None
    """Raised by the next update."""
    finished: int = 0
    progress: LiveProgress = field(default_factory=lambda: LiveProgress(images=()))

    def update(self) -> LiveProgress:
        if self.fault is not None:
            fault, self.fault = self.fault, None
            raise fault
        images = tuple(self.live.names)
        count, hand_eye = len(images), None
        if count >= 3:
            hand_eye = a_hand_eye(count >= self.accurate_from, 10.0 / count)
        findings = ()
        if self.contradicted in images:
            findings = (
                Finding(
                    kind=FindingKind.POSE_CONTRADICTS_IMAGE,
                    severity="warns",
                    concerns="poses",
                    images=(str(self.contradicted),),
                    value=0.03,
                    details={"rotation": 0.1},
                ),
            )
        self.progress = LiveProgress(
            images=images, added=images[-1] if images else None, registered=images, findings=findings,
            hand_eye=hand_eye, points_in_base=np.random.default_rng(0).normal(size=(50, 3)),
        )  # fmt: skip
        return self.progress

    def finish(self) -> Any:
        self.finished += 1
        made = a_hand_eye(True)
        blurred = Finding.of(FindingKind.BLURRED, "warns", "images", "images/001.png", value=5.0)
        error = LeaveOneOut(
            translation_mm=0.0123, rotation_deg=0.00456, reprojection_px=0.0789, how="joint adjustment"
        )
        findings = (blurred,) if self.warns else ()
        found = replace(made, findings=findings, held_out=error)
        return SimpleNamespace(
            converged=True, calibration=found, verdict="accepted", out=self.live.folder / "result"
        )

    def close(self) -> None:
        self.live.close()


def a_capture(
    folder: Path,
    frames: Iterator[Frame],
    tell: Callable[[Answer, list[str]], None] = lambda answer, lines: None,
    gripper: Callable[[], RobotState] | None = None,
    accurate_from: int = 100,
    verifies: Path | None = None,
    **options: Any,
) -> tuple[LiveSession, Scripted]:
    """Return a session that captures these frames into a folder, and its calibration."""
    scripted: Any = Scripted(LiveFolder(folder), accurate_from=accurate_from)
    camera = Camera(frames, lambda: None)
    options = {"require": REQUIRED} | options
    session = LiveSession(scripted, camera, SessionOptions(**options), tell, gripper, verifies)
    return session, scripted


def still_frames(image: Callable[[], ndarray]) -> Iterator[Frame]:
    """Yield the result of `image` four times a second."""
    step = 0
    while True:
        yield Frame(image(), 0.25 * step)
        step += 1


def take_all(session: LiveSession, poses: list[ndarray], waits: bool = False) -> list[Answer]:
    """Run a session that is asked for an image at each pose, and return the answers."""
    answers: list[Answer] = []

    def source() -> None:
        for pose in poses:
            answers.append(session.take(RobotState(0.0, pose), waits=waits))

    session.run(source)
    return answers


def still(tabletop: Path, k: int) -> ndarray:
    return read_image(tabletop / "images" / f"{k:02d}.jpg")


def poses(tabletop: Path) -> list[ndarray]:
    frames = json.loads((tabletop / "capture.json").read_text())["frames"]
    return [np.array(frame["base_from_gripper"]) for frame in frames]


def video(path: Path, tabletop: Path, images: range, rest_s: int = 1) -> Path:
    """Write a video in which the arm rests before each image and swings for half a second in between."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), RATE, (640, 480))
    for k in images:
        rgb = still(tabletop, k)
        for step in range(5):
            shift = np.array([[1, 0, 40.0 * (5 - step)], [0, 1, 0]])
            writer.write(cv2.warpAffine(rgb, shift, (640, 480), borderMode=cv2.BORDER_WRAP)[..., ::-1])
        for _ in range(RATE * rest_s):
            writer.write(np.ascontiguousarray(rgb[..., ::-1]))
    writer.release()
    return path
