"""Session of a live capture: images on request, commands of a person, and the calibration in a separate thread.

Requests and commands may come from any thread (HTTP server, terminal, arm) and are executed one after the other.
"""

import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.options import GRASPING, RequiredAccuracy
from jcr.capture.options import MIN_FRAMES
from jcr.errors import InputError, RejectedError, count_of
from jcr.live.cameras import Camera, Frame
from jcr.live.kept_frames import COMPARED_S, frame_at_rest
from jcr.live.progress import LiveProgress, progress_lines, verifying_lines
from jcr.live.robot import MOVED_ON, REST, TRY_AGAIN, Action, RobotState, States, is_farther, next_rest
from jcr.records.capture_schema import FrameEntry

if TYPE_CHECKING:
    from jcr.live.calibration import LiveCalibration
    from jcr.pipeline.verify import Verification
    from jcr.result import RunResult

SAME_VIEW_AS = (0.005, np.radians(1.0))
"""Smallest difference (m, rad) between the gripper poses of two images; a closer image would add no information."""
ENOUGH_IMAGES, MOST_IMAGES = 12, 40
"""Default largest number of images: of a capture, and of one with --until-accurate."""
LONGEST_S, INTERRUPTED_S = 60.0, 10.0
"""Longest wait (s) for the calibration of the last images: at the end of a capture, and after an interruption."""

Answer = dict[str, Any]
"""Answer to a request or command, as values of JSON: whether it is accepted, the reason, and so on."""


@dataclass(frozen=True, kw_only=True)
class SessionOptions:
    """Options of a live capture: number of images, waiting time, and required accuracy."""

    images: int | None = None
    """Number of images at which the capture stops; by default 12, and with --until-accurate 40."""
    patience: float = 5.0
    """Longest time (s) to wait for an image at rest."""
    require: RequiredAccuracy = GRASPING
    """Required bound on 95 % of the errors of a point at the working distance."""
    until_accurate: bool = False
    """End with exit status 0 as soon as the requirement is met and the leave-one-out error confirms it. If it is not met
    with the last image, the exit status is 3."""


@dataclass(frozen=True, kw_only=True)
class SessionState:
    """State of a live capture at one moment: images, last event, and calibration. It is immutable; the page shows it."""

    version: int = 0
    """Number that increases with every change of the state."""
    event: str = ""
    """Last event in words; empty if the other fields show it."""
    is_refusal: bool = False
    """Whether the event is the reason why a request or command was refused."""
    images: tuple[FrameEntry, ...] = ()
    can_undo: bool = False
    replaces: str | None = None
    """Name of the image that the next one replaces; None: the next one is added."""
    progress: LiveProgress = LiveProgress(images=())
    """Last state of the calibration; the newest images may be missing in it."""
    is_over: bool = False
    is_done: bool = False
    """Whether this is the last state of the session."""
    result: "RunResult | None" = None
    """Final calibration of all images; None before the end, or if it failed."""
    most: int = ENOUGH_IMAGES
    """Number of images at which the capture ends."""
    verifies: Path | None = None
    """Run folder that the images verify; None: the images are calibrated."""
    verification: "Verification | None" = None
    """Result of the verification with these images; None before the first, and after a change of the images."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the images, in the order in which they were taken."""
        return tuple(one.image for one in self.images)


