"""Record of a finding, and the order, verdict and sentences of several."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import RejectedError
from jcr.findings.sentences import filled
from jcr.findings.table import FindingKind

Severity = Literal["rejects", "warns", "informs"]
Concerns = Literal["reconstruction", "motion", "images", "intrinsics", "poses", "mount", "robot", "none"]
"""Part of the capture that the remedy changes: another reconstruction of the same images, other motions, more or other
images, other intrinsics, corrected gripper poses, a firm mount, the arm's name or joint angles; or nothing."""
Verdict = Literal["accepted", "accepted with warnings", "rejected"]
RANK: dict[Severity, int] = {"rejects": 0, "warns": 1, "informs": 2}


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Observation that speaks against a calibration, or that is worth stating."""

    # Files also hold text and remedy, which follow from the fields.
    __pydantic_config__ = {"extra": "ignore"}
    kind: FindingKind
    severity: Severity
    concerns: Concerns = "none"
    images: tuple[str, ...] = ()
    """Names of the images concerned; empty where it concerns all or none."""
    joints: tuple[int, ...] = ()
    """Joints concerned, the first is 1."""
    value: float | None = None
    """Size, in the unit of its kind (docs: reference/findings); None where it has no size."""
    std: float | None = None
    """One standard deviation of the value."""
    p: float | None = None
    """Chance of this or more where there is nothing to find."""
    shift: tuple[float, ...] | None = None
    """Change of the calibration if this were allowed for, in COVARIANCE_ORDER; its outer product is part of the
    covariance. None where it adds nothing."""
    intrinsics_shift: tuple[float, ...] | None = None
    """Change of the intrinsics with it, in the order of camera.parameters. What these compensate of `shift` is no
    error for a user of both. None where it concerns the transform alone."""
    details: Mapping[str, float | str] = field(default_factory=dict)
    """Further numbers (m, rad, px, shares) and names that the sentence needs."""

    @classmethod
    def of(
        cls,
        kind: FindingKind,
        severity: Severity,
        concerns: Concerns = "none",
        *images: str,
        value: float | None = None,
        std: float | None = None,
        p: float | None = None,
        **details: float | str,
    ) -> "Finding":
        """Make a finding about these images, with further numbers and names as `details`."""
        return cls(
            kind=kind,
            severity=severity,
            concerns=concerns,
            images=images,
            value=value,
            std=std,
            p=p,
            details=details,
        )

    @property
    def covariance(self) -> Float[ndarray, "7 7"]:
        """Its part of the covariance of the calibration, in COVARIANCE_ORDER."""
        shift = np.zeros(7) if self.shift is None else np.array(self.shift)
        return np.outer(shift, shift)


def text(finding: Finding) -> str:
    """Return the message: what is wrong, in one sentence."""
    return filled(finding.kind.row.message, finding)


def remedy(finding: Finding) -> str:
    """Return the remedy in one sentence; empty where nothing helps or nothing need be done."""
    return filled(finding.kind.row.remedy, finding)


def sentence(finding: Finding) -> str:
    """Return message and remedy in one line."""
    return "; ".join(filter(None, (text(finding), remedy(finding))))


def doubt_of(findings: Iterable[Finding]) -> str | None:
    """Return the first reason of a rejection, of findings that are strongest first; None where nothing rejects."""
    return next((sentence(finding) for finding in findings if finding.severity == "rejects"), None)


def warnings_of(findings: Iterable[Finding]) -> tuple[str, ...]:
    """Return a sentence for each finding that rejects or warns."""
    return tuple(sentence(finding) for finding in findings if finding.severity != "informs")


def no_reconstruction(error: RejectedError) -> tuple[Finding, ...]:
    """Return the failure of every back end as findings."""
    details = {"text": error.what, "remedy": "; ".join(error.remedies)}
    failed = Finding(
        kind=FindingKind.NO_RECONSTRUCTION, severity="rejects", concerns="reconstruction", details=details
    )
    return (failed, *(Finding.of(FindingKind.RECONSTRUCTION, "warns", text=text) for text in error.also))


def is_cause(finding: Finding) -> bool:
    """Test whether a finding explains others."""
    return bool(finding.kind.row.explains)


def is_lasting(finding: Finding) -> bool:
    """Test whether a finding holds for every reconstruction of the same images: camera, robot, mount, order."""
    return is_cause(finding) and finding.kind.row.group != "reconstruction"


def strongest_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Order findings by severity; of one severity those of the images alone, other causes, then consequences."""

    def place(finding: Finding) -> tuple[int, bool, bool]:
        return RANK[finding.severity], finding.kind.row.group != "images", not is_cause(finding)

    return tuple(sorted(findings, key=place))


def is_explained(findings: Sequence[Finding]) -> bool:
    """Test whether a cause rejects a calibration, against which neither more images nor other motions help."""
    return bool(findings) and findings[0].severity == "rejects" and is_cause(findings[0])


def without_consequences(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return findings, strongest first, without those that the first one explains: their remedies do not help."""
    if not is_explained(findings):
        return tuple(findings)
    first, *others = findings
    return (first, *(one for one in others if one.kind not in first.kind.row.explains))


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict, that of the worst finding."""
    severities = {finding.severity for finding in findings}
    if "rejects" in severities:
        return "rejected"
    return "accepted with warnings" if "warns" in severities else "accepted"
