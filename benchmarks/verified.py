"""Real captures cut in halves, one verified against the calibration from the other, and a check at a start.

Nothing moved between the halves. Then the poses of the second half are shifted along an axis of the base, or of the
gripper, which is a move of the scene, or of the camera, by the same length. The check at a start is simulated.
"""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

import numpy as np

from benchmarks.page import folders_with_captures, mm_deg, number, of_rows, table
from jcr.capture.formats import capture_json
from jcr.capture.images import read_image
from jcr.capture.read import read_capture
from jcr.errors import RejectedError
from jcr.files import write_bytes
from jcr.geometry import transform
from jcr.pipeline.run import calibrate
from jcr.pipeline.verify import Verification, verify_run
from jcr.pipeline.verify_history import FILE, telling_poses
from jcr.records import Capture
from jcr.result import RunResult
from simulation.capture import SimulateOptions, simulate

LEAST, SHIFT_M = 12, 5e-3
"""Fewest images of a capture that is cut in halves, and the shift of the poses."""
CALIBRATION, FEW, MANY, REPEATS = 12, (3, 4, 5), 15, 5
"""Images of the simulated calibration, of a check at a start, and of a whole verification; repeated measurements."""
Shift = Literal["none", "scene", "camera"]


class Half(NamedTuple):
    """Verification of one half of a capture against the other."""

    capture: str
    shift: Shift
    images: tuple[int, int]
    """Images of the calibration and of the verification."""
    found: Verification
    seconds: float

    @property
    def off_mm(self) -> float:
        """Distance of the found translation from the shift; infinite if another cause is likelier, or none found."""
        true = np.array([SHIFT_M if self.shift == "scene" else -SHIFT_M, 0, 0])
        step = self.found.moves[-1].step if self.found.cause == self.shift else None
        return np.inf if step is None else 1e3 * float(np.linalg.norm(step[:3] - true))


