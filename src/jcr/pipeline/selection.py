"""Selection of the reconstruction: back ends are tried in turn, each reconstructed, calibrated and timed."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

from jcr.allocator import give_back
from jcr.calibration.checks.capture import as_causes, view_findings
from jcr.calibration.record import Calibration
from jcr.calibration.robot_errors import robot_errors
from jcr.calibration.stage import calibrate_reconstruction
from jcr.calibration.words import leave_one_out_text
from jcr.depth.densify import densify
from jcr.errors import InputError, RejectedError
from jcr.findings import (
    Concerns,
    Finding,
    FindingKind,
    is_lasting,
    no_reconstruction,
    remedy,
    strongest_first,
    text,
)
from jcr.progress import Progress, silent
from jcr.reconstruct import BACKENDS, ReconstructOptions, reconstruct, tries
from jcr.records import Attempt, Capture, Reconstruction
from jcr.result import RunOptions

HELPS: tuple[Concerns, ...] = ("reconstruction", "images")
"""Concerns of a rejection against which another reconstruction of the same images may help."""
TEXTURED = 50
"""Observations per image of the capture. SIFT finds 600 to 850 in simulated tabletops of 640x480, 220 in those of half
the size, and 90 where all are blurred by 9 px."""
NEARLY_ALL = 0.9
"""Share of the capture's images."""

Keep = Callable[[Reconstruction], None]
Selected = tuple[Reconstruction, Calibration]
"""Reconstruction that is kept, and its calibration with the record of all attempts and their times."""


