"""The stages in order, from a capture to a run folder that any of them can start again from.

capture -> reconstruct -> calibrate -> cloud -> map -> report
"""

import fcntl
import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from jcr import __version__
from jcr.attempts import best_reconstruction
from jcr.calibration.calibration_json import (
    CalibrationFile,
    calibration_file,
    failed_file,
    read_calibration,
    write_calibration,
)
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.stage import calibrate as calibrate_stage
from jcr.calibration.stage import calibrate_poses as calibrate_poses_stage
from jcr.capture.added import FOLDER as ADDED
from jcr.capture.added import read_added, with_images, write_added
from jcr.capture.capture_json import kept
from jcr.capture.read import read_capture
from jcr.errors import InputError, NotTrustedError
from jcr.export.points import read_cloud, write_cloud
from jcr.extras import is_installed
from jcr.files import remove_unfinished, write_text
from jcr.memory import give_back
from jcr.progress import Progress, silent
from jcr.reconstruct.backends import ReconstructOptions, candidates, device_of
from jcr.reconstruct.reconstruction_npz import FORMAT, read_reconstruction, write_reconstruction
from jcr.records import Capture, HandEye, PointCloud, PosePairs, Reconstruction
from jcr.represent.cloud import point_cloud
from jcr.represent.map_file import require_packages
from jcr.represent.options import CloudOptions, MapOptions
from jcr.results import PosesResult, RunResult
from jcr.segment.measure import Measured
from jcr.segment.measure import measure as measure_cloud
from jcr.segment.options import SegmentOptions
from jcr.segment.segments import image_labels, label_cloud

CAPTURE = "capture"
"""In the run folder: images and poses that were read from another format than capture.json."""
STATE = "run.json"
"""In the run folder: the capture, and what each finished stage was made from."""
OF_CALIBRATION = ("cloud.ply", "map.safetensors", "report.html")
"""In the run folder: what holds of one calibration alone."""
LOCK = ".lock"
"""In the run folder: held by the run that writes there."""


@dataclass(frozen=True)
class RunOptions:
    """The options of every stage."""

    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions | None = field(default_factory=MapOptions)
    """None: no cloud and no map, and no dense depth, which only these need."""
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
    that cannot be used, or where the map is asked for and torch is not installed, and NotTrustedError when no
    camera poses are found (calibration.json then says why).
    """
    options = _with_backend(options, backend, capture)
    if options.map is None:
        options = _sparse(options)
    else:
        require_map(options.reconstruct)
    with run_folder(Path(out)) as folder:
        capture = kept(capture, folder / CAPTURE)
        added = read_added(folder, capture)
        result = _calibrate(capture, folder, options, progress)
        if options.map is not None:
            result = _map(capture, added, folder, options, options.map, result, progress)
        _report(capture, result, progress)
        return result


def calibrate(
    capture: Capture,
    out: str | Path,
    options: RunOptions | None = None,
    *,
    backend: str | None = None,
    progress: Progress | None = None,
) -> RunResult:
    """Reconstruction and calibration of a capture in the folder `out`; raises as `run` does.

    Without torch there is no dense depth, which only a later map needs.
    """
    options = _with_backend(options, backend, capture)
    if not is_installed("torch"):
        options = _sparse(options)
    with run_folder(Path(out)) as folder:
        return _calibrate(kept(capture, folder / CAPTURE), folder, options, progress)


def calibrate_poses(
    pairs: PosePairs, out: str | Path, options: CalibrateOptions | None = None
) -> PosesResult:
    """calibration.json in the folder `out` from camera poses that were given, without images."""
    start = time.perf_counter()
    with run_folder(Path(out)) as folder:
        hand_eye = calibrate_poses_stage(pairs, options)
        timings = {"calibrate": round(time.perf_counter() - start, 3)}
        content = calibration_file(pairs, pairs, hand_eye, timings, __version__)
        _forget_reconstruction(folder)
        _replace_calibration(folder, content)
        _write_log(folder, content)
        return PosesResult(folder, content, hand_eye)


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
    require_map()
    capture = read_capture_of(out)
    with run_folder(Path(out)) as folder:
        made = options_of(out)
        options = replace(
            made,
            reconstruct=replace(made.reconstruct, dense=True),
            cloud=cloud or CloudOptions(),
            segment=segment or SegmentOptions(),
        )
        added = with_images(read_added(folder, capture), add)
        result = _calibrate(capture, folder, options, progress)
        result = _map(capture, added, folder, options, map or MapOptions(), result, progress)
        _report(capture, result, progress)
        return result


def require_map(options: ReconstructOptions | None = None) -> None:
    """InputError, before any work, where no map can be made: no torch, or no dense depth wanted."""
    if options is not None and not options.dense:
        raise InputError("--no-dense: the map needs dense depth; leave it out, or add --no-map")
    require_packages("the map", "; `jcr run --no-map` and `jcr calibrate` do without")


def _sparse(options: RunOptions) -> RunOptions:
    return replace(options, reconstruct=replace(options.reconstruct, dense=False))


def read_capture_of(out: str | Path) -> Capture:
    """The capture that a run folder was made from; InputError where there is no run, or no such capture any more."""
    state = _read_state(Path(out))
    if "capture" not in state:
        raise InputError(f"{out}: holds no run; make one with `jcr run` or `jcr calibrate`")
    return read_capture(state["capture"])


def measure(out: str | Path) -> Measured:
    """The support plane of a run and what stands on it, from its cloud and its calibration.

    Raises InputError where there is no map, and when no plane carries the scene.
    """
    cloud = read_cloud(Path(out) / "cloud.ply")
    return _measured(cloud, read_calibration(Path(out)))


def options_of(out: str | Path) -> RunOptions:
    """The options that a run folder's calibration was made with."""
    state = _read_state(Path(out))["options"]
    return RunOptions(ReconstructOptions(**state["reconstruct"]), CalibrateOptions(**state["calibrate"]))


