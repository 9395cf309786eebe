"""Which back end a run keeps: each that is tried is reconstructed, calibrated and timed, one after the other."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from jcr.calibration.options import CalibrateOptions
from jcr.calibration.robot_errors import robot_errors
from jcr.calibration.stage import calibrate
from jcr.calibration.words import missed
from jcr.errors import InputError, NotTrustedError
from jcr.memory import give_back
from jcr.progress import Progress, silent
from jcr.reconstruct.backends import (
    BACKENDS,
    ReconstructOptions,
    plan_depth,
    reconstruct,
    tries,
    with_depth_of,
)
from jcr.records import Attempt, Capture, HandEye, Reconstruction


@dataclass(frozen=True)
class Choice:
    """What the run keeps, and why."""

    reconstruction: Reconstruction
    hand_eye: HandEye
    attempts: tuple[Attempt, ...]
    """In the order in which they were made."""
    timings_s: dict[str, float]
    """What the stages took now, all attempts together."""


class NothingFoundError(NotTrustedError):
    """No back end that was tried came to a calibration."""

    def __init__(self, failure: NotTrustedError, attempts: tuple[Attempt, ...]) -> None:
        super().__init__(failure.what, *failure.remedies, also=failure.also)
        self.attempts = attempts


def choose(
    capture: Capture,
    options: ReconstructOptions,
    calibrate_options: CalibrateOptions,
    progress: Progress | None = None,
    chosen: Callable[[Reconstruction], None] = lambda reconstruction: None,
) -> Choice:
    """The capture reconstructed and calibrated; where `auto` had a choice, the notes say what it chose and why.

    `auto` runs the best back end whose weights are on this machine, and the next attempt of `backends.tries` as long
    as the ones before failed or gave a calibration that is rejected for another reason than the motion. Of two results
    an accepted one is kept, else the one with the smaller leave-one-out error; dense depth is made for the one that is
    kept, unless a known length is read from it. `chosen` gets the reconstruction as soon as it is sure that the run
    keeps it. Raises InputError as the back end does, and where gripper poses and joint angles contradict each other;
    NothingFoundError where no back end gave anything.
    """
    robot_errors(capture, calibrate_options)  # refuses before the images cost time
    made = tries(options)
    if len(made) == 1:
        only = _tried(capture, made[0], calibrate_options, progress, chosen)
        return _choice(only, (only.attempt(),))
    depth_later = options.dense and calibrate_options.known_length is None
    if depth_later:
        if not BACKENDS[made[0].backend].hub_id:
            plan_depth(capture, options)
        made = [replace(one, dense=False) for one in made]
    kept = _tried(capture, made[0], calibrate_options, progress)
    if isinstance(kept.failure, InputError) and options.weights is not None:
        raise kept.failure
    attempts, at = [kept.attempt()], 0
    if kept.is_enough and BACKENDS[kept.backend].hub_id:
        kept = kept.noted(_about(kept.backend))
    for one in made[1:]:
        if kept.is_enough:
            break
        other = _tried(capture, one, calibrate_options, progress)
        kept, (attempts[at], of_other) = _better(kept, other)
        attempts.append(of_other)
        if kept.name == other.name:
            at = len(attempts) - 1
    if depth_later:
        kept, attempts[at] = kept.with_depth(capture, options, attempts[at], progress)
    choice = _choice(kept, tuple(attempts))
    chosen(choice.reconstruction)
    return choice


def again(
    capture: Capture,
    reconstruction: Reconstruction,
    read_s: float,
    earlier: tuple[Attempt, ...],
    options: CalibrateOptions,
    progress: Progress | None = None,
) -> Choice:
    """A reconstruction that was chosen before, and read in `read_s` seconds, calibrated again; raises as `choose` does.

    The account of how it was chosen stays what it was.
    """
    tried = _calibrated(capture, _Tried(reconstruction.backend, read_s, reconstruction), options, progress)
    choice = _choice(tried, (tried.attempt(),))
    return replace(choice, attempts=earlier or choice.attempts)


def deepened(
    capture: Capture, choice: Choice, options: ReconstructOptions, progress: Progress | None = None
) -> Choice:
    """A choice that was made without dense depth, with it; raises as `choose` does where the memory is too small."""
    if not BACKENDS[choice.reconstruction.backend].hub_id:
        plan_depth(capture, options)
    start = time.perf_counter()
    made = with_depth_of(capture, choice.reconstruction, options, progress)
    give_back()
    seconds = choice.timings_s["reconstruct"] + time.perf_counter() - start
    return replace(
        choice, reconstruction=made, timings_s=choice.timings_s | {"reconstruct": round(seconds, 3)}
    )


@dataclass(frozen=True)
class _Tried:
    """One attempt with all that it made."""

    backend: str
    reconstruct_s: float
    reconstruction: Reconstruction | None = None
    calibrate_s: float = 0.0
    hand_eye: HandEye | None = None
    failure: InputError | NotTrustedError | None = None
    """Why there is no calibration."""
    features: str | None = None
    """What was matched between images, where the back end has a choice."""

    @property
    def name(self) -> str:
        """The back end and its features."""
        return self.backend + (f" with {self.features}" if self.features else "")

    @property
    def missed_m(self) -> float:
        """Error on images left out; infinite where there were too few to leave one out."""
        held_out = None if self.hand_eye is None else self.hand_eye.held_out
        return float("inf") if held_out is None else held_out.length_m

    @property
    def is_enough(self) -> bool:
        """Whether no other back end is asked: this one is accepted, or the motion is at fault."""
        hand_eye = self.hand_eye
        return hand_eye is not None and (hand_eye.converged or not hand_eye.observability.observable)

    def told(self) -> str:
        """The back end, and its error on images left out."""
        held_out = None if self.hand_eye is None else self.hand_eye.held_out
        error = (
            "too few images to leave one out"
            if held_out is None
            else f"leave-one-out error {missed(held_out)}"
        )
        return f"{self.name} ({error})"

    def noted(self, note: str) -> "_Tried":
        """The same with one more note."""
        assert self.reconstruction is not None
        return replace(
            self, reconstruction=replace(self.reconstruction, notes=(note, *self.reconstruction.notes))
        )

    def with_depth(
        self, capture: Capture, options: ReconstructOptions, account: Attempt, progress: Progress | None
    ) -> "tuple[_Tried, Attempt]":
        """The same with dense depth, and the account of it with the time that took."""
        if self.reconstruction is None or self.hand_eye is None:
            return self, account
        start = time.perf_counter()
        made = with_depth_of(capture, self.reconstruction, options, progress)
        give_back()
        seconds = self.reconstruct_s + time.perf_counter() - start
        tried = replace(self, reconstruction=made, reconstruct_s=seconds)
        return tried, replace(account, reconstruct_s=round(seconds, 3))

    def attempt(self, why_not: str | None = None) -> Attempt:
        """The account of it; what failed has its own reason."""
        return Attempt(
            self.backend,
            None if self.reconstruction is None else len(self.reconstruction.image_index),
            round(self.reconstruct_s, 3),
            round(self.calibrate_s, 3),
            why_not if self.failure is None else str(self.failure),
            self.features,
        )


def _tried(
    capture: Capture,
    options: ReconstructOptions,
    calibrate_options: CalibrateOptions,
    progress: Progress | None,
    reconstructed: Callable[[Reconstruction], None] = lambda reconstruction: None,
) -> _Tried:
    """One back end's reconstruction, and what `calibrate` makes of it."""
    start = time.perf_counter()
    features = None if options.features == "auto" else options.features
    try:
        reconstruction = reconstruct(capture, options, progress)
    except (InputError, NotTrustedError) as error:
        seconds = time.perf_counter() - start
        return _Tried(options.backend, seconds, failure=error.with_traceback(None), features=features)
    tried = _Tried(options.backend, time.perf_counter() - start, reconstruction, features=features)
    give_back()  # what the back end worked with
    reconstructed(reconstruction)
    return _calibrated(capture, tried, calibrate_options, progress)


