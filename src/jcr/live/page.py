"""What the live page shows of a capture: one record, drawn by the templates and the figures of the report."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jcr.calibration.requirement import GRASPING
from jcr.live.arm_words import ArmWords
from jcr.live.calibration_progress import Progress
from jcr.live.calibration_words import faults, next_lines, next_sentence, number_of
from jcr.live.collect import LiveCapture, Shown
from jcr.live.folder import LiveFolder
from jcr.records import Finding, Intrinsics
from jcr.records.words import reached_in_words, sentence
from jcr.report.figures import Figure, course_figure
from jcr.report.raster import TRACK_COLOR
from jcr.report.render import Section, render
from jcr.report.scene3d import TRACK_SIZE, PointLayer, scene_data, scene_view
from jcr.report.verdict import Tile
from jcr.rounding import significant

PACKAGE = "jcr.live"
PARTS = ("head", "next", "course", "images")
"""Templates of what changes with the capture, each in an element of this name."""
ANY_CAMERA = Intrinsics(600.0, 600.0, 320.0, 240.0, 640, 480)
"""Drawn where no intrinsics are known."""


@dataclass(frozen=True, kw_only=True)
class ImageCard:
    """An image as the page lists it."""

    number: int
    name: str
    fault: str
    """What is found against it; empty where nothing is."""
    state: str
    """registered, not registered, new (no calibration with it yet)."""


@dataclass(frozen=True, kw_only=True)
class PageState:
    """All that changes on the page, but for the 3D view; the templates draw nothing else."""

    kind: str
    """good, fair, bad, or empty: the colour of the headline."""
    headline: str
    lines: Sequence[str]
    """What is to be known of it, and what is wrong."""
    replaces: int | None
    """The number of the image that the next one replaces."""
    is_over: bool
    can_undo: bool
    tiles: Sequence[Tile]
    next_pose: str
    """Where it is and what is expected of it; empty where none is proposed."""
    next_lines: Sequence[str]
    """As the arm writes it."""
    courses: Sequence[Figure]
    images: Sequence[ImageCard]
    """The newest first."""


def whole_page(capture: LiveCapture) -> str:
    """The page as a browser loads it; it then asks for its parts."""
    content = {"folder": str(capture.live.folder), "scene": _scene_section(capture)}
    return render("live.html", content, PACKAGE)


def page_parts(capture: LiveCapture) -> dict[str, Any]:
    """What the page asks for when the capture has changed: the parts, as HTML, and what the 3D view draws."""
    shown = capture.shown
    state = page_state(shown, capture.live, capture.options.require or GRASPING, capture.words)
    parts = {name: render(f"{name}.html", {"state": state}, PACKAGE) for name in PARTS}
    return {
        "version": shown.version,
        "is_over": shown.is_over,
        "images": len(shown.images),
        "parts": parts,
        "scene": json.dumps(_scene(capture)),
    }


def page_state(shown: Shown, live: LiveFolder, required: tuple[float, float], words: ArmWords) -> PageState:
    """What the page shows at one moment; `required` are mm and degrees."""
    progress, images = shown.progress, _cards(shown)
    kind, headline, lines = _verdict(shown, required)
    pose = progress.next_pose if not shown.is_over else None
    return PageState(
        kind=kind,
        headline=headline,
        lines=lines,
        replaces=None if shown.replaces is None else live.names.index(shown.replaces) + 1,
        is_over=shown.is_over,
        can_undo=live.can_undo or shown.replaces is not None,
        tiles=_tiles(shown, required),
        next_pose="" if pose is None else next_sentence(progress),
        next_lines=[] if pose is None else next_lines(progress, words),
        courses=_courses(progress, required),
        images=images[::-1],
    )


def _cards(shown: Shown) -> list[ImageCard]:
    progress = shown.progress
    against = {name: sentence(one) for one in progress.findings[::-1] for name in _of_one(one)}
    return [
        ImageCard(
            number=number,
            name=name,
            fault=against.get(name, ""),
            state="registered"
            if name in progress.registered
            else "not registered"
            if name in progress.images
            else "new",
        )
        for number, name in enumerate(shown.images, 1)
    ]


def _of_one(finding: Finding) -> tuple[str, ...]:
    return finding.images if len(finding.images) == 1 and finding.severity != "informs" else ()


def _verdict(shown: Shown, required: tuple[float, float]) -> tuple[str, str, list[str]]:
    """The kind, the headline and the lines below it."""
    progress, wrong = shown.progress, faults(shown.progress)
    lines = [_capitalised(sentence(one)) for one in wrong]
    if shown.result is not None:
        verdict = shown.result.verdict
        kind = {"accepted": "good", "rejected": "bad"}.get(verdict, "fair")
        found = shown.result.hand_eye.requirement
        reached = [] if found is None else [_capitalised(reached_in_words(found))]
        where = f"The calibration of all {len(shown.images)} images is in {shown.result.out}; its report.html shows it."
        return kind, _capitalised(verdict), [*reached, where]
    if shown.is_refusal:
        return "bad", _capitalised(shown.event), lines
    if shown.event:
        return "", _capitalised(shown.event), lines
    if not shown.images:
        first = "Move the arm so that the camera sees textured things at different heights, and let it rest."
        return "", "No image yet", [first]
    if wrong:
        is_bad = any(one.severity == "rejects" for one in wrong)
        number = number_of(wrong[0], shown.images)
        commands = [] if number is None else [f"Retake or remove image {number}."]
        return "bad" if is_bad else "fair", lines[0], [*commands, *lines[1:]]
    if progress.now is None:
        return (
            "",
            f"{len(shown.images)} images",
            ["From the third image that registers on there is a calibration."],
        )
    return _accuracy(progress, required)


def _accuracy(progress: Progress, required: tuple[float, float]) -> tuple[str, str, list[str]]:
    """Of a calibration against which nothing is found."""
    assert progress.now is not None
    if progress.requirement_met:
        return (
            "good",
            "Requirement met, press Finish",
            ["The leave-one-out error confirms it. More images are possible."],
        )
    mm, deg = progress.now.translation_mm, progress.now.rotation_deg
    if mm > required[0] or deg > required[1]:
        return "", "Not accurate enough yet: go on to the next pose", []
    if progress.leave_one_out is None:
        return "", "Accurate by its own estimate: more images are needed to confirm it", []
    return "fair", "Accurate by its own estimate, which the leave-one-out error exceeds", []


def _capitalised(words: str) -> str:
    return words[:1].upper() + words[1:]


def _tiles(shown: Shown, required: tuple[float, float]) -> list[Tile]:
    progress = shown.progress
    if not shown.images:
        return []
    tiles: list[Tile] = [
        (name, f"± {significant(value)}{unit}", f"required {limit:g}{unit}", True)
        for name, value, limit, unit in zip(
            ("Point seen, 95 %", "Direction, 95 %"), _reached(shown), required, (" mm", "°"), strict=False
        )
    ]
    count = f"{len(progress.registered)} of {len(shown.images)}"
    tiles.append(("Images registered", count, "", False))
    if (error := progress.leave_one_out) is not None:
        off = f"{significant(error.translation_mm)} mm · {significant(error.rotation_deg)}°"
        tiles.append(("Leave-one-out error", off, "", False))
    return tiles


def _reached(shown: Shown) -> tuple[float, ...]:
    """How exact the calibration is (mm, degrees), at the end that of all images; empty where there is none."""
    found = None if shown.result is None else shown.result.hand_eye.requirement
    if found is not None:
        return found.reached_mm, found.reached_deg
    now = shown.progress.now
    return () if now is None else (now.translation_mm, now.rotation_deg)


def _courses(progress: Progress, required: tuple[float, float]) -> list[Figure]:
    """How exact the calibration was, image by image."""
    if len(history := progress.history) < 2:
        return []
    count = [one.images for one in history]
    curves = [
        ("Point seen (mm)", [one.translation_mm for one in history], required[0], " mm"),
        ("Direction (°)", [one.rotation_deg for one in history], required[1], "°"),
    ]
    return [course_figure(title, count, values, goal, unit) for title, values, goal, unit in curves]


def _scene_section(capture: LiveCapture) -> Section:
    checks = [
        ("cameras", "cameras", True),
        ("grippers", "grippers", True),
        ("grid", "base and grid", True),
        ("next", "next pose (green)", True),
        ("tracks", "points seen (red)", True),
    ]
    return Section(
        "view", {"layers": [], "checks": checks, "through": [], "labels": [], "data": _scene(capture)}
    )


def _scene(capture: LiveCapture) -> dict[str, Any]:
    """Points seen, images and the next pose; cameras where a calibration places them."""
    shown, live = capture.shown, capture.live
    progress, found = shown.progress, shown.progress.hand_eye
    x = np.eye(4) if found is None else found.gripper_from_camera
    faults = {one.name: one.fault for one in _cards(shown)}
    views = [
        scene_view(
            Path(one.name).name,
            faults.get(one.name, "") or one.name,
            not faults.get(one.name),
            one.base_from_gripper,
            one.base_from_gripper @ x if found is not None and one.name in progress.registered else None,
        )
        for one in live.images
    ]
    points = np.zeros((0, 3)) if progress.points_in_base is None else progress.points_in_base
    layer = PointLayer(
        "points seen", points, np.tile(np.array(TRACK_COLOR, np.uint8), (len(points), 1)), TRACK_SIZE
    )
    next_poses = [] if progress.next_pose is None or shown.is_over else [progress.next_pose.base_from_gripper]
    intrinsics = (found.intrinsics if found is not None else None) or ANY_CAMERA
    shown_in_base = np.array([np.zeros(3), *(pose[:3, 3] for pose in (*live.poses, *next_poses))])
    return scene_data([layer], views, next_poses, x, intrinsics, shown_in_base)
