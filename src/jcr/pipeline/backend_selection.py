"""Selection of the reconstruction: back ends reconstruct the images one after the other until one is calibrated well."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from jcr.backends import BACKENDS, MARKER, ReconstructOptions, reconstruct, tries
from jcr.calibration.arm_of_capture import robot_errors
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.calibration.checks.images import as_causes, view_findings
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration, PublishedCalibration
from jcr.calibration.summary import leave_one_out_text
from jcr.errors import InputError, RejectedError
from jcr.extras import extra
from jcr.findings import (
    Concerns,
    Finding,
    FindingKind,
    is_lasting,
    no_reconstruction,
    strongest_first,
)
from jcr.memory import give_back
from jcr.progress import Progress, silent
from jcr.records import Attempt, Capture, PosePairs, Reconstruction
from jcr.result import RunOptions

HELPS: tuple[Concerns, ...] = ("reconstruction", "images")
"""Concerns of a rejecting finding for which another back end may give an accepted calibration of the same images."""
TEXTURED = 50
"""Observations per image above which images have enough SIFT features. SIFT finds 600 to 850 in simulated tabletops of
640x480, 220 in those of half the size, and 90 if all are blurred by 9 px."""
SIFT_SUFFICES = 0.9
"""Share of the capture's images that SIFT must register so that other features are not tried."""


