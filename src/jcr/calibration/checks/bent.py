"""Are the robot's poses bent by where its gripper is? An axis of wrong length, a stand that leans, a tool that sags.

What the residuals show surely (estimation/bent.py) is free in the adjustment that follows. The calibration stays that of
the effective transform, which predicts best from the poses as they are reported; how far it is from that of the true
poses, and what the scale may be off by, counts as uncertainty.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.adjust import adjust_case, refined_by
from jcr.calibration.case import Case, Checked
from jcr.estimation.bent import STRAINS, WAYS, Bent, bends, by_scale, tested, to_straight
from jcr.estimation.hand_eye import judged
from jcr.geometry import step_between
from jcr.records import Finding, Kind

LOG_P = float(np.log(1e-6))
"""Chance of any one alarm where there is nothing. Of 132 simulated captures of 8 to 20 images, 72 of them by arms with
joint offsets of up to 1° and links 1 mm off, none comes below 1e-5, and none of seven real ones."""
MATERIAL = 0.5
"""Standard deviations by which a fault must move the camera's place on some axis to be reported."""
MIN_IMAGES = 6
"""With fewer no size of errors is known beside."""


def check_bent(case: Case) -> Checked:
    """The ways in which the used poses are surely bent, and the calibration with these free."""
    assert case.adjusted is not None
    poses = case.base_from_gripper[case.used]
    adjusted, found = case.adjusted, list[Bent]()
    if len(poses) < MIN_IMAGES:
        return Checked()
    while len(found) < len(WAYS):
        left = [kind for kind in WAYS if all(one.kind is not kind for one in found)]
        best = min((tested(adjusted.equations, poses, kind) for kind in left), key=lambda one: one.log_p)
        if best.log_p > LOG_P:
            break
        found.append(best)
        adjusted = adjust_case(case, bent=bends((one.kind for one in found), poses))
    if not found:
        return Checked()
    straight = to_straight(adjusted.equations, adjusted.log_sizes, bends((one.kind for one in found), poses))
    shifts = [straight] + [np.zeros(7)] * (len(found) - 1)
    metre = by_scale(adjusted.equations)
    findings = tuple(_finding(one, shift, metre) for one, shift in zip(found, shifts, strict=True))
    refined = judged(refined_by(case, adjusted))
    moved = np.r_[
        step_between(case.hand_eye.gripper_from_camera, refined.gripper_from_camera),
        np.log(refined.scale / case.hand_eye.scale),
    ]
    std = np.sqrt(np.diag(case.hand_eye.covariance)[:6]) * case.hand_eye.converged
    if not (np.abs([moved[:6], *(one.shift[:6] for one in findings if one.shift)]) > MATERIAL * std).any():
        return Checked()
    if case.hand_eye.converged and refined.converged:
        return Checked(findings, refined, adjusted)
    # One that is rejected stays, and the finding explains it.
    return Checked(tuple(replace(one, severity="rejects", shift=tuple(moved.tolist())) for one in findings))


def _finding(found: Bent, shift: Float[ndarray, "7"], metre: Float[ndarray, "7"]) -> Finding:
    """One way as a finding; `metre` is how X moves with the logarithm of the scale."""
    if found.kind is Kind.LENGTHS:
        value, std, axis = _longest(found)
        # Of three lengths one differs from the others: which of them is a metre, no image shows.
        of_metre = abs(value) / 3 * metre
        shift = shift + of_metre * (1 if shift[:6] @ of_metre[:6] >= 0 else -1)
        details = {"frame": "base"} | dict(zip("xyz", axis.tolist(), strict=True))
    elif found.kind is Kind.TOOL_SAGS:
        value = float(np.linalg.norm(found.size))
        along = found.size / value
        std = float(np.sqrt(along @ found.covariance @ along))
        details = {"frame": "gripper"} | dict(zip("xyz", along.tolist(), strict=True))
    else:
        value, std, details = float(found.size[0]), float(np.sqrt(found.covariance[0, 0])), {}
    p = float(np.exp(max(found.log_p, -700)))
    finding = Finding.of(found.kind, "warns", "robot", value=value, std=std, p=p, **details)
    return replace(finding, shift=tuple(shift.tolist()))


def _longest(found: Bent) -> tuple[float, float, Float[ndarray, "3"]]:
    """By how much positions are too long along one axis beside those across it, its standard deviation, and the axis."""
    strain = np.einsum("k,kab->ab", found.size, STRAINS)
    values, vectors = np.linalg.eigh(strain)
    k = int(np.abs(values).argmax())
    axis = vectors[:, k] * np.sign(vectors[np.abs(vectors[:, k]).argmax(), k])
    by = np.einsum("a,kab,b->k", axis, STRAINS, axis)
    # The two others are shorter by half of it each.
    return 1.5 * float(values[k]), 1.5 * float(np.sqrt(by @ found.covariance @ by)), axis
