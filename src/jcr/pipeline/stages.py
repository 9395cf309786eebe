"""Stages of a run: each computes records from those of the stages before it, and writes them into the run folder."""

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from jcr import __version__
from jcr.backends import candidates, device_of
from jcr.boards.proposal import proposed
from jcr.calibration.record import AnyCalibration, Calibration, FailedCalibration, write_calibration
from jcr.calibration.summary import log
from jcr.capture.added_capture import FOLDER as ADDED
from jcr.capture.added_capture import write_added
from jcr.cell.cameras_json import FILE as CAMERAS
from jcr.cell.cameras_json import CamerasFile, write_cameras
from jcr.cell.moving_parts import with_moving_parts
from jcr.depth.densify import densify
from jcr.depth.depth_npz import FORMAT as DEPTH_FORMAT
from jcr.depth.depth_npz import write_depth
from jcr.errors import InputError
from jcr.files import read_bytes, write_text
from jcr.findings import sentence
from jcr.memory import give_back
from jcr.pipeline.backend_selection import (
    NothingFoundError,
    select_published,
    select_reconstruction,
    timings_of,
)
from jcr.progress import Progress, silent
from jcr.records import Capture, ImageVerdict, Reconstruction
from jcr.records.reconstruction_npz import FORMAT, write_reconstruction
from jcr.result import (
    CALIBRATION,
    CLOUD,
    DEPTH,
    LOG,
    MAP,
    RECONSTRUCTION,
    REPORT,
    STATE,
    RunOptions,
    RunResult,
    RunState,
)
from jcr.scene.cloud import write_cloud

MOVING = "moving"
"""Subfolder with the images of a fixed camera without the static background, which show the carried object alone."""
LIVE = "result"
"""Subfolder of a live capture with the run of all its images."""
LARGE = 50_000_000
"""Size (bytes) above which size and date identify a file, such as network weights; the content identifies others."""


def begun(out: Path, capture: Capture, options: RunOptions) -> RunResult:
    """Return the RunResult of a run before its first stage, with capture, options and fingerprints of the inputs.

    The fingerprints are those of reconstruction and depth. Raises InputError if the capture's path is not UTF-8.
    """
    folder = str(capture.folder.resolve())
    try:
        folder.encode()
    except UnicodeEncodeError:
        raise InputError(f"{capture.folder}: a folder whose name is not UTF-8; rename it") from None
    own = options.reconstruct
    paths = {name: path.resolve() for name, path in vars(own).items() if isinstance(path, Path)}
    state = RunState(capture=folder, options=replace(options, reconstruct=replace(own, **paths)))
    with suppress(InputError):
        before = RunResult(out).state
        if before.capture == folder:
            state = state.model_copy(update={"version": before.version, "predecessor": before.predecessor})
    return with_fingerprints(RunResult(out, capture=capture, state=state), "select", "densify")


def with_fingerprints(result: RunResult, *stages: str) -> RunResult:
    """Return the result with a fingerprint of the inputs of the named stages; it covers those of the stages before."""
    made = dict(result.state.made)
    for name in stages:
        inputs = STAGES[name].inputs
        made[name] = fingerprint([*made.values()], inputs and inputs(result), __version__)
    return result.with_parts(state=result.state.model_copy(update={"made": made}))


def make(result: RunResult, stages: Sequence[str], progress: Progress) -> RunResult:
    """Run those of the named stages that the run's cameras and options need; return the result with their outputs.

    The times (s) of the stages after the calibration are added to `timings_s` of the calibration.
    """
    unneeded = set() if has_cameras(result) else {"cameras"}
    unneeded |= {"densify", "map"} if result.state.options.map is None else set()
    for name in (name for name in stages if name not in unneeded):
        start = time.perf_counter()
        result = STAGES[name].function(result, progress)
        give_back()
        if name not in FIRST:  # `timings_of` gives the times of these, summed over all back ends
            timings = result.calibration.timings_s | {name: round(time.perf_counter() - start, 3)}
            result = result.with_parts(calibration=replace(result.calibration, timings_s=timings))
    return result


def finished(result: RunResult, stages: Sequence[str], progress: Progress) -> RunResult:
    """Run the named stages, which follow the calibration; mark the run as finished in run.json; return its result."""
    if not has_cameras(result):
        (result.out / CAMERAS).unlink(missing_ok=True)
        result = result.with_parts(cameras=None)
    result = make(result, stages, progress)
    keep_calibration(result.out, result.calibration)
    return complete(result)


def has_cameras(result: RunResult) -> bool:
    """Test whether the run locates other cameras of the cell; the published method has none."""
    return bool(result.others) and result.state.options.method == "default"


