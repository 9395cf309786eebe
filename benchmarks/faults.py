"""Captures with one fault each, and captures without a fault.

Two tables. Observations: gripper poses and image points of simulated faults through structure from motion and the
calibration stage. Images: rendered images with one fault through all of `jcr calibrate`, so that features, mapper and
the selection of a back end take part.
"""

import tempfile
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.special import chdtrc

import jcr
from benchmarks.page import farthest, mm_deg, squared_distance, table
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.errors import InputError, RejectedError
from jcr.findings import FindingKind, kinds_of
from simulation import image_faults as make
from simulation import scene_faults as scenes
from simulation.faults import Faults, FaultyCapture, faulty_capture, reconstructed
from simulation.image_faults import IMAGES as FEW_IMAGES
from simulation.image_faults import ImageFault, rendered

IMAGES, SCENES = 12, 5
"""Images of a capture of observations, and rendered scenes."""
DRAWS, CLEAN, CLEAN_IMAGES = 2, 70, 5
"""Captures per fault (observations), and captures without a fault of each kind."""
SIGMAS, JOINT_P = 3.0, 0.0027
"""Largest error on an axis in stated standard deviations, and least joint chance, of an error that is stated rightly."""
FOCUS = frozenset({FindingKind.FOCUS_BY_DISTANCE, FindingKind.FOCUS_BY_IMAGE})
ZOOM = frozenset({FindingKind.ZOOM, FindingKind.FOCUS_BY_IMAGE})
SHUTTER = frozenset({FindingKind.ROLLING_SHUTTER})
INTRINSICS = frozenset({FindingKind.INTRINSICS})
MOVED = frozenset({FindingKind.SLIP, FindingKind.DRIFT})
ORDER = frozenset({FindingKind.POSE_CONVENTION, FindingKind.DELAY, FindingKind.POSES_SWAPPED})
ONE_POSE = frozenset({FindingKind.POSES_SWAPPED, FindingKind.POSE_CONTRADICTS_IMAGE})
ROBOT = kinds_of("strain") | {FindingKind.JOINT_OFFSETS}
BOARD = frozenset(
    {FindingKind.BOARD_SIZE, FindingKind.BOARD_MOVED, FindingKind.BOARD_STRETCHED, FindingKind.BOARD_BENT}
)
SCENE = frozenset({FindingKind.BASE_MOVED, FindingKind.REPETITIVE})
SCALE_ALONE = "positions 1 % too long"
"""Fault that no image shows: scale comes from the robot."""


@dataclass(frozen=True)
class Case:
    """Row of a table: a fault, and the kinds of finding that name it."""

    what: str
    fault: Faults | ImageFault
    named_by: frozenset[FindingKind] = frozenset()
    """Kinds of which any names the fault; images left out name their own fault, too."""
    given: bool = True
    """Whether intrinsics are given."""


def _off(name: str, **sizes: float) -> tuple[str, Faults, frozenset[FindingKind]]:
    """Return a row of intrinsics that are given wrong by these differences."""
    return name, Faults(intrinsics=tuple(sizes.items())), INTRINSICS


def _case(name: str, named_by: frozenset[FindingKind] = frozenset(), **fault: Any) -> Case:
    """Return a row of images with a fault of the stored images or of single poses."""
    return Case(name, ImageFault(**fault), named_by)


