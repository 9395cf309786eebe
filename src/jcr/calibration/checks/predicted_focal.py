"""Check of given intrinsics by the focal length that a network predicts."""

from dataclasses import replace

import numpy as np

from jcr.calibration.case import Case
from jcr.estimation.intrinsics_prior import MEASURED, camera_with_prior
from jcr.findings import Finding, FindingKind
from jcr.rounding import significant

OF_NETWORK = 1.64
"""Standard deviations between a network's focal length and the given one; a tenth of the networks is farther off."""


def check_predicted_focal(case: Case) -> Case:
    """Report that a network's focal length contradicts the one that was given; their difference is uncertainty."""
    given, predicted = case.capture.intrinsics, case.reconstruction.predicted_focal
    if given is None or predicted is None:
        return case
    focal, relative_std = predicted
    off = focal / given.fx - 1
    if abs(off) < OF_NETWORK * np.hypot(relative_std, MEASURED["f"]):
        return case
    sizes = f"{focal:.0f} ± {significant(focal * relative_std)} px where {given.fx:.0f} is given"
    details = {
        "source": "pointmaps",
        "shown": f"a focal length of {sizes}",
        "fx": focal,
        "fx_given": given.fx,
    }
    by_focal = camera_with_prior(case.reconstruction.intrinsics, {"f": abs(off)})
    moved = tuple((by_focal.directions @ by_focal.std).tolist())
    found = Finding.of(FindingKind.INTRINSICS, "warns", "intrinsics", **details)
    return case.after((replace(found, shift=(0.0,) * 7, intrinsics_shift=moved),))
