"""The section on a board beside features: where it was found in the images, its size, its bend."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.images import read_image
from jcr.records import BoardFound
from jcr.report.features import reprojections_px
from jcr.report.raster import image_url
from jcr.report.render import Section
from jcr.report.svg import WIDTH, Figure, Shape, line, text, ticks
from jcr.results import RunResult
from jcr.rounding import significant, with_std

IMAGES, MAGNIFIED = 2, 50
"""Drawn, those with most corners, and how many times longer the reprojection errors are drawn."""
AROUND, LEAST = 0.35, 0.3
"""Of the corners' extent, what is drawn beyond them on each side; and of the image's width, the least that is drawn."""
MARGINS = (46.0, 34.0, 12.0, 40.0)
"""px left, above, right and below the drawn bend."""
LEAST_MM = 0.5
"""Height that the drawn bend has space for at least, so that a flat board looks flat."""


def board_section(result: RunResult) -> Section | None:
    """Corners over the images that show most of them, and the heights above the plane; None where no board took part
    beside features."""
    if (board := result.calibration.board) is None:
        return None
    figures = [_corners_figure(result, row) for row in _most_shown(result)]
    if board.bend_mm > 0:
        figures.append(_bend_figure(np.array(board.shape_mm)))
    content = {
        "board": board,
        "images": len(result.calibration.images),
        "side": with_std(board.side_mm, board.side_std_mm),
        "rms": f"{board.rms_px:.2f}",
        "bend": significant(board.bend_mm),
        "places": _places(board),
        "magnified": MAGNIFIED,
        "figures": figures,
    }
    return Section("board", content)


def _places(board: BoardFound) -> dict[str, str]:
    """Of each body, where it is and how far from level."""
    return {
        f"place of tag {k}" if board.bodies > 1 else "place": (
            f"({', '.join(f'{x:.3f}' for x in centre)}) m in the base, {tilt:.1f}° from horizontal"
        )
        for k, (centre, tilt) in enumerate(zip(board.centres_in_base, board.tilts_deg, strict=True), start=1)
    }


def _most_shown(result: RunResult) -> Sequence[int]:
    """Rows of the reconstruction's images with most corners, the first ones of equals, in the order of the capture."""
    tracks = result.reconstruction.tracks
    count = np.bincount(
        tracks.image[tracks.on_board[tracks.point]], minlength=len(result.reconstruction.image_index)
    )
    chosen = np.argsort(-count, kind="stable")[:IMAGES]
    return sorted(chosen[count[chosen] > 0].tolist())


def _corners_figure(result: RunResult, row: int) -> Figure:
    """The part of an image around the corners; each with the way to where its 3D point is projected."""
    tracks, name = result.reconstruction.tracks, result.capture.images[result.image_index[row]]
    own = np.flatnonzero((tracks.image == row) & tracks.on_board[tracks.point])
    pixels = read_image(result.capture.folder / name)
    height, width = pixels.shape[:2]
    low, size = _around(tracks.x_px[own] + 0.5, (width, height))
    zoom = WIDTH / size[0]
    left, top = low.astype(int)
    right, bottom = np.ceil(low + size).astype(int)
    part = pixels[top:bottom, left:right]
    shown = (round(zoom * part.shape[1]), round(zoom * part.shape[0]))
    small = cv2.resize(part, shown, interpolation=cv2.INTER_AREA if zoom < 1 else cv2.INTER_CUBIC)
    shapes = [Shape("image", {"href": image_url(small, "JPEG"), "width": shown[0], "height": shown[1]})]
    at = zoom * (tracks.x_px[own] + 0.5 - [left, top])
    for begin, off in zip(at, zoom * MAGNIFIED * reprojections_px(result.reconstruction)[own], strict=True):
        shapes.append(
            Shape("circle", {"class": "corner", "cx": f"{begin[0]:.1f}", "cy": f"{begin[1]:.1f}", "r": 4})
        )
        shapes.append(line([begin, begin + off], "off"))
    shapes.append(text(8.0, 18.0, name, "level"))
    return Figure(
        f"{len(own)} corners of the board in {name}", shapes, float(shown[1]), width=float(shown[0])
    )


def _around(
    x_px: Float[ndarray, "k 2"], size: tuple[int, int]
) -> tuple[Float[ndarray, "2"], Float[ndarray, "2"]]:
    """Upper left corner and size of the part of an image around points; of the image's own proportions."""
    whole = np.array(size, float)
    extent = (1 + 2 * AROUND) * np.ptp(x_px, axis=0)
    share = min(max(float((extent / whole).max()), LEAST), 1.0)
    middle = (x_px.min(0) + x_px.max(0)) / 2
    return (middle - share * whole / 2).clip(0, (1 - share) * whole), share * whole


def _bend_figure(shape_mm: Float[ndarray, "c 3"]) -> Figure:
    """The corners from the side: height above the plane over the place along the longer side."""
    title = "The board from its side, heights magnified"
    left, above, right, below = MARGINS
    along = shape_mm[:, int(np.ptp(shape_mm[:, :2], axis=0).argmax())]
    along, height = along - along.min(), shape_mm[:, 2]
    half = max(float(np.abs(height).max()), LEAST_MM / 2) * 1.15
    wide, tall = WIDTH - left - right, 0.4 * WIDTH
    shapes = [text(0.0, 16.0, title, "title")]

    def at(x: float, z: float) -> tuple[float, float]:
        return left + wide * x / float(along.max()), above + tall * (half - z) / (2 * half)

    for tick in ticks(-half, half):
        shapes.append(line([at(0.0, tick), at(float(along.max()), tick)], "frame" if tick == 0 else "faint"))
        shapes.append(text(left - 7, at(0.0, tick)[1] + 4, f"{tick:g}", "small end"))
    for tick in ticks(0.0, float(along.max())):
        shapes.append(text(at(tick, 0.0)[0], above + tall + 16, f"{tick:g}", "small middle"))
    for x, z in zip(along.tolist(), height.tolist(), strict=True):
        u, v = at(x, z)
        named = Shape("title", {}, f"{z:+.2f} mm")
        dot = {"class": "course-point", "cx": f"{u:.1f}", "cy": f"{v:.1f}", "r": 3}
        shapes.append(Shape("circle", dot, children=(named,)))
    end = above + tall + below
    shapes.append(text(left + wide / 2, end - 6, "along the board (mm); heights in mm", "small middle"))
    return Figure(title, shapes, end)
