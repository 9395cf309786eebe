"""Segmentation of a scene by geometry: the support plane, and the objects on it."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage
from scipy.spatial import ConvexHull, Delaunay, KDTree

from jcr.depth.support_plane import robust_std, support_plane
from jcr.errors import InputError, count_of
from jcr.geometry import apply, inverse, transform
from jcr.records import PRIOR, PointCloud
from jcr.segments.options import TabletopOptions


@dataclass(frozen=True)
class Support:
    """Support plane of a scene, on which the objects stand."""

    base_from_support: Float[ndarray, "4 4"]
    """Pose of the plane: origin on the plane amid its points, z normal to it, towards the cameras."""
    noise: float
    """Robust standard deviation (m) of the distances of the plane's points from the plane."""
    roughness: float
    """Robust standard deviation (m) of points about the median of their neighbourhood; unlike `noise`, a bent table
    does not increase it."""
    on_plane: Bool[ndarray, " n"]
    """Mask of the n points of the cloud that lie on the plane."""


FEWEST_POINTS, LEAST_SHARE = 30, 1e-3
"""Smallest number of points of an object, and smallest share of all points."""
NOISE_REACH = 4.0
"""Largest height of a point on the plane, in standard deviations of the plane's noise."""
CLEARLY = 1.5
"""Multiple of the smallest height of an object that some of its points must exceed; noise reaches the height."""
FEWEST_IN_CELL, STRAY_SHARE = 3, 0.05
"""Smallest number of points of an occupied cell seen from above, and smallest share of the median cell's number. Cells
with fewer points hold only stray points."""
FLAT_PATCH = 0.02
"""Side (m) of a patch of the table that counts as flat even if the table is bent."""
LARGEST_REACH = 10.0
"""Largest distance (m) of an object from the middle of all along an axis; no arm reaches as far. It bounds memory."""
FEWEST_MEASURED = 1000
"""Smallest number of measured points for which the fit of the support plane ignores filled-in points."""


def fit_support(cloud: PointCloud) -> Support:
    """Fit the plane with most points that has all cameras on one side, by `support_plane`; prefer level planes.

    Points filled in by plane priors are excluded from the fit and its noise, because they lie on planes by
    construction. Raises InputError if no plane holds a tenth of the points.
    """
    filled = np.zeros(len(cloud.image), bool) if cloud.reason is None else cloud.reason == PRIOR
    if (~filled).sum() < FEWEST_MEASURED:
        filled[:] = False
    x, centers = cloud.points_in_base[~filled], cloud.camera_centers_in_base
    if len(x) < 100:
        raise InputError(f"the cloud has {count_of(len(x), 'point')}; a support plane needs some hundreds")
    far = float(np.median(np.linalg.norm(x - centers[cloud.image[~filled]], axis=1)))
    if (plane := support_plane(x, centers, far, z_is_up=True)) is None:
        raise InputError(
            "no plane carries the scene: none holds a tenth of the points with all cameras on one side"
        )
    up, middle, noise = plane
    # The x axis of the support frame is the base's x axis (or y axis) projected onto the plane.
    along = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    along = along - (along @ up) * up
    along /= np.linalg.norm(along)
    rotation = np.stack([along, np.cross(up, along), up], axis=1)
    distance = (x - middle) @ up
    on = np.abs(distance) < 3 * noise
    patch = np.floor((x[on] - middle) @ rotation[:, :2] / FLAT_PATCH).astype(np.int64)
    patch -= patch.min(0)
    _, place = np.unique(np.ravel_multi_index(tuple(patch.T), patch.max(0) + 1), return_inverse=True)
    bend = ndimage.median(distance[on], place, np.arange(place.max() + 1))
    roughness = min(robust_std(distance[on] - bend[place]), noise)
    on_plane = np.abs((cloud.points_in_base - middle) @ up) < 3 * noise
    return Support(transform(rotation, middle), noise, roughness, on_plane)


