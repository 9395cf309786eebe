"""Verification of a calibration by later captures of its scene: has camera, scene or robot changed since?"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.calibration.drift import Cause, detectable
from jcr.calibration.options import GRASPING
from jcr.capture.images import read_image
from jcr.capture.read import read_capture
from jcr.distributions import chi2
from jcr.errors import InputError, RejectedError
from jcr.estimation.robot_noise import REACH
from jcr.files import locked
from jcr.findings import Verdict
from jcr.geometry import Transform, retract, step_between
from jcr.number_format import significant
from jcr.pipeline.calibrated_scene import (
    NewImages,
    name_of,
    new_images,
    old_scene,
    require_new,
)
from jcr.pipeline.options import TOLERANCE
from jcr.pipeline.stages import fingerprint
from jcr.pipeline.verify_history import (
    History,
    Verified,
    read_history,
    with_capture,
    without_part,
    write_history,
)
from jcr.progress import Progress, silent
from jcr.records import Capture
from jcr.result import RunResult

ALPHA = 1e-3
"""False-alarm rate of the test of a fixed camera, and of two calibrations."""


class Move(NamedTuple):
    """Change since the calibration that exceeds the tolerance."""

    causes: tuple[Cause, ...]
    """The most likely cause, then those that explain the captures nearly as well."""
    first: int
    """Index of the first capture after the change, in the history."""
    since: str
    step: Float[ndarray, "6"] | None
    """Step of the camera (gripper axes) or the scene (base axes): m, rad; None: the robot's poses changed."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Verification:
    """Result of a verification: the drift of the camera, and the verdict on the old calibration."""

    name: str = ""
    """Name of the capture that was verified last, or of a fixed camera."""
    offset: Float[ndarray, "6"]
    """Step from calibrated to present gripper_from_camera: translation (m), rotation vector (rad); gripper axes. For a
    fixed camera the step of base_from_camera in base axes."""
    covariance: Float[ndarray, "6 6"]
    """Covariance of `offset`."""
    p_value: float
    """Probability of an offset this large or larger if nothing has moved."""
    detectable: tuple[float, float]
    """Translation (m) and rotation (rad), in the worst direction, that the test detects with probability 0.9."""
    moved: bool
    """Whether a drift is significant and larger than the tolerance."""
    images: tuple[str, ...]
    """Names of the new images that were used."""
    notes: tuple[str, ...]
    """Warnings about the new images and the sensitivity of the test."""
    moves: tuple[Move, ...] = ()
    """Changes of camera, scene and robot since the calibration; empty if nothing has moved, and for a fixed camera."""
    history: tuple[Verified, ...] = ()
    """All captures that were verified against the run, oldest first."""
    fixed: str | None = None
    """Name of the camera if it is a fixed one, whose drift is along base axes; None: the camera on the gripper."""
    others: tuple["Verification", ...] = ()
    """Results for the fixed cameras of the run of which there are new images."""

    def __repr__(self) -> str:
        """Return the verdict, what has moved, and the smallest change that is detected."""
        mm, deg = 1e3 * self.detectable[0], np.degrees(self.detectable[1])
        least = f"detects {significant(mm)} mm, {significant(float(deg))}°"
        return f"<Verification {self.name}: {self.verdict}, {self.finding}; {least}>"

    @property
    def verdict(self) -> Verdict:
        """Verdict on the old calibration: rejected if something moved."""
        return "rejected" if self.moved else "accepted"

    def as_json(self) -> dict[str, Any]:
        """Return the content of `jcr verify --json`, with lengths in mm and angles in degrees."""
        names = ("verdict", "moved", "cause", "p_value", "images", "notes")
        facts: dict[str, Any] = {name: getattr(self, name) for name in names}
        facts["moves"] = [{"causes": one.causes, "since": one.since} for one in self.moves]
        facts |= _in_mm_deg("drift", self.offset, self.covariance)
        facts |= {
            "detectable_mm": 1e3 * self.detectable[0],
            "detectable_deg": float(np.degrees(self.detectable[1])),
        }
        if self.fixed is None:
            facts["cameras"] = {one.fixed: one.as_json() for one in self.others}
            facts["history"] = [_row_as_json(row) for row in self.history]
        return facts

    @property
    def cause(self) -> Cause | None:
        """Most likely cause of the last change; None if nothing has moved."""
        return self.moves[-1].causes[0] if self.moves else "camera" if self.moved else None

    @property
    def finding(self) -> str:
        """Phrase that states what has moved, by how much, and since which capture."""
        if self.fixed is not None:
            return f"{self.fixed} has {'moved' if self.moved else 'not moved'}"
        return "; ".join(map(_in_words, self.moves)) or "no drift is detected"

    @property
    def advice(self) -> str:
        """Remedy, in words, for the case that something has moved."""
        if self.fixed is not None:
            return f"{self.fixed} has moved; fasten it, and calibrate it again (jcr add-camera, under another name)"
        causes, anew = self.moves[-1].causes, "calibrate again from 8 or more images (jcr run)"
        if causes[1:]:
            return (
                "take two more images with a rotated wrist, which show what has moved; if it is the camera, tighten "
                f"the mount, then {anew}"
            )
        return {
            "camera": f"tighten the mount, then {anew}",
            "scene": "the scene or the robot's base has moved as a whole; the camera's calibration is still valid, but "
            "the map is not: build it again (jcr run)",
            "robot": "the robot reports other poses than before (new joint zeros, another tool frame or "
            f"payload), and the calibration is not valid for these; {anew}",
        }[str(causes[0])]


