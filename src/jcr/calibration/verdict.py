"""Findings in a calibration: their shifts add to its covariance, and a result that becomes too uncertain is rejected."""

from dataclasses import replace

import numpy as np

from jcr.calibration.case import Case, CheckResult
from jcr.estimation.hand_eye import judged
from jcr.findings import Finding, verdict_of
from jcr.records import HandEye


def with_checked(case: Case, checked: CheckResult) -> Case:
    """Return the case after a check."""
    hand_eye, adjusted = checked.hand_eye or case.hand_eye, checked.adjusted or case.adjusted
    return replace(case, hand_eye=with_findings(hand_eye, checked.findings), adjusted=adjusted)


def with_findings(hand_eye: HandEye, findings: tuple[Finding, ...]) -> HandEye:
    """Return a calibration with findings, and with their shifts in its covariance.

    A finding rejects the calibration where its shift makes it too uncertain, or where it explains a rejection.
    """
    named: list[Finding] = []
    for finding in findings:
        if finding.shift is None:
            named.append(finding)
            continue
        accepted = hand_eye.converged and verdict_of([*named, finding]) != "rejected"
        both = finding.shift, finding.intrinsics_shift
        shifts = None if both[1] is None else (np.array(both[0]), np.array(both[1]))
        hand_eye = hand_eye.with_fault(finding.covariance, shifts)
        # More images, the remedy for a large covariance, do not help against a fault: that finding is left out.
        if not accepted or not judged(hand_eye).converged:
            finding = replace(finding, severity="rejects")
        named.append(finding)
    return hand_eye.with_findings(*named)
