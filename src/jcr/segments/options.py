"""Options and result type of the segmentation, kept apart so that the help of the command line imports no SciPy."""

from dataclasses import dataclass, field
from math import inf
from typing import Annotated, Literal

import tyro
from jaxtyping import Int
from numpy import ndarray

from jcr.errors import InputError


@dataclass(frozen=True)
class TabletopOptions:
    """Limits of an object on the table."""

    object_lowest: Annotated[float, tyro.conf.arg(metavar="M")] = 0.008
    """Height (m) above the plane that an object must reach; lower points then also belong to it."""
    object_highest: Annotated[float, tyro.conf.arg(metavar="M")] = 0.6
    """Height (m) above the plane beyond which nothing belongs to an object."""
    object_gap: Annotated[float, tyro.conf.arg(metavar="M")] = 0.01
    """Space (m) between objects in the view from above that separates them."""
    object_smallest: Annotated[float, tyro.conf.arg(metavar="M")] = 0.015
    """Extent (m) of the points below which an object is treated as noise."""


@dataclass(frozen=True)
class SegmentOptions:
    """Method that divides the scene into objects."""

    segments: Literal["auto", "labels", "tabletop", "sam", "none"] = "auto"
    """Source of the labels. labels are images labels/NAME.png in the capture's folder. tabletop finds the support plane
    and the objects on it. sam is Segment Anything 2 (pip install 'jcr-handeye[sam]'). auto uses labels if there are any,
    otherwise tabletop."""
    sam_weights: Annotated[str, tyro.conf.arg(metavar="PATH_OR_HUB_ID")] = "facebook/sam2.1-hiera-tiny"
    """Path or hub id of Segment Anything's weights."""
    tabletop: TabletopOptions = field(default_factory=TabletopOptions)


def check_segment_options(options: SegmentOptions) -> None:
    """Raise InputError if a limit of an object is no length, or the lowest height is not below the highest."""
    limits = options.tabletop
    for name, value in vars(limits).items():
        if not 0 < value < inf:
            raise InputError(f"{name} {value:g}: give metres above 0")
    if not limits.object_lowest < limits.object_highest:
        raise InputError(
            f"object_lowest {limits.object_lowest:g}: give less than object_highest, {limits.object_highest:g} m"
        )


LabelImages = tuple[Int[ndarray, "m h w"], tuple[str, ...]]
"""Labels at the pixels of m pointmaps (0: no object), and the name of each label; the name of label 0 is "none"."""
