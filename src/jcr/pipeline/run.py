"""The stages in order, each timed, from a capture to a run folder that any of them can start again from.

capture -> reconstruct -> calibrate -> cameras -> densify -> map -> report
"""

import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jcr import __version__
from jcr.allocator import give_back
from jcr.boards.proposal import proposed_for
from jcr.calibration.cues import check_known_length
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.calibration.poses import calibrate_poses as calibrate_poses_stage
from jcr.calibration.record import Calibration, calibration_of, failed_calibration, write_calibration
from jcr.calibration.words import log
from jcr.capture.added import read_added, with_images, write_added
from jcr.capture.formats.capture_json import kept
from jcr.capture.options import ReadOptions
from jcr.capture.read import read_capture
from jcr.cell.added import camera_of, keep_camera, read_added_cameras
from jcr.cell.carried import carried_scene, refined
from jcr.cell.placement import FILE as CAMERAS
from jcr.cell.placement import CamerasFile, write_cameras
from jcr.depth.densify import densify
from jcr.depth.depth_npz import is_made_from, write_depth
from jcr.errors import InputError, RejectedError
from jcr.extras import is_installed
from jcr.files import write_text
from jcr.findings import sentence
from jcr.options import checked_options
from jcr.pipeline.selection import NothingFoundError, again, choose, timings_of
from jcr.progress import Progress, silent
from jcr.reconstruct import BackendName, check_board, device_of
from jcr.records import Capture, CellCamera, PosePairs, Reconstruction
from jcr.records.npz import write_reconstruction
from jcr.run_folder import (
    CALIBRATION,
    CAPTURE,
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
    fingerprint_of_run,
    locked,
    state_of,
)
from jcr.scene.cloud import read_cloud, write_cloud
from jcr.scene.map_file import PACKAGES, require_packages
from jcr.scene.options import CloudOptions, MapOptions
from jcr.segments.options import SegmentOptions

if TYPE_CHECKING:
    from jcr.segments.measure import Measurement

MOVING = "moving"
"""Images of a fixed camera without what stands still; a carried thing is reconstructed from them."""
LIVE = "result"
"""Run folder of all images, in the folder of a capture that was calibrated while it was taken."""
Stage = Callable[[RunResult, RunOptions, Progress], tuple[RunResult, list[str]]]
"""Function of the result so far; returns the result with its part, and notes."""


def run(
    capture: Capture | str | Path,
    out: str | Path,
    options: RunOptions | Mapping[str, Any] | None = None,
    *,
    backend: BackendName | None = None,
    progress: Progress | None = None,
    calibrated: Callable[[RunResult], None] | None = None,
) -> RunResult:
    """Calibrate a capture, or what lies at its path, and write calibration, cloud, map and report to the folder `out`.

    `backend` (auto, or a name of `jcr models`) takes the place of that of `options`. Finished stages are reused from
    `out` if capture and options are unchanged, and so is a whole run. Without torch there is no map, and a note says how
    to add it. `calibrated` is called with the calibration before depth and map are made. Raises InputError if the input
    cannot be used, and RejectedError if no camera poses are found; calibration.json then contains the reason.
    """
    out, report = Path(out), progress or silent
    options = checked_options(options, RunOptions)
    check_options(options.calibrate)
    check_board(options.reconstruct)
    capture = _capture_of(capture, out)
    check_known_length(capture, options.calibrate.known_length)
    options, missing = _possible(options.for_capture(capture, backend), capture)
    with locked(out):
        capture = kept(capture, out / CAPTURE)
        state = state_of(capture, options)
        before = RunResult(out, capture=capture, is_unchanged=True)
        if _is_complete(before, state):
            if before.parent_from_camera is None:
                raise NothingFoundError(before.doubt)
            return before
        if options.map is not None:
            # Torch takes more than a second to import, loops of depth as long to load; COLMAP leaves a core idle.
            threading.Thread(target=_load_map_code, args=[options.estimates_depth], daemon=True).start()
        added = None if options.map is None else read_added(out, capture)
        result = _calibrated(RunResult(out, capture=capture, state=state, added=added), options, report)
        result = _noted(result, missing)
        if calibrated is not None:
            calibrated(result)
        result = _after_calibration(result, options, report)
        _write_complete(result.state, out, result.capture)
        return result