def complete(result: RunResult) -> RunResult:
    """Write fingerprints of inputs and files to run.json, which marks the run as finished; return the result."""
    result = result.with_parts(state=finished_state(result))
    write_state(result)
    return result


def is_unchanged(result: RunResult) -> bool:
    """Test whether the folder holds the finished run of the same inputs and options, with all its files."""
    with suppress(InputError, OSError):
        before, now = RunResult(result.out).state, finished_state(result)
        return before.made == now.made and before.files == now.files != {}
    return False


def finished_state(result: RunResult) -> RunState:
    """Return the state of a run with the fingerprint of all its inputs and options, and those of the folder's files.

    Fingerprints of calibration.json and of images added later are hashes; that of another file is an empty text.
    """
    out = result.out
    names = [name for stage in STAGES.values() for name in stage.files if (out / name).exists()]
    hashed = [name for name in (CALIBRATION, ADDED) if (out / name).exists()]
    files = dict.fromkeys(names, "") | {name: fingerprint(out / name) for name in hashed}
    return with_fingerprints(result, "report").state.model_copy(update={"files": files})


def _reconstruction_inputs(result: RunResult) -> Any:
    """Return the inputs of the reconstruction: images, poses, intrinsics, mount and the options of its back ends."""
    capture, own = result.capture, result.state.options.reconstruct
    weights = Path(own.weights) if own.weights and Path(own.weights).exists() else None
    images = [(name, capture.folder / name) for name in capture.images]
    # The mount decides which pixels are reconstructed, and which poses guide it.
    of_capture = images, capture.mount, capture.base_from_gripper, capture.intrinsics
    return *of_capture, candidates(own), weights, FORMAT, result.state.options.method, own


def _run_inputs(result: RunResult) -> Any:
    """Return all inputs of a run: everything of the capture and of the other cameras, and all options."""
    capture, folder = result.capture, result.capture.folder
    depths = [folder / name for name in capture.depths or () if name is not None]
    others = [
        vars(one) | {"folder": [(one.folder or folder) / name for name in one.images]}
        for one in result.others
    ]
    facts = vars(capture) | {"folder": depths, "source": str(capture.source), "others": others}
    return facts, result.state.options


def fingerprint(*values: Any) -> str:
    """Return a SHA-256 hash of `values`: of the fields of records, and the content of arrays and files (Path).

    A folder is hashed as its files, and a file above LARGE as size and date.
    """

    def identity(value: Any) -> Any:
        if isinstance(value, ndarray):
            return hashlib.sha256(value.tobytes()).hexdigest()
        if not isinstance(value, Path):
            return vars(value)
        if value.is_dir():
            files = (file for file in sorted(value.rglob("*")) if file.is_file())
            return [(str(file.relative_to(value)), file) for file in files]
        if not value.exists():
            return str(value)
        if (stat := value.stat()).st_size > LARGE:
            return stat.st_size, stat.st_mtime_ns
        return hashlib.sha256(read_bytes(value)).hexdigest()

    return hashlib.sha256(json.dumps(values, default=identity).encode()).hexdigest()


def _kept_failure(result: RunResult, error: NothingFoundError) -> NothingFoundError:
    """Write calibration.json and the report of a run without a calibration; return the error to raise.

    The error proposes the option `--board` if the images show a board.
    """
    capture, tried = result.capture, error.attempts
    content = FailedCalibration(
        method=result.state.options.method,
        mount=capture.mount,
        backend=tried[-1].backend,
        images=tuple(
            ImageVerdict(image=name, used=False, reason="not registered") for name in capture.images
        ),
        intrinsics=capture.intrinsics and capture.intrinsics.with_std(None),
        findings=error.findings,
        attempts=tried,
        timings_s=timings_of(tried),
    ).with_notes()
    boards = proposed(capture, result.state.options.reconstruct.board)
    content = content.with_findings(*boards).with_notes() if boards else content
    keep_calibration(result.out, content)
    complete(_report(result.with_parts(calibration=content)))
    return NothingFoundError(error.with_more(*map(sentence, boards)), tried) if boards else error


