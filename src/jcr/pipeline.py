"""The stages in order, each timed, from a capture to a run folder that any of them can start again from.

capture -> reconstruct -> calibrate -> densify -> map -> report
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from jcr import __version__, stages
from jcr.calibration.calibration_json import calibration_file
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.calibration.poses import calibrate_poses as calibrate_poses_stage
from jcr.calibration.poses import is_one
from jcr.capture.added import read_added, with_images
from jcr.cell.added import camera_of, keep_camera, read_added_cameras
from jcr.errors import NotTrustedError
from jcr.progress import Progress, silent
from jcr.records import Capture, PosePairs
from jcr.represent.options import CloudOptions, MapOptions
from jcr.results import PosesResult, RunOptions, RunResult
from jcr.run_folder import RunFolder, held
from jcr.segment.options import SegmentOptions

if TYPE_CHECKING:
    from jcr.segment.measure import Measured


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
    options = (options or RunOptions()).for_capture(capture, backend)
    check_options(options.calibrate)
    if capture.mount == "base":  # what it sees moves with the gripper: there is no map in the base frame
        options = replace(options, map=None)
    if options.map is not None:
        from jcr.mapping import require_map

        require_map(options.depth)
    with held(Path(out)) as folder:
        capture = folder.keep_capture(capture)
        added = None if options.map is None else read_added(folder.path, capture)
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
    options = replace(options or RunOptions(), map=None)
    return run(capture, out, options, backend=backend, progress=progress)


def calibrate_poses(
    pairs: PosePairs, out: str | Path, options: CalibrateOptions | None = None
) -> PosesResult:
    """calibration.json and report in the folder `out` from camera poses that were given, without images."""
    from jcr.report.html import poses_report_html

    with held(Path(out)) as folder:
        start = time.perf_counter()
        hand_eye = calibrate_poses_stage(pairs, options)
        timings = {"calibrate": round(time.perf_counter() - start, 3)}
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
    calibration, and are used in every later map of the folder. Dense depth is estimated if the folder has none.
    """
    from jcr.mapping import require_map

    before = RunFolder(Path(out))
    options = RunOptions.of(before.options(), cloud=cloud, map=map or MapOptions(), segment=segment)
    require_map(options.depth)
    capture = before.capture()
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
    before, report = RunFolder(Path(out)), progress or silent
    options, capture = RunOptions.of(before.options(), map=None), before.capture()
    if (doubt := before.calibration().doubt) is not None:
        raise NotTrustedError(
            f"{out}: its calibration is rejected, so no camera can be located with it: {doubt}"
        )
    with held(Path(out)) as folder:
        added = read_added_cameras(folder.path, capture)
        taken = [capture.camera_name, *(camera.name for camera in (*capture.others, *added))]
        file = None if intrinsics is None else Path(intrinsics)
        camera = camera_of(name, [Path(picture) for picture in pictures], file, taken)
        result = stages.calibrated(capture, folder, options, report)
        located = stages.cameras(result, (*added, camera), folder, options, report)
        assert located is not None
        if (found := located.cameras[-1]).doubt is not None:
            raise NotTrustedError(f"{name}: {found.doubt}")
        keep_camera(folder.path, capture, camera)
        result = stages.located(result, folder, options, report)
        if folder.has_map():
            from jcr.mapping import measured

            cloud, scene = folder.cloud(), folder.scene()
            result = replace(result, cloud=cloud, scene=scene, measured=measured(cloud, result.calibration))
        return stages.reported(result, folder, options, report)


def measure(out: str | Path) -> "Measured":
    """Measure the support plane of a run and the objects on it, from its cloud and its calibration.

    Raises InputError if there is no map, or if there is no support plane.
    """
    from jcr.mapping import measured

    folder = RunFolder(Path(out))
    return measured(folder.cloud(), folder.calibration())


def _all_stages(
    capture: Capture, added: Capture | None, folder: RunFolder, options: RunOptions, progress: Progress
) -> RunResult:
    """`added` are the images of the map alone; None: there is no map."""
    result = stages.calibrated(capture, folder, options, progress)
    if capture.mount != "base":
        result = stages.located(result, folder, options, progress)
    if added is not None:
        result = stages.densified(result, folder, options, progress)
        result = stages.mapped(result, added, folder, options, progress)
    return stages.reported(result, folder, options, progress)
