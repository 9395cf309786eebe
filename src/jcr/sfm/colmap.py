"""The COLMAP back end: structure from motion; no network, no weights."""

import math
from dataclasses import replace

from PIL import ExifTags, Image

from jcr.camera import usable_intrinsics
from jcr.capture.images import read_image
from jcr.errors import RejectedError
from jcr.progress import Progress, silent
from jcr.records import Capture, Intrinsics, Reconstruction
from jcr.sfm.options import ColmapOptions

_FILM_DIAGONAL_MM = 43.27
"""Diagonal of the 36 x 24 mm frame that EXIF's equivalent focal length refers to."""
_START_FOCALS = (0.8, 0.5, 1.2)
"""Initial focal lengths in long sides, without known intrinsics. COLMAP's 1.2 alone fails on two of three real wrist
cameras (true values 0.5 to 0.7); from 0.8 all three converge."""


def reconstruct_colmap(
    capture: Capture, options: ColmapOptions | None = None, progress: Progress | None = None
) -> Reconstruction:
    """Camera poses and tracks of a capture, up to one similarity.

    Known intrinsics are held, unknown ones are estimated. Raises RejectedError when fewer than three images
    register: how many did, the likely reason, and what to do instead.
    """
    from jcr.sfm.mapping import structure_from_motion

    options = options or ColmapOptions()
    report = progress or silent
    images = [read_image(capture.folder / name) for name in capture.images]
    cameras, is_known, warnings = starting_intrinsics(capture)
    try:
        sparse = structure_from_motion(
            images, cameras, is_known, options, report, capture.base_from_gripper, capture.images
        )
    except RejectedError as error:
        raise error.with_more(*warnings) from None
    notes, registered = sparse.notes, sparse.image_index
    if missing := [name for row, name in enumerate(capture.images) if row not in registered]:
        notes += (f"{len(registered)} of {len(capture)} images registered; not {', '.join(missing)}",)
    return replace(sparse, notes=notes, warnings=(*warnings, *sparse.warnings))


def starting_intrinsics(capture: Capture) -> tuple[list[Intrinsics], bool, tuple[str, ...]]:
    """Return the initial intrinsics, tried in turn; whether they are given; and warnings about them."""
    given, warnings = usable_intrinsics(capture.intrinsics)
    if given:
        return [given], True, warnings
    # EXIF's 35 mm focal length if there is one, then usual ones.
    width, height = capture.image_size
    with Image.open(capture.folder / capture.images[0]) as opened:
        exif = opened.getexif().get_ifd(ExifTags.IFD.Exif)
    focal_35mm = exif.get(ExifTags.Base.FocalLengthIn35mmFilm)
    focals = [focal_35mm / _FILM_DIAGONAL_MM * math.hypot(width, height)] if focal_35mm else []
    focals += [factor * max(width, height) for factor in _START_FOCALS]
    guesses = [Intrinsics(f, f, (width - 1) / 2, (height - 1) / 2, width, height) for f in focals]
    return guesses, False, warnings
