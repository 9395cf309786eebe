"""Stage of the map: from a calibrated reconstruction to the labelled cloud, the map, and the measured objects."""

from concurrent.futures import ThreadPoolExecutor

from jcr.allocator import give_back
from jcr.depth.measured import with_measured_depth
from jcr.errors import InputError
from jcr.progress import Progress
from jcr.reconstruct import device_of
from jcr.run_folder import RunOptions, RunResult
from jcr.scene.cloud import point_cloud
from jcr.segments.measure import measure_objects
from jcr.segments.segments import image_labels, label_cloud
from jcr.segments.tabletop import fit_support


def make_map(result: RunResult, options: RunOptions, progress: Progress) -> tuple[RunResult, list[str]]:
    """Return the result with cloud, map and measured objects, with the images that were added later; and remarks.

    Raises InputError where no point is confident enough, or the options leave nothing to map.
    """
    from jcr.scene.build import build_scene  # torch takes seconds, and is asked for by maps alone

    assert options.map is not None  # or this stage is left out
    device = device_of(options.reconstruct)
    capture, hand_eye, reconstruction = result.capture, result.hand_eye, result.reconstruction
    if len(result.added):
        from jcr.depth.added import extend

        reconstruction = extend(reconstruction, hand_eye, len(capture), result.added, progress)
    reconstruction, remarks = with_measured_depth(capture, reconstruction, hand_eye)
    given = image_labels(capture, reconstruction, hand_eye, options.segment, progress)
    labels, names = (None, ("none",)) if given is None else (given.labels, given.names)
    cloud = point_cloud(capture, reconstruction, hand_eye, labels, options.cloud, names)
    try:
        support = fit_support(cloud)
    except InputError:
        support = None
    cloud, notes = label_cloud(cloud, options.segment, support)
    notes = [*remarks, *notes]
    if len(result.added) and options.segment.segments in ("auto", "labels") and given is not None:
        notes.append(
            "images added later have no label images; --segments tabletop labels what they show, too"
        )
    give_back()
    with ThreadPoolExecutor(1) as beside:
        sizes = None if support is None else beside.submit(measure_objects, cloud, result.scale_std, support)
        scene = build_scene(cloud, options.map, progress, device=device)
        measured = None if sizes is None else sizes.result()
    return result.with_parts(cloud=cloud, scene=scene, measured=measured), notes