def label_tabletop(
    cloud: PointCloud, options: TabletopOptions | None = None, support: Support | None = None
) -> PointCloud:
    """Return the cloud with labels: 1 for the support plane, 2, 3, … for the objects that stand on it, largest first.

    Other points have label 0, earlier labels are replaced, and the largest object is that with most points. `support`
    is fitted if it is None. Objects are separated as seen from straight above, so objects that touch or lie on one
    another are one object. Raises InputError if no plane carries the scene.
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
        over &= (np.abs(x_in_support[:, :2] - np.median(x_in_support[over, :2], axis=0)) < LARGEST_REACH).all(
            1
        )
        cell = np.floor(x_in_support[:, :2] / (options.object_gap / 2)).astype(int)
        # Two empty cells on every side; points farther out are counted in the outermost one.
        low, high = cell[over].min(0) - 2, cell[over].max(0) + 2
        # Connected cells that hold more than a few stray points.
        count = np.zeros(high - low + 1)
        np.add.at(count, tuple((cell[over] - low).T), 1)
        enough = max(FEWEST_IN_CELL, STRAY_SHARE * float(np.median(count[count > 0])))
        parts, _ = ndimage.label(count >= enough, np.ones((3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
        place = tuple((np.clip(cell, low, high) - low).T)
        # Points too low to be an object by themselves belong to the object above them.
        part = np.where((height > noise) & (height < options.object_highest), parts[place], 0)
        beneath = np.asarray(ndimage.binary_dilation(parts > 0, np.ones((3, 3))), bool)
        bare = support.on_plane & ~beneath[place]
        reaching = np.bincount(part, height > CLEARLY * founding, minlength=part.max() + 1)
        part[reaching[part] < FEWEST_POINTS] = 0
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
    """Return the number of each point's object: 1 for the object with most points, 2, 3, … for the others, 0 for none.

    `part` is the number of the connected group of points, seen from above, to which each point belongs, 0 for none.
    Groups whose outlines overlap are joined; groups that are small, or mostly outside of the bare plane, are no
    objects. `x_in_support` are the points (m), z normal to the plane. `bare` marks points of the plane with nothing
    above them. Raises InputError if too little of the plane is bare.
    """
    # Groups are joined if their outlines overlap in the plane, such as the two sides of a ring, and if a small one is
    # above the plane and close to a larger one, such as a cup's handle.
    count = np.bincount(part)
    count[0] = 0
    joined = np.arange(len(count))
    rows = [np.flatnonzero(part == k) if count[k] >= 3 else np.zeros(0, int) for k in range(len(count))]
    hull = [cv2.convexHull(x_in_support[own, :2].astype(np.float32)) if len(own) else None for own in rows]
    order = [k for k in np.argsort(-count) if hull[k] is not None]
    for at, small in enumerate(order):
        is_above = x_in_support[rows[small], 2].min() > 2 * options.object_gap
        for large in order[:at]:
            shared, _ = cv2.intersectConvexConvex(hull[small], hull[large])
            if shared > 0.2 * cv2.contourArea(hull[small]) or (
                is_above
                and count[small] < 0.25 * count[large]
                and KDTree(x_in_support[rows[large], :2]).query(x_in_support[rows[small], :2])[0].min()
                < 2.5 * options.object_gap
            ):
                joined[small] = joined[large]
                break
    part = joined[part]
    count = np.bincount(part)
    # A part mostly outside of the bare plane is background, such as a wall; a small part is noise.
    plane_xy = x_in_support[bare, :2]
    if bare.sum() < FEWEST_POINTS or np.linalg.eigvalsh(np.cov(plane_xy.T))[0] < FLAT_PATCH**2 / 12:
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
        (span >= options.object_smallest)
        & (count >= max(FEWEST_POINTS, LEAST_SHARE * len(part)))
        & (beside <= 0.7)
    )
    good[0] = False
    rank = np.zeros(len(count), int)
    rank[np.argsort(-np.where(good, count, 0))[: good.sum()]] = np.arange(1, good.sum() + 1)
    return rank[part]
