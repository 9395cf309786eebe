"""Test of given intrinsics against the focal length of a network."""

from dataclasses import replace

import numpy as np

from jcr.calibration.case import Case, CheckResult
from jcr.estimation.intrinsics_prior import MEASURED, camera_with_prior
from jcr.findings import Finding, FindingKind

OF_NETWORK = 1.64
"""Standard deviations between a network's focal length and the given one; a tenth of the networks is farther off."""


def check_predicted_focal(case: Case) -> CheckResult:
    """Return that the focal length of a network contradicts the one that was given; their difference is uncertainty."""
    given, predicted = case.capture.intrinsics, case.reconstruction.predicted_focal
    if given is None or predicted is None:
        return CheckResult()
    focal, std = predicted[0], predicted[0] * predicted[1]
    used, off = case.reconstruction.intrinsics, focal / given.fx - 1
    if abs(off) < OF_NETWORK * np.hypot(predicted[1], MEASURED["f"]):
        return CheckResult()
    size = {"focal": focal, "focal_std": std, "focal_given": given.fx}
    by_focal = camera_with_prior(used, {"f": abs(off)})
    moved = tuple((by_focal.directions @ by_focal.std).tolist())
    found = Finding.of(FindingKind.INTRINSICS, "warns", "intrinsics", **size)
    return CheckResult((replace(found, shift=(0.0,) * 7, intrinsics_shift=moved),))
