"""Things that moved in the scene between images: matches that agree with each other and that the robot contradicts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.match.epipolar import RoughX, distance_px
from jcr.match.gate import Key, Pair
from jcr.match.verify import View

LEAST_MATCHES = 12
"""Of a thing in two images."""
PLANE_PX = 3.0
LEAST_OFF_PX = 6.0
TIMES_FARTHER = 3.0
"""From the predicted epipolar lines than the matches that the robot confirms."""
LEAST_PAIRS = 4
LEAST_SHARE = 0.4
"""Of the confirmed pairs between the two groups, those that show two motions. Prints that look alike on several things
show a few, too."""
LARGEST_AREA = 0.3
"""Of the image."""
SCENE_INSIDE = 0.3
"""Matches of the scene where the thing is seen, beside its own."""
LARGEST_SHARE = 0.5
"""Of the images: which half moved nobody can say."""


@dataclass(frozen=True)
class Moved:
    """Images in which a thing was elsewhere than in the rest, and where it is seen in them."""

    rows: tuple[int, ...]
    regions: tuple[tuple[int, int, int, int], ...]
    """Left, top, right, bottom (px, working size) for each."""


def second_motions(
    view: View,
    confirmed: Sequence[Pair],
    raw: Mapping[Key, Int[ndarray, "_ 2"]],
    motion: Float[ndarray, "n n 4 4"],
    x: RoughX,
) -> dict[Key, Int[ndarray, "_ 2"]]:
    """Matches of confirmed pairs that lie off the predicted epipolar lines and on one plane's image in both.

    A face of a thing is plane enough; an essential matrix would take in whatever is left over.
    """
    found = {}
    for pair in confirmed:
        rows = raw.get(pair.key)
        if rows is None or len(rows) < LEAST_MATCHES:
            continue
        of_scene = float(np.median(distance_px(view, pair, motion, x.gripper_from_camera)))
        away = distance_px(view, replace(pair, rows=rows), motion, x.gripper_from_camera)
        rows = rows[away > max(LEAST_OFF_PX, TIMES_FARTHER * of_scene)]
        if len(rows) < LEAST_MATCHES:
            continue
        x_i, x_j = view.x_px[pair.i][rows[:, 0]], view.x_px[pair.j][rows[:, 1]]
        # Plain RANSAC finds as many inliers, and takes 60 times as long where few are.
        inside = cv2.findHomography(x_i, x_j, cv2.USAC_FAST, PLANE_PX)[1]
        if inside is None or inside.sum() < LEAST_MATCHES:
            continue
        rows = rows[inside[:, 0].astype(bool)]
        if _has_place_of_its_own(view, rows, pair):
            found[pair.key] = rows
    return found


def _has_place_of_its_own(view: View, rows: Int[ndarray, "m 2"], of_scene: Pair) -> bool:
    """Whether a second motion fills a small part of both images, where the scene's own motion has few matches.

    A repeated pattern has a second motion, too, all over the scene.
    """
    for side, row in enumerate(of_scene.key):
        mine, its = (view.x_px[row][of[:, side]] for of in (rows, of_scene.rows))
        low, high = np.quantile(mine, [0.05, 0.95], axis=0)
        if (high - low).prod() > LARGEST_AREA * view.intrinsics.width * view.intrinsics.height:
            return False
        inside = ((its > low) & (its < high)).all(1).sum()
        if inside > SCENE_INSIDE * len(mine):
            return False
    return True


def moved_things(
    view: View, second: Mapping[Key, Int[ndarray, "_ 2"]], confirmed: Sequence[Key], count: int
) -> Moved | None:
    """The smaller group of images between which and the rest something moved; None where nothing did.

    A pair of one image of each group shows two motions, a pair within a group one: the groups are the two sides of a
    graph, found image by image from the one with most such pairs.
    """
    edges = np.zeros((count, count), dtype=bool)
    for i, j in second:
        edges[i, j] = edges[j, i] = True
    degree = edges.sum(1)
    if len(second) < LEAST_PAIRS:
        return None
    side = np.zeros(count, dtype=int)
    order = [int(np.argmax(degree))]
    side[order[0]] = 1
    for _ in range(count):
        pull = np.where(side == 0, (edges @ side).astype(float), 0.0)
        row = int(np.argmax(np.abs(pull)))
        if pull[row] == 0:
            break
        side[row] = -int(np.sign(pull[row]))
    groups = [tuple(np.flatnonzero(side == sign).tolist()) for sign in (1, -1)]
    # Images without such a pair stand with the larger group.
    smaller = min(groups, key=len)
    if not smaller or len(smaller) > LARGEST_SHARE * count:
        return None
    between = [key for key in confirmed if (key[0] in smaller) != (key[1] in smaller)]
    if sum(key in second for key in between) < max(LEAST_PAIRS, LEAST_SHARE * len(between)):
        return None
    regions = []
    for row in smaller:
        points = [
            view.x_px[row][rows[:, 0 if key[0] == row else 1]] for key, rows in second.items() if row in key
        ]
        low, high = np.quantile(np.concatenate(points), [0.05, 0.95], axis=0).round().astype(int)
        regions.append((int(low[0]), int(low[1]), int(high[0]), int(high[1])))
    return Moved(smaller, tuple(regions))


def in_words(moved: Moved, names: Sequence[str], scale: float) -> str:
    """Images and regions, in pixels of the original images."""
    return "; ".join(
        f"{names[row]} (x {round(scale * left)} to {round(scale * right)}, y {round(scale * top)} to "
        f"{round(scale * bottom)})"
        for row, (left, top, right, bottom) in zip(moved.rows, moved.regions, strict=True)
    )
