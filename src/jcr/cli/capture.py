"""Command `jcr capture`: take a capture live, image by image, with its accuracy after each."""

import os
import signal
import sys
import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jcr.capture.intrinsics import read_intrinsics
from jcr.capture.options import MIN_FRAMES
from jcr.cli.output import Output
from jcr.errors import InputError, count_of, printable
from jcr.estimation.arms import CHOICES, RobotName
from jcr.files import locked
from jcr.live.cameras import open_camera
from jcr.live.robot import states_of
from jcr.live.session import Answer, LiveSession, SessionOptions
from jcr.number_format import labelled
from jcr.pipeline.options import TOLERANCE

if TYPE_CHECKING:
    from jcr.result import RunResult


VERIFIED = 5
"""Default number of images that verify a run; more add little (jcr verify --check-poses)."""


@dataclass(frozen=True, kw_only=True)
class CaptureCommand:
    """Take a capture live with a camera and a robot, and show after each image what is still missing.

    An image is taken when the arm rests, and kept if it is sharp and nothing moves. After each image the command prints
    the accuracy of the calibration, its faults, and what would improve it. OUT/result is the calibration of all images.
    After Ctrl-C the same command resumes. The live page, whose address is printed, has buttons to take, retake and
    remove images, to undo, and to finish.

    for example:
      jcr capture captures/table --camera 0 --poses ur:192.168.0.2 --robot ur5e
      jcr capture captures/table --camera 0 --poses ur:192.168.0.2 --require 2 0.3 --until-accurate
      jcr capture captures/table --camera realsense --poses franka:172.16.0.2
      jcr capture captures/table --camera 2 --camera-size 1920 1080 --poses xarm:192.168.1.203
      jcr capture captures/table --camera rtsp://192.168.0.9/stream --poses http --page-port 7464
      jcr capture captures/today --camera 0 --poses ur:192.168.0.2 --verify out/table
    """

    out: tyro.conf.Positional[Path]
    """Folder of the capture; an unfinished capture is continued."""
    camera: Annotated[str, tyro.conf.arg(metavar="DEVICE")] = "0"
    """V4L2 device number, realsense[:SERIAL], URL of a stream (rtsp://…), or a recording (video file, .bag)."""
    camera_size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="WIDTH HEIGHT")] = None
    """Resolution in pixels; by default that of the camera (1280 720 for a RealSense)."""
    poses: Annotated[str, tyro.conf.arg(metavar="SOURCE")] = "http"
    """Source of gripper poses: ur:HOST[:PORT] (Universal Robots), franka:HOST, xarm:HOST, or http (a program posts
    them, jcr docs http)."""
    robot: Annotated[RobotName | None, tyro.conf.arg(metavar=CHOICES)] = None
    """Name of the arm, to model its joint offsets and link errors."""
    page_port: Annotated[int, tyro.conf.arg(metavar="PORT")] = 0
    """Port of the live page and of samples on this machine; 0 selects a free one. The key is random, or that of the
    environment variable JCR_TOKEN."""
    intrinsics_from: Path | None = None
    """File with the camera's intrinsics, as for --camera-info, or a capture.json or calibration.json. By default
    those of a RealSense are used, and those of other cameras are estimated."""
    verify: Annotated[Path | None, tyro.conf.arg(metavar="OUT")] = None
    """Run to verify with the images (default: 5), at the end and at each POST /verify, instead of calibrating them."""
    session: SessionOptions = field(default_factory=SessionOptions)
    output: Output = field(default_factory=Output)

    def main(self) -> int:
        """Take images until the user ends or `--until-accurate` is met, and calibrate with all."""
        from jcr.cli.check_verify_compare import verification_lines
        from jcr.live.calibration import LiveCalibration
        from jcr.live.server import LiveServer
        from jcr.pipeline.verify import verifiable
        from jcr.pipeline.verify_page import write_page

        options, out, states = self.session, self.out, states_of(self.poses)
        if options.until_accurate and options.require == "none":
            raise InputError("--until-accurate: needs the accuracy that is meant, not --require none")
        given = None if self.intrinsics_from is None else read_intrinsics(self.intrinsics_from)
        if states is None and self.poses != "http":
            raise InputError(f"--poses {self.poses}: give ur:HOST, franka:HOST, xarm:HOST or http")
        answers, run = list[Answer](), self.verify
        if run is not None:
            verifiable(run)
            options = replace(options, images=options.images or VERIFIED)

        def tell(answer: Answer, lines: list[str]) -> None:
            answers.append(answer)
            _print("\n".join(lines))

        # A service manager ends the capture as Ctrl-C does, and not as glog does, with a page of C++ frames.
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, signal.default_int_handler)
        with locked(out), open_camera(self.camera, self.camera_size) as camera:
            given, limits = given or camera.intrinsics, {"require": options.require}
            calibration = LiveCalibration(out, intrinsics=given, robot=self.robot, options=limits)
            gripper = None if states is None else lambda: next(states())
            session = LiveSession(calibration, camera, options, tell, gripper, run)
            token = os.environ.get("JCR_TOKEN") or None
            try:
                with LiveServer(session, self.page_port, token, self.poses == "http") as server:
                    _print(
                        f"{count_of(len(calibration.live.names), 'image')} in {out}; open {server.address} in a browser"
                    )
                    if states is None:
                        _print(f"waiting for POST http://{server.hosts[0]}/sample with the key {server.key}")
                        session.run()
                    else:
                        where = self.poses.partition(":")[2]
                        _print(f"move the arm; an image is taken whenever it rests ({where})")
                        session.run(lambda: session.watch(states))
                    result = session.finish()
            finally:
                calibration.close()
        if not calibration.live.names:
            why = session.state.event.removeprefix("refused: ") or "none was asked for"
            raise InputError(f"{out}: no image was kept: {why}; the same command begins again")
        facts = {"capture": str(out), "images": calibration.live.names, "answers": answers}
        if (found := session.state.verification) is not None:
            assert run is not None
            page = write_page(run, found, TOLERANCE)
            lines = [*verification_lines(found, False), *labelled("Page", str(page))]
            self.output.result(lines, facts | {"verification": found.as_json()})
            return 3 if found.moved else 0
        return _conclude(self, facts, result, calibration.progress.requirement_met)


