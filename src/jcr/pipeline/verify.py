"""Test whether the camera has moved since it was calibrated, from a few new images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from jcr.calibration.drift import Cause, Drift, detectable, drift
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.calibration.robot_errors import of_poses, robot_errors
from jcr.calibration.stage import calibrate
from jcr.capture.images import read_image
from jcr.capture.read import read_source
from jcr.cell.added import read_added_cameras
from jcr.distributions import chi2
from jcr.errors import InputError, RejectedError
from jcr.estimation.absolute_pose import CameraPose
from jcr.estimation.solve import Solution, solve
from jcr.estimation.wrist import pose_problem
from jcr.findings import Verdict, sentence
from jcr.geometry import Poses, step_between
from jcr.options import checked_options
from jcr.progress import Progress, silent
from jcr.reconstruct import reconstruct
from jcr.records import Capture, CellCamera, HandEye, PosePairs, Reconstruction
from jcr.run_folder import RunOptions, RunResult
from jcr.sfm.register import register

ROUNDING = 1e-9
"""Largest change of a number of a pose that is written and read again."""
MIN_TO_RECALIBRATE = 5
"""Images of another scene; with fewer a wrong one cannot be outvoted."""


@dataclass(frozen=True)
class VerifyOptions:
    """Options of the test for a moved camera."""

    alpha: float = 1e-3
    """False-alarm rate: the probability of reporting a movement when nothing has moved."""
    tolerance: tuple[float, float] = (0.5, 0.05)
    """MM DEG: drifts smaller than both raise no alarm, however significant."""


@dataclass(frozen=True, kw_only=True)
class Verification:
    """Verdict on a calibration, with the measured drift."""

    moved: bool
    cause: Cause
    """Body that has moved, where one has."""
    offset: Float[ndarray, "6"]
    """Drift: translation (m) and rotation vector (rad) of the camera in gripper axes."""
    std: Float[ndarray, "6"]
    p_value: float
    detectable: tuple[float, float]
    """m, rad: a drift of this size in the worst direction would be found nine times in ten."""
    images: tuple[str, ...]
    """Names of the images that were used."""
    notes: tuple[str, ...]
    how: str
    fixed: str | None = None
    """Name of the camera, where it is a fixed one; the drift is then along axes of the base."""
    others: tuple["Verification", ...] = ()
    """Fixed cameras of the run that the new capture has images of."""

    @property
    def drift_m(self) -> float:
        """Distance (m) of the camera from its calibrated place."""
        return float(np.linalg.norm(self.offset[:3]))

    @property
    def drift_rad(self) -> float:
        """Angle (rad) of the camera's rotation since the calibration."""
        return float(np.linalg.norm(self.offset[3:]))

    @property
    def verdict(self) -> Verdict:
        """Verdict on the calibration by the new images."""
        if self.moved:
            return "rejected"
        return "accepted with warnings" if self.notes else "accepted"

    @property
    def finding(self) -> str:
        """Body that has moved, in words."""
        if self.fixed is not None:
            return f"{self.fixed} has {'moved' if self.moved else 'not moved'}"
        moved = {"camera": "the camera", "scene": "the scene", "either": "the camera or the scene"}
        return f"{moved[self.cause]} has moved" if self.moved else "nothing has moved"

    @property
    def advice(self) -> str:
        """Remedy where something has moved."""
        if self.fixed is not None:
            return f"{self.fixed} has moved; fasten it, and calibrate it again (jcr add-camera, under another name)"
        anew = "tighten the mount, then calibrate again from 8 or more images (jcr run)"
        if self.cause == "scene":
            return (
                "the scene or the robot's base was moved as a whole; the camera's calibration is still valid, the map "
                "is not: build it again (jcr run)"
            )
        if self.cause == "either":
            return (
                f"either the camera has moved on the gripper, or the whole scene has; two more images with the wrist "
                f"rotated decide which; if it is the camera, {anew}"
            )
        return f"the camera has moved on the gripper; {anew}"


