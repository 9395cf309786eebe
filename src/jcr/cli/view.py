"""`jcr view`: a run in 3D, in the browser."""

import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Show a run in the browser: points, cameras, grippers, robot, the map's layers, a sphere to drag.

    The page is served until Ctrl-C, and only to this machine; from another one use
    ssh -L 8080:127.0.0.1:8080. Needs viser: pip install 'jcr-handeye[view]'.

    examples:
      jcr view out/table
      jcr view out/table --urdf arm.urdf --tip tool0
      jcr view out/table --urdf arm.urdf --joints joints.csv --port 9000
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    urdf: Path | None = None
    """The robot, shown at the pose of each image; its root link is the base of the gripper poses."""
    joints: Path | None = None
    """Its joint values (rad, m), one row per image: .csv or .npy. Unset: one inverse-kinematics solution that puts TIP
    at each gripper pose."""
    tip: Annotated[str | None, tyro.conf.arg(metavar="LINK")] = None
    """The URDF link whose poses the capture contains."""
    port: int = 8080
    """Port of 127.0.0.1 to listen on; 0 selects a free one."""
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Serve the page until Ctrl-C."""
    from jcr.errors import InputError
    from jcr.extras import extra
    from jcr.progress import progress_bars
    from jcr.run_folder import RunFolder

    if arguments.urdf is None and (arguments.joints or arguments.tip):
        raise InputError("--joints and --tip are of a robot; name its --urdf too")
    if arguments.urdf is not None and (arguments.joints is None) == (arguments.tip is None):
        raise InputError(
            "--urdf: give either --joints FILE, or --tip LINK, the link whose poses the capture has"
        )
    RunFolder(arguments.out).calibration()  # raises at once where there is none
    for package in ("viser", "matplotlib", "torch"):
        extra(package, "view", "jcr view")
    from jcr.viewer.robot import read_joints, read_urdf, solve_joints
    from jcr.viewer.run import read_run
    from jcr.viewer.server import open_server
    from jcr.viewer.viewer import Viewer

    run = read_run(arguments.out)
    robot = values = None
    if arguments.urdf is not None:
        robot = read_urdf(arguments.urdf)
        if arguments.joints is not None:
            values = read_joints(arguments.joints, robot, len(run.calibration.images))[run.gripper_image]
        elif arguments.tip is not None:
            values = solve_joints(robot, arguments.tip, run.base_from_gripper)
    server = open_server(arguments.port, f"jcr · {run.name}")
    try:
        with progress_bars() as progress:
            Viewer(server, run, robot, values, progress)
        address = f"http://127.0.0.1:{server.get_port()}"
        arguments.output.result(f"{address} (Ctrl-C ends it)\n", {"address": address})
        threading.Event().wait()
    except KeyboardInterrupt:
        return 0
    finally:
        server.stop()
    return 0
