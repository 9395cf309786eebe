"""Which back end a run keeps: each that is tried is reconstructed, calibrated and timed, one after the other."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from jcr.allocator import give_back
from jcr.calibration.checks.views import as_causes, view_findings
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
from jcr.records import Attempt, Capture, HandEye, LeaveOneOut, Reconstruction


class NothingFoundError(RejectedError):
    """No back end that was tried came to a calibration; `findings` say why, strongest first."""

    def __init__(
        self, failure: RejectedError, attempts: tuple[Attempt, ...], causes: tuple[Finding, ...] = ()
    ) -> None:
        self.attempts = attempts
        self.findings = strongest_first((*causes, *no_reconstruction(failure)))
        first = self.findings[0]
        if first.kind is FindingKind.NO_RECONSTRUCTION:
            super().__init__(failure.what, *failure.remedies, also=failure.also)
        else:  # too few features, and what would give more, are its consequences
            super().__init__(text(first), *filter(None, [remedy(first)]))


@dataclass(frozen=True, kw_only=True)
class Tried:
    """One back end's reconstruction and calibration, or why there is none, among the others that were tried."""

    account: Attempt
    """For the files."""
    made: Reconstruction | None = None
    calibrated: HandEye | None = None
    failure: InputError | RejectedError | None = None
    """Why there is no calibration."""
    before: tuple[Attempt, ...] = ()
    after: tuple[Attempt, ...] = ()
    """The accounts of the others, in the order in which they were made."""

    @property
    def attempts(self) -> tuple[Attempt, ...]:
        """The accounts of all, in the order in which they were made."""
        return (*self.before, self.account, *self.after)

    @property
    def timings_s(self) -> dict[str, float]:
        """Seconds that the stages took, all attempts together."""
        return timings_of(self.attempts)

    @property
    def reconstruction(self) -> Reconstruction:
        """Of an attempt that `require_found` passed."""
        assert self.made is not None
        return self.made

    @property
    def hand_eye(self) -> HandEye:
        """Of an attempt that `require_found` passed."""
        assert self.calibrated is not None
        return self.calibrated

    @property
    def leave_one_out(self) -> LeaveOneOut | None:
        """The leave-one-out error; None where there were too few images, or nothing was found."""
        return None if self.calibrated is None else self.calibrated.leave_one_out

    @property
    def leave_one_out_m(self) -> float:
        """The leave-one-out error as one length; infinite where there is none."""
        return float("inf") if self.leave_one_out is None else self.leave_one_out.length_m

    @property
    def name(self) -> str:
        """The back end and its features."""
        features = self.account.features
        return self.account.backend + (f" with {features}" if features else "")

    @property
    def title(self) -> str:
        """The name for the beginning of a note."""
        best = ", the best whose weights are on this machine" if BACKENDS[self.account.backend].hub_id else ""
        return f"back end {self.name}{best}"

    @property
    def with_error(self) -> str:
        """The name with the leave-one-out error."""
        if self.leave_one_out is None:
            return f"{self.name} (too few images to leave one out)"
        return f"{self.name} (leave-one-out error {leave_one_out_text(self.leave_one_out)})"

    def noted(self, note: str) -> "Tried":
        """The same with one more note."""
        made = self.reconstruction
        return replace(self, made=replace(made, notes=(note, *made.notes)))

    def kept_after(self, other: "Tried", why_not: str | None = None) -> "Tried":
        """This one kept, which was tried after another; `why_not` is why that is not, where it did not fail."""
        return replace(self, before=(*other.before, other.rejected_attempts(why_not), *other.after))

    def kept_before(self, other: "Tried", why_not: str | None = None) -> "Tried":
        """This one kept, which was tried before another; `why_not` is why that is not, where it did not fail."""
        return replace(self, after=(*self.after, other.rejected_attempts(why_not)))

    def rejected_attempts(self, why_not: str | None) -> Attempt:
        """The account of one that is not kept; what failed has its own reason."""
        return self.account if why_not is None else replace(self.account, why_not=why_not)

    def require_found(self, of_images: tuple[Finding, ...]) -> "Tried":
        """Itself, with what the images alone say of the capture; raises InputError or NothingFoundError where there is
        nothing to keep."""
        if isinstance(self.failure, InputError):
            raise self.failure
        if self.failure is not None:
            raise NothingFoundError(self.failure, self.attempts, as_causes(of_images))
        found = of_images if self.hand_eye.is_sound else as_causes(of_images)
        return replace(self, calibrated=self.hand_eye.with_findings(*found)) if found else self


