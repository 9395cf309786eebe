"""report.html: one file that says whether to trust a calibration, hands it over, and shows what was found."""

import platform
from collections.abc import Mapping, Sequence
from html import escape
from importlib import metadata
from typing import Any

from jcr.calibration.calibration_json import CalibrationFile
from jcr.calibration.words import attempt_in_words, budget_in_words, missed, pixels
from jcr.extras import is_installed
from jcr.geometry import Transforms, scale_translation
from jcr.records import COEFFICIENTS, Capture
from jcr.report.cell_cameras import cameras_section
from jcr.report.figures import ABOVE, OBLIQUE, camera_figure
from jcr.report.map_pictures import map_section
from jcr.report.map_samples import sample_surface
from jcr.report.markup import PAGE, filled
from jcr.report.motion import motion_section
from jcr.report.object_table import objects_section
from jcr.report.pictures import images_section, thumbnails
from jcr.report.residual_bars import residuals_section
from jcr.report.scene3d import scene_section
from jcr.report.transform import transform_section
from jcr.results import RunResult
from jcr.rounding import significant

SURFACE_POINTS = 80_000
"""Sampled from the map, at most."""

Options = Mapping[str, Mapping[str, Any]]
"""A stage's name, and its options by name."""


def report_html(result: RunResult, options: Options | None = None) -> str:
    """The report of a run, made with these options, as one HTML page that loads nothing else.

    Sections whose record a run does not have are left out. Raises InputError when an image of the capture has
    become unreadable.
    """
    calibration, hand_eye = result.calibration, result.hand_eye
    if result.capture.mount == "base":
        sections = [
            _verdict(calibration),
            _tiles(calibration),
            _warnings(calibration),
            transform_section(hand_eye, "base"),
            images_section(result),
            residuals_section(result),
            _details(calibration, options or {}),
        ]
        return _page(result.capture, calibration, sections)
    base_from_camera = hand_eye.base_from_recon @ scale_translation(
        result.reconstruction.recon_from_camera, hand_eye.scale
    )
    surface = None if result.scene is None else sample_surface(result.scene, SURFACE_POINTS)
    sections = [
        _verdict(calibration),
        _tiles(calibration),
        _warnings(calibration),
        transform_section(hand_eye),
        "" if result.cameras is None else cameras_section(result.cameras),
        scene_section(result, base_from_camera, surface),
        images_section(result),
        residuals_section(result),
        motion_section(result),
        filled("before_after.html", panels=_before_after(result, base_from_camera)),
        ""
        if result.scene is None or surface is None
        else map_section(result, result.scene, surface, base_from_camera),
        ""
        if result.scene is None or result.measured is None
        else objects_section(result.measured, result.scene.label_names),
        _details(calibration, options or {}, {} if result.scene is None else result.scene.history),
    ]
    return _page(result.capture, calibration, sections)


def failed_report_html(capture: Capture, calibration: CalibrationFile, options: Options | None = None) -> str:
    """The report of a run that found no camera poses: why, with the cure, and the images."""
    reason = escape(calibration.doubt or "")
    verdict = f"<h2><b>No calibration:</b> {reason}.</h2><p>Nothing was calibrated and nothing mapped.</p>"
    cards = "".join(
        f'<figure><img src="{url}" alt="{escape(name)}"><figcaption><span class="file">{escape(name)}</span>'
        "</figcaption></figure>"
        for name, url in zip(capture.images, thumbnails(capture, capture.intrinsics), strict=True)
    )
    say = "What the camera saw. Without texture, overlap or light no features are found in them."
    sections = [
        f'<section class="verdict bad">{verdict}</section>',
        filled("images.html", say=say, about="", cards=cards),
        _details(calibration, options or {}),
    ]
    return _page(capture, calibration, sections)


def _page(capture: Capture, calibration: CalibrationFile, sections: Sequence[str]) -> str:
    return filled(
        "page.html",
        name=escape(capture.folder.resolve().name),
        about=f"{len(capture)} images · back end {escape(calibration.backend)} · jcr {calibration.version}",
        style=(PAGE / "page.css").read_text(),
        sections="\n".join(sections),
        scene3d=(PAGE / "scene3d.js").read_text(),
        copy=(PAGE / "copy.js").read_text(),
    )


