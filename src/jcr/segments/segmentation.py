"""Segmentation of a scene by the user's label images (one PNG per image), by geometry, or by Segment Anything."""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt16
from numpy import ndarray

from jcr.calibration.record import Calibration, PublishedCalibration
from jcr.camera import project, rays
from jcr.capture.images import read_one_channel
from jcr.errors import InputError
from jcr.files import IMAGES, capture_file
from jcr.progress import Progress, silent
from jcr.records import Capture, PointCloud, Reconstruction
from jcr.segments.options import LabelImages, SegmentOptions
from jcr.segments.tabletop import Support, label_tabletop

MOST_LABELS = 1024
"""Largest number of labels; an image with more values is probably no label image."""


def read_labels(capture: Capture, reconstruction: Reconstruction) -> LabelImages | None:
    """Read the capture's label images `labels/NAME.png` at the pixels of the pointmaps; None if there are no PNG files.

    NAME is the image's path in the capture without a leading images/ and without suffix, and the nearest pixel is read.
    Label images have 8 or 16 bits and the image's size; 0 is no object. `labels/names.json` may name the labels: {"1":
    "mug", …}. Raises InputError if the label image of a registered image is missing, unreadable, of another size, or
    has labels beyond 1023, or if two images would share one.
    """
    folder = capture.folder / "labels"
    if not any(folder.rglob("*.png")):
        return None
    # Positions of the pointmap's pixels in the capture's image, where the nearest label is read.
    at_px = project(reconstruction.intrinsics, rays(reconstruction.dense.intrinsics)).astype(np.float32)
    labels = np.zeros(reconstruction.dense.confidence.shape, np.int64)
    names = label_names_of(capture.images)
    for k, row in enumerate(reconstruction.image_index):
        if row < len(capture):  # later rows are images that were added to the run
            label = _read_label(capture, capture.images[row], names[row])
            labels[k] = cv2.remap(label, at_px[..., 0], at_px[..., 1], cv2.INTER_NEAREST, borderValue=0)
    count = int(labels.max()) + 1
    names = {k: str(k) for k in range(1, count)} | {0: "none"} | _read_names(folder / "names.json")
    return labels, tuple(names[k] for k in range(count))


def label_names_of(images: Sequence[str]) -> list[str]:
    """Return the path of each image's label image, relative to the capture; raise InputError if two images share one."""
    owners = dict[str, str]()
    for image in images:
        name = Path(image).with_suffix(".png")
        parts = name.parts[name.parts[0] == IMAGES and len(name.parts) > 1 :]
        if (owner := owners.setdefault("/".join(("labels", *parts)), image)) != image:
            raise InputError(f"{owner} and {image} would share one label image; rename one of them")
    return list(owners)


def _read_label(capture: Capture, image: str, name: str) -> UInt16[ndarray, "h w"]:
    """Return the label image `name` of an image of the capture; raise InputError if there is none that fits."""
    path = capture_file(capture.folder, name, f"{capture.folder}: label image of {image}")
    if not path.is_file():
        raise InputError(f"{path}: not found; give labels for all images of the capture or none ({image})")
    label = read_one_channel(path, str(path))
    if label.shape[::-1] != capture.image_size:
        raise InputError(
            f"{path}: is {label.shape[::-1]} pixels and {image} is {capture.image_size}; make them alike"
        )
    if label.max() >= MOST_LABELS:
        raise InputError(f"{path}: holds label {label.max()}; number labels from 1 to {MOST_LABELS - 1}")
    return label.astype(np.uint16)


def _read_names(path: Path) -> dict[int, str]:
    """Return the name of each label in the file `path`, names.json; an empty dict if there is no such file."""
    if not path.is_file():
        return {}
    try:
        named = json.loads(path.read_text("utf-8")).items()
        # One line each: the header of cloud.ply names them.
        names = {int(label): " ".join(str(name).split()) or label for label, name in named}
        "".join(names.values()).encode()  # half of a surrogate pair cannot be written
        return names
    except (ValueError, AttributeError, RecursionError):
        raise InputError(f'{path}: expected {{"1": "mug", "2": "box"}}') from None


def image_labels(
    capture: Capture,
    reconstruction: Reconstruction,
    hand_eye: Calibration | PublishedCalibration,
    options: SegmentOptions,
    progress: Progress = silent,
) -> LabelImages | None:
    """Return a label per pixel of the pointmaps, and label names; None for methods that label the cloud.

    The labels come from the capture's label images or Segment Anything, as set by `options`. With "auto" the result is
    None if the capture has no label images. Raises InputError if requested label images are missing or Segment Anything
    cannot be loaded.
    """
    if options.segments in ("auto", "labels"):
        labels = read_labels(capture, reconstruction)
        if labels is None and options.segments == "labels":
            raise InputError(
                f"{capture.folder / 'labels'}: holds no PNG; give NAME.png for each images/NAME.jpg, or choose "
                "--segments tabletop"
            )
        return labels
    if options.segments == "sam":
        from jcr.segments.sam import load_sam, sam_labels

        return sam_labels(load_sam(options.sam_weights), reconstruction, hand_eye, progress)
    return None


def label_cloud(
    cloud: PointCloud, options: SegmentOptions, support: Support | None = None
) -> tuple[PointCloud, tuple[str, ...]]:
    """Return the cloud with labels of the objects on its support plane (`label_tabletop`), and notes for the user.

    The cloud is unchanged if it has labels or the options exclude this method. `support` is fitted if it is None. If no
    plane carries the scene, InputError is raised with the option "tabletop"; with "auto" a note says so.
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
