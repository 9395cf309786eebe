"""`jcr compare`: how far apart two calibrations are."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Float
from numpy import ndarray


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
    json: bool = False
    """Print the result as JSON."""


def main(arguments: Arguments) -> int:
    """Print the difference, and how many of the calibration's own sigmas it is where they are known."""
    from jcr.geometry import rotation_between_deg, rotation_log

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
        error = np.concatenate([offset, rotation_log(reference[:3, :3] @ ours[:3, :3].T)])
        sigmas = (np.abs(error) / np.sqrt(np.diag(covariance)[:6])).tolist()
        result["sigmas"] = sigmas
        text += f"; at most {max(sigmas):.1f} of its reported standard deviations on any axis"
    sys.stdout.write((json.dumps(result) if arguments.json else text) + "\n")
    return 0


def read_hand_eye(path: Path) -> tuple[Float[ndarray, "4 4"], Float[ndarray, "7 7"] | None]:
    """gripper_from_camera, and its covariance where the file has one; InputError where there is neither."""
    from jcr.capture.read import read_json
    from jcr.errors import InputError
    from jcr.geometry import require_rigid

    file = path
    if path.is_dir():
        names = ("calibration.json", "reference.json")
        file = next((path / name for name in names if (path / name).is_file()), path / names[0])
    if not file.is_file():
        raise InputError(f"{path}: no calibration.json or reference.json there; name a run folder or a file")
    content = read_json(file)
    matrix = content.get("gripper_from_camera") if isinstance(content, dict) else None
    if matrix is None:
        raise InputError(f"{file}: has no gripper_from_camera; the calibration it is from found none")
    try:
        transform = require_rigid(
            np.array(matrix, dtype=np.float64).reshape(4, 4), f"{file}: gripper_from_camera"
        )
    except (TypeError, ValueError) as error:
        raise InputError(str(error) if isinstance(error, InputError) else f"{file}: no 4x4 matrix") from None
    uncertainty = content.get("uncertainty")
    covariance = None if not uncertainty else np.array(uncertainty["covariance"], dtype=np.float64)
    return transform, covariance
