"""Normal equations of many points in images, with the points eliminated by the Schur complement.

An observation depends on what all of them share (where a camera is mounted, its intrinsics), on where its own image was
taken from, and on its point. A point's block is 3x3 and touches its own observations alone; what is left without them is
a small dense system (Triggs et al., "Bundle adjustment: a modern synthesis", 2000, section 6).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

POINTS_AT_ONCE = 1024
"""Points whose coupling to the cameras is held in memory together."""


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of observations, and their residuals, all times the root of their weights."""

    shared: Float[ndarray, "k 2 s"]
    """By what all images share: the first columns of the equations."""
    own: Float[ndarray, "k 2 o"]
    """By what each image has of its own: `o` more columns an image."""
    by_point: Float[ndarray, "k 2 3"]
    residual: Float[ndarray, "k 2"]


@dataclass(frozen=True)
class _Group:
    """Points that are eliminated together, for they are seen by few images of many."""

    points: Int[ndarray, " n"]
    rows: Int[ndarray, " k"]
    """Of their observations, point by point."""
    starts: Int[ndarray, " n"]
    """Each point's first observation."""
    images: Int[ndarray, " i"]
    """That see any of them."""
    pairs: Int[ndarray, " j"]
    """First observation of each point in each image: rigs see a point by several cameras."""
    point: Int[ndarray, " j"]
    """Of each pair, in `points`."""
    image: Int[ndarray, " j"]
    """Of each pair, in `images`."""


@dataclass(frozen=True)
class Sightings:
    """Which points are seen in which images."""

    rows: list[Int[ndarray, "..."]]
    """Observations of each image."""
    starts: Int[ndarray, " p"]
    """Each point's first observation."""
    groups: list[_Group]

    @staticmethod
    def of(point: Int[ndarray, " k"], image: Int[ndarray, " k"], images: int) -> "Sightings":
        """Of observations sorted by point and then by image, every point with at least one."""
        starts = np.flatnonzero(np.diff(point, prepend=-1))
        rows = [np.flatnonzero(image == i) for i in range(images)]
        return Sightings(rows, starts, _groups(starts, image))


@dataclass(frozen=True)
class Normal:
    """The normal equations after the points are eliminated."""

    hessian: Float[ndarray, "d d"]
    right: Float[ndarray, " d"]
    _blocks: list[tuple[ndarray, ndarray, ndarray, ndarray, ndarray]]
    """Per group its points, its columns, and the points' own blocks, their coupling to the columns, and gradients."""

    def stepped(self, points: Float[ndarray, "p 3"], step: Float[ndarray, " d"]) -> Float[ndarray, "p 3"]:
        """The points after the Gauss-Newton step that belongs to a step of everything else."""
        points = points.copy()
        for chosen, columns, v, w, g in self._blocks:
            points[chosen] -= np.linalg.solve(v, (g + w @ step[columns])[..., None])[..., 0]
        return points


def with_points_held(
    rows: Derivatives, seen: Sightings
) -> tuple[Float[ndarray, "d d"], Float[ndarray, " d"]]:
    """Hessian and right side of everything but the points."""
    s, o = rows.shared.shape[2], rows.own.shape[2]
    size = s + o * len(seen.rows)
    hessian, right = np.zeros((size, size)), np.zeros(size)
    for i, of_image in enumerate(seen.rows):
        block = np.concatenate([rows.shared[of_image], rows.own[of_image]], axis=2).reshape(-1, s + o)
        columns = np.r_[0:s, s + o * i : s + o * (i + 1)]
        hessian[np.ix_(columns, columns)] += block.T @ block
        right[columns] -= block.T @ rows.residual[of_image].ravel()
    return hessian, right


def without_points(
    hessian: Float[ndarray, "d d"],
    right: Float[ndarray, " d"],
    rows: Derivatives,
    seen: Sightings,
    damping: float = 0.0,
) -> Normal:
    """The equations of everything but the points, in place, with what the points could take up taken from them."""
    s, o = rows.shared.shape[2], rows.own.shape[2]
    blocks = []
    for group in seen.groups:
        own_columns = s + o * np.arange(len(group.images))[:, None] + np.arange(o)
        columns = np.r_[:s, (s + o * group.images[:, None] + np.arange(o)).ravel()]
        by_point = rows.by_point[group.rows]
        transposed = np.swapaxes(by_point, 1, 2)
        v = point_blocks(by_point, group.starts, damping)
        w = np.zeros((len(v), 3, len(columns)))
        w[:, :, :s] = np.add.reduceat(transposed @ rows.shared[group.rows], group.starts)
        places = group.point[:, None, None], np.arange(3)[:, None], own_columns[group.image][:, None]
        w[places] = np.add.reduceat(transposed @ rows.own[group.rows], group.pairs)
        g = np.add.reduceat((transposed @ rows.residual[group.rows][..., None])[..., 0], group.starts)
        half = np.linalg.solve(np.linalg.cholesky(v), np.concatenate([w, g[..., None]], axis=2))
        half = half.reshape(3 * len(v), -1)
        hessian[np.ix_(columns, columns)] -= half[:, :-1].T @ half[:, :-1]
        right[columns] += half[:, :-1].T @ half[:, -1]
        blocks.append((group.points, columns, v, w, g))
    return Normal(hessian, right, blocks)


def point_blocks(
    by_point: Float[ndarray, "k 2 3"], starts: Int[ndarray, " n"], damping: float = 0.0
) -> Float[ndarray, "n 3 3"]:
    """The points' own blocks of the normal equations, kept from being singular where their rays are parallel."""
    v = np.add.reduceat(np.swapaxes(by_point, 1, 2) @ by_point, starts)
    v[:, range(3), range(3)] *= 1 + damping
    v[:, range(3), range(3)] += 1e-9 * np.trace(v, axis1=1, axis2=2)[:, None] + 1e-12
    return v


def _groups(starts: Int[ndarray, " p"], image: Int[ndarray, " k"]) -> list[_Group]:
    """Points in the order of the first image that sees them: those beside each other are seen by few others."""
    if len(starts) == 0:
        return []
    seen = np.diff(np.r_[starts, len(image)])
    by_first = np.argsort(image[starts], kind="stable")
    groups = []
    for points in np.array_split(by_first, -(-len(by_first) // POINTS_AT_ONCE)):
        counts = seen[points]
        begins = np.cumsum(counts) - counts
        rows = np.repeat(starts[points] - begins, counts) + np.arange(counts.sum())
        images, of_image = np.unique(image[rows], return_inverse=True)
        of_point = np.repeat(np.arange(len(points)), counts)
        pairs = np.flatnonzero(np.diff(of_point * len(images) + of_image, prepend=-1))
        groups.append(_Group(points, rows, begins, images, pairs, of_point[pairs], of_image[pairs]))
    return groups
