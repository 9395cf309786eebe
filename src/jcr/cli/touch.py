"""`jcr touch`: compares the map with points touched by the robot's tip."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.cli.output import Output


@dataclass(frozen=True)
class Arguments:
    """Measure the error in task space: touch points with a calibrated tip and compare them with the map.

    OUT is the folder of a run, POINTS a CSV with one line per point: image, x_px, y_px (the pixel of an image of the
    run that shows the point) and x_m, y_m, z_m (the tip in the base frame when it touches the point). report.html shows
    the pixel under the pointer in an image that is opened large, and a click copies it as image,x_px,y_px. Use three or
    more points, spread over the scene; corners and printed marks are best. The exit status is 3 if the errors are larger
    than the reported uncertainty explains.

    examples:
      jcr touch out/table touched.csv
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    points: Annotated[Path, tyro.conf.Positional]
    """The touched points, .csv."""
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Print the verdict, then each error beside what was expected."""
    from jcr.calibration.words import labelled
    from jcr.pipeline.touch import UNLIKELY, touch

    found = touch(arguments.out, arguments.points)
    is_larger = found.p_value < UNLIKELY
    x, y, z = 1e3 * found.common
    verdict = "REJECTED: larger than" if is_larger else "ACCEPTED: within"
    lines = [
        f"{verdict} the reported uncertainty: {1e3 * found.rms:.2f} mm (rms), {1e3 * found.expected:.2f} mm expected"
    ]
    if is_larger:
        lines += labelled(
            "Remedy",
            "check the tip's calibration (a constant error), then calibrate the camera again (jcr run)",
        )
    lines += labelled("Mean", f"{x:+.2f} {y:+.2f} {z:+.2f} mm")
    lines += [
        f"{image}: {1e3 * error[0]:+.2f} {1e3 * error[1]:+.2f} {1e3 * error[2]:+.2f} mm "
        f"(± {1e3 * std[0]:.2f} {1e3 * std[1]:.2f} {1e3 * std[2]:.2f})"
        for image, error, std in zip(found.images, found.error, found.std, strict=True)
    ]
    facts = {
        "rms_mm": 1e3 * found.rms,
        "expected_mm": 1e3 * found.expected,
        "p": found.p_value,
        "mean_mm": (1e3 * found.common).tolist(),
        "points": [
            {"image": image, "error_mm": (1e3 * error).tolist(), "std_mm": (1e3 * std).tolist()}
            for image, error, std in zip(found.images, found.error, found.std, strict=True)
        ],
    }
    arguments.output.result("\n".join(lines) + "\n", facts)
    return 3 if is_larger else 0
