"""Verdict on a calibration: findings that follow from its numbers, and the severity of findings that are added."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from jcr.calibration.record import Calibration
from jcr.estimation.pose_misfit import MAX_NOISE
from jcr.findings import Finding, FindingKind, strongest_first
from jcr.records import RobotNoise, Uncertainty

MAX_STD = (*MAX_NOISE, 0.05)
"""Largest standard deviations (m, rad, relative scale) of an accepted calibration."""
MIN_SHARE_USED = 0.6
"""Smallest fraction of the registered images that an accepted calibration uses."""
MIN_FOR_OUTLIERS = 5
"""Number of images below which outliers cannot be detected and the robot pose noise is poorly known."""
WELL_ABOVE = 2e-3
"""Leave-one-out error (m) up to which no warning is given."""
SURPRISE = 1.5
"""Ratio of the residuals to the given robot noise up to which no warning is given."""


def judged(numbers: Calibration, motions: Sequence[Finding], findings: Sequence[Finding] = ()) -> Calibration:
    """Return a calibration with all of its findings, and with the errors that they state in its covariance.

    `numbers` is a calibration whose findings are ignored. `motions` are the findings on directions that the motions do
    not determine, `findings` those of the checks. Findings on image count, robot noise and uncertainty are derived here
    from the numbers; the shifts of `findings` add to the covariance after that, since a finding with a shift has its
    own severity (`appended`).
    """
    of_numbers = findings_of(numbers, motions)
    # A weakly observed direction explains an uncertainty that rejects, and is therefore named first, unless the poses
    # are wrong: those of a wrong convention may be near a degenerate motion.
    uncertain = any(one.kind is FindingKind.UNCERTAIN for one in of_numbers)
    weak = "rejects" if uncertain and poses_agree(numbers.robot_noise) else "warns"
    seen = (replace(one, severity=weak) if "nearly" in one.details else one for one in motions)
    return replace(
        with_uncertainty(numbers, with_shifts(numbers.uncertainty, findings)),
        findings=strongest_first((*seen, *of_numbers, *findings)),
    )


def findings_of(numbers: Calibration, motions: Sequence[Finding]) -> list[Finding]:
    """Return the findings that follow from the numbers of a calibration alone: those that reject, then warnings."""
    observable = all("nearly" in one.details for one in motions)
    return [*_rejecting(numbers, observable), *_warning(numbers)]


def appended(
    findings: Sequence[Finding],
    new: Sequence[Finding],
    calibration: Callable[[Sequence[Finding]], Calibration],
) -> tuple[Finding, ...]:
    """Return `findings` with `new` ones after them, of which those that explain a rejection have the severity "rejects".

    A finding with a shift (`Finding.shift`, in COVARIANCE_ORDER) states the change of the calibration if the fault were
    modelled. It rejects if the calibration is rejected, or too uncertain with the shift (MAX_STD). `calibration`
    returns the calibration with some findings.
    """
    kept = tuple(findings)
    for one in new:
        if one.shift is not None and one.severity != "rejects":
            found = calibration((*kept, one))
            beyond = any(_too_uncertain(found)) if found.observability.observable else False
            if not found.converged or beyond:
                one = replace(one, severity="rejects")
        kept = (*kept, one)
    return kept


def with_shifts(uncertainty: Uncertainty, findings: Sequence[Finding]) -> Uncertainty:
    """Return the uncertainty with s·sᵀ added to the covariance for the shift s of each finding that states one.

    The shift changes transform and scale and, if they were estimated, the intrinsics.
    """
    for one in findings:
        if one.shift is not None:
            moved = () if one.intrinsics_shift is None or uncertainty.joint is None else one.intrinsics_shift
            shift = np.r_[one.shift, moved]
            uncertainty = uncertainty.with_error(np.outer(shift, shift))
    return uncertainty


def with_uncertainty(numbers: Calibration, uncertainty: Uncertainty) -> Calibration:
    """Return a calibration with another uncertainty, also as standard deviations of its intrinsics."""
    intrinsics, std = numbers.intrinsics, uncertainty.intrinsics_std
    intrinsics = None if intrinsics is None else intrinsics.with_std(std)
    return replace(numbers, uncertainty=uncertainty, intrinsics=intrinsics)


def poses_agree(noise: RobotNoise) -> bool:
    """Return whether the estimated robot errors per axis are at most MAX_NOISE, as an accepted calibration needs."""
    metres, radians = noise.together
    return metres <= MAX_NOISE[0] and bool(radians <= MAX_NOISE[1])


def _too_uncertain(numbers: Calibration) -> Iterator[tuple[str, float]]:
    """Yield the parts of a calibration whose standard deviation is above MAX_STD, each with the largest one."""
    std = numbers.uncertainty.std
    parts = {"translation": std[:3].max(), "rotation": std[3:6].max(), "scale": std[6]}
    yield from (
        (part, float(value))
        for (part, value), most in zip(parts.items(), MAX_STD, strict=True)
        if value > most
    )


def _rejecting(numbers: Calibration, observable: bool) -> Iterator[Finding]:
    """Yield findings that reject a calibration: few images agree, poses contradict images, or it is too uncertain."""
    used, n = int(numbers.inliers.sum()), len(numbers.inliers)
    if used < max(3, MIN_SHARE_USED * n) and n > 2:
        counts = {"value": float(used), "images": float(n)}
        yield Finding.of(FindingKind.FEW_AGREE, "rejects", "reconstruction", **counts)
    if not poses_agree(numbers.robot_noise):
        metres, radians = numbers.robot_noise.together
        kind = FindingKind.POSES_CONTRADICT_IMAGES
        yield Finding.of(kind, "rejects", "reconstruction", value=metres, rotation=radians)
    if not observable:
        return
    # With few images, half of the uncertainty may be due to the poorly known robot pose noise.
    unknown = {"noise_unknown": 1.0} if numbers.robot_noise.given is None and used < MIN_FOR_OUTLIERS else {}
    for part, value in _too_uncertain(numbers):
        yield Finding.of(FindingKind.UNCERTAIN, "rejects", "images", part=part, value=value, **unknown)


def _warning(numbers: Calibration) -> Iterator[Finding]:
    """Yield findings that warn: residuals larger than the given noise, a large leave-one-out error, or few images."""
    noise, images = numbers.robot_noise, [one for one in numbers.images if one.used]
    residual = np.array([(one.translation_residual_mm, one.rotation_residual_deg) for one in images], float)
    # The rms residual per axis, corrected for the 13 fitted unknowns.
    fitted = 6 * len(images) / max(6 * len(images) - 13, 1)
    mm, deg = np.sqrt(fitted * (residual.reshape(-1, 2) ** 2).mean(0) / 3).tolist()
    metres, radians = 1e-3 * mm, float(np.radians(deg))
    if noise.given is not None and (
        metres > SURPRISE * noise.given[0] or radians > SURPRISE * noise.given[1]
    ):
        details = {"rotation": radians, "given": noise.given[0], "given_rotation": noise.given[1]}
        yield Finding.of(FindingKind.NOISE_ABOVE_GIVEN, "warns", "none", value=metres, **details)
    if (held_out := numbers.held_out) is not None:
        left_out_m, typical = 1e-3 * held_out.translation_mm, float(np.sqrt(3)) * noise.together[0]
        if left_out_m > max(3 * typical, WELL_ABOVE):
            yield Finding.of(FindingKind.LEAVE_ONE_OUT, "warns", "images", value=left_out_m, residual=typical)
    if len(numbers.inliers) < MIN_FOR_OUTLIERS:
        yield Finding.of(FindingKind.FEW_IMAGES, "warns", "images", value=float(len(numbers.inliers)))
