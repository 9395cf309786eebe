"""What a calibration that is made while the images are taken has come to after each of them."""

from dataclasses import dataclass

from jaxtyping import Float
from numpy import ndarray

from jcr.records import Finding, HandEye, LeaveOneOut, NextPose


@dataclass(frozen=True, kw_only=True)
class Reached:
    """How exact the calibration was with the first images."""

    images: int
    translation_mm: float
    """95 % of errors are smaller; of what `Requirement.at` names."""
    rotation_deg: float
    accepted: bool


CONFIRMING_IMAGES = 8
"""Least number of used images with which the leave-one-out error can confirm an accuracy."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """The state of a calibration that grows by an image at a time."""

    images: tuple[str, ...]
    """Names of all that are kept, in the order in which they were taken."""
    added: str | None = None
    """The image that this is the state after; None where none was added."""
    refused: Finding | None = None
    """Why the image that was given is not kept."""
    registered: tuple[str, ...] = ()
    """Images whose cameras are known."""
    findings: tuple[Finding, ...] = ()
    """Against single images and against the calibration, strongest first; where there is none, what is missing."""
    hand_eye: HandEye | None = None
    """The calibration; None while fewer than three images are registered."""
    history: tuple[Reached, ...] = ()
    """After each image that gave a calibration."""
    next_pose: NextPose | None = None
    """The gripper pose that helps most, and what is expected of the calibration with it; None below two images."""
    next_joints: Float[ndarray, " dof"] | None = None
    """Joint angles (rad) there; None where the arm is not known or does not reach it."""
    next_like: str | None = None
    """The image whose pose is nearest to it."""
    points_in_base: Float[ndarray, "p 3"] | None = None
    """Points of the scene that are seen so far (m); None without a calibration."""

    @property
    def now(self) -> Reached | None:
        """Accuracy of the calibration; None where there is none with these images."""
        return self.history[-1] if self.hand_eye is not None and self.history else None

    @property
    def leave_one_out(self) -> LeaveOneOut | None:
        """Mean error of each image's gripper pose predicted by the others; None where too few images are used."""
        found = self.hand_eye
        if found is None or found.inliers.sum() < CONFIRMING_IMAGES:
            return None
        return found.leave_one_out

    @property
    def requirement_met(self) -> bool:
        """Whether the calibration is accepted, estimated as exact as required, and its leave-one-out error agrees."""
        found, error = self.hand_eye, self.leave_one_out
        if found is None or not found.converged or found.requirement is None or error is None:
            return False
        required = found.requirement
        is_within = (
            error.translation_mm <= required.translation_mm and error.rotation_deg <= required.rotation_deg
        )
        return required.met and is_within
