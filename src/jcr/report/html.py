"""report.html: one file that says whether to trust a calibration, hands it over, and shows what was found."""

import platform
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.calibration_json import CalibrationFile
from jcr.calibration.words import (
    attempt_in_words,
    budget_in_words,
    missed,
    pixels,
)
from jcr.capture.capture_json import origin
from jcr.capture.table import TABLES
from jcr.errors import printable
from jcr.extras import is_installed
from jcr.geometry import scale_translation
from jcr.records import COEFFICIENTS, Capture, Intrinsics, Kind, verdict_of
from jcr.records.words import SHORT, reached_in_words, remedy, sentence, text
from jcr.report.cell_cameras import cameras_section
from jcr.report.features import features_section
from jcr.report.figures import ABOVE, OBLIQUE, camera_figure
from jcr.report.map_pictures import map_section
from jcr.report.map_samples import sample_surface
from jcr.report.markup import PAGE, filled
from jcr.report.motion import motion_section
from jcr.report.object_table import objects_section
from jcr.report.pictures import images_section, pixels_of_file, thumbnails
from jcr.report.residual_bars import residuals_section
from jcr.report.scene3d import scene_section
from jcr.report.seen import seen_section
from jcr.report.transform import transform_section
from jcr.results import PosesResult, RunResult
from jcr.rounding import significant

SURFACE_POINTS = 80_000
"""Sampled from the map, at most."""

MAIN = ("A seen point", "Translation, 1 σ", "Rotation, 1 σ")
"""The tiles with the largest numbers."""

UNNAMED = {
    Path(name).stem for name in (*TABLES, "capture.json", "cal_data.yaml", "transforms.json", "metadata.yaml")
}
"""Files that are called so in every capture."""
ANY_LENS = Intrinsics(600.0, 600.0, 320.0, 240.0, 640, 480)
"""Of the cameras that are drawn where nobody says what they saw."""
LINKS = {
    "warnings": "Warnings",
    "notes": "Notes",
    "transform": "Transform",
    "seen": "Seen points",
    "view": "3D",
    "images": "Images",
    "features": "Features",
    "residuals": "Residuals",
    "uncertainty": "Uncertainty",
    "before-after": "Before and after",
    "map": "Map",
    "objects": "Objects",
    "details": "Details",
}
"""To the sections, by their names in the page."""
Options = Mapping[str, Mapping[str, Any]]
"""A stage's name, and its options by name."""


def report_html(result: RunResult, options: Options | None = None) -> str:
    """The report of a run, made with these options, as one HTML page that loads nothing else.

    Sections whose record a run does not have are left out. Raises InputError when an image of the capture has
    become unreadable.
    """
    calibration, hand_eye, capture = result.calibration, result.hand_eye, result.capture
    reconstruction, rows = result.reconstruction, result.image_index
    if result.capture.mount == "base":
        sections = [
            _verdict(calibration),
            _tiles(calibration),
            _remarks("warnings", "Warnings", calibration.remarks),
            _remarks("notes", "Notes", calibration.notes),
            transform_section(hand_eye, "base"),
            images_section(result),
            residuals_section(result),
            _details(calibration, options or {}),
        ]
        return _page(_heading(capture, options or {}), origin(capture.folder), calibration, sections)
    base_from_camera = hand_eye.base_from_recon @ scale_translation(
        reconstruction.recon_from_camera, hand_eye.scale
    )
    surface = None if result.scene is None else sample_surface(result.scene, SURFACE_POINTS)
    sections = [
        _verdict(calibration),
        _tiles(calibration),
        _remarks("warnings", "Warnings", calibration.remarks),
        _remarks("notes", "Notes", calibration.notes),
        transform_section(hand_eye),
        seen_section(result),
        "" if result.cameras is None else cameras_section(result.cameras),
        scene_section(result, base_from_camera, surface),
        images_section(result),
        features_section(result),
        residuals_section(result),
        motion_section(result),
        _before_after(
            capture.base_from_gripper, reconstruction.recon_from_camera, base_from_camera, rows, result.lens
        ),
        ""
        if result.scene is None or surface is None
        else map_section(result, result.scene, surface, base_from_camera),
        ""
        if result.scene is None or result.measured is None
        else objects_section(result.measured, result.scene.label_names),
        _details(calibration, options or {}, {} if result.scene is None else result.scene.history),
    ]
    return _page(_heading(capture, options or {}), origin(capture.folder), calibration, sections)