def _in_mm_deg(
    name: str, step: Float[ndarray, "6"], covariance: Float[ndarray, "6 6"]
) -> dict[str, Float[ndarray, "3"]]:
    """Return a step and its standard deviations in mm and degrees, for JSON: NAME_mm, NAME_deg, NAME_std_mm, ..."""
    std = np.sqrt(np.diag(covariance))
    parts = {"": step, "_std": std}
    return {f"{name}{kind}_{unit}": factor * part[axes] for kind, part in parts.items()
            for unit, factor, axes in (("mm", 1e3, slice(0, 3)), ("deg", np.degrees(1.0), slice(3, 6)))}  # fmt: skip


def _row_as_json(row: Verified) -> dict[str, Any]:
    """Return the content of --json for one capture of the history."""
    facts: dict[str, Any] = {"capture": row.name, "images": row.images, "notes": row.notes}
    for name, one in (("camera", row.camera), ("scene", row.scene)):
        facts |= _in_mm_deg(name, one.step, one.covariance) | {f"{name}_p": one.p_value}
    facts |= {
        "detectable_mm": 1e3 * row.detectable[0],
        "detectable_deg": float(np.degrees(row.detectable[1])),
    }
    return facts | {"odds": row.odds, "scene_left": row.scene_left}


def _in_words(move: Move) -> str:
    """Return a change in words."""
    nouns = {"camera": "the camera", "scene": "the scene", "robot": "the robot's reported poses"}
    said = " or ".join(nouns[one] for one in nouns if one in move.causes)
    did = "have changed" if "robot" in move.causes else "has moved"
    size = ""
    if move.step is not None:
        mm, deg = 1e3 * np.linalg.norm(move.step[:3]), np.degrees(np.linalg.norm(move.step[3:]))
        size = f" by {mm:.2f} mm and {deg:.3f}°"
    return f"{said} {did}{size} since capture {move.since}"


def verifiable(out: str | Path) -> RunResult:
    """Return the run in a folder; raise InputError if it cannot be verified: not of a wrist camera, or rejected."""
    run = RunResult(out)
    run.of_wrist_camera()
    if not run.found.converged:
        raise InputError(f"{out}: its rejected calibration cannot be tested; calibrate again (jcr run)")
    return run


