"""Orders of images' names: as people count, img2 before img10, and as text, img10 before img2."""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray


def natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts names as people count."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def paired_by_name(
    names: Sequence[str], poses: Float[ndarray, "n 4 4"]
) -> dict[bool, Float[ndarray, "n 4 4"]]:
    """Poses of images whose rows were listed in the order of their names as numbers (True) or as text (False).

    Of both orders those that pair other rows with the images than `names` and `poses` do, whose rows are in order.
    """
    found = {}
    for by_number in (True, False):
        order = sorted(range(len(names)), key=lambda k: natural(names[k]) if by_number else names[k])
        if order != list(range(len(names))):
            found[by_number] = np.empty_like(poses)
            found[by_number][order] = poses
    return found
