"""`jcr compare`: how far apart two calibrations are."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from jcr.cli.output import Output


@dataclass(frozen=True)
class Arguments:
    """The difference of a calibration from a reference, in mm and degrees.

    Each is a run folder, a calibration.json, or any JSON with a `gripper_from_camera` (a capture's
    reference.json, or the folder that holds one).

    examples:
      jcr compare out/tabletop examples/tabletop
      jcr compare out/today out/yesterday --json
    """

    out: Annotated[Path, tyro.conf.Positional]
    """The calibration to judge."""
    reference: Annotated[Path, tyro.conf.Positional]
    """What to hold it against."""
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Print the difference, and how many of the calibration's own sigmas it is where they are known."""
    from jcr.calibration.calibration_json import read_hand_eye
    from jcr.geometry import rotation_between_deg, step_between

    ours, covariance = read_hand_eye(arguments.out)
    reference, _ = read_hand_eye(arguments.reference)
    offset = reference[:3, 3] - ours[:3, 3]
    result: dict[str, object] = {
        "translation_mm": 1e3 * float(np.linalg.norm(offset)),
        "rotation_deg": float(rotation_between_deg(ours[:3, :3], reference[:3, :3])),
        "translation_xyz_mm": (1e3 * offset).tolist(),
    }
    text = f"{result['translation_mm']:.3f} mm, {result['rotation_deg']:.4f}°"
    if covariance is not None:
        sigmas = (np.abs(step_between(ours, reference)) / np.sqrt(np.diag(covariance)[:6])).tolist()
        result["sigmas"] = sigmas
        text += f"; at most {max(sigmas):.1f} of its reported standard deviations on any axis"
    arguments.output.result(text + "\n", result)
    return 0