def verify_run(
    out: str | Path,
    new: Capture | str | Path | Mapping[str, Capture | NewImages],
    tolerance: tuple[float, float] = TOLERANCE,
    progress: Progress = silent,
) -> Verification:
    """Test with new images whether the cameras of the run folder `out` have moved since its calibration.

    `new` is a capture, its path, or several captures by name, oldest first. Each is located in the calibrated scene, and
    tested with the captures that were verified before, which verify.json in the run folder keeps. Changes smaller than
    both parts of `tolerance` (mm, degrees) raise no alarm, however significant. Raises InputError if the run has no
    accepted calibration or the images are of another camera. Raises RejectedError if no image shares enough features
    with the scene.
    """
    if not isinstance(new, Capture | Mapping):
        new = read_capture(new, at_least=1)
    captures = {name_of(new): new} if isinstance(new, Capture) else new
    if not captures:
        raise InputError(f"{out}: no captures to verify it with; name one or more")
    run = verifiable(out)
    capture = run.capture
    with locked(run.out):
        digest = fingerprint(run.found.gripper_from_camera, capture.base_from_gripper, capture.images)
        scene, history, row = old_scene(run.out, digest), read_history(run.out, digest), 0
        for k, (name, one) in enumerate(captures.items()):
            progress("find the old scene", k / len(captures))
            images = one if isinstance(one, NewImages) else new_images(one)
            known = [k for k, past in enumerate(history.captures) if set(images.digests) <= set(past.digests)]
            if not known:
                require_new(capture, scene.pixels, images)
                history = with_capture(
                    without_part(history, images.digests), run, scene.located(name, images)
                )
                write_history(run.out, history)
            row = known[0] if known else len(history.captures) - 1
    progress("find the old scene", 1.0)
    found, last = _judged(run, history, row, tolerance), list(captures.values())[-1]
    fixed = [] if isinstance(last, NewImages) else _fixed_cameras(run, last, tolerance, progress)
    return replace(found, others=tuple(fixed))


def _judged(run: RunResult, history: History, index: int, tolerance: tuple[float, float]) -> Verification:
    """Return the verification by one row of a history; changes above the tolerance (mm, degrees) have moved."""
    row = history.captures[index]
    x, z = run.found.gripper_from_camera, run.found.base_from_recon.rigid
    moves, notes = list[Move](), list(row.notes)
    transforms: dict[Cause, Transform] = {"camera": x, "scene": z, "robot": x}
    for cause, transform in transforms.items():
        own = [one for one in history.changes if one.cause == cause]
        if not own:
            continue
        now = transform
        for one in own:
            now = retract(now, one.motion)
        step = step_between(transform, now)
        first = own[0].first
        shown = None if cause == "robot" else step
        move = Move((cause, *own[-1].rivals), first, history.captures[first].name, shown)
        # Errors of the joints turn the gripper, and move it by their typical lever.
        size = sum(one.size for one in own)
        if exceeds(step if cause != "robot" else np.array([REACH * size, 0, 0, size, 0, 0]), tolerance):
            moves.append(move)
        else:
            notes.append(f"{_in_words(move)}, which is significant and below the tolerance")
    return Verification(
        name=row.name,
        offset=row.camera.step,
        covariance=row.camera.covariance,
        p_value=row.camera.p_value,
        detectable=row.detectable,
        moved=bool(moves),
        images=row.images,
        notes=(*notes, *_blindness(row.detectable)),
        moves=tuple(sorted(moves, key=lambda one: one.first)),
        history=history.captures,
    )


def exceeds(step: Float[ndarray, "6"], tolerance: tuple[float, float]) -> bool:
    """Test whether translation or rotation of a step (m, rad) is larger than in `tolerance` (mm, degrees)."""
    sizes = 1e3 * np.linalg.norm(step[:3]), np.degrees(np.linalg.norm(step[3:]))
    return bool(sizes[0] > tolerance[0] or sizes[1] > tolerance[1])


