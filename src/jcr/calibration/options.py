"""Options of a calibration, in a module that the command line's help imports without SciPy."""

from dataclasses import dataclass
from math import inf, isfinite, radians
from typing import Annotated, Literal

import tyro

from jcr.errors import InputError

GRASPING = (5.0, 1.0)
"""Default of the required accuracy (mm, degrees): a parallel gripper that opens 10 mm wider than its object has 5 mm to
either side, and one degree moves the tip of a 100 mm finger by 2 mm."""
RequiredAccuracy = Annotated[tuple[float, float] | Literal["none"], tyro.conf.arg(metavar="MM DEG|none")]
"""Option of a required accuracy (mm, degrees), or that none is required."""


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions:
    """Required accuracy, checks and priors of a hand-eye calibration."""

    require: RequiredAccuracy = GRASPING
    """Required bound on 95 % of the errors of a point at the image centre, at the working distance. If it is missed, the
    verdict is "accepted, but not as exact as needed" and the exit status 3. 5 mm and 1° are enough for grasping. With
    none, every sound calibration is accepted."""
    robot_noise: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="MM DEG")] = None
    """Least noise (1 sigma per axis) of the gripper poses; the estimated noise may be larger."""
    scale: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Metres per unit of the camera poses of samples, known to 0.2 %. By default 1 for a marker of known size; otherwise
    it is estimated."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="ARM")] = None
    """Name of the arm (see `jcr capture --help`), to model its joint offsets and link errors. By default the arm
    that the capture names, if any."""
    known_height: Annotated[float | None, tyro.conf.arg(metavar="MM")] = None
    """Height of the camera above the gripper's origin along the rotation axis, for planar or SCARA arms."""

    @property
    def robot_noise_m_rad(self) -> tuple[float, float] | None:
        """Option `robot_noise` in metres and radians; None if it is not set."""
        return None if self.robot_noise is None else (self.robot_noise[0] / 1e3, radians(self.robot_noise[1]))


def check_options(options: CalibrateOptions) -> None:
    """Raise InputError if a number of the options is out of range or the name of the arm is unknown."""
    from jcr.estimation.arms import arm_named

    required = None if options.require == "none" else options.require
    for flag, pair in (("require", required), ("robot_noise", options.robot_noise)):
        if pair is not None and not all(0 < value < inf for value in pair):
            raise InputError(f"{flag} {pair[0]:g} {pair[1]:g}: give two positive numbers, mm and degrees")
    if options.scale is not None and not 0 < options.scale < inf:
        raise InputError(f"scale {options.scale:g}: give a positive number, metres per unit")
    if options.known_height is not None and not isfinite(options.known_height):
        raise InputError(f"known_height {options.known_height:g}: give millimetres")
    if options.robot is not None:
        arm_named(options.robot)