def poses_report_html(result: PosesResult, options: Options | None = None) -> str:
    """The report of camera poses that were given: as that of a run, without images."""
    calibration, hand_eye, pairs = result.calibration, result.hand_eye, result.pairs
    base_from_camera = hand_eye.base_from_recon @ scale_translation(pairs.recon_from_camera, hand_eye.scale)
    cameras = pairs.recon_from_camera, base_from_camera
    sections = [
        _verdict(calibration),
        _tiles(calibration),
        _remarks("warnings", "Warnings", calibration.remarks),
        _remarks("notes", "Notes", calibration.notes),
        transform_section(hand_eye),
        residuals_section(result),
        motion_section(result),
        _before_after(pairs.base_from_gripper, *cameras, result.image_index, ANY_LENS),
        _details(calibration, options or {}),
    ]
    return _page("poses given, no images", pairs.source, calibration, sections)


def failed_report_html(capture: Capture, calibration: CalibrationFile, options: Options | None = None) -> str:
    """The report of a run that found no camera poses: why, with the remedy, and the images."""
    cards = "".join(
        f'<figure><div class="shot"><img src="{url}" alt="{escape(name)}"></div>'
        f'<figcaption><span class="file">{escape(name)}</span></figcaption></figure>'
        for name, url in zip(capture.images, thumbnails(capture, capture.intrinsics), strict=True)
    )
    say = "What the camera saw. Without texture, overlap or light no features are found in them."
    sections = [
        _failure(calibration),
        filled(
            "images.html",
            say=say,
            about="",
            cards=cards,
            pixels=pixels_of_file(capture.intrinsics, capture.image_size),
        ),
        _details(calibration, options or {}),
    ]
    return _page(_heading(capture, options or {}), origin(capture.folder), calibration, sections)


def _failure(calibration: CalibrationFile) -> str:
    """What is wrong in one sentence, what to do, and below it what each back end that was tried said."""
    failed, *others = calibration.findings
    remedies = [sentence(one) for one in others if one.kind is Kind.BOARD_IN_VIEW]
    remedies += filter(None, [remedy(failed)])
    items = "".join(
        f"<li><b>{escape(attempt.backend)}</b>{' with ' + attempt.features if attempt.features else ''}, "
        f"{attempt.reconstruct_s + attempt.calibrate_s:.1f} s: "
        f"{escape(attempt.why_not or '')}</li>"
        for attempt in calibration.attempts
    )
    tried = f'<h3>What was tried</h3><ul class="attempts">{items}</ul>' if items else ""
    cures = "".join(f"<li>{escape(words[0].upper() + words[1:])}.</li>" for words in remedies)
    helps = f'<h3>What helps</h3><ul class="attempts">{cures}</ul>' if cures else ""
    return (
        f'<section class="verdict bad" id="verdict"><h2><b>No calibration: {escape(text(failed))}.</b></h2>{helps}'
        f"{tried}</section>"
    )


def _heading(capture: Capture, options: Options) -> str:
    """The arm and the camera of a capture, as far as it says."""
    width, height = capture.image_size
    given = "given" if capture.intrinsics is not None else "estimated"
    robot = options.get("calibrate", {}).get("robot") or capture.robot
    arm = f"arm {robot}" if robot else "arm of a URDF" if capture.urdf else "arm not named"
    return f"{arm} · {capture.camera_name} camera, {width} × {height} px, intrinsics {given}"


def _page(heading: str, source: Path, calibration: CalibrationFile, sections: Sequence[str]) -> str:
    """`heading` says of what the calibration is, `source` is the capture as the user named it."""
    # The table or the bag's metadata are called alike in every capture: their folder has the name.
    named = source.parent if source.stem in UNNAMED else source
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    about = f"{len(calibration.images)} images · back end {calibration.backend} · {made} · jcr {calibration.version}"
    return filled(
        "page.html",
        name=escape(printable(named.resolve().name)),
        about=f"{escape(heading)}<br>{escape(about)}<br>{escape(printable(str(source)))}",
        style=(PAGE / "page.css").read_text("utf-8"),
        sections="\n".join(sections),
        links=_links(sections),
        scene3d=(PAGE / "scene3d.js").read_text("utf-8"),
        copy=(PAGE / "copy.js").read_text("utf-8"),
        large=(PAGE / "large.js").read_text("utf-8"),
    )


