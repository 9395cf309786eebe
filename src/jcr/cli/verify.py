"""`jcr verify`: has the camera moved since it was calibrated?"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from jcr.capture.options import ReadOptions
from jcr.cli.output import VerboseOutput
from jcr.cli.source import looked_at, with_images
from jcr.pipeline.verify import VerifyOptions

if TYPE_CHECKING:
    from jcr.pipeline.verify import Verification


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Test a calibration with new images: has the camera moved on the gripper since?

    OUT is the run folder of the calibration; its capture must still be at its old path. CAPTURE is a capture in any
    format with one or more new images of the same scene (two or three distinguish a moved camera from a moved table),
    or with five or more images of another scene. Fixed cameras of the run that CAPTURE names in `cameras` are tested
    too. The exit status is 3 if something has moved, or if the images cannot decide.

    examples:
      jcr verify out/table captures/this-morning
      jcr verify out/table captures/this-morning --tolerance 1 0.1 --json
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of the run that calibrated the camera."""
    capture: Annotated[Path, tyro.conf.Positional]
    """The new images and their poses: a capture folder, or another format (jcr docs captures)."""
    read: ReadOptions = field(default_factory=ReadOptions)
    verify: VerifyOptions = field(default_factory=VerifyOptions)
    output: VerboseOutput = field(default_factory=VerboseOutput)


def main(arguments: Arguments) -> int:
    """Verify and print what to do."""
    from jcr.pipeline.verify import verify_run
    from jcr.progress import progress_bars

    with (
        progress_bars() as progress,
        looked_at(arguments.capture, arguments.read, progress, at_least=1) as new,
    ):
        capture = with_images(new, arguments.capture, "which verify needs")
        found = verify_run(arguments.out, capture, arguments.verify, progress)
    cameras = (found, *found.others)
    facts = _as_json(found) | {"cameras": {one.fixed: _as_json(one) for one in found.others}}
    lines = [line for one in cameras for line in _as_lines(one, arguments.output.verbose)]
    arguments.output.result("\n".join(lines) + "\n", facts)
    return 3 if any(one.moved for one in cameras) else 0


def _as_lines(found: "Verification", verbose: bool) -> list[str]:
    """Return the verdict on one camera, the remedy, the drift with its standard deviation, and warnings."""
    from jcr.calibration.words import labelled

    drift = f"{1e3 * found.drift_m:.2f} mm, {np.degrees(found.drift_rad):.3f}° from the calibration"
    offset, std = _spaced(1e3 * found.offset[:3], 2), _spaced(1e3 * found.std[:3], 2)
    angle, angle_std = _spaced(np.degrees(found.offset[3:]), 3), _spaced(np.degrees(found.std[3:]), 3)
    parent = "gripper" if found.fixed is None else "base"
    noticed = f"{1e3 * found.detectable[0]:.1f} mm or {np.degrees(found.detectable[1]):.2f}°"
    lines = [
        f"{found.verdict.upper()}: {found.finding}, {drift}",
        *(labelled("Remedy", found.advice) if found.moved else ()),
        *labelled("Drift", f"{offset} ± {std} mm, {angle} ± {angle_std}° (1σ, {parent} axes)"),
        *labelled("Images", f"{len(found.images)}, {found.how}; 9 of 10 drifts of {noticed} are noticed"),
        *(line for note in found.notes for line in labelled("WARNING", note)),
    ]
    return [*lines, f"p = {found.p_value:.2g}"] if verbose else lines


def _spaced(values: np.ndarray, digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)


def _as_json(found: "Verification") -> dict[str, object]:
    return {
        "verdict": found.verdict,
        "moved": found.moved,
        "cause": found.cause if found.moved else None,
        "drift_mm": (1e3 * found.offset[:3]).tolist(),
        "drift_deg": np.degrees(found.offset[3:]).tolist(),
        "drift_std_mm": (1e3 * found.std[:3]).tolist(),
        "drift_std_deg": np.degrees(found.std[3:]).tolist(),
        "p_value": found.p_value,
        "detectable_mm": 1e3 * found.detectable[0],
        "detectable_deg": float(np.degrees(found.detectable[1])),
        "images": list(found.images),
        "notes": list(found.notes),
        "how": found.how,
    }
