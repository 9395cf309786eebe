"""Captures written in the layouts in which people store images and poses, read without options.

Each layout of `simulation/layouts.py` is written from real captures and simulated recordings. It is read, and, where
names and numbers leave several readings, decided by camera poses that were found without the robot.
"""

import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from PIL import Image

import jcr
from benchmarks.page import folders_with_captures, table
from jcr.capture.options import MIN_FRAMES, ReadOptions
from jcr.capture.pairing import natural
from jcr.capture.read import read_capture, read_source
from jcr.errors import InputError, RejectedError
from jcr.geometry import rotation_exp, step_between, transform
from jcr.pipeline.reading_decision import decide
from jcr.records import Capture
from jcr.sfm.colmap import reconstruct_alone
from simulation.layouts import LAYOUTS, Layout, write_layout
from simulation.recordings import (
    CAMERA_NOISE,
    MOTIONS,
    Recording,
    angles_of_joints,
    board_seen,
    simulated_recordings,
)

SAME = (1e-3, float(np.radians(0.1)))
"""Largest distance (m, rad) of a pose that is read from the pose that was written; text rounds to less."""
MOUNTED = transform(rotation_exp(np.array([0.1, -0.05, 0.4])), np.array([0.05, -0.02, 0.04]))
"""gripper_from_camera by which the board's pose beside a real robot's pose is made."""
_OPTION = r"--[a-z]+(?:-[a-z]+)*(?: (?!--)[^\s,;()`\"']+)?"
OPTIONS = re.compile(rf"{_OPTION}(?: {_OPTION})*")
"""Options in a message; those that stand together are one match."""
Kind = Literal["right", "in part", "refused", "rejected", "left out", "accepted"]
"""What reading gives: all poses right, those of some images, none; or wrong poses, by what a calibration does with them:
it is rejected, it leaves the wrong poses out, or it is accepted with wrong poses."""
LONGEST = 220
"""Number of characters of a message in a table."""
SMALL_PX = 160
"""Long side (px) of the copies of real images that are read; camera poses come from the originals."""
IN_ONE_OF = 3
"""Each capture is written in one in this many layouts, and the next two in others; all would take twenty minutes. One
whose motion does not observe the reading is written in half as many: its many options are all tried."""
WRONG: tuple[Kind, ...] = ("rejected", "left out", "accepted")


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of a layout of one recording."""

    layout: Layout
    recording: Recording
    fault: str
    """Fault of the numbers; empty: none."""
    kind: Kind
    """Outcome without option."""
    message: str
    by_images: bool
    """Whether names and numbers left several readings, so that the images were needed."""
    by_option: tuple[Kind, ...] = ()
    """Outcome with each of the options that the message of a refusal names."""

    @property
    def column(self) -> str:
        """Column of the page that counts the outcome."""
        if self.kind in WRONG:
            return "wrong"
        return "with option" if self.kind == "refused" and "right" in self.by_option else self.kind

    @property
    def is_wrongly_accepted(self) -> bool:
        """Whether wrong poses are accepted, without option or with one that the message names."""
        return "accepted" in (self.kind, *self.by_option)


def run(captures: Path, every: int = 1) -> str:
    """Return the page in Markdown: all layouts of one in `every` of the captures and of the simulated recordings."""
    with tempfile.TemporaryDirectory(prefix="jcr-inputs-") as folder:
        place = Path(folder)
        recordings = [_real(one, place) for one in folders_with_captures(captures, every)]
        recordings += simulated_recordings(place / "simulated", range(0, len(MOTIONS), every))
        observed = {one.name for one in recordings if _is_observed(one)}
        read = [
            _outcome(place / "layout", layout, one, "", one.base_from_gripper)
            for (k, layout), (turn, one) in product(enumerate(LAYOUTS), enumerate(recordings))
            if (k + turn // 2) % (IN_ONE_OF if one.name in observed else 2 * IN_ONE_OF) == 0
        ]
        faulty = [*_faults(place / "layout", [one for one in recordings if one.name in observed])]
    return "\n".join(_page(recordings, observed, read, faulty)) + "\n"


def _real(folder: Path, place: Path) -> Recording:
    """Return a real capture as a recording, with camera poses that are reconstructed without its gripper poses.

    Small copies of its images are written below the folder `place`: a reader decodes every image.
    """
    capture = read_capture(folder)
    capture = capture.of_rows(sorted(range(len(capture)), key=lambda k: natural(capture.images[k])))
    try:
        made = reconstruct_alone(capture)
        camera, image = made.recon_from_camera, made.image_index
    except RejectedError:
        camera, image = np.zeros((0, 4, 4)), np.zeros(0, int)
    files = tuple(place / folder.name / Path(name).name for name in capture.images)
    files[0].parent.mkdir()
    for name, file in zip(capture.images, files, strict=True):
        small = Image.open(folder / name)
        small.thumbnail((SMALL_PX, SMALL_PX))
        small.save(file)
    return Recording(
        name=folder.name,
        files=files,
        base_from_gripper=capture.base_from_gripper,
        camera_from_board=board_seen(capture.base_from_gripper, MOUNTED),
        joints=angles_of_joints(len(capture), np.random.default_rng(len(capture))),
        recon_from_camera=camera,
        image_index=image,
        motion="real",
    )


def _is_observed(recording: Recording) -> bool:
    """Return whether the true poses and the camera poses of a recording give an accepted calibration."""
    rows, camera = recording.image_index, recording.recon_from_camera
    if len(rows) < MIN_FRAMES:
        return False
    return jcr.solve_hand_eye(recording.base_from_gripper[rows], camera).converged


def _outcome(
    folder: Path,
    layout: Layout,
    recording: Recording,
    fault: str,
    poses: Float[ndarray, "n 4 4"],
    rows: Sequence[int] | None = None,
) -> Outcome:
    """Write poses of a recording in a layout, and read it as a user would: without option, then with those named."""
    shutil.rmtree(folder, ignore_errors=True)
    write_layout(folder, layout, recording, poses, rows)
    by_images = False
    by_option: tuple[Kind, ...] = ()
    try:
        capture = read_source(folder)
        assert isinstance(capture, Capture)
        by_images = bool(capture.candidates)
        kind, message = _judged(_decided(capture, recording), recording)
    except InputError as error:
        kind, message = "refused", str(error).replace(f"{folder}", "FOLDER")
        by_option = tuple(_with_options(folder, recording, options) for options in named_options(message))
    return Outcome(
        layout=layout,
        recording=recording,
        fault=fault,
        kind=kind,
        message=message,
        by_images=by_images,
        by_option=by_option,
    )


def _decided(capture: Capture, recording: Recording) -> Capture:
    """Return a capture whose reading is decided by the camera poses, if it was not decided before.

    Raises InputError if it cannot be decided.
    """
    if not capture.candidates:
        return capture
    if not len(recording.image_index):
        raise InputError("the images cannot be reconstructed")
    return decide(capture, *_cameras_of(capture, recording))


def _cameras_of(capture: Capture, recording: Recording) -> tuple[Float[ndarray, "m 4 4"], Int[ndarray, " m"]]:
    """Return the recording's camera poses of images that the capture has, and the indices of these images in it."""
    row_of = {image: row for row, image in enumerate(_images_of(capture, recording))}
    kept = [k for k, image in enumerate(recording.image_index.tolist()) if image in row_of]
    rows = [row_of[int(recording.image_index[k])] for k in kept]
    return recording.recon_from_camera[kept], np.array(rows, int)


