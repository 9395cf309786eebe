"""Selection of the segments: label images of the user, geometry, or Segment Anything."""

from jcr.errors import InputError
from jcr.progress import Progress
from jcr.records import Capture, HandEye, PointCloud, Reconstruction
from jcr.segments.labels import LabelImages, read_labels
from jcr.segments.options import SegmentOptions
from jcr.segments.tabletop import Support, label_tabletop


def image_labels(
    capture: Capture,
    reconstruction: Reconstruction,
    hand_eye: HandEye,
    options: SegmentOptions,
    progress: Progress | None = None,
) -> LabelImages | None:
    """Return labels at the pointmaps' pixels; None where geometry or nothing labels the cloud.

    Raises InputError when label images are asked for and missing, or Segment Anything cannot be loaded.
    """
    if options.segments in ("auto", "labels"):
        labels = read_labels(capture, reconstruction)
        if labels is None and options.segments == "labels":
            raise InputError(
                f"{capture.folder / 'labels'}: holds no PNG; put labels/NAME.png there for every image, "
                "or choose --segments tabletop"
            )
        return labels
    if options.segments == "sam":
        from jcr.segments.sam import load_sam, sam_labels

        return sam_labels(load_sam(options.sam_weights), reconstruction, hand_eye, progress)
    return None


def label_cloud(
    cloud: PointCloud, options: SegmentOptions, support: Support | None = None
) -> tuple[PointCloud, tuple[str, ...]]:
    """Return the cloud with labels from its geometry, where nothing else gave any, and notes for the user.

    `support` is found here where it is not given. Raises InputError when the tabletop was asked for and no plane
    carries the scene.
    """
    if options.segments not in ("auto", "tabletop") or len(cloud.label_names) > 1:
        return cloud, ()
    try:
        labelled = label_tabletop(cloud, options.tabletop, support)
    except InputError as error:
        if options.segments == "tabletop":
            raise
        return cloud, (f"no segments: {error}",)
    if len(labelled.label_names) == 2:
        return labelled, ("no object stands out above the table; the map has the segment table alone",)
    return labelled, ()
