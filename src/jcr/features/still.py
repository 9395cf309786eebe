"""Parts of the image that do not move while the gripper does: its own fingers, a logo, text drawn into the images."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import binary_dilation, find_objects, label

from jcr.features.gate import Key

CELL_PX = 16
NEAR_PX = 2.5
"""Largest distance of a keypoint's positions in two images that counts as no motion."""
LEAST_PAIRS = 4
LEAST_SHARE = 0.2
"""Least share of the pairs with matches in a cell; by chance a point keeps its pixel in one or two."""
LEAST_CELLS = 3


def still_cells(
    x_px: Sequence[Float[ndarray, "_ 2"]],
    raw: Mapping[Key, Int[ndarray, "_ 2"]],
    size: tuple[int, int],
    moving: Iterable[Key],
) -> Bool[ndarray, "r c"]:
    """Cells of the image in which matches keep their pixel in many of the `moving` pairs."""
    shape = -(-size[1] // CELL_PX), -(-size[0] // CELL_PX)
    kept, seen = np.zeros(shape), np.zeros(shape)
    for key in moving:
        rows = raw.get(key)
        if rows is None or not len(rows):
            continue
        x_i, x_j = x_px[key[0]][rows[:, 0]], x_px[key[1]][rows[:, 1]]
        stays = np.linalg.norm(x_i - x_j, axis=1) < NEAR_PX
        cells = _cells(x_i, shape)
        for counts, some in ((seen, cells), (kept, cells[stays])):
            counts[tuple(np.unique(some, axis=0).T)] += 1
    still = (kept >= LEAST_PAIRS) & (kept > LEAST_SHARE * np.maximum(seen, 1))
    parts = _parts(still)
    sizes = np.bincount(parts.ravel())
    still &= (sizes >= LEAST_CELLS)[parts]
    return binary_dilation(still, np.ones((3, 3))) if still.any() else still


def hidden(x_px: Float[ndarray, "k 2"], still: Bool[ndarray, "r c"]) -> Bool[ndarray, " k"]:
    """Test which keypoints lie in a part that does not move."""
    return still[tuple(_cells(x_px, still.shape).T)]


def in_words(still: Bool[ndarray, "r c"], size: tuple[int, int], original: tuple[int, int]) -> str:
    """Return the parts as text: rectangles in pixels of the original images."""
    scale = np.array(original) / np.array(size)
    places = []
    for rows, columns in find_objects(_parts(still)):
        left, top = (scale * CELL_PX * [columns.start, rows.start]).round().astype(int)
        right, bottom = np.minimum(scale * CELL_PX * [columns.stop, rows.stop], original).round().astype(int)
        places.append(f"x {left} to {right}, y {top} to {bottom}")
    return "; ".join(places)


def _parts(still: Bool[ndarray, "r c"]) -> Int[ndarray, "r c"]:
    """Cells numbered by the part that they belong to; 0 for none."""
    parts = np.zeros(still.shape, dtype=np.int32)
    label(still, structure=np.ones((3, 3)), output=parts)
    return parts


def _cells(x_px: Float[ndarray, "k 2"], shape: tuple[int, int]) -> Int[ndarray, "k 2"]:
    column_row = np.clip((x_px // CELL_PX).astype(int), 0, [shape[1] - 1, shape[0] - 1])
    return column_row[:, ::-1]
