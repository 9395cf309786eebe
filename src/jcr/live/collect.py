"""Taking a capture: requests for images, what a person types and what the calibration comes to, one after the other.

The source of poses and the calibration have threads of their own; what they come to is put into one queue, and all that
changes the capture's images happens here, but for their removal, which the calibration's thread does between two of its
states.
"""

import queue
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from jcr.capture.images import brightness_and_sharpness, read_image
from jcr.errors import InputError
from jcr.live.arm_words import ArmWords
from jcr.live.asks import Answer, Ask
from jcr.live.calibration_keys import Typed
from jcr.live.calibration_progress import Progress
from jcr.live.calibration_words import progress_answer, progress_lines
from jcr.live.calibration_worker import CalibrationWorker, Failed
from jcr.live.camera import Camera
from jcr.live.coverage import as_answer, coverage, in_words
from jcr.live.folder import LiveFolder
from jcr.live.look import Still, grid, still_image
from jcr.live.page import ENOUGH, Window, write_page
from jcr.live.rest import REST, farther

if TYPE_CHECKING:
    from jcr.live.calibration import LiveCalibration
    from jcr.results import RunResult

SAME_PLACE = (0.005, np.radians(1.0))
"""m, rad: a second image from within this adds nothing."""
ENOUGH_IMAGES, MOST_IMAGES = 12, 40
"""Of a capture, and of one that ends when it is accurate enough."""


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


_Event = Ask | Typed | Progress | Failed | Exception | None
"""None: nobody asks any more."""


def collect(
    live: LiveFolder,
    camera: Camera,
    asks: Iterator[Ask],
    options: CollectOptions,
    tell: Callable[[Answer, list[str]], None],
    words: ArmWords | None = None,
    calibration: "LiveCalibration | None" = None,
    typed: "queue.SimpleQueue[Typed] | None" = None,
) -> "RunResult | None":
    """Take images into the folder until there are enough, nobody asks any more, or the video ends.

    `tell` gets each answer, and each state of the `calibration` where there is one, with the lines that a person reads,
    the next pose in the arm's own `words`. live.html in the folder shows how it goes. `typed` are commands, from another
    thread. The finished calibration is returned where the capture ended because it is accurate.
    """
    taking = _Taking(live=live, camera=camera, options=options, tell=tell, words=words or ArmWords())
    if calibration is not None:
        taking.worker = CalibrationWorker(calibration, taking.events.put, options.until_accurate)
    with Window(live, camera.latest):
        return taking.until_the_end(asks, typed)


