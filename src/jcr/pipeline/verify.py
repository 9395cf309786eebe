"""Test from a few new images whether the camera has moved since its calibration."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.calibration.drift import ALPHA, Drift, detectable, drift
from jcr.calibration.options import GRASPING
from jcr.calibration.robot_errors import robot_errors
from jcr.calibration.stage import calibrate_reconstruction
from jcr.capture.folder import require_decided
from jcr.capture.images import read_image
from jcr.capture.read import read_capture
from jcr.distributions import chi2
from jcr.errors import InputError, RejectedError
from jcr.estimation.absolute_pose import CameraPose
from jcr.estimation.problem import pose_problem
from jcr.estimation.robot_noise import of_poses
from jcr.estimation.solve import solve
from jcr.findings import Verdict, sentence
from jcr.geometry import step_between
from jcr.pipeline.options import TOLERANCE
from jcr.progress import Progress, silent
from jcr.records import Capture, CellCamera
from jcr.result import RunResult
from jcr.sfm.register import register


@dataclass(frozen=True, kw_only=True)
class Verification(Drift):
    """Result of the test for a moved camera: the measured drift, and the verdict on the old calibration."""

    moved: bool
    """Whether the drift is significant and larger than the tolerance."""
    images: tuple[str, ...]
    """Names of the new images that were used."""
    notes: tuple[str, ...]
    """Warnings about the new images and the sensitivity of the test."""
    fixed: str | None = None
    """Name of the camera if it is a fixed one, whose drift is along base axes; None: the camera on the gripper."""
    others: tuple["Verification", ...] = ()
    """Results for the fixed cameras of the run of which there are new images."""

    @property
    def verdict(self) -> Verdict:
        """Verdict on the old calibration: rejected if the camera moved."""
        return "rejected" if self.moved else "accepted"

    @property
    def finding(self) -> str:
        """Phrase that states what has moved: nothing, the camera, the scene, or camera or scene if that is unclear."""
        if self.fixed is not None:
            return f"{self.fixed} has {'moved' if self.moved else 'not moved'}"
        moved = {"camera": "the camera", "scene": "the scene", "either": "the camera or the scene"}
        return f"{moved[self.cause]} has moved" if self.moved else "no drift is detected"

    @property
    def advice(self) -> str:
        """Remedy, in words, for the case that something has moved."""
        if self.fixed is not None:
            return f"{self.fixed} has moved; fasten it, and calibrate it again (jcr add-camera, under another name)"
        anew = "tighten the mount, then calibrate again from 8 or more images (jcr run)"
        return {
            "scene": "the scene or the robot's base was moved as a whole; the camera's calibration is still valid, the "
            "map is not: build it again (jcr run)",
            "either": "either the camera has moved on the gripper, or the whole scene has; two more images with the "
            f"wrist rotated decide which; if it is the camera, {anew}",
            "camera": f"the camera has moved on the gripper; {anew}",
        }[self.cause]


def verify_run(
    out: str | Path,
    new: Capture | str | Path,
    tolerance: tuple[float, float] = TOLERANCE,
    progress: Progress | None = None,
) -> Verification:
    """Test with the images of `new`, a capture or its path, whether the cameras of the run folder `out` have moved.

    The new images are located in the reconstruction of the calibrated scene. Drifts smaller than both parts of
    `tolerance` (mm, degrees) raise no alarm, however significant. Raises InputError if the run has no accepted
    calibration or the images are of another camera. Raises RejectedError if no image shares enough features
    with the scene.
    """
    report = progress or silent
    if not isinstance(new, Capture):
        new = read_capture(new, at_least=1)
    new = require_decided(new)
    run = RunResult(out)
    _, capture, reconstruction = run.of_wrist_camera()
    calibration = run.found
    if not calibration.converged:
        raise InputError(
            f"{out}: its calibration is rejected and cannot be tested; calibrate again (jcr run)"
        )
    taken_then, taken_now = _new_images(capture, capture, new, new)
    report("find the old scene", 0.0)
    found = register(reconstruction, [taken_then[row] for row in reconstruction.image_index], list(taken_now))
    report("find the old scene", 1.0)
    located, lost = dict[int, CameraPose](), list[str]()
    for row, place in enumerate(found):
        if isinstance(place, CameraPose):
            located[row] = place
        else:
            lost.append(f"{new.images[row]} shares {place} points with the calibrated scene")
    if not located:
        raise RejectedError(
            f"cannot tell: {'; '.join(lost)}; take images of the scene that was calibrated on, or calibrate images of "
            "another one (jcr calibrate) and compare both runs (jcr compare)"
        )
    wrist = _in_old_scene(run, new, located, lost, tolerance)
    return replace(wrist, others=tuple(_fixed_cameras(run, new, tolerance, progress)))


def _new_images(
    then: Capture | CellCamera, capture: Capture, now: Capture | CellCamera, new: Capture
) -> tuple[list[UInt8[ndarray, "h w 3"]], list[UInt8[ndarray, "h w 3"]]]:
    """Return the images of a camera's calibration, and its new images.

    `then` is the camera in the capture `capture` of the calibration, `now` the same one in the capture `new`. Raises
    InputError if the new images have another size, or if one of them was used for the calibration.
    """
    if now.image_size != then.image_size:
        (width, height), (wide, high) = now.image_size, then.image_size
        raise InputError(
            f"{new.folder}: images of {width}x{height} pixels, the calibration is for {wide}x{high}; take them with the "
            "same camera and resolution"
        )
    before, after = (
        [read_image((one.folder or whole.folder) / name) for name in one.images]
        for one, whole in ((then, capture), (now, new))
    )
    for name, image in zip(now.images, after, strict=True):
        for old, other in zip(then.images, before, strict=True):
            if np.array_equal(image, other):
                raise InputError(
                    f"{name}: equals {old}, an image of the calibration, and cannot test it; take a new image"
                )
    return before, after


def _in_old_scene(
    run: RunResult,
    new: Capture,
    located: Mapping[int, CameraPose],
    notes: list[str],
    tolerance: tuple[float, float],
) -> Verification:
    """Return the test for a moved wrist camera from new images with camera poses in the old reconstruction.

    `located` maps indices of images in `new` to these poses (recon frame); `notes` are warnings about new images without
    one. The poses of the calibration are fitted again for their joint covariance, which calibration.json lacks.
    """
    _, capture, reconstruction = run.of_wrist_camera()
    calibration = run.found
    calibrate_options, rows = run.state.options.calibrate, list(located)
    is_used = np.array([calibration.images[row].used for row in reconstruction.image_index])
    used = reconstruction.image_index[is_used]
    robot = robot_errors(capture, calibrate_options, new)
    old = capture.base_from_gripper[used], reconstruction.recon_from_camera[is_used]
    similarity = calibration.base_from_recon
    problem, state = pose_problem(
        *old,
        (calibration.gripper_from_camera, similarity.scale, similarity.rigid),
        error_covariance=of_poses(robot.systematic, used),
        noise_floor=calibrate_options.robot_noise_m_rad,
    )
    cameras = np.stack([one.a_from_camera for one in located.values()])
    found = drift(
        solve(problem, state, averaged=False),
        old,
        (new.base_from_gripper[rows], cameras, np.stack([one.covariance for one in located.values()])),
        of_poses(robot.systematic, np.r_[used, len(capture) + np.array(rows)]),
    )
    if robot.unused is not None:
        notes = [*notes, sentence(robot.unused)]
    return _judged(found, tolerance, [new.images[row] for row in rows], notes)


def _fixed_cameras(
    run: RunResult, new: Capture, tolerance: tuple[float, float], progress: Progress | None
) -> Iterator[Verification]:
    """Yield the drift of each fixed camera of the run that has images in `new`.

    The old and the new pose of the camera are estimated together, so that errors of the wrist camera's calibration
    cancel in their difference. Raises RejectedError if the images share too few features with the scene.
    """
    from jcr.cell.stage import place_cameras  # imports pycolmap, which the command-line help does not need

    _, capture, reconstruction = run.of_wrist_camera()
    calibrate_options = run.state.options.calibrate
    others = {one.name: one for one in run.others}
    placed = {
        one.name: one.intrinsics
        for one in ([] if run.cameras is None else run.cameras.cameras)
        if one.converged and one.mount == "base" and one.intrinsics is not None and one.name in others
    }
    known_cameras = [camera for camera in new.others if camera.name in placed]
    if not known_cameras:
        return
    hand_eye = calibrate_reconstruction(capture, reconstruction, calibrate_options)
    for camera in known_cameras:
        own = others[camera.name]
        _new_images(own, capture, camera, new)
        # Both poses are of the same camera, so that an error of its intrinsics cancels in their difference.
        intrinsics = placed[camera.name]
        known = {"intrinsics": intrinsics, "intrinsics_std": np.zeros(4 + len(intrinsics.distortion))}
        now = replace(camera, name=f"{camera.name[:60]}_now", folder=camera.folder or new.folder, **known)
        both = replace(own, **known), now
        parts = capture, both, reconstruction, hand_eye, calibrate_options, progress
        cell, solution, poses = place_cameras(*parts)
        for one in cell.cameras:
            if one.parent_from_camera is None:
                raise RejectedError(f"cannot tell: {one.doubt}")
        assert solution is not None
        before, after = (poses[one.name] for one in both)
        j = solution.derivative(after) - solution.derivative(before)
        offset = step_between(before(solution.state), after(solution.state))
        found = _of_two(offset, j @ solution.covariance @ j.T)
        notes = [text for one in cell.cameras for text in one.warnings]
        yield replace(_judged(found, tolerance, now.images, notes), fixed=own.name)


def _of_two(offset: Float[ndarray, "6"], covariance: Float[ndarray, "6 6"]) -> Drift:
    """Return the drift of a camera from its old to its new pose, with a χ² test of the step between both.

    `offset` is that step (translation in m, then rotation vector in rad; axes of the gripper, or of the base for a fixed
    camera), `covariance` its covariance.
    """
    p_value = float(chi2.sf(offset @ np.linalg.solve(covariance, offset), 6))
    noticed = detectable(covariance)
    found = {"offset": offset, "covariance": covariance, "p_value": p_value, "detectable": noticed}
    return Drift(**found, cause="camera", is_noisier=False)


def _judged(
    found: Drift, tolerance: tuple[float, float], images: Sequence[str], notes: Sequence[str]
) -> Verification:
    """Return the verification for a drift; the camera moved if the drift is significant and above the tolerance.

    The drift is significant if its p-value is below ALPHA. The tolerance is exceeded if translation or rotation is
    larger than in `tolerance` (mm, degrees). `notes` are warnings to include, and `images` are the new images that were
    used.
    """
    notes = list(notes)
    if found.is_noisier:
        notes.append(
            "the images disagree with one another; something else than the camera moved too, or the robot is less exact "
            "than when it was calibrated"
        )
    unnoticed_mm, unnoticed_deg = 1e3 * found.detectable[0], float(np.degrees(found.detectable[1]))
    if unnoticed_mm > GRASPING[0] or unnoticed_deg > GRASPING[1]:
        notes.append(
            f"drifts of less than {unnoticed_mm:.0f} mm or {unnoticed_deg:.1f}° would not be noticed; take more images, "
            "with the wrist rotated and at other distances"
        )
    millimetres = 1e3 * float(np.linalg.norm(found.offset[:3]))
    degrees = float(np.degrees(np.linalg.norm(found.offset[3:])))
    matters = millimetres > tolerance[0] or degrees > tolerance[1]
    moved = found.p_value < ALPHA and matters
    return Verification(**vars(found), moved=moved, images=tuple(images), notes=tuple(notes))
