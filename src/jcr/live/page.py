"""Content of the live page: the state of a session as plain values, from which templates make HTML."""

import json
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from jcr.calibration.options import RequiredAccuracy
from jcr.capture.images import encode_jpeg, read_image
from jcr.errors import count_of
from jcr.findings import reached_in_words, sentence
from jcr.live.progress import (
    accuracy_line,
    advice,
    faults,
    finding_lines,
    reached_accuracy,
    verifying_lines,
)
from jcr.live.session import LiveSession, SessionState
from jcr.number_format import significant
from jcr.records import Intrinsics
from jcr.report.render import render
from jcr.report.scene3d import scene_data, scene_view, track_layer
from jcr.report.verdict import Tile

if TYPE_CHECKING:
    from jcr.pipeline.verify import Verification

PACKAGE = "jcr.live"
TEMPLATES = ("head", "images")
"""Names of the templates of the parts that change; each part is the content of the HTML element of that name."""
LAYERS = {
    "cameras": "cameras",
    "grippers": "grippers",
    "grid": "base and grid",
    "tracks": "points of the scene (red)",
}
"""Parts of the 3D view that can be hidden, and the labels of their check boxes."""
ANY_CAMERA = Intrinsics(600.0, 600.0, 320.0, 240.0, 640, 480)
"""Camera that is drawn while the intrinsics are unknown."""
NOW_PX, CARD_PX = 640, 330
"""Widths (px) of the camera's live image and of the images in the list."""
FEW_FEATURES = 150
"""Number of SIFT features, in an image NOW_PX wide, below which an image may not register."""


def whole_page(session: LiveSession) -> str:
    """Return the HTML of the live page, without its changing parts, which its script requests from `page_parts`."""
    checks = [(name, label, True) for name, label in LAYERS.items()]
    view = {"layers": [], "checks": checks, "through": [], "labels": [], "data": _scene(session.state)}
    return render("live.html", {"folder": str(session.folder.folder), "scene": view}, PACKAGE)


def page_parts(session: LiveSession, state: SessionState, has_report: bool) -> dict[str, Any]:
    """Return the changing parts of the live page for a state: HTML by name, data of the 3D view, flags of the script.

    `has_report` states that the report of the final calibration exists and can be opened.
    """
    # "kind" selects the colour of the headline; "cards" are those of the images, the newest first.
    kind, *lines = verdict_lines(state)
    headline, *below = (line[:1].upper() + line[1:] for line in lines)
    content = {"state": state, "has_report": has_report, "kind": kind, "headline": headline, "lines": below}
    content["has_gripper"] = session.has_gripper
    content |= {"cards": _cards(state)[::-1], "tiles": _tiles(state, session.options.require)}
    return {
        "version": state.version,
        "is_over": state.is_over,
        "is_done": state.is_done,
        "has_report": has_report,
        "images": len(state.images),
        "parts": {name: render(f"{name}.html", content, PACKAGE) for name in TEMPLATES},
        "scene": json.dumps(_scene(state)),
    }


def _cards(state: SessionState) -> list[dict[str, Any]]:
    """Return a card for each image: its number in commands, file name, the finding about it, and registration state.

    Keys: "number" (from 1), "name", "fault" (empty without one), "kind" (CSS class: used, warned or rejected) and
    "state" ("registered", "not registered" or "new"; after calibration or verification "used" or "left out").
    """
    progress, against, kinds = state.progress, dict[str, str](), dict[str, str]()
    findings = progress.findings if state.result is None else state.result.calibration.findings
    for one in findings[::-1]:
        if len(one.images) == 1 and one.severity != "informs":
            against[one.images[0]] = sentence(one)
            kinds[one.images[0]] = "warned" if one.severity == "warns" else "rejected"
    registered = dict.fromkeys(progress.images, "not registered")
    registered |= dict.fromkeys(progress.registered, "registered")
    registered |= dict.fromkeys(filter(None, [state.replaces]), "the next image replaces this one")
    used = None if state.verification is None else set(state.verification.images)
    if state.verifies is not None:
        registered = dict.fromkeys(state.names, "taken")
    if state.result is not None:
        used = {one.image for one in state.result.calibration.images if one.used}
    if used is not None:
        registered = {name: "used" if name in used else "left out" for name in state.names}
    return [
        {"number": number, "name": name, "fault": against.get(name, ""), "kind": kinds.get(name, "used")}
        | {"state": registered.get(name, "new")}
        for number, name in enumerate(state.names, 1)
    ]


