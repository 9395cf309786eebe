"""`benchmarks attack`: captures with one thing wrong that looks like nothing, and captures with nothing wrong.

Without images: gripper poses and image observations of simulated faults (simulate/faults.py), cameras by structure
from motion of these observations with the intrinsics that the user believes, then the calibration stage as it is.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.page import mm_deg, table
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.stage import calibrate
from jcr.estimation.equation import predict
from jcr.estimation.intrinsics_prior import ESTIMATED, FIXED, camera_with_prior
from jcr.estimation.wrist import adjust_wrist
from jcr.geometry import step_between
from jcr.records import Capture, HandEye, Kind, Reconstruction
from simulation.faults import INTRINSICS, Faults, FaultyCapture, faulty_capture

DRAWS, FEW, CLEAN = 7, 2, 70
"""Of what is random by itself, of what only the noise makes random, and of nothing wrong."""
IMAGES = 12
LOOSE = (3.0, 3.0)
"""m, rad: gripper poses by which structure from motion is hardly held."""
NAMES = {
    Kind.FOCUS_BY_DISTANCE: "focus follows distance",
    Kind.FOCUS_BY_IMAGE: "focus scatters",
    Kind.ZOOM: "zoom",
    Kind.ROLLING_SHUTTER: "rolling shutter",
    Kind.ROLLING_SHUTTER_BY_IMAGE: "rolling shutter",
    Kind.INTRINSICS: "intrinsics",
    Kind.LENGTHS: "lengths",
    Kind.BASE_LEANS: "base leans",
    Kind.TOOL_SAGS: "tool sags",
    Kind.SLIP: "slip",
    Kind.DRIFT: "drift",
    Kind.DELAY: "delay",
    Kind.POSES_CONTRADICT_IMAGES: "poses and images disagree",
    Kind.NOISE_ABOVE_GIVEN: "poses and images disagree",
    Kind.FEW_AGREE: "poses and images disagree",
    Kind.UNCERTAIN: "too uncertain",
}
"""What is found, by its kind."""


@dataclass(frozen=True)
class Case:
    """One thing wrong."""

    what: str
    faults: Faults
    estimated: bool = False
    """Intrinsics are not given."""
    draws: int = FEW


CASES = (
    Case("focal length grows by 1 % from the nearest view to the farthest", Faults(focal_by_distance=0.01)),
    Case("by 2 %", Faults(focal_by_distance=0.02)),
    Case("by 4 %", Faults(focal_by_distance=0.04)),
    Case("by 2 %, intrinsics estimated", Faults(focal_by_distance=0.02), True),
    Case("focal length scatters by 1 %", Faults(focal_scatter=0.01), draws=DRAWS),
    Case("by 2 %", Faults(focal_scatter=0.02), draws=DRAWS),
    Case("zoom by 3 % in the second half", Faults(zoom=0.03)),
    Case("principal point 12 px off in x", Faults(intrinsics=(("cx", 12.0),))),
    Case("6 px in x and in y", Faults(intrinsics=(("cx", 6.0), ("cy", 6.0)))),
    Case("k1 of -0.03 ignored", Faults(intrinsics=(("k1", -0.03),))),
    Case("pixels stretched by 5 % in x", Faults(intrinsics=(("fx", 31.0),))),
    Case("fx alone 3 % off", Faults(intrinsics=(("fx", -18.6),))),
    Case("rolling shutter, 15 px in x", Faults(rolling_px=15.0)),
    Case("mount slips by 1 mm 0.3° midway", Faults(slip=(1e-3, np.radians(0.3))), draws=DRAWS),
    Case("by 3.6 mm 1.1° midway", Faults(slip=(3.6e-3, np.radians(1.1))), draws=DRAWS),
    Case(
        "by 3.6 mm 1.1° after two thirds",
        Faults(slip=(3.6e-3, np.radians(1.1)), slip_after=0.67),
        draws=DRAWS,
    ),
    Case("poses read 100 ms late, 3 s from view to view", Faults(delay_s=0.1, view_s=3.0), draws=DRAWS),
    Case("6 s from view to view", Faults(delay_s=0.1, view_s=6.0), draws=DRAWS),
    Case("positions along z 2 % too long", Faults(lengths=(0.0, 0.0, 0.02))),
    Case("along z 4 %", Faults(lengths=(0.0, 0.0, 0.04))),
    Case("along x 2 %", Faults(lengths=(0.02, 0.0, 0.0))),
    Case("the stand leans by 4° per metre of reach", Faults(tilt_by_reach=float(np.radians(4)))),
    Case("the tool sags by 1.1° where it is level", Faults(sag=0.02)),
    Case("positions 1 % too long", Faults(pose_scale=1.01)),
    Case("positions 5 % too long", Faults(pose_scale=1.05)),
)


@dataclass(frozen=True)
class Outcome:
    """What became of one draw."""

    accepted: bool
    said: frozenset[str]
    mm: float
    deg: float
    sigmas: float
    """Largest error on an axis of X in reported standard deviations."""

    @property
    def is_sound(self) -> bool:
        """Refused, or within three standard deviations."""
        return not self.accepted or self.sigmas <= 3


def reconstructed(found: FaultyCapture, estimated: bool) -> tuple[Capture, Reconstruction]:
    """What structure from motion makes of the observations with the believed intrinsics, or its own."""
    cameras, m = found.base_from_camera, len(found.base_from_camera)
    start = np.eye(4), 1.0, np.eye(4)
    free = (
        camera_with_prior(found.intrinsics, ESTIMATED)
        if estimated
        else camera_with_prior(found.intrinsics, FIXED)
    )
    sfm = adjust_wrist(cameras, start, cameras, free, found.tracks, noise=LOOSE)
    state = sfm.state
    intrinsics, x = sfm.problem.intrinsics(state)[0], state.x[0]
    rigs = predict(x, state.scale, state.z[0], state.world_from_rig)
    capture = Capture(
        folder=Path("."),
        images=tuple(f"{k:02d}.png" for k in range(m)),
        base_from_gripper=found.base_from_gripper,
        image_size=(INTRINSICS.width, INTRINSICS.height),
        intrinsics=None if estimated else found.intrinsics,
    )
    return capture, Reconstruction(
        image_index=np.arange(m),
        recon_from_camera=rigs @ x,
        intrinsics=intrinsics,
        tracks=found.tracks,
        backend="simulated",
    )


def calibrated(
    faults: Faults,
    seed: int,
    images: int = IMAGES,
    estimated: bool = False,
    options: CalibrateOptions | None = None,
) -> tuple[FaultyCapture, HandEye]:
    """One draw and its calibration."""
    found = faulty_capture(np.random.default_rng([seed, images]), images, faults)
    return found, calibrate(*reconstructed(found, estimated), options)


def outcome(found: FaultyCapture, hand_eye: HandEye) -> Outcome:
    """Against the camera's place before or after a slip, by poses as reported or as they were: whichever is farther."""
    std = np.sqrt(np.diag(hand_eye.covariance)[:6])
    said = frozenset(NAMES[finding.kind] for finding in hand_eye.findings if finding.kind in NAMES)
    steps = [
        step_between(hand_eye.gripper_from_camera, x)
        for x in (found.gripper_from_camera, found.gripper_from_camera_after)
    ]
    step = max(steps, key=lambda one: float(np.abs(one / std).max()))
    return Outcome(hand_eye.converged, said, *mm_deg(step), float(np.abs(step / std).max()))


