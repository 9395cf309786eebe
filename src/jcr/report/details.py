"""Section of details: times, intrinsics, uncertainty budget, options and versions."""

import platform
from collections.abc import Mapping
from importlib import metadata
from typing import Any

import numpy as np

from jcr.calibration.record import Calibration
from jcr.calibration.words import attempt_in_words, budget_in_words
from jcr.extras import is_installed
from jcr.findings.sentences import LENGTHS
from jcr.records import COEFFICIENTS, Reconstruction
from jcr.report.images import reprojections_px
from jcr.report.render import Section
from jcr.rounding import significant, with_std

StageOptions = Mapping[str, Mapping[str, Any]]
"""Options by name, by the name of their stage."""
CELLS = 16
"""Cells across the image in which coverage is counted."""
PACKAGES = ("numpy", "scipy", "torch", "pycolmap")


def details_section(
    calibration: Calibration,
    options: StageOptions,
    reconstruction: Reconstruction | None = None,
    map_history: Mapping[str, str] | None = None,
) -> Section:
    """Return blocks of names and values."""
    uncertainty = calibration.uncertainty
    budget = None if uncertainty is None else uncertainty.budget
    blocks: dict[str, Mapping[str, str]] = {
        "Time": _times(calibration),
        "Intrinsics": _intrinsics(calibration),
        "Uncertainty, 1 σ per axis": {} if budget is None else budget_in_words(budget),
        "Lengths": _lengths(calibration),
        "Depth camera": _depth_camera(calibration),
        "Robot": _robot(calibration),
        "Features": {} if reconstruction is None else _features(reconstruction),
        "Board": _board(calibration),
        "Map": map_history or {},
    }
    for stage, chosen in options.items():
        blocks[f"Options: {stage}"] = {name: _value(value) for name, value in chosen.items()}
    versions = {"jcr": calibration.version, "python": platform.python_version()}
    blocks["Versions"] = versions | {name: metadata.version(name) for name in PACKAGES if is_installed(name)}
    return Section("details", {"blocks": {title: rows for title, rows in blocks.items() if rows}})


def _times(calibration: Calibration) -> dict[str, str]:
    """Return the seconds of the stages and the attempts."""
    timings = calibration.timings_s
    rows = {stage: f"{seconds:.1f} s" for stage, seconds in timings.items()}
    rows["together"] = f"{sum(timings.values()):.1f} s"
    if calibration.parent_from_camera is not None:  # else the failure lists them
        for k, attempt in enumerate(calibration.attempts, start=1):
            rows[f"attempt {k}"] = attempt_in_words(attempt, len(calibration.images))
    return rows


def _intrinsics(calibration: Calibration) -> dict[str, str]:
    """Return the intrinsics with standard deviations; none where they are unknown."""
    if (found := calibration.intrinsics) is None:
        return {}
    return {
        "size": f"{found.width} × {found.height} px",
        "focal length": f"{found.fx:.2f}, {found.fy:.2f}{_plus_minus(found.std, 0)} px",
        "principal point": f"{found.cx:.2f}, {found.cy:.2f}{_plus_minus(found.std, 2)} px",
        " ".join(COEFFICIENTS[found.model]): ", ".join(f"{k:.5g}" for k in found.distortion),
    }


def _plus_minus(std: list[float] | None, first: int) -> str:
    """Return the larger of two standard deviations as text."""
    return "" if std is None else f" ± {significant(max(std[first : first + 2]))}"


def _depth_camera(calibration: Calibration) -> dict[str, str]:
    """Return scale error and noise of the depth camera."""
    if (check := calibration.depth_check) is None:
        return {}
    noise_mm = {z: significant(1e3 * float(check.std_m(np.array(z)))) for z in check.distances_m}
    return {
        "scale error, compared with the robot": f"{check.off_percent:+.2f} ± {check.std_percent:.2g} %",
        **{f"noise at {z:.2f} m, 1 σ": f"{value} mm" for z, value in noise_mm.items()},
        "looked at": f"{check.features} features of {check.images} images",
    }


def _lengths(calibration: Calibration) -> dict[str, str]:
    """Return the difference between each known length and the robot's positions."""
    return {
        LENGTHS[one.name]: (
            f"{one.robot_longer_percent:+.2f} ± {significant(one.std_percent)} % longer by the robot's positions, "
            f"{'part of the scale' if one.used else 'not used'}"
        )
        for one in calibration.lengths
    }


def _robot(calibration: Calibration) -> dict[str, str]:
    """Return systematic robot errors, joint offsets and the ratio of angles."""
    items = {}
    if (errors := calibration.robot_errors) is not None:
        items["errors shared by neighbouring poses"] = (
            f"{errors.translation_mm:.2g} mm {errors.rotation_deg:.2g}° per axis"
        )
        for k, joint in enumerate(errors.joints or [], start=1):
            items[f"joint {k} off by"] = f"{joint.offset_deg:+.3f} ± {joint.std_deg:.3f}°"
    return items


def _features(reconstruction: Reconstruction) -> dict[str, str]:
    """Return the number of tracked features, their coverage of the image and their reprojection error."""
    tracks, intrinsics = reconstruction.tracks, reconstruction.intrinsics
    if len(tracks.image) == 0:
        return {}
    side = intrinsics.width / CELLS
    rows = max(round(intrinsics.height / side), 1)
    column, row = ((tracks.x_px + 0.5) / [side, intrinsics.height / rows]).astype(int).T
    cells = np.unique(row.clip(0, rows - 1) * CELLS + column.clip(0, CELLS - 1))
    median = float(np.median(np.linalg.norm(reprojections_px(reconstruction), axis=1)))
    return {
        "observations": f"{len(tracks.image)} of {len(tracks.points_in_recon)} points",
        "coverage of the image": f"{100 * len(cells) / (rows * CELLS):.0f} % of the cells",
        "median reprojection error": f"{significant(median)} px",
    }


def _board(calibration: Calibration) -> dict[str, str]:
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


def _value(value: Any) -> str:
    """Return the value of an option as text."""
    if value is None:
        return "unset"
    return str(list(value) if isinstance(value, tuple) else value)