class NothingFoundError(RejectedError):
    """Error that no back end gave a calibration; it holds the attempts and the findings, strongest first."""

    def __init__(
        self, failure: RejectedError, attempts: tuple[Attempt, ...] = (), causes: tuple[Finding, ...] = ()
    ) -> None:
        """Make the error from the failure of the last back end, the records of all attempts, and findings `causes`.

        `causes` are findings of the images alone; if one rejects, the message states it instead of the failure.
        """
        self.attempts = attempts
        self.findings = strongest_first((*causes, *no_reconstruction(failure)))
        first = self.findings[0]
        if first.kind is FindingKind.NO_RECONSTRUCTION:
            super().__init__(failure.what, *failure.remedies, also=failure.also)
        else:  # the failure and its remedies are consequences of the finding on the images
            super().__init__(first.text, *filter(None, [first.remedy]))


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One attempt to reconstruct and calibrate with one back end: its results, or the error that ended it."""

    account: Attempt
    reconstruction: Reconstruction | None
    hand_eye: Calibration | PublishedCalibration | None
    failure: InputError | RejectedError | None

    @property
    def rejection(self) -> Finding | None:
        """First finding that rejects the calibration; None without one."""
        if self.hand_eye is None or self.hand_eye.converged:
            return None
        return next(finding for finding in self.hand_eye.findings if finding.severity == "rejects")

    @property
    def rank(self) -> tuple[bool, bool, bool, float]:
        """Sort key, largest for the best trial: (calibrated, accepted, explained, minus leave-one-out error in m).

        A rejection is explained if its finding holds for every reconstruction of the same images. The error is
        √(translation² + (0.3 m · rotation)²), infinite if there is none.
        """
        if self.hand_eye is None:
            return False, False, False, 0.0
        rejection, error = self.rejection, self.hand_eye.held_out
        is_explained = rejection is not None and is_lasting(rejection)
        return True, rejection is None, is_explained, -float("inf") if error is None else -error.length_m

    @property
    def is_doubtful(self) -> bool:
        """Whether findings of the images matter: no calibration, warnings, a rejection, or images left out.

        It is False after an InputError of the back end, which has another cause than the images.
        """
        if self.hand_eye is None:
            return not isinstance(self.failure, InputError)
        return bool(self.hand_eye.warnings) or not all(one.used for one in self.hand_eye.images)

    def in_words(self, is_kept: bool = False) -> str:
        """Return the back end, its features and its leave-one-out error, and the reason why it failed or is rejected.

        `is_kept`: the calibration is the selected one, and the reason is left out.
        """
        name = " with ".join(filter(None, (self.account.backend, self.account.features)))
        if self.hand_eye is None:
            return f"{name} failed ({self.failure})"
        error = self.hand_eye.held_out
        left_out = "too few images to leave one out"
        name += f" ({left_out if error is None else f'leave-one-out error {leave_one_out_text(error)}'})"
        return name if is_kept else f"{name} is rejected ({self.hand_eye.doubt})"

    def is_textured(self, images: int) -> bool:
        """Test whether COLMAP found at least 50 SIFT features per image, so that a lack of texture is excluded.

        Learned features do not count: they are found without texture.
        """
        if self.account.backend != "colmap" or self.account.features not in (None, "sift"):
            return False
        if self.reconstruction is None:
            return isinstance(self.failure, RejectedError) and self.failure.despite_texture
        return len(self.reconstruction.tracks.image) >= TEXTURED * images


def select_reconstruction(
    capture: Capture,
    options: RunOptions,
    progress: Progress = silent,
    keep: Callable[[Reconstruction], None] | None = None,
    before: Reconstruction | None = None,
    goes_on: bool = False,
) -> tuple[Reconstruction, Calibration]:
    """Reconstruct and calibrate a capture with the back ends of `reconstruct.tries`, and return the best trial's result.

    The next back end is tried while the best trial failed, or is rejected for a reason that may depend on the back end;
    a note names the selected one and the reason. If there is only one back end to try, `keep` receives its
    reconstruction before the calibration. If the reconstruction `before` is given, only it is
    calibrated, or it first if `goes_on`.
    Raises InputError if a back end does, or if gripper poses and joint angles contradict each other; NothingFoundError
    if no back end gives a calibration.
    """
    robot_errors(capture, options.calibrate)  # raises InputError before time is spent on the images
    trials, notes = list[Trial](), list[str]()

    @cache
    def of_images() -> tuple[Finding, ...]:
        """Return the findings of the images alone (blur, one view, repetition), computed once."""
        return view_findings(capture)

    def calibrate(capture: Capture, made: Reconstruction) -> Calibration:
        return calibrate_reconstruction(capture, made, options.calibrate)

    if before is not None:
        trials.append(_try(capture, before, reconstruct, calibrate, progress))
    candidates = tries(options.reconstruct) if before is None or goes_on else []
    if capture.mount == "base":
        # A board that the gripper carries before a fixed camera is small in the images, as all that moves: corners are
        # more accurate there than features, and found in a fifth of the time.
        candidates.sort(key=lambda one: one.backend != MARKER)
    for one in candidates:
        reason, goes_on = _why_untried(one, trials, len(capture), of_images) if trials else (None, True)
        notes += filter(None, [reason])
        if not goes_on:
            break
        if reason is None:
            reported = keep if len(candidates) == 1 and not trials else None
            trial = _try(capture, one, reconstruct, calibrate, progress, reported)
            is_own = not BACKENDS[one.backend].hub_id or one.weights is not None
            if isinstance(trial.failure, InputError) and is_own:
                raise trial.failure
            trials.append(trial)
    return _select(trials, notes, of_images() if any(one.is_doubtful for one in trials) else ())


def solved_pairs(pairs: PosePairs, options: CalibrateOptions | None = None) -> PublishedCalibration:
    """Calibrate given camera poses by the published solver; raises as `select_published` does."""
    require_published(options or CalibrateOptions())
    from jcr.paper.run import calibrate_published

    return calibrate_published(pairs, pairs)


def require_published(options: CalibrateOptions) -> None:
    """Raise InputError without torch, and for an option of the calibration, because the published method has none."""
    extra("torch", "map", "method paper")
    for name, value in vars(CalibrateOptions()).items():
        if getattr(options, name) != value:
            raise InputError(f"method paper: does not use {name}; leave it out")


def select_published(
    capture: Capture,
    options: RunOptions,
    progress: Progress = silent,
    before: Reconstruction | None = None,
) -> tuple[Reconstruction, PublishedCalibration]:
    """Reconstruct and calibrate a capture by the published method, with one back end and without checks.

    If the reconstruction `before` is given, only it is calibrated. Raises InputError as the method does, and
    NothingFoundError if it gives no calibration.
    """
    require_published(options.calibrate)
    if capture.mount != "gripper":
        raise InputError("method paper: is for a camera on the gripper; leave it out")
    # Torch and pycolmap take seconds to import, and torch may be absent.
    from jcr.paper.run import calibrate_published, reconstruct_published

    source = options.reconstruct if before is None else before
    return _select([_try(capture, source, reconstruct_published, calibrate_published, progress)], [], ())


def _why_untried(
    options: ReconstructOptions,
    trials: Sequence[Trial],
    images: int,
    of_images: Callable[[], tuple[Finding, ...]],
) -> tuple[str | None, bool]:
    """Return the reason why the next back end is not tried, and whether the back ends after it may be tried.

    The reason is None if the back end is tried, or if there is nothing to report. No other back end is tried if the
    best trial is accepted, if its rejection does not depend on the back end, or if `of_images` reject. Other features
    are not tried if SIFT registers 90 % or more of the images. A back end that does not test the camera's intrinsics is
    not tried if SIFT finds enough features (`is_textured`), because it could accept a wrong calibration.
    """
    best = max(trials, key=lambda one: one.rank)
    if best.hand_eye is not None:
        rejection = best.rejection
        if rejection is None:
            return None, False
        if is_lasting(rejection) or rejection.concerns not in HELPS:
            return f"no other back end was tried, for none can help: {rejection.text}", False
    if best.is_doubtful and any(one.severity == "rejects" for one in of_images()):
        return None, False
    textured = [one for one in trials if one.is_textured(images)]
    if options.backend == "colmap":
        seen = [0 if one.reconstruction is None else len(one.reconstruction.image_index) for one in textured]
        if max(seen, default=0) >= SIFT_SUFFICES * images:
            plenty = "no features but SIFT's were tried: there are plenty, and they register"
            return f"{plenty} {max(seen)} of {images} images", True
    if textured and not BACKENDS[options.backend].tests_camera:
        reason = (
            "it is for scenes without features, which these images have in plenty, and does not test the camera as they "
            "do"
        )
        return f"{options.backend} was not tried: {reason}", False
    return None, True


def _select(
    trials: Sequence[Trial], notes: list[str], of_images: tuple[Finding, ...]
) -> tuple[Reconstruction, Any]:
    """Return reconstruction and calibration of the trial of highest rank, with `notes` and the findings `of_images`.

    Raises NothingFoundError if no trial has a calibration. The InputError of an only trial is raised unchanged.
    """
    kept = max(trials, key=lambda one: one.rank)
    hand_eye, reconstruction = kept.hand_eye, kept.reconstruction
    if hand_eye is None or reconstruction is None:
        *earlier, last = trials
        failure = last.failure
        if isinstance(failure, InputError) and not earlier:
            raise failure
        failure = failure if isinstance(failure, RejectedError) else RejectedError(str(failure))
        # The notes include the licence of network weights that were used.
        failure = failure.with_more(*notes, *(f"back end {one.in_words()}" for one in earlier))
        raise NothingFoundError(failure, tuple(one.account for one in trials), as_causes(of_images))
    if others := [one for one in trials if one is not kept]:
        _, accepted, explained, _ = kept.rank
        why = "was used"
        if not accepted and any(one.hand_eye is not None for one in others):
            reason = "it shows the cause" if explained else "its leave-one-out error is the smaller one"
            why = f"is rejected, too, and was used: {reason}"
        texts = [*(one.in_words() for one in others), f"{kept.in_words(is_kept=True)} {why}"]
        notes.insert(0, f"back end {'; '.join(texts)}")
    found = of_images if hand_eye.converged else as_causes(of_images)
    attempts = tuple(replace(one.account, why_not=None) if one is kept else one.account for one in trials)
    hand_eye = replace(hand_eye, attempts=attempts, timings_s=timings_of(attempts))
    reconstruction = replace(reconstruction, notes=(*notes, *reconstruction.notes))
    return reconstruction, hand_eye.with_findings(*found) if found else hand_eye


def timings_of(attempts: Sequence[Attempt]) -> dict[str, float]:
    """Return the seconds of the stages "reconstruct" and "calibrate", summed over all attempts."""
    return {
        "reconstruct": round(sum(attempt.reconstruct_s for attempt in attempts), 3),
        "calibrate": round(sum(attempt.calibrate_s for attempt in attempts), 3),
    }


def _try(
    capture: Capture,
    source: ReconstructOptions | Reconstruction,
    reconstructing: Callable[..., Reconstruction],
    calibrating: Callable[..., Calibration | PublishedCalibration],
    progress: Progress,
    keep: Callable[[Reconstruction], None] | None = None,
) -> Trial:
    """Return the trial of one back end: a reconstruction and its calibration, or the error of either.

    `keep` receives the reconstruction before the calibration. An InputError of the calibration is raised, because it
    would occur with every back end.
    """
    start = time.perf_counter()
    own = source if isinstance(source, ReconstructOptions) else None
    made = failure = hand_eye = why_not = None
    try:
        made = source if isinstance(source, Reconstruction) else reconstructing(capture, source, progress)
    except (InputError, RejectedError) as error:
        failure = error.with_traceback(None)
    give_back()  # return the memory of the back end to the system
    if made is not None and keep is not None:
        keep(made)
    reconstructed = time.perf_counter()
    if made is not None:
        progress("calibrate", 0.0)
        try:
            hand_eye = calibrating(capture, made)
            why_not = f"rejected: {hand_eye.doubt}"
        except RejectedError as error:
            failure = error.with_traceback(None)
        give_back()
        progress("calibrate", 1.0)
    account = Attempt(
        backend=made.backend if made is not None else own.backend if own is not None else "",
        images_registered=None if made is None else len(made.image_index),
        reconstruct_s=round(reconstructed - start, 3),
        calibrate_s=round(time.perf_counter() - reconstructed, 3),
        why_not=why_not if failure is None else str(failure),
        features=None if own is None or own.features == "auto" else own.features,
    )
    return Trial(account=account, reconstruction=made, hand_eye=hand_eye, failure=failure)
