"""How a calibration is found; apart from the stage, so that the command line's help need not import SciPy."""

from dataclasses import dataclass
from math import inf, isfinite
from typing import Annotated, Literal

import tyro

from jcr.errors import InputError


@dataclass(frozen=True)
class CalibrateOptions:
    """How the hand-eye calibration is found."""

    require: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="MM DEG")] = None
    """How exact the camera on the gripper must be known: 95 % of errors smaller than this, else exit status 3. Unset:
    5 mm and 1°, enough to grasp with, and a calibration that is less exact gives a warning."""
    require_at: Literal["camera", "scene"] = "camera"
    """Where the millimetres of --require count: scene is what the camera looks at, where rotation moves it too."""
    robot_noise: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="MM DEG")] = None
    """One-sigma noise of the gripper poses per axis, at least; the data may say more."""
    scale: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Samples: metres per unit of the camera poses, known to 0.2 %; unset: 1 for a marker of known size, else found."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="ARM")] = None
    """Name of the arm (see `jcr simulate --help`), whose joint offsets and link errors then count as such; else the one
    that the capture names."""
    known_height: Annotated[float | None, tyro.conf.arg(metavar="MM")] = None
    """Planar or SCARA arms: the camera's height above the gripper's origin along its rotation axis."""
    known_length: Annotated[
        tuple[str, float, float, float, float, float] | None, tyro.conf.arg(metavar="IMAGE X1 Y1 X2 Y2 MM")
    ] = None
    """A length that gives a lost scale: two pixels of one image, and their distance."""
    focus: Literal["fixed", "varies"] = "fixed"
    """varies: a focal length for each image, of a camera whose focus moved while the images were taken."""
    bundle_adjustment: Annotated[
        bool, tyro.conf.arg(help="Use the camera poses alone; skip the refinement by image points.")
    ] = True
    """Refine by the points that images share."""


def check_options(options: CalibrateOptions) -> None:
    """InputError, before any work, where a number or a name is none that can be."""
    from jcr.handeye.arms import arm_named

    for flag, pair in (("--require", options.require), ("--robot-noise", options.robot_noise)):
        if pair is not None and not all(0 < value < inf for value in pair):
            raise InputError(f"{flag} {pair[0]:g} {pair[1]:g}: give two positive numbers, mm and degrees")
    if options.scale is not None and not 0 < options.scale < inf:
        raise InputError(f"--scale {options.scale:g}: give a positive number, metres per unit")
    if options.known_height is not None and not isfinite(options.known_height):
        raise InputError(f"--known-height {options.known_height:g}: give millimetres")
    if options.robot is not None:
        arm_named(options.robot)
