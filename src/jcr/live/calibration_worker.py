"""A calibration that is made in a thread of its own, so that neither the camera nor the source of poses waits for it."""

import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jaxtyping import Float
from numpy import ndarray

from jcr.errors import InputError, RejectedError
from jcr.live.calibration_progress import Progress

if TYPE_CHECKING:
    from jcr.live.calibration import LiveCalibration
    from jcr.results import RunResult

    Heard = Callable[["Progress | RunResult | Failed | Exception"], None]

LONGEST_S = 60.0
"""That the end of a capture waits for the calibration of its last images."""
INTERRUPTED_S = 10.0
"""The same of a capture that is interrupted."""


@dataclass(frozen=True)
class Failed:
    """Why there is no calibration of the images so far: the capture goes on."""

    reason: str


class CalibrationWorker:
    """Calibrates whenever the capture has changed; what it comes to is handed to `heard`, in the worker's thread."""

    def __init__(self, calibration: "LiveCalibration", heard: "Heard", until_accurate: bool = False) -> None:
        """`until_accurate`: as soon as the calibration is as accurate as required, it is finished, too."""
        self._calibration, self._heard, self._until_accurate = calibration, heard, until_accurate
        self._changed = threading.Event()
        self._refused: queue.SimpleQueue[Float[ndarray, "4 4"]] = queue.SimpleQueue()
        self._ended = self._abandoned = False
        self._calibrated: tuple[str, ...] = ()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def start(self) -> None:
        """Begin with what the folder of the capture holds."""
        self._changed.set()
        self._thread.start()

    def changed(self) -> None:
        """Images were added to the capture, or taken out of it."""
        self._changed.set()

    def refused(self, base_from_gripper: Float[ndarray, "4 4"]) -> None:
        """No image could be kept at a gripper pose: the next one is proposed elsewhere."""
        self._refused.put(base_from_gripper)
        self._changed.set()

    def finish(self) -> None:
        """Calibrate what is left to calibrate, and stop."""
        self._ended = True
        self._stop(LONGEST_S)

    def abandon(self) -> None:
        """Stop with the state that is being calculated; what is not calibrated yet lies in the folder."""
        self._abandoned = True
        self._stop(INTERRUPTED_S)

    def _stop(self, longest_s: float) -> None:
        self._changed.set()
        if self._thread.is_alive():
            self._thread.join(longest_s)

    def _watch(self) -> None:
        while True:
            self._changed.wait()
            if self._abandoned:
                return
            ends = self._ended
            self._changed.clear()
            try:
                self._calibrate()
            except (InputError, RejectedError) as error:
                self._heard(Failed(str(error)))
            except OSError as error:
                self._heard(Failed(f"{error.filename or self._calibration.live.folder}: {error.strerror}"))
            except Exception as error:
                self._heard(error)
            if ends:
                return

    def _calibrate(self) -> None:
        names = tuple(self._calibration.live.names)
        if names != self._calibrated:
            progress = self._calibration.update()
            self._calibrated = progress.images
            self._heard(progress)
            if self._until_accurate and progress.requirement_met:
                self._heard(self._calibration.finish())
        while not self._refused.empty():
            self._heard(self._calibration.propose_elsewhere(self._refused.get()))
