"""The stages in order, each timed, from a capture to a run folder that any of them can start again from.

capture -> reconstruct -> calibrate -> densify -> map -> report
"""

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jcr import __version__
from jcr.calibration.cues import check_known_length
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.calibration.poses import calibrate_poses as calibrate_poses_stage
from jcr.calibration.poses import is_one
from jcr.calibration.record import calibration_of
from jcr.capture.added import read_added, with_images
from jcr.capture.options import ReadOptions
from jcr.capture.read import read_capture
from jcr.cell.added import camera_of, keep_camera, read_added_cameras
from jcr.errors import InputError, RejectedError
from jcr.extras import is_installed
from jcr.options import checked_options
from jcr.pipeline import stages
from jcr.pipeline.selection import NothingFoundError
from jcr.progress import Progress, silent
from jcr.reconstruct import BackendName, check_board
from jcr.records import Capture, PosePairs
from jcr.results import PosesResult, RunOptions, RunResult, SavedRun, load_run
from jcr.run_folder import CAPTURE, REPORT, RunFolder, locked
from jcr.scene.options import CloudOptions, MapOptions
from jcr.segments.options import SegmentOptions

if TYPE_CHECKING:
    from jcr.segments.measure import Measurement


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
    `out` if capture and options are unchanged. Without torch there is no map, and a note says how to add it.
    `calibrated` is called with the calibration before depth and map are made. Raises InputError if the input cannot be
    used, and RejectedError if no camera poses are found; calibration.json then contains the reason.
    """
    options = checked_options(options, RunOptions)
    check_options(options.calibrate)
    check_board(options.reconstruct)
    capture = _capture_of(capture, Path(out))
    check_known_length(capture, options.calibrate.known_length)
    options, missing = _possible(options.for_capture(capture, backend), capture)
    with locked(Path(out)) as folder, ThreadPoolExecutor(1) as beside:
        # Torch takes more than a second to import, the loops of depth as long to load, and COLMAP leaves a core idle.
        importing = None if options.map is None else beside.submit(_why_no_map, options.estimates_depth)
        capture = folder.keep_capture(capture)
        added = None if options.map is None else read_added(folder.path, capture)
        try:
            result = stages.calibrated(capture, folder, options, progress or silent)
        except NothingFoundError:
            folder.keep_complete(capture, options)
            raise
        missing = missing if importing is None else importing.result()
        if missing is not None:
            options, added, result = replace(options, map=None), None, result.noted(missing)
        if calibrated is not None:
            calibrated(result)
        result = _after_calibration(result, added, folder, options, progress or silent)
        folder.keep_complete(result.capture, options)
        return result


def finished(capture: Capture, out: str | Path, options: RunOptions) -> SavedRun | None:
    """Return the run in the folder `out` if it was made from this capture with these options and nothing has changed."""
    if not (Path(out) / REPORT).is_file():
        return None
    options, _ = _possible(options.for_capture(capture), capture)
    with locked(Path(out)) as folder:
        if not folder.is_complete(folder.keep_capture(capture), options):
            return None
    return load_run(out)


def _possible(options: RunOptions, capture: Capture) -> tuple[RunOptions, str | None]:
    """Return the options, without the map where none can be made, and the package to install for it."""
    # What a camera on the base sees moves with the gripper, not with the base.
    if options.map is None or capture.mount == "base":
        return replace(options, map=None), None
    from jcr.pipeline.mapping import require_dense
    from jcr.scene.map_file import PACKAGES

    require_dense(options.depth)
    if all(map(is_installed, PACKAGES)):
        return options, None
    return replace(options, map=None), _why_no_map()


def _why_no_map(estimate_depth: bool = False) -> str | None:
    """Return the package to install before a map can be made; None where all is imported and its loops are compiled."""
    from jcr.scene.map_file import require_packages

    if estimate_depth:
        from jcr.depth.densify import compile_loops

        compile_loops()
    try:
        require_packages("the map", ", then `jcr map`")
    except InputError as error:
        return f"no map was made: {error}"
    import jcr.scene.build  # noqa: F401

    return None


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


def calibrate_poses(
    pairs: PosePairs, out: str | Path, options: CalibrateOptions | None = None
) -> PosesResult:
    """Write calibration.json and report to the folder `out`, from camera poses that were given, without images."""
    from jcr.report.html import poses_report_html

    with locked(Path(out)) as folder:
        start = time.perf_counter()
        hand_eye = calibrate_poses_stage(pairs, options)
        timings = {"calibrate": round(time.perf_counter() - start, 3)}
        content = calibration_of(pairs, pairs, hand_eye, timings, __version__)
        folder.forget_reconstruction()
        folder.keep_calibration(content)
        result = PosesResult(
            out=folder.path,
            pairs=pairs,
            calibration=content,
            hand_eye=hand_eye,
            scale_is_one=hand_eye.converged and is_one(hand_eye),
        )
        folder.keep_report(poses_report_html(result, {"calibrate": asdict(options or CalibrateOptions())}))
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
    from jcr.pipeline.mapping import require_map

    before = RunFolder(Path(out))
    options = RunOptions.of(
        before.options(),
        cloud=checked_options(cloud, CloudOptions),
        map=checked_options(map, MapOptions),
        segment=checked_options(segment, SegmentOptions),
    )
    require_map(options.depth)
    capture = before.capture()
    with locked(Path(out)) as folder:
        added = read_added(folder.path, capture)
        for path in add:
            added = with_images(added, Path(path), checked_options(read, ReadOptions))
        result = stages.calibrated(capture, folder, options, progress or silent)
        return _after_calibration(result, added, folder, options, progress or silent)


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
    before, report = RunFolder(Path(out)), progress or silent
    options, capture = RunOptions.of(before.options(), map=None), before.capture()
    if (doubt := before.calibration().doubt) is not None:
        raise RejectedError(
            f"{out}: its calibration is rejected, so no camera can be located with it: {doubt}"
        )
    with locked(Path(out)) as folder:
        added = read_added_cameras(folder.path, capture)
        taken = [capture.camera_name, *(camera.name for camera in (*capture.others, *added))]
        file = None if intrinsics is None else Path(intrinsics)
        camera = camera_of(name, files, file, taken)
        result = stages.calibrated(capture, folder, options, report)
        located = stages.cameras(result, (*added, camera), folder, options, report)
        assert located is not None
        if (found := located.cameras[-1]).doubt is not None:
            raise RejectedError(f"{name}: {found.doubt}")
        keep_camera(folder.path, capture, camera)
        result = stages.located(result, folder, options, report)
        if folder.has_map():
            from jcr.pipeline.mapping import measured

            cloud, scene = folder.cloud(), folder.scene()
            result = replace(result, cloud=cloud, scene=scene, measured=measured(cloud, result.calibration))
        return stages.reported(result, folder, options, report)


def measure(out: str | Path) -> "Measurement":
    """Measure the support plane of a run and the objects on it, from its cloud and its calibration.

    Raises InputError if there is no map, or if there is no support plane.
    """
    from jcr.pipeline.mapping import measured

    folder = RunFolder(Path(out))
    return measured(folder.cloud(), folder.calibration())


def _capture_of(capture: Capture | str | Path, out: Path) -> Capture:
    """Return a capture as it is, or read it from a path; images of a recording are put into the run folder."""
    if isinstance(capture, Capture):
        return capture
    if not isinstance(capture, str | Path):
        raise InputError(f"{capture!r:.80}: give a capture of jcr.read_capture, or its path")
    with locked(out):
        return read_capture(capture, into=out / CAPTURE)


def _after_calibration(
    result: RunResult, added: Capture | None, folder: RunFolder, options: RunOptions, progress: Progress
) -> RunResult:
    """Run the stages after the calibration; `added` are images of the map alone, None without a map."""
    if result.capture.mount != "base":
        result = stages.located(result, folder, options, progress)
    if added is not None:
        result = stages.densified(result, folder, options, progress)
        result = stages.mapped(result, added, folder, options, progress)
    return stages.reported(result, folder, options, progress)
