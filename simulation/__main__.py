"""Write a simulated capture with its ground truth: `python -m simulation OUT`, in a checkout."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.errors import InputError
from jcr.progress import progress_bars
from simulation.capture import SimulateOptions, simulate


@dataclass(frozen=True)
class Arguments:
    """A capture of a simulated tabletop, rendered with MuJoCo, with the ground truth beside it.

    OUT holds capture.json and images/ as any capture does, reference.json (the true hand-eye transform) and truth/
    (scene.json: heights, boxes, poses; depth and labels per image).

    examples:
      python -m simulation captures/simulated
      python -m simulation captures/noisy --seed 3 --robot-noise 0.5 0.1
      python -m simulation captures/measuring --scene measuring --images 10
      python -m simulation captures/uncalibrated --unknown-intrinsics
    """

    out: Annotated[Path, tyro.conf.Positional]
    """New folder to write."""
    simulate: Annotated[SimulateOptions, tyro.conf.arg(name="")] = field(default_factory=SimulateOptions)


def main() -> int:
    """Write the capture and return the exit status."""
    arguments = tyro.cli(Arguments, prog="python -m simulation")
    try:
        with progress_bars() as progress:
            simulate(arguments.out, arguments.simulate, progress)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
