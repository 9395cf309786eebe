"""Calibration that is updated after each image of a capture, with its accuracy and findings."""

import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt16
from numpy import ndarray
from numpy.typing import ArrayLike

from jcr.calibration.arm_of_capture import robot_errors
from jcr.calibration.calibrate import calibration_of, checked_case
from jcr.calibration.checks.images import SAME
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.capture.images import BLURRED_EDGE, EDGES_AT, edge_width, read_image
from jcr.errors import InputError, RejectedError
from jcr.estimation.prediction import MIN_PREDICTED_IMAGES
from jcr.files import locked
from jcr.findings import Finding, FindingKind, strongest_first
from jcr.least_squares import one_blas_thread
from jcr.live.folder import Channels, LiveFolder
from jcr.live.progress import LiveProgress
from jcr.options import checked_options
from jcr.records import Capture, FrameNames, Intrinsics, Tracks
from jcr.records.capture_schema import IntrinsicsEntry
from jcr.sfm.live_map import LiveMap

if TYPE_CHECKING:
    from jcr.result import RunResult

OBSERVATIONS = 300, 8000
"""Largest mean number of observations per image, and largest total, while images are taken; `finish` uses all."""
LEAST_IMAGES_TO_REJECT = 5
"""Smallest number of images with which a missing calibration is a finding that rejects."""
MOST_SHOWN = 3000
"""Largest number of points in `LiveProgress.points_in_base`."""


