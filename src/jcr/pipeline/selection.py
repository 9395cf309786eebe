"""Selection of the reconstruction: back ends are tried in turn, each reconstructed, calibrated and timed."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from jcr.allocator import give_back
from jcr.calibration.checks.capture import as_causes, view_findings
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.robot_errors import robot_errors
from jcr.calibration.stage import calibrate
from jcr.calibration.words import leave_one_out_text
from jcr.depth.densify import densify
from jcr.depth.options import DepthOptions
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
from jcr.records import Attempt, Capture, HandEye, Reconstruction

HELPS: tuple[Concerns, ...] = ("reconstruction", "images")
"""Concerns of a rejection against which another reconstruction of the same images may help."""
TEXTURED = 50
"""Observations per image of the capture. SIFT finds 600 to 850 in simulated tabletops of 640x480, 220 in those of half
the size, and 90 where all are blurred by 9 px."""
NEARLY_ALL = 0.9
"""Share of the capture's images."""


class NothingFoundError(RejectedError):
    """Error that no back end that was tried came to a calibration; `findings` are the reasons, strongest first."""

    def __init__(
        self, failure: RejectedError, attempts: tuple[Attempt, ...], causes: tuple[Finding, ...] = ()
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
class Selection:
    """Reconstruction that is kept, its calibration, and the record of all attempts."""

    reconstruction: Reconstruction
    hand_eye: HandEye
    attempts: tuple[Attempt, ...]


@dataclass(frozen=True, kw_only=True)
class BackendTrial:
    """Reconstruction and calibration by one back end, or the error that prevented one."""

    account: Attempt
    """Record for the files."""
    reconstruction: Reconstruction | None = None
    hand_eye: HandEye | None = None
    failure: InputError | RejectedError | None = None

    @property
    def name(self) -> str:
        """Name of the back end, with its features."""
        features = self.account.features
        return self.account.backend + (f" with {features}" if features else "")

    @property
    def with_error(self) -> str:
        """Name of the back end, with the leave-one-out error."""
        if self.hand_eye is None or self.hand_eye.leave_one_out is None:
            return f"{self.name} (too few images to leave one out)"
        return f"{self.name} (leave-one-out error {leave_one_out_text(self.hand_eye.leave_one_out)})"

    @property
    def rejection(self) -> Finding | None:
        """Strongest finding that rejects the calibration; None of one that is sound, or was not made."""
        if self.hand_eye is None or self.hand_eye.is_sound:
            return None
        return next(finding for finding in self.hand_eye.findings if finding.severity == "rejects")

    @property
    def why_not(self) -> str:
        """Reason why the attempt is not kept, in words."""
        return f"failed ({self.failure})" if self.hand_eye is None else f"is rejected ({self.hand_eye.doubt})"


def rank(trial: BackendTrial) -> tuple[bool, bool, float]:
    """Return the key by which calibrations are compared: accepted, explained, minus the leave-one-out error (m).

    A rejection is explained where a cause rejects it that holds for every reconstruction of the same images.
    """
    assert trial.hand_eye is not None
    rejection, error = trial.rejection, trial.hand_eye.leave_one_out
    is_explained = rejection is not None and is_lasting(rejection)
    return rejection is None, is_explained, -float("inf") if error is None else -error.length_m


def needs_another(trial: BackendTrial) -> bool:
    """Test whether a back end failed, or is rejected for a reason that another back end may not have.

    Findings about camera, robot, mount or motion hold for every reconstruction of the same images.
    """
    if trial.hand_eye is None:
        return True
    rejection = trial.rejection
    return rejection is not None and not is_lasting(rejection) and rejection.concerns in HELPS


def is_textured(trial: BackendTrial, images: int) -> bool:
    """Test whether SIFT found plenty of features in that number of images, so that their lack rejects nothing.

    Learned features find as many on plain surfaces.
    """
    if trial.account.backend != "colmap" or trial.account.features not in (None, "sift"):
        return False
    if trial.reconstruction is None:
        return isinstance(trial.failure, RejectedError) and trial.failure.despite_texture
    return len(trial.reconstruction.tracks.image) >= TEXTURED * images


def choose(
    capture: Capture,
    options: ReconstructOptions,
    calibrate_options: CalibrateOptions,
    progress: Progress | None = None,
    chosen: Callable[[Reconstruction], None] = lambda reconstruction: None,
    depth_options: DepthOptions | None = None,
) -> Selection:
    """Reconstruct and calibrate a capture by the back ends of `reconstruct.tries`, and keep the one of highest rank.

    Another is tried as long as the best one `needs_another`; a note says which was kept and why. `chosen` gets the
    reconstruction as soon as it is certain that the run keeps it. `depth_options` are for a known length. Raises
    InputError as the back end does, and where gripper poses and joint angles contradict each other; NothingFoundError
    where no back end gave anything.
    """
    robot_errors(capture, calibrate_options)  # refuses before the images cost time
    stages = (calibrate_options, depth_options or DepthOptions(), progress)
    plan = tries(options)
    trials, notes = list[BackendTrial](), list[str]()
    of_images: tuple[Finding, ...] | None = None
    for one in plan:
        if trials:
            of_images = _of_images(capture, trials[-1]) if of_images is None else of_images
            reason, goes_on = _why_untried(one, trials, len(capture), of_images)
            if reason is not None:
                notes += filter(None, [reason])
                if goes_on:
                    continue
                break
        trial = _try(capture, one, stages, chosen if len(plan) == 1 else None)
        is_own = not BACKENDS[one.backend].hub_id or options.weights is not None
        if isinstance(trial.failure, InputError) and is_own:
            raise trial.failure
        trials.append(trial)
    selection = _select(trials, notes, of_images or _of_images(capture, trials[-1]))
    if len(plan) > 1:
        chosen(selection.reconstruction)
    return selection


def _why_untried(
    options: ReconstructOptions,
    trials: Sequence[BackendTrial],
    images: int,
    of_images: tuple[Finding, ...],
) -> tuple[str | None, bool]:
    """Return why a back end is not tried after others, None where it is; and whether the next one may be.

    A camera at rest shows every back end the same view. Where SIFT registers nearly all images, other features show
    the same scene to the same robot. Where SIFT finds plenty of features, a back end that does not test the camera as
    features do would accept unseen what these reject.
    """
    best = max((one for one in trials if one.hand_eye is not None), key=rank, default=trials[-1])
    if not needs_another(best):
        rejection = best.rejection
        no_help = "no other back end was tried, for none can help: "
        return "" if rejection is None else no_help + text(rejection), False
    if any(one.severity == "rejects" for one in of_images):
        return "", False
    textured = [one for one in trials if is_textured(one, images)]
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


def _select(trials: Sequence[BackendTrial], notes: list[str], of_images: tuple[Finding, ...]) -> Selection:
    """Return the trial of highest rank with the notes, and with the findings of the images alone.

    Raises InputError or NothingFoundError where there is none.
    """
    kept = max((one for one in trials if one.hand_eye is not None), key=rank, default=None)
    if kept is None:
        *earlier, last = trials
        if isinstance(last.failure, InputError) and not earlier:
            raise last.failure
        failure = (
            last.failure if isinstance(last.failure, RejectedError) else RejectedError(str(last.failure))
        )
        # The licence of weights that were used belongs to this answer, too.
        also = [*notes, *(f"back end {one.name} {one.why_not}" for one in earlier)]
        raise NothingFoundError(
            failure.with_more(*also), tuple(one.account for one in trials), as_causes(of_images)
        )
    assert kept.hand_eye is not None and kept.reconstruction is not None
    others = [one for one in trials if one is not kept]
    if others:
        notes.insert(0, _why_kept(kept, others))
    hand_eye = kept.hand_eye
    found = of_images if hand_eye.is_sound else as_causes(of_images)
    return Selection(
        reconstruction=replace(kept.reconstruction, notes=(*notes, *kept.reconstruction.notes)),
        hand_eye=hand_eye.with_findings(*found) if found else hand_eye,
        attempts=tuple(
            one.account
            if one is kept or one.hand_eye is None
            else replace(one.account, why_not=f"rejected: {one.hand_eye.doubt}")
            for one in trials
        ),
    )


def _why_kept(kept: BackendTrial, others: Sequence[BackendTrial]) -> str:
    """Return why one back end is kept and not the others, in words."""
    parts = [f"{one.name if one.hand_eye is None else one.with_error} {one.why_not}" for one in others]
    accepted, explained, _ = rank(kept)
    if accepted or not any(one.hand_eye is not None for one in others):
        how = f"{kept.with_error} was used"
    elif explained:
        how = f"{kept.with_error} is rejected, too, and was used: it shows the cause"
    else:
        how = f"{kept.with_error} is rejected, too, and was used: its leave-one-out error is the smaller one"
    return f"back end {'; '.join([*parts, how])}"


def _of_images(capture: Capture, trial: BackendTrial) -> tuple[Finding, ...]:
    """Return the findings of the images alone where a calibration failed, is not accepted, or leaves images out."""
    if isinstance(trial.failure, InputError):
        return ()
    found = trial.hand_eye
    if found is not None and found.verdict == "accepted" and found.inliers.sum() == len(capture):
        return ()
    return view_findings(capture)


def again(
    capture: Capture,
    reconstruction: Reconstruction,
    read_s: float,
    options: CalibrateOptions,
    progress: Progress | None = None,
    depth_options: DepthOptions | None = None,
) -> Selection:
    """Calibrate again a reconstruction that was chosen before, and read in `read_s` seconds; raise as `choose`."""
    trial = _reconstructed(reconstruction, read_s, None)
    trial = _calibrated(capture, trial, (options, depth_options or DepthOptions(), progress))
    return _select([trial], [], _of_images(capture, trial))


def timings_of(attempts: Sequence[Attempt]) -> dict[str, float]:
    """Return the seconds that the stages took, all attempts together."""
    return {
        "reconstruct": round(sum(attempt.reconstruct_s for attempt in attempts), 3),
        "calibrate": round(sum(attempt.calibrate_s for attempt in attempts), 3),
    }


Stages = tuple[CalibrateOptions, DepthOptions, Progress | None]


def _try(
    capture: Capture,
    options: ReconstructOptions,
    stages: Stages,
    reconstructed: Callable[[Reconstruction], None] | None,
) -> BackendTrial:
    """Reconstruct by one back end and calibrate; `reconstructed` gets the reconstruction before it is calibrated."""
    start = time.perf_counter()
    features = None if options.features == "auto" else options.features
    try:
        reconstruction = reconstruct(capture, options, stages[2])
    except (InputError, RejectedError) as error:
        account = Attempt(
            backend=options.backend,
            images_registered=None,
            reconstruct_s=round(time.perf_counter() - start, 3),
            calibrate_s=0.0,
            why_not=str(error),
            features=features,
        )
        return BackendTrial(account=account, failure=error.with_traceback(None))
    trial = _reconstructed(reconstruction, time.perf_counter() - start, features, options.backend)
    give_back()  # what the back end worked with
    return _calibrated(capture, trial, stages, reconstructed)


def _reconstructed(
    reconstruction: Reconstruction, seconds: float, features: str | None, backend: str | None = None
) -> BackendTrial:
    """Return the trial of a reconstruction that is not calibrated yet."""
    account = Attempt(
        backend=backend or reconstruction.backend,
        images_registered=len(reconstruction.image_index),
        reconstruct_s=round(seconds, 3),
        calibrate_s=0.0,
        why_not=None,
        features=features,
    )
    return BackendTrial(account=account, reconstruction=reconstruction)


def _calibrated(
    capture: Capture,
    trial: BackendTrial,
    stages: Stages,
    reconstructed: Callable[[Reconstruction], None] | None = None,
) -> BackendTrial:
    """Return the trial with its calibration; InputError of the calibration no other back end avoids.

    A known length ends on surfaces: with one, dense depth comes first, from cameras and tracks alone.
    """
    options, depth_options, progress = stages
    report, reconstruction, account = progress or silent, trial.reconstruction, trial.account
    assert reconstruction is not None
    start = time.perf_counter()
    if options.known_length is not None:
        reconstruction = densify(capture, reconstruction, depth_options, progress)
        seconds = round(account.reconstruct_s + time.perf_counter() - start, 3)
        account = replace(account, reconstruct_s=seconds)
    if reconstructed is not None:
        reconstructed(reconstruction)
    report("calibrate", 0.0)
    start, failure, hand_eye = time.perf_counter(), None, None
    try:
        hand_eye = calibrate(capture, reconstruction, options)
    except RejectedError as error:
        failure = error.with_traceback(None)
    seconds = round(time.perf_counter() - start, 3)
    account = replace(account, calibrate_s=seconds, why_not=None if failure is None else str(failure))
    give_back()
    report("calibrate", 1.0)
    return BackendTrial(account=account, reconstruction=reconstruction, hand_eye=hand_eye, failure=failure)