def verdict_lines(state: SessionState) -> list[str]:
    """Return a list: colour of the headline ("good", "fair", "bad" or empty), headline, and the lines below it."""
    progress, result, count = state.progress, state.result, len(state.images)
    wrong = faults(progress)
    if result is not None:
        required = result.calibration.requirement
        found = [] if required is None or not required.met else [reached_in_words(required)]
        found += [sentence(one) for one in result.calibration.findings if one.severity != "informs"]
        kind = {"accepted": "good", "rejected": "bad"}.get(result.verdict, "fair")
        used = f"{result.calibration.images_used} of {count_of(count, 'image')}"
        return [kind, result.verdict, *found, f"The calibration uses {used}; it is in {result.out}."]
    if state.is_refusal:
        return ["bad", state.event, *(sentence(one) for one in wrong)]
    if state.event:
        return ["", state.event, *([] if state.is_over else _verifying(state))]
    if state.verification is not None:
        return _verification_lines(state.verification)
    if not count:
        first = "Move the arm so that the camera sees textured things at different heights, and let it rest."
        return ["", "No image yet", first, *_verifying(state)]
    if state.verifies is not None:
        return ["", *_verifying(state)]
    if not progress.images:
        return ["", f"{count} images", "They are being calibrated."]
    lines = finding_lines(progress)
    if any(one.severity == "rejects" for one in wrong):
        return ["bad", *lines]
    if wrong:
        return ["fair", *lines, advice(progress)]
    if progress.requirement_met:
        return ["good", "Requirement met, press Finish"]
    return ["", f"{count} images", accuracy_line(progress), advice(progress)]


def _verifying(state: SessionState) -> list[str]:
    """Return what is still needed to verify a run; empty if none is verified."""
    return [] if state.verifies is None else verifying_lines(state.verifies, len(state.images), state.most)


def _verification_lines(found: "Verification") -> list[str]:
    """Return the lines of `verdict_lines` for a verification: verdict, what has moved, remedy, notes and sensitivity."""
    kind = "bad" if found.moved else "fair" if found.notes else "good"
    remedy = [f"Remedy: {found.advice}"] if found.moved else []
    mm, deg = significant(1e3 * found.detectable[0]), significant(float(np.degrees(found.detectable[1])))
    sensitivity = (
        f"{count_of(len(found.images), 'image')} used; they find 9 of 10 changes of {mm} mm or {deg}°"
    )
    return [kind, f"verification: {found.verdict}", found.finding, *remedy, *found.notes, sensitivity]


def _verifying_tiles(state: SessionState) -> list[Tile]:
    """Return tiles of a capture that verifies a run: number of images and, after the verification, the drift."""
    tiles: list[Tile] = [("Images", f"{len(state.images)} of {state.most}", "", "first")]
    if (found := state.verification) is not None:
        mm, deg = 1e3 * np.linalg.norm(found.offset[:3]), np.degrees(np.linalg.norm(found.offset[3:]))
        size = f"{significant(float(mm))} mm, {significant(float(deg))}°"
        tiles.append(("Drift of the camera", size, "from the calibration", "first"))
    return tiles