HELPS: tuple[Concerns, ...] = ("reconstruction", "images")
"""What another reconstruction of the same images may help against: one that is wrong, or of too few of them."""


def rejection(tried: Tried) -> Finding | None:
    """The strongest finding that rejects a calibration; None of one that is sound, or was not made."""
    if tried.calibrated is None or tried.calibrated.is_sound:
        return None
    return next(finding for finding in tried.calibrated.findings if finding.severity == "rejects")


def needs_another(tried: Tried) -> bool:
    """Whether another back end is tried: this one failed, or is rejected for what another may not have.

    What was found about camera, robot, mount or motion holds for every reconstruction of the same images.
    """
    if tried.calibrated is None:
        return True
    rejected = rejection(tried)
    return rejected is not None and not is_lasting(rejected) and rejected.concerns in HELPS


TEXTURED = 50
"""Observations per image of the capture. SIFT finds 600 to 850 in simulated tabletops of 640x480, 220 in those of half
the size, and 90 where all are blurred by 9 px."""


def is_textured(tried: Tried, images: int) -> bool:
    """Whether SIFT found features in plenty in that number of images, so that a rejection is not for lack of them.

    Learned features find as many on plain surfaces.
    """
    if tried.account.backend != "colmap" or tried.account.features not in (None, "sift"):
        return False
    if tried.made is None:
        return isinstance(tried.failure, RejectedError) and tried.failure.despite_texture
    return len(tried.made.tracks.image) >= TEXTURED * images


NEARLY_ALL = 0.9
"""Share of the capture's images."""


def is_well_seen(tried: Tried, images: int) -> bool:
    """Whether SIFT found features in plenty and registered nearly all of that number of images, so that a rejection is
    not for lack of either: other features show the same scene to the same robot, for three times the seconds."""
    return (
        is_textured(tried, images)
        and tried.made is not None
        and len(tried.made.image_index) >= NEARLY_ALL * images
    )


def choose(
    capture: Capture,
    options: ReconstructOptions,
    calibrate_options: CalibrateOptions,
    progress: Progress | None = None,
    chosen: Callable[[Reconstruction], None] = lambda reconstruction: None,
    depth_options: DepthOptions | None = None,
) -> Tried:
    """The capture reconstructed and calibrated; where `auto` had a choice, the notes say what it chose and why.

    `auto` runs the best back end whose weights are on this machine, and the next attempt of `backends.tries` as long
    as one `needs_another`; where SIFT finds features in plenty, none that does not test the camera as these do, for
    what they reject it would accept unseen, and where these register nearly all images no other features. Of two
    results an accepted one is kept, else the one with the smaller leave-one-out error. `chosen` gets the
    reconstruction as soon as it is sure that the run keeps it. `depth_options` are for a known length. Raises
    InputError as the back end does, and where gripper poses and joint angles contradict each other; NothingFoundError
    where no back end gave anything.
    """
    robot_errors(capture, calibrate_options)  # refuses before the images cost time
    depth_options = depth_options or DepthOptions()
    first, *others = tries(options)
    if not others:
        kept = _tried(capture, first, calibrate_options, depth_options, progress, chosen)
        return kept.require_found(_of_images(capture, kept))
    kept = _tried(capture, first, calibrate_options, depth_options, progress)
    if isinstance(kept.failure, InputError) and options.weights is not None:
        raise kept.failure
    if not needs_another(kept) and BACKENDS[kept.account.backend].hub_id:
        kept = kept.noted(kept.title)
    of_images = _of_images(capture, kept)
    # A camera at rest shows every back end the same one view.
    untried = [] if any(one.severity == "rejects" for one in of_images) else others
    textured, seen = is_textured(kept, len(capture)), is_well_seen(kept, len(capture))
    for one in untried:
        if not needs_another(kept):
            kept = _alone(kept)
            break
        if seen and one.backend == "colmap":
            kept = kept.noted(
                f"no features but SIFT's were tried: there are plenty, and they register "
                f"{len(kept.reconstruction.image_index)} of {len(capture)} images"
            )
            continue
        if textured and not BACKENDS[one.backend].tests_camera:
            kept = _not_overruled(kept, one.backend)
            break
        tried = _tried(capture, one, calibrate_options, depth_options, progress)
        textured = textured or is_textured(tried, len(capture))
        seen = seen or is_well_seen(tried, len(capture))
        kept = _better(kept, tried)
    kept = kept.require_found(of_images)
    chosen(kept.reconstruction)
    return kept


