"""Collapsed sections: cameras of the cell; measured objects; times, uncertainty budget, options and versions."""

import platform
from collections.abc import Mapping
from importlib import metadata
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.record import AnyCalibration
from jcr.calibration.words import attempt_in_words, budget_in_words
from jcr.cell.placement import CamerasFile, TransformUncertainty
from jcr.extras import is_installed
from jcr.findings.sentences import LENGTHS
from jcr.report.render import Section, label_colors
from jcr.rounding import significant, with_std
from jcr.segments.measure import Measurement

StageOptions = Mapping[str, Mapping[str, Any]]
"""Options by name, by the name of their stage."""
PACKAGES = ("numpy", "scipy", "torch", "pycolmap")


def details_section(
    calibration: AnyCalibration, options: StageOptions, map_history: Mapping[str, str] | None = None
) -> Section:
    """Return blocks of names and values."""
    times, uncertainty = calibration.timings_s, calibration.uncertainty
    budget = None if uncertainty is None else uncertainty.budget
    attempts = (
        [] if calibration.parent_from_camera is None else calibration.attempts
    )  # else the failure lists them
    lengths = {
        LENGTHS[
            one.name
        ]: f"{one.robot_longer_percent:+.2f} ± {significant(one.std_percent)} % longer by the robot's "
        f"positions, {'part of the scale' if one.used else 'not used'}"
        for one in calibration.lengths
    }
    depth, robot = {}, {}
    if (check := calibration.depth_check) is not None:
        depth["scale error, compared with the robot"] = (
            f"{check.off_percent:+.2f} ± {check.std_percent:.2g} %"
        )
        for z in check.distances_m:
            depth[f"noise at {z:.2f} m, 1 σ"] = f"{significant(1e3 * float(check.std_m(np.array(z))))} mm"
        depth["looked at"] = f"{check.features} features of {check.images} images"
    if (errors := calibration.robot_errors) is not None:
        shared = f"{errors.translation_mm:.2g} mm {errors.rotation_deg:.2g}° per axis"
        robot["errors shared by neighbouring poses"] = shared
        for k, joint in enumerate(errors.joints or [], start=1):
            robot[f"joint {k} off by"] = f"{joint.offset_deg:+.3f} ± {joint.std_deg:.3f}°"
    blocks: dict[str, Mapping[str, str]] = {
        "Time": {stage: f"{seconds:.1f} s" for stage, seconds in times.items()}
        | {"together": f"{sum(times.values()):.1f} s"}
        | {
            f"attempt {k}": attempt_in_words(one, len(calibration.images))
            for k, one in enumerate(attempts, start=1)
        },
        "Uncertainty, 1 σ per axis": {} if budget is None else budget_in_words(budget),
        "Lengths": lengths,
        "Depth camera": depth,
        "Robot": robot,
        "Board": _board(calibration),
        "Map": map_history or {},
    }
    for stage, chosen in options.items():
        blocks[f"Options: {stage}"] = {
            name: "unset" if value is None else str(list(value) if isinstance(value, tuple) else value)
            for name, value in chosen.items()
        }
    versions = {"jcr": calibration.version, "python": platform.python_version()}
    blocks["Versions"] = versions | {name: metadata.version(name) for name in PACKAGES if is_installed(name)}
    return Section("details", {"blocks": {title: rows for title, rows in blocks.items() if rows}})


def _board(calibration: AnyCalibration) -> dict[str, str]:
    """Return size, place and flatness of a board that took part beside features."""
    if (board := calibration.board) is None:
        return {}
    stated = f", {board.stated_mm:g} mm stated" if board.stated_mm else ""
    rows = {
        board.spec: f"{board.corners} corners in {board.images} images, {board.rms_px:.2f} px rms per axis",
        "side by the robot's positions": f"{with_std(board.side_mm, board.side_std_mm)} mm{stated}",
        "lowest to highest corner": f"{significant(board.bend_mm)} mm",
    }
    for k, (centre, tilt) in enumerate(zip(board.centres_in_base, board.tilts_deg, strict=True), start=1):
        name = f"place of tag {k}" if board.bodies > 1 else "place"
        at = ", ".join(f"{x:.3f}" for x in centre)
        rows[name] = f"({at}) m in the base, {tilt:.1f}° from horizontal"
    return rows


def objects_section(measured: Measurement, label_names: tuple[str, ...]) -> Section:
    """Return height and box of every object with one standard deviation, beside the colour of its label."""
    colors = label_colors(len(label_names)).tolist()
    rows = []
    for one in measured.objects:
        length, width, height = (
            f"{1e3 * value:.1f} ±\u00a0{1e3 * std:.1f}"
            for value, std in zip(one.box_size, one.box_std, strict=True)
        )
        if not one.top_seen:
            height = f"at least {1e3 * one.height:.1f}"
        x, y = one.base_from_box[:2, 3]
        rows.append((one.name, colors[one.label], (height, length, width, f"{x:.3f}, {y:.3f}")))
    return Section("objects", {"rows": rows, "noise": f"{1e3 * measured.support.noise:.1f}"})


def cameras_section(cameras: CamerasFile) -> Section:
    """Return a card for each camera, with its images, and for each arm."""
    cards = []
    for camera in cameras.cameras:
        arm = "" if camera.arm is None else f" of arm {camera.arm}"
        name = "base_from_camera" if camera.mount == "base" else f"gripper_from_camera{arm}"
        images = [
            (
                image.image,
                f"{image.points} points",
                "" if image.reprojection_px is None else f"{significant(image.reprojection_px)} px",
                image.reason or "used",
            )
            for image in camera.images
        ]
        about = {"rejected": camera.doubt is not None, "remarks": camera.warnings, "images": images}
        matrix = _matrix(camera.parent_from_camera, camera.uncertainty)
        cards.append({"title": f"{camera.name}: {name}", "name": name, **about, **matrix})
    for arm in cameras.arms:
        name, matrix = "base_from_other_base", _matrix(np.array(arm.base_from_other_base), arm.uncertainty)
        about = {"rejected": False, "remarks": (), "images": ()}
        cards.append({"title": f"arm {arm.name}: {name}", "name": name, **about, **matrix})
    return Section("cameras", {"cards": cards})


def _matrix(
    matrix: Float[ndarray, "4 4"] | None, uncertainty: TransformUncertainty | None
) -> dict[str, str | None]:
    """Return the matrix as text, to read and to copy, and its standard deviations; None without a transform."""
    if matrix is None or uncertainty is None:
        return {"matrix": None}
    return {
        "matrix": "\n".join("".join(f"{value:>10.6f}" for value in row)[1:] for row in matrix),
        "copied": str(matrix.round(9).tolist()),
        "std": uncertainty.in_words,
    }
