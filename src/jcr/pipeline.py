"""The stages in order, each timed, from a capture to a run folder that any of them can start again from.

capture -> reconstruct -> calibrate -> cloud -> map -> report
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from jcr import __version__
from jcr.attempts import Choice, NothingFoundError, again, choose, timings_of
from jcr.calibration.calibration_json import CalibrationFile, calibration_file, failed_file
from jcr.calibration.stage import CalibrateOptions, is_one
from jcr.calibration.stage import calibrate_poses as calibrate_poses_stage
from jcr.capture.added import read_added, with_images, write_added
from jcr.errors import InputError
from jcr.memory import give_back
from jcr.progress import Progress, silent
from jcr.reconstruct.backends import ReconstructOptions, candidates, device_of
from jcr.records import Capture, PointCloud, PosePairs
from jcr.represent.cloud import CloudOptions, point_cloud
from jcr.represent.options import MapOptions
from jcr.results import PosesResult, RunResult
from jcr.run_folder import MadeWith, RunFolder, State, fingerprint, held
from jcr.segment.measure import Measured
from jcr.segment.measure import measure as measure_cloud
from jcr.segment.options import SegmentOptions
from jcr.segment.segments import image_labels, label_cloud


@dataclass(frozen=True)
class RunOptions:
    """The options of every stage."""

    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions = field(default_factory=MapOptions)
    segment: SegmentOptions = field(default_factory=SegmentOptions)


def run(
    capture: Capture,
    out: str | Path,
    options: RunOptions | None = None,
    *,
    backend: str | None = None,
    progress: Progress | None = None,
) -> RunResult:
    """Everything: calibration, cloud, map and report of a capture in the folder `out`.

    Finished stages are taken from `out` when capture and options are unchanged. Raises InputError on input
    that cannot be used and NotTrustedError when no camera poses are found (calibration.json then says why).
    """
    options = _with_backend(options, backend, capture)
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
    """Reconstruction and calibration of a capture in the folder `out`; raises as `run` does."""
    options = _with_backend(options, backend, capture)
    with held(Path(out)) as folder:
        return _calibrate(folder.keep_capture(capture), folder, options, progress or silent)


def calibrate_poses(
    pairs: PosePairs, out: str | Path, options: CalibrateOptions | None = None
) -> PosesResult:
    """calibration.json in the folder `out` from camera poses that were given, without images."""
    with held(Path(out)) as folder:
        start = time.perf_counter()
        hand_eye = calibrate_poses_stage(pairs, options)
        timings = {"calibrate": _seconds_since(start)}
        content = calibration_file(pairs, pairs, hand_eye, timings, __version__)
        folder.forget_reconstruction()
        folder.keep_calibration(content)
        return PosesResult(folder.path, content, hand_eye, hand_eye.converged and is_one(hand_eye))


def build_map(
    out: str | Path,
    cloud: CloudOptions | None = None,
    map: MapOptions | None = None,
    segment: SegmentOptions | None = None,
    *,
    add: Sequence[tuple[Path, Path]] = (),
    progress: Progress | None = None,
) -> RunResult:
    """Cloud, map and report again, from the capture and the calibration that the run folder `out` names.

    `add` are further images, oldest first, each with a file of its base_from_gripper. They change the map and
    not the calibration, and every later map of the folder has them.
    """
    made_with, capture = RunFolder(Path(out)).options(), RunFolder(Path(out)).capture()
    options = RunOptions(
        made_with.reconstruct,
        made_with.calibrate,
        cloud or CloudOptions(),
        map or MapOptions(),
        segment or SegmentOptions(),
    )
    with held(Path(out)) as folder:
        added = with_images(read_added(folder.path, capture), add)
        return _all_stages(capture, added, folder, options, progress or silent)


def measure(out: str | Path) -> Measured:
    """The support plane of a run and what stands on it, from its cloud and its calibration.

    Raises InputError where there is no map, and when no plane carries the scene.
    """
    folder = RunFolder(Path(out))
    cloud = folder.cloud()
    return _measured(cloud, folder.calibration())


def _all_stages(
    capture: Capture, added: Capture, folder: RunFolder, options: RunOptions, progress: Progress
) -> RunResult:
    calibrated = _calibrate(capture, folder, options, progress)
    mapped = _map(calibrated, added, folder, options, progress)
    return _report(mapped, folder, options, progress)


def _calibrate(capture: Capture, folder: RunFolder, options: RunOptions, progress: Progress) -> RunResult:
    # What auto stands for changes with the weights that are on this machine.
    names = candidates(options.reconstruct)
    made_from = fingerprint(capture, asdict(options.reconstruct) | {"backend": names})
    state = State(
        capture=str(capture.folder.resolve()),
        reconstruct=made_from,
        options=MadeWith(reconstruct=options.reconstruct, calibrate=options.calibrate),
    )
    try:
        choice = _reconstruct_and_calibrate(capture, folder, state, progress)
    except NothingFoundError as error:
        if folder.made_from(made_from) is None:
            folder.forget_reconstruction()
        timings = timings_of(error.attempts)
        failed = failed_file(capture, names[-1], str(error), timings, __version__, error.attempts)
        folder.keep_calibration(failed)
        _report_failure(capture, failed, folder, options)
        raise
    folder.keep_state(state.model_copy(update={"attempts": choice.attempts}))
    content = calibration_file(
        capture, choice.reconstruction, choice.hand_eye, choice.timings_s, __version__, choice.attempts
    )
    folder.keep_calibration(content)
    return RunResult(folder.path, capture, content, choice.hand_eye, choice.reconstruction)


def _reconstruct_and_calibrate(
    capture: Capture, folder: RunFolder, state: State, progress: Progress
) -> Choice:
    """The reconstruction that the folder has of the same input, calibrated; else back ends are tried."""
    reconstruct, calibrate = state.options.reconstruct, state.options.calibrate
    earlier = folder.made_from(state.reconstruct)
    if earlier is None:
        return choose(
            capture, reconstruct, calibrate, progress, lambda made: folder.keep_reconstruction(made, state)
        )
    start = time.perf_counter()
    reconstruction = folder.reconstruction()
    return again(capture, reconstruction, _seconds_since(start), earlier.attempts, calibrate, progress)


def _map(
    result: RunResult, added: Capture, folder: RunFolder, options: RunOptions, progress: Progress
) -> RunResult:
    from jcr.represent.build import build_scene

    start = time.perf_counter()
    device = device_of(options.reconstruct)
    extended = _extended(result, added, device, options, progress)
    cloud, notes = _cloud(extended, options, progress)
    folder.keep_cloud(cloud)
    give_back()
    scene = build_scene(cloud, options.map, progress, device=device)
    folder.keep_scene(scene)
    content = _timed(result.calibration, "map", start, notes)
    folder.amend_calibration(content)
    try:
        measured = _measured(cloud, content)
    except InputError:  # no plane carries the scene
        measured = None
    return replace(result, calibration=content, cloud=cloud, scene=scene, measured=measured)


def _extended(
    result: RunResult, added: Capture, device: str, options: RunOptions, progress: Progress
) -> RunResult:
    """With the reconstruction of images that were added later, which from now on are part of the run."""
    if not len(added):
        return result
    from jcr.reconstruct.added import extend

    memory_gb, count = options.reconstruct.memory_gb, len(result.capture)
    reconstruction = extend(result.reconstruction, result.hand_eye, count, added, device, progress, memory_gb)
    write_added(added, result.capture)
    return replace(result, reconstruction=reconstruction)


def _cloud(result: RunResult, options: RunOptions, progress: Progress) -> tuple[PointCloud, tuple[str, ...]]:
    """The labelled cloud, and what the user should know of its labels."""
    capture, reconstruction, hand_eye = result.capture, result.reconstruction, result.hand_eye
    given = image_labels(capture, reconstruction, hand_eye, options.segment, progress)
    labels, names = (None, ("none",)) if given is None else (given.labels, given.names)
    cloud = point_cloud(capture, reconstruction, hand_eye, labels, options.cloud, names)
    cloud, notes = label_cloud(cloud, options.segment)
    added = reconstruction.image_index >= len(capture)
    if added.any() and options.segment.segments in ("auto", "labels") and given is not None:
        notes += ("images added later have no label images; --segments tabletop labels what they show, too",)
    return cloud, notes


def _measured(cloud: PointCloud, calibration: CalibrationFile) -> Measured:
    uncertainty = calibration.uncertainty
    return measure_cloud(cloud, 0.0 if uncertainty is None else uncertainty.scale_std_percent / 100)


def _report(result: RunResult, folder: RunFolder, options: RunOptions, progress: Progress) -> RunResult:
    from jcr.report.html import report_html

    start = time.perf_counter()
    progress("report", 0.0)
    folder.keep_report(report_html(result, _told(options)))
    content = _timed(result.calibration, "report", start)
    folder.amend_calibration(content)
    progress("report", 1.0)
    return replace(result, calibration=content)


def _report_failure(
    capture: Capture, failed: CalibrationFile, folder: RunFolder, options: RunOptions
) -> None:
    from jcr.report.html import failed_report_html

    folder.keep_report(failed_report_html(capture, failed, _told(options)))


def _told(options: RunOptions) -> dict[str, Mapping[str, Any]]:
    """The options that decide the calibration, a stage each."""
    return {"reconstruct": asdict(options.reconstruct), "calibrate": asdict(options.calibrate)}


def _timed(content: CalibrationFile, stage: str, start: float, notes: Sequence[str] = ()) -> CalibrationFile:
    """With the seconds of one more stage, and what it found worth a warning."""
    timings = content.timings_s | {stage: _seconds_since(start)}
    return content.model_copy(update={"timings_s": timings, "warnings": [*content.warnings, *notes]})


def _seconds_since(start: float) -> float:
    return round(time.perf_counter() - start, 3)


def _with_backend(options: RunOptions | None, backend: str | None, capture: Capture) -> RunOptions:
    """The options with the back end of the call, or the one that takes the capture's own camera poses."""
    options = options or RunOptions()
    if backend is not None:
        return replace(options, reconstruct=replace(options.reconstruct, backend=backend))
    if capture.cameras is not None and (options.reconstruct.backend, options.reconstruct.weights) == (
        "auto",
        None,
    ):
        given = replace(options.reconstruct, backend="given", weights=str(capture.cameras.resolve()))
        return replace(options, reconstruct=given)
    return options