SLIP = (3.6e-3, float(np.radians(1.1)))
OBSERVED = (
    Case(
        "focal length grows by 1 % from the nearest view to the farthest",
        Faults(focal_by_distance=0.01),
        FOCUS,
    ),
    Case("by 4 %", Faults(focal_by_distance=0.04), FOCUS),
    Case("by 2 %, intrinsics estimated", Faults(focal_by_distance=0.02), FOCUS, given=False),
    Case("focal length scatters by 2 %", Faults(focal_scatter=0.02), FOCUS),
    Case("zoom by 3 % in the second half", Faults(zoom=0.03), ZOOM),
    Case(*_off("principal point 12 px off in x", cx=12.0)),
    Case(*_off("k1 of -0.03 ignored", k1=-0.03)),
    Case(*_off("fx alone 3 % off", fx=-18.6)),
    Case("rolling shutter, 15 px in x", Faults(rolling_px=15.0), SHUTTER),
    Case("mount slips by 1 mm 0.3° midway", Faults(slip=(1e-3, float(np.radians(0.3)))), MOVED),
    Case("by 3.6 mm 1.1° midway", Faults(slip=SLIP), MOVED),
    Case("by 3.6 mm 1.1° after two thirds", Faults(slip=SLIP, slip_after=0.67), MOVED),
    Case("poses read 100 ms late, 3 s from view to view", Faults(delay_s=0.1, view_s=3.0), ORDER),
    Case("positions along z 4 % too long", Faults(lengths=(0.0, 0.0, 0.04)), ROBOT),
    Case("the stand leans by 4° per metre of reach", Faults(tilt_by_reach=float(np.radians(4))), ROBOT),
    Case("the tool sags by 1.1° where it is level", Faults(sag=0.02), ROBOT),
    Case(SCALE_ALONE, Faults(pose_scale=1.01)),
)
"""Faults of captures of observations."""
SEEN = (
    Case(
        "focal length grows by 2 % from the nearest view to the farthest",
        Faults(focal_by_distance=0.02),
        FOCUS,
    ),
    Case("by 8 %", Faults(focal_by_distance=0.08), FOCUS),
    Case("zoom by 3 % midway", Faults(zoom=0.03), ZOOM),
    Case(*_off("digital zoom of 1.11, intrinsics unchanged", fx=69.0, fy=69.0)),
    Case(*_off("k1 of -0.1 missing", k1=-0.1)),
    Case(*_off("principal point 40 px off", cx=32.0, cy=-24.0)),
    Case(*_off("focal length given 3 % too long", fx=-19.0, fy=-19.0)),
    Case("rolling shutter, 24 px", Faults(rolling_px=24.0), SHUTTER),
    Case("stabiliser moves the image by 3 px", Faults(centre_scatter_px=3.0), kinds_of("camera")),
    Case("thin prism, 0.04", Faults(prism=(0.04, 0.0, 0.02, 0.0)), kinds_of("camera")),
    Case("mount slips by 3.6 mm 1.1°", Faults(slip=SLIP), MOVED),
    Case(
        "base pushed by 20 mm 2° midway",
        Faults(base_moved=(0.02, float(np.radians(2.0)))),
        frozenset({FindingKind.BASE_MOVED}),
    ),
    Case("poses read 400 ms late", Faults(delay_s=0.4, view_s=6.0), ORDER),
    Case("tool sags by 1.1° where it is level", Faults(sag=0.02), ROBOT),
    Case(SCALE_ALONE, Faults(pose_scale=1.01), ROBOT),
)
"""Faults of camera and robot in captures of images."""
EXCHANGED = np.r_[0:3, 6, 4:6, 3, 7:FEW_IMAGES]
RENDERED = (
    *(replace(case, fault=ImageFault(faults=case.fault)) for case in SEEN if isinstance(case.fault, Faults)),
    _case("images of half the resolution", INTRINSICS, change=make.halved),
    _case("mirrored images", ORDER, change=make.mirrored),
    _case("images sorted by name as text", ORDER, change=make.sorted_as_text),
    *(
        replace(_case(f"poses {what}, no intrinsics", ORDER, change=change), given=False)
        for what, change in (("inverted", make.inverted), ("in reverse order", make.reversed_poses))
    ),
    _case("one pose 5 mm 1° off", ONE_POSE, change=make.one_off(5.0, 1.0, 4), wrong=(4,)),
    _case("two poses exchanged", ONE_POSE, change=make.reordered(EXCHANGED), wrong=(3, 6)),
    _case("a frame that is repeated", ONE_POSE, change=make.repeated(4, (5,)), wrong=(5,)),
    _case("objects pushed by 6 cm midway", scene=scenes.pushed),
    _case("a belt with most objects moves by 5 cm midway", SCENE, scene=scenes.belt),
    _case("a display scrolls", scene=scenes.display),
    _case("an arm's link moves over the table", scene=scenes.moving_link),
    _case("the table is a regular tiling", SCENE, scene=scenes.tiled),
    *(
        _case(f"board: {what}", frozenset() if what == "right" else BOARD, scene=change, board=scenes.BOARD)
        for what, change in scenes.WRONG_BOARDS.items()
    ),
    _case("exposure and white balance differ by 30 %", change=make.exposed(0.3)),
    _case("two images blurred by 9 px", change=make.blurred(9, (2, 6))),
)
"""Faults of captures of images through all of `jcr calibrate`."""


