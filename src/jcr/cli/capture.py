"""`jcr capture`: takes a capture live, image by image, with advice on the next pose."""

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jcr.capture.options import ConventionName, UnitsName
from jcr.cli.output import Output
from jcr.handeye.arms import CHOICES, ROBOT_NAMES, RobotName
from jcr.live.camera import CameraOptions
from jcr.live.collect import CollectOptions

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jcr.live.arm_words import ArmWords
    from jcr.live.asks import Answer, Ask
    from jcr.live.folder import LiveFolder


@dataclass(frozen=True)
class Arguments:
    """Take a capture live, with a camera and the gripper poses of a robot, and see what is still missing.

    An image is taken when the arm rests, and kept if it is sharp and nothing moves; OUT/live.html shows the images,
    what they cover and the pose that would help most. After Ctrl-C the same command resumes.

    examples:
      jcr capture captures/table --camera 0 --poses ur:192.168.0.2 --robot ur5e
      jcr capture captures/table --camera realsense --poses franka:172.16.0.2
      jcr capture captures/table --camera 2 --camera-size 1920 1080 --focus 30 --poses xarm:192.168.1.203
      jcr capture captures/table --camera rtsp://192.168.0.9/stream --poses tcp
      jcr capture captures/table --camera 0 --poses typed --pose-convention kuka --pose-units mm-deg
      JCR_TOKEN=secret jcr capture captures/table --camera 0 --listen 0.0.0.0:7464
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture; an unfinished capture is continued."""
    camera: Annotated[str, tyro.conf.arg(metavar="DEVICE")] = "0"
    """V4L2 device number, realsense[:SERIAL], URL of a stream (rtsp://…), or a recording (video file, .bag)."""
    optics: CameraOptions = field(default_factory=CameraOptions)
    poses: Annotated[str, tyro.conf.arg(metavar="SOURCE")] = "tcp"
    """Where gripper poses come from: ur:HOST[:PORT] (Universal Robots), franka:HOST, xarm:HOST, typed (by hand),
    or tcp (a program sends them, jcr docs capture)."""
    pose_convention: ConventionName = "auto"
    """Notation of typed poses and of the printed next pose; auto: the arm's own."""
    pose_units: UnitsName = "auto"
    """Units of typed and printed poses; auto: those of the convention."""
    robot: Annotated[RobotName | None, tyro.conf.arg(metavar=CHOICES)] = None
    """The arm: the next pose is then also printed as joint angles, within the arm's limits."""
    listen: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")] = "127.0.0.1:7464"
    """With tcp: address and port to listen on; any but a loopback address needs a token."""
    token: str | None = None
    """With tcp: the token that the client must send first; better set as JCR_TOKEN, which other users cannot see."""
    timeout: Annotated[float, tyro.conf.arg(metavar="S")] = 600.0
    """With tcp: stop after this many seconds without a pose."""
    intrinsics_from: Path | None = None
    """JSON file with the camera's "intrinsics" (a capture.json or calibration.json); unset: those stored in the camera
    (RealSense), otherwise estimated."""
    collect: CollectOptions = field(default_factory=CollectOptions)
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Collect until there are enough images."""
    from jcr.live.collect import collect
    from jcr.live.devices import opened
    from jcr.live.folder import LiveFolder

    answers: list[Answer] = []

    def tell(answer: "Answer", lines: list[str]) -> None:
        answers.append(answer)
        _say("\n".join(lines))

    lens = _lens(arguments.intrinsics_from)
    with opened(arguments.camera, arguments.optics) as camera:
        live = LiveFolder(arguments.out, lens or camera.intrinsics, arguments.robot)
        _say(f"{len(live.names)} images in {arguments.out}; watch {arguments.out / 'live.html'} in a browser")
        collect(live, camera, _asks(arguments), arguments.collect, tell, _words(arguments, live))
    more = "" if len(live.names) >= 3 else "; three or more are needed, the same command resumes"
    arguments.output.result(
        f"{len(live.names)} images in {arguments.out}{more}; next: jcr check {arguments.out}\n",
        {"capture": str(arguments.out), "images": live.names, "answers": answers},
    )
    return 0


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


def _asks(arguments: Arguments) -> "Iterator[Ask]":
    from jcr.errors import InputError
    from jcr.live import franka, ur, xarm
    from jcr.live.line_server import Listen, bound, served_poses
    from jcr.live.rest import asks_at_rest
    from jcr.live.typed import typed_poses

    kind, _, address = arguments.poses.partition(":")
    if kind == "typed" and not address:
        yield from typed_poses(sys.stdin, _say, arguments.pose_convention, arguments.pose_units)
    elif kind == "tcp" and not address:
        host, port = _address(arguments.listen, 7464, "--listen ")
        token = arguments.token or os.environ.get("JCR_TOKEN")
        listen = Listen(host, port, token, arguments.timeout)
        with bound(listen) as server:
            _say("waiting for poses on {}:{}".format(*server.getsockname()[:2]))
            yield from served_poses(server, listen)
    elif kind in _SPOKEN and address:
        _say(f"move the arm; an image is taken whenever it rests ({address})")
        if kind == "ur":
            host, port = _address(address, 30003, "--poses ur:")
            yield from asks_at_rest(lambda: ur.states(host, port))
        else:
            module = franka if kind == "franka" else xarm
            yield from asks_at_rest(lambda: module.states(address))
    else:
        raise InputError(f"--poses {arguments.poses}: give ur:HOST, franka:HOST, xarm:HOST, typed or tcp")


_SPOKEN: dict[str, ConventionName] = {"ur": "ur", "franka": "franka", "xarm": "xarm"}
"""How the arms' own pendants and programs write poses."""


def _words(arguments: Arguments, live: "LiveFolder") -> "ArmWords":
    from jcr.handeye.arms import arm_named
    from jcr.live.arm_words import ArmWords

    convention = arguments.pose_convention
    if convention == "auto":
        convention = _SPOKEN.get(arguments.poses.partition(":")[0], "auto")
    name = live.rest.get("robot")
    arm = arm_named(name) if name in ROBOT_NAMES else None
    return ArmWords(convention, arguments.pose_units, arm)


def _address(text: str, port: int, option: str) -> tuple[str, int]:
    from jcr.errors import InputError

    host, _, number = text.rpartition(":") if ":" in text else (text, "", str(port))
    if not host or not number.isdigit() or not int(number) < 65536:
        raise InputError(f"{option}{text}: no address; write HOST:PORT such as 127.0.0.1:{port}")
    return host, int(number)


def _lens(file: Path | None) -> dict[str, Any] | None:
    from jcr.capture.plain_files import read_json
    from jcr.errors import InputError

    if file is None:
        return None
    content = read_json(file)
    lens = content.get("intrinsics") if isinstance(content, dict) else None
    if not isinstance(lens, dict):
        raise InputError(f'--intrinsics-from {file}: holds no "intrinsics"; name a capture.json with some')
    return {key: lens[key] for key in ("model", "fx", "fy", "cx", "cy", "distortion") if key in lens}