def _blindness(noticed: tuple[float, float]) -> list[str]:
    """Return a warning if drifts that matter for grasping would not be noticed; `noticed` is what would be (m, rad)."""
    mm, deg = 1e3 * noticed[0], float(np.degrees(noticed[1]))
    if mm <= GRASPING[0] and deg <= GRASPING[1]:
        return []
    return [
        f"drifts of less than {mm:.0f} mm or {deg:.1f}° would not be noticed; take more images, with a rotated wrist "
        "and at other distances"
    ]


def _fixed_cameras(
    run: RunResult, new: Capture, tolerance: tuple[float, float], progress: Progress
) -> Iterator[Verification]:
    """Yield the drift of each fixed camera of the run that has images in `new`.

    The old and the new pose of the camera are estimated together, so that errors of the wrist camera's calibration
    cancel in their difference. Raises RejectedError if the images share too few features with the scene.
    """
    from jcr.cell.place_cameras import (
        place_cameras,  # imports pycolmap, which the command-line help does not need
    )

    _, capture, reconstruction = run.of_wrist_camera()
    calibrate_options = run.state.options.calibrate
    others = {one.name: one for one in run.others}
    placed = {
        one.name: one.intrinsics
        for one in ([] if run.cameras is None else run.cameras.cameras)
        if one.converged and one.mount == "base" and one.intrinsics is not None and one.name in others
    }
    known_cameras = [camera for camera in new.others if camera.name in placed]
    if not known_cameras:
        return
    hand_eye = calibrate_reconstruction(capture, reconstruction, calibrate_options)
    for camera in known_cameras:
        own = others[camera.name]
        folder = own.folder or capture.folder
        require_new(own, [read_image(folder / name) for name in own.images], new_images(new, camera))
        # Both poses are of the same camera, so that an error of its intrinsics cancels in their difference.
        intrinsics = placed[camera.name]
        known = {"intrinsics": intrinsics, "intrinsics_std": np.zeros(4 + len(intrinsics.distortion))}
        now = replace(camera, name=f"{camera.name[:60]}_now", folder=camera.folder or new.folder, **known)
        both = replace(own, **known), now
        parts = capture, both, reconstruction, hand_eye, calibrate_options, progress
        cell, solution, poses = place_cameras(*parts)
        for one in cell.cameras:
            if one.parent_from_camera is None:
                raise RejectedError(f"cannot tell: {one.doubt}")
        assert solution is not None
        before, after = (poses[one.name] for one in both)
        j = solution.derivative(after) - solution.derivative(before)
        offset = step_between(before(solution.state), after(solution.state))
        notes = [text for one in cell.cameras for text in one.warnings]
        found = of_two_poses(offset, j @ solution.covariance @ j.T, tolerance, now.images, notes)
        yield replace(found, name=own.name, fixed=own.name)


def of_two_poses(
    offset: Float[ndarray, "6"],
    covariance: Float[ndarray, "6 6"],
    tolerance: tuple[float, float],
    images: Sequence[str],
    notes: Sequence[str],
) -> Verification:
    """Return the verification by the step of a camera from its old to its new pose; its χ² is tested at ALPHA.

    `offset` is that step (translation in m, then rotation vector in rad; axes of the gripper, or of the base for a
    fixed camera), `covariance` its covariance. The camera moved if the step is significant and exceeds `tolerance` (mm,
    degrees).
    """
    p_value = float(chi2.sf(offset @ np.linalg.solve(covariance, offset), 6))
    noticed = detectable(covariance, chi2.isf(ALPHA, 6))
    return Verification(
        offset=offset,
        covariance=covariance,
        p_value=p_value,
        detectable=noticed,
        moved=p_value < ALPHA and exceeds(offset, tolerance),
        images=tuple(images),
        notes=(*notes, *_blindness(noticed)),
    )