def _tiles(state: SessionState, required: RequiredAccuracy) -> list[Tile]:
    """Return tiles of reached and required accuracy, number of registered images, and leave-one-out error.

    Accuracy and error are those of the final calibration if there is one. `required` are bounds (mm, degrees) on 95 %
    of the errors of a point at the working distance. There are no tiles without images.
    """
    if not state.images:
        return []
    if state.verifies is not None:
        return _verifying_tiles(state)
    tiles, reached, error = list[Tile](), state.progress.reached or (), state.progress.leave_one_out
    if state.result is not None:
        error = state.result.calibration.held_out
        reached = reached_accuracy(state.result.calibration) or ()
    names = ("Point uncertainty", " mm"), ("Direction", "°")
    missing = [Path(name).name for name in state.names if name not in state.progress.registered]
    without = [f"without {', '.join(missing[:3])}{' …' * (len(missing) > 3)}"] if missing else []
    for k, ((name, unit), value) in enumerate(zip(names, reached, strict=False)):
        limits = [] if required == "none" else [f"required {required[k]:g}{unit}"]
        tiles.append((f"{name}, 95 %", f"± {significant(value)}{unit}", "; ".join(limits + without), "first"))
    # The images of the last calibration; some may be removed since, and others are not calibrated yet.
    calibrated = [name for name in state.names if name in state.progress.images]
    new = len(state.images) - len(calibrated)
    name, count = "Images registered", sum(name in state.progress.registered for name in calibrated)
    if state.result is not None:
        name, count, calibrated, new = "Images used", state.result.calibration.images_used, state.names, 0
    tiles.append((name, f"{count} of {len(calibrated)}", f"{new} new" if new else "", ""))
    if error is not None:
        size = f"{significant(error.translation_mm)} mm, {significant(error.rotation_deg)}°"
        px = "" if error.reprojection_px is None else f"{significant(error.reprojection_px)} px"
        tiles.append(("Leave-one-out error", size, px, ""))
    return tiles


def _scene(state: SessionState) -> dict[str, Any]:
    """Return the data of the 3D view (`scene_data`) in the base frame: points and gripper poses.

    After a calibration, the data also contain the camera poses of the registered images.
    """
    progress, found = state.progress, state.progress.hand_eye
    x = np.eye(4) if found is None else found.gripper_from_camera
    views = []
    for one, card in zip(state.images, _cards(state), strict=True):
        name, fault, gripper = Path(one.image).name, card["fault"], one.base_from_gripper
        camera = gripper @ x if found is not None and one.image in progress.registered else None
        views.append(scene_view(name, fault or one.image, not fault, gripper, camera))
    points = np.zeros((0, 3)) if progress.points_in_base is None else progress.points_in_base
    intrinsics = (found.intrinsics if found is not None else None) or ANY_CAMERA
    shown_in_base = np.array([np.zeros(3), *(one.base_from_gripper[:3, 3] for one in state.images)])
    return scene_data([track_layer("points of the scene", points)], views, intrinsics, shown_in_base)


@lru_cache(maxsize=128)
def image_card(file: Path) -> bytes:
    """Return an image file as the bytes of a JPEG that is 330 px (CARD_PX) wide."""
    return encode_jpeg(_small(read_image(file), CARD_PX))


def camera_image(image: UInt8[ndarray, "h w 3"]) -> tuple[bytes, str]:
    """Return an RGB image as a JPEG, 640 px wide with a ring at each SIFT feature, and a sentence on their number."""
    small = _small(image, NOW_PX)
    found = cv2.SIFT.create(2000).detect(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), None)
    for feature in found:
        cv2.circle(small, (round(feature.pt[0]), round(feature.pt[1])), 3, (60, 235, 120), 1, cv2.LINE_AA)
    few = "" if len(found) >= FEW_FEATURES else " Few: put textured things into view."
    return encode_jpeg(small), f"{len(found)} features.{few}"


def _small(image: UInt8[ndarray, "h w 3"], width: int) -> UInt8[ndarray, "h2 w2 3"]:
    """Return a copy of an image that is scaled to a `width` (px) with its aspect ratio, averaged over areas."""
    size = width, max(1, round(width * image.shape[0] / image.shape[1]))
    return np.asarray(cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA), np.uint8)
