"""Stage of the map: from a calibrated reconstruction to the labelled cloud, the map, and the measured objects."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from jcr.allocator import give_back
from jcr.calibration.record import Calibration
from jcr.depth.measured import with_measured_depth
from jcr.depth.options import DepthOptions
from jcr.errors import InputError
from jcr.progress import Progress
from jcr.reconstruct import device_of
from jcr.records import Capture, PointCloud
from jcr.results import RunOptions, RunResult
from jcr.scene.cloud import point_cloud
from jcr.scene.map_file import require_packages
from jcr.segments.measure import Measurement, measure_objects
from jcr.segments.segments import image_labels, label_cloud
from jcr.segments.tabletop import Support, fit_support

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap


@dataclass(frozen=True)
class MapResult:
    """Result of the stage of the map."""

    cloud: PointCloud
    scene: "SceneMap"
    measured: Measurement | None
    """None where no plane carries the scene."""
    notes: tuple[str, ...]
    """Remarks on the labels."""


def require_map(options: DepthOptions) -> None:
    """Raise InputError, before any work, where no map can be made: no torch, or no dense depth wanted."""
    require_dense(options)
    require_packages("the map", "; `jcr run` and `jcr calibrate` calibrate without it")


def require_dense(options: DepthOptions) -> None:
    """Raise InputError where a map is wanted, and the dense depth that it needs is not."""
    if not options.dense:
        raise InputError("--no-dense: the map needs dense depth; leave it out, or add --no-map")


def make_map(result: RunResult, added: Capture, options: RunOptions, progress: Progress) -> MapResult:
    """Build the map of a calibrated run and of images that were added to it later.

    Raises InputError where no point is confident enough, or the options leave nothing to map.
    """
    from jcr.scene.build import build_scene  # torch takes seconds, and is asked for by maps alone

    assert options.map is not None  # or this stage is left out
    device = device_of(options.reconstruct)
    result = _extended(result, added, options, progress)
    reconstruction, remarks = with_measured_depth(result.capture, result.reconstruction, result.hand_eye)
    cloud, support, notes = _cloud(replace(result, reconstruction=reconstruction), options, progress)
    give_back()
    with ThreadPoolExecutor(1) as beside:
        sizes = None if support is None else beside.submit(measured, cloud, result.calibration, support)
        scene = build_scene(cloud, options.map, progress, device=device)
        return MapResult(cloud, scene, sizes and sizes.result(), (*remarks, *notes))


def measured(cloud: PointCloud, calibration: Calibration, support: Support | None = None) -> Measurement:
    """Measure the support plane, found where it is not given, and the objects on it; raise InputError without one."""
    uncertainty = calibration.uncertainty
    return measure_objects(
        cloud, 0.0 if uncertainty is None else uncertainty.scale_std_percent / 100, support
    )


def _extended(result: RunResult, added: Capture, options: RunOptions, progress: Progress) -> RunResult:
    """Return the result with the added images in the reconstruction."""
    if not len(added):
        return result
    from jcr.depth.added import extend

    count = len(result.capture)
    reconstruction = extend(result.reconstruction, result.hand_eye, count, added, progress)
    return replace(result, reconstruction=reconstruction)


def _cloud(
    result: RunResult, options: RunOptions, progress: Progress
) -> tuple[PointCloud, Support | None, tuple[str, ...]]:
    """Return the labelled cloud, its support plane if there is one, and remarks on the labels."""
    capture, reconstruction, hand_eye = result.capture, result.reconstruction, result.hand_eye
    given = image_labels(capture, reconstruction, hand_eye, options.segment, progress)
    labels, names = (None, ("none",)) if given is None else (given.labels, given.names)
    cloud = point_cloud(capture, reconstruction, hand_eye, labels, options.cloud, names)
    try:
        support = fit_support(cloud)
    except InputError:
        support = None
    cloud, notes = label_cloud(cloud, options.segment, support)
    added = reconstruction.image_index >= len(capture)
    if added.any() and options.segment.segments in ("auto", "labels") and given is not None:
        notes += ("images added later have no label images; --segments tabletop labels what they show, too",)
    return cloud, support, notes