def calibrate(
    capture: Capture | str | Path,
    out: str | Path,
    options: RunOptions | Mapping[str, Any] | None = None,
    *,
    backend: BackendName | None = None,
    progress: Progress | None = None,
) -> RunResult:
    """Calibrate a capture and write calibration and report to the folder `out`; raises as `run` does.

    No dense depth is estimated: only a map and a known length need it, and `build_map` adds it if it is missing.
    """
    options = replace(checked_options(options, RunOptions), map=None)
    return run(capture, out, options, backend=backend, progress=progress)


def calibrate_poses(pairs: PosePairs, out: str | Path, options: CalibrateOptions | None = None) -> RunResult:
    """Write calibration.json and report to the folder `out`, from camera poses that were given, without images."""
    from jcr.report.html import poses_report_html

    out = Path(out)
    with locked(out):
        start = time.perf_counter()
        hand_eye = calibrate_poses_stage(pairs, options)
        timings = {"calibrate": round(time.perf_counter() - start, 3)}
        content = calibration_of(pairs, pairs, hand_eye, timings, __version__)
        _forget_reconstruction(out)
        _keep_calibration(out, content)
        result = RunResult(out, capture=pairs, calibration=content, hand_eye=hand_eye, reconstruction=pairs)
        page = poses_report_html(result, {"calibrate": asdict(options or CalibrateOptions())})
        write_text(out / REPORT, page)
        return result


