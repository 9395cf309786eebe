"""State of a live calibration after each image: as a record, as lines of the terminal, and as JSON for a program."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.record import AnyCalibration, Calibration
from jcr.calibration.summary import leave_one_out_text
from jcr.errors import count_of
from jcr.findings import Finding, FindingKind, sentence, without_consequences
from jcr.number_format import significant
from jcr.records import LeaveOneOut

CONFIRMING_IMAGES = 8
"""Least number of used images with which the leave-one-out error is reported and can confirm the accuracy."""
REQUIREMENT_MET = "requirement met: finish, or go on"
FIRST_ADVICE = "rotate the wrist by 20° or more, and move, between images"


@dataclass(frozen=True, kw_only=True, repr=False)
class LiveProgress:
    """State of a live calibration: its images, findings and calibration."""

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
    points_in_base: Float[ndarray, "p 3"] | None = None
    """Reconstructed points of the scene (m, base frame); None without a calibration."""

    def __repr__(self) -> str:
        found = "no calibration yet" if self.hand_eye is None else self.hand_eye.in_short
        return f"<LiveProgress: {len(self.registered)} of {len(self.images)} images registered; {found}>"

    @property
    def reached(self) -> tuple[float, float] | None:
        """Accuracy of the calibration (`reached_accuracy`); None without a calibration."""
        return None if self.hand_eye is None else reached_accuracy(self.hand_eye)

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
        wrong = faults(self)
        return f"{accuracy_line(self)}\n{sentence(wrong[0]) if wrong else advice(self)}"

    def as_json(self) -> dict[str, Any]:
        """Return the state as values of JSON: accuracies in mm and degrees."""
        error = self.leave_one_out
        mm, deg = self.reached or (None, None)
        return {
            "images": list(self.images),
            "registered": list(self.registered),
            "translation_95_mm": mm,
            "rotation_95_deg": deg,
            "verdict": None if self.hand_eye is None else self.hand_eye.verdict,
            "findings": [
                {"kind": one.kind.value, "severity": one.severity, "images": list(one.images)}
                | {"text": one.text, "remedy": one.remedy}
                for one in self.findings
            ],
            "leave_one_out": None if error is None else [error.translation_mm, error.rotation_deg],
            "requirement_met": self.requirement_met,
        }


def reached_accuracy(hand_eye: AnyCalibration) -> tuple[float, float] | None:
    """Return the bounds (mm, degrees) on 95 % of the errors of a point at the working distance; None if unknown."""
    seen = None if hand_eye.uncertainty is None else hand_eye.uncertainty.seen
    return None if seen is None else (float(seen.within_95_mm), float(seen.rotation_95_deg))


def faults(state: LiveProgress) -> list[Finding]:
    """Return the findings that reject the calibration or warn, first those about the image added last.

    Findings that only state that more images are needed are left out.
    """
    more_images = FindingKind.NOT_EXACT_ENOUGH, FindingKind.FEW_IMAGES
    acting = (one for one in without_consequences(state.findings) if one.severity != "informs")
    found = [one for one in acting if one.kind not in more_images]
    return sorted(found, key=lambda one: one.images != (state.added,))


def finding_lines(state: LiveProgress) -> list[str]:
    """Return each finding of `faults` as a sentence; one about a single image has the commands to retake or remove it.

    Images are numbered from 1 in the commands.
    """
    retake = {name: f" (retake {k}, or remove {k})" for k, name in enumerate(state.images, start=1)}
    return [
        sentence(one) + (retake.get(one.images[0], "") if len(one.images) == 1 else "")
        for one in faults(state)
    ]


def advice(state: LiveProgress) -> str:
    """Return the next action: to finish, to add the images that a missed accuracy needs, or to rotate the wrist."""
    if state.requirement_met:
        return REQUIREMENT_MET
    missed = (one.remedy for one in state.findings if one.kind is FindingKind.NOT_EXACT_ENOUGH)
    return next(missed, FIRST_ADVICE)


def progress_lines(state: LiveProgress) -> list[str]:
    """Return the state as lines of the terminal: accuracy, faults, and advice; advice alone with one image at most."""
    if state.hand_eye is None and len(state.images) <= 1:
        return [FIRST_ADVICE]
    below = finding_lines(state)
    if (error := state.leave_one_out) is not None:
        below.insert(0, f"leave-one-out error {leave_one_out_text(error)}")
    return [accuracy_line(state), *(f"  {line}" for line in below), advice(state)]


def verifying_lines(run: Path, taken: int, most: int) -> list[str]:
    """Return the state of a capture that verifies a run folder: images `taken` of `most`, and what is missing."""
    missing = most - taken
    more = f"{count_of(missing, 'more image')}: {FIRST_ADVICE}; Finish verifies with those taken so far"
    return [f"{taken} of {count_of(most, 'image')} to verify {run}", *([more] if missing > 0 else [])]


def accuracy_line(state: LiveProgress) -> str:
    """Return a line with the number of registered images and the reached and required accuracy (95 %; mm, degrees)."""
    images = f"{len(state.registered)} of {len(state.images)} images registered"
    if state.reached is None or state.hand_eye is None:
        return f"{images}: no calibration yet"
    mm, deg = map(significant, state.reached)
    line = f"{images}: ± {mm} mm and {deg}° (95 % of errors of a point at the working distance)"
    line += "" if state.hand_eye.converged else ", rejected"
    if (required := state.hand_eye.requirement) is not None:
        met = "met" if state.requirement_met else "not met"
        if required.met and not state.requirement_met:
            met = "reached, but exceeded by the leave-one-out error"
            if state.leave_one_out is None:
                now = state.hand_eye.images_used
                met = f"reached, to be confirmed with {CONFIRMING_IMAGES} used images ({now} now)"
        line += f"; required {required.translation_mm:g} mm and {required.rotation_deg:g}°: {met}"
    return line