def _of_images(capture: Capture, tried: Tried) -> tuple[Finding, ...]:
    """What the images alone say of a capture that failed, is not accepted as it is, or has images without a use."""
    if isinstance(tried.failure, InputError):
        return ()
    found = tried.calibrated
    if found is not None and found.verdict == "accepted" and found.inliers.sum() == len(capture):
        return ()
    return view_findings(capture)


def _alone(kept: Tried) -> Tried:
    """With why no other back end was tried, where a rejected one is kept."""
    rejected = rejection(kept)
    if rejected is None:
        return kept
    return kept.noted(f"no other back end was tried, for none can help: {text(rejected)}")


def _not_overruled(kept: Tried, backend: str) -> Tried:
    """With why a back end that tests less was not tried."""
    note = (
        f"{backend} was not tried: it is for scenes without features, which these images have in plenty, and does not "
        "test the camera as they do"
    )
    if kept.calibrated is not None:
        return kept.noted(note)
    assert isinstance(kept.failure, RejectedError)
    return replace(kept, failure=kept.failure.with_more(note))


def again(
    capture: Capture,
    reconstruction: Reconstruction,
    read_s: float,
    options: CalibrateOptions,
    progress: Progress | None = None,
    depth_options: DepthOptions | None = None,
) -> Tried:
    """A reconstruction that was chosen before, and read in `read_s` seconds, calibrated again; raises as `choose`."""
    tried = _reconstructed(reconstruction, read_s, None)
    surfaces = _with_surface(capture, tried, options, depth_options or DepthOptions(), progress)
    kept = _calibrated(capture, surfaces, options, progress)
    return kept.require_found(_of_images(capture, kept))


def timings_of(attempts: tuple[Attempt, ...]) -> dict[str, float]:
    """Seconds that the stages took, all attempts together."""
    return {
        "reconstruct": round(sum(attempt.reconstruct_s for attempt in attempts), 3),
        "calibrate": round(sum(attempt.calibrate_s for attempt in attempts), 3),
    }


def _tried(
    capture: Capture,
    options: ReconstructOptions,
    calibrate_options: CalibrateOptions,
    depth_options: DepthOptions,
    progress: Progress | None,
    reconstructed: Callable[[Reconstruction], None] = lambda reconstruction: None,
) -> Tried:
    """One back end's reconstruction, and what `calibrate` makes of it."""
    start = time.perf_counter()
    features = None if options.features == "auto" else options.features
    try:
        reconstruction = reconstruct(capture, options, progress)
    except (InputError, RejectedError) as error:
        seconds = round(time.perf_counter() - start, 3)
        account = Attempt(
            backend=options.backend,
            images_registered=None,
            reconstruct_s=seconds,
            calibrate_s=0.0,
            why_not=str(error),
            features=features,
        )
        return Tried(account=account, failure=error.with_traceback(None))
    tried = _reconstructed(reconstruction, time.perf_counter() - start, features, options.backend)
    give_back()  # what the back end worked with
    tried = _with_surface(capture, tried, calibrate_options, depth_options, progress)
    reconstructed(tried.reconstruction)
    return _calibrated(capture, tried, calibrate_options, progress)


