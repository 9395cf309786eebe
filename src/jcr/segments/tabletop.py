"""Segmentation by geometry: the support plane, and the objects on it."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage
from scipy.spatial import ConvexHull, Delaunay, KDTree

from jcr.errors import InputError
from jcr.geometry import apply, inverse, transform
from jcr.records import PRIOR, PointCloud
from jcr.segments.options import TabletopOptions


@dataclass(frozen=True)
class Support:
    """The plane that carries the scene."""

    base_from_support: Float[ndarray, "4 4"]
    """Origin on the plane amid its points, z up, away from it towards the cameras."""
    noise: float
    """Robust one-sigma distance (m) of the plane's points from it."""
    roughness: float
    """Robust distance (m) from the surface of neighbouring points, which leaves the plane where the table is bent."""
    on_plane: Bool[ndarray, " n"]
    """Points of the cloud that lie on it."""


FEWEST, LEAST_SHARE = 30, 1e-3
"""Points of an object, and share of all points."""
NOISE_REACH = 4.0
"""Sigmas of the plane's noise within which a point is taken to lie on it."""
CLEARLY = 1.5
"""Times the height from which points found an object that it must reach: noise comes just that far."""
FEWEST_IN_CELL, STRAY_SHARE = 3, 0.05
"""Points, and share of the median cell's, below which a cell of the map from above holds only stray points."""
PATCH = 0.02
"""Metres over which a table is taken for flat, however it is bent."""
LEAST_LEVEL, LEVEL_WEIGHT = 0.9, 5
"""Cosine to the base frame's z axis from which a plane is level, and how many times its points then count."""
FEWEST_MEASURED = 1000
"""Measured points from which a support plane is fitted without those that were filled in."""
PLANES, SAMPLE = 400, 20_000
"""Planes through three random points that are tried, and points each is tried on."""


def fit_support(cloud: PointCloud) -> Support:
    """Fit the plane with most points on it that has the cameras on one side (RANSAC, then robust least squares).

    What was filled in by planes is left out of the fit and its noise: it lies on planes by construction.
    Raises InputError when no plane holds a tenth of the points.
    """
    draw = np.random.default_rng(0)
    filled = np.zeros(len(cloud.image), bool) if cloud.reason is None else cloud.reason == PRIOR
    if (~filled).sum() < FEWEST_MEASURED:
        filled[:] = False
    x, image = cloud.points_in_base[~filled], cloud.image[~filled]
    if len(x) < 100:
        raise InputError(f"the cloud has {len(x)} points; a support plane needs some hundreds")
    some = x[draw.choice(len(x), min(SAMPLE, len(x)), replace=False)]
    a, b, c = some[draw.integers(len(some), size=(3, PLANES))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, length, where=length > 1e-9, out=np.zeros_like(normal))
    offset = (normal * a).sum(1)
    side = np.sign(cloud.camera_centers_in_base @ normal.T - offset)
    one_sided = (np.abs(side.sum(0)) == len(side)) & (length[:, 0] > 1e-9)
    # A table's points are spread about it by the noise of depth, which is larger the farther the cameras are.
    far = np.median(np.linalg.norm(x - cloud.camera_centers_in_base[image], axis=1))
    count = np.zeros(PLANES, int)
    for k in np.flatnonzero(one_sided):  # one by one, each stays in the processor's cache
        count[k] = np.count_nonzero(np.abs(some @ normal[k] - offset[k]) < 0.005 * far)
    # A wall behind the table may be seen more; arms that stand upright are the rule.
    level = np.abs(normal[:, 2]) > LEAST_LEVEL
    best = int((count * np.where(level, LEVEL_WEIGHT, 1)).argmax())
    if count[best] < 0.1 * len(some):
        raise InputError(
            "no plane carries the scene: none holds a tenth of the points with all cameras on one side"
        )

    # Geman and McClure's weights: a sheet of board or a tray that lies on the table does not lift the plane.
    up, middle = normal[best] * side[0, best], a[best]
    distance, noise = (x - middle) @ up, 0.002 * far
    for _ in range(10):
        near = np.abs(distance) < 3 * noise
        weight = 1 / (1 + (distance[near] / noise) ** 2) ** 2
        middle = weight @ x[near] / weight.sum()
        _, axes = np.linalg.eigh(np.cov((x[near] - middle).T, aweights=weight))
        up = axes[:, 0] * np.sign(axes[:, 0] @ up)
        distance = (x - middle) @ up
        noise = max(_noise(distance[np.abs(distance) < 3 * noise]), 1e-5 * far)
    # x of the support's frame lies as near to x of the base as it can.
    along = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    along = along - (along @ up) * up
    along /= np.linalg.norm(along)
    rotation = np.stack([along, np.cross(up, along), up], axis=1)
    on = np.abs(distance) < 3 * noise
    patch = np.floor((x[on] - middle) @ rotation[:, :2] / PATCH).astype(np.int64)
    patch -= patch.min(0)
    _, place = np.unique(np.ravel_multi_index(tuple(patch.T), patch.max(0) + 1), return_inverse=True)
    bend = ndimage.median(distance[on], place, np.arange(place.max() + 1))
    on_plane = np.abs((cloud.points_in_base - middle) @ up) < 3 * noise
    return Support(
        transform(rotation, middle), noise, min(_noise(distance[on] - bend[place]), noise), on_plane
    )