class LiveSession:
    """Live capture: takes images with a camera on request, and calibrates them in a thread meanwhile."""

    def __init__(
        self,
        calibration: "LiveCalibration",
        camera: Camera,
        options: SessionOptions | None = None,
        tell: Callable[[Answer, list[str]], None] = lambda answer, lines: None,
        gripper: Callable[[], RobotState] | None = None,
        verifies: Path | None = None,
    ) -> None:
        """Prepare a session that adds images of `camera` to `calibration`; `run` starts it.

        `tell` is called with each answer and each state of the calibration, as JSON and as lines for a person.
        `gripper` returns the present state of the arm, for an image on command and to detect motion after each image;
        None: poses are typed or posted. `verifies` is a run folder that is verified with the images, which are then not
        calibrated; None: they are calibrated.
        """
        self.calibration, self.folder, self.camera = calibration, calibration.live, camera
        self.options = options or SessionOptions()
        self._tell, self._gripper = tell, gripper
        most = self.options.images or (MOST_IMAGES if self.options.until_accurate else ENOUGH_IMAGES)
        self._frames = iter(camera.frames)
        self._lock = threading.RLock()
        """Lock that is held while an image is taken or a command is executed."""
        self._changed = threading.Condition()
        self.has_gripper = gripper is not None
        """Whether the session can read the pose of the gripper, so that a person can take an image."""
        self.state = SessionState(images=self.folder.images, most=most, verifies=verifies)
        self._calibrated: tuple[str, ...] | None = None
        self._error: Exception | None = None
        self._worker = ThreadPoolExecutor(1)
        """Thread that calibrates after each change of the images."""
        self._following: Future[None] = Future()
        """Last calibration that was requested from the worker."""

    def run(self, source: Callable[[], None] | None = None) -> None:
        """Run the session until there are enough images, `source` or the video ends, or the requirement is met.

        `source` is a function that calls `take` for each image; it runs in a separate thread. None: other threads call
        `take`. Raises the error with which the source or the camera ended.
        """

        def request() -> None:
            try:
                source()  # pyright: ignore[reportOptionalCall]
            except Exception as error:
                self.end(error)
            self.end()

        self._follow()
        self._show(is_over=len(self.folder.names) >= self.state.most)
        if source is not None:
            threading.Thread(target=request, daemon=True).start()
        longest_s, abandon = INTERRUPTED_S, True
        try:
            with self._changed:
                self._changed.wait_for(lambda: self.state.is_over)
                if self._error is None and self.state.result is None:
                    self._show(self._last_step or self.state.event)
            longest_s, abandon = LONGEST_S, self._error is not None
        finally:
            # Wait until all images are calibrated; after an interruption or error, for the running calibration only.
            self.end()
            self._worker.shutdown(wait=False, cancel_futures=abandon)
            with suppress(Exception):  # `end` has the error of a calibration
                self._following.result(longest_s)
        if self._error is not None:
            raise self._error

    def end(self, error: Exception | None = None) -> None:
        """End the capture: no more images are taken. `run` then raises `error`, if there is one."""
        if not self.state.is_over:
            self._error = error
        self._show(self.state.event, is_over=True)

    def watch(self, states: States) -> None:
        """Take an image whenever the arm that `states` reads rests at a new pose, until the capture has ended."""
        last, limit = None, MOVED_ON
        while not self.state.is_over:
            state = next_rest(states, last, limit)
            # The connection is closed while an image is taken, because buffered states would be out of date.
            answer = self.take(state)
            last, limit = state.base_from_gripper, MOVED_ON if answer["accepted"] else TRY_AGAIN

    def take(self, state: RobotState, waits: bool = False) -> Answer:
        """Take an image while the arm rests at `state`, start to calibrate all images, and return an answer for JSON.

        `state` is written with the image: gripper pose and joint angles. The answer has "accepted", and "image" (name)
        or "reason". An image that the new one replaces is removed with its addition. `waits`: wait for the calibration,
        add its state to the answer, and raise the unexpected error that ended it.
        """
        with self._lock:
            if self.state.is_over:
                return {"accepted": False, "reason": "the capture has ended", "done": True}
            old = self.state.replaces
            try:
                frame = self._frame(state.base_from_gripper)
                data = state.joints, frame.time_s, frame.depth_mm
                name = self.folder.add(frame.image, state.base_from_gripper, *data, replaces=old)
            except (InputError, OSError) as error:
                why = str(error)
                if isinstance(error, OSError):
                    why = f"the image cannot be written ({error.strerror}); free the disk and take it again"
                answer = {"accepted": False, "reason": why, "done": self.state.is_over}
                self._say(f"refused: {why}", answer)
            else:
                self._follow()
                is_over = len(self.folder.names) >= self.state.most
                answer = {"accepted": True, "image": name, "done": self.state.is_over or is_over}
                event = f"kept {name}" if old is None else f"kept {name} in place of {old}"
                self._say(event, answer, is_over=is_over, replaces=None)
            following = self._following
        if not waits:
            return answer
        with suppress(CancelledError):
            following.result()
        return self.state.progress.as_json() | answer | {"done": self.state.is_over}

    def press(self, action: Action, number: int | None = None) -> None:
        """Execute a command of a person, such as "take" or "remove".

        `number` is the number of the image that it concerns, counted from 1; None selects the last image.
        """
        with self._lock:
            names = self.folder.names
            number = len(names) if number is None else number
            if self.state.is_over:
                return
            if action == "finish":
                self._show(is_over=True)
            elif action == "undo":
                self._undo()
            elif action in ("retake", "remove") and not 1 <= number <= len(names):
                self._refuse(f"refused: there is no image{f' {number}' if names else ''}")
            elif action == "remove":
                name = names[number - 1]
                self.folder.remove(name)
                kept = None if self.state.replaces == name else self.state.replaces
                self._say(f"removed {name}", {"images": self.folder.names}, replaces=kept)
                self._follow()
            else:
                if action == "retake":
                    name = names[number - 1]
                    self._say(f"the next image replaces {name}", {"replaces": name}, replaces=name)
                if self._gripper is not None:
                    try:
                        self.take(self._gripper())
                    except InputError as error:  # the gripper's pose cannot be read
                        self._refuse(f"refused: {error}")
                elif action == "take":
                    self._refuse("refused: give the pose at which the gripper rests; the image is taken then")

    def _undo(self) -> None:
        """Undo the last change: a replacement that waits for its image, else the last addition or removal."""
        if (waiting := self.state.replaces) is not None:
            self._say(f"{waiting} is kept", {"replaces": None}, replaces=None)
        elif self.folder.undo():
            self._say(f"undone: {len(self.folder.names)} images", {"images": self.folder.names})
            self._follow()
        else:
            self._refuse("refused: nothing to undo")

    def finish(self) -> "RunResult | None":
        """Verify the run, or calibrate all images and return the result; None with fewer than three, or if it failed.

        Raises the errors of `verify`.
        """
        try:
            if self.state.result is None and (step := self._last_step):
                self._show(step, is_over=True)
                if self.state.verifies is not None:
                    self.verify()
                else:
                    self._show(result=self.calibration.finish())
        except RejectedError as error:
            if self.state.verifies is not None:
                raise
            self._refuse(f"no calibration: {error}")
        finally:
            self._show(self.state.event, is_refusal=self.state.is_refusal, is_over=True, is_done=True)
        return self.state.result

    @property
    def _last_step(self) -> str:
        """Computation that follows the last image, in words; empty if there are too few images for it."""
        count, run = len(self.folder.names), self.state.verifies
        if run is not None:
            return f"verifying {run} with {count_of(count, 'image')}" if count else ""
        return f"computing the final calibration of all {count} images" if count >= MIN_FRAMES else ""

    def verify(self) -> "Verification":
        """Verify the run with the images taken so far, show the result, and return it.

        Raises InputError if no run is verified, and the errors of `verify_run`.
        """
        from jcr.pipeline.verify import verify_run

        if (run := self.state.verifies) is None:
            raise InputError("no run is verified; start the capture with --verify OUT")
        with self._lock:
            self._show(self._last_step)
            try:
                found = verify_run(run, self.folder.folder)
            except Exception as error:
                self._show(f"not verified: {error}", is_refusal=True)
                raise
            self._show(verification=found)
        if not self.state.is_over:  # The result at the end is printed by the command.
            count = count_of(len(found.images), "image")
            self._tell({"verification": found.as_json()}, [f"{found.verdict} by {count}: {found.finding}"])
        return found

    def _frame(self, base_from_gripper: Float[ndarray, "4 4"]) -> Frame:
        """Return a frame taken while the gripper rests at this pose (4,4); raise InputError if none can be kept."""
        images = [one for one in self.folder.images if one.image != self.state.replaces]
        for one in images:
            if not is_farther(one.base_from_gripper, base_from_gripper, SAME_VIEW_AS):
                raise InputError(f"the gripper is where {one.image} was taken; move to another pose")
        kept = [self.folder.summary(one.image) for one in images]
        try:
            found = frame_at_rest(self._frames, kept, self.options.patience)
        except StopIteration:
            self.end()
            raise InputError(
                f"the video has ended; an image needs two equal frames {COMPARED_S:g} s apart (jcr docs capture)"
            ) from None
        except InputError as error:
            self.end(error)
            raise
        if isinstance(found, str):
            raise InputError(found)
        try:
            now = base_from_gripper if self._gripper is None else self._gripper().base_from_gripper
        except (InputError, StopIteration) as error:
            raise InputError(f"the pose cannot be read after the image: {error}") from None
        if is_farther(base_from_gripper, now, REST):
            raise InputError("the arm moved while the image was taken; let it rest")
        return found

    def _refuse(self, event: str) -> None:
        """Publish the reason why a request or command was not executed, on the page and through `tell`."""
        self._say(event, {"accepted": False, "reason": event.removeprefix("refused: ")})

    def _follow(self) -> None:
        """Call `_calibrate` in the worker thread."""
        with suppress(RuntimeError):  # After the end of the session the worker accepts no requests.
            self._following = self._worker.submit(self._calibrate)

    def _calibrate(self) -> None:
        """Calibrate the images if they changed; count them only if a run is verified.

        With --until-accurate, end the capture if the calibration of all images meets the requirement.
        """
        try:
            if tuple(self.folder.names) != self._calibrated:
                names = tuple(self.folder.names)
                is_counted = self.state.verifies is not None
                progress = LiveProgress(images=names) if is_counted else self.calibration.update()
                self._calibrated = progress.images
                self._report(progress)
                if self.options.until_accurate and progress.requirement_met:
                    result = self.calibration.finish()
                    if result.verdict == "accepted":
                        self._show(is_over=True, result=result)
        except (InputError, RejectedError) as error:
            self._refuse(f"no calibration: {error}")
        except OSError as error:
            self._refuse(f"no calibration: {error.filename or self.folder.folder}: {error.strerror}")
        except Exception as error:
            self.end(error)
            raise

    def _report(self, progress: LiveProgress) -> None:
        """Publish a new state of the calibration, on the page and through `tell`."""
        with self._changed:
            state = self.state
            is_shown = not state.is_refusal and not state.is_over and progress.images == state.names
            self._show("" if is_shown else state.event, is_refusal=state.is_refusal, progress=progress)
        if state.verifies is not None:
            lines = verifying_lines(state.verifies, len(progress.images), state.most)
            self._tell({"images": list(progress.images)}, lines)
        else:
            self._tell({"calibration": progress.as_json()}, progress_lines(progress))

    def _say(self, event: str, answer: Answer, **changes: Any) -> None:
        """Publish an event (text) on the page, and with `answer` (JSON) through `tell`."""
        self._show(event, is_refusal=not answer.get("accepted", True), **changes)
        self._tell(answer, [event])

    def _show(self, event: str = "", *, is_refusal: bool = False, **changes: Any) -> None:
        """Replace `state` by a copy with this event and the fields `changes`, and notify waiting threads."""
        with self._changed:
            changes["is_over"] = self.state.is_over or changes.get("is_over", False)
            waiting, images = changes.get("replaces", self.state.replaces), self.folder.images
            if tuple(one.image for one in images) != self.state.names:
                changes = {"verification": None} | changes
            self.state = replace(
                self.state,
                version=self.state.version + 1,
                event=event,
                is_refusal=is_refusal,
                images=images,
                can_undo=self.folder.can_undo or waiting is not None,
                **changes,
            )
            self._changed.notify_all()