def _reconstructed(
    reconstruction: Reconstruction, seconds: float, features: str | None, backend: str | None = None
) -> Tried:
    count = len(reconstruction.image_index)
    account = Attempt(
        backend=backend or reconstruction.backend,
        images_registered=count,
        reconstruct_s=round(seconds, 3),
        calibrate_s=0.0,
        why_not=None,
        features=features,
    )
    return Tried(account=account, made=reconstruction)


def _with_surface(
    capture: Capture,
    tried: Tried,
    options: CalibrateOptions,
    depth_options: DepthOptions,
    progress: Progress | None,
) -> Tried:
    """The attempt as the calibration can take it: a known length ends on surfaces, so here densify comes before it.

    It may, for it uses cameras and tracks alone; everywhere else it follows the calibration, of the attempt that is
    kept.
    """
    if options.known_length is None:
        return tried
    start = time.perf_counter()
    made = densify(capture, tried.reconstruction, depth_options, progress)
    seconds = tried.account.reconstruct_s + time.perf_counter() - start
    return replace(tried, made=made, account=replace(tried.account, reconstruct_s=round(seconds, 3)))


def _calibrated(
    capture: Capture, tried: Tried, options: CalibrateOptions, progress: Progress | None
) -> Tried:
    """Input that calibration cannot use, no other back end fixes: its InputError is the caller's."""
    report = progress or silent
    report("calibrate", 0.0)
    start = time.perf_counter()

    def account(why_not: str | None) -> Attempt:
        seconds = round(time.perf_counter() - start, 3)
        return replace(tried.account, calibrate_s=seconds, why_not=why_not)

    try:
        hand_eye = calibrate(capture, tried.reconstruction, options)
    except RejectedError as error:
        return replace(tried, account=account(str(error)), failure=error.with_traceback(None))
    calibrated = replace(tried, account=account(None), calibrated=hand_eye)
    give_back()
    report("calibrate", 1.0)
    return calibrated


def _is_explained(tried: Tried) -> bool:
    """Whether what rejects it is a cause, which holds for every reconstruction of the same images."""
    rejected = rejection(tried)
    return rejected is not None and is_lasting(rejected)


def _better(one: Tried, other: Tried) -> Tried:
    """Which of two is kept, noting why; `one` is known to be doubtful, and was tried first."""
    if isinstance(other.failure, InputError) and not BACKENDS[other.account.backend].hub_id:
        raise other.failure
    about = one.title + "," * ("," in one.title)
    if one.calibrated is None:
        nothing = f"{about} failed ({one.failure})"
        if other.calibrated is None:
            # The licence of weights that were used belongs to this answer, too.
            why = other.failure
            failure = why if isinstance(why, RejectedError) else RejectedError(str(why))
            return replace(other, failure=failure.with_more(nothing)).kept_after(one)
        return other.noted(f"{nothing}; {other.with_error} was used instead").kept_after(one)
    untrusted = f"rejected: {one.hand_eye.doubt}"
    doubt = f"{about} is rejected ({one.hand_eye.doubt})"
    if other.calibrated is None:
        return one.noted(f"{doubt}, and {other.name} failed ({other.failure})").kept_before(other)
    if other.hand_eye.is_sound:
        note = f"{doubt}; {other.with_error} is {other.hand_eye.verdict}, and was used instead of {one.with_error}"
        return other.noted(note).kept_after(one, untrusted)
    farther = "rejected, and its leave-one-out error is the larger one: "
    note = f"{doubt}, and so is {other.name}; "
    if _is_explained(other) and not _is_explained(one):
        return other.noted(f"{note}{other.name} shows why").kept_after(one, untrusted)
    if other.leave_one_out_m < one.leave_one_out_m:
        note += f"{other.with_error} was used and not {one.with_error}"
        return other.noted(note).kept_after(one, farther + one.with_error)
    note += f"{one.with_error} was used and not {other.with_error}"
    return one.noted(note).kept_before(other, farther + other.with_error)