def _links(sections: Sequence[str]) -> str:
    """To each section that has a heading."""
    found = [name for section in sections for name in re.findall(r'<section[^>]* id="([^"]+)"', section)]
    return "".join(f'<a href="#{name}">{LINKS[name]}</a>' for name in found if name in LINKS)


def _verdict(calibration: CalibrationFile) -> str:
    held_out, required = calibration.held_out, calibration.requirement
    miss = "" if held_out is None else missed(held_out)
    short, verdict = calibration.short, verdict_of(calibration.findings).capitalize()
    if calibration.doubt is not None:
        kind, headline = "bad", f"<b>{verdict}:</b> {escape(calibration.doubt)}."
    elif short is not None:
        say = "" if required is None else f"{reached_in_words(required)}; {remedy(short)}"
        kind, headline = "fair", f"<b>{verdict}:</b> {SHORT}: {escape(say)}."
    else:
        within = "nothing speaks against it" if required is None else escape(reached_in_words(required))
        kind, headline = "good", f"<b>{verdict}:</b> {within}."
    if held_out is None:
        believe = "There were too few images to leave one out and see how well the others predict it."
    elif not calibration.observability.observable:
        # An error along a direction that no motion shows changes no prediction.
        believe = (
            f"Its leave-one-out error of {miss} is no comfort: what is unobservable, no image can contradict."
        )
    elif not calibration.converged:
        no_comfort = "what is wrong with all images, none of them can miss"
        believe = f"Its leave-one-out error of {miss} is no comfort: {no_comfort}."
    else:
        believe = (
            f"Beside it the leave-one-out error: {miss} ({escape(held_out.how)}). It is of one pose, with the "
            "robot pose noise in it, and blind to what all images share, such as intrinsics that are a little wrong."
        )
    if calibration.uncertainty is not None:
        believe += f" Least certain is the translation {escape(calibration.uncertainty.worst)} (one σ)."
    return f'<section class="verdict {kind}" id="verdict"><h2>{headline}</h2><p>{believe}</p></section>'


def _tiles(calibration: CalibrationFile) -> str:
    tiles = []
    if (uncertainty := calibration.uncertainty) is not None:
        direction, _, size = uncertainty.worst.partition(": ")
        worst_deg = significant(max(uncertainty.rotation_std_deg))
        if (seen := uncertainty.seen) is not None:
            far = significant(1e-3 * seen.distance_mm)
            where = f"at {far} m, 95 % of errors; {significant(seen.ray_95_deg)}° of its ray"
            tiles.append(("A seen point", f"{significant(seen.within_95_mm)} mm", where))
        tiles.append(("Translation, 1 σ", size, f"of the camera; worst {direction}"))
        tiles.append(("Rotation, 1 σ", f"±{worst_deg}°", "of the camera; worst about an axis of the gripper"))
    if (held_out := calibration.held_out) is not None:
        degrees = f"{significant(held_out.rotation_deg)}°{pixels(held_out).replace(', ', ' · ')}"
        tiles.append(("Leave-one-out error", f"{significant(held_out.translation_mm)} mm", degrees))
    if uncertainty is not None and calibration.scale is not None:
        percent = significant(uncertainty.scale_std_percent)
        tiles.append(("Scale", significant(calibration.scale, 4), f"m per unit, ±{percent}\u00a0%"))
    used, all_images = calibration.images_used, len(calibration.images)
    tiles.append(
        (
            "Images used",
            f"{used} of {all_images}",
            f"{all_images - used} rejected" if used < all_images else "",
        )
    )
    if (noise := calibration.robot_noise) is not None:
        how = "estimated" if noise.estimated else "as given"
        degrees = f"{significant(noise.rotation_deg)}° per axis, {how}"
        tiles.append(("Robot pose noise, 1 σ", f"{significant(noise.translation_mm)} mm", degrees))
    cells = [
        f'<div class="{"tile first" if name in MAIN else "tile"}"><div class="name">{name}</div>'
        f'<div class="number">{escape(number)}</div><div class="more">{escape(more)}</div></div>'
        for name, number, more in tiles
    ]
    return f'<div class="tiles">{"".join(cells)}</div>'


def _remarks(kind: str, title: str, remarks: Sequence[str]) -> str:
    if not remarks:
        return ""
    items = "".join(f"<li>{escape(remark)}</li>" for remark in remarks)
    return f'<section class="{kind}" id="{kind}"><h2>{title}</h2><ul>{items}</ul></section>'


