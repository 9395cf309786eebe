"""Options of cloud and map, separate from the code that imports torch so that the command-line help loads fast."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import Annotated, Literal

import tyro

from jcr.errors import InputError


@dataclass(frozen=True)
class CloudOptions:
    """Selection of the points of the pointmaps that enter the map."""

    confidence_percentile: Annotated[float, tyro.conf.arg(metavar="PERCENT")] = 20.0
    """Share (%) of the points to remove, least confident first, of those that only matching or a prediction supports."""
    max_points: Annotated[int, tyro.conf.arg(metavar="COUNT")] = 200_000
    """Largest number of points, drawn evenly over the pixels of all images."""
    cloud_seed: int = 0
    """Seed of the draw of the points."""


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Workspace, resolution and training of the map."""

    preset: Literal["default", "paper"] = "default"
    """Kind of map. default uses feature grids and learns free space along the rays. paper uses the published networks
    with uniform negatives (jcr.paper.fields), and is slower and coarser."""
    steps: Annotated[int, tyro.conf.arg(metavar="COUNT")] = 1000
    """Number of training steps of the preset paper; the default preset stops on a plateau."""
    workspace: Annotated[
        tuple[float, float, float, float, float, float] | None,
        tyro.conf.arg(metavar="XMIN YMIN ZMIN XMAX YMAX ZMAX"),
    ] = None
    """Box of the map in the base frame (m); by default a box around the points and the cameras."""
    cell: Annotated[float, tyro.conf.arg(metavar="M")] = 0.01
    """Side (m) of the finest feature cells; seen space is recorded at half of it."""
    max_cells: Annotated[int, tyro.conf.arg(metavar="COUNT")] = 4_000_000
    """Largest number of cells; the cells are enlarged until the workspace has no more."""
    max_seconds: Annotated[float, tyro.conf.arg(metavar="S")] = 60.0
    """Longest time (s) of the training; it stops earlier on a plateau."""
    map_seed: int = 0
    """Seed of the samples and of the initial weights."""


LARGEST_CELL = 0.1
"""Largest cell (m). Seen space is recorded at half of it, about the opening of a gripper; a planner has no use of larger
cells. With 0.05 or 0.15 only the refused options differ."""


def check_cloud_options(options: CloudOptions) -> None:
    """Raise InputError if a number of the options is out of range."""
    if not 0 <= options.confidence_percentile < 100:
        raise InputError(f"confidence_percentile {options.confidence_percentile:g}: give 0 to below 100 %")
    if options.max_points < 1:
        raise InputError(f"max_points {options.max_points}: give 1 or more")


def check_map_options(options: MapOptions) -> None:
    """Raise InputError if a number of the options is out of range, or an option does not concern the preset."""
    check_workspace(options.workspace)
    if not 0 < options.cell <= LARGEST_CELL:
        raise InputError(f"cell {options.cell:g}: give metres, above 0 and up to {LARGEST_CELL:g}")
    if options.max_cells < 1:
        raise InputError(f"max_cells {options.max_cells}: give 1 or more")
    if not 0 < options.max_seconds < inf:
        raise InputError(f"max_seconds {options.max_seconds:g}: give a positive number of seconds")
    if options.steps < 1:
        raise InputError(f"steps {options.steps}: give 1 or more")
    if options.preset == "default" and options.steps != MapOptions.steps:
        raise InputError(f"steps {options.steps}: is for the preset paper; leave it out, or give max_seconds")


def check_workspace(workspace: Sequence[float] | None) -> None:
    """Raise InputError unless `workspace` is None, or three finite minima (m) below three finite maxima."""
    if workspace is None:
        return
    pairs = zip(workspace[:3], workspace[3:], strict=True)
    if not all(isfinite(low) and isfinite(high) and low < high for low, high in pairs):
        raise InputError(
            f"workspace {tuple(workspace)}: give xmin ymin zmin xmax ymax zmax (m), minima below maxima"
        )