def _select(result: RunResult, progress: Progress) -> RunResult:
    """Return the result with a selected reconstruction and its calibration, and write the reconstruction.

    A reconstruction of the same inputs in the run folder, or in the one that `jcr capture` wrote, is used again. For a
    fixed camera, only the pixels of the object that the gripper carries are used. If no back end gives a calibration,
    calibration.json and the report state the reason, and NothingFoundError is raised; it proposes the option `--board`
    if the images show a board.
    """
    capture, out, options = result.capture, result.out, result.state.options
    seen = with_moving_parts(capture, out / MOVING) if capture.mount == "base" else capture

    def is_same(folder: Path, stage: str = "select", file: str = RECONSTRUCTION) -> bool:
        """Test whether a folder has a file of the same inputs; False if its run.json cannot be read."""
        with suppress(InputError):
            made = RunResult(folder).state.made.get(stage)
            return made == result.state.made[stage] and (folder / file).is_file()
        return False

    if not is_same(out, "densify", DEPTH):  # so that the fingerprints of run.json are those of its files
        (out / DEPTH).unlink(missing_ok=True)
    same = next(filter(is_same, (out, capture.folder / LIVE)), None)
    before = None if same is None else RunResult(same, capture=seen)
    try:
        keep = partial(keep_reconstruction, result)
        read = None if before is None else before.reconstruction
        if options.method == "paper":
            made, found = select_published(seen, options, progress, read)
        else:
            is_attempted = before is None or bool(before.state.attempts)
            made, found = select_reconstruction(seen, options, progress, keep, read, goes_on=not is_attempted)
    except NothingFoundError as error:
        if not is_same(out):
            forget_reconstruction(out)
        raise _kept_failure(result, error) from None
    attempts = found.attempts if before is None else before.state.attempts or found.attempts
    state = result.state.model_copy(update={"attempts": attempts})
    result = result.with_parts(state=state, reconstruction=made, calibration=found)
    if is_same(out) and read is not None and np.array_equal(made.recon_from_camera, read.recon_from_camera):
        write_state(result)
    else:
        keep_reconstruction(result, made)
    return result


def keep_reconstruction(result: RunResult, reconstruction: Reconstruction) -> None:
    """Write a reconstruction, then run.json; pointmaps that are not a network's are left out, as depth.npz has them."""
    forget_reconstruction(result.out)
    pointmaps = reconstruction.pointmaps
    predicted = pointmaps if pointmaps is not None and pointmaps.is_predicted else None
    write_reconstruction(result.out / RECONSTRUCTION, replace(reconstruction, pointmaps=predicted))
    write_state(result)


def forget_reconstruction(out: Path) -> None:
    """Delete run.json, then depth and reconstruction, so that run.json never describes files of other inputs."""
    for name in (STATE, DEPTH, RECONSTRUCTION):
        (out / name).unlink(missing_ok=True)


def _record(result: RunResult, progress: Progress) -> RunResult:
    """Add attempts, notes and a proposed board to the calibration; write calibration.json and log.txt."""
    capture, reconstruction, content = result.capture, result.reconstruction, result.solved
    notes = (*capture.notes, *reconstruction.notes)
    content = replace(content, attempts=result.state.attempts, notes=notes, frame_names=capture.frame_names)
    if content.verdict == "rejected" or content.short is not None:
        content = content.with_findings(*proposed(capture, result.state.options.reconstruct.board))
    content = content.with_notes()
    keep_calibration(result.out, content)
    return result.with_parts(calibration=content)


def keep_calibration(out: Path, content: AnyCalibration) -> None:
    """Write calibration.json and, as text, log.txt; delete files that were made from a different calibration first."""
    same = False
    with suppress(InputError):
        before = RunResult(out).calibration
        same = (before.mount, before.scale) == (content.mount, content.scale)
        same = same and np.array_equal(before.parent_from_camera, content.parent_from_camera)  # pyright: ignore[reportArgumentType]
    for name in () if same else (CLOUD, MAP, REPORT, CAMERAS):
        (out / name).unlink(missing_ok=True)
    write_calibration(out / CALIBRATION, content)
    write_text(out / LOG, log(content))


def write_state(result: RunResult) -> None:
    """Write the state of a run (capture, options, attempts, fingerprints) to run.json."""
    content = result.state.model_dump(mode="json", warnings=False)
    write_text(result.out / STATE, json.dumps(content, indent=2) + "\n")


def place(result: RunResult, progress: Progress) -> CamerasFile:
    """Calibrate the other cameras of the cell in the run's reconstruction; return the content of cameras.json."""
    from jcr.cell.place_cameras import place_cameras

    parts = result.capture, result.others, result.reconstruction, result.found
    return place_cameras(*parts, result.state.options.calibrate, progress)[0]


def _cameras(result: RunResult, progress: Progress) -> RunResult:
    """Calibrate the other cameras of the cell, write cameras.json, and return the result with its content."""
    found = place(result, progress)
    write_cameras(result.out, found)
    return result.with_parts(cameras=found)


