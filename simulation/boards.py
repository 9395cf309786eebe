"""Simulated captures with a printed sheet, flat or bent, without images."""

from dataclasses import dataclass, replace

import numpy as np

from jcr.camera import project
from jcr.geometry import apply, inverse, rotation_exp, transform
from jcr.records import Boards, Body
from simulation.faults import INTRINSICS, FaultyCapture

CORNERS, SIDE_M, NOISE_PX = (9, 6), 0.025, 0.1
"""Inner corners, side of a square, and standard deviation of a coordinate of a corner."""


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """Chessboard that lies among other things, with the size that its user states."""

    stated_m: float | None = 0.025
    """Stated side; None where it is unknown."""
    bend_m: float = 0.0
    """Height of its short edges over its middle."""
    size_error: float = 0.0
    """Relative excess of the printed size over SIDE_M."""
    stretch: float = 0.0
    """Relative excess of its first side over its second."""
    moved_m: float = 0.0
    """Distance along x by which it is moved before the last third of the images."""


def with_sheet(found: FaultyCapture, rng: np.random.Generator, sheet: Sheet) -> FaultyCapture:
    """Return the capture with the corners of a sheet among its points, in the images that show all of it."""
    grid = np.stack(np.meshgrid(*map(np.arange, CORNERS)), axis=-1).reshape(-1, 2).astype(float)
    grid = np.column_stack([grid - grid.mean(0), np.zeros(len(grid))])
    printed = SIDE_M * (1 + sheet.size_error) * grid
    printed[:, 0] *= 1 + sheet.stretch
    printed[:, 2] = sheet.bend_m * (grid[:, 0] / grid[:, 0].max()) ** 2
    base_from_sheet = transform(
        rotation_exp(np.array([0.0, 0.0, rng.uniform(0, np.pi)])), np.array([0.5, 0.0, 0.005])
    )
    x_in_base = apply(base_from_sheet, printed)
    tracks = found.tracks
    first, image, x_px = len(tracks.points_in_recon), [tracks.image], [tracks.x_px]
    for k, camera in enumerate(found.base_from_camera):
        moved = [sheet.moved_m if 3 * k >= 2 * len(found.base_from_camera) else 0.0, 0.0, 0.0]
        seen = project(found.intrinsics, apply(inverse(camera), x_in_base + moved))
        if ((seen > 0) & (seen < [INTRINSICS.width, INTRINSICS.height])).all():
            image.append(np.full(len(grid), k))
            x_px.append(seen + NOISE_PX * rng.normal(size=seen.shape))
    row = first + np.arange(len(grid))
    unit = 1.0 if sheet.stated_m is None else sheet.stated_m
    boards = Boards(
        spec=f"chessboard:{CORNERS[0]}x{CORNERS[1]}:{'SIDE' if sheet.stated_m is None else unit}",
        side=unit,
        size_std=None if sheet.stated_m is None else 0.002,
        bodies=(Body(0, row, unit * grid),),
    )
    with_corners = replace(
        tracks,
        image=np.concatenate(image),
        x_px=np.concatenate(x_px),
        point=np.concatenate([tracks.point, *[row] * (len(image) - 1)]),
        points_in_recon=np.concatenate([tracks.points_in_recon, x_in_base]),
        boards=boards,
    )
    return replace(found, tracks=with_corners)
