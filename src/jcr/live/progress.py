"""State of a live calibration after each image: as a record, as lines of the terminal, and as JSON for a program."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.record import Calibration
from jcr.calibration.words import leave_one_out_text
from jcr.capture.controllers import CONVENTIONS, numbers_from_poses
from jcr.capture.options import ConventionName, UnitsName
from jcr.estimation.kinematics import Arm
from jcr.findings import Finding, FindingKind, remedy, sentence, text, without_consequences
from jcr.records import LeaveOneOut, NextPose
from jcr.rounding import significant

CONFIRMING_IMAGES = 8
"""Least number of used images with which the leave-one-out error is reported and can confirm the accuracy."""
REQUIREMENT_MET = "requirement met: finish, or go on"
FIRST_ADVICE = "rotate the wrist by 20° or more, and move, between images"


@dataclass(frozen=True)
class Notation:
    """Notation in which proposed gripper poses are shown: pose convention, units, and the arm for joint angles."""

    convention: ConventionName = "auto"
    """Pose convention; auto: quat-xyzw."""
    units: UnitsName = "auto"
    """Units of lengths and angles; auto: those of the convention."""
    arm: Arm | None = None
    """Arm whose joint angles are shown with the pose; None: the arm is not known, and none are shown."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """State of a live calibration: its images, findings, calibration, and the proposed next pose."""

    images: tuple[str, ...]
    """Names of all images of the capture, in the order in which they were taken."""
    added: str | None = None
    """Name of the image whose addition led to this state; None if no image was added."""
    registered: tuple[str, ...] = ()
    """Names of the images whose camera pose is known from the reconstruction."""
    findings: tuple[Finding, ...] = ()
    """Findings about single images and about the calibration, strongest first."""
    hand_eye: Calibration | None = None
    """Calibration, which may be rejected; None while fewer than three images are registered."""
    next_pose: NextPose | None = None
    """Gripper pose that improves the calibration most; None with fewer than two images."""
    next_joints: Float[ndarray, " dof"] | None = None
    """Joint angles (rad) of `next_pose`; None if the arm is not known or cannot reach the pose."""
    points_in_base: Float[ndarray, "p 3"] | None = None
    """Reconstructed points of the scene (m, base frame); None without a calibration."""

    @property
    def reached(self) -> tuple[float, float] | None:
        """Reached accuracy: bounds (mm, degrees) on 95 % of the errors of a point at the working distance.

        None without a calibration, or if the calibration has no requirement.
        """
        required = None if self.hand_eye is None else self.hand_eye.requirement
        return None if required is None else (float(required.reached_mm), float(required.reached_deg))

    @property
    def leave_one_out(self) -> LeaveOneOut | None:
        """Leave-one-out error of the calibration; None with fewer than eight used images."""
        found = self.hand_eye
        if found is None or found.inliers.sum() < CONFIRMING_IMAGES:
            return None
        return found.held_out

    @property
    def requirement_met(self) -> bool:
        """Whether the calibration is accepted, and estimated accuracy and leave-one-out error meet the requirement."""
        found, error = self.hand_eye, self.leave_one_out
        if found is None or not found.converged or found.requirement is None or error is None:
            return False
        required = found.requirement
        is_within = (
            error.translation_mm <= required.translation_mm and error.rotation_deg <= required.rotation_deg
        )
        return required.met and is_within

    def __str__(self) -> str:
        """Return two lines: the reached and required accuracy, and the next action."""
        advice = FIRST_ADVICE if self.next_pose is None else f"next pose: {next_lines(self, Notation())[0]}"
        if wrong := faults(self):
            advice = sentence(wrong[0])
        elif self.requirement_met:
            advice = REQUIREMENT_MET
        return f"{accuracy_line(self)}\n{advice}"

    def as_json(self) -> dict[str, Any]:
        """Return the state as values of JSON: poses and joints in m and rad, accuracies in mm and degrees."""
        pose, error = self.next_pose, self.leave_one_out
        mm, deg = self.reached or (None, None)
        return {
            "images": list(self.images),
            "registered": list(self.registered),
            "translation_95_mm": mm,
            "rotation_95_deg": deg,
            "verdict": None if self.hand_eye is None else self.hand_eye.verdict,
            "findings": [
                {"kind": one.kind.value, "severity": one.severity, "images": list(one.images)}
                | {"text": text(one), "remedy": remedy(one)}
                for one in self.findings
            ],
            "leave_one_out": None if error is None else [error.translation_mm, error.rotation_deg],
            "requirement_met": self.requirement_met,
            "next_base_from_gripper": None if pose is None else pose.base_from_gripper.tolist(),
            "next_joints": None if self.next_joints is None else self.next_joints.tolist(),
            "next_expected": None if pose is None else [pose.within_95_mm, pose.rotation_95_deg],
        }


def faults(state: Progress) -> list[Finding]:
    """Return the findings that reject the calibration or warn, first those about the image added last.

    Findings that only state that more images are needed are left out.
    """
    more_images = FindingKind.NOT_EXACT_ENOUGH, FindingKind.FEW_IMAGES
    acting = (one for one in without_consequences(state.findings) if one.severity != "informs")
    found = [one for one in acting if one.kind not in more_images]
    return sorted(found, key=lambda one: one.images != (state.added,))


def finding_lines(state: Progress) -> list[str]:
    """Return each finding of `faults` as a sentence; one about a single image has the commands to retake or remove it.

    Images are numbered from 1 in the commands.
    """
    retake = {name: f" (retake {k}, or remove {k})" for k, name in enumerate(state.images, start=1)}
    return [
        sentence(one) + (retake.get(one.images[0], "") if len(one.images) == 1 else "")
        for one in faults(state)
    ]


def progress_lines(state: Progress, notation: Notation) -> list[str]:
    """Return the state as lines of the terminal: accuracy, faults, and the next pose in this notation.

    With one image at most, the only line is advice; if the requirement is met, a line says so instead of the next pose.
    """
    if state.hand_eye is None and len(state.images) <= 1:
        return [FIRST_ADVICE]
    below = finding_lines(state)
    if (error := state.leave_one_out) is not None:
        below.insert(0, f"leave-one-out error {leave_one_out_text(error)}")
    lines = [accuracy_line(state), *(f"  {line}" for line in below)]
    if state.requirement_met:
        return [*lines, REQUIREMENT_MET]
    if state.next_pose is not None:
        about, *below = next_lines(state, notation)
        lines += [f"next: {about}", *(f"  {line}" for line in below)]
    return lines


def next_lines(state: Progress, notation: Notation) -> list[str]:
    """Return lines of text on the next pose: what it improves, the gripper pose in this notation, and joint angles.

    The state must have a next pose. The first line has the translation (mm) and rotation (degrees) from the closest
    image's pose, and the expected accuracy. For the convention of UR, there is also a line in URScript. A line is added
    if the arm of `notation` cannot reach the pose.
    """

    def joined(numbers: Float[ndarray, " k"], digits: int) -> str:
        """Return numbers with `digits` decimals, separated by commas."""
        return ", ".join(f"{value:.{digits}f}" for value in numbers)

    assert (new := state.next_pose) is not None
    moved, rotated = 1e3 * new.moved_m, np.degrees(new.rotation_rad)
    then = f"expected then: {significant(new.within_95_mm)} mm and {significant(new.rotation_95_deg)}°"
    convention = "quat-xyzw" if notation.convention == "auto" else notation.convention
    units: UnitsName = "mm-rad" if convention == "ur" else notation.units
    pose, joints = new.base_from_gripper[None], state.next_joints
    row = numbers_from_poses(pose, convention, units)[0]
    if convention in ("franka", "matrix"):
        order = "O_T_EE, by columns" if convention == "franka" else "base_from_gripper, by rows"
        line = f"{order}: [{joined(row, 5)}]"
    else:
        form = CONVENTIONS[convention]
        length, angle = form.units(units)
        digits = 3 * [1 if length == "mm" else 4]
        digits += (len(row) - 3) * [5 if not form.has_angles else 2 if angle == "deg" else 4]
        named = [f"{name} {value:.{n}f}" for name, value, n in zip(form.columns, row, digits, strict=True)]
        unit = f" {angle.replace('deg', '°')}" if form.has_angles else ""
        line = f"{' '.join(named[:3])} {length}, {' '.join(named[3:])}{unit}"
    lines = [f"{moved:.0f} mm and {rotated:.0f}° from {new.like}; {then}", line]
    if convention == "ur":
        movel = f"URScript: movel(p[{joined(numbers_from_poses(pose, 'ur')[0], 5)}], a=0.3, v=0.1)"
        lines[1:] = [f"pendant: {line}", movel]
    is_used = all(one.kind is not FindingKind.ROBOT_UNUSED for one in state.findings)
    if joints is not None:
        lines += [f"joints, °: {joined(np.degrees(joints), 2)}", f"joints, rad: {joined(joints, 4)}"]
    elif notation.arm is not None and is_used:
        lines.append(f"a {notation.arm.name} cannot reach this pose within its joint limits: go near it")
    return lines


def accuracy_line(state: Progress) -> str:
    """Return a line with the number of registered images and the reached and required accuracy (95 %; mm, degrees)."""
    images = f"{len(state.registered)} of {len(state.images)} images registered"
    if state.reached is None or state.hand_eye is None:
        return f"{images}: no calibration yet"
    mm, deg = map(significant, state.reached)
    line = f"{images}: ± {mm} mm and {deg}° (95 % of errors of a point at the working distance)"
    line += "" if state.hand_eye.is_sound else ", rejected"
    if (required := state.hand_eye.requirement) is not None:
        met = "met" if state.requirement_met else "not met"
        if required.met and not state.requirement_met:
            met = "reached, but exceeded by the leave-one-out error"
            if state.leave_one_out is None:
                met = f"reached, to be confirmed with {CONFIRMING_IMAGES} images"
        line += f"; required {required.translation_mm:g} mm and {required.rotation_deg:g}°: {met}"
    return line