def _calibrate(capture: Capture, folder: Path, options: RunOptions, progress: Progress | None) -> RunResult:
    report = progress or silent
    state = _read_state(folder)
    if state.get("reconstruct") == _made_from(capture, replace(options.reconstruct, dense=True)):
        options = replace(
            options, reconstruct=replace(options.reconstruct, dense=True)
        )  # it is there already
    made_from = _made_from(capture, options.reconstruct)
    start = time.perf_counter()
    try:
        if state.get("reconstruct") == made_from:
            reconstruction, hand_eye = read_reconstruction(folder / "reconstruction.npz"), None
        else:
            best = best_reconstruction(capture, options.reconstruct, options.calibrate, progress)
            reconstruction, hand_eye = best.reconstruction, best.hand_eye
            (folder / STATE).unlink(missing_ok=True)  # or it would vouch for a file that it does not know
            give_back()  # what the back end worked with
            write_reconstruction(folder / "reconstruction.npz", reconstruction)
        state = {
            "capture": str(capture.folder.resolve()),
            "reconstruct": made_from,
            "options": {"reconstruct": asdict(options.reconstruct), "calibrate": asdict(options.calibrate)},
        }
        write_text(folder / STATE, json.dumps(state, indent=2) + "\n")
        reconstructed = time.perf_counter()
        report("calibrate", 0.0)
        hand_eye = hand_eye or calibrate_stage(capture, reconstruction, options.calibrate)
        give_back()
        report("calibrate", 1.0)
    except NotTrustedError as error:
        if state.get("reconstruct") != made_from:  # what is there is another capture's, or of other options
            _forget_reconstruction(folder)
        timings = {"reconstruct": round(time.perf_counter() - start, 3)}
        failed = failed_file(capture, candidates(options.reconstruct)[-1], str(error), timings, __version__)
        _replace_calibration(folder, failed)
        _write_log(folder, failed)
        _report_failure(capture, folder, failed)
        raise
    timings = {
        "reconstruct": round(reconstructed - start, 3),
        "calibrate": round(time.perf_counter() - reconstructed, 3),
    }
    content = calibration_file(capture, reconstruction, hand_eye, timings, __version__)
    _replace_calibration(folder, content)
    _write_log(folder, content)
    return RunResult(folder, content, hand_eye, reconstruction)


def _map(
    capture: Capture,
    added: Capture,
    folder: Path,
    options: RunOptions,
    map_options: MapOptions,
    result: RunResult,
    progress: Progress | None,
) -> RunResult:
    from jcr.represent.build import build_scene

    start = time.perf_counter()
    reconstruction, device = result.reconstruction, device_of(options.reconstruct)
    if len(added):
        from jcr.reconstruct.added import extend

        reconstruction = extend(
            reconstruction,
            result.hand_eye,
            len(capture),
            added,
            device,
            progress or silent,
            options.reconstruct.memory_gb,
        )
        write_added(added, capture)
    cloud, notes = _cloud(capture, reconstruction, result.hand_eye, options, progress)
    write_cloud(folder / "cloud.ply", cloud)
    give_back()
    scene = build_scene(cloud, map_options, progress, device=device)
    scene.save(folder / "map.safetensors")
    timings = result.calibration.timings_s | {"map": round(time.perf_counter() - start, 3)}
    warnings = [*result.calibration.warnings, *notes]
    content = result.calibration.model_copy(update={"timings_s": timings, "warnings": warnings})
    write_calibration(folder / "calibration.json", content)
    _write_log(folder, content)
    try:
        measured = _measured(cloud, content)
    except InputError:  # no plane carries the scene
        measured = None
    return replace(result, calibration=content, cloud=cloud, scene=scene, measured=measured)


