"""A calibration that is made while the images are taken: after each image, how exact it is and what is missing."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8, UInt16
from numpy import ndarray

from jcr.calibration.case import Case, of_points
from jcr.calibration.checks.left_out import SAME
from jcr.calibration.checks.views import STILL as MOVED
from jcr.calibration.expected import FEWEST, assumed_of
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.calibration.requirement import advised
from jcr.calibration.robot_errors import robot_errors
from jcr.calibration.stage import checked
from jcr.capture.camera_json import intrinsics_as_json
from jcr.capture.images import BLURRED_EDGE, EDGES_AT, edge_width, read_image
from jcr.errors import RejectedError
from jcr.estimation.arms import arm_named
from jcr.files import read_bytes, write_text
from jcr.geometry import apply, largest_motion
from jcr.least_squares import one_blas_thread
from jcr.live.calibration_progress import Progress, Reached
from jcr.live.folder import LiveFolder
from jcr.live.look import STILL, grid
from jcr.live.next_pose import Reach, Tried, before_calibration, proposed
from jcr.options import checked_options
from jcr.records import Capture, Finding, HandEye, Intrinsics, Kind, Tracks, strongest_first
from jcr.sfm.growing import Growing

if TYPE_CHECKING:
    from jcr.results import RunResult

HISTORY = "live/history.json"
"""In the folder of the capture: how exact the calibration was after each image."""
OBSERVATIONS = 300, 8000
"""An image and in all, that take part while images are taken; what more of them add, the calibration at the end has."""
FEW = 5
"""Images from which on there is a calibration, or a finding that says what is missing."""
MOST_POINTS = 3000


class LiveCalibration:
    """A calibration that grows with its capture.

    `folder` is that of the capture, or its LiveFolder; a capture that was begun there is continued, from its files.
    `intrinsics` are of images as they are given to `add`; None: they are estimated. `robot` names the arm
    (jcr.estimation.arms.ROBOT_NAMES). `reach` (2,3) is the box (m, base frame) in which gripper poses are proposed.
    Images and poses are written into the folder as they come, and it can be read by jcr.read_capture at any time.
    """

    def __init__(
        self,
        folder: LiveFolder | str | Path,
        *,
        intrinsics: Intrinsics | None = None,
        robot: str | None = None,
        options: CalibrateOptions | Mapping[str, Any] | None = None,
        reach: Float[ndarray, "2 3"] | None = None,
    ) -> None:
        """Raises InputError where the folder holds no capture that can be continued, or an option cannot be."""
        if not isinstance(folder, LiveFolder):
            given = None if intrinsics is None else intrinsics_as_json(intrinsics)
            folder = LiveFolder(Path(folder), given, robot)
        self.live = folder
        self._options = checked_options(options, CalibrateOptions)
        check_options(self._options)
        name = self._options.robot or folder.rest.get("robot")
        self._reach = Reach(None if name is None else arm_named(name), reach)
        self._map: Growing | None = None
        self._mapped: list[str] = []
        self._of_image: dict[str, tuple[Finding, ...]] = {}
        self._grids: dict[str, Float32[ndarray, "gh gw"]] = {}
        self._history = _read_history(folder.folder / HISTORY)
        self._refused: list[Float[ndarray, "4 4"]] = []
        self._next_pose: Callable[[], dict[str, Any]] = dict
        """Fields of Progress, of the capture as it was calibrated last and the gripper poses refused since."""
        self.progress = Progress(images=tuple(folder.names), history=self._history)

    def add(
        self,
        image: UInt8[ndarray, "h w 3"],
        base_from_gripper: Float[ndarray, "4 4"],
        joints: Float[ndarray, " dof"] | None = None,
        time_s: float | None = None,
        depth_mm: UInt16[ndarray, "h w"] | None = None,
    ) -> Progress:
        """Keep an image (RGB) and the gripper pose at it, and calibrate with it.

        `joints` are the arm's angles (rad), `time_s` is when the image was taken, `depth_mm` that of a depth camera. An
        image of another size, or one that repeats an earlier one while the gripper moved, is not kept: `refused` says
        why, and the rest stays as it was.
        """
        refused = self.fault(image, base_from_gripper)
        if refused is not None:
            return self._refusing(refused, base_from_gripper)
        self.live.add(image, base_from_gripper, joints, depth_mm, time_s)
        return self.update()

    def remove(self, index: int) -> Progress:
        """Take the image at `index` out of the capture, and calibrate without it."""
        self.live.remove(self.live.names[index])
        return self.update()

    def replace(
        self,
        index: int,
        image: UInt8[ndarray, "h w 3"],
        base_from_gripper: Float[ndarray, "4 4"],
        joints: Float[ndarray, " dof"] | None = None,
        time_s: float | None = None,
        depth_mm: UInt16[ndarray, "h w"] | None = None,
    ) -> Progress:
        """Take an image in place of that at `index`: it becomes the last one, for images are in the order of taking.

        Where the new one is refused, the old one stays.
        """
        old = self.live.names[index]
        refused = self.fault(image, base_from_gripper, without=old)
        if refused is not None:
            return self._refusing(refused, base_from_gripper)
        self.live.add(image, base_from_gripper, joints, depth_mm, time_s, replaces=old)
        return self.update()

    def undo(self) -> Progress:
        """Take back the last `add`, `remove` or `replace` since the capture was begun or resumed."""
        self.live.undo()
        return self.update()

    def finish(self, out: str | Path | None = None) -> "RunResult":
        """The calibration of all images by `jcr.calibrate`, from the features and matches that were found.

        Its run folder is `out`, or the folder `result` of the capture. Raises as `jcr.calibrate` does.
        """
        from jcr.pipeline import calibrate
        from jcr.results import RunOptions
        from jcr.run_folder import LIVE

        options = RunOptions(calibrate=self._options)
        return calibrate(self.live.folder, out or self.live.folder / LIVE, options)

    def fault(
        self,
        image: UInt8[ndarray, "h w 3"],
        base_from_gripper: Float[ndarray, "4 4"],
        without: str | None = None,
    ) -> Finding | None:
        """Why an image would not be kept; None of one that can be. `without` names an image that does not count."""
        size = (image.shape[1], image.shape[0])
        if self.live.size not in (None, size):
            sizes = {"size": "{}x{}".format(*size), "before": "{}x{}".format(*self.live.size)}
            return Finding(kind=Kind.SIZE_DIFFERS, severity="rejects", mend="images", details=sizes)
        coarse = grid(image)
        for one in self.live.images:
            metres, radians = largest_motion(np.stack([one.base_from_gripper, base_from_gripper]))
            if one.name == without or (metres < MOVED[0] and radians < MOVED[1]):
                continue
            if np.abs(self._grid(one.name) - coarse).mean() < STILL:
                return Finding(
                    kind=Kind.FRAME_REPEATED,
                    severity="rejects",
                    mend="images",
                    images=(one.name,),
                    value=metres,
                    details={"rotation": radians},
                )
        return None

    @one_blas_thread
    def update(self) -> Progress:
        """Bring the calibration up to what the folder holds: images that were added there, or removed."""
        capture = self.live.capture()
        names, before = [] if capture is None else list(capture.images), len(self._mapped)
        for name in [name for name in self._mapped if name not in names]:
            self._forget(name)
        # An image that is back is not the last one: those after it are mapped after it again.
        same = next(
            (k for k, pair in enumerate(zip(self._mapped, names, strict=False)) if len(set(pair)) > 1), None
        )
        for name in [] if same is None else self._mapped[same:]:
            self._forget(name)
        new = [name for name in names if name not in self._mapped]
        if capture is not None:
            self._extend(capture)
        added = new[-1] if new and before <= len(names) else None
        self._refused.clear()
        self.progress = self._calibrated(capture, added)
        return self.progress

    def close(self) -> None:
        """Remove the working files, and the files of images that were taken out of the capture."""
        if self._map is not None:
            self._map.close()
        self.live.close()

    @one_blas_thread
    def propose_elsewhere(self, base_from_gripper: Float[ndarray, "4 4"]) -> Progress:
        """The state with a next pose away from a gripper pose at which no image could be kept."""
        self._refused.append(base_from_gripper)
        self.progress = replace(self.progress, **self._next_pose())
        return self.progress

    def _refusing(self, refused: Finding, base_from_gripper: Float[ndarray, "4 4"]) -> Progress:
        if refused.kind is Kind.FRAME_REPEATED:
            self.propose_elsewhere(base_from_gripper)
        self.progress = replace(self.progress, added=None, refused=refused)
        return self.progress

    def _grid(self, name: str) -> Float32[ndarray, "gh gw"]:
        if name not in self._grids:
            self._grids[name] = grid(read_image(self.live.folder / name))
        return self._grids[name]

    def _forget(self, name: str) -> None:
        if self._map is not None:
            self._map.remove(self._mapped.index(name))
        self._mapped.remove(name)
        self._of_image.pop(name, None)
        self._grids.pop(name, None)

    def _extend(self, capture: Capture) -> None:
        """Map the images of a capture that are not mapped yet."""
        for count in range(len(self._mapped) + 1, len(capture) + 1):
            name = capture.images[count - 1]
            image = read_image(capture.folder / name)
            self._of_image[name] = self._looked_at(name, image)
            if self._map is None or self._map.is_to_be_mapped_again:
                if self._map is not None:
                    self._map.close()
                # What is there already is mapped at once, as after an interruption.
                self._map = Growing(capture)
                self._of_image |= {
                    other: self._looked_at(other, read_image(capture.folder / other))
                    for other in capture.images[count:]
                }
                self._mapped = list(capture.images)
                return
            self._map.add(_first(capture, count), image)
            self._mapped.append(name)

    def _looked_at(self, name: str, image: UInt8[ndarray, "h w 3"]) -> tuple[Finding, ...]:
        """What an image by itself, and when it was taken, say against it."""
        found = []
        if (width := edge_width(image)) > BLURRED_EDGE:
            edge_px = max(*image.shape[:2], EDGES_AT) * width
            found.append(
                Finding(kind=Kind.BLURRED, severity="warns", mend="images", images=(name,), value=edge_px)
            )
        if (back := self.live.seconds_back(name)) is not None:
            found.append(
                Finding(kind=Kind.CLOCK_JUMPS, severity="warns", mend="poses", images=(name,), value=back)
            )
        return tuple(found)

    def _calibrated(self, capture: Capture | None, added: str | None) -> Progress:
        names = tuple(self._mapped)
        of_images = [finding for name in names for finding in self._of_image[name]]
        of_images += self._not_registered(names)
        made = None if self._map is None or not names else self._map.reconstruction()
        registered = () if made is None else tuple(names[row] for row in made.image_index)
        state = Progress(images=names, added=added, registered=registered, history=self._history)
        rows = np.zeros(0, int) if made is None else made.image_index
        if capture is None:
            self._next_pose = dict
        else:
            self._next_pose = lambda: before_calibration(self._tried(capture, rows), self._reach)
        if capture is None or made is None or len(registered) < FEWEST:
            findings = strongest_first([*of_images, *_too_few(len(names))])
            return replace(state, findings=findings, **self._next_pose())
        tracks = _longest(made.tracks, min(OBSERVATIONS[0] * len(registered), OBSERVATIONS[1]))
        made = replace(made, tracks=tracks)
        robot = robot_errors(capture, self._options).of(made.image_index)
        try:
            case = checked(capture, made, self._options, robot)
        except RejectedError:
            findings = strongest_first([*of_images, *_too_few(len(names))])
            return replace(state, findings=findings, **self._next_pose())
        assumptions = assumed_of(case)
        hand_eye = advised(
            case.hand_eye, case.base_from_gripper, self._options, robot, assumptions, case.scene_in_base
        )
        findings = [*of_images, *_contradicting(case, hand_eye), *hand_eye.findings]
        self._remember(len(names), hand_eye)
        self._next_pose = lambda: proposed(
            case, hand_eye, robot, assumptions, self._reach, self._tried(capture, rows)
        )
        return replace(
            state,
            hand_eye=hand_eye,
            findings=strongest_first(findings),
            history=self._history,
            points_in_base=_points(case, hand_eye),
            **self._next_pose(),
        )

    def _tried(self, capture: Capture, registered: Int[ndarray, " m"]) -> Tried:
        return Tried(capture, registered, tuple(self._refused))

    def _not_registered(self, names: tuple[str, ...]) -> list[Finding]:
        """Images that stay out of the map, where there is one or there are enough for one."""
        if self._map is None or len(names) < FEWEST:
            return []
        inside = set(self._map.registered)
        return [
            Finding(
                kind=Kind.NOT_REGISTERED,
                severity="warns",
                mend="images",
                images=(name,),
                value=float(self._map.matched_with(row)),
            )
            for row, name in enumerate(names)
            if row not in inside
        ]

    def _remember(self, images: int, hand_eye: HandEye) -> None:
        """Write how exact the calibration is with this number of images; what was known of more is of others."""
        required = hand_eye.requirement
        assert required is not None
        reached = Reached(
            images=images,
            translation_mm=float(required.reached_mm),
            rotation_deg=float(required.reached_deg),
            accepted=hand_eye.converged,
        )
        self._history = (*(one for one in self._history if one.images < images), reached)
        write_text(self.live.folder / HISTORY, json.dumps([asdict(one) for one in self._history]) + "\n")


def _first(capture: Capture, count: int) -> Capture:
    return replace(
        capture, images=capture.images[:count], base_from_gripper=capture.base_from_gripper[:count]
    )


def _longest(tracks: Tracks, most: int) -> Tracks:
    """The points that most images see, until there are `most` observations.

    Among points of as many images the fraction of a pixel decides: as good as chance, and the same choice of points
    however the map was grown.
    """
    count = np.bincount(tracks.point, minlength=len(tracks.points_in_recon))
    fraction = np.ones(len(count))
    np.minimum.at(fraction, tracks.point, tracks.x_px[:, 0] % 1.0)
    order = np.lexsort([fraction, -count])
    chosen = tracks.on_board
    chosen[order[np.cumsum(count[order]) <= most]] = True
    return of_points(tracks, chosen)


def _too_few(images: int) -> list[Finding]:
    """That there is no calibration, and why."""
    if images < FEW:
        return [Finding(kind=Kind.FEW_IMAGES, severity="informs", mend="images", value=float(images))]
    details = {"text": "fewer than three images are registered", "remedy": "let the views overlap more"}
    return [Finding(kind=Kind.NO_RECONSTRUCTION, severity="rejects", mend="reconstruction", details=details)]


def _contradicting(case: Case, hand_eye: HandEye) -> list[Finding]:
    """Images whose gripper poses a sound calibration leaves out, and where their cameras show the gripper."""
    if not hand_eye.is_sound:
        return []
    images = hand_eye.images
    return [
        Finding(
            kind=Kind.POSE_CONTRADICTS_IMAGE,
            severity="warns",
            mend="poses",
            images=(case.names[row],),
            value=float(images.translation_residual_m[row]),
            details={"rotation": float(images.rotation_residual_rad[row])},
        )
        for row in np.flatnonzero(~images.inliers)
        if images.translation_residual_m[row] > SAME[0] or images.rotation_residual_rad[row] > SAME[1]
    ]


def _points(case: Case, hand_eye: HandEye) -> Float[ndarray, "p 3"]:
    """Points of the scene that three or more images see (m, base frame)."""
    tracks = case.reconstruction.tracks
    seen = np.flatnonzero(np.bincount(tracks.point, minlength=len(tracks.points_in_recon)) >= 3)
    some = seen[:: max(1, len(seen) // MOST_POINTS)]
    return apply(hand_eye.base_from_recon, hand_eye.scale * tracks.points_in_recon[some])


def _read_history(file: Path) -> tuple[Reached, ...]:
    """As it was written; nothing of a file that cannot be read, for it decides nothing."""
    try:
        return tuple(Reached(**one) for one in json.loads(read_bytes(file)))
    except (OSError, ValueError, TypeError):
        return ()