def _noise(distance: Float[ndarray, " n"]) -> float:
    """Return a robust standard deviation: 1.4826 times the median absolute deviation."""
    return float(1.4826 * np.median(np.abs(distance - np.median(distance))))


def label_tabletop(
    cloud: PointCloud, options: TabletopOptions | None = None, support: Support | None = None
) -> PointCloud:
    """Return the cloud with label 1 on the support plane and 2, 3, … on the objects that stand on it, largest first.

    Objects are separated seen from straight above: what lies over one another is one object, and so are objects
    that touch. Raises InputError when no plane carries the scene.
    """
    options = options or TabletopOptions()
    support = support or fit_support(cloud)
    x_in_support = apply(inverse(support.base_from_support), cloud.points_in_base)
    height = x_in_support[:, 2]
    noise = NOISE_REACH * support.noise
    founding = max(options.object_lowest, noise)
    over = (height > founding) & (height < options.object_highest)
    object_of = np.zeros(len(height), int)
    if over.any():
        cell = np.floor(x_in_support[:, :2] / (options.object_gap / 2)).astype(int)
        # Two empty cells all around, the outermost one stands for all that lies farther out.
        low, high = cell[over].min(0) - 2, cell[over].max(0) + 2
        # Connected cells that hold more than a few stray points.
        count = np.zeros(high - low + 1)
        np.add.at(count, tuple((cell[over] - low).T), 1)
        enough = max(FEWEST_IN_CELL, STRAY_SHARE * float(np.median(count[count > 0])))
        parts, _ = ndimage.label(count >= enough, np.ones((3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
        place = tuple((np.clip(cell, low, high) - low).T)
        # What is too low to found an object belongs to the one it lies under: its foot.
        part = np.where((height > noise) & (height < options.object_highest), parts[place], 0)
        beneath = np.asarray(ndimage.binary_dilation(parts > 0, np.ones((3, 3))), bool)
        bare = support.on_plane & ~beneath[place]
        reaching = np.bincount(part, height > CLEARLY * founding, minlength=part.max() + 1)
        part[reaching[part] < FEWEST] = 0
        object_of = _objects(part, x_in_support, bare, options)
    table = (np.abs(height) <= noise) & (object_of == 0)
    label = np.where(object_of > 0, object_of + 1, np.where(table, 1, 0))
    names = ("none", "table", *(f"object {k}" for k in range(1, int(object_of.max(initial=0)) + 1)))
    return replace(cloud, label=label, label_names=names)


def _objects(
    part: Int[ndarray, " n"],
    x_in_support: Float[ndarray, "n 3"],
    bare: Bool[ndarray, " n"],
    options: TabletopOptions,
) -> Int[ndarray, " n"]:
    """Return the object of each point, from 1 for the one with most points; 0 = none.

    `bare` are the points of the plane that lie beneath nothing.
    """
    part = _joined(part, x_in_support, options)
    count = np.bincount(part)
    # What mostly stands beside the bare plane is background, such as a wall; what is too small is noise.
    plane_xy = x_in_support[bare, :2]
    if bare.sum() < FEWEST or np.linalg.eigvalsh(np.cov(plane_xy.T))[0] < PATCH**2 / 12:
        raise InputError(
            "no bare part of the support plane is in view, so objects cannot be told from what lies beside it; leave a "
            "hand's width of it free, or give label images"
        )
    outline = Delaunay(plane_xy[ConvexHull(plane_xy).vertices])
    beside = np.bincount(part, outline.find_simplex(x_in_support[:, :2]) < 0) / np.maximum(count, 1)
    span = np.array(
        [np.ptp(x_in_support[part == k], axis=0).max() if count[k] else 0.0 for k in range(len(count))]
    )
    good = (
        (span >= options.object_smallest) & (count >= max(FEWEST, LEAST_SHARE * len(part))) & (beside <= 0.7)
    )
    good[0] = False
    rank = np.zeros(len(count), int)
    rank[np.argsort(-np.where(good, count, 0))[: good.sum()]] = np.arange(1, good.sum() + 1)
    return rank[part]


def _joined(
    part: Int[ndarray, " n"], x_in_support: Float[ndarray, "n 3"], options: TabletopOptions
) -> Int[ndarray, " n"]:
    """Join parts of one object: outlines that overlap, and small parts in the air close to a larger one.

    The two sides of a ring seen from either side, the far rim of a cup, its handle.
    """
    count = np.bincount(part)
    count[0] = 0
    joined = np.arange(len(count))
    rows = [np.flatnonzero(part == k) if count[k] >= 3 else np.zeros(0, int) for k in range(len(count))]
    hull = [cv2.convexHull(x_in_support[own, :2].astype(np.float32)) if len(own) else None for own in rows]
    order = [k for k in np.argsort(-count) if hull[k] is not None]
    for at, small in enumerate(order):
        floats = x_in_support[rows[small], 2].min() > 2 * options.object_gap
        for large in order[:at]:
            shared, _ = cv2.intersectConvexConvex(hull[small], hull[large])
            overlap = shared > 0.2 * cv2.contourArea(hull[small])
            if overlap or (
                floats
                and count[small] < 0.25 * count[large]
                and KDTree(x_in_support[rows[large], :2]).query(x_in_support[rows[small], :2])[0].min()
                < 2.5 * options.object_gap
            ):
                joined[small] = joined[large]
                break
    return joined[part]
