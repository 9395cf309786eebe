"""The stages in order, each timed, from a capture to a run folder that any of them can start again from.

capture -> reconstruct -> calibrate -> cloud -> map -> report
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from jcr import __version__
from jcr.attempts import Choice, NothingFoundError, again, choose, deepened, timings_of
from jcr.calibration.calibration_json import CalibrationFile, calibration_file, failed_file
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.calibration.poses import calibrate_poses as calibrate_poses_stage
from jcr.calibration.poses import is_one
from jcr.capture.added import read_added, with_images, write_added
from jcr.capture.images import read_image
from jcr.cell.added import camera_of, keep_camera, read_added_cameras
from jcr.cell.cameras_json import CamerasFile, cameras_file
from jcr.cell.found import CameraFound
from jcr.errors import NotTrustedError
from jcr.mapping import mapped, measured, require_map
from jcr.progress import Progress, silent
from jcr.reconstruct.backends import with_cameras_of
from jcr.reconstruct.board_in_view import proposed
from jcr.records import Capture, CellCamera, Finding, PosePairs
from jcr.records.words import sentence
from jcr.represent.options import CloudOptions, MapOptions
from jcr.results import PosesResult, RunOptions, RunResult
from jcr.run_folder import MOVING, RunFolder, State, held, state_of
from jcr.segment.measure import Measured
from jcr.segment.options import SegmentOptions


def run(
    capture: Capture,
    out: str | Path,
    options: RunOptions | None = None,
    *,
    backend: str | None = None,
    progress: Progress | None = None,
) -> RunResult:
    """Calibrate a capture and write calibration, cloud, map and report to the folder `out`.

    Finished stages are reused from `out` if capture and options are unchanged. Raises InputError if the input cannot be
    used, or if a map is requested and torch is not installed, and NotTrustedError if no camera poses are found
    (calibration.json then says why).
    """
    options = _with_backend(options, backend, capture)
    check_options(options.calibrate)
    if capture.mount == "base":  # what it sees moves with the gripper: there is no map in the base frame
        return calibrate(capture, out, options, progress=progress)
    if options.map is None:
        options = _with_dense(options, options.calibrate.known_length is not None)
    else:
        require_map(options.reconstruct)
    with held(Path(out)) as folder:
        capture = folder.keep_capture(capture)
        added = read_added(folder.path, capture)
        return _all_stages(capture, added, folder, options, progress or silent)


def calibrate(
    capture: Capture,
    out: str | Path,
    options: RunOptions | None = None,
    *,
    backend: str | None = None,
    progress: Progress | None = None,
) -> RunResult:
    """Calibrate a capture and write calibration and report to the folder `out`; raises as `run` does.

    No dense depth is estimated: only a map and a known length need it, and `build_map` adds it if it is missing.
    """
    options = _with_backend(options, backend, capture)
    options = _with_dense(options, options.calibrate.known_length is not None)
    check_options(options.calibrate)
    with held(Path(out)) as folder:
        capture = folder.keep_capture(capture)
        if capture.mount == "base":
            return _report(
                _watched(capture, folder, options, progress or silent), folder, options, progress or silent
            )
        calibrated = _calibrate(capture, folder, options, progress or silent)
        calibrated = _placed(calibrated, folder, options, progress or silent)
        return _report(calibrated, folder, options, progress or silent)


def calibrate_poses(
    pairs: PosePairs, out: str | Path, options: CalibrateOptions | None = None
) -> PosesResult:
    """calibration.json and report in the folder `out` from camera poses that were given, without images."""
    from jcr.report.html import poses_report_html

    with held(Path(out)) as folder:
        start = time.perf_counter()
        hand_eye = calibrate_poses_stage(pairs, options)
        timings = {"calibrate": _seconds_since(start)}
        content = calibration_file(pairs, pairs, hand_eye, timings, __version__)
        folder.forget_reconstruction()
        folder.keep_calibration(content)
        is_metric = hand_eye.converged and is_one(hand_eye)
        result = PosesResult(folder.path, pairs, content, hand_eye, is_metric)
        folder.keep_report(poses_report_html(result, {"calibrate": asdict(options or CalibrateOptions())}))
        return result


def build_map(
    out: str | Path,
    cloud: CloudOptions | None = None,
    map: MapOptions | None = None,
    segment: SegmentOptions | None = None,
    *,
    add: Sequence[tuple[Path, Path]] = (),
    progress: Progress | None = None,
) -> RunResult:
    """Build cloud, map and report again, from the capture and the calibration of the run folder `out`.

    `add` are further images, oldest first, each with a file of its base_from_gripper. They change the map but not the
    calibration, and are used in every later map of the folder. If the folder was made without dense depth, it is
    added to the reconstruction.
    """
    made_with = RunFolder(Path(out)).options()
    reconstruct = replace(made_with.reconstruct, dense=True)
    require_map(reconstruct)
    capture = RunFolder(Path(out)).capture()
    options = RunOptions(
        reconstruct,
        made_with.calibrate,
        cloud or CloudOptions(),
        map or MapOptions(),
        segment or SegmentOptions(),
    )
    with held(Path(out)) as folder:
        added = with_images(read_added(folder.path, capture), add)
        return _all_stages(capture, added, folder, options, progress or silent)


def add_camera(
    out: str | Path,
    name: str,
    pictures: Sequence[str | Path],
    intrinsics: str | Path | None = None,
    *,
    progress: Progress | None = None,
) -> RunResult:
    """Locate a fixed camera from its images of the scene of the run folder `out`.

    `intrinsics` is a JSON file in the form of capture.json; None: they are estimated. The camera becomes part of the
    run, of cameras.json and of the report. Raises InputError if the images are not from one camera or do not fit the
    intrinsics, and NotTrustedError, writing nothing, if they do not determine the camera's pose or the run is rejected.
    """
    made_with, capture = RunFolder(Path(out)).options(), RunFolder(Path(out)).capture()
    earlier = RunFolder(Path(out)).calibration()
    if earlier.doubt is not None:
        raise NotTrustedError(
            f"{out}: its calibration is rejected, so no camera can be located with it: {earlier.doubt}"
        )
    options = RunOptions(made_with.reconstruct, made_with.calibrate)
    with held(Path(out)) as folder:
        added = read_added_cameras(folder.path, capture)
        taken = [capture.camera_name, *(camera.name for camera in (*capture.others, *added))]
        camera = camera_of(
            name,
            [Path(picture) for picture in pictures],
            None if intrinsics is None else Path(intrinsics),
            taken,
        )
        result = _calibrate(capture, folder, options, progress or silent)
        placed = _cameras(result, (*added, camera), options, progress or silent, folder)
        assert placed is not None
        if (found := placed.cameras[-1]).doubt is not None:
            raise NotTrustedError(f"{name}: {found.doubt}")
        keep_camera(folder.path, capture, camera)
        result = _placed(result, folder, options, progress or silent)
        if folder.has_map():
            cloud = folder.cloud()
            result = replace(
                result, cloud=cloud, scene=folder.scene(), measured=measured(cloud, result.calibration)
            )
        return _report(result, folder, options, progress or silent)


def measure(out: str | Path) -> Measured:
    """Measure the support plane of a run and the objects on it, from its cloud and its calibration.

    Raises InputError if there is no map, or if there is no support plane.
    """
    folder = RunFolder(Path(out))
    return measured(folder.cloud(), folder.calibration())


def _all_stages(
    capture: Capture, added: Capture, folder: RunFolder, options: RunOptions, progress: Progress
) -> RunResult:
    calibrated = _placed(_calibrate(capture, folder, options, progress), folder, options, progress)
    if options.map is not None:
        calibrated = _map(calibrated, added, folder, options, progress)
    return _report(calibrated, folder, options, progress)


def _calibrate(capture: Capture, folder: RunFolder, options: RunOptions, progress: Progress) -> RunResult:
    """The reconstruction that the folder has of the same input, calibrated; else back ends are tried."""
    if not options.reconstruct.dense:
        dense = _with_dense(options, True)
        if folder.earlier(state_of(capture, dense.reconstruct, dense.calibrate)) is not None:
            options = dense  # it is there already
    state = state_of(capture, options.reconstruct, options.calibrate)
    try:
        choice = (
            _kept(capture, folder, state, progress)
            or _deepened(capture, folder, options, state, progress)
            or choose(
                capture,
                options.reconstruct,
                options.calibrate,
                progress,
                lambda made: folder.keep_reconstruction(made, state),
            )
        )
    except NothingFoundError as nothing:
        board = None if options.reconstruct.board else _board_in_view(capture)
        _fail(capture, folder, state, options, nothing, board)
        raise (nothing if board is None else nothing.with_more(sentence(board))) from None
    folder.keep_state(state.model_copy(update={"attempts": choice.attempts}))
    content = calibration_file(
        capture, choice.reconstruction, choice.hand_eye, choice.timings_s, __version__, choice.attempts
    )
    if not options.reconstruct.board and (not content.converged or content.short is not None):
        board = _board_in_view(capture)
        content = content if board is None else content.with_findings(board)
    folder.keep_calibration(content)
    return RunResult(folder.path, capture, content, choice.hand_eye, choice.reconstruction)


def _placed(result: RunResult, folder: RunFolder, options: RunOptions, progress: Progress) -> RunResult:
    """With the other cameras of the cell, those of the capture and those added to the run."""
    start = time.perf_counter()
    added = read_added_cameras(folder.path, result.capture)
    cameras = _cameras(result, added, options, progress, folder)
    folder.keep_cameras(cameras)
    if cameras is None:
        return result
    content = _timed(result.calibration, "cameras", start)
    folder.amend_calibration(content)
    return replace(result, calibration=content, cameras=cameras)


def _cameras(
    result: RunResult,
    added: Sequence[CellCamera],
    options: RunOptions,
    progress: Progress,
    folder: RunFolder,
) -> CamerasFile | None:
    from jcr.cell.alone import calibrated_elsewhere, sees_another_scene
    from jcr.cell.stage import place_cameras

    others = (*result.capture.others, *added)
    if not others:
        return None
    of_scene = [camera for camera in others if not camera.watches_gripper]
    found = place_cameras(
        result.capture, of_scene, result.reconstruction, result.hand_eye, options.calibrate, progress
    )
    by_name = {camera.name: camera for camera in found.cameras}
    for camera in of_scene:
        shared = by_name[camera.name]
        if result.hand_eye.converged and sees_another_scene(camera, shared):
            by_name[camera.name] = calibrated_elsewhere(
                result.capture,
                camera,
                shared,
                _with_dense(options, False).reconstruct,
                options.calibrate,
                progress,
            )
    by_name |= {
        camera.name: _watching(result.capture, camera, folder, options, progress)
        for camera in others
        if camera.watches_gripper
    }
    return cameras_file(replace(found, cameras=tuple(by_name[camera.name] for camera in others)), __version__)


def _watched(capture: Capture, folder: RunFolder, options: RunOptions, progress: Progress) -> RunResult:
    """A fixed camera that watches what the gripper carries, calibrated; there is no map of that."""
    from jcr.cell.background import write_moving_parts
    from jcr.cell.carried import exchanged, refined

    write_moving_parts(capture.folder, capture.images, folder.path / MOVING)
    seen = replace(exchanged(capture), folder=folder.path / MOVING)
    state = state_of(seen, options.reconstruct, options.calibrate)
    state = state.model_copy(update={"capture": str(capture.folder.resolve())})
    try:
        choice = _kept(seen, folder, state, progress) or choose(
            seen,
            options.reconstruct,
            options.calibrate,
            progress,
            lambda made: folder.keep_reconstruction(made, state),
        )
    except NothingFoundError as nothing:
        _fail(capture, folder, state, options, nothing)
        raise
    folder.keep_state(state.model_copy(update={"attempts": choice.attempts}))
    hand_eye = refined(capture, choice.reconstruction, choice.hand_eye, options.calibrate)
    content = calibration_file(
        capture, choice.reconstruction, hand_eye, choice.timings_s, __version__, choice.attempts
    )
    folder.keep_calibration(content)
    return RunResult(folder.path, capture, content, hand_eye, choice.reconstruction)


def _watching(
    capture: Capture, camera: CellCamera, folder: RunFolder, options: RunOptions, progress: Progress
) -> CameraFound:
    """The same of a further camera of a capture, as one of its cameras."""
    from jcr.cell.carried import calibrated_alone

    return calibrated_alone(
        capture,
        camera,
        folder.path / MOVING / camera.name,
        _with_dense(options, False).reconstruct,
        options.calibrate,
        progress,
    )


def _kept(capture: Capture, folder: RunFolder, state: State, progress: Progress) -> Choice | None:
    """What an earlier run chose from the same input; None where it is to be made."""
    start = time.perf_counter()
    if (earlier := folder.earlier(state)) is None:
        return None
    reconstruction = folder.reconstruction()
    seconds = _seconds_since(start)
    return again(capture, reconstruction, seconds, earlier.attempts, state.options.calibrate, progress)


def _deepened(
    capture: Capture, folder: RunFolder, options: RunOptions, state: State, progress: Progress
) -> Choice | None:
    """What an earlier run chose from the same input without dense depth, with it; None where it is to be made."""
    if not options.reconstruct.dense or options.calibrate.known_length is not None:
        return None
    without = _with_dense(options, False)
    choice = _kept(capture, folder, state_of(capture, without.reconstruct, without.calibrate), progress)
    if choice is None:
        return None
    choice = deepened(capture, choice, options.reconstruct, progress)
    folder.keep_reconstruction(choice.reconstruction, state)
    return choice


def _board_in_view(capture: Capture) -> Finding | None:
    """The board that would help, where the images show one."""
    return proposed([read_image(capture.folder / name) for name in capture.images])


def _fail(
    capture: Capture,
    folder: RunFolder,
    state: State,
    options: RunOptions,
    error: NothingFoundError,
    board: Finding | None = None,
) -> None:
    """Leave the reason where the results would be, and nothing of another capture or of other options."""
    from jcr.report.html import failed_report_html

    if folder.earlier(state) is None:
        folder.forget_reconstruction()
    backend, timings = error.attempts[-1].backend, timings_of(error.attempts)
    failed = failed_file(capture, backend, error, timings, __version__, error.attempts)
    failed = failed if board is None else failed.with_findings(board)
    folder.keep_calibration(failed)
    folder.keep_report(failed_report_html(capture, failed, _told(options)))


def _map(
    result: RunResult, added: Capture, folder: RunFolder, options: RunOptions, progress: Progress
) -> RunResult:
    start = time.perf_counter()
    made = mapped(result, added, options, progress)
    folder.keep_map(made.cloud, made.scene)
    if len(added):
        write_added(added, result.capture)
    content = _timed(result.calibration, "map", start, made.notes)
    folder.amend_calibration(content)
    return replace(result, calibration=content, cloud=made.cloud, scene=made.scene, measured=made.measured)


def _report(result: RunResult, folder: RunFolder, options: RunOptions, progress: Progress) -> RunResult:
    from jcr.report.html import report_html

    start = time.perf_counter()
    progress("report", 0.0)
    folder.keep_report(report_html(result, _told(options)))
    content = _timed(result.calibration, "report", start)
    folder.amend_calibration(content)
    progress("report", 1.0)
    return replace(result, calibration=content)


def _told(options: RunOptions) -> dict[str, Mapping[str, Any]]:
    """The options that decide the calibration, a stage each."""
    return {"reconstruct": asdict(options.reconstruct), "calibrate": asdict(options.calibrate)}


def _timed(content: CalibrationFile, stage: str, start: float, notes: Sequence[str] = ()) -> CalibrationFile:
    """With the seconds and the notes of one more stage."""
    timings = content.timings_s | {stage: _seconds_since(start)}
    return content.model_copy(update={"timings_s": timings, "notes": [*content.notes, *notes]})


def _seconds_since(start: float) -> float:
    return round(time.perf_counter() - start, 3)


def _with_dense(options: RunOptions, dense: bool) -> RunOptions:
    return replace(options, reconstruct=replace(options.reconstruct, dense=dense))


def _with_backend(options: RunOptions | None, backend: str | None, capture: Capture) -> RunOptions:
    """The options with the back end of the call, or the one that takes the capture's own camera poses."""
    options = options or RunOptions()
    if backend is not None:
        options = replace(options, reconstruct=replace(options.reconstruct, backend=backend))
    return replace(options, reconstruct=with_cameras_of(capture, options.reconstruct))