def run() -> str:
    """Markdown: the claim, the table of faults, and false alarms."""
    rows = {case: [_one(case, seed) for seed in range(case.draws)] for case in CASES}
    clean = [_clean(seed) for seed in range(CLEAN)]
    return page(rows, clean)


def _one(case: Case, seed: int) -> Outcome:
    return outcome(*calibrated(case.faults, seed, estimated=case.estimated))


def _clean(seed: int) -> Outcome:
    """Nothing wrong: 8 to 20 images, robots of 0.1 to 0.7 mm, intrinsics given and estimated in turn."""
    size = 2.0 ** (seed % 4 - 1)
    faults = Faults(robot_noise=(1e-4 * size + 5e-5, 3e-4 * size))
    return outcome(*calibrated(faults, 1000 + seed, (8, 12, 20)[seed % 3], estimated=seed % 2 == 1))


def page(rows: dict[Case, list[Outcome]], clean: list[Outcome]) -> str:
    """Markdown of what was measured."""
    known = [one for case, row in rows.items() if case.faults.pose_scale == 1.0 for one in row]
    alarms = [one for one in clean if one.said]
    falsely = ", ".join(sorted({name for one in alarms for name in one.said})) or "none"
    lines = [
        f"> Captures with one silent fault (focus, zoom, intrinsics, rolling shutter, slip, delay): "
        f"{100 * np.mean([bool(one.said) for one in known]):.0f} % are reported, and "
        f"{100 * np.mean([one.is_sound for one in known]):.0f} % of the results are rejected or within 3 reported "
        f"standard deviations; of {len(clean)} captures with nothing wrong {len(alarms)} are reported as faulty.",
        "",
        f"{IMAGES} images, 500 points seen with 0.4 px of noise, robot pose noise 0.3 mm and 0.06° per axis, poses in "
        "the order of the images. *reported*: a warning or a rejection that says what is in the column beside it, with "
        "how many of the draws say so. *sound*: rejected, or within 3 reported standard deviations on every axis; "
        "against the camera's place before and after a slip, whichever is farther.",
        "",
        *table(
            "what is wrong | draws | reported | as | accepted | off, median: mm | ° | σ, median | sound",
            (_cells(case, row) for case, row in rows.items()),
        ),
        "",
        f"Nothing wrong: {len(clean)} captures of 8, 12 and 20 images, robots of 0.1 to 0.45 mm, intrinsics given "
        f"and estimated in turn: {len(alarms)} reported as faulty ({falsely}), "
        f"{sum(one.accepted for one in clean)} accepted, {sum(not one.is_sound for one in clean)} of these beyond 3 σ.",
        "",
        "Positions that are a few per cent too long, by a wrong link or a wrong unit, change nothing that an image "
        "shows: scale comes from the robot. Only joint angles of a known arm, or a length that is known otherwise (a "
        "board, `--known-length`), show it.",
    ]
    return "\n".join(lines) + "\n"


def _cells(case: Case, row: list[Outcome]) -> list[str]:
    message = Counter(name for one in row for name in one.said).most_common(3)
    mm, deg, sigmas = np.median([(one.mm, one.deg, one.sigmas) for one in row], axis=0)
    return [
        case.what,
        str(len(row)),
        _share(bool(one.said) for one in row),
        ", ".join(f"{name} {count}" for name, count in message),
        _share(one.accepted for one in row),
        f"{mm:.1f}",
        f"{deg:.2f}",
        f"{sigmas:.1f}",
        _share(one.is_sound for one in row),
    ]


def _share(flags: Iterable[bool]) -> str:
    values = list(flags)
    return f"{sum(values)} of {len(values)}"
