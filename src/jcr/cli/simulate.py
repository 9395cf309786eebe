"""`jcr simulate`: a simulated capture with ground truth."""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.simulate.capture import SimulateOptions, simulate


@dataclass(frozen=True)
class Arguments:
    """A capture of a simulated tabletop, rendered with MuJoCo, with the truth beside it.

    OUT holds capture.json and images/ as any capture does, reference.json (the true hand-eye) and truth/
    (scene.json: heights, boxes, poses; depth and labels per image).

    examples:
      jcr simulate captures/simulated
      jcr simulate captures/noisy --seed 3 --robot-noise 0.5 0.1
      jcr simulate captures/measuring --scene measuring --images 10
      jcr simulate captures/orbit --pattern orbit --unknown-intrinsics
    """

    out: Annotated[Path, tyro.conf.Positional]
    """New folder to write."""
    simulate: SimulateOptions = field(default_factory=SimulateOptions)
    json: bool = False
    """Print the result as JSON on stdout."""


def main(arguments: Arguments) -> int:
    """Write the capture and say where."""
    out = simulate(arguments.out, arguments.simulate)
    if arguments.json:
        sys.stdout.write(json.dumps({"capture": str(out)}) + "\n")
    else:
        sys.stderr.write(f"wrote {out}\n")
    return 0
