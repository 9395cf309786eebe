"""History of the captures that were verified against a run (verify.json), and the sequential test of each new one."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import Field, ValidationError

from jcr.calibration.arm_of_capture import robot_errors
from jcr.calibration.drift import (
    MOST_OLD,
    Change,
    Located,
    Reference,
    Step,
    check_series,
    most_telling,
    step_of,
)
from jcr.errors import InputError, first_fault
from jcr.estimation.absolute_pose import absolute_pose
from jcr.estimation.robot_noise import of_poses
from jcr.files import write_text
from jcr.records.json_fields import Part, Spread
from jcr.records.json_file import read_json
from jcr.result import RunResult

FILE, FORMAT = "verify.json", "jcr.verify/1"
WINDOW = 8
"""Number of the last captures that are tested together. A change that none of eight captures shows is below a third of
what one capture shows; with twice as many the test takes four times as long."""


class NewCapture(Part):
    """Capture that was located in the calibrated scene."""

    name: str
    digests: tuple[str, ...]
    """Hashes of all its images, each with its pose."""
    images: tuple[str, ...]
    """Images that were located and whose poses are used."""
    notes: tuple[str, ...] = ()
    scene_left: Annotated[float, Field(ge=0, le=1)] | None = None
    """Share of the calibrated scene that the images show unchanged; None if too few points were expected."""
    located: Located | None
    """Camera poses of the images; None for captures before the last WINDOW."""


class Verified(NewCapture):
    """Row of the history: a capture and its test."""

    camera: Step
    scene: Step
    detectable: tuple[Spread, Spread]
    """Smallest change of the camera since the capture before (m, rad) that is found with probability 0.9."""
    odds: Spread
    """Odds for a change since the last one that was found; a change is found at 1000."""


class History(Part):
    """Content of verify.json: captures that were verified against one calibration, oldest first, and changes."""

    format: Literal["jcr.verify/1"] = FORMAT
    calibration: str
    """Hash of the calibration and the poses of its images."""
    captures: tuple[Verified, ...] = ()
    changes: tuple[Change, ...] = ()


def read_history(out: Path, calibration: str) -> History:
    """Read verify.json of a run folder; return an empty history if there is none of this calibration."""
    file, empty = out / FILE, History(calibration=calibration)
    if not file.is_file():
        return empty
    try:
        found = History.model_validate(read_json(file))
    except ValidationError as error:
        raise InputError(f"{file}: {first_fault(error)}; remove the file, the history begins again") from None
    return found if found.calibration == calibration else empty


def without_part(history: History, digests: Sequence[str]) -> History:
    """Return the history without its last capture, if that holds a part of the images with these hashes.

    Raises InputError if some of the images belong to other captures.
    """
    known = [one for one in history.captures if not set(digests).isdisjoint(one.digests)]
    if not known:
        return history
    last = history.captures[-1]
    if known != [last] or not set(last.digests) < set(digests):
        names = ", ".join(one.name for one in known)
        raise InputError(f"some of the images were verified before ({names}); take new ones")
    index = len(history.captures) - 1
    changes = tuple(one for one in history.changes if one.named < index)
    return history.model_copy(update={"captures": history.captures[:-1], "changes": changes})


def write_history(out: Path, history: History) -> None:
    """Write verify.json; only the last WINDOW captures keep their camera poses."""
    old = [one.model_copy(update={"located": None}) for one in history.captures[:-WINDOW]]
    kept = history.model_copy(update={"captures": (*old, *history.captures[-WINDOW:])})
    write_text(out / FILE, kept.model_dump_json() + "\n")


def reference_of(run: RunResult) -> tuple[Reference, ndarray]:
    """Return the calibration of a run for tests of later captures, and the indices of the images it contains."""
    calibration = run.found
    _, capture, reconstruction = run.of_wrist_camera()
    used = np.flatnonzero([calibration.images[row].used for row in reconstruction.image_index])
    used = used[np.unique(np.linspace(0, len(used) - 1, min(MOST_OLD, len(used))).astype(int))]
    rows, similarity = reconstruction.image_index[used], calibration.base_from_recon
    return Reference(
        x=calibration.gripper_from_camera,
        scale=similarity.scale,
        z=similarity.rigid,
        base_from_gripper=capture.base_from_gripper[rows],
        recon_from_camera=reconstruction.recon_from_camera[used],
        noise_floor=run.state.options.calibrate.robot_noise_m_rad,
    ), rows


def with_capture(history: History, run: RunResult, new: NewCapture) -> History:
    """Return the history with one more capture, tested with those before it.

    An image whose pose contradicts the others is left out with a note.
    """
    reference, rows = reference_of(run)
    before = max(len(history.captures) + 1 - WINDOW, 0)
    while True:
        assert new.located is not None
        series = [*(one.located for one in history.captures[before:] if one.located), new.located]
        systematic = _systematic(run, rows, series)
        test = check_series(reference, series, systematic, history.changes, before)
        if test.wrong_image is None:
            break
        new = _without_image(new, test.wrong_image)
    count = 6 * len(reference.base_from_gripper)
    own = np.r_[:count, len(systematic) - 6 * len(new.located) : len(systematic)]
    alone = reference, new.located, systematic[np.ix_(own, own)]
    decided = [one for one in test.changes if not one.rivals]
    row = Verified(
        **vars(new),
        camera=step_of(*alone, "camera", decided),
        scene=step_of(*alone, "scene", decided),
        detectable=test.detectable,
        odds=float(np.exp(min(test.log_odds, 100.0))),
    )
    return history.model_copy(update={"captures": (*history.captures, row), "changes": test.changes})


def telling_poses(run: RunResult, count: int) -> list[tuple[int, tuple[float, float]]]:
    """Return the images of a run at whose poses new images would tell most about the camera, best first.

    Each is the index of an image in the capture, with the change (m, rad) of the camera that the images up to this one
    find nine times in ten. The errors of their camera poses are taken from the points that the old images show.
    """
    reference, rows = reference_of(run)
    _, capture, reconstruction = run.of_wrist_camera()
    tracks, covariances = reconstruction.tracks, list[ndarray]()
    for row in rows:
        own = tracks.image == np.flatnonzero(reconstruction.image_index == row)[0]
        points = tracks.points_in_recon[tracks.point[own]]
        pose = absolute_pose(tracks.x_px[own], points, reconstruction.intrinsics, gate_px=3.0)
        if pose is None:
            raise InputError(f"{capture.images[row]}: shows too little of the scene; name poses of your own")
        covariances.append(pose.covariance)
    there = Located(
        base_from_gripper=tuple(reference.base_from_gripper),
        recon_from_camera=tuple(reference.recon_from_camera),
        covariance=tuple(covariances),
        joints=None if capture.joints is None else tuple(capture.joints[rows]),
    )
    systematic = _systematic(run, rows, [there])
    return [(int(rows[k]), noticed) for k, noticed in most_telling(reference, there, systematic, count)]


def _systematic(run: RunResult, rows: ndarray, series: Sequence[Located]) -> Float[ndarray, "s s"]:
    """Return the covariance of systematic errors of the poses of the calibration's images `rows`, then of a series."""
    gripper = np.concatenate([np.stack(one.base_from_gripper) for one in series])
    joints = [np.stack(one.joints) for one in series if one.joints is not None]
    later = replace(
        run.capture,
        images=tuple(map(str, range(len(gripper)))),
        base_from_gripper=gripper,
        joints=np.concatenate(joints) if len(joints) == len(series) else None,
        depths=None,
        others=(),
    )
    errors = robot_errors(run.capture, run.state.options.calibrate, later)
    return of_poses(errors.systematic, np.r_[rows, len(run.capture) + np.arange(len(gripper))])


def _without_image(new: NewCapture, image: int) -> NewCapture:
    """Return a capture without one image, whose pose contradicts the others, and with a note of it."""
    left = [k for k in range(len(new.images)) if k != image]
    parts = {name: part and tuple(part[k] for k in left) for name, part in vars(new.located).items()}
    note = f"{new.images[image]}: its pose contradicts the other images; it is left out"
    update = {"images": tuple(new.images[k] for k in left), "located": Located(**parts)}
    return new.model_copy(update=update | {"notes": (*new.notes, note)})
