"""Planes for regions without texture, supported by the matched depth around them.

The method follows ACMP (Xu and Tao, "Planar prior assisted PatchMatch multi-view stereo", AAAI 2020), with a plane for
each region of one colour (Romanoni and Matteucci, "TAPA-MVS", ICCV 2019) and one support plane of the scene, mostly the
table. A pixel takes its plane's depth where the other views show the point in the same colour.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from jcr.depth.colour_regions import FEWEST_OF_REGION, colour_regions, region_planes
from jcr.depth.consistency import colours_agree
from jcr.depth.patch_match_stereo import Relative, grid
from jcr.records import Intrinsics

ON_PLANE = 0.006
"""Largest relative difference of inverse depth at which a matched pixel counts as lying on a plane."""
SAME_COLOUR = 0.1
"""Distance of colours (RGB, 0 to 1, exposure and vignetting compensated) below which two pixels may show one point."""
CONTINUED_SIGMAS = 3.5
"""Distance up to which a plane is continued, in standard deviations of the positions of its supporting pixels. The
support plane is continued without limit."""
CARRIED = 0.5
"""Least share of a region's matched pixels that must lie on its plane."""
STRONG = 0.6
"""Least share of a region's matched pixels on its plane, from which matched pixels off the plane count as wrong: beside
outlines, matching gives the depth of the nearer surface."""
OFF_PLANE = 0.015
"""Relative difference of inverse depth from which a matched pixel off such a plane counts as wrong."""
FEWEST_VIEWS = 2
"""Least number of other images that must show a point in its colour."""
LARGEST_PATCH = 0.02
"""Largest region without a plane of its own that may take the support plane, as a share of the image."""
WHOLE = 0.8
"""Least share of such a region's pixels at which the support plane must be confirmed; an object standing on the plane
shows parallax."""
_PAIRS = 600
"""Largest number of pixels of an image whose brightness is compared with each other image."""


def evened(
    colors: UInt8[ndarray, "m h w 3"],
    inverse_depth: Float[ndarray, "m h w"],
    matched: Bool[ndarray, "m h w"],
    views: Sequence[Relative],
    pinhole: Intrinsics,
) -> Float[ndarray, "m h w 3"]:
    """Return RGB colours (0 to 1) corrected for exposure and vignetting, which are estimated from `matched` pixels.

    `inverse_depth` is 1/z of the pixels; `views` are the projections of each image into its neighbours. The log
    brightness of one point differs between images 1 and 2 by the difference of their exposures plus a·(r₁² - r₂²). Here
    r is the tangent of the angle off the optical axis, and a is common to all images. The fit uses least absolute
    deviations.
    """
    color = colors.astype(np.float32) / 255
    m, h, w = matched.shape
    k = grid(pinhole)
    r2 = (((np.arange(w) - k[2]) / k[0]) ** 2 + ((np.arange(h) - k[3]) / k[1])[:, None] ** 2).astype(
        np.float32
    )
    grey = np.stack([np.log(np.maximum(cv2.blur(image.mean(-1), (5, 5)), 0.02)) for image in color])
    draw = np.random.default_rng(0)
    first, second, difference, radius = [], [], [], []
    for i, view in enumerate(views):
        v, u = np.nonzero(matched[i])
        chosen = draw.permutation(len(v))[:_PAIRS]
        v, u = v[chosen], u[chosen]
        ray = np.stack([(u - k[2]) / k[0], (v - k[3]) / k[1], np.ones(len(u))], -1)
        for j, a, b, _ in zip(*view, strict=True):
            x, y, z = (ray @ a.T + b * inverse_depth[i, v, u][:, None]).T
            x, y = np.rint(x / z), np.rint(y / z)
            inside = (z > 0) & (x >= 0) & (y >= 0) & (x < w) & (y < h)
            x, y = np.where(inside, x, 0).astype(int), np.where(inside, y, 0).astype(int)
            ratio = z / inverse_depth[i, v, u] * inverse_depth[j, y, x]
            one = inside & matched[j, y, x] & (np.abs(ratio - 1) < ON_PLANE)
            first.append(np.full(one.sum(), i))
            second.append(np.full(one.sum(), j))
            difference.append((grey[i, v, u] - grey[j, y, x])[one])
            radius.append((r2[v, u] - r2[y, x])[one])
    rows, right = np.concatenate(first), np.concatenate(difference)
    design = np.zeros((len(rows), m + 1))
    design[np.arange(len(rows)), rows] = 1
    design[np.arange(len(rows)), np.concatenate(second)] -= 1
    design[:, m] = np.concatenate(radius)
    found = np.zeros(m + 1)
    for _ in range(8 if len(rows) else 0):
        weight = 1 / np.maximum(np.abs(right - design @ found), 0.02)
        # The small term fixes the overall exposure, and images that share no point with others.
        normal = (design * weight[:, None]).T @ design + 1e-3 * weight.mean() * np.eye(m + 1)
        found = np.linalg.solve(normal, (design * weight[:, None]).T @ right)
    return np.stack(
        [image * np.exp(-(found[i] + found[m] * r2))[..., None] for i, image in enumerate(color)]
    ).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class PlanarPrior:
    """Maps of the planes of colour regions and of their checks, of one image or of m."""

    inverse_depth: Float[ndarray, "*m h w"]
    holds: Bool[ndarray, "*m h w"]
    """Pixels where two other images (one on the support plane) show the same colour and none sees through the plane."""
    confirms: Bool[ndarray, "*m h w"]
    """Pixels where the plane confirms a match: it holds, or the only other image with the point has the same colour."""
    agreeing: UInt8[ndarray, "*m h w"]
    """Number of images that must agree with the plane's depth, at most 1 on the support plane."""
    contradicts: Bool[ndarray, "*m h w"]
    """Wrong matches: 1.5 % or more off a plane that has 60 % of its region's matches."""
    std: Float[ndarray, "*m h w"]
    """Standard deviation of the inverse depth, relative to it."""


