"""The head of the report: whether to use the calibration, or why there is none, and its main numbers."""

from collections.abc import Iterator

from jcr.calibration.calibration_json import CalibrationFile
from jcr.calibration.words import leave_one_out_text, pixels
from jcr.records import Kind, verdict_of
from jcr.records.words import SHORT, reached_in_words, remedy, sentence, text
from jcr.report.render import Section
from jcr.rounding import significant

Tile = tuple[str, str, str, bool]
"""What it is, the number, what there is to know of it, and whether it is one of the main numbers."""


def head(calibration: CalibrationFile) -> list[Section]:
    """Verdict, main numbers, warnings and notes."""
    remarks = {"warnings": calibration.remarks, "notes": calibration.notes}
    return [
        Section("verdict", _verdict(calibration)),
        Section("tiles", {"tiles": list(_tiles(calibration))}),
        *(Section(name, {"remarks": found}) for name, found in remarks.items() if found),
    ]


def failure_section(calibration: CalibrationFile) -> Section:
    """What is wrong in one sentence, what to do, and how each back end failed that was tried."""
    failed, *others = calibration.findings
    remedies = [sentence(one) for one in others if one.kind is Kind.BOARD_IN_VIEW]
    remedies += filter(None, [remedy(failed)])
    content = {
        "fault": text(failed),
        "remedies": [words[0].upper() + words[1:] for words in remedies],
        "attempts": [
            (
                attempt.backend,
                f" with {attempt.features}" if attempt.features else "",
                attempt.reconstruct_s + attempt.calibrate_s,
                attempt.why_not or "",
            )
            for attempt in calibration.attempts
        ],
    }
    return Section("failure", content)


def _verdict(calibration: CalibrationFile) -> dict[str, str]:
    required, short = calibration.requirement, calibration.short
    if calibration.doubt is not None:
        kind, reason = "bad", calibration.doubt
    elif short is not None:
        found = "" if required is None else f"{reached_in_words(required)}; {remedy(short)}"
        kind, reason = "fair", f"{SHORT}: {found}"
    else:
        kind = "good"
        reason = "nothing contradicts it" if required is None else reached_in_words(required)
    believe = _leave_one_out(calibration)
    if calibration.uncertainty is not None:
        believe += f" Least certain is the translation {calibration.uncertainty.worst} (one σ)."
    verdict = verdict_of(calibration.findings).capitalize()
    return {"kind": kind, "verdict": verdict, "reason": reason, "believe": believe}


def _leave_one_out(calibration: CalibrationFile) -> str:
    """How far the leave-one-out error supports the verdict."""
    if (held_out := calibration.held_out) is None:
        return "There were too few images to leave one out and see how well the others predict it."
    error = leave_one_out_text(held_out)
    if not calibration.observability.observable:
        # An error along a direction that is unobservable changes no prediction.
        return f"Its leave-one-out error of {error} is no comfort: what is unobservable, no image can contradict."
    if not calibration.converged:
        return (
            f"Its leave-one-out error of {error} is no comfort: it is blind to what is wrong with all images."
        )
    return (
        f"Beside it the leave-one-out error: {error} ({held_out.how}). It is of one pose, with the robot pose noise in "
        "it, and blind to what all images share, such as intrinsics that are a little wrong."
    )


def _tiles(calibration: CalibrationFile) -> Iterator[Tile]:
    if (uncertainty := calibration.uncertainty) is not None:
        direction, _, size = uncertainty.worst.partition(": ")
        worst_deg = significant(max(uncertainty.rotation_std_deg))
        if (seen := uncertainty.seen) is not None:
            far = significant(1e-3 * seen.distance_mm)
            where = f"at {far} m, 95 % of errors; {significant(seen.ray_95_deg)}° of its ray"
            yield "A seen point", f"{significant(seen.within_95_mm)} mm", where, True
        yield "Translation, 1 σ", size, f"of the camera; worst {direction}", True
        yield "Rotation, 1 σ", f"±{worst_deg}°", "of the camera; worst about an axis of the gripper", True
    if (held_out := calibration.held_out) is not None:
        degrees = f"{significant(held_out.rotation_deg)}°{pixels(held_out).replace(', ', ' · ')}"
        yield "Leave-one-out error", f"{significant(held_out.translation_mm)} mm", degrees, False
    if uncertainty is not None and calibration.scale is not None:
        percent = significant(uncertainty.scale_std_percent)
        yield "Scale", significant(calibration.scale, 4), f"m per unit, ±{percent}\u00a0%", False
    used, all_images = calibration.images_used, len(calibration.images)
    rejected = f"{all_images - used} rejected" if used < all_images else ""
    yield "Images used", f"{used} of {all_images}", rejected, False
    if (noise := calibration.robot_noise) is not None:
        how = "estimated" if noise.estimated else "as given"
        degrees = f"{significant(noise.rotation_deg)}° per axis, {how}"
        yield "Robot pose noise, 1 σ", f"{significant(noise.translation_mm)} mm", degrees, False
