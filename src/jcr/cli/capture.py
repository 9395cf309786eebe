"""`jcr capture`: takes a capture live, image by image, with advice on the next pose."""

import os
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jcr.capture.options import ConventionName, UnitsName
from jcr.cli.output import Output
from jcr.errors import InputError
from jcr.estimation.arms import CHOICES, ROBOT_NAMES, RobotName
from jcr.live.camera import CameraOptions
from jcr.live.collect import LEAST_IMAGES, CollectOptions

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jcr.live.arm_words import ArmWords
    from jcr.live.asks import Answer, Ask
    from jcr.live.calibration import LiveCalibration
    from jcr.live.collect import LiveCapture
    from jcr.live.folder import LiveFolder
    from jcr.live.rest import States
    from jcr.live.server import Listen, Server
    from jcr.results import RunResult


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Take a capture live, with a camera and the gripper poses of a robot, and see what is still missing.

    An image is taken when the arm rests, and kept if it is sharp and nothing moves. The calibration is made meanwhile:
    after each image it is printed how exact it is, what is wrong, and the pose that helps most. OUT/result is the
    calibration of all images. After Ctrl-C the same command resumes. The live page, whose address is printed, has
    buttons to take, retake and remove images, to undo that, and to finish; the same words can be typed.

    examples:
      jcr capture captures/table --camera 0 --poses ur:192.168.0.2 --robot ur5e
      jcr capture captures/table --camera 0 --poses ur:192.168.0.2 --require 2 0.3 --until-accurate
      jcr capture captures/table --camera realsense --poses franka:172.16.0.2
      jcr capture captures/table --camera 2 --camera-size 1920 1080 --focus 30 --poses xarm:192.168.1.203
      jcr capture captures/table --camera rtsp://192.168.0.9/stream --poses http --page-port 7464
      jcr capture captures/table --camera 0 --poses typed --pose-convention kuka --pose-units mm-deg
      JCR_TOKEN=secret jcr capture captures/table --camera 0 --listen 192.168.0.5:7464
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture; an unfinished capture is continued."""
    camera: Annotated[str, tyro.conf.arg(metavar="DEVICE")] = "0"
    """V4L2 device number, realsense[:SERIAL], URL of a stream (rtsp://…), or a recording (video file, .bag)."""
    optics: CameraOptions = field(default_factory=CameraOptions)
    poses: Annotated[str, tyro.conf.arg(metavar="SOURCE")] = "http"
    """Where gripper poses come from: ur:HOST[:PORT] (Universal Robots), franka:HOST, xarm:HOST, typed (by hand),
    or http (a program sends them, jcr docs capture)."""
    pose_convention: ConventionName = "auto"
    """Notation of typed poses and of the printed next pose; auto: the arm's own."""
    pose_units: UnitsName = "auto"
    """Units of typed and printed poses; auto: those of the convention."""
    robot: Annotated[RobotName | None, tyro.conf.arg(metavar=CHOICES)] = None
    """The arm: the next pose is then also printed as joint angles, within the arm's limits."""
    page_port: Annotated[int, tyro.conf.arg(metavar="PORT")] = 0
    """Port of the live page and of samples on this machine alone; 0: any free one."""
    listen: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    """Serve other machines too, at this address and under this host name only; needs a token."""
    token: str | None = None
    """Key of the session instead of a random one; better set as JCR_TOKEN, which other users cannot see."""
    timeout: Annotated[float, tyro.conf.arg(metavar="S")] = 600.0
    """With --poses http: stop after this many seconds without a pose."""
    intrinsics_from: Path | None = None
    """JSON file with the camera's "intrinsics" (a capture.json or calibration.json); unset: those stored in the camera
    (RealSense), otherwise estimated."""
    collect: CollectOptions = field(default_factory=CollectOptions)
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Collect until there are enough images, or the calibration is as accurate as required."""
    from jcr.live.collect import LiveCapture
    from jcr.live.devices import opened
    from jcr.live.folder import LiveFolder
    from jcr.live.server import Server
    from jcr.run_folder import locked

    options = arguments.collect
    if options.until_accurate and options.require is None:
        raise InputError("--until-accurate: needs --require MM DEG, the accuracy that is meant")
    _require_source(arguments.poses)
    listen = _listen(arguments)
    answers: list[Answer] = []

    def tell(answer: "Answer", lines: list[str]) -> None:
        answers.append(answer)
        _print("\n".join(lines))

    given = _intrinsics(arguments.intrinsics_from)
    with locked(arguments.out), opened(arguments.camera, arguments.optics) as camera:
        live = LiveFolder(arguments.out, given or camera.intrinsics, arguments.robot)
        calibration, states = _calibration(live, options), _states(arguments)
        gripper = None if states is None else lambda: next(states())
        capture = LiveCapture(calibration, camera, options, tell, _words(arguments, live), gripper)
        try:
            with Server(capture, listen) as server:
                _print(f"{len(live.names)} images in {arguments.out}; open {server.address} in a browser")
                capture.run(_asks(arguments, states, _lines(arguments, capture), server))
                result = capture.finish()
        finally:
            calibration.close()
    requirement_met = calibration.progress.requirement_met
    return _report(arguments, live, answers, result, requirement_met)


def _calibration(live: "LiveFolder", options: CollectOptions) -> "LiveCalibration":
    from jcr.calibration.options import CalibrateOptions
    from jcr.live.calibration import LiveCalibration

    return LiveCalibration(live, options=CalibrateOptions(require=options.require), reach=options.reach_m)


def _report(
    arguments: Arguments,
    live: "LiveFolder",
    answers: "list[Answer]",
    result: "RunResult | None",
    requirement_met: bool,
) -> int:
    """Print what was taken and how exact its calibration is; 3 where that is not what `--until-accurate` waits for."""
    from jcr.records.words import reached_in_words, sentence

    out, images = arguments.out, len(live.names)
    more = "" if images >= LEAST_IMAGES else "; three or more are needed, the same command resumes"
    text = f"{images} images in {out}{more}; next: jcr {'run' if result else 'check'} {out}\n"
    required = None if result is None else result.hand_eye.requirement
    if result is not None and required is not None:
        rejected = [sentence(one) for one in result.hand_eye.findings if one.severity == "rejects"][:1]
        verdict = "; ".join([result.verdict, *rejected])
        text = f"{result.out}: {verdict}\n{reached_in_words(required)}\n{text}"
    facts = {"capture": str(out), "images": live.names, "answers": answers}
    facts["result"] = None if result is None else str(result.out)
    facts["verdict"] = None if result is None else result.verdict
    arguments.output.result(text, facts)
    is_accurate = result is not None and result.converged and required is not None and required.met
    return 3 if arguments.collect.until_accurate and not (is_accurate and requirement_met) else 0


def _lines(arguments: Arguments, capture: "LiveCapture") -> "Iterator[str]":
    """What is typed, without commands; where poses come from elsewhere, a thread of its own reads these."""
    from jcr.live.commands import HELP, without_commands

    lines = without_commands(sys.stdin, capture.press)
    if sys.stdin.isatty():
        _print(HELP)
    if arguments.poses != "typed":
        threading.Thread(target=lambda: all(True for _ in lines), daemon=True).start()
    return lines


def _print(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


def _require_source(poses: str) -> None:
    """Raise InputError where `--poses` is no source, before a camera is opened."""
    kind, _, address = poses.partition(":")
    if poses not in ("typed", "http") and not (kind in _SPOKEN and address):
        raise InputError(f"--poses {poses}: give ur:HOST, franka:HOST, xarm:HOST, typed or http")


def _states(arguments: Arguments) -> "States | None":
    """The states of an arm that is watched; None of poses that are typed or sent."""
    from jcr.live import franka, ur, xarm

    kind, _, address = arguments.poses.partition(":")
    if kind not in _SPOKEN or not address:
        return None
    if kind == "ur":
        host, port = _address(address, 30003, "--poses ur:")
        return lambda: ur.states(host, port)
    module = franka if kind == "franka" else xarm
    return lambda: module.states(address)


def _asks(
    arguments: Arguments, states: "States | None", lines: "Iterator[str]", server: "Server"
) -> "Iterator[Ask]":
    """Yield the requests for images of the source that `--poses` names."""
    from jcr.live.rest import asks_at_rest
    from jcr.live.typed import typed_poses

    if states is not None:
        _print(f"move the arm; an image is taken whenever it rests ({arguments.poses.partition(':')[2]})")
        return asks_at_rest(states)
    if arguments.poses == "typed":
        return typed_poses(lines, _print, arguments.pose_convention, arguments.pose_units)
    samples = server.sampled_poses(arguments.timeout)
    _print(f"waiting for POST http://{server.hosts[0]}/sample with the key {server.key}")
    return samples


def _listen(arguments: Arguments) -> "Listen":
    """Return the address of the server; raise InputError where it is open to others without a token."""
    from jcr.live.server import LOOPBACK, Listen, checked_listen

    token = arguments.token or os.environ.get("JCR_TOKEN") or None
    if arguments.listen is None:
        return checked_listen(Listen(LOOPBACK, arguments.page_port, token, "--page-port"))
    host, port = _address(arguments.listen, 7464, "--listen ")
    return checked_listen(Listen(host, port, token, "--listen"))


_SPOKEN: dict[str, ConventionName] = {"ur": "ur", "franka": "franka", "xarm": "xarm"}
"""How the arms' own pendants and programs write poses."""


def _words(arguments: Arguments, live: "LiveFolder") -> "ArmWords":
    from jcr.estimation.arms import arm_named
    from jcr.live.arm_words import ArmWords

    convention = arguments.pose_convention
    if convention == "auto":
        convention = _SPOKEN.get(arguments.poses.partition(":")[0], "auto")
    name = live.rest.get("robot")
    arm = arm_named(name) if name in ROBOT_NAMES else None
    return ArmWords(convention, arguments.pose_units, arm)


def _address(text: str, port: int, option: str) -> tuple[str, int]:
    host, _, number = text.rpartition(":") if ":" in text else (text, "", str(port))
    if not host or not number.isdigit() or not int(number) < 65536:
        raise InputError(f"{option}{text}: no address; write HOST:PORT such as 127.0.0.1:{port}")
    return host, int(number)


def _intrinsics(file: Path | None) -> dict[str, Any] | None:
    from jcr.capture.plain_files import read_json

    if file is None:
        return None
    content = read_json(file)
    given = content.get("intrinsics") if isinstance(content, dict) else None
    if not isinstance(given, dict):
        raise InputError(f'--intrinsics-from {file}: holds no "intrinsics"; name a capture.json with some')
    return {key: given[key] for key in ("model", "fx", "fy", "cx", "cy", "distortion") if key in given}