def _calibrated(
    capture: Capture, tried: _Tried, options: CalibrateOptions, progress: Progress | None
) -> _Tried:
    """Input that calibration cannot use, no other back end fixes: its InputError is the caller's."""
    report = progress or silent
    assert tried.reconstruction is not None
    report("calibrate", 0.0)
    start = time.perf_counter()
    try:
        hand_eye = calibrate(capture, tried.reconstruction, options)
    except NotTrustedError as error:
        return replace(tried, calibrate_s=time.perf_counter() - start, failure=error.with_traceback(None))
    seconds = time.perf_counter() - start
    give_back()
    report("calibrate", 1.0)
    return replace(tried, calibrate_s=seconds, hand_eye=hand_eye)


def _about(backend: str, name: str = "") -> str:
    best = ", the best whose weights are on this machine" if BACKENDS[backend].hub_id else ""
    return f"back end {name or backend}{best}"


def _better(one: _Tried, other: _Tried) -> tuple[_Tried, tuple[Attempt, ...]]:
    """Which of two is kept, noting why, and the account of both; `one` is known to be doubtful."""
    if isinstance(other.failure, InputError) and not BACKENDS[other.backend].hub_id:
        raise other.failure
    about = _about(one.backend, one.name)
    about += "," * ("," in about)
    if one.hand_eye is None:
        nothing = f"{about} failed ({one.failure})"
        if other.hand_eye is None:
            # The licence of weights that were used belongs to this answer, too.
            why = other.failure
            failure = why if isinstance(why, NotTrustedError) else NotTrustedError(str(why))
            failure = failure.with_more(nothing)
            return replace(other, failure=failure), (one.attempt(), other.attempt())
        kept = other.noted(f"{nothing}; {other.told()} was used instead")
        return kept, (one.attempt(), other.attempt())
    doubt = f"{about} is rejected ({one.hand_eye.doubt})"
    if other.hand_eye is None:
        kept = one.noted(f"{doubt}, and {other.name} failed ({other.failure})")
        return kept, (one.attempt(), other.attempt())
    untrusted = f"rejected: {one.hand_eye.doubt}"
    if other.hand_eye.converged:
        kept = other.noted(f"{doubt}; {other.told()} is accepted, and was used instead of {one.told()}")
        return kept, (one.attempt(untrusted), other.attempt())
    kept, left = (other, one) if other.missed_m < one.missed_m else (one, other)
    words = f"{doubt}, and so is {other.name}; {kept.told()} was used and not {left.told()}"
    farther = f"rejected, and its leave-one-out error is the larger one: {left.told()}"
    attempts = tuple(tried.attempt(farther if tried is left else None) for tried in (one, other))
    return kept.noted(words), attempts


def _choice(kept: _Tried, attempts: tuple[Attempt, ...]) -> Choice:
    """Raises InputError or NothingFoundError where there is nothing to keep."""
    if isinstance(kept.failure, InputError):
        raise kept.failure
    if kept.failure is not None:
        raise NothingFoundError(kept.failure, attempts)
    assert kept.reconstruction is not None and kept.hand_eye is not None
    return Choice(kept.reconstruction, kept.hand_eye, attempts, timings_of(attempts))


def timings_of(attempts: tuple[Attempt, ...]) -> dict[str, float]:
    """Seconds that the stages took, all attempts together."""
    return {
        "reconstruct": round(sum(attempt.reconstruct_s for attempt in attempts), 3),
        "calibrate": round(sum(attempt.calibrate_s for attempt in attempts), 3),
    }
