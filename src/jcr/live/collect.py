"""Taking a capture: requests for images, commands of a person and states of the calibration, one after the other.

The source of poses, the calibration, the terminal and the live page have threads of their own; what they come to is put
into one queue, and all that changes the capture's images happens here.
"""

import queue
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from jcr.capture.images import read_image
from jcr.errors import InputError, RejectedError
from jcr.live.arm_words import ArmWords
from jcr.live.asks import Answer, Ask
from jcr.live.calibration_progress import Progress
from jcr.live.calibration_words import progress_answer, progress_lines
from jcr.live.calibration_worker import CalibrationWorker, Failed
from jcr.live.camera import Camera, Frame
from jcr.live.commands import Command
from jcr.live.look import Look, frame_at_rest
from jcr.live.rest import REST, State, farther

if TYPE_CHECKING:
    from jcr.live.calibration import LiveCalibration
    from jcr.results import RunResult

SAME_PLACE = (0.005, np.radians(1.0))
"""m, rad: a second image from within this adds nothing."""
ENOUGH_IMAGES, MOST_IMAGES = 12, 40
"""Of a capture, and of one that ends when it is accurate enough."""
LEAST_IMAGES = 3
"""Of a calibration."""


@dataclass(frozen=True, kw_only=True)
class CollectOptions:
    """How images are taken."""

    images: int | None = None
    """Stop with this many images; unset: 12, and with --until-accurate 40."""
    patience: float = 5.0
    """Seconds to wait for an image at rest."""
    reach: Annotated[
        tuple[float, float, float, float, float, float] | None,
        tyro.conf.arg(metavar="XMIN YMIN ZMIN XMAX YMAX ZMAX"),
    ] = None
    """Box that contains all proposed gripper positions (m, base frame)."""
    require: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="MM DEG")] = None
    """Required accuracy: 95 % of errors of a point seen at the distance of the scene. Unset: 5 mm and 1°."""
    until_accurate: bool = False
    """End, with exit status 0, as soon as the calibration is as accurate as required and images that take no part in it
    agree; with status 3 where it is not with the last image."""

    @property
    def most(self) -> int:
        """Images with which the capture ends in any case."""
        return self.images or (MOST_IMAGES if self.until_accurate else ENOUGH_IMAGES)

    @property
    def reach_m(self) -> "np.ndarray | None":
        """`reach` as its lower and upper corner (2,3)."""
        return None if self.reach is None else np.array(self.reach).reshape(2, 3)


@dataclass(frozen=True, kw_only=True)
class Shown:
    """A capture at one moment, as the live page shows it."""

    version: int = 0
    """Grows with every change."""
    event: str = ""
    """What happened last, in words; empty of what the rest shows."""
    is_refusal: bool = False
    """Whether that is why an image was not kept."""
    images: tuple[str, ...] = ()
    replaces: str | None = None
    """The image that the next one replaces."""
    progress: Progress = Progress(images=())
    """Of the last calibration, which may be of fewer images."""
    is_over: bool = False
    result: "RunResult | None" = None
    """The calibration of all images, at the end."""


_Event = Ask | Command | Progress | Failed | Exception | None
"""None: no more requests come."""


