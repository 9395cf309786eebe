"""Functions that run the stages of a run in order and write its folder; a later call reuses the finished files."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from jcr.backends import BackendName, ReconstructOptions, device_of
from jcr.calibration.calibrate import calibrate_pose_pairs
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.calibration.record import FailedCalibration
from jcr.capture.added_capture import with_added_images
from jcr.capture.formats.capture_json import kept, origin
from jcr.capture.formats.capture_json import read as read_kept
from jcr.capture.options import ReadOptions
from jcr.capture.read import read_capture
from jcr.cell.added_cameras import added_camera, keep_camera
from jcr.cell.cameras_json import write_cameras
from jcr.errors import InputError, RejectedError
from jcr.extras import is_installed
from jcr.files import as_path, locked, write_text
from jcr.options import checked_options
from jcr.pipeline.backend_selection import SIFT_SUFFICES, NothingFoundError, solved_pairs
from jcr.pipeline.reading_decision import decided_by_images
from jcr.pipeline.stages import (
    FIRST,
    REST,
    begun,
    finished,
    forget_reconstruction,
    is_unchanged,
    keep_calibration,
    keep_reconstruction,
    make,
    place,
)
from jcr.progress import Progress, silent
from jcr.records import Capture, PosePairs, Reconstruction
from jcr.result import CAPTURE, CLOUD, REPORT, RunOptions, RunResult
from jcr.scene.cloud import read_cloud
from jcr.scene.map_file import MAP_PACKAGES, require_packages
from jcr.scene.options import CloudOptions, MapOptions, check_cloud_options, check_map_options
from jcr.segments.options import SegmentOptions, check_segment_options

if TYPE_CHECKING:
    from jcr.segments.measure import Measurement


def run(
    capture: Capture | str | Path,
    out: str | Path,
    options: RunOptions | Mapping[str, Any] | None = None,
    *,
    backend: BackendName | None = None,
    progress: Progress = silent,
    calibrated: Callable[[RunResult], None] | None = None,
) -> RunResult:
    """Calibrate a capture, or the capture at a path; write calibration, cloud, map and report to the folder `out`.

    `backend` ("auto", or a name of `jcr models`) replaces the one of `options`. A finished reconstruction or run in
    `out` is reused if capture and options are unchanged. Without torch there is no map, and a note says how to add it.
    `calibrated` is called with the calibrated result before depth and map are computed. Raises InputError if the input
    cannot be used, and RejectedError if no camera poses are found; calibration.json then contains the reason.
    """
    out = as_path(out, "out")
    options = checked_options(options, RunOptions)
    require_valid(options)
    if options.calibrate.scale is not None:
        raise InputError("scale: is for camera poses without images (samples); leave it out")
    if not isinstance(capture, Capture | str | Path):
        raise InputError(f"{capture!r:.80}: give a capture of jcr.read_capture, or its path")
    require_folder_of_results(out)
    if not isinstance(capture, Capture):
        with locked(out):
            capture = read_capture(capture, into=out / CAPTURE)
    own = options.reconstruct if backend is None else replace(options.reconstruct, backend=backend)
    options, missing = _possible(replace(options, reconstruct=own), capture, out)
    _require_own_run(capture, out)
    with locked(out):
        start, is_open = time.perf_counter(), bool(capture.candidates)
        capture, alone = _decided(capture, out, own, progress)
        decision_s = {"decide": round(time.perf_counter() - start, 3)} if is_open else {}
        result = begun(out, kept(capture, out / CAPTURE), options)
        if alone is not None and own.backend in ("auto", "colmap") and own.features in ("auto", "sift"):
            keep_reconstruction(result, alone)
        if is_unchanged(result):
            before = RunResult(out, capture=result.capture, is_unchanged=True)
            if isinstance(failed := before.calibration, FailedCalibration):
                raise NothingFoundError(RejectedError(str(failed.doubt)))
            return before
        if options.map is not None:
            # Torch and the compiled loops of depth take over a second each to load; COLMAP leaves a core free for them.
            threading.Thread(target=_load_map_code, daemon=True).start()
        else:
            result = result.with_parts(cloud=None, scene=None, measured=None)
        result = make(result, FIRST, progress)
        content = result.calibration.with_notes(*missing)
        result = result.with_parts(calibration=replace(content, timings_s=decision_s | content.timings_s))
        if calibrated is not None:
            calibrated(result)
        return finished(result, REST, progress)


def calibrate(
    capture: Capture | str | Path,
    out: str | Path,
    options: RunOptions | Mapping[str, Any] | None = None,
    *,
    backend: BackendName | None = None,
    progress: Progress = silent,
) -> RunResult:
    """Calibrate a capture without a map; write calibration and report to the folder `out`; raises as `run` does.

    `build_map` adds a map later.
    """
    options = replace(checked_options(options, RunOptions), map=None)
    return run(capture, out, options, backend=backend, progress=progress)


def calibrate_poses(
    pairs: PosePairs,
    out: str | Path,
    options: CalibrateOptions | None = None,
    method: Literal["default", "paper"] = "default",
) -> RunResult:
    """Calibrate from given camera poses, without images; write calibration.json and report to the folder `out`.

    `method` is that of RunOptions. Raises RejectedError if the published method gives no calibration.
    """
    from jcr.report.html import report_html

    out = as_path(out, "out")
    with locked(out):
        start = time.perf_counter()
        content = solved_pairs(pairs, options) if method == "paper" else calibrate_pose_pairs(pairs, options)
        timings_s = {"calibrate": round(time.perf_counter() - start, 3)}
        content = replace(content, timings_s=timings_s, frame_names=pairs.frame_names)
        forget_reconstruction(out)
        keep_calibration(out, content)
        result = RunResult(out, capture=pairs, calibration=content, reconstruction=pairs)
        page = report_html(result, {"calibrate": asdict(options or CalibrateOptions())})
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
    progress: Progress = silent,
) -> RunResult:
    """Build cloud, map and report of the run folder `out` again, from its capture and calibration.

    `add` are captures of later images of the scene, oldest first, which are read with the options `read`. They change
    the map of this and later calls, but not the calibration. Dense depth is estimated if the folder has none.
    """
    before = RunResult(out)
    options = replace(
        before.state.options,
        cloud=checked_options(cloud, CloudOptions),
        map=checked_options(map, MapOptions),
        segment=checked_options(segment, SegmentOptions),
    )
    require_valid(options)
    require_packages("the map", "; `jcr run` and `jcr calibrate` calibrate without it")
    with locked(before.out):
        result = begun(before.out, before.capture, options)
        for path in add:
            added = with_added_images(result.added, as_path(path, "add"), checked_options(read, ReadOptions))
            result = result.with_parts(added=added)
        return finished(make(result, FIRST, progress), REST, progress)


def add_camera(
    out: str | Path,
    name: str,
    images: Sequence[str | Path] | str | Path = (),
    intrinsics: str | Path | None = None,
    *,
    progress: Progress = silent,
) -> RunResult:
    """Locate a fixed camera in the base frame, from its images of the scene of the run folder `out`.

    `name` is the new camera's name, `images` one or several files. `intrinsics` is a file as for `camera_info` of
    ReadOptions; None: the intrinsics are estimated. The camera is added to the run, to cameras.json and to the report.
    Raises InputError if the images are not from one camera or do not fit the intrinsics. Raises RejectedError, without
    writing anything, if the images do not determine the camera's pose or the run is rejected.
    """
    files = [as_path(one, name) for one in ([images] if isinstance(images, str | Path) else images)]
    if not files:
        raise InputError(f"{name}: no images; give one or more that the camera took")
    before = RunResult(out)
    if before.capture.mount == "base":
        raise InputError(
            f"{out}: its camera watches the gripper; list the others beside it under cameras in capture.json, with an "
            "image for each frame, and calibrate again"
        )
    options = replace(before.state.options, map=None)
    if (doubt := before.calibration.doubt) is not None:
        raise RejectedError(f"{out}: its calibration is rejected and locates no camera: {doubt}")
    with locked(before.out):
        known = begun(before.out, before.capture, options)
        file = None if intrinsics is None else as_path(intrinsics, "intrinsics")
        taken = [known.capture.camera_name, *(one.name for one in known.others)]
        with TemporaryDirectory() as scratch:
            camera = added_camera(name, files, file, known.capture, taken, Path(scratch))
            result = make(known.with_parts(others=(*known.others, camera)), FIRST, progress)
            located = place(result, progress)
            if (found := located.cameras[-1]).doubt is not None:
                raise RejectedError(f"{name}: {found.doubt}")
            keep_camera(before.out, known.capture, camera)
        write_cameras(before.out, located)
        others = RunResult(before.out, capture=known.capture).others
        return finished(result.with_parts(others=others, cameras=located), ["report"], progress)


def measure(out: str | Path) -> "Measurement":
    """Measure support plane and objects of the run folder `out`; raise InputError without a map or support plane."""
    from jcr.segments.measure import measure_objects

    run = RunResult(out)
    std = run.scale_std  # raises InputError if there is no run
    return measure_objects(read_cloud(run.out / CLOUD), std)


def require_valid(options: RunOptions) -> None:
    """Raise InputError for options that a late stage would refuse, before time is spent on the images."""
    check_options(options.calibrate)
    if options.reconstruct.board is not None:
        from jcr.boards.detection import boards

        boards(options.reconstruct.board)  # raises InputError if the option does not describe a board
    if options.map is not None:
        check_cloud_options(options.cloud)
        is_published = "paper" in (options.method, options.map.preset)
        check_map_options(replace(options.map, preset="paper" if is_published else "default"))
        check_segment_options(options.segment)
    if options.reconstruct.device == "cuda":
        device_of(options.reconstruct)


def require_folder_of_results(out: Path) -> None:
    """Raise InputError if `out` is a capture."""
    if (out / "capture.json").is_file():
        raise InputError(f"{out}: is a capture, and the results need a folder of their own; name another one")


def _require_own_run(capture: Capture, out: Path) -> None:
    """Raise InputError if the folder `out` holds the run of another capture, whose results would be lost."""
    other = None
    with suppress(InputError):  # there is no run
        other = Path(RunResult(out).state.capture)
    if other is None or capture.source is not None or not other.is_dir():
        return
    if capture.folder.resolve() not in (other, origin(other).resolve()):
        raise InputError(f"{out}: holds the run of {other}; name another folder, or delete it")


def _decided(
    capture: Capture, out: Path, options: ReconstructOptions, report: Progress
) -> tuple[Capture, Reconstruction | None]:
    """Return the capture with a decided reading, and the reconstruction that decided it if it has nearly all images.

    The decision that the run folder keeps is taken again while the file and its possible readings are the same.
    """
    if not capture.candidates:
        return capture, None
    if (known := _decided_before(capture, out / CAPTURE)) is not None:
        return known, None
    capture, made = decided_by_images(capture, options.board, options.seed, report)
    is_enough = made is not None and len(made.image_index) >= SIFT_SUFFICES * len(capture)
    return capture, made if is_enough else None


def _decided_before(capture: Capture, folder: Path) -> Capture | None:
    """Return the capture with the reading that a folder keeps for the same images and numbers; None without one."""
    with suppress(InputError, OSError, ValueError):
        before = read_kept(folder)
        rows = [capture.images.index(name) for name in before.images]
        images = ((capture.folder / name, folder / name) for name in before.images)
        if (
            before.reading is None
            or before.mount != capture.mount
            or not all(a.read_bytes() == b.read_bytes() for a, b in images)
        ):
            return None
        for _, poses in capture.candidates:
            if len(poses) == len(capture) and np.allclose(poses[rows], before.base_from_gripper, atol=1e-9):
                chosen = replace(capture.of_rows(rows), base_from_gripper=poses[rows], reading=before.reading)
                return replace(chosen, candidates=())
    return None


def _possible(options: RunOptions, capture: Capture, out: Path) -> tuple[RunOptions, tuple[str, ...]]:
    """Return the options, without a map if none can be made, and a note (in a tuple) if packages for it are missing.

    A fixed camera has no map.
    """
    # A fixed camera observes the object that the gripper carries; a map would not be fixed in the base frame.
    if options.map is None or capture.mount == "base":
        return replace(options, map=None), ()
    try:
        if not all(map(is_installed, MAP_PACKAGES)):
            require_packages("the map", f", then `jcr map {out}`")
    except InputError as error:
        return replace(options, map=None), (f"no map was made: {error}",)
    return options, ()


def _load_map_code() -> None:
    """Import the modules that depth and map need; errors are ignored, because the stages raise them again."""
    with suppress(Exception):
        from jcr.depth.densify import compile_loops

        compile_loops()
        import jcr.scene.build  # noqa: F401
