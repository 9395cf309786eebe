"""`jcr compare`: how far apart two calibrations are."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from jcr.cli.output import Output

UNLIKELY = 1e-3
"""Of a difference that the reported errors explain."""


@dataclass(frozen=True)
class Arguments:
    """Compare two calibrations: their difference in mm and degrees, and whether their covariances explain it.

    Each is a run folder, a calibration.json, or any JSON with a `gripper_from_camera` (a capture's reference.json, or
    the folder that holds one; with `std_mm` and `std_deg` if its errors are known). χ² is the squared difference in
    units of both covariances, p the probability of a larger one if nothing else is wrong. For two calibrations of one
    arm p is too large, because they share systematic errors. The exit status is 3 if one of the two is rejected.

    examples:
      jcr compare out/tabletop examples/tabletop
      jcr compare out/today out/yesterday --json
    """

    out: Annotated[Path, tyro.conf.Positional]
    """The calibration to compare."""
    reference: Annotated[Path, tyro.conf.Positional]
    """The calibration to compare it with."""
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Print the difference, χ² and p where standard deviations are known, and what explains it."""
    from jcr.calibration.difference import difference
    from jcr.calibration.known_transform import read_hand_eye
    from jcr.errors import RejectedError

    known = {path: read_hand_eye(path) for path in (arguments.out, arguments.reference)}
    found = difference(known[arguments.out], known[arguments.reference])
    result: dict[str, object] = {
        "translation_mm": 1e3 * float(np.linalg.norm(found.translation_m)),
        "rotation_deg": float(np.degrees(np.linalg.norm(found.rotation_vector))),
        "translation_xyz_mm": (1e3 * found.translation_m).tolist(),
        "rejected": {str(path): one.doubt for path, one in known.items() if one.doubt is not None},
    }
    text = f"{result['translation_mm']:.3f} mm, {result['rotation_deg']:.4f}°"
    if found.sigmas is not None:
        result |= {"sigmas": found.sigmas.tolist(), "chi2": found.chi2, "p": found.p_value}
        result["explained_by"] = found.explained_by
        text += (
            f"; at most {found.sigmas.max():.1f} of the reported standard deviations on any axis; "
            f"χ² {found.chi2:.1f} of 6, p = {found.p_value:.2g}"
        )
        if len(found.explained_by) > 1:
            shares = [
                f"{name.replace('_', ' ')} {100 * share:.0f} %" for name, share in found.explained_by.items()
            ]
            text += f"\nwould be explained by: {', '.join(shares)}"
        if found.p_value is not None and found.p_value < UNLIKELY:
            text += "\nmore than what both report: something has moved, or is not in their errors"
    arguments.output.result(text + "\n", result)
    for path, one in known.items():
        if one.doubt is not None:
            raise RejectedError(f"{path}: its calibration is rejected: {one.doubt}")
    return 0