@dataclass(frozen=True)
class Outcome:
    """Result of one capture against the truth."""

    accepted: bool
    kinds: frozenset[FindingKind] = frozenset()
    """Kinds of the findings that warn or reject."""
    remarks: frozenset[FindingKind] = frozenset()
    """Kinds of the findings that only inform, because the result allows for them."""
    left_out: frozenset[int] = frozenset()
    """Rows of images that the result does not use."""
    mm: float = np.nan
    deg: float = np.nan
    sigmas: float = np.nan
    """Largest error on an axis of X in stated standard deviations."""
    joint_p: float = np.nan
    """Chance of that error or more, all six axes together."""
    refused: bool = False
    """Whether the input was refused, with what, where and the remedy."""

    @property
    def is_within(self) -> bool:
        """Whether the capture is accepted and as near the truth as stated."""
        return self.accepted and self.sigmas <= SIGMAS and self.joint_p >= JOINT_P

    @property
    def is_sound(self) -> bool:
        """Whether the capture is rejected, or within three standard deviations on every axis."""
        return not self.accepted or self.sigmas <= SIGMAS

    @property
    def is_silent(self) -> bool:
        """Whether the capture is accepted without a warning and farther off than stated."""
        return self.accepted and not self.is_within and not self.kinds

    def is_named(self, case: Case) -> bool:
        """Return whether the answer names the fault, or leaves the wrong images out."""
        wrong = case.fault.wrong if isinstance(case.fault, ImageFault) else ()
        return (
            self.refused
            or bool((self.kinds | self.remarks) & case.named_by)
            or (bool(wrong) and self.left_out >= set(wrong))
        )


