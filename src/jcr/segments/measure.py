"""Measurement of the objects on the support plane: height, footprint and box with standard deviations."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from jcr.errors import count_of
from jcr.geometry import apply, inverse, rotation_exp, transform
from jcr.records import PointCloud
from jcr.segments.tabletop import FEWEST_POINTS, Support, fit_support

SHARPEST = 0.0005
"""Smallest width (m) over which heights are smoothed; twice the roughness of the plane if that is larger."""
TOP_SHARE = 0.25
"""Smallest density of points at a top, as a share of the object's mean density; stray points are sparser."""
OUTLINE_CELL = 0.003
"""Side (m) of the cells in which an object's points, seen from above, are counted."""
EDGE_SHARE = 0.4
"""Density of points seen from above, as a share of the median density, below which a cell holds only wrong depths
beside an outline."""
SIDE_SHARE = 0.005
"""Share of the area seen from above that is cut off at each side, because noise has put it there."""
SAME_TOP = 0.05
"""Largest jackknife deviation, as a share of the height, of a top that several images confirm."""


@dataclass(frozen=True, kw_only=True)
class ObjectSize:
    """Size and position of one object on the support plane, with standard deviations (m)."""

    label: int
    name: str
    points: int
    height: float
    """Height (m) of the object's top above the plane."""
    height_std: float
    top_seen: bool
    """True if several images confirm the top; if False, the object may be higher than `height`."""
    footprint_in_base: Float[ndarray, "k 3"]
    """Convex outline of the object on the plane: k corners (m) in order."""
    base_from_box: Float[ndarray, "4 4"]
    """Pose of the object's smallest box on the plane: origin at the centre, z up, x along the longer side."""
    box_size: Float[ndarray, "3"]
    """Length, width and height (m) of the box, along its axes x, y, z."""
    box_std: Float[ndarray, "3"]


@dataclass(frozen=True)
class Measurement:
    """Support plane of a scene and the sizes of the objects on it."""

    support: Support
    objects: tuple[ObjectSize, ...]
    """Objects, sorted by footprint, largest first."""

    def __repr__(self) -> str:
        sizes = ((one.name, "x".join(f"{1e3 * m:.0f}" for m in one.box_size)) for one in self.objects)
        named = ", ".join(f"{name} {size} mm" for name, size in sizes)
        return (
            f"<Measurement: {count_of(len(self.objects), 'object')} on the support plane: {named or 'none'}>"
        )


def measure_objects(cloud: PointCloud, scale_std: float = 0.0, support: Support | None = None) -> Measurement:
    """Measure all labelled objects above the support plane, which is fitted to the cloud if `support` is None.

    Label 0 and the support plane's own label are not objects. `scale_std` is the relative standard deviation of the
    calibration's scale. Standard deviations come from a jackknife that leaves out one image at a time (Efron and Stein
    1981). The reason is that depth errors are correlated within an image. The error of the scale is added in
    quadrature, and half a cell (OUTLINE_CELL) for the sides. For the height, the bend of the table is added,
    sqrt(noise² - roughness²) of the support plane. The spread of heights at the top, divided by the root of the number
    of images, is added, too. Points above the top, d metres up to 99 % of the heights, are scatter or a rim; the height
    is anywhere up to there, d/√3 rms. Raises InputError if no plane carries the scene.
    """
    support = support or fit_support(cloud)
    x_in_support = apply(inverse(support.base_from_support), cloud.points_in_base)
    plane_label = np.bincount(cloud.label[support.on_plane]).argmax()
    # Mean height of the plane's points without those of one image, for each image.
    off, shown_by = x_in_support[support.on_plane, 2], cloud.image[support.on_plane]
    n = len(cloud.camera_centers_in_base)
    total, count = np.bincount(shown_by, off, n), np.bincount(shown_by, minlength=n)
    plane_without = (off.sum() - total) / np.maximum(len(off) - count, 1)
    bent = np.sqrt(max(support.noise**2 - support.roughness**2, 0.0))
    sizes = []
    for label in np.unique(cloud.label):
        rows = cloud.label == label
        if label in (0, plane_label) or rows.sum() < FEWEST_POINTS:
            continue
        x, image = x_in_support[rows], cloud.image[rows]
        top, spread, rotation_rad, center, sides, within = _shape(x, support.roughness)
        if top <= 0:
            continue
        parts = []
        for k in np.unique(image):
            if (image != k).sum() >= FEWEST_POINTS:
                part = _shape(x[image != k], support.roughness, rotation_rad)
                parts.append([*part[4], part[0] - plane_without[k]])
        size, jackknife = np.array([*sides, top]), np.zeros(3)
        if len(parts) > 1:
            jackknife = np.sqrt((len(parts) - 1) * np.var(parts, axis=0))
        above = max(float(np.quantile(x[:, 2], 0.99)) - top, 0.0)
        of_top = bent, spread / np.sqrt(max(len(parts), 1)), above / np.sqrt(3)
        own = np.array([OUTLINE_CELL / 2, OUTLINE_CELL / 2, np.linalg.norm(of_top)])
        std = np.sqrt(jackknife**2 + own**2 + (scale_std * size) ** 2)
        turn = rotation_exp(np.array([0.0, 0.0, rotation_rad]))
        outline = _outline(within)
        outline = np.column_stack([outline, np.zeros(len(outline))])
        sizes.append(
            ObjectSize(
                label=int(label),
                name=cloud.label_names[label],
                points=len(x),
                height=top,
                height_std=float(std[2]),
                top_seen=bool(jackknife[2] < SAME_TOP * top),
                footprint_in_base=apply(support.base_from_support, outline),
                base_from_box=support.base_from_support @ transform(turn, np.append(center, top / 2)),
                box_size=size,
                box_std=std,
            )
        )
    return Measurement(support, tuple(sorted(sizes, key=lambda size: -size.box_size[0] * size.box_size[1])))


