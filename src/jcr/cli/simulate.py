"""`jcr simulate`: a simulated capture with ground truth."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.cli.output import Output
from jcr.simulate.capture import SimulateOptions, simulate


@dataclass(frozen=True)
class Arguments:
    """A capture of a simulated tabletop, rendered with MuJoCo, with the truth beside it.

    OUT holds capture.json and images/ as any capture does, reference.json (the true hand-eye transform; of a robot
    with errors the effective one, and the physical one beside it) and truth/ (scene.json: heights, boxes, poses;
    robot.json: the robot's errors; depth and labels per image).

    examples:
      jcr simulate captures/simulated
      jcr simulate captures/noisy --seed 3 --robot-noise 0.5 0.1
      jcr simulate captures/measuring --scene measuring --images 10
      jcr simulate captures/orbit --pattern orbit --unknown-intrinsics
      jcr simulate captures/bent --robot ur5e --joint-offsets 0.1 --link-errors 0.3 --intrinsics-error 0.5
    """

    out: Annotated[Path, tyro.conf.Positional]
    """New folder to write."""
    simulate: SimulateOptions = field(default_factory=SimulateOptions)
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Write the capture and print its path."""
    from jcr.progress import progress_bars

    with progress_bars() as progress:
        out = simulate(arguments.out, arguments.simulate, progress)
    arguments.output.result(f"capture: {out}\n", {"capture": str(out)})
    return 0