def run(every: int = 1) -> str:
    """Return the page in Markdown: claims, the two tables of one fault in `every`, and false alarms."""
    observed = {case: [outcome(*calibrated(case.fault, k, given=case.given)) for k in range(DRAWS)]
                for case in OBSERVED[::every] if isinstance(case.fault, Faults)}  # fmt: skip
    images = {case: [through_images(1, case.fault, case.given)]
              for case in RENDERED[::every] if isinstance(case.fault, ImageFault)}  # fmt: skip
    clean = []
    # 8 to 20 images, robots of 0.1 to 0.45 mm, intrinsics given and estimated
    for seed in range(max(CLEAN // every, 1)):
        size = 2.0 ** (seed % 4 - 1)
        faults = Faults(robot_noise=(1e-4 * size + 5e-5, 3e-4 * size))
        clean.append(outcome(*calibrated(faults, 1000 + seed, (8, 12, 20)[seed % 3], seed % 2 == 0)))
    clean_images = [through_images(1000 + k, ImageFault(), k % 2 == 0) for k in range(CLEAN_IMAGES)]
    lines = [
        _claim("observations", observed, clean),
        _claim("images through `jcr calibrate`", images, clean_images),
        "",
        "*named*: a finding that warns or rejects names the fault, or the wrong images are left out. *within 3 σ*: "
        "accepted, on every axis and jointly (p > 0.27 %). *warned*: accepted with a warning and farther off. "
        "**silent**: accepted without a warning and farther off. A camera that moved is compared before and after, "
        "whichever is farther. Positions too long in one proportion change nothing that an image shows.",
    ]
    for title, rows in (
        (
            f"Observations: {IMAGES} images, 500 points with 0.4 px, robot pose noise 0.3 mm and 0.06°",
            observed,
        ),
        (f"Images: {FEW_IMAGES} of 640x480, rendered scenes and arms with typical systematic errors", images),
    ):
        head = "fault | captures | named | as | rejected | within 3 σ | warned | silent | off, median: mm | ° | σ"
        lines += ["", f"## {title}", "", *table(head, (_cells(case, row) for case, row in rows.items()))]
    return "\n".join(lines) + "\n"


def calibrated(
    faults: Faults,
    seed: int,
    images: int = IMAGES,
    given: bool = True,
    options: CalibrateOptions | None = None,
) -> tuple[FaultyCapture, Calibration]:
    """Draw a capture of observations with these faults and calibrate it."""
    found = faulty_capture(np.random.default_rng([seed, images]), images, faults)
    return found, calibrate_reconstruction(*reconstructed(found, not given), options)


def outcome(found: FaultyCapture, hand_eye: Calibration) -> Outcome:
    """Compare a calibration with the camera's place before and after a slip, whichever is farther."""
    return _judged(hand_eye, (found.gripper_from_camera, found.gripper_from_camera_after), frozenset())


def through_images(seed: int, fault: ImageFault, given: bool) -> Outcome:
    """Draw a capture of images with a fault and run `jcr calibrate` on it."""
    capture = make.draw(rendered(seed % SCENES), seed, fault, given=given)
    with tempfile.TemporaryDirectory() as folder:
        try:
            options = {"reconstruct": {"board": fault.board}} if fault.board else None
            folders = make.write(capture, Path(folder) / "capture"), Path(folder) / "out"
            result = jcr.calibrate(*folders, options)
        except InputError:
            return Outcome(False, refused=True)
        except RejectedError:
            return Outcome(False, frozenset({FindingKind.NO_RECONSTRUCTION}))
    used = result.reconstruction.image_index[result.found.inliers].tolist()
    left_out = frozenset(range(len(capture.images))) - set(used)
    return _judged(result.found, capture.gripper_from_camera, left_out)


def _judged(
    hand_eye: Calibration, truths: Iterable[Float[ndarray, "4 4"]], left_out: frozenset[int]
) -> Outcome:
    """Compare a calibration with the truth that is farthest from it."""
    covariance = hand_eye.covariance[:6, :6]
    step, sigmas = farthest(hand_eye.gripper_from_camera, covariance, truths)
    joint_p = float(chdtrc(6, squared_distance(step, covariance)))
    # Findings that a user reads as a warning; insufficient accuracy is no fault.
    kinds = frozenset(
        one.kind
        for one in hand_eye.findings
        if one.severity != "informs" and one.kind is not FindingKind.NOT_EXACT_ENOUGH
    )
    remarks = frozenset(one.kind for one in hand_eye.findings if one.severity == "informs")
    return Outcome(hand_eye.converged, kinds, remarks, left_out, *mm_deg(step), sigmas, joint_p)


Rows = dict[Case, list[Outcome]]


def _claim(what: str, rows: Rows, clean: Sequence[Outcome]) -> str:
    every = [one for case, row in rows.items() if case.what != SCALE_ALONE for one in row]
    silent = [case.what for case, row in rows.items() if any(one.is_silent for one in row)]
    alarms = [one for one in clean if one.kinds]
    return (
        f"> One fault each, {what}: of {len(every)} captures {sum(not one.accepted for one in every)} are rejected, "
        f"{sum(one.is_within for one in every)} accepted within 3 σ, "
        f"{sum(one.accepted and not one.is_within and bool(one.kinds) for one in every)} accepted with a warning and "
        f"farther off, {sum(one.is_silent for one in every)} silently wrong; "
        f"silent anywhere: {', '.join(silent) or 'none'}. Of {len(clean)} captures without a fault {len(alarms)} are "
        f"called faulty and {sum(not one.is_sound for one in clean)} are accepted beyond 3 σ."
    )


def _cells(case: Case, row: Sequence[Outcome]) -> list[object]:
    kinds = Counter(sorted(str(kind) for one in row for kind in one.kinds)).most_common(3)
    has_name = case.named_by or (isinstance(case.fault, ImageFault) and case.fault.wrong)
    silent = sum(one.is_silent for one in row)
    kept = [(one.mm, one.deg, one.sigmas) for one in row if np.isfinite(one.mm)]
    mm, deg, sigmas = np.median(kept, axis=0) if kept else (np.nan,) * 3
    return [
        case.what,
        len(row),
        sum(one.is_named(case) for one in row) if has_name else "–",
        ", ".join(f"{name} {count}" for name, count in kinds),
        sum(not one.accepted for one in row),
        sum(one.is_within for one in row),
        sum(one.accepted and not one.is_within and not one.is_silent for one in row),
        f"**{silent}**" if silent else 0,
        f"{mm:.1f}",
        f"{deg:.2f}",
        f"{sigmas:.1f}",
    ]
