"""File report.html: one page with the verdict on a calibration, the transform to copy, and the evidence."""

from contextlib import suppress
from datetime import UTC, datetime

from jcr.calibration.record import FailedCalibration, PublishedCalibration
from jcr.calibration.summary import intrinsics_origin
from jcr.capture.formats.capture_json import origin
from jcr.capture.readings import decision_in_words
from jcr.errors import InputError, count_of, printable
from jcr.number_format import significant
from jcr.records import Capture
from jcr.report.details import StageOptions, cameras_section, details_section, objects_section
from jcr.report.images import images_section
from jcr.report.motion import motion_section
from jcr.report.render import Content, render
from jcr.report.residuals import residuals_section
from jcr.report.scene3d import scene_section
from jcr.report.transform import transform_section
from jcr.report.verdict import failure_section, head
from jcr.result import RunResult

UNNAMED = {"poses", "capture", "metadata"}
"""Stems of file names that are the same in every capture, so that the folder names the capture."""
LINKS = {
    "warnings": "Warnings",
    "transform": "Transform",
    "view": "3D view",
    "images": "Images",
    "cameras": "Cameras",
    "residuals": "Residuals",
    "uncertainty": "Uncertainty and motion",
    "objects": "Objects",
    "notes": "Notes",
    "details": "Details",
}
"""Sections by name: text of the link to the section, which is also the heading of a collapsed section."""
OPEN = {"verdict", "failure", "tiles", "warnings", "transform", "view", "images"}
"""Names of the sections that are not collapsed."""


def report_html(result: RunResult, options: StageOptions | None = None) -> str:
    """Return the report of a run as one HTML page that loads no other file; `options` are those of the run, for display.

    Sections without data are left out. A run from given camera poses has no images; a run that found no camera poses has
    only the reason, the remedy, the images and the details. Raises InputError if an image of the capture cannot be read.
    """
    calibration, capture, options = result.calibration, result.capture, options or {}
    if not isinstance(capture, Capture):
        about, source = "poses given, no images", capture.source or result.out
    else:
        (width, height), source = capture.image_size, origin(capture.folder)
        robot = options.get("calibrate", {}).get("robot") or capture.robot
        arm = f"arm {robot}" if robot else "arm of a URDF" if capture.urdf else "arm not named"
        given = "not given" if capture.intrinsics is None else "given"
        if calibration.intrinsics is not None:
            given = intrinsics_origin(calibration)
        about = f"{arm} · {capture.camera_name} camera, {width} × {height} px, intrinsics {given}"
    has_images, is_published = isinstance(capture, Capture), isinstance(calibration, PublishedCalibration)
    is_wrist, scene = has_images and capture.mount != "base", result.scene if has_images else None
    measured, sections = None if scene is None else result.measured, dict[str, Content | None]()
    if isinstance(calibration, FailedCalibration):
        sections |= {"failure": failure_section(calibration), "images": images_section(capture)}
    else:
        sections |= head(calibration, result.cameras if has_images else None)
        sections |= {
            "transform": transform_section(result.solved),
            "view": scene_section(result) if is_wrist else None,
            "images": images_section(capture, result) if has_images else None,
            "cameras": cameras_section(result.cameras) if has_images and result.cameras is not None else None,
            "residuals": None if is_published else residuals_section(result),
            "uncertainty": motion_section(result)
            if not is_published and (is_wrist or not has_images)
            else None,
            "objects": None
            if scene is None or measured is None
            else objects_section(measured, scene.label_names),
            "notes": {"remarks": calibration.notes} if calibration.notes else None,
        }
    sections["details"] = details_section(calibration, options, None if scene is None else scene.history)
    shown = {name: content for name, content in sections.items() if content is not None}
    # Files with a usual name, such as capture.json, do not name the capture; their folder does.
    named = source.parent if source.stem in UNNAMED else source
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    images = count_of(len(calibration.images), "image")
    run = f"{images} · back end {calibration.backend} · {made} · jcr {calibration.version}"
    content = {
        "name": printable(named.resolve().name),
        "about": [about, *_facts(result), run, printable(str(source))],
        "sections": shown,
        "open": OPEN,
        "links": {name: LINKS[name] for name in shown if name in LINKS},
    }
    return render("report.html", content)


def _facts(result: RunResult) -> list[str]:
    """Return lines of text on a run: version of the calibration, intrinsics, and reading of the poses, where known."""
    lines, capture = list[str](), result.capture
    with suppress(InputError):  # results that are no runs have no state
        if (state := result.state).predecessor is not None:
            lines.append(f"version {state.version} of this calibration, after {printable(state.predecessor)}")
    if (found := result.calibration.intrinsics) is not None:
        focal, centre = (f" ± {significant(max(found.std[k : k + 2]))}" if found.std else "" for k in (0, 2))
        lines.append(
            f"fx {found.fx:.2f}, fy {found.fy:.2f}{focal} · cx {found.cx:.2f}, cy {found.cy:.2f}{centre} px · "
            f"{found.model} distortion {', '.join(f'{value:.4g}' for value in found.distortion)}"
        )
    if isinstance(capture, Capture) and capture.reading is not None:
        lines.append(printable(f"poses: {decision_in_words(capture.reading)}"))
    return lines