class LiveCapture:
    """One capture while it is taken; `run` takes images until it ends, `finish` calibrates all of them.

    `tell` gets each answer, and each state of the calibration, with the lines that a person reads, the next pose in the
    arm's own `words`. `gripper` reads where the gripper is now (InputError where it cannot), for an image on command;
    None where poses are typed or sent.
    """

    def __init__(
        self,
        calibration: "LiveCalibration",
        camera: Camera,
        options: CollectOptions,
        tell: Callable[[Answer, list[str]], None],
        words: ArmWords | None = None,
        gripper: Callable[[], State] | None = None,
    ) -> None:
        self.calibration, self.live, self.camera = calibration, calibration.live, camera
        self.options, self.words = options, words or ArmWords()
        self.shown = Shown(images=tuple(self.live.names))
        self._tell, self._gripper = tell, gripper
        self._events: queue.SimpleQueue[_Event | RunResult] = queue.SimpleQueue()
        self._worker = CalibrationWorker(calibration, self._events.put, options.until_accurate)
        self._frames = iter(camera.frames)
        self._looks = {name: Look.of(read_image(self.live.folder / name)) for name in self.live.names}
        self._waiting: list[tuple[str | None, Ask, Answer]] = []
        """Requests that are answered with the calibration: the image that it must have, None of one that was refused."""
        self._answered = threading.Event()

    def press(self, command: Command) -> None:
        """Obey a command after all that came before it; from any thread."""
        self._events.put(command)

    def run(self, asks: Iterator[Ask]) -> None:
        """Take images until there are enough, no more requests come, the video ends, or the calibration is accurate."""
        self._worker.start()
        self._show("", is_over=len(self.live.names) >= self.options.most)
        threading.Thread(target=self._listen, args=(asks,), daemon=True).start()
        try:
            while not self.shown.is_over:
                self._handle(self._events.get())
            self._stop(self._worker.finish)
            while not self._events.empty():
                event = self._events.get()
                if isinstance(event, Ask):
                    event.answer({"accepted": False, "reason": "the capture has ended", "done": True})
                elif event is not None and not isinstance(event, Command):
                    self._handle(event)
        except BaseException:
            self._stop(self._worker.abandon)
            raise
        finally:
            self._answer_waiting()

    def finish(self) -> "RunResult | None":
        """The calibration of all images; None, with a line that says why, where there is none."""
        if self.shown.result is None and len(self.live.names) >= LEAST_IMAGES:
            self._show(f"calibrating all {len(self.live.names)} images", is_over=True)
            try:
                self._show("", result=self.calibration.finish())
            except RejectedError as error:
                self._refuse(f"no calibration: {error}")
        return self.shown.result

    def _stop(self, worker_stops: Callable[[], None]) -> None:
        self._show(self.shown.event, is_over=True)
        self._answered.set()
        worker_stops()

    def _listen(self, asks: Iterator[Ask]) -> None:
        """One request after the other, each when the one before it was handled."""
        try:
            while not self.shown.is_over and (ask := next(asks, None)) is not None:
                self._events.put(ask)
                self._answered.wait()
                self._answered.clear()
        except Exception as error:
            self._events.put(error)
        self._events.put(None)

    def _handle(self, event: "_Event | RunResult") -> None:
        if event is None:
            self._show(self.shown.event, is_over=True)
        elif isinstance(event, Ask):
            self._take(event)
            self._answered.set()
        elif isinstance(event, Command):
            self._obey(event)
        elif isinstance(event, Progress):
            self._report(event)
        elif isinstance(event, Failed):
            self._refuse(f"no calibration: {event.reason}")
            self._answer_waiting(of_all=True)
        elif isinstance(event, Exception):
            raise event
        else:
            self._end_if_accurate(event)

    def _take(self, ask: Ask) -> None:
        """Take an image, keep it, and answer, at once or with the calibration."""
        try:
            frame = self._frame(ask)
            name = frame if isinstance(frame, InputError) else self._keep(ask, frame)
        except StopIteration:
            name = InputError("the video has ended")
            self._show("", is_over=True)
        if isinstance(name, InputError):
            answer: Answer = {"accepted": False, "reason": str(name), "done": self.shown.is_over}
            self._show(f"refused: {name}", is_refusal=True)
            self._tell(answer, [f"refused: {name}"])
            self._worker.refused(ask.base_from_gripper)
            self._answer(ask, None, answer)
            return
        self._show(f"kept {name}", is_over=len(self.live.names) >= self.options.most)
        self._tell(_accepted(name, self.shown.is_over), [f"kept {name}"])
        self._answer(ask, name, _accepted(name, self.shown.is_over))

    def _answer(self, ask: Ask, name: str | None, answer: Answer) -> None:
        """Answer a request, at once or with the calibration and the next pose."""
        if ask.waits:
            self._waiting.append((name, ask, answer))
        else:
            ask.answer(answer)

    def _frame(self, ask: Ask) -> Frame | InputError:
        """A frame at rest, or why none is kept."""
        others = [one for one in self.live.images if one.name != self.shown.replaces]
        for one in others:
            if not farther(one.base_from_gripper, ask.base_from_gripper, SAME_PLACE):
                return InputError(f"the gripper is where {one.name} was taken; move to another pose")
        found = frame_at_rest(self._frames, [self._looks[one.name] for one in others], self.options.patience)
        if isinstance(found, str):
            return InputError(found)
        if ask.current is not None and farther(ask.base_from_gripper, ask.current(), REST):
            return InputError("the arm moved while the image was taken; let it rest")
        return found

    def _keep(self, ask: Ask, frame: Frame) -> str | InputError:
        """The name of a frame that is kept; the InputError of one that does not fit the others or cannot be written."""
        try:
            name = self.live.add(
                frame.image,
                ask.base_from_gripper,
                ask.joints,
                frame.depth_mm,
                frame.time_s,
                replaces=self.shown.replaces,
            )
        except InputError as error:
            return error
        except OSError as error:
            return InputError(
                f"the image cannot be written ({error.strerror}); free the disk and take it again"
            )
        self._looks[name] = Look.of(frame.image)
        self._show("", replaces=None)
        self._worker.changed()
        return name

    def _obey(self, command: Command) -> None:
        names = self.live.names
        number = len(names) if command.number is None else command.number
        if command.action == "finish":
            self._show("", is_over=True)
        elif command.action == "take":
            self._take_now()
        elif command.action == "undo":
            self._undo()
        elif not 1 <= number <= len(names):
            self._refuse(f"refused: there is no image {number}")
        elif command.action == "retake":
            self._retake(names[number - 1])
        else:
            self.live.remove(names[number - 1])
            self._changed(f"removed {names[number - 1]}")

    def _take_now(self) -> None:
        if self._gripper is None:
            self._refuse("refused: give the pose at which the gripper rests; the image is taken then")
            return
        try:
            state = self._gripper()
            read = self._gripper
            self._take(
                Ask(state.base_from_gripper, current=lambda: read().base_from_gripper, joints=state.joints)
            )
        except InputError as error:
            self._refuse(f"refused: {error}")

    def _retake(self, name: str) -> None:
        """The next image replaces one: now, where the gripper is still there."""
        event = f"the next image replaces {name}"
        self._show(event, replaces=name)
        self._tell({"retake": name}, [event])
        there = next(one.base_from_gripper for one in self.live.images if one.name == name)
        if self._gripper is not None and not farther(there, self._gripper().base_from_gripper, SAME_PLACE):
            self._take_now()

    def _undo(self) -> None:
        if self.shown.replaces is not None:
            self._show("no image is replaced", replaces=None)
        elif self.live.undo():
            self._changed(f"undone: {len(self.live.names)} images")
        else:
            self._refuse("refused: nothing to undo")

    def _changed(self, event: str) -> None:
        """Calibrate the images that are there now."""
        self._show(event, replaces=None)
        self._worker.changed()
        self._tell({"images": self.live.names}, [event])

    def _refuse(self, why: str) -> None:
        self._show(why, is_refusal=True)
        self._tell({"accepted": False, "reason": why.removeprefix("refused: ")}, [why])

    def _report(self, state: Progress) -> None:
        shown = self.shown
        is_done = not shown.is_refusal and state.images == shown.images
        self._show("" if is_done else shown.event, is_refusal=shown.is_refusal, progress=state)
        lines = progress_lines(state, self.options.require, self.words)
        self._tell({"calibration": progress_answer(state)}, lines)
        # Whether an accurate calibration ends the capture is known when it is finished.
        self._answer_waiting(with_kept=not (self.options.until_accurate and state.requirement_met))

    def _end_if_accurate(self, result: "RunResult") -> None:
        required = result.hand_eye.requirement
        if result.converged and required is not None and required.met:
            self._show("", is_over=True, result=result)
        self._answer_waiting()

    def _answer_waiting(self, of_all: bool = False, with_kept: bool = True) -> None:
        """Answer the requests that were refused, and those whose images the calibration has, or all of them."""
        state, waiting = self.shown.progress, self._waiting
        is_due = [
            of_all or self.shown.is_over or name is None or (with_kept and name in state.images)
            for name, _, _ in waiting
        ]
        self._waiting = [one for one, due in zip(waiting, is_due, strict=True) if not due]
        for (_, ask, answer), due in zip(waiting, is_due, strict=True):
            if due:
                ask.answer(progress_answer(state) | answer | {"done": self.shown.is_over})

    def _show(self, event: str, *, is_refusal: bool = False, **changes: object) -> None:
        self.shown = replace(
            self.shown,
            version=self.shown.version + 1,
            event=event,
            is_refusal=is_refusal,
            images=tuple(self.live.names),
            **changes,  # pyright: ignore[reportArgumentType]
        )


def _accepted(name: str, is_over: bool) -> Answer:
    return {"accepted": True, "image": name, "done": is_over}