def _verdict(calibration: CalibrationFile) -> str:
    held_out, uncertainty = calibration.held_out, calibration.uncertainty
    miss = "" if held_out is None else missed(held_out)
    if calibration.doubt is not None:
        headline = f"<b>Do not trust this calibration:</b> {escape(calibration.doubt)}."
    elif miss:
        headline = f"<b>Trusted:</b> images left out of the calibration are predicted to {miss} on average."
    else:
        headline = "<b>Trusted</b> by its own account: nothing speaks against it, nor could a held-out image."
    if held_out is None:
        believe = "There were too few images to leave one out and see how well the others predict it."
    elif not calibration.observability.observable:
        # An error along a direction that no motion shows changes no prediction.
        believe = f"Its held-out error of {miss} is no comfort: what no motion shows, no image can miss."
    elif not calibration.converged:
        believe = f"Its held-out error of {miss} is no comfort: what is wrong with all images, none of them can miss."
    else:
        believe = (
            f"Held-out error, the number to believe: {miss} ({escape(held_out.how)}). The residuals of a fit "
            "shrink with few images even where it is wrong."
        )
    if uncertainty is not None:
        believe += f" Least certain is the offset {escape(uncertainty.worst)} (one σ)."
    kind = "good" if calibration.converged else "bad"
    return f'<section class="verdict {kind}"><h2>{headline}</h2><p>{believe}</p></section>'


def _tiles(calibration: CalibrationFile) -> str:
    tiles = []
    if (held_out := calibration.held_out) is not None:
        degrees = f"{significant(held_out.rotation_deg)}°{pixels(held_out).replace(', ', ' · ')}"
        tiles.append(("Held-out error", f"{significant(held_out.translation_mm)} mm", degrees))
    if (uncertainty := calibration.uncertainty) is not None:
        direction, _, size = uncertainty.worst.partition(": ")
        worst_deg = significant(max(uncertainty.rotation_std_deg))
        tiles.append(("Offset, 1 σ", size, f"at worst, {direction}"))
        tiles.append(("Orientation, 1 σ", f"±{worst_deg}°", "at worst, about gripper axes"))
        if calibration.scale is not None:
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
        tiles.append(("Robot's noise, 1 σ", f"{significant(noise.translation_mm)} mm", degrees))
    cells = [
        f'<div class="tile"><div class="name">{name}</div><div class="number">{escape(number)}</div>'
        f'<div class="more">{escape(more)}</div></div>'
        for name, number, more in tiles
    ]
    return f'<div class="tiles">{"".join(cells)}</div>'


def _warnings(calibration: CalibrationFile) -> str:
    # What the verdict already says is not said twice.
    if not calibration.remarks:
        return ""
    items = "".join(f"<li>{escape(remark)}</li>" for remark in calibration.remarks)
    return f'<section class="warnings"><h2>Good to know</h2><ul>{items}</ul></section>'


def _before_after(result: RunResult, base_from_camera: Transforms) -> str:
    grippers, lens = result.capture.base_from_gripper, result.lens
    before, rows = result.reconstruction.recon_from_camera, result.reconstruction.image_index
    return "".join(
        [
            camera_figure("Before: own frame and unit", grippers, before, None, lens, OBLIQUE),
            camera_figure("After calibration and rescaling", grippers, base_from_camera, rows, lens, OBLIQUE),
            camera_figure("Before, from above", grippers, before, None, lens, ABOVE),
            camera_figure("After, from above", grippers, base_from_camera, rows, lens, ABOVE),
        ]
    )


def _details(
    calibration: CalibrationFile, options: Options, map_history: Mapping[str, str] | None = None
) -> str:
    timings = calibration.timings_s
    blocks = {"Time": {stage: f"{seconds:.1f} s" for stage, seconds in timings.items()}}
    blocks["Time"]["together"] = f"{sum(timings.values()):.1f} s"
    for k, attempt in enumerate(calibration.attempts, start=1):
        blocks["Time"][f"attempt {k}"] = attempt_in_words(attempt, len(calibration.images))
    if (lens := calibration.intrinsics) is not None:
        blocks["Lens"] = {
            "size": f"{lens.width} × {lens.height} px",
            "focal length": f"{lens.fx:.2f}, {lens.fy:.2f}{_plus_minus(lens.std, 0)} px",
            "principal point": f"{lens.cx:.2f}, {lens.cy:.2f}{_plus_minus(lens.std, 2)} px",
            " ".join(COEFFICIENTS[lens.model]): ", ".join(f"{k:.5g}" for k in lens.distortion),
        }
    if (uncertainty := calibration.uncertainty) is not None and uncertainty.budget is not None:
        blocks["Uncertainty, 1 σ per axis"] = budget_in_words(uncertainty.budget)
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
        items["poses near each other err alike"] = (
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