def _cloud(
    capture: Capture,
    reconstruction: Reconstruction,
    hand_eye: HandEye,
    options: RunOptions,
    progress: Progress | None,
) -> tuple[PointCloud, tuple[str, ...]]:
    """The labelled cloud, and what the user should know of its labels."""
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


def _report(capture: Capture, result: RunResult, progress: Progress | None) -> None:
    from jcr.report.html import report_html

    report = progress or silent
    report("report", 0.0)
    write_text(result.out / "report.html", report_html(capture, result))
    report("report", 1.0)


def _report_failure(capture: Capture, folder: Path, failed: CalibrationFile) -> None:
    from jcr.report.html import failed_report_html

    write_text(folder / "report.html", failed_report_html(capture, failed, folder))


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


@contextmanager
def run_folder(folder: Path) -> Iterator[Path]:
    """The folder, made and held, so that a second run on it writes nothing between the first one's files.

    What a killed run had begun to write is removed, and so is a new folder into which nothing came.
    """
    new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / LOCK).open("w")
    except (FileExistsError, NotADirectoryError):
        raise InputError(f"{folder}: is a file; name a folder for the results") from None
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); choose another folder") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"{folder}: another jcr is writing there; wait for it or choose another"
            ) from None
        for place in (folder, *(folder / CAPTURE).rglob("."), folder / ADDED):
            remove_unfinished(place)
        try:
            yield folder
        finally:
            if new and os.listdir(folder) == [LOCK]:
                shutil.rmtree(folder)


def _forget_reconstruction(folder: Path) -> None:
    for name in (STATE, "reconstruction.npz"):
        (folder / name).unlink(missing_ok=True)


def _replace_calibration(folder: Path, content: CalibrationFile) -> None:
    """Write calibration.json; what was made from another one goes first, so that the two are never mixed."""
    passing = {"timings_s", "warnings", "version"}
    try:
        same = read_calibration(folder).model_dump(exclude=passing) == content.model_dump(exclude=passing)
    except InputError:
        same = False
    if not same:
        for name in OF_CALIBRATION:
            (folder / name).unlink(missing_ok=True)
    write_calibration(folder / "calibration.json", content)


def _made_from(capture: Capture, options: ReconstructOptions) -> str:
    # What auto stands for changes with the weights that are on this machine.
    return fingerprint(capture, asdict(options) | {"backend": candidates(options)})


def fingerprint(capture: Capture, options: dict[str, Any]) -> str:
    """A hash of all that a stage's result depends on: pictures, poses, lens, options and version."""
    digest = hashlib.sha256()
    for name in capture.images:
        digest.update(name.encode() + b"\0" + hashlib.sha256((capture.folder / name).read_bytes()).digest())
    digest.update(capture.base_from_gripper.tobytes())
    lens = None if capture.intrinsics is None else asdict(capture.intrinsics)
    if (
        options["weights"] is not None
    ):  # gigabytes at times: size and date tell one file of that name from another
        weights = Path(options["weights"])
        files = sorted(weights.iterdir()) if weights.is_dir() else [weights] if weights.is_file() else []
        states = [[str(file), file.stat().st_size, file.stat().st_mtime_ns] for file in files]
        options = options | {"weights": states or options["weights"]}
    digest.update(json.dumps([lens, options, __version__, FORMAT], sort_keys=True).encode())
    return digest.hexdigest()


def _read_state(folder: Path) -> dict[str, Any]:
    try:
        state = json.loads((folder / STATE).read_text())
        return state if isinstance(state, dict) else {}
    except (OSError, ValueError, RecursionError):
        return {}  # without a state every stage is made again, which is always right


def _write_log(folder: Path, content: CalibrationFile) -> None:
    lines = [f"jcr {content.version}, back end {content.backend}"]
    lines += [f"{stage}: {seconds:.2f} s" for stage, seconds in content.timings_s.items()]
    lines += [f"{image.image}: {image.reason or 'used'}" for image in content.images]
    lines += [f"warning: {warning}" for warning in content.warnings]
    write_text(folder / "log.txt", "\n".join(lines) + "\n")