def run(captures: Path, every: int = 1) -> str:
    """Return the page in Markdown, of one capture in `every` below `captures`: claims, then the tables."""
    halves, absent = list[Half](), list[str]()
    for folder in folders_with_captures(captures, every):
        try:
            halves += _halves(read_capture(folder))
        except RejectedError as refusal:
            absent.append(f"- {folder.name}: {str(refusal).splitlines()[0]}")
    with TemporaryDirectory(prefix="jcr-verified-") as folder:
        start, seconds = _start(Path(folder))
    lines = [
        *_claims(halves, seconds),
        "",
        "## Halves of real captures",
        "",
        f"Captures of {LEAST} images or more. Calibrated from their even images, verified with the odd ones. "
        "Named: causes that explain the images; with more than one, the images cannot decide.",
        "",
        *table(
            f"capture | images | poses shifted, {1e3 * SHIFT_M:.0f} mm | named | step: mm | ° | off, mm | "
            "one capture finds: mm | ° | s",
            map(_cells, halves),
        ),
        *(["", *absent] if absent else []),
        "",
        "## A check at a start",
        "",
        f"Smallest move of the camera that is found nine times in ten, after a calibration from {CALIBRATION} images "
        "of 640x480. At poses of the calibration: `jcr verify --check-poses`. At other poses: the next images of "
        "the same capture.",
        "",
        *table("images | poses | mm | ° | s, first | s, median of 5 | no drift", start),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _claims(halves: list[Half], seconds: float) -> Iterator[str]:
    """Yield the results of the page in sentences."""
    still = [one for one in halves if one.shift == "none"]
    if still:
        yield (
            f"> A drift is named in {sum(one.found.moved for one in still)} of {len(still)} real captures that are cut "
            "in halves and verified by themselves."
        )
    for shift in ("scene", "camera"):
        own = [one for one in halves if one.shift == shift]
        found = [one for one in own if one.found.moved]
        if found:
            named = sum(shift in one.found.moves[-1].causes for one in found)
            off = [one.off_mm for one in found if np.isfinite(one.off_mm)]
            stated = sum(one.found.detectable[0] > SHIFT_M for one in own if not one.found.moved)
            yield (
                f"> With poses shifted as if the {shift} moved by {1e3 * SHIFT_M:.0f} mm, a move is found in "
                f"{len(found)} of {len(own)}, and the {shift} is among the named in {named}; its step is "
                f"{np.median(off):.1f} mm off (median of {len(off)}, worst {max(off):.1f} mm). Of the other "
                f"{len(own) - len(found)} captures {stated} state that they find larger moves alone."
            )
    yield f"> A check of 5 images of 640x480 at a start takes {seconds:.1f} s."


def _cells(one: Half) -> list[object]:
    """Return the row of a half."""
    named = " or ".join(one.found.moves[-1].causes) if one.found.moves else "none"
    move = one.found.moves[-1].step if one.found.moves else None
    step = ("", "") if move is None else map(number, mm_deg(move))
    off = number(one.off_mm) if np.isfinite(one.off_mm) else ""
    mm, rad = one.found.detectable
    noticed = number(1e3 * mm), number(np.degrees(rad))
    return [
        one.capture,
        "{} and {}".format(*one.images),
        one.shift,
        named,
        *step,
        off,
        *noticed,
        number(one.seconds, 1),
    ]


def _halves(capture: Capture) -> Iterator[Half]:
    """Calibrate the even images of a capture, and verify the odd ones as they are and with shifted poses."""
    if len(capture) < LEAST:
        return
    old, new = (of_rows(capture, range(first, len(capture), 2)) for first in (0, 1))
    by = transform(np.eye(3), np.array([SHIFT_M, 0, 0]))
    poses: dict[Shift, np.ndarray] = {
        "none": new.base_from_gripper,
        "scene": by @ new.base_from_gripper,
        "camera": new.base_from_gripper @ by,
    }
    with TemporaryDirectory() as folder:
        old = _written(old, Path(folder, "old"))
        if not (result := calibrate(old, Path(folder, "out"))).converged:
            raise RejectedError("the calibration from the even images is rejected", "take more images")
        for shift, shifted in poses.items():
            (result.out / FILE).unlink(missing_ok=True)
            begun = time.perf_counter()
            found = verify_run(result.out, {"second": replace(new, base_from_gripper=shifted)})
            seconds = time.perf_counter() - begun
            yield Half(capture.folder.name, shift, (len(old), len(new)), found, seconds)


def _written(capture: Capture, folder: Path) -> Capture:
    """Write a part of a capture as a folder of its own, and return that capture."""
    for name in capture.images:
        write_bytes(folder / name, (capture.folder / name).read_bytes())
    capture_json.write(folder, replace(capture, folder=folder, others=()))
    return read_capture(folder)


def _start(folder: Path) -> tuple[list[list[object]], float]:
    """Return the rows of checks at a start beside a whole verification, and the median time (s) of five images."""
    count = CALIBRATION + MANY
    options = SimulateOptions(images=count, noise=2.0, robot_noise=(0.2, 0.03), truth="scene")
    capture = read_capture(simulate(folder / "capture", options))
    old = _written(of_rows(capture, range(CALIBRATION)), folder / "old")
    result = calibrate(old, folder / "out")
    told, rows, seconds = telling_poses(result, FEW[-1]), list[list[object]](), 0.0
    for n in FEW:
        mm, rad = told[n - 1][1]
        rows.append([n, "of the calibration", number(1e3 * mm), number(np.degrees(rad), 3), "", "", ""])
    images = [read_image(capture.folder / name) for name in capture.images[CALIBRATION:]]
    for n in (*FEW, MANY):
        poses = capture.base_from_gripper[CALIBRATION:][:n]
        found, times = _repeated(result, images[:n], poses)
        mm, rad = found.detectable
        middle = float(np.median(times[1:]))
        seconds = middle if n == FEW[-1] else seconds
        cells = number(1e3 * mm), number(np.degrees(rad), 3), number(times[0]), number(middle)
        rows.append([n, "others", *cells, "yes" if not found.moved else found.finding])
    return rows, seconds


def _repeated(
    result: RunResult, images: list[np.ndarray], poses: np.ndarray
) -> tuple[Verification, list[float]]:
    """Return the verification by some images, and the times (s) of the first and of REPEATS more."""
    times = list[float]()
    while True:
        (result.out / FILE).unlink(missing_ok=True)
        begun = time.perf_counter()
        found = RunResult(result.out).verify(images, poses)
        times.append(time.perf_counter() - begun)
        if len(times) > REPEATS:
            return found, times
