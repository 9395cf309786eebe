"""Records as HTML tables, which notebooks show."""

from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jcr.records.calibration import HandEye
    from jcr.records.capture import Capture


def table(heading: str, rows: Iterable[Sequence[str]], note: str = "") -> str:
    """A heading, rows whose first cell names them, and a note below; all of it text."""
    cells = "".join(
        f"<tr><th>{escape(name)}</th>{''.join(f'<td>{escape(cell)}</td>' for cell in others)}</tr>"
        for name, *others in rows
    )
    return f"<p><b>{escape(heading)}</b></p><table>{cells}</table><p>{escape(note)}</p>"


def hand_eye_table(hand_eye: "HandEye", note: str = "") -> str:
    """The transform with its standard deviations, the verdict and what warns."""
    from jcr.geometry import rotation_log  # SciPy, which help need not wait for

    std = np.sqrt(np.diag(hand_eye.covariance))
    mm = 1e3 * hand_eye.gripper_from_camera[:3, 3]
    degrees = np.degrees(rotation_log(hand_eye.gripper_from_camera[:3, :3]))
    used = f"{int(hand_eye.inliers.sum())} of {len(hand_eye.inliers)} poses used"
    rows = [("", "translation", "rotation vector")] + [
        (
            axis,
            f"{mm[k]:.2f} ± {1e3 * std[k]:.2f} mm",
            f"{degrees[k]:.3f} ± {np.degrees(std[3 + k]):.3f}°",
        )
        for k, axis in enumerate("xyz")
    ]
    verdict = ": ".join(filter(None, (hand_eye.verdict, "; ".join(hand_eye.warnings))))
    return table(f"gripper_from_camera, {verdict}; {used}", rows, f"1σ, gripper axes. {note}")


def capture_table(capture: "Capture") -> str:
    """Where a capture is, what was read of it, and what reading found."""
    width, height = capture.image_size
    centres = capture.base_from_gripper[:, :3, 3]
    camera = "to be estimated"
    if (given := capture.intrinsics) is not None:
        camera = (
            f"{given.model}, fx {given.fx:.1f}, fy {given.fy:.1f}, cx {given.cx:.1f}, cy {given.cy:.1f} px"
        )
    rows = [
        ("images", f"{len(capture)} of {width} x {height} px"),
        ("intrinsics", camera),
        ("gripper positions", " x ".join(f"{side:.3f}" for side in np.ptp(centres, axis=0)) + " m"),
        ("robot", capture.robot or str(capture.urdf or "not named")),
        ("joint angles", "none" if capture.joints is None else f"{capture.joints.shape[1]} a pose"),
        ("further cameras", ", ".join(camera.name for camera in capture.others) or "none"),
    ]
    return table(f"capture {capture.source or capture.folder}", rows, "; ".join(capture.notes))
