"""What `--backend auto` does: the best back end, and another one where that is not to be trusted."""

from dataclasses import dataclass, replace

from jcr.calibration.stage import CalibrateOptions, calibrate, missed_m
from jcr.errors import InputError, NotTrustedError
from jcr.progress import Progress
from jcr.reconstruct.backends import ReconstructOptions, candidates, reconstruct
from jcr.reconstruct.checkpoints import CHECKPOINTS
from jcr.records import Capture, HandEye, HeldOut, Reconstruction


@dataclass(frozen=True)
class Attempt:
    """What one back end came to."""

    reconstruction: Reconstruction
    hand_eye: HandEye | None = None
    """What `calibrate` makes of it; None: it was not asked, as there was no choice."""

    @property
    def held_out(self) -> HeldOut | None:
        """None where too few images were there to leave one out."""
        return None if self.hand_eye is None else self.hand_eye.held_out

    @property
    def missed_m(self) -> float:
        """Error on images left out; infinite where there were too few to leave one out."""
        return missed_m(self.held_out)

    def told(self) -> str:
        """The back end, and its error on images left out."""
        held_out, name = self.held_out, self.reconstruction.backend
        if held_out is None:
            return f"{name} (too few images to leave one out)"
        return f"{name} (held-out error {held_out.translation_mm:.2g} mm, {held_out.rotation_deg:.2g}°)"

    def noted(self, note: str) -> "Attempt":
        """The same with one more note."""
        return replace(
            self, reconstruction=replace(self.reconstruction, notes=(note, *self.reconstruction.notes))
        )


def best_reconstruction(
    capture: Capture,
    options: ReconstructOptions,
    calibrate_options: CalibrateOptions,
    progress: Progress | None = None,
) -> Attempt:
    """The capture reconstructed; where `auto` had a choice, the notes say what it chose and why.

    `auto` runs the best back end whose weights are on this machine, and the next one when that gives nothing or
    its calibration is not to be trusted for another reason than the motion. Of two results a trusted one is kept,
    else the one with the smaller held-out error. Raises as `reconstruct` does for the last one that was tried.
    """
    names = candidates(options)[:2]
    if len(names) == 1:
        return Attempt(reconstruct(capture, replace(options, backend=names[0]), progress))
    first = replace(options, backend=names[0])
    # Weights that the user named are the first one's.
    second = replace(options, backend=names[1], weights=None)
    chose = f"back end {names[0]}"
    if names[0] in CHECKPOINTS:
        chose += ", the best whose weights are on this machine"
    try:
        one = _attempt(capture, first, calibrate_options, progress)
    except (NotTrustedError, InputError) as error:
        if isinstance(error, InputError) and options.weights is not None:
            raise
        nothing = f"{chose}, gave nothing ({error})"
        try:
            other = _attempt(capture, second, calibrate_options, progress)
        except NotTrustedError as last:  # the licence of weights that were used belongs to this answer, too
            raise NotTrustedError(f"{last}; {nothing}") from None
        return other.noted(f"{nothing}; {other.told()} was used instead")
    assert one.hand_eye is not None
    if one.hand_eye.converged or not one.hand_eye.observability.observable:
        return one.noted(chose) if names[0] in CHECKPOINTS else one
    doubt = f"{chose}, is not to be trusted ({one.hand_eye.warnings[0]})"
    try:
        other = _attempt(capture, second, calibrate_options, progress)
    except NotTrustedError as error:
        return one.noted(f"{doubt}, and {names[1]} gave nothing ({error})")
    assert other.hand_eye is not None
    if other.hand_eye.converged:
        return other.noted(f"{doubt}; {other.told()} is, and was used instead of {one.told()}")
    kept, left = (other, one) if other.missed_m < one.missed_m else (one, other)
    return kept.noted(f"{doubt}, nor is {names[1]}; {kept.told()} was used and not {left.told()}")


def _attempt(
    capture: Capture,
    options: ReconstructOptions,
    calibrate_options: CalibrateOptions,
    progress: Progress | None,
) -> Attempt:
    reconstruction = reconstruct(capture, options, progress)
    return Attempt(reconstruction, calibrate(capture, reconstruction, calibrate_options))
