"""The records that flow from stage to stage, and nothing else.

Frames: `base`, `gripper`, `camera` (OpenCV optical: x right, y down, z forward), `recon` (arbitrary origin
and unit). Pixel (0, 0) is the *centre* of the top-left pixel, as in OpenCV. Metres and radians.
"""

from jcr.records.calibration import (
    COVARIANCE_ORDER,
    Attempt,
    Budget,
    DepthCheck,
    Excitation,
    HandEye,
    HeldOut,
    ImageVerdict,
    JointOffsets,
    NextPose,
    Observability,
    Refinement,
    Requirement,
    RobotNoise,
    ScaleCheck,
)
from jcr.records.capture import (
    COEFFICIENTS,
    Capture,
    CellCamera,
    Coefficients,
    Intrinsics,
    LensModel,
    Mount,
    PosePairs,
    coefficients_of,
)
from jcr.records.cloud import PointCloud
from jcr.records.findings import RANK, Finding, Kind, Mend, Severity, Verdict, verdict_of
from jcr.records.reconstruction import (
    BOTH,
    MATCHED,
    NO_DEPTH,
    PRIOR,
    CameraEvidence,
    Pointmaps,
    Reconstruction,
    Tracks,
)

__all__ = [
    "Attempt",
    "BOTH",
    "Budget",
    "COVARIANCE_ORDER",
    "CameraEvidence",
    "COEFFICIENTS",
    "Capture",
    "CellCamera",
    "Coefficients",
    "DepthCheck",
    "Excitation",
    "Finding",
    "HandEye",
    "HeldOut",
    "ImageVerdict",
    "Intrinsics",
    "JointOffsets",
    "LensModel",
    "Kind",
    "MATCHED",
    "Mend",
    "Mount",
    "NO_DEPTH",
    "NextPose",
    "Observability",
    "PRIOR",
    "PointCloud",
    "Pointmaps",
    "PosePairs",
    "RANK",
    "Reconstruction",
    "Refinement",
    "Requirement",
    "RobotNoise",
    "ScaleCheck",
    "Severity",
    "Tracks",
    "Verdict",
    "coefficients_of",
    "verdict_of",
]