def _images_of(capture: Capture, recording: Recording) -> list[int]:
    """Return the index in the recording of each image of the capture; both are hard links to one file."""
    index = {file.stat().st_ino: k for k, file in enumerate(recording.files)}
    return [index[(capture.folder / name).stat().st_ino] for name in capture.images]


def _judged(capture: Capture, recording: Recording) -> tuple[Kind, str]:
    """Return what the poses of a capture are, compared with the true ones of its images, and this in words."""
    images = _images_of(capture, recording)
    step = step_between(recording.base_from_gripper[images], capture.base_from_gripper)
    is_wrong = (np.linalg.norm(step.reshape(-1, 2, 3), axis=2) > SAME).any(1)
    if not is_wrong.any():
        absent = len(recording) - len(images)
        return ("in part", f"{absent} of {len(recording)} images are left out") if absent else ("right", "")
    words = f"{is_wrong.sum()} of {len(images)} poses are wrong"
    if capture.reading is not None:
        one = capture.reading
        words += f": {one.notation}, {one.units}{', inverted' if one.inverted else ''}, by {one.decided_by}"
    camera, rows = _cameras_of(capture, recording)
    if len(rows) < MIN_FRAMES:
        return "rejected", f"{words}; no reconstruction"
    fit = jcr.solve_hand_eye(capture.base_from_gripper[rows], camera)
    if not fit.converged:
        return "rejected", f"{words}; {fit.doubt}"
    used = is_wrong[rows][[image.used for image in fit.images]]
    return ("accepted", f"{words}; {used.sum()} of {len(used)} used") if used.any() else ("left out", words)


def named_options(message: str) -> list[dict[str, Any]]:
    """Return the options of reading that a message names, each combination as a dict of ReadOptions' fields."""
    known, found = {field.name: field.default for field in fields(ReadOptions)}, list[dict[str, Any]]()
    for text in OPTIONS.findall(message):
        options = dict[str, Any]()
        for option, given in re.findall(r"--([a-z-]+)(?: (?!--)(\S+))?", text):
            name, value = option.replace("-", "_"), given.rstrip(".:")
            if name in known and (value or known[name] is False):
                options[name] = True if known[name] is False else value
        if options and options not in found:
            found.append(options)
    return found