def _densify(result: RunResult, progress: Progress) -> RunResult:
    """Return the result with dense depth in its reconstruction, estimated unless it is there, and write depth.npz."""
    made = densify(result.capture, result.reconstruction, result.state.options.depth, progress)
    if not made.dense.is_predicted and not (result.out / DEPTH).is_file():
        write_depth(result.out / DEPTH, made)
    return result.with_parts(reconstruction=made)


def _map(result: RunResult, progress: Progress) -> RunResult:
    """Return the result with cloud, map and measured objects, and write cloud and map.

    Images that were added later are included.
    """
    # These imports take seconds, which a calibration without a map does not need.
    from jcr.depth.added_images import extend
    from jcr.depth.depth_camera import with_measured_depth
    from jcr.paper.fields import published_scene
    from jcr.scene.build import build_scene
    from jcr.scene.cloud import point_cloud
    from jcr.scene.uncertainty import map_uncertainty
    from jcr.segments.measure import measure_objects
    from jcr.segments.segmentation import image_labels, label_cloud
    from jcr.segments.tabletop import fit_support

    options, capture, hand_eye, added = result.state.options, result.capture, result.solved, result.added
    assert options.map is not None  # `make` leaves this stage out otherwise
    made = result.reconstruction
    if len(added):
        x, base_from_recon = hand_eye.gripper_from_camera, hand_eye.base_from_recon
        made = extend(made, x, base_from_recon, len(capture), added, progress)
    made, remarks = with_measured_depth(
        capture, made, hand_eye.depth_check if hand_eye.converged else None, hand_eye.scale
    )
    given = image_labels(capture, made, hand_eye, options.segment, progress)
    labels, names = given or (None, ("none",))
    cloud, support = point_cloud(capture, made, hand_eye, labels, options.cloud, names), None
    with suppress(InputError):
        support = fit_support(cloud)
    cloud, more = label_cloud(cloud, options.segment, support)
    notes = [*remarks, *more]
    if len(added) and options.segment.segments in ("auto", "labels") and given is not None:
        notes.append("images added later have no label images; --segments tabletop labels them, too")
    give_back()
    with ThreadPoolExecutor(1) as beside:
        sizes = None if support is None else beside.submit(measure_objects, cloud, result.scale_std, support)
        is_published = "paper" in (options.method, options.map.preset)
        build = published_scene if is_published else build_scene
        scene = build(cloud, options.map, progress, device=device_of(options.reconstruct))
        if isinstance(hand_eye, Calibration):
            scene.set_uncertainty(map_uncertainty(scene, cloud, hand_eye))
        measured = None if sizes is None else sizes.result()
    write_cloud(result.out / CLOUD, cloud)
    scene.save(result.out / MAP)
    if len(added):
        write_added(added, capture)
    noted = result.calibration.with_notes(*notes)
    return result.with_parts(cloud=cloud, scene=scene, measured=measured, calibration=noted)


def _report(result: RunResult, progress: Progress = silent) -> RunResult:
    """Write report.html and return the result."""
    from jcr.report.html import report_html

    progress("report", 0.0)
    options = result.state.options
    # The options of the map are left out: the map holds its own history.
    stages = {"reconstruct": options.reconstruct, "calibrate": options.calibrate, "densify": options.depth}
    about = {stage: asdict(own) for stage, own in stages.items()}
    write_text(result.out / REPORT, report_html(result, about))
    progress("report", 1.0)
    return result


class Stage(NamedTuple):
    """Stage of a run: its files, its function, and its inputs."""

    files: tuple[str, ...]
    function: Callable[[RunResult, Progress], RunResult]
    """Function that writes the files and adds records to the result."""
    inputs: Callable[[RunResult], Any] | None = None
    """Function that returns what the files are made from beside the inputs of the stages before. They are valid if
    run.json has the fingerprint of these inputs. None: the files are valid if those of the last stage are."""


STAGES: dict[str, Stage] = {
    "select": Stage((RECONSTRUCTION,), _select, _reconstruction_inputs),
    "record": Stage((CALIBRATION,), _record),
    "cameras": Stage((CAMERAS,), _cameras),
    "densify": Stage((DEPTH,), _densify, lambda result: (result.state.options.depth, DEPTH_FORMAT)),
    "map": Stage((CLOUD, MAP), _map),
    "report": Stage((REPORT,), _report, _run_inputs),
}
"""Stages by name, in order."""
FIRST, REST = tuple(STAGES)[:2], tuple(STAGES)[2:]
"""Names of the stages until the calibration, and of those after the calibration."""
