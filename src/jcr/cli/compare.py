"""`jcr compare`: how far apart two calibrations are."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from jcr.cli.output import VerboseOutput

if TYPE_CHECKING:
    from jcr.calibration.difference import Difference

UNLIKELY = 1e-3
"""Largest p-value of a difference that the reported errors do not explain."""


@dataclass(frozen=True)
class Arguments:
    """Compare two calibrations: their difference in mm and degrees, and whether their covariances explain it.

    Each is a run folder, a calibration.json, or any JSON with a `gripper_from_camera` (a capture's reference.json, or
    the folder that holds one; with `std_mm` and `std_deg` if its errors are known). With --verbose: χ², the squared
    difference in units of both covariances, and p, the probability of a larger one if nothing else is wrong. For two
    calibrations of one arm p is too large, because they share systematic errors. The exit status is 3 if one of the
    two is rejected, or if the reported errors do not explain the difference.

    examples:
      jcr compare out/tabletop examples/tabletop
      jcr compare out/today out/yesterday --json
    """

    out: Annotated[Path, tyro.conf.Positional]
    """The calibration to compare."""
    reference: Annotated[Path, tyro.conf.Positional]
    """The calibration to compare it with."""
    output: VerboseOutput = field(default_factory=VerboseOutput)


def main(arguments: Arguments) -> int:
    """Print the difference, whether the reported errors explain it, and the causes that would."""
    from jcr.calibration.difference import difference, read_hand_eye

    known = {path: read_hand_eye(path) for path in (arguments.out, arguments.reference)}
    found = difference(known[arguments.out], known[arguments.reference])
    rejected = {str(path): one.doubt for path, one in known.items() if one.doubt is not None}
    facts: dict[str, object] = {
        "translation_mm": 1e3 * float(np.linalg.norm(found.translation_m)),
        "rotation_deg": float(np.degrees(np.linalg.norm(found.rotation_vector))),
        "translation_xyz_mm": (1e3 * found.translation_m).tolist(),
        "rejected": rejected,
    }
    if found.sigmas is not None:
        facts |= {"sigmas": found.sigmas.tolist(), "chi2": found.chi2, "p": found.p_value}
        facts["explained_by"] = found.explained_by
    is_contradiction = found.p_value is not None and found.p_value < UNLIKELY
    verdict = "REJECTED" if is_contradiction or rejected else "ACCEPTED"
    lines = _as_lines(found, rejected, is_contradiction, arguments.output.verbose)
    apart = f"{facts['translation_mm']:.3f} mm, {facts['rotation_deg']:.4f}° apart"
    arguments.output.result("\n".join([f"{verdict}: {apart}{lines[0]}", *lines[1:]]) + "\n", facts)
    return 3 if verdict == "REJECTED" else 0


def _as_lines(
    found: "Difference", rejected: dict[str, str], is_contradiction: bool, verbose: bool
) -> list[str]:
    """Return the end of the verdict's line, and the lines after it."""
    from jcr.calibration.words import labelled

    offset = " ".join(f"{1e3 * value:.3f}" for value in found.translation_m)
    lines = [*labelled("Difference", f"{offset} mm (gripper axes)")]
    if found.sigmas is None:
        lines = ["; neither file states its errors", *lines]
    else:
        lines[0] += f"; at most {found.sigmas.max():.1f} of the reported standard deviations on any axis"
        explained = "; the reported errors explain it"
        if is_contradiction:
            explained = "; more than the reported errors explain"
            remedy = "find out what moved between the two, or which error they do not report"
            lines = [*labelled("Remedy", remedy), *lines]
        lines = [explained, *lines]
        shares = [
            f"{name.replace('_', ' ')} {100 * share:.0f} %" for name, share in found.explained_by.items()
        ]
        if len(shares) > 1:
            lines += labelled("Causes", f"would be {', '.join(shares)}")
        if verbose:
            lines.append(f"χ² {found.chi2:.1f} of 6, p = {found.p_value:.2g}")
    return [
        *lines,
        *(line for path, why in rejected.items() for line in labelled("Rejected", f"{path}: {why}")),
    ]