@dataclass(kw_only=True)
class _Taking:
    """One capture while it is taken."""

    live: LiveFolder
    camera: Camera
    options: CollectOptions
    tell: Callable[[Answer, list[str]], None]
    words: ArmWords
    worker: CalibrationWorker | None = None
    events: "queue.SimpleQueue[_Event | RunResult]" = field(default_factory=queue.SimpleQueue)
    answered: threading.Event = field(default_factory=threading.Event)
    is_over: bool = False
    replaces: str | None = None
    """The image that the next one is taken in place of."""
    is_other: bool = False
    """Whether images were removed since it was last asked what the capture covers."""
    done: "RunResult | None" = None

    def __post_init__(self) -> None:
        self.kept = {name: _as_kept(self.live, name) for name in self.live.names}
        self.found = coverage(self.live, self.options.reach_m, self.words)
        self.frames = iter(self.camera.frames)
        self._show(f"{len(self.kept)} images of {self.options.most}")

    def until_the_end(
        self, asks: Iterator[Ask], typed: "queue.SimpleQueue[Typed] | None"
    ) -> "RunResult | None":
        """Handle what comes until the capture ends."""
        if self.worker is not None:
            self.worker.start()
        self.is_over = len(self.kept) >= self.options.most
        threading.Thread(target=self._listen, args=(asks,), daemon=True).start()
        if typed is not None:
            threading.Thread(target=self._forward, args=(typed,), daemon=True).start()
        try:
            while not self.is_over:
                self._handle(self.events.get())
        except BaseException:
            self._end(abandon=True)
            raise
        self._end(abandon=False)
        while not self.events.empty():
            event = self.events.get()
            if not isinstance(event, Ask | Typed):
                self._handle(event)
        return self.done

    def _end(self, abandon: bool) -> None:
        self.is_over = True
        self.answered.set()
        if self.worker is not None:
            (self.worker.abandon if abandon else self.worker.finish)()

    def _listen(self, asks: Iterator[Ask]) -> None:
        """One request after the other, each when the one before it was answered."""
        try:
            while not self.is_over and (ask := next(asks, None)) is not None:
                self.events.put(ask)
                self.answered.wait()
                self.answered.clear()
        except Exception as error:
            self.events.put(error)
        self.events.put(None)

    def _forward(self, typed: "queue.SimpleQueue[Typed]") -> None:
        while not self.is_over:
            self.events.put(typed.get())

    def _handle(self, event: "_Event | RunResult") -> None:
        if event is None:
            self.is_over = True
        elif isinstance(event, Ask):
            self._take(event)
            self.answered.set()
        elif isinstance(event, Typed):
            self._obey(event)
        elif isinstance(event, Progress):
            self._tell_progress(event)
        elif isinstance(event, Failed):
            self.tell({"calibration": None, "reason": event.reason}, [f"no calibration: {event.reason}"])
        elif isinstance(event, Exception):
            raise event
        else:
            self._end_if_accurate(event)

    def _take(self, ask: Ask) -> None:
        try:
            taken = self._image(ask)
        except StopIteration:
            answer: Answer = {"accepted": False, "reason": "the video has ended"}
            self.is_over = True
            ask.answer(answer | {"done": True})
            self.tell(answer, ["the video has ended"])
            return
        name = taken if isinstance(taken, InputError | str) else self._keep(ask, taken)
        if isinstance(name, InputError) or isinstance(taken, str):
            answer = {"accepted": False, "reason": str(name)}
            lines, headline = [f"refused: {name}"], f"Refused: {name}"
        else:
            self.is_over = len(self.kept) >= self.options.most
            answer = {"accepted": True, "image": name, "done": self.is_over} | as_answer(self.found)
            headline = f"{len(self.kept)} images of {self.options.most}"
            lines = [f"kept {name}", *in_words(self.found)]
        self._show(headline)
        ask.answer(answer)
        self.tell(answer, lines)

    def _image(self, ask: Ask) -> Still | str:
        """An image at rest, or why none is kept."""
        for name, pose in self.live.places():
            is_there = name in self.kept and name != self.replaces
            if is_there and not farther(pose, ask.base_from_gripper, SAME_PLACE):
                return f"the gripper is where {name} was taken; move to another pose"
        others = [one for name, one in self.kept.items() if name != self.replaces]
        taken = still_image(self.frames, others, self.options.patience)
        if ask.current is not None and farther(ask.base_from_gripper, ask.current(), REST):
            return "the arm moved while the image was taken; let it rest"
        return taken

    def _keep(self, ask: Ask, taken: Still) -> str | InputError:
        """Keep an image, in place of another where one is retaken; an InputError of one that does not fit the others."""
        try:
            name = self.live.add(taken.image, ask.base_from_gripper, ask.joints, taken.depth_mm, taken.time_s)
        except InputError as error:
            return error
        self.kept[name] = taken
        if self.replaces is not None:
            self._remove(self.replaces)
            self.replaces = None
        elif self.worker is not None:
            self.worker.changed()
        self.found = coverage(
            self.live, self.options.reach_m, self.words, None if self.is_other else self.found
        )
        self.is_other = False
        return name

    def _remove(self, name: str) -> None:
        self.kept.pop(name, None)
        self.is_other = True
        if self.worker is None:
            self.live.remove(name)
        else:
            self.worker.remove(name)

    def _obey(self, typed: Typed) -> None:
        names = list(self.kept)
        row = len(names) if typed.number is None else typed.number
        if typed.action == "finish":
            self.is_over = True
        elif not 1 <= row <= len(names):
            self.tell({"accepted": False, "reason": "no such image"}, [f"refused: there is no image {row}"])
        elif typed.action == "retake":
            self.replaces = names[row - 1]
            self.tell({"retake": self.replaces}, [f"the next image replaces {self.replaces}"])
        else:
            self._remove(names[row - 1])
            self.tell({"removed": names[row - 1]}, [f"removed {names[row - 1]}"])

    def _tell_progress(self, state: Progress) -> None:
        lines = progress_lines(state, self.options.require, self.words)
        self.tell({"calibration": progress_answer(state)}, lines)

    def _end_if_accurate(self, result: "RunResult") -> None:
        required = result.hand_eye.requirement
        if result.converged and required is not None and required.met:
            self.done, self.is_over = result, True

    def _show(self, headline: str) -> None:
        write_page(self.live, self.found, headline, self.options.require or ENOUGH)


def _as_kept(live: LiveFolder, name: str) -> Still:
    image = read_image(live.folder / name)
    return Still(image=image, grid=grid(image), sharpness=brightness_and_sharpness(image)[1])