def _conclude(
    arguments: CaptureCommand, facts: dict[str, Any], result: "RunResult | None", requirement_met: bool
) -> int:
    """Print the result of a capture and the next command; return the exit status.

    The status is 3 if the calibration failed, is rejected or is not as exact as needed, or if `--until-accurate` is
    given and the leave-one-out error does not confirm the accuracy; else 0. `requirement_met`: the last live
    calibration met the requirement, and its leave-one-out error confirms this.
    """
    from jcr.calibration.summary import summary

    out, images, lines = facts["capture"], len(facts["images"]), list[str]()
    verdict, is_sound = None, False
    if result is not None:
        verdict, is_sound = result.verdict, result.converged
        lines = summary(result.calibration).splitlines()
    facts |= {"result": None if result is None else str(result.out), "verdict": verdict}
    run = Path("out") / Path(out).resolve().name
    run = run.with_name(f"{run.name}_run") if run.resolve() == Path(out).resolve() else run
    command = f"jcr run {out} {run}" if is_sound else f"jcr check {out}"
    if images < MIN_FRAMES:
        command = f"the same command resumes; {MIN_FRAMES} or more images are needed"
    lines += [*labelled("Capture", f"{count_of(images, 'image')} in {out}"), *labelled("Next", command)]
    arguments.output.result(lines, facts)
    if arguments.session.until_accurate:
        return 0 if verdict == "accepted" and requirement_met else 3
    return 3 if images >= MIN_FRAMES and verdict != "accepted" else 0


def _print(text: str) -> None:
    """Print progress on stderr."""
    sys.stderr.write(f"{printable(text)}\n")
    sys.stderr.flush()