def _before_after(
    grippers: Float[ndarray, "n 4 4"],
    before: Float[ndarray, "m 4 4"],
    after: Float[ndarray, "m 4 4"],
    rows: Int[ndarray, " m"],
    lens: Intrinsics,
) -> str:
    panels = [
        camera_figure("Before: own frame and unit", grippers, before, None, lens, OBLIQUE),
        camera_figure("After calibration and rescaling", grippers, after, rows, lens, OBLIQUE),
        camera_figure("Before, from above", grippers, before, None, lens, ABOVE),
        camera_figure("After, from above", grippers, after, rows, lens, ABOVE),
    ]
    return filled("before_after.html", panels="".join(panels))


def _details(
    calibration: CalibrationFile, options: Options, map_history: Mapping[str, str] | None = None
) -> str:
    timings = calibration.timings_s
    blocks = {"Time": {stage: f"{seconds:.1f} s" for stage, seconds in timings.items()}}
    blocks["Time"]["together"] = f"{sum(timings.values()):.1f} s"
    found = calibration.gripper_from_camera is not None  # else the failure has told of them
    for k, attempt in enumerate(calibration.attempts if found else [], start=1):
        blocks["Time"][f"attempt {k}"] = attempt_in_words(attempt, len(calibration.images))
    if (lens := calibration.intrinsics) is not None:
        blocks["Intrinsics"] = {
            "size": f"{lens.width} × {lens.height} px",
            "focal length": f"{lens.fx:.2f}, {lens.fy:.2f}{_plus_minus(lens.std, 0)} px",
            "principal point": f"{lens.cx:.2f}, {lens.cy:.2f}{_plus_minus(lens.std, 2)} px",
            " ".join(COEFFICIENTS[lens.model]): ", ".join(f"{k:.5g}" for k in lens.distortion),
        }
    if (uncertainty := calibration.uncertainty) is not None and uncertainty.budget is not None:
        blocks["Uncertainty, 1 σ per axis"] = budget_in_words(uncertainty.budget)
    if (check := calibration.depth_check) is not None:
        blocks["Depth camera"] = {
            "scale error, compared with the robot": f"{check.off_percent:+.2f} ± {check.std_percent:.2g} %",
            **{
                f"noise at {z:.2f} m, 1 σ": f"{significant(1e3 * float(check.std_m(np.array(z))))} mm"
                for z in check.distances_m
            },
            "looked at": f"{check.features} features of {check.images} images",
        }
    if robot := _robot(calibration):
        blocks["Robot"] = robot
    if map_history:
        blocks["Map"] = dict(map_history)
    for stage, chosen in options.items():
        blocks[f"Options: {stage}"] = {name: _value(value) for name, value in chosen.items()}
    packages = ("numpy", "scipy", "torch", "pycolmap")
    blocks["Versions"] = {"jcr": calibration.version, "python": platform.python_version()}
    blocks["Versions"] |= {name: metadata.version(name) for name in packages if is_installed(name)}
    columns = []
    for title, rows in blocks.items():
        items = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in rows.items())
        columns.append(f"<div><h3>{escape(title)}</h3><dl>{items}</dl></div>")
    return f'<section id="details"><h2>Details</h2><div class="columns">{"".join(columns)}</div></section>'


def _plus_minus(std: list[float] | None, first: int) -> str:
    return "" if std is None else f" ± {significant(max(std[first : first + 2]))}"


def _robot(calibration: CalibrationFile) -> dict[str, str]:
    """What the poses tell of the robot itself."""
    items = {}
    if (errors := calibration.robot_errors) is not None and errors.p is not None:
        items["errors shared by neighbouring poses"] = (
            f"{errors.translation_mm:.2g} mm {errors.rotation_deg:.2g}° per axis (p = {errors.p:.2g})"
        )
        for k, joint in enumerate(errors.joints or [], start=1):
            items[f"joint {k} off by"] = f"{joint.offset_deg:+.3f} ± {joint.std_deg:.3f}°"
    if (angles := calibration.angle_ratio) is not None:
        items["camera angles over gripper angles"] = f"{angles.ratio:.4f} ± {angles.std:.4f} (1 is right)"
    return items


def _value(value: Any) -> str:
    if value is None:
        return "unset"
    return str(list(value) if isinstance(value, tuple) else value)
