"""The state of a growing calibration as lines that a person reads at the arm, and as an answer for a program."""

from collections.abc import Sequence

import numpy as np

from jcr.live.arm_words import ArmWords, pose_lines
from jcr.live.asks import Answer
from jcr.live.calibration_progress import Progress, Reached
from jcr.records import Finding, Kind
from jcr.records.findings import without_consequences
from jcr.records.words import remedy, sentence, text
from jcr.rounding import significant

EARLIER = 5
"""States before the present one that are printed."""


def progress_lines(state: Progress, require: tuple[float, float] | None, words: ArmWords) -> list[str]:
    """How exact the calibration is beside what is required, how it came to that, what is wrong, and the next pose."""
    if state.hand_eye is None and len(state.images) <= 1:
        return ["rotate the wrist by 20° or more, and move, between images"]
    lines = [f"{_registered(state)}: {_accuracy(state, require)}"]
    if len(earlier := state.history[-EARLIER - 1 : -1]) and state.now is not None:
        course = " → ".join(significant(one.translation_mm) for one in (*earlier, state.now))
        angles = " → ".join(significant(one.rotation_deg) for one in (*earlier, state.now))
        lines.append(f"  image by image: {course} mm, {angles}°")
    if (error := state.leave_one_out) is not None:
        lines.append(
            f"  leave-one-out error {significant(error.translation_mm)} mm and {significant(error.rotation_deg)}°"
        )
    for one in faults(state):
        number = number_of(one, state.images)
        commands = "" if number is None else f" (retake {number}, or remove {number})"
        lines.append(f"  {sentence(one)}{commands}")
    if state.next_pose is not None:
        lines.append(f"next: {next_sentence(state)}")
        lines += [f"  {line}" for line in next_lines(state, words)]
    return lines


def faults(state: Progress) -> list[Finding]:
    """What is found against the images and the calibration, that of the last image first; not that more images help."""
    found = [
        one
        for one in without_consequences(state.findings)
        if one.severity != "informs" and one.kind not in (Kind.NOT_EXACT_ENOUGH, Kind.FEW_IMAGES)
    ]
    return sorted(found, key=lambda one: one.images != (state.added,))


def number_of(finding: Finding, images: Sequence[str]) -> int | None:
    """The number by which commands name the one image that a finding is against; None of any other finding."""
    if len(finding.images) != 1 or finding.images[0] not in images:
        return None
    return images.index(finding.images[0]) + 1


def next_sentence(state: Progress) -> str:
    """Where the next pose is, and what is expected of the calibration with it."""
    pose = state.next_pose
    assert pose is not None
    moved, rotated = 1e3 * pose.moved_m, np.degrees(pose.rotation_rad)
    then = f"then {significant(pose.within_95_mm)} mm and {significant(pose.rotation_95_deg)}° are expected"
    return f"{moved:.0f} mm and {rotated:.0f}° from {state.next_like}; {then}"


def next_lines(state: Progress, words: ArmWords) -> list[str]:
    """The next pose in the words of the arm."""
    assert state.next_pose is not None
    lines = pose_lines(state.next_pose.base_from_gripper, words, state.next_joints)
    if words.arm is not None and state.next_joints is None:
        lines.append(f"a {words.arm.name} cannot reach this pose within its joint limits: go near it")
    return lines


def _registered(state: Progress) -> str:
    return f"{len(state.registered)} of {len(state.images)} images registered"


def _accuracy(state: Progress, require: tuple[float, float] | None) -> str:
    if state.now is None or state.hand_eye is None:
        return "no calibration yet"
    asked = "" if require is None else f"; {require[0]:g} mm and {require[1]:g}° are required"
    verdict = "" if state.hand_eye.is_sound else ", rejected"
    return f"± {_pair(state.now)} (95 % of errors of a seen point){verdict}{asked}"


def _pair(reached: Reached) -> str:
    return f"{significant(reached.translation_mm)} mm and {significant(reached.rotation_deg)}°"


def progress_answer(state: Progress) -> Answer:
    """The same for a program."""
    pose, now, error = state.next_pose, state.now, state.leave_one_out
    return {
        "images": list(state.images),
        "registered": list(state.registered),
        "translation_95_mm": None if now is None else now.translation_mm,
        "rotation_95_deg": None if now is None else now.rotation_deg,
        "verdict": None if state.hand_eye is None else state.hand_eye.verdict,
        "history": [vars(one) for one in state.history],
        "findings": [
            {
                "kind": one.kind.value,
                "severity": one.severity,
                "images": list(one.images),
                "text": text(one),
                "remedy": remedy(one),
            }
            for one in state.findings
        ],
        "leave_one_out": None if error is None else [error.translation_mm, error.rotation_deg],
        "requirement_met": state.requirement_met,
        "next_base_from_gripper": None if pose is None else pose.base_from_gripper.tolist(),
        "next_joints": None if state.next_joints is None else state.next_joints.tolist(),
        "next_expected": None if pose is None else [pose.within_95_mm, pose.rotation_95_deg],
    }