def _with_options(folder: Path, recording: Recording, options: Mapping[str, Any]) -> Kind:
    """Return what reading with options gives; a path among them is one in the folder or relative to it."""
    paths = {
        name: next(
            (one for one in (Path(value), folder / value, *folder.rglob(value)) if one.exists()), value
        )
        for name, value in options.items()
        if name in ("poses", "camera_info")
    }
    try:
        capture = read_source(folder, {**options, **paths})
        assert isinstance(capture, Capture)
        return _judged(_decided(capture, recording), recording)[0]
    except InputError:
        return "refused"


def _exchanged(recording: Recording) -> Int[ndarray, " n"]:
    """Return the order of poses in which those of the two most distant grippers with camera poses are exchanged."""
    image, order = recording.image_index, np.arange(len(recording))
    at = recording.base_from_gripper[image, :3, 3]
    far = np.linalg.norm(at[:, None] - at, axis=2)
    pair = image[[*np.unravel_index(int(far.argmax()), far.shape)]]
    order[pair] = order[pair[::-1]]
    return order


ORDERS: dict[str, Callable[[Recording], Int[ndarray, " n"]]] = {
    "two rows exchanged": _exchanged,
    "all rows shuffled": lambda one: np.random.default_rng(len(one)).permutation(len(one)),
    "off by one": lambda one: np.roll(np.arange(len(one)), 1),
}
"""Faults that give images the poses of other images: the index of the pose of each image."""
MISSING, ANOTHER = "one row missing", "poses of another capture"


