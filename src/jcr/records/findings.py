"""What was found to speak against a calibration, or to be worth knowing: data, from which `words.py` makes sentences."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import RejectedError

Severity = Literal["rejects", "warns", "informs"]
Mend = Literal["reconstruction", "motion", "images", "intrinsics", "poses", "mount", "robot", "none"]
"""What would help: another reconstruction of the same images, other motions, more or other images, other intrinsics,
corrected gripper poses, a firm mount, the arm's name or joint angles; or nothing."""
Verdict = Literal["accepted", "accepted with warnings", "rejected"]


class FindingKind(StrEnum):
    """Every kind of finding there is."""

    UNOBSERVABLE = "unobservable motion"
    FEW_IMAGES = "few images"
    FEW_AGREE = "few images agree"
    POSES_CONTRADICT_IMAGES = "gripper poses contradict the images"
    POSE_CONVENTION = "pose convention"
    NOISE_ABOVE_GIVEN = "noise above the given one"
    UNCERTAIN = "too uncertain"
    LEAVE_ONE_OUT = "leave-one-out error"
    NOT_EXACT_ENOUGH = "requirement not met"
    FOCUS_BY_DISTANCE = "focal length changes with distance"
    FOCUS_BY_IMAGE = "focal length differs between images"
    ZOOM = "focal length changed once"
    ROLLING_SHUTTER = "images sheared alike"
    ROLLING_SHUTTER_BY_IMAGE = "images sheared each by itself"
    THIN_PRISM = "thin prism"
    CENTRE_SAGS = "principal point moves with gravity"
    INTRINSICS = "intrinsics contradict the images"
    SLIP = "camera moved on the gripper"
    DRIFT = "camera drifts on the gripper"
    BASE_MOVED = "robot base moved against the scene"
    DELAY = "gripper poses early or late"
    WRONG_MOUNT = "wrong mount"
    ROBOT_UNUSED = "robot not used"
    JOINT_OFFSETS = "joint offsets"
    LENGTHS = "robot lengths differ by direction"
    BASE_LEANS = "robot base leans with reach"
    TOOL_SAGS = "tool sags"
    BOARD_SIZE = "board size contradicts the robot"
    SCALES = "lengths contradict each other"
    BOARD_SIDE = "side of a board"
    BOARD_MOVED = "board at several places"
    BOARD_NOT_FOUND = "board not found"
    NETWORK_SCALE = "a network's metre contradicts the robot"
    SCALE_ASSUMED = "scale assumed"
    SCALE_FROM_ROBOT = "scale from the robot alone"
    IMAGES_ROTATED = "images rotated"
    BOARD_IN_VIEW = "board in view"
    RECONSTRUCTION = "reconstruction"
    NO_RECONSTRUCTION = "no reconstruction"
    OWN_REJECTED = "the capture's own camera is rejected"
    FEW_POINTS_SHARED = "few points shared with the scene"
    FEW_LOCALISED = "few images localised"
    NO_COMMON_POSE = "no image taken with one that is used"
    ONE_GRIPPER_POSE = "camera seen at one gripper pose"
    SECOND_ON_ARM = "second camera on another arm"
    NOT_FIXED = "camera not fixed"
    NOT_RIGID = "camera not rigid on the gripper"
    FAR_FROM_GRIPPER = "camera far from the gripper"
    IMAGE_MISSES = "image contradicts the camera's place"
    PLACE_UNCERTAIN = "camera's place too uncertain"
    AT_ANOTHER_CAMERA = "camera stands where another was"
    POINTS_CROWDED = "points crowded"
    STATIC_IMAGES = "images show no motion"
    BLURRED = "images blurred"
    FEW_USED = "few images used"
    POSES_SWAPPED = "gripper poses exchanged"
    POSE_CONTRADICTS_IMAGE = "gripper pose contradicts its image"
    NOT_REGISTERED = "image not registered"
    FRAME_REPEATED = "image repeats another"
    SAMPLE_REPEATED = "image and pose repeat others"
    POSE_UNIT = "gripper pose in another unit"
    SIZE_DIFFERS = "image size differs"
    CLOCK_JUMPS = "clock jumps back"