class LiveCalibration:
    """Calibration that is computed again whenever an image is added to its capture or removed from it.

    `folder` is the folder of the capture; a capture that was begun there is continued. `intrinsics` belong to all
    images; None: they are estimated. `robot` names the arm (`jcr capture --help` shows the names), `frame_names` the
    frames of base, gripper and camera, for exports.
    Images and poses are written into the folder when they are added, so that jcr.read_capture can read the capture at
    any time. Methods may be called from several threads.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        intrinsics: Intrinsics | IntrinsicsEntry | None = None,
        robot: str | None = None,
        frame_names: FrameNames | None = None,
        options: CalibrateOptions | Mapping[str, Any] | None = None,
        exclusive: bool = False,
    ) -> None:
        """Open or begin a capture; raise InputError if the capture cannot be continued or an option is wrong.

        `exclusive`: lock the folder against other processes until `close`; InputError if another one holds the lock.
        """
        self._opened = ExitStack()
        if exclusive:
            self._opened.enter_context(locked(Path(folder)))
        given = IntrinsicsEntry.of(intrinsics) if isinstance(intrinsics, Intrinsics) else intrinsics
        self.live = LiveFolder(Path(folder), given, robot, frame_names)
        self._lock = threading.RLock()
        """Lock that is held while the capture, the map or `progress` is changed."""
        self._options = checked_options(options, CalibrateOptions)
        check_options(self._options)
        self._map: LiveMap | None = None
        self._mapped: tuple[str, ...] = ()
        self._blurred: dict[str, Finding] = {}
        self._is_closed = False
        self.progress = LiveProgress(images=tuple(self.live.names))

    def __repr__(self) -> str:
        """Return the folder of the capture, and the state of the calibration."""
        return f"<LiveCalibration {self.live.folder}: {self.progress!r}>"

    def add(
        self,
        image: ArrayLike,
        base_from_gripper: ArrayLike,
        joints: ArrayLike | None = None,
        time_s: float | None = None,
        depth_mm: UInt16[ndarray, "h w"] | None = None,
        *,
        color: Channels = "rgb",
    ) -> LiveProgress:
        """Add an image (h,w,3) uint8 and its gripper pose (4,4) to the capture, and calibrate all images again.

        `joints` are the joint angles of the arm (rad), `time_s` is the time of the image (s). `depth_mm` (h,w) is the
        depth of its pixels along the optical axis (0: unknown). `color` is the order of the channels ("bgr" for
        OpenCV). Grey images are valid. Raises InputError for an array that is no image or no rigid pose, a pose that is
        not in metres, an image of another size than the others, and an image that repeats another. The capture is then
        unchanged. Several threads may call this at the same time.
        """
        with self._changing():
            self.live.add(image, base_from_gripper, joints, time_s, depth_mm, color)
            return self.update()

    def remove(self, image: int | str) -> LiveProgress:
        """Remove an image from the capture, and calibrate without it.

        `image` is its name, or its index, which counts from 0, and from the end if it is negative. Raises InputError if
        there is no such image.
        """
        with self._changing():
            names = self.live.names
            if isinstance(image, int) and -len(names) <= image < len(names):
                image = names[image]
            if image not in names:
                raise InputError(f"there is no image {image}; the capture has {len(names)}")
            self.live.remove(image)
            return self.update()

    def undo(self) -> LiveProgress:
        """Undo the last addition or removal of an image since this object was made, and calibrate again.

        Returns the new state of the calibration, which is the same if there is nothing to undo.
        """
        with self._changing():
            self.live.undo()
            return self.update()

    def finish(self, out: str | Path | None = None) -> "RunResult":
        """Calibrate all images with all their observations, by `jcr.calibrate`, and write a run folder.

        `out` is the run folder; None: the subfolder `result` of the capture. Raises the errors of `jcr.calibrate`.
        """
        from jcr.pipeline.run import calibrate
        from jcr.result import RunOptions

        with self._lock:
            options = RunOptions(calibrate=self._options)
            return calibrate(self.live.folder, out or self.live.folder / "result", options)

    @one_blas_thread
    def update(self) -> LiveProgress:
        """Calibrate the images that the folder (`live`) has now, and return the new state of the calibration."""
        with self._lock:
            capture, before = self.live.capture(), self._mapped
            self._mapped = () if capture is None else capture.images
            new = {name: read_image(self.live.folder / name) for name in self._mapped if name not in before}
            for name, image in new.items():
                if (width := edge_width(image)) > BLURRED_EDGE:
                    edge_px = max(*image.shape[:2], EDGES_AT) * width
                    found = Finding.of(FindingKind.BLURRED, "warns", "images", name, value=edge_px)
                    self._blurred[name] = found
            if capture is None:
                self._map = None
            else:
                self._map = self._map or LiveMap(capture)
                self._map.update(capture, new)
            added = list(new)[-1] if new and len(before) <= len(self._mapped) else None
            self.progress = self._calibrated(capture, added)
            return self.progress

    def close(self) -> None:
        """Delete the files of images that were removed from the capture, and unlock the folder."""
        with self._lock:
            self.live.close()
            self._opened.close()
            self._is_closed = True

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Hold the lock for a change of the images; raise InputError after `close`."""
        with self._lock:
            if self._is_closed:
                raise InputError(f"{self.live.folder}: the calibration is closed; open it again to change it")
            yield

    def _calibrated(self, capture: Capture | None, added: str | None) -> LiveProgress:
        """Return the state of the calibration; without a calibration if fewer than three images are registered.

        `capture` has all images (None: there are none); `added` is the name of the image added last, None if none was.
        """
        names = self._mapped
        state = LiveProgress(images=names, added=added)
        if capture is None or self._map is None:
            return state
        made = self._map.reconstruction()
        rows = np.zeros(0, int) if made is None else made.image_index
        robot, case = robot_errors(capture, self._options), None
        findings = [self._blurred[name] for name in names if name in self._blurred]
        missing = sorted(set(range(len(names))) - set(self._map.registered))
        for row in missing if len(names) >= MIN_PREDICTED_IMAGES else ():
            agreeing, contradicted = self._map.matched_with(row)
            matches, concerns = max((agreeing, "images"), (contradicted, "poses"), key=lambda one: one[0])
            kind = FindingKind.NOT_REGISTERED
            findings.append(Finding.of(kind, "warns", concerns, names[row], value=float(matches)))
        if made is not None and len(rows) >= MIN_PREDICTED_IMAGES:
            most = min(OBSERVATIONS[0] * len(rows), OBSERVATIONS[1])
            some = replace(made, tracks=_longest(made.tracks, most))
            with suppress(RejectedError):
                case = checked_case(capture, some, self._options, robot.of(rows))
        state = replace(state, registered=tuple(names[row] for row in rows))
        if case is None:
            findings += [] if robot.unused is None else [robot.unused]
            few = Finding.of(FindingKind.FEW_IMAGES, "informs", "images", value=float(len(names)))
            if len(names) >= LEAST_IMAGES_TO_REJECT:
                why, then = "fewer than three images are registered", "let the views overlap more"
                kind = FindingKind.NO_RECONSTRUCTION
                few = Finding.of(kind, "rejects", "reconstruction", text=why, remedy=then)
            return replace(state, findings=strongest_first([*findings, few]))
        hand_eye, tracks = calibration_of(case), case.reconstruction.tracks
        for one in hand_eye.images if hand_eye.converged else ():
            metres = 1e-3 * (one.translation_residual_mm or 0.0)
            radians = float(np.radians(one.rotation_residual_deg or 0.0))
            if not one.used and (metres > SAME[0] or radians > SAME[1]):
                kind = FindingKind.POSE_CONTRADICTS_IMAGE
                findings.append(Finding.of(kind, "warns", "poses", one.image, value=metres, rotation=radians))
        # The points shown are observed by three images or more.
        seen = np.flatnonzero(np.bincount(tracks.point, minlength=len(tracks.points_in_recon)) >= 3)
        points = tracks.points_in_recon[seen[:: max(1, len(seen) // MOST_SHOWN)]]
        found = strongest_first([*findings, *hand_eye.findings])
        return replace(
            state, hand_eye=hand_eye, findings=found, points_in_base=hand_eye.base_from_recon(points)
        )


def _longest(tracks: Tracks, most: int) -> Tracks:
    """Return the tracks of board points and of the points that the most images observe, up to `most` observations.

    All observations of a chosen point are kept. Among points with equally many, the one whose pixels have the smallest
    fractional part of x is first. This is as good as a random choice, and independent of the image order.
    """
    count = np.bincount(tracks.point, minlength=len(tracks.points_in_recon))
    fraction = np.ones(len(count))
    np.minimum.at(fraction, tracks.point, tracks.x_px[:, 0] % 1.0)
    order = np.lexsort([fraction, -count])
    chosen = tracks.on_board
    chosen[order[np.cumsum(count[order]) <= most]] = True
    return tracks.only(chosen[tracks.point])