def build_map(
    out: str | Path,
    cloud: CloudOptions | Mapping[str, Any] | None = None,
    map: MapOptions | Mapping[str, Any] | None = None,
    segment: SegmentOptions | Mapping[str, Any] | None = None,
    *,
    add: Sequence[str | Path] = (),
    read: ReadOptions | Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> RunResult:
    """Build cloud, map and report again, from the capture and the calibration of the run folder `out`.

    `add` are captures of further images, oldest first, read with the options `read`. They change the map but not the
    calibration, and are used in every later map of the folder. Dense depth is estimated if the folder has none.
    """
    before, report = RunResult(out), progress or silent
    options = replace(
        before.state.options,
        depth=replace(before.state.options.depth, dense=True),
        cloud=checked_options(cloud, CloudOptions),
        map=checked_options(map, MapOptions),
        segment=checked_options(segment, SegmentOptions),
    )
    require_packages("the map", "; `jcr run` and `jcr calibrate` calibrate without it")
    capture = before.capture
    with locked(before.out):
        added = read_added(before.out, capture)
        for path in add:
            added = with_images(added, Path(path), checked_options(read, ReadOptions))
        parts = RunResult(before.out, capture=capture, state=state_of(capture, options), added=added)
        return _after_calibration(_calibrated(parts, options, report), options, report)


def add_camera(
    out: str | Path,
    name: str,
    images: Sequence[str | Path] | str | Path = (),
    intrinsics: str | Path | None = None,
    *,
    progress: Progress | None = None,
) -> RunResult:
    """Locate a fixed camera from its images of the scene of the run folder `out`.

    `images` are one file or more. `intrinsics` is a JSON file in the form of capture.json; None: they are estimated. The
    camera becomes part of the run, of cameras.json and of the report. Raises InputError if the images are not from one
    camera or do not fit the intrinsics, and RejectedError, writing nothing, if they do not determine the camera's pose
    or the run is rejected.
    """
    files = [Path(image) for image in ([images] if isinstance(images, str | Path) else images)]
    if not files:
        raise InputError(f"{name}: no images; give one or more that the camera took")
    before, report = RunResult(out), progress or silent
    options, capture = replace(before.state.options, map=None), before.capture
    if (doubt := before.calibration.doubt) is not None:
        raise RejectedError(
            f"{out}: its calibration is rejected, so no camera can be located with it: {doubt}"
        )
    with locked(before.out):
        added = read_added_cameras(before.out, capture)
        taken = [capture.camera_name, *(camera.name for camera in (*capture.others, *added))]
        file = None if intrinsics is None else Path(intrinsics)
        camera = camera_of(name, files, file, taken)
        parts = RunResult(before.out, capture=capture, state=state_of(capture, options))
        result = _calibrated(parts, options, report)
        located = _place(result, (*capture.others, *added, camera), options, report)
        if (found := located.cameras[-1]).doubt is not None:
            raise RejectedError(f"{name}: {found.doubt}")
        keep_camera(before.out, capture, camera)
        return _after_calibration(result, options, report, with_map=True)


def measure(out: str | Path) -> "Measurement":
    """Measure the support plane of a run and the objects on it, from its cloud and its calibration.

    Raises InputError if there is no map, or if there is no support plane.
    """
    from jcr.segments.measure import measure_objects

    return measure_objects(read_cloud(Path(out) / CLOUD), RunResult(out).scale_std)


def _capture_of(capture: Capture | str | Path, out: Path) -> Capture:
    """Return a capture as it is, or read it from a path; images of a recording are put into the run folder."""
    if isinstance(capture, Capture):
        return capture
    if not isinstance(capture, str | Path):
        raise InputError(f"{capture!r:.80}: give a capture of jcr.read_capture, or its path")
    with locked(out):
        return read_capture(capture, into=out / CAPTURE)


def _possible(options: RunOptions, capture: Capture) -> tuple[RunOptions, str | None]:
    """Return the options, without the map where none can be made, and a note on the package that it needs.

    Raises InputError where a map is wanted, and the dense depth that it needs is not.
    """
    # What a camera on the base sees moves with the gripper, not with the base.
    if options.map is None or capture.mount == "base":
        return replace(options, map=None), None
    if not options.depth.dense:
        raise InputError("--no-dense: the map needs dense depth; leave it out, or add --no-map")
    if all(map(is_installed, PACKAGES)):
        return options, None
    try:
        require_packages("the map", ", then `jcr map`")
    except InputError as error:
        return replace(options, map=None), f"no map was made: {error}"
    return options, None


def _load_map_code(estimates_depth: bool) -> None:
    """Import what a map needs; an error shows again where the map is made."""
    with suppress(Exception):
        if estimates_depth:
            from jcr.depth.densify import compile_loops

            compile_loops()
        import jcr.scene.build  # noqa: F401


def _is_complete(before: RunResult, state: RunState) -> bool:
    """Test whether a run of the same input is finished, and its files were neither changed nor removed since."""
    try:
        found = before.state.run
        return found is not None and found == fingerprint_of_run(before.out, before.capture, state)
    except (InputError, OSError):
        return False


def _calibrated(result: RunResult, options: RunOptions, progress: Progress) -> RunResult:
    """Calibrate the reconstruction that the folder has of the same input; without one, select one of the back ends.

    Where the camera watches the gripper, what the gripper carries is the scene.
    """
    out, capture, state, own = result.out, result.capture, result.state, options.calibrate
    watches, seen = capture.mount == "base", capture
    if watches:
        # The arm's kinematics are those of the reported poses, and not of their inverses.
        seen, own = carried_scene(capture, out / MOVING), replace(own, robot=None)
    before = _with_reconstruction_of(state, out, seen)
    try:
        if before is None:
            kept = choose(seen, options.reconstruct, own, progress, options.depth)
            state = state.model_copy(update={"attempts": kept.attempts})
            _keep_reconstruction(out, kept.reconstruction, state)
        else:
            kept = again(seen, lambda: before.reconstruction, own, progress, options.depth)
            state = state.model_copy(update={"attempts": before.state.attempts or kept.attempts})
            _write_state(out, state)
            if before.out != out:
                _keep_reconstruction(out, kept.reconstruction, state)
    except NothingFoundError as error:
        if before is None:
            _forget_reconstruction(out)
        raise _failed(out, capture, options, state, error) from None
    _keep_depth(out, kept.reconstruction, state)
    reconstruction, hand_eye, timings = kept.reconstruction, kept.hand_eye, timings_of(kept.attempts)
    if watches:
        hand_eye = refined(capture, reconstruction, hand_eye, options.calibrate)
    content = calibration_of(capture, reconstruction, hand_eye, timings, __version__, state.attempts)
    if content.verdict == "rejected" or content.short is not None:
        board = proposed_for(capture, options.reconstruct.board)
        content = content if board is None else content.with_findings(board)
    _keep_calibration(out, content)
    return result.with_parts(
        state=state, calibration=content, hand_eye=hand_eye, reconstruction=reconstruction
    )


def _with_reconstruction_of(state: RunState, out: Path, capture: Capture) -> RunResult | None:
    """Return the earlier run of the folder, or of `jcr capture`, whose reconstruction was made from the same input.

    A state that cannot be read proves nothing: to make every stage again is always right.
    """
    for folder in (out, capture.folder / LIVE):
        before, is_same = RunResult(folder, capture=capture), False
        with suppress(InputError):
            is_same = before.state.reconstruction == state.reconstruction
        if is_same and (folder / RECONSTRUCTION).is_file():
            if folder == out and not is_made_from(out / DEPTH, state.depth):
                (out / DEPTH).unlink(missing_ok=True)
            return before
    return None


def _failed(
    out: Path, capture: Capture, options: RunOptions, state: RunState, error: NothingFoundError
) -> NothingFoundError:
    """Return the error, with the --board that the images show, after its reason is written to the folder."""
    from jcr.report.html import failed_report_html

    board, tried = proposed_for(capture, options.reconstruct.board), error.attempts
    content = failed_calibration(
        capture, tried[-1].backend, error.findings, timings_of(tried), __version__, tried
    )
    content = content if board is None else content.with_findings(board)
    _keep_calibration(out, content)
    write_text(out / REPORT, failed_report_html(capture, content, _for_report(options)))
    _write_complete(state, out, capture)
    return error if board is None else NothingFoundError(error.with_more(sentence(board)), tried)


def _after_calibration(
    result: RunResult, options: RunOptions, progress: Progress, with_map: bool = False
) -> RunResult:
    """Run the stages after the calibration; `with_map`: the report has the map that is there already."""
    stages: list[tuple[str, Stage]] = []
    if result.capture.mount != "base":
        result = result.with_parts(others=_others(result))
        (result.out / CAMERAS).unlink(missing_ok=True)
        stages += [("cameras", _cameras)] if result.others else []
    if options.map is not None:
        stages += [("densify", _densify), ("map", _map)]
    elif not with_map:
        result = result.with_parts(cloud=None, scene=None, measured=None)
    for name, stage in (*stages, ("report", _report)):
        start = time.perf_counter()
        result, notes = stage(result, options, progress)
        give_back()
        timings = result.calibration.timings_s | {name: round(time.perf_counter() - start, 3)}
        content = result.calibration.model_copy(update={"timings_s": timings})
        result = _noted(result.with_parts(calibration=content), *notes)
    _write_calibration(result.out, result.calibration)
    return result


def _others(result: RunResult) -> tuple[CellCamera, ...]:
    """Return the other cameras of the cell, those of the capture and those added to the run."""
    return (*result.capture.others, *read_added_cameras(result.out, result.capture))


def _place(
    result: RunResult, cameras: Sequence[CellCamera], options: RunOptions, progress: Progress
) -> CamerasFile:
    """Return cameras of the cell as cameras.json has them."""
    from jcr.cell.stage import place_cameras

    parts = result.capture, cameras, result.reconstruction, result.hand_eye, options.calibrate
    return place_cameras(*parts, progress).file(__version__)


def _cameras(result: RunResult, options: RunOptions, progress: Progress) -> tuple[RunResult, list[str]]:
    """Locate the other cameras of the cell."""
    found = _place(result, result.others, options, progress)
    write_cameras(result.out, found)
    return result.with_parts(cameras=found), []


def _densify(result: RunResult, options: RunOptions, progress: Progress) -> tuple[RunResult, list[str]]:
    """Add the dense depth of the map: predicted, in the folder, or estimated now."""
    reconstruction = densify(result.capture, result.reconstruction, options.depth, progress)
    _keep_depth(result.out, reconstruction, result.state)
    return result.with_parts(reconstruction=reconstruction), []


def _map(result: RunResult, options: RunOptions, progress: Progress) -> tuple[RunResult, list[str]]:
    """Add cloud, map and measured objects, with the images that were added later.

    Raises InputError where no point is confident enough, or the options leave nothing to map.
    """
    # Labels and sizes need half of SciPy, the map torch, which takes seconds; a calibration does not.
    from jcr.depth.added import extend
    from jcr.depth.measured import with_measured_depth
    from jcr.scene.build import build_scene
    from jcr.scene.cloud import point_cloud
    from jcr.segments.measure import measure_objects
    from jcr.segments.segments import image_labels, label_cloud
    from jcr.segments.tabletop import fit_support

    assert options.map is not None  # or this stage is left out
    out, device, added = result.out, device_of(options.reconstruct), result.added
    capture, hand_eye, made = result.capture, result.hand_eye, result.reconstruction
    if len(added):
        made = extend(made, hand_eye, len(capture), added, progress)
    made, remarks = with_measured_depth(capture, made, hand_eye)
    given = image_labels(capture, made, hand_eye, options.segment, progress)
    labels, names = (None, ("none",)) if given is None else (given.labels, given.names)
    cloud, support = point_cloud(capture, made, hand_eye, labels, options.cloud, names), None
    with suppress(InputError):
        support = fit_support(cloud)
    cloud, more = label_cloud(cloud, options.segment, support)
    notes = [*remarks, *more]
    if len(added) and options.segment.segments in ("auto", "labels") and given is not None:
        notes.append(
            "images added later have no label images; --segments tabletop labels what they show, too"
        )
    give_back()
    with ThreadPoolExecutor(1) as beside:
        sizes = None if support is None else beside.submit(measure_objects, cloud, result.scale_std, support)
        scene = build_scene(cloud, options.map, progress, device=device)
        measured = None if sizes is None else sizes.result()
    write_cloud(out / CLOUD, cloud)
    scene.save(out / MAP)
    if len(added):
        write_added(added, capture)
    return result.with_parts(cloud=cloud, scene=scene, measured=measured), notes


def _report(result: RunResult, options: RunOptions, progress: Progress) -> tuple[RunResult, list[str]]:
    """Write the report."""
    from jcr.report.html import report_html

    progress("report", 0.0)
    write_text(result.out / REPORT, report_html(result, _for_report(options)))
    progress("report", 1.0)
    return result, []


def _for_report(options: RunOptions) -> dict[str, Mapping[str, Any]]:
    """Return the options of the stages up to the map, which has its own history."""
    stages = {"reconstruct": options.reconstruct, "calibrate": options.calibrate, "densify": options.depth}
    return {stage: asdict(own) for stage, own in stages.items()}


def _noted(result: RunResult, *notes: str | None) -> RunResult:
    """Return the result with more notes."""
    every = [*result.calibration.notes, *filter(None, notes)]
    return result.with_parts(calibration=result.calibration.model_copy(update={"notes": every}))


def _write_state(out: Path, state: RunState) -> None:
    """Write run.json."""
    content = state.model_dump(mode="json", warnings=False)
    write_text(out / STATE, json.dumps(content, indent=2) + "\n")


def _write_complete(state: RunState, out: Path, capture: Capture) -> None:
    """Note in run.json that all files of a run are there."""
    _write_state(out, state.model_copy(update={"run": fingerprint_of_run(out, capture, state)}))


def _forget_reconstruction(out: Path) -> None:
    """Remove the reconstruction of another input; a kill between two files leaves none without its fingerprint."""
    for name in (STATE, DEPTH, RECONSTRUCTION):
        (out / name).unlink(missing_ok=True)


def _keep_reconstruction(out: Path, reconstruction: Reconstruction, state: RunState) -> None:
    """Write a reconstruction, then its fingerprint; pointmaps that were estimated become depth.npz."""
    _forget_reconstruction(out)
    pointmaps = reconstruction.pointmaps
    predicted = pointmaps if pointmaps is not None and pointmaps.is_predicted else None
    write_reconstruction(out / RECONSTRUCTION, replace(reconstruction, pointmaps=predicted))
    _write_state(out, state)


def _keep_depth(out: Path, reconstruction: Reconstruction, state: RunState) -> None:
    """Write depth.npz, where the reconstruction has estimated pointmaps and they are not there already."""
    pointmaps = reconstruction.pointmaps
    if pointmaps is None or pointmaps.is_predicted or is_made_from(out / DEPTH, state.depth):
        return
    write_depth(out / DEPTH, reconstruction, state.depth)


def _keep_calibration(out: Path, content: Calibration) -> None:
    """Write calibration.json and log.txt; what was made from another one goes first, so that the two never mix."""
    with suppress(InputError):
        before = RunResult(out).calibration
        same = before.mount == content.mount and before.scale == content.scale
        if same and np.array_equal(before.parent_from_camera, content.parent_from_camera):  # pyright: ignore[reportArgumentType]
            return _write_calibration(out, content)
    for name in (CLOUD, MAP, REPORT, CAMERAS):
        (out / name).unlink(missing_ok=True)
    return _write_calibration(out, content)


def _write_calibration(out: Path, content: Calibration) -> None:
    """Write calibration.json and log.txt."""
    write_calibration(out / CALIBRATION, content)
    write_text(out / LOG, log(content))