def verify_run(
    out: str | Path,
    new: Capture | str | Path,
    options: VerifyOptions | Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Verification:
    """Test the calibration in the run folder `out` against the few images of `new`, a capture or its path.

    Raises InputError for a run that holds no accepted calibration, or images of another camera; RejectedError
    when the images share too few features with the old scene, or too few of another, to tell.
    """
    report, options = progress or silent, checked_options(options, VerifyOptions)
    if not 0 < options.alpha < 0.5:
        raise InputError(f"--alpha {options.alpha}: give a false-alarm rate between 0 and 0.5")
    new = _read(new)
    run = RunResult(out)
    calibration, capture, reconstruction = run.of_wrist_camera()
    if not calibration.converged:
        raise InputError(
            f"{out}: its calibration is rejected and cannot be tested; calibrate again (jcr run)"
        )
    _require_size(new.folder, new.image_size, capture.image_size)
    taken_then, taken_now = _images(capture.folder, capture.images), _images(new.folder, new.images)
    _require_new(taken_now, taken_then)
    report("find the old scene", 0.0)
    located = register(
        reconstruction,
        [taken_then[capture.images[row]] for row in reconstruction.image_index],
        [*taken_now.values()],
    )
    report("find the old scene", 1.0)
    lost = [f"{name} shares {place} points with the calibrated scene"
            for name, place in zip(new.images, located, strict=True) if not isinstance(place, CameraPose)]  # fmt: skip
    options_then = run.state.options
    if len(lost) < len(new):
        then = (calibration, capture, reconstruction, options_then.calibrate)
        found = _in_old_scene(then, new, located, lost, options)
        return replace(found, others=_fixed_cameras(run, then[1:], new, options, progress))
    if len(new) < MIN_TO_RECALIBRATE:
        raise RejectedError(
            f"cannot tell: {'; '.join(lost)}; take images of the scene that was calibrated on, or "
            f"{MIN_TO_RECALIBRATE} or more of another one"
        )
    return _by_recalibration(calibration, new, options_then, options, progress)


def _read(new: Capture | str | Path) -> Capture:
    if isinstance(new, Capture):
        return new
    found = read_source(new, at_least=1)
    if isinstance(found, PosePairs):
        raise InputError(f"{new}: gives poses and no images, which verify needs")
    return found


def _require_size(folder: Path, now: tuple[int, int], then: tuple[int, int]) -> None:
    if now != then:
        raise InputError(
            f"{folder}: images of {now[0]}x{now[1]} pixels, the calibration is for {then[0]}x{then[1]}; take them with "
            "the same camera and resolution"
        )


def _in_old_scene(
    then: tuple[Calibration, Capture, Reconstruction, CalibrateOptions],
    new: Capture,
    located: Sequence[CameraPose | int],
    lost: Sequence[str],
    options: VerifyOptions,
) -> Verification:
    """Test by the images that are located in the calibrated scene."""
    calibration, capture, reconstruction, calibrate_options = then
    shared = [k for k, place in enumerate(located) if isinstance(place, CameraPose)]
    places = [place for place in located if isinstance(place, CameraPose)]
    used = reconstruction.image_index[_used(calibration, reconstruction)]
    robot = robot_errors(capture, calibrate_options, new)
    found = drift(
        *fitted(*then, of_poses(robot.systematic, used)),
        (
            new.base_from_gripper[shared],
            np.stack([place.a_from_camera for place in places]),
            np.stack([place.covariance for place in places]),
        ),
        of_poses(robot.systematic, np.r_[used, len(capture) + np.array(shared)]),
        options.alpha,
    )
    unused = [] if robot.unused is None else [sentence(robot.unused)]
    notes = (*lost, *unused, *_same_poses(new, capture))
    return _judged(found, options, tuple(new.images[k] for k in shared), notes, "in the old scene")


def _fixed_cameras(
    run: RunResult,
    calibrated: tuple[Capture, Reconstruction, CalibrateOptions],
    new: Capture,
    options: VerifyOptions,
    progress: Progress | None,
) -> tuple[Verification, ...]:
    """Compare the place of each fixed camera of the run with its new images, where `new` has some.

    The places before and now are estimated together, so that the errors of the wrist camera move both alike. Raises
    RejectedError where the images share too few features with the scene.
    """
    capture, reconstruction, calibrate_options = calibrated
    cameras = run.cameras
    others = {camera.name: camera for camera in (*capture.others, *read_added_cameras(run.out, capture))}
    placed = {
        one.name: one.intrinsics.record()
        for one in ([] if cameras is None else cameras.cameras)
        if one.converged and one.mount == "base" and one.intrinsics is not None and one.name in others
    }
    found = []
    for camera in new.others:
        if camera.name not in placed:
            continue
        own = others[camera.name]
        taken_now = _images(camera.folder or new.folder, camera.images)
        _require_new(taken_now, _images(own.folder or capture.folder, own.images))
        _require_size(new.folder, camera.image_size, own.image_size)
        # One camera took both: an error of its intrinsics moves both places alike.
        known = {
            "intrinsics": placed[camera.name],
            "intrinsics_std": np.zeros(4 + len(placed[camera.name].distortion)),
        }
        now = replace(camera, name=f"{camera.name[:60]}_now", folder=camera.folder or new.folder, **known)
        both = [replace(own, **known), now]
        hand_eye = calibrate(capture, reconstruction, calibrate_options)
        found.append(
            _place_twice(capture, both, (reconstruction, hand_eye), calibrate_options, options, progress)
        )
    return tuple(found)


def _place_twice(
    capture: Capture,
    cameras: Sequence[CellCamera],
    calibrated: tuple[Reconstruction, HandEye],
    calibrate_options: CalibrateOptions,
    options: VerifyOptions,
    progress: Progress | None,
) -> Verification:
    """Compare the two places of one camera, before and now."""
    from jcr.cell.stage import place_cameras  # pycolmap, which help need not wait for

    placed = place_cameras(capture, cameras, *calibrated, calibrate_options, progress)
    for camera in placed.cameras:
        if camera.parent_from_camera is None:
            raise RejectedError(f"cannot tell: {camera.doubt}")
    assert placed.solution is not None
    before, after = (placed.poses[camera.name] for camera in cameras)
    j = placed.solution.derivative(after) - placed.solution.derivative(before)
    covariance = j @ placed.solution.covariance @ j.T
    offset = step_between(before(placed.solution.state), after(placed.solution.state))
    notes = tuple(text for camera in placed.cameras for text in camera.warnings)
    found = _of_two(offset, covariance, options, cameras[1].images, notes, "in the mapped scene")
    return replace(found, fixed=cameras[0].name)


def _images(folder: Path, names: Sequence[str]) -> dict[str, UInt8[ndarray, "h w 3"]]:
    return {name: read_image(folder / name) for name in names}


def _require_new(
    now: Mapping[str, UInt8[ndarray, "_ _ 3"]], then: Mapping[str, UInt8[ndarray, "_ _ 3"]]
) -> None:
    """Raise InputError where an image is one of the calibration, whatever its name: it would confirm itself."""
    for name, image in now.items():
        for old, other in then.items():
            if np.array_equal(image, other):
                raise InputError(
                    f"{name}: is {old}, which the calibration was made from, and cannot test it; take a new image"
                )


def _same_poses(new: Capture, then: Capture) -> tuple[str, ...]:
    """Return a note where gripper poses equal those of the calibration to the last digit: commanded, or copied."""
    same = [
        name
        for name, pose in zip(new.images, new.base_from_gripper, strict=True)
        if (np.abs(pose - then.base_from_gripper) < ROUNDING).all(axis=(1, 2)).any()
    ]
    if not same:
        return ()
    return (
        f"{', '.join(same)}: the gripper pose is to the last digit one of the calibration; give the pose that the robot "
        "measures there now, not a copy or the commanded one",
    )


def fitted(
    calibration: Calibration,
    capture: Capture,
    reconstruction: Reconstruction,
    options: CalibrateOptions,
    systematic: Float[ndarray, "s s"],
) -> tuple[Solution, tuple[Poses, Poses]]:
    """Fit the calibration's poses again, for the joint covariance that its file does not keep; return the poses, too.

    Robot and cameras alone, without bundle adjustment: new images are located in the same cameras' frame. `systematic`
    is the covariance of the systematic errors of the poses used, at 1 rad.
    """
    row_used = _used(calibration, reconstruction)
    poses = (
        capture.base_from_gripper[reconstruction.image_index][row_used],
        reconstruction.recon_from_camera[row_used],
    )
    x, similarity = calibration.gripper_from_camera, calibration.base_from_recon
    problem, state = pose_problem(
        *poses,
        (x, similarity.scale, similarity.rigid),
        error_covariance=systematic,
        noise_floor=options.robot_noise_m_rad,
    )
    return solve(problem, state, averaged=False), poses


def _used(calibration: Calibration, reconstruction: Reconstruction) -> Bool[ndarray, " m"]:
    return np.array([calibration.images[row].used for row in reconstruction.image_index])


def _judged(
    found: Drift, options: VerifyOptions, images: tuple[str, ...], notes: tuple[str, ...], how: str
) -> Verification:
    if found.is_noisier:
        notes += ("the images disagree with one another; something else than the camera moved too, or the robot "
                  "is less exact than when it was calibrated",)  # fmt: skip
    return Verification(
        moved=_is_moved(found.offset, found.p_value, options),
        cause=found.cause,
        offset=found.offset,
        std=np.sqrt(np.diag(found.covariance)),
        p_value=found.p_value,
        detectable=found.detectable,
        images=images,
        notes=notes,
        how=how,
    )


def _is_moved(offset: Float[ndarray, "6"], p_value: float, options: VerifyOptions) -> bool:
    millimetres = 1e3 * float(np.linalg.norm(offset[:3]))
    degrees = float(np.degrees(np.linalg.norm(offset[3:])))
    matters = millimetres > options.tolerance[0] or degrees > options.tolerance[1]
    return p_value < options.alpha and matters


def _by_recalibration(
    calibration: Calibration,
    new: Capture,
    options_then: RunOptions,
    options: VerifyOptions,
    progress: Progress | None,
) -> Verification:
    """Calibrate from the images of another scene, and test the difference against both covariances."""
    if calibration.intrinsics is not None:
        new = replace(new, intrinsics=calibration.intrinsics.record())
    reconstruction = reconstruct(new, options_then.reconstruct, progress)
    hand_eye = calibrate(new, reconstruction, options_then.calibrate)
    if not hand_eye.converged:
        raise RejectedError(f"cannot tell: a new calibration from these images failed ({hand_eye.doubt})")
    before = calibration.gripper_from_camera
    offset = step_between(before, hand_eye.gripper_from_camera)
    covariance = calibration.covariance[:6, :6] + hand_eye.covariance[:6, :6]
    images = tuple(new.images[row] for row in reconstruction.image_index[hand_eye.inliers])
    return _of_two(
        offset, covariance, options, images, (), "against a calibration of its own in another scene"
    )


def _of_two(
    offset: Float[ndarray, "6"],
    covariance: Float[ndarray, "6 6"],
    options: VerifyOptions,
    images: tuple[str, ...],
    notes: tuple[str, ...],
    how: str,
) -> Verification:
    """Return the verdict on two places of the camera that differ by `offset`."""
    p_value = float(chi2.sf(offset @ np.linalg.solve(covariance, offset), 6))
    return Verification(
        moved=_is_moved(offset, p_value, options),
        cause="camera",
        offset=offset,
        std=np.sqrt(np.diag(covariance)),
        p_value=p_value,
        detectable=detectable(covariance, options.alpha),
        images=images,
        notes=notes,
        how=how,
    )