class NothingFoundError(RejectedError):
    """Error that no back end came to a calibration, with the attempts and the reasons, strongest first."""

    def __init__(
        self, failure: RejectedError, attempts: tuple[Attempt, ...] = (), causes: tuple[Finding, ...] = ()
    ) -> None:
        """Order `causes`, findings of the images alone, before the failure."""
        self.attempts = attempts
        self.findings = strongest_first((*causes, *no_reconstruction(failure)))
        first = self.findings[0]
        if first.kind is FindingKind.NO_RECONSTRUCTION:
            super().__init__(failure.what, *failure.remedies, also=failure.also)
        else:  # too few features, and what would give more, are its consequences
            super().__init__(text(first), *filter(None, [remedy(first)]))


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Reconstruction and calibration by one back end, or the error that prevented one."""

    account: Attempt
    """Record for the files."""
    reconstruction: Reconstruction | None
    hand_eye: Calibration | None
    failure: InputError | RejectedError | None

    @property
    def rejection(self) -> Finding | None:
        """Strongest finding that rejects the calibration; None of one that is sound, or was not made."""
        if self.hand_eye is None or self.hand_eye.is_sound:
            return None
        return next(finding for finding in self.hand_eye.findings if finding.severity == "rejects")

    @property
    def rank(self) -> tuple[bool, bool, bool, float]:
        """Key of the comparison: calibrated, accepted, explained, minus the leave-one-out error (m).

        A rejection is explained where a cause rejects it that holds for every reconstruction of the same images.
        """
        if self.hand_eye is None:
            return False, False, False, 0.0
        rejection, error = self.rejection, self.hand_eye.held_out
        is_explained = rejection is not None and is_lasting(rejection)
        return True, rejection is None, is_explained, -float("inf") if error is None else -error.length_m

    @property
    def is_doubtful(self) -> bool:
        """Whether the calibration failed, is not accepted, or leaves images out: the images may show why."""
        if self.hand_eye is None:
            return not isinstance(self.failure, InputError)
        return self.hand_eye.verdict != "accepted" or not all(one.used for one in self.hand_eye.images)

    @property
    def name(self) -> str:
        """Name of the back end with its features and, where there is a calibration, the leave-one-out error."""
        name = " with ".join(filter(None, (self.account.backend, self.account.features)))
        if self.hand_eye is None:
            return name
        error = self.hand_eye.held_out
        if error is None:
            return f"{name} (too few images to leave one out)"
        return f"{name} (leave-one-out error {leave_one_out_text(error)})"

    @property
    def why_not(self) -> str:
        """Name of the back end, and the reason why the attempt is not kept."""
        if self.hand_eye is None:
            return f"{self.name} failed ({self.failure})"
        return f"{self.name} is rejected ({self.hand_eye.doubt})"

    def is_textured(self, images: int) -> bool:
        """Test whether SIFT found plenty of features in that number of images, so that their lack rejects nothing.

        Learned features find as many on plain surfaces.
        """
        if self.account.backend != "colmap" or self.account.features not in (None, "sift"):
            return False
        if self.reconstruction is None:
            return isinstance(self.failure, RejectedError) and self.failure.despite_texture
        return len(self.reconstruction.tracks.image) >= TEXTURED * images


def select_reconstruction(
    capture: Capture,
    options: RunOptions,
    progress: Progress | None = None,
    keep: Keep | None = None,
    before: Callable[[], Reconstruction] | None = None,
) -> Selected:
    """Reconstruct and calibrate a capture by the back ends of `reconstruct.tries`, and keep the one of highest rank.

    Another is tried as long as the best one failed, or is rejected for a reason that another may not have; a note says
    which was kept and why. `keep` is called with the reconstruction of the only back end before its calibration.
    `before` returns one that was selected earlier, which is calibrated instead. Raises InputError as the back end does,
    and where gripper poses and joint angles contradict each other; NothingFoundError where no back end gave anything.
    """
    robot_errors(capture, options.calibrate)  # refuses before the images cost time
    trials, notes = list[Trial](), list[str]()

    @cache
    def of_images() -> tuple[Finding, ...]:
        """Return the findings of the images alone."""
        return view_findings(capture)

    if before is not None:
        trials.append(_try(capture, before, options, progress))
    candidates = tries(options.reconstruct) if before is None else []
    for one in candidates:
        reason, goes_on = _why_untried(one, trials, len(capture), of_images) if trials else (None, True)
        notes += filter(None, [reason])
        if not goes_on:
            break
        if reason is None:
            reported = keep if len(candidates) == 1 else None
            trial = _try(capture, one, options, progress, reported)
            is_own = not BACKENDS[one.backend].hub_id or one.weights is not None
            if isinstance(trial.failure, InputError) and is_own:
                raise trial.failure
            trials.append(trial)
    return _select(trials, notes, of_images() if any(one.is_doubtful for one in trials) else ())


def _why_untried(
    options: ReconstructOptions,
    trials: Sequence[Trial],
    images: int,
    of_images: Callable[[], tuple[Finding, ...]],
) -> tuple[str | None, bool]:
    """Return why a back end is not tried after others, None where it is; and whether the next one may be.

    Findings about camera, robot, mount or motion hold for every reconstruction of the same images. A camera at rest
    shows every back end the same view. Where SIFT registers nearly all images, other features show the same scene to
    the same robot. Where SIFT finds plenty of features, a back end that does not test the camera as features do would
    accept unseen what these reject.
    """
    best = max(trials, key=lambda one: one.rank)
    if best.hand_eye is not None:
        rejection = best.rejection
        if rejection is None:
            return None, False
        if is_lasting(rejection) or rejection.concerns not in HELPS:
            return f"no other back end was tried, for none can help: {text(rejection)}", False
    if best.is_doubtful and any(one.severity == "rejects" for one in of_images()):
        return None, False
    textured = [one for one in trials if one.is_textured(images)]
    if options.backend == "colmap":
        seen = [0 if one.reconstruction is None else len(one.reconstruction.image_index) for one in textured]
        if max(seen, default=0) >= NEARLY_ALL * images:
            plenty = "no features but SIFT's were tried: there are plenty, and they register"
            return f"{plenty} {max(seen)} of {images} images", True
    if textured and not BACKENDS[options.backend].tests_camera:
        reason = (
            "it is for scenes without features, which these images have in plenty, and does not test the camera as they "
            "do"
        )
        return f"{options.backend} was not tried: {reason}", False
    return None, True


def _select(trials: Sequence[Trial], notes: list[str], of_images: tuple[Finding, ...]) -> Selected:
    """Return the trial of highest rank with the notes, and with the findings of the images alone.

    Raises InputError or NothingFoundError where there is none.
    """
    kept = max(trials, key=lambda one: one.rank)
    hand_eye, reconstruction = kept.hand_eye, kept.reconstruction
    if hand_eye is None or reconstruction is None:
        *earlier, last = trials
        failure = last.failure
        if isinstance(failure, InputError) and not earlier:
            raise failure
        failure = failure if isinstance(failure, RejectedError) else RejectedError(str(failure))
        # The licence of weights that were used belongs to this answer, too.
        failure = failure.with_more(*notes, *(f"back end {one.why_not}" for one in earlier))
        raise NothingFoundError(failure, tuple(one.account for one in trials), as_causes(of_images))
    if others := [one for one in trials if one is not kept]:
        _, accepted, explained, _ = kept.rank
        why = f"{kept.name} was used"
        if not accepted and any(one.hand_eye is not None for one in others):
            reason = "it shows the cause" if explained else "its leave-one-out error is the smaller one"
            why = f"{kept.name} is rejected, too, and was used: {reason}"
        notes.insert(0, f"back end {'; '.join([*(one.why_not for one in others), why])}")
    found = of_images if hand_eye.is_sound else as_causes(of_images)
    attempts = tuple(
        one.account
        if one is kept or one.hand_eye is None
        else replace(one.account, why_not=f"rejected: {one.hand_eye.doubt}")
        for one in trials
    )
    hand_eye = replace(hand_eye, attempts=attempts, timings_s=timings_of(attempts))
    reconstruction = replace(reconstruction, notes=(*notes, *reconstruction.notes))
    return reconstruction, hand_eye.with_findings(*found) if found else hand_eye


def timings_of(attempts: Sequence[Attempt]) -> dict[str, float]:
    """Return the seconds that the stages took, all attempts together."""
    return {
        "reconstruct": round(sum(attempt.reconstruct_s for attempt in attempts), 3),
        "calibrate": round(sum(attempt.calibrate_s for attempt in attempts), 3),
    }


def _try(
    capture: Capture,
    source: ReconstructOptions | Callable[[], Reconstruction],
    options: RunOptions,
    progress: Progress | None,
    keep: Keep | None = None,
) -> Trial:
    """Make a reconstruction by a back end, or read one by a function, and calibrate.

    A known length ends on surfaces: with one, dense depth comes first, from cameras and tracks alone. Raises InputError
    of the calibration, which no other back end avoids.
    """
    start, report = time.perf_counter(), progress or silent
    candidate = source if isinstance(source, ReconstructOptions) else None
    made = failure = hand_eye = None
    try:
        made = reconstruct(capture, source, progress) if isinstance(source, ReconstructOptions) else source()
    except (InputError, RejectedError) as error:
        failure = error.with_traceback(None)
    give_back()  # memory of the back end
    if made is not None and keep is not None:
        keep(made)
    if made is not None and options.calibrate.known_length is not None:
        made = densify(capture, made, options.depth, progress)
    calibrating = ended = time.perf_counter()
    if made is not None:
        report("calibrate", 0.0)
        try:
            hand_eye = calibrate_reconstruction(capture, made, options.calibrate)
        except RejectedError as error:
            failure = error.with_traceback(None)
        ended = time.perf_counter()
        give_back()
        report("calibrate", 1.0)
    backend = candidate or made
    account = Attempt(
        backend="" if backend is None else backend.backend,
        images_registered=None if made is None else len(made.image_index),
        reconstruct_s=round(calibrating - start, 3),
        calibrate_s=round(ended - calibrating, 3),
        why_not=None if failure is None else str(failure),
        features=None if candidate is None or candidate.features == "auto" else candidate.features,
    )
    return Trial(account=account, reconstruction=made, hand_eye=hand_eye, failure=failure)
