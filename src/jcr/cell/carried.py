"""Eye-to-hand calibration: a fixed camera observes an object in the gripper.

In the frame of the object the camera moves like a wrist camera moves in the base frame. With inverse gripper poses, a
fixed camera is therefore calibrated like a wrist camera. Robot errors are errors of the gripper poses, not of their
inverses, so the result and its covariance are estimated again with the actual poses (estimation/pose_equations.py).
"""

from dataclasses import replace
from pathlib import Path

from jcr.calibration.adjust import adjust_case
from jcr.calibration.case import MIN_OBSERVATIONS, Case, with_findings
from jcr.calibration.checks.camera import of_case
from jcr.calibration.checks.effects import EFFECTS, effects, with_effects
from jcr.calibration.hand_eye import judged, solve_hand_eye
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.calibration.robot_errors import robot_errors
from jcr.capture.images import encode_png, read_image
from jcr.cell.background import moving_parts
from jcr.estimation.solve import recon_frame, uncertainty_of
from jcr.files import write_bytes
from jcr.findings import Finding, FindingKind
from jcr.geometry import inverse
from jcr.records import Capture, Reconstruction


def eye_to_hand(capture: Capture, moving: Path | None = None) -> Capture:
    """Return the capture of a fixed camera as a capture of a camera that moves around the carried object.

    Gripper poses are inverted. Robot name, URDF and joints are removed, since they belong to the original poses.
    `moving` is a folder to which images without the static background are written, which are then used; None: the
    original images are used.
    """
    if moving is not None:
        images = moving_parts([read_image(capture.folder / name) for name in capture.images])
        for name, image in zip(capture.images, images, strict=True):
            write_bytes(moving / name, encode_png(image))  # PNG whatever the name
    return replace(
        capture,
        folder=moving or capture.folder,
        base_from_gripper=inverse(capture.base_from_gripper),
        mount="gripper",
        others=(),
        joints=None,
        robot=None,
        urdf=None,
    )


def refined(
    capture: Capture,
    reconstruction: Reconstruction,
    found: Calibration,
    options: CalibrateOptions | None = None,
) -> Calibration:
    """Return the calibration of a fixed camera, refined from `found`, with the gripper poses as reported.

    `found` was computed with inverse gripper poses (`eye_to_hand`). A rejected calibration is not refined; it gets the
    finding WRONG_MOUNT if the camera turns out to be on the gripper.
    """
    options = options or CalibrateOptions()
    rows = reconstruction.image_index
    if not found.is_sound:
        on_gripper = solve_hand_eye(
            capture.base_from_gripper[rows], reconstruction.recon_from_camera, camera_errors="none"
        )
        why = Finding.of(FindingKind.WRONG_MOUNT, "rejects", "mount", camera=capture.camera_name)
        return (found.with_findings(why) if on_gripper.converged else found).on_fixed_camera()
    case = Case(
        capture=capture,
        reconstruction=reconstruction,
        options=options,
        robot=robot_errors(capture, options).of(rows),
        priors=(),
        hand_eye=found,
        carries="scene",
    )
    if found.source == "poses" or case.tracks.from_pointmaps or len(case.tracks.image) < MIN_OBSERVATIONS:
        return found.on_fixed_camera()
    case = replace(case, adjusted=adjust_case(case))
    state, effects_found = effects(of_case(case))
    adjusted, effects_found = with_effects(case, state, effects_found)
    answer = adjusted or case.adjusted
    assert answer is not None
    scale, gripper_from_object = recon_frame(answer, case.tracks)
    uncertainty = uncertainty_of(answer)
    intrinsics = answer.problem.intrinsics(answer.state)[0].with_std(uncertainty.intrinsics_std)
    again = replace(
        found,
        on_gripper=answer.state.x[0],
        resting=gripper_from_object,
        scale=scale,
        uncertainty=replace(uncertainty, seen=found.uncertainty.seen, scene=found.uncertainty.scene),
        intrinsics=intrinsics,
        robot_noise=answer.noise,
        next_poses=(),
        findings=tuple(one for one in found.findings if one.kind not in EFFECTS),
    )
    return judged(with_findings(judged(again), effects_found)).on_fixed_camera()
