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
      jcr view out/table --urdf arm.urdf --port 9000
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    urdf: Path | None = None
    """The robot, shown at the capture's joint values of each image; unset: the capture's URDF. Its root link is the
    base of the gripper poses."""
    port: int = 8080
    """Port of 127.0.0.1 to listen on; 0 selects a free one."""
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Serve the page until Ctrl-C."""
    from jcr.extras import extra
    from jcr.progress import progress_bars
    from jcr.run_folder import load_run

    run = load_run(arguments.out)  # raises at once where there is none
    for package in ("viser", "torch"):
        extra(package, "view", "jcr view")
    from jcr.viewer.server import open_server
    from jcr.viewer.viewer import Viewer

    server = open_server(arguments.port, f"jcr · {arguments.out.resolve().name}")
    try:
        with progress_bars() as progress:
            Viewer(server, run, arguments.urdf, progress)
        address = f"http://127.0.0.1:{server.get_port()}"
        arguments.output.result(f"{address} (Ctrl-C ends it)\n", {"address": address})
        threading.Event().wait()
    except KeyboardInterrupt:
        return 0
    finally:
        server.stop()
    return 0