Kind = FindingKind


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that was found, its size, and what would help."""

    kind: Kind
    severity: Severity
    mend: Mend = "none"
    images: tuple[str, ...] = ()
    """Names of the images concerned; empty where it concerns all or none."""
    joints: tuple[int, ...] = ()
    """Joints concerned, the first is 1."""
    value: float | None = None
    """Size of what was found, in the unit of its kind (docs: reference/findings); None where it has no size."""
    std: float | None = None
    """One standard deviation of the value."""
    p: float | None = None
    """Chance of this or more where there is nothing to find."""
    shift: tuple[float, ...] | None = None
    """How far the calibration would move if this were allowed for, in COVARIANCE_ORDER; its outer product is part of
    the covariance. None where it adds nothing."""
    intrinsics_shift: tuple[float, ...] | None = None
    """How far the intrinsics would move with it, in the order of camera.parameters: what they make good of `shift` harms
    nobody who uses both. None where it is of X alone."""
    details: Mapping[str, float | str] = field(default_factory=dict)
    """Further numbers (m, rad, px, shares) and names that the sentence needs."""

    @classmethod
    def of(
        cls,
        kind: Kind,
        severity: Severity,
        mend: Mend = "none",
        *images: str,
        value: float | None = None,
        std: float | None = None,
        p: float | None = None,
        **details: float | str,
    ) -> "Finding":
        """A finding about these images, with further numbers and names as `details`."""
        return cls(
            kind=kind, severity=severity, mend=mend, images=images, value=value, std=std, p=p, details=details
        )

    @property
    def covariance(self) -> Float[ndarray, "7 7"]:
        """What it adds to that of the calibration."""
        shift = np.zeros(7) if self.shift is None else np.array(self.shift)
        return np.outer(shift, shift)


def no_reconstruction(error: RejectedError) -> tuple[Finding, ...]:
    """The failure of every back end as findings."""
    details = {"text": error.what, "remedy": "; ".join(error.remedies)}
    failed = Finding(kind=Kind.NO_RECONSTRUCTION, severity="rejects", mend="reconstruction", details=details)
    return (failed, *(Finding.of(Kind.RECONSTRUCTION, "warns", text=text) for text in error.also))


CAMERA = frozenset(
    {
        Kind.FOCUS_BY_DISTANCE,
        Kind.FOCUS_BY_IMAGE,
        Kind.ZOOM,
        Kind.ROLLING_SHUTTER,
        Kind.ROLLING_SHUTTER_BY_IMAGE,
        Kind.THIN_PRISM,
        Kind.CENTRE_SAGS,
        Kind.INTRINSICS,
    }
)
"""Kinds by which the camera is not one with these intrinsics."""
BENT = frozenset({Kind.LENGTHS, Kind.BASE_LEANS, Kind.TOOL_SAGS})
"""Kinds by which the robot's poses are bent, depending on where the gripper is."""
LASTING = (
    CAMERA
    | BENT
    | {
        Kind.BOARD_SIZE,
        Kind.SCALES,
        Kind.SLIP,
        Kind.DRIFT,
        Kind.BASE_MOVED,
        Kind.DELAY,
        Kind.POSE_CONVENTION,
        Kind.WRONG_MOUNT,
        Kind.STATIC_IMAGES,
        Kind.BLURRED,
        Kind.POSES_SWAPPED,
    }
)
"""Kinds about camera, robot, mount and order: they hold for every reconstruction of the same images."""
CAUSES = LASTING | {Kind.FEW_USED}
"""Kinds that explain others: what is uncertain, or does not fit, is so because of them."""
OF_IMAGES = frozenset({Kind.STATIC_IMAGES, Kind.BLURRED})
"""Kinds that the images show without any pose; they explain other causes, too."""
RANK: dict[Severity, int] = {"rejects": 0, "warns": 1, "informs": 2}


def strongest_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """What rejects, then what warns, then what informs; of the same severity causes, those of the images first, then
    their consequences, each in the order given."""

    def place(finding: Finding) -> tuple[int, bool, bool]:
        return RANK[finding.severity], finding.kind not in OF_IMAGES, finding.kind not in CAUSES

    return tuple(sorted(findings, key=place))


CONSEQUENCES = frozenset(
    {Kind.FEW_AGREE, Kind.POSES_CONTRADICT_IMAGES, Kind.NOISE_ABOVE_GIVEN, Kind.UNCERTAIN, Kind.LEAVE_ONE_OUT}
)
"""Kinds that are so because of what rejects a calibration, where that is a cause."""
OF_FEW_IMAGES = frozenset({Kind.UNOBSERVABLE, Kind.SLIP, Kind.DRIFT, Kind.BASE_MOVED, Kind.DELAY})
"""Those that are so, too, where too few of the images could be used."""


def is_explained(findings: Sequence[Finding]) -> bool:
    """Whether what rejects a calibration is a cause, against which neither more images nor other motions help."""
    return bool(findings) and findings[0].severity == "rejects" and findings[0].kind in CAUSES


def without_consequences(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Findings, strongest first, without those that the first one explains: their remedies are none."""
    if not is_explained(findings):
        return tuple(findings)
    first, *others = findings
    few = first.kind in OF_IMAGES or first.kind is Kind.FEW_USED
    explained = CONSEQUENCES | (OF_FEW_IMAGES if few else frozenset())
    return (first, *(one for one in others if one.kind not in explained))


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """The verdict is that of the worst finding."""
    severities = {finding.severity for finding in findings}
    if "rejects" in severities:
        return "rejected"
    return "accepted with warnings" if "warns" in severities else "accepted"
