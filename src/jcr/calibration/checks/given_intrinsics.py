"""Tests of given intrinsics against the images and against the focal length of a network.

Given intrinsics are measurements with a small error. The images and the robot's motion determine them all the same:
freed in the bundle adjustment, focal length, principal point and two radial coefficients have an estimate and a
covariance, in which what few images, a flat scene or little rotation leave open is large, and nothing is then claimed.
"""

from dataclasses import replace

import numpy as np

from jcr.calibration.adjust import adjust_case, refined_by
from jcr.calibration.case import Case, Checked
from jcr.calibration.checks.imaged import Imaged, of_case
from jcr.camera import PARAMETERS, by_parameters, parameters, unproject
from jcr.estimation.hand_eye import judged
from jcr.estimation.intrinsics_prior import ESTIMATED, FIXED, MEASURED, camera_with_prior
from jcr.estimation.score_test import freed_intrinsics
from jcr.estimation.solve import Solution
from jcr.estimation.wrist import estimate_of
from jcr.findings import Finding, FindingKind
from jcr.geometry import ARM, step_between

SURE = 5.0
"""Standard deviations, widened for an estimated robot noise. Of 48 simulated webcam captures of 5 to 15 images with the
true intrinsics, freed focal lengths were 1.03 of them off (rms), at most 2.9."""
DOUBT = 2.0, 0.5
"""Standard deviations and share of what matters that leave doubt."""
OFF = 0.01
"""Relative. Intrinsics stored with real captures are up to 1.2 % from those of a board (jcr docs results/real)."""
OFF_CENTRE = ESTIMATED["cx"]
"""Share of the width: centres of cheap cameras scatter by so much, and an offset that was found with a wrong one is
right where it is used with the same."""
OF_NETWORK = 1.64
"""Standard deviations between a network's focal length and the given one; a tenth of the networks is farther off."""
CX, CY, K1, K2 = (PARAMETERS.index(name) for name in ("cx", "cy", "k1", "k2"))


def intrinsics_contradiction(case: Case) -> Checked:
    """Return the contradiction between the used images and the given intrinsics; nothing where they agree.

    The calibration is then the one with the intrinsics that the images show, which those that were given are no part of;
    one that was rejected stays, and the finding has the shift.
    """
    given, fit = case.reconstruction.intrinsics, case.hand_eye.before or case.hand_eye
    contradiction = contradicted_by(of_case(case))
    if contradiction is None or contradiction[1].severity == "informs":
        return Checked()
    freed, contradicted = contradiction
    if case.hand_eye.converged and (refined := judged(refined_by(case, freed))).converged:
        return Checked((contradicted,), refined, freed)
    with_found, as_given = (
        estimate_of(one, case.tracks)
        for one in (freed, adjust_case(case, prior=camera_with_prior(given, FIXED)))
    )
    # Camera poses may have been found with other intrinsics than those given: the farther of the two answers counts.
    shifts = [
        np.append(
            step_between(start.gripper_from_camera, with_found.gripper_from_camera),
            np.log(with_found.scale / start.scale),
        )
        for start in (fit.estimate, as_given)
    ]
    shift = max(shifts, key=lambda by: float(np.linalg.norm(by[:6] * [1, 1, 1, ARM, ARM, ARM])))
    # Where the intrinsics are wrong, bundle adjustment bends the robot's poses to them: the fit to camera poses bends
    # least.
    return Checked((replace(contradicted, shift=tuple(shift.tolist())),), case.hand_eye.before)


def check_predicted_focal(case: Case) -> Checked:
    """Return that the focal length of a network contradicts the one that was given; their difference is uncertainty."""
    given, predicted = case.capture.intrinsics, case.reconstruction.predicted_focal
    if given is None or predicted is None:
        return Checked()
    focal, std = predicted[0], predicted[0] * predicted[1]
    used, off = case.reconstruction.intrinsics, focal / given.fx - 1
    if abs(off) < OF_NETWORK * np.hypot(predicted[1], MEASURED["f"]):
        return Checked()
    size = {"focal": focal, "focal_std": std, "focal_given": given.fx, "predicted": 1.0}
    by_focal = camera_with_prior(used, {"f": abs(off)})
    moved = tuple((by_focal.directions @ by_focal.std).tolist())
    found = Finding.of(FindingKind.INTRINSICS, "warns", "intrinsics", **size)
    return Checked((replace(found, shift=(0.0,) * 7, intrinsics_shift=moved),))


def contradicted_by(imaged: Imaged, sure: float = SURE) -> tuple[Solution, Finding] | None:
    """Adjust the images as if no intrinsics had been given for one camera; return this and the contradiction.

    Return None where there is none. A finding of less than `sure` standard deviations only informs.

    Only when one Gauss-Newton step from the adjustment with these, the intrinsics freed, leaves some doubt are the
    intrinsics adjusted until they settle.
    """
    if not _found_off(imaged, imaged.adjusted, *DOUBT):
        return None
    freed = imaged.adjust(camera_with_prior(imaged.start, ESTIMATED), None, None)
    surely = _found_off(imaged, freed, sure, 1.0)
    found = surely or _found_off(imaged, freed, *DOUBT)
    if not found:
        return None
    severity = "warns" if surely else "informs"
    return freed, Finding.of(FindingKind.INTRINSICS, severity, "intrinsics", **found)


def _found_off(imaged: Imaged, adjusted: Solution, sure: float, share: float) -> dict[str, float]:
    """Return each part of the intrinsics that is off by `sure` standard deviations and by `share` of a limit (px)."""
    given = imaged.start
    camera, covariance = freed_intrinsics(adjusted, camera_with_prior(given, ESTIMATED), imaged.camera)
    by = camera - parameters(given)
    std = np.sqrt(np.diag(covariance))
    off: dict[str, float] = {}
    if abs(by[0]) > max(sure * std[0], share * OFF * given.fx):
        off |= {"focal": float(camera[0]), "focal_std": float(std[0]), "focal_given": given.fx}
    used_radius = np.linalg.norm(unproject(given, imaged.x_px)[:, :2], axis=1)
    radius = np.linspace(0.2, 1.0, 9) * np.quantile(used_radius, 0.95)
    ray = np.stack([radius, 0 * radius, np.ones(9)], axis=1)
    bends = by_parameters(given, ray)[:, 0, [K1, K2]]
    bent_px = bends @ by[[K1, K2]]
    bent_std_px = np.sqrt(np.einsum("rk,kl,rl->r", bends, covariance[np.ix_([K1, K2], [K1, K2])], bends))
    most = int(np.abs(bent_px).argmax())
    px, px_std = float(abs(bent_px[most])), float(bent_std_px[most])
    if px > max(sure * px_std, share * OFF * given.fx * radius[most]):
        off |= {"bend": px, "bend_std": px_std}
    centre_std = std[[CX, CY]]
    if (np.abs(by[[CX, CY]]) > np.maximum(sure * centre_std, share * OFF_CENTRE * given.width)).any():
        off |= {"cx": float(camera[CX]), "cy": float(camera[CY]), "centre_std": float(centre_std.max())}
        off |= {"cx_given": given.cx, "cy_given": given.cy}
    return off