def _shape(
    x_in_support: Float[ndarray, "n 3"], roughness: float, given_rad: float | None = None
) -> tuple[float, float, float, Float[ndarray, "2"], Float[ndarray, "2"], Float[ndarray, "k 2"]]:
    """Return height and spread of the top, rotation, centre and sides of one object, and k points within the sides.

    `x_in_support` are its n points (m), z normal to the support plane; `roughness` is the standard deviation (m) of
    their noise. The spread is the robust standard deviation (m) of heights at the top. The rotation (rad, about z) is
    that from the x axis to the longer side; `given_rad` replaces its estimate. Centre, sides and points are in m and in
    the plane; the sides are the lengths along the rotated x and y axes.
    """
    top, spread = _top(x_in_support[:, 2], roughness)
    xy, area = _dense(x_in_support[:, :2])
    middle = xy.mean(0)
    rotation_rad = given_rad or 0.0
    if given_rad is None:
        hull = _outline(xy - middle)
        _, (length, width), degrees = cv2.minAreaRect(hull.astype(np.float32))
        rotation_rad = float(np.radians(degrees) + np.pi / 2 * (length < width))
    along = (xy - middle) @ _axes(rotation_rad).T
    low, high = np.quantile(along, [SIDE_SHARE, 1 - SIDE_SHARE], axis=0, weights=area, method="inverted_cdf")
    within = ((along >= low) & (along <= high)).all(1)
    center = middle + (low + high) / 2 @ _axes(rotation_rad)
    return top, spread, rotation_rad, center, high - low, xy[within]


def _outline(xy: Float[ndarray, "n 2"]) -> Float[ndarray, "k 2"]:
    """Return the k corners of the convex hull of n points (m), in the order in which they follow each other on it."""
    middle = xy.mean(0)  # float32 is precise near the origin only
    return cv2.convexHull((xy - middle).astype(np.float32))[:, 0] + middle


def _top(height: Float[ndarray, " n"], roughness: float) -> tuple[float, float]:
    """Return the height (m) of an object's top, and the robust standard deviation (m) of its points' heights at the top.

    `height` are the heights of the points above the plane (m), `roughness` the standard deviation (m) of their noise.
    The result is the median height around the highest peak in the density of heights. Peaks below a quarter (TOP_SHARE)
    of the object's mean density are scatter. A high quantile would be 2 % too large for narrow tops.
    """
    width = max(2 * roughness, SHARPEST)
    step = width / 4
    low = height.min()
    count = np.bincount(((height - low) / step).astype(int), minlength=9)
    density = gaussian_filter1d(count.astype(float), width / step, mode="constant")
    span = (np.quantile(height, 0.99) - low) / step + 1
    peak = int(np.flatnonzero(density >= TOP_SHARE * len(height) / max(span, 8.0)).max())
    while peak > 0 and density[peak - 1] >= density[peak]:
        peak -= 1
    around = np.abs(height - (low + (peak + 0.5) * step)) < 2.5 * width
    middle = float(np.median(height[around]))
    return middle, 1.4826 * float(np.median(np.abs(height[around] - middle)))


def _dense(xy: Float[ndarray, "n 2"]) -> tuple[Float[ndarray, "k 2"], Float[ndarray, " k"]]:
    """Return the k of n points (m) that are not in the sparse fringe around an object, and a weight for each.

    The points are counted in square cells of side OUTLINE_CELL in the plane. The fringe are cells with less than 40 %
    (EDGE_SHARE) of the median number. The weight is 1 / number of points in the same cell.
    """
    cell = tuple((np.floor((xy - xy.min(0)) / OUTLINE_CELL).astype(int) + 1).T)
    count = np.zeros([rows.max() + 2 for rows in cell])
    np.add.at(count, cell, 1.0)
    kept = gaussian_filter(count, 0.5, mode="constant")[cell] >= EDGE_SHARE * np.median(count[count > 0])
    if kept.sum() < 3:
        kept[:] = True
    return xy[kept], 1 / count[cell][kept]


def _axes(rotation_rad: float) -> Float[ndarray, "2 2"]:
    """Return the unit vectors of the x and y axes after a counter-clockwise rotation by `rotation_rad`, as rows."""
    return rotation_exp(np.array([0.0, 0.0, -rotation_rad]))[:2, :2]
