"""Options of cloud and map, separate from the code that imports torch so that the command-line help loads fast."""

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class CloudOptions:
    """Selection of the points of the pointmaps that enter the map."""

    confidence_percentile: Annotated[float, tyro.conf.arg(metavar="PERCENT")] = 20.0
    """Drop this share (%) of the points that have only matching or a prediction as support, least confident first."""
    max_points: Annotated[int, tyro.conf.arg(metavar="COUNT")] = 200_000
    """Keep at most this many points, drawn evenly over the pixels of all images."""
    cloud_seed: int = 0
    """Seed of that draw."""


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Workspace, resolution and training of the map."""

    preset: Literal["default", "paper"] = "default"
    """default: feature grids, free space learnt along the rays; paper: the published networks and their training, with
    uniform negatives (jcr.paper.fields), slower and coarser."""
    steps: Annotated[int, tyro.conf.arg(metavar="COUNT")] = 1000
    """Number of training steps of the preset paper; the default preset stops on a plateau."""
    workspace: Annotated[
        tuple[float, float, float, float, float, float] | None,
        tyro.conf.arg(metavar="XMIN YMIN ZMIN XMAX YMAX ZMAX"),
    ] = None
    """Box of the map in the base frame (m); unset: a box around the points and the cameras."""
    cell: Annotated[float, tyro.conf.arg(metavar="M")] = 0.01
    """Side (m) of the finest feature cells; seen space is recorded at half of it."""
    max_cells: Annotated[int, tyro.conf.arg(metavar="COUNT")] = 4_000_000
    """Enlarge the cells until the workspace holds no more than this many."""
    max_seconds: Annotated[float, tyro.conf.arg(metavar="S")] = 60.0
    """Stop the training after this time at the latest; it stops earlier on a plateau."""
    map_seed: int = 0
    """Seed of the samples and of the initial weights."""
