"""Top of the report: verdict with its reason, main numbers and warnings, or the reason of a failure."""

from collections.abc import Iterator

from jcr.calibration.record import AnyCalibration, Calibration, PublishedCalibration
from jcr.calibration.summary import (
    corner_bound,
    corner_in_words,
    corner_is_missed,
    leave_one_out_text,
    worst_direction,
)
from jcr.cell.cameras_json import CamerasFile
from jcr.findings import FindingKind, reached_in_words, sentence
from jcr.number_format import significant
from jcr.report.render import Content

Tile = tuple[str, str, str, str]
"""Number in a box: its name, the number as text, a remark, and its classes in CSS: "first" for one of the main numbers,
"missed" for one that misses the required accuracy."""


def head(calibration: AnyCalibration, cameras: CamerasFile | None = None) -> dict[str, Content]:
    """Return the first sections of the report by name: "verdict", "tiles" (main numbers) and, if any, "warnings".

    The warnings include the rejected ones of the other `cameras`, which the verdict on the calibration does not.
    """
    sections: dict[str, Content] = {"verdict": _verdict(calibration)}
    sections["tiles"] = {"tiles": list(_tiles(calibration))}
    rejected = () if cameras is None else cameras.rejected
    remarks = [f"Camera {one.name} is rejected: {one.doubt}" for one in rejected] + calibration.remarks
    return sections | ({"warnings": {"remarks": remarks}} if remarks else {})


def failure_section(calibration: AnyCalibration) -> Content:
    """Return the reason why no camera poses were found, the remedies, and a row for each attempt with a back end."""
    failed, *others = calibration.findings
    remedies = [sentence(one) for one in others if one.kind is FindingKind.BOARD_IN_VIEW]
    remedies += filter(None, [failed.remedy])
    attempts = list[tuple[str, str, float, str]]()
    for one in calibration.attempts:
        features = f" with {one.features}" if one.features else ""
        attempts.append((one.backend, features, one.reconstruct_s + one.calibrate_s, one.why_not or ""))
    remedies = [words[0].upper() + words[1:] for words in remedies]
    return {"fault": failed.text, "remedies": remedies, "attempts": attempts}


def _verdict(calibration: AnyCalibration) -> dict[str, str]:
    """Return verdict, colour ("kind"), reason and remedy, and sentences on leave-one-out error and uncertainty."""
    required, short, verdict = calibration.requirement, calibration.short, calibration.verdict
    kind = {"accepted": "good", "rejected": "bad"}.get(verdict, "fair")
    stated = short if calibration.converged else calibration.findings[0]
    if stated is not None:
        reason = stated.text
    else:
        reason = "no check contradicts it" if required is None else reached_in_words(required)
        if corner_is_missed(calibration):
            reason += "; the corners of the image do not reach this"
    corner = corner_in_words(calibration)
    evidence = (f"{corner[0].upper()}{corner[1:]}. " if corner else "") + _leave_one_out(calibration)
    if isinstance(calibration, PublishedCalibration):
        reason = calibration.findings[0].text
        evidence = "Small residuals do not prove accuracy, because X is on both sides of AX = XB."
    if isinstance(calibration, Calibration):
        worst = worst_direction(calibration)
        evidence += f" Largest uncertainty of the translation: {worst} (1 σ)."
    remedy = "" if stated is None or not stated.remedy else f"Remedy: {stated.remedy}."
    return {
        "kind": kind,
        "verdict": verdict.capitalize(),
        "reason": reason,
        "remedy": remedy,
        "evidence": evidence,
    }


def _leave_one_out(calibration: AnyCalibration) -> str:
    """Return a sentence with the leave-one-out error, and the errors that it cannot show."""
    if (held_out := calibration.held_out) is None:
        return "There are too few images for a leave-one-out error."
    error = f"Leave-one-out error {leave_one_out_text(held_out)} ({held_out.how})"
    if not calibration.observability.observable:
        return f"{error}; it does not support the result, because no image can contradict an unobservable direction."
    if not calibration.converged:
        return f"{error}; it does not support the result, because it cannot show errors common to all images."
    return (
        f"{error}. It includes the robot pose noise and cannot show errors common to all images, such as slightly wrong "
        "intrinsics."
    )


def _tiles(calibration: AnyCalibration) -> Iterator[Tile]:
    """Yield tiles (a number in a box) of the accuracy of a point at the image centre and corner, used images, and scale.

    Tiles whose numbers the calibration does not have are left out; without the corner, the rotation uncertainty of the
    camera is given. A rejected calibration has no accuracy.
    """
    uncertainty = calibration.uncertainty if calibration.converged else None
    if uncertainty is not None and (seen := uncertainty.seen) is not None:
        far, turned = significant(1e-3 * seen.distance_mm), significant(seen.rotation_95_deg)
        bound, kind = (
            f"{significant(seen.within_95_mm)} mm",
            "first" + " missed" * (calibration.short is not None),
        )
        yield "Point at the image centre", bound, f"at {far} m, {turned}°; 95 %", kind
        bound, kind = corner_bound(seen), "first missed" if corner_is_missed(calibration) else "first"
        about = (
            f"{significant(seen.corners.rotation_95_deg)}°; 95 %"
            if bound[0].isdigit()
            else "no features near it"
        )
        yield "Point in the image corner", bound, about, kind
    elif uncertainty is not None:
        degrees = significant(max(uncertainty.rotation_std_deg))
        yield "Rotation of the camera", f"±{degrees}°", "1 σ, worst axis", "first"
    if isinstance(calibration, PublishedCalibration):
        found = calibration.residuals
        yield "Residual δt", f"{significant(1e3 * found.translation)} mm", "paper, eq. 16", "first"
        yield "Residual δR", significant(found.rotation), "paper, eq. 16; Frobenius norm", "first"
    used, count = calibration.images_used, len(calibration.images)
    yield "Images used", f"{used} of {count}", f"{count - used} left out" if used < count else "", "first"
    if isinstance(calibration, PublishedCalibration):
        yield "Scale", f"{calibration.scale:.4g}", "m per unit of the reconstruction", "first"
    elif uncertainty is not None and calibration.scale is not None:
        std = f"±{significant(uncertainty.scale_std_percent)}\u00a0%"
        yield "Scale", std, f"{significant(calibration.scale, 4)} m per unit of the reconstruction", "first"