def _faults(folder: Path, recordings: Sequence[Recording]) -> Iterator[Outcome]:
    """Yield the outcome of each layout with each fault, with recordings in turn."""
    for turn, (layout, fault) in enumerate(product(LAYOUTS, (*ORDERS, MISSING, ANOTHER))):
        one = recordings[turn % len(recordings)]
        poses, rows = one.base_from_gripper, None
        if fault in ORDERS:
            poses = poses[ORDERS[fault](one)]
        elif fault == MISSING:
            rows = [k for k in range(len(one)) if k != len(one) // 3]
        else:
            others = sorted((other for other in recordings if other is not one), key=len)
            other = next((other for other in others if len(other) >= len(one)), others[-1])
            poses = other.base_from_gripper[np.arange(len(one)) % len(other)]
        yield _outcome(folder, layout, one, fault, poses, rows)


def _page(
    recordings: Sequence[Recording], observed: Set[str], read: Sequence[Outcome], faulty: Sequence[Outcome]
) -> Iterator[str]:
    """Yield the lines of the page."""
    seen, others = (
        [one for one in read if (one.recording.name in observed) is known] for known in (True, False)
    )
    real, total = sum(one.motion == "real" for one in recordings), Counter(one.column for one in read)
    share = 100 * sum(one.column == "right" for one in seen) / max(len(seen), 1)
    by_fault = Counter(one.kind for one in faulty)
    yield (
        f"> {real} real captures and {len(recordings) - real} simulated recordings in {len(LAYOUTS)} layouts. "
        f"Where the motion observes the reading, {share:.1f} % of {len(seen)} are read right without option. Of all "
        f"{len(read)}, {total['wrong']} are read wrong; {sum(one.kind == 'accepted' for one in read)} are accepted with "
        f"wrong poses, {sum('accepted' in one.by_option for one in read)} with an option that a message names."
    )
    yield (
        f"> Wrong on purpose: of {len(faulty)} {by_fault['refused']} are refused, {by_fault['rejected']} rejected, "
        f"{by_fault['accepted']} accepted with wrong poses, {sum('accepted' in one.by_option for one in faulty)} with "
        "an option that a message names."
    )
    yield from ("", *_legend(), "")
    for title, part in (("observed", seen), ("not observed", others)):
        yield from (f"## Motion: reading {title}", "", *_totals(part), "")
    yield from ("## Layouts", "", *_by_layout(seen, others), "")
    yield from ("## Refused although the motion observes the reading", "", *_refused(seen), "")
    yield from ("## Captures", "", *_by_recording(recordings, observed, read), "")
    yield from ("## Wrong on purpose", "", *_by_fault(faulty), "")
    yield from _wrongly_read([*read, *faulty])


def _legend() -> list[str]:
    """Return the meaning of the columns."""
    return [
        f"*right*: every image has its pose within {1e3 * SAME[0]:.0f} mm and {np.degrees(SAME[1]):.1f}°, without "
        "option. *with option*: refused, and an option that the message names gives this. *in part*: right poses, "
        "images left out. *refused*: no option in the message helps. *wrong*: poses of other values; in parentheses "
        "those that are accepted by a calibration. *by images*: captures whose names and numbers leave several "
        "readings. *names fix*: names and numbers state notation, units and direction.",
        "",
        "The motion observes the reading where the true poses and the camera poses give an accepted calibration. "
        "Camera poses of real captures are reconstructed without the robot, with the stored intrinsics; those of "
        f"simulated recordings have noise of {1e3 * CAMERA_NOISE[0]:.1f} mm and {np.degrees(CAMERA_NOISE[1]):.2f}° on "
        f"an axis. Each capture is written in one in {IN_ONE_OF} of the layouts, in turn; one whose motion does not "
        f"observe the reading, in one in {2 * IN_ONE_OF}.",
    ]


COLUMNS = ("right", "with option", "in part", "refused", "wrong")


def _cells(part: Sequence[Outcome]) -> list[str]:
    """Return the cells of a row of outcomes, those of COLUMNS."""
    count, accepted = Counter(one.column for one in part), sum(one.kind == "accepted" for one in part)
    return [
        *(str(count[name]) for name in COLUMNS[:-1]),
        f"{count['wrong']} ({accepted})" if count["wrong"] else "0",
    ]


def _totals(part: Sequence[Outcome]) -> list[str]:
    """Return the table of totals of a part: by what decides the reading, and by the origin of the captures."""
    rows = {
        "read by names and numbers": [one for one in part if not one.by_images],
        "several readings: the images": [one for one in part if one.by_images],
        "names fix the reading": [one for one in part if one.layout.names_fix],
        "names do not fix it": [one for one in part if not one.layout.names_fix],
        "real captures": [one for one in part if one.recording.motion == "real"],
        "simulated": [one for one in part if one.recording.motion != "real"],
        "all": [*part],
    }
    cells = [(name, len(some), *_cells(some)) for name, some in rows.items()]
    return table(f"part | layouts | {' | '.join(COLUMNS)}", cells)


def _by_layout(seen: Sequence[Outcome], others: Sequence[Outcome]) -> list[str]:
    """Return the table of layouts."""
    rows = []
    for layout in LAYOUTS:
        parts = [[one for one in part if one.layout is layout] for part in (seen, others)]
        images = sum(one.by_images for part in parts for one in part)
        cells = [cell for part in parts for cell in _cells(part)]
        rows.append((layout.name, "yes" if layout.names_fix else "no", images, *cells))
    unobserved = " | ".join(f"unobserved: {name}" for name in COLUMNS)
    return table(f"layout | names fix | by images | {' | '.join(COLUMNS)} | {unobserved}", rows)


def _refused(seen: Sequence[Outcome]) -> list[str]:
    """Return the table of layouts that are refused, with the message of one capture."""
    rows = []
    for layout in LAYOUTS:
        some = [one for one in seen if one.layout is layout and one.column == "refused"]
        if some:
            rows.append((layout.name, len(some), some[0].recording.name, _cell(some[0].message)))
    return table("layout | captures | for example | message", rows)


def _cell(message: str) -> str:
    """Return the beginning of a message for a cell of a table."""
    text = message.replace("|", "/").replace("\n", " ")
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"


def _by_recording(recordings: Sequence[Recording], observed: Set[str], read: Sequence[Outcome]) -> list[str]:
    """Return the table of captures."""
    rows = []
    for one in recordings:
        cells = _cells([outcome for outcome in read if outcome.recording is one])
        cameras = f"{len(one.image_index)} of {len(one)}"
        rows.append((one.name, one.motion, cameras, "yes" if one.name in observed else "no", *cells))
    return table(f"capture | motion | camera poses | observed | {' | '.join(COLUMNS)}", rows)


def _by_fault(faulty: Sequence[Outcome]) -> list[str]:
    """Return the table of faults by outcome."""
    kinds: tuple[str, ...] = get_args(Kind)
    rows = []
    for fault in (*ORDERS, MISSING, ANOTHER):
        some = [one for one in faulty if one.fault == fault]
        count = Counter(one.kind for one in some)
        by_option = sum("accepted" in one.by_option for one in some)
        rows.append((fault, len(some), *(count[kind] for kind in kinds), by_option))
    names = {"in part": "right, an image left out", "left out": "accepted without the wrong rows"}
    head = " | ".join(names.get(kind, kind) for kind in kinds)
    return table(f"fault | layouts | {head} | accepted with an option of the message", rows)


def _wrongly_read(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the table of outcomes that must not be: wrong poses without a fault, and all that are accepted."""
    rows = [
        (one.layout.name, one.recording.name, one.fault, one.kind, _cell(one.message))
        for one in outcomes
        if one.is_wrongly_accepted or (one.kind in WRONG and not one.fault)
    ]
    return (
        ["## Wrong", "", *table("layout | capture | fault | without option | what", rows), ""] if rows else []
    )