def planar_prior(
    i: int,
    surfaces: tuple[Float[ndarray, "m h w"], Float[ndarray, "m h w 3"]],
    inverse_depth: Float[ndarray, "h w"],
    matched: Bool[ndarray, "h w"],
    view: Relative,
    support: Float[ndarray, "4"],
    recon_from_camera: Float[ndarray, "4 4"],
    camera: tuple[Float[ndarray, "4"], Float[ndarray, "h w 3"]],
) -> PlanarPrior:
    """Fit a plane to the matched depth of each colour region of image i, and check it by the other images.

    `surfaces` are the matched inverse depths of all images (0: none) and their colours, corrected and slightly
    smoothed. `inverse_depth`, `matched` and `recon_from_camera` are those of image i; `view` is its projection into its
    neighbours. `support` is the scene's main plane in the recon frame: unit normal n, and d with n·x + d = 0; 0 for
    none. `camera` are fx, fy, cx, cy and the rays (z = 1) of the pixels.
    """
    (depths, colors), (k, ray) = surfaces, camera
    label, count = colour_regions(colors[i])
    # The support plane as p with p·x = 1 in the camera frame; 0 if it contains the camera centre.
    offset = float(support[:3] @ recon_from_camera[:3, 3] + support[3])
    plane = -recon_from_camera[:3, :3].T @ support[:3] / offset if offset else np.zeros(3)
    found = region_planes(label, count, inverse_depth, matched, ray, plane, ON_PLANE, i)
    # Mahalanobis distance from the pixels that support the region's plane.
    u, v = (axis[label] for axis in found.middle_px.T)
    u, v = np.arange(label.shape[1]) - u, np.arange(label.shape[0])[:, None] - v
    (uu, uv), (_, vv) = found.information.transpose(1, 2, 0)
    away = np.sqrt(np.maximum(uu[label] * u * u + 2 * uv[label] * u * v + vv[label] * v * v, 0))
    # Shadows and prints on the support plane are small regions without a plane of their own.
    size = np.bincount(label.ravel(), minlength=count)
    lonely = _beside(label, found.is_support) & (found.inliers == 0) & (found.matched < FEWEST_OF_REGION)
    lonely &= size < LARGEST_PATCH * label.size
    found.plane[lonely] = plane
    predicted = np.einsum("hwi,hwi->hw", found.plane[label], ray).astype(np.float32)
    carried = (found.inliers > 0) & (found.inliers >= CARRIED * found.matched)
    on_support, whole = found.is_support[label], (found.is_support | lonely)[label]
    near = whole | (away < CONTINUED_SIGMAS)
    asked = (carried | lonely)[label] & (predicted > 0) & near
    points = np.where(asked, predicted, np.float32(0))
    counts = np.zeros((3, *label.shape), np.float32)
    same, unlike, through = colours_agree(counts, i, points, depths, colors, *view[:3], k, SAME_COLOUR)
    holds = asked & (same >= FEWEST_VIEWS) & (same >= 2 * unlike) & (through == 0)
    # Where only one other image sees the point, it must agree, and a match or the support plane must confirm it.
    alone = asked & (same == 1) & (unlike == 0) & (through == 0)
    holds |= alone & on_support
    # On top of an object the plane would lie too low, and colours would differ along its outline in other views.
    holds &= ~(lonely & (np.bincount(label.ravel(), holds.ravel()) / size < WHOLE))[label]
    wrong = asked & (found.inliers >= STRONG * found.matched)[label]
    wrong &= matched & (np.abs(predicted / inverse_depth - 1) > OFF_PLANE)
    return PlanarPrior(
        inverse_depth=predicted,
        holds=holds,
        confirms=holds | alone,
        agreeing=np.where(on_support, np.minimum(same, 1), same).astype(np.uint8),
        contradicts=wrong,
        std=(found.std[label] * np.where(whole, 1.0, np.maximum(away, 1.0))).astype(np.float32),
    )


def _beside(label: Int[ndarray, "h w"], chosen: Bool[ndarray, " r"]) -> Bool[ndarray, " r"]:
    """Return for each of r regions whether it touches one of the `chosen` regions; `label` is each pixel's region.

    Two regions touch if a pixel of one is next to a pixel of the other in a row or column.
    """
    beside = np.zeros(len(chosen), bool)
    for one, other in ((label[:, 1:], label[:, :-1]), (label[1:], label[:-1])):
        beside[one[chosen[other]]] = True
        beside[other[chosen[one]]] = True
    return beside
