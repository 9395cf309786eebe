"""Linear algebra of normal equations: Cholesky factors of dense matrices, and the Schur complement of points.

A point's block is 3x3 and touches its own observations alone; without the points a small dense system is left (Triggs
et al., "Bundle adjustment: a modern synthesis", 2000, section 6).
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.linalg import get_lapack_funcs

Matrices = Float[ndarray, "*k n n"]
Columns = Float[ndarray, "*#k n r"]
JITTER = (0.0, 1e-14, 1e-12, 1e-10)
"""Added to correlations whose least eigenvalue is lost in rounding."""
_solve_triangular, _invert = get_lapack_funcs(("trtrs", "potri"), dtype=np.float64)


def cholesky(matrix: Matrices) -> Matrices:
    """Return L of a matrix that is positive definite but for rounding, which that of degenerate motions is not."""
    size = np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), 1e-300))
    scaled = matrix / size[..., :, None] / size[..., None, :]
    for rounding in JITTER:
        try:
            return size[..., None] * np.linalg.cholesky(scaled + rounding * np.eye(matrix.shape[-1]))
        except np.linalg.LinAlgError:
            if matrix.ndim > 2:
                return np.array([cholesky(each) for each in matrix])
    values, vectors = np.linalg.eigh(scaled)
    r = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, JITTER[-1]))).T, mode="r"))
    return size[:, None] * (r.T * np.sign(np.diag(r)))


def lower(root: Matrices, right: Columns) -> Float[ndarray, "*k n r"]:
    """Return L⁻¹ times matrices."""
    return _triangular(root, right, transposed=False)


def upper(root: Matrices, right: Columns) -> Float[ndarray, "*k n r"]:
    """Return L⁻ᵀ times matrices."""
    return _triangular(root, right, transposed=True)


def over(root: Matrices, right: Columns) -> Float[ndarray, "*k n r"]:
    """Return V⁻¹ times matrices."""
    return upper(root, lower(root, right))


def inverse_of(root: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    """Return V⁻¹."""
    half = np.tril(_invert(root, lower=1)[0])
    return half + np.tril(half, -1).T


def log_root_determinant(root: Matrices) -> Float[ndarray, "*k"] | np.floating:
    """Return log √det V."""
    return np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(-1)


def _triangular(root: Matrices, right: Columns, transposed: bool) -> Float[ndarray, "*k n r"]:
    # A row-major L is a column-major Lᵀ, which LAPACK takes without a copy.
    if root.ndim == right.ndim == 2:
        return _solve_triangular(root.T, right, lower=0, trans=not transposed)[0]
    right = np.broadcast_to(right, (*root.shape[:-2], *right.shape[-2:]))
    out = np.empty(right.shape)
    for k in np.ndindex(root.shape[:-2]):
        out[k] = _solve_triangular(root[k].T, right[k], lower=0, trans=not transposed)[0]
    return out


POINTS_AT_ONCE = 1024
"""Points whose coupling to the cameras is in memory together."""


@dataclass(frozen=True, kw_only=True)
class Derivatives:
    """Derivatives of observations, and their residuals, all times the root of their weights."""

    shared: Float[ndarray, "k 2 s"]
    """Derivatives by the columns that all images share, which come first."""
    own: Float[ndarray, "k 2 o"]
    """Derivatives by the `o` columns that each image has of its own."""
    by_point: Float[ndarray, "k 2 3"]
    residual: Float[ndarray, "k 2"]


def in_order(order: Int[ndarray, " k"], *parts: Derivatives) -> Derivatives:
    """Return the rows of several parts, one after the other, in another order."""
    names = ("shared", "own", "by_point", "residual")
    return Derivatives(
        **{name: np.concatenate([getattr(part, name) for part in parts])[order] for name in names}
    )


@dataclass(frozen=True, kw_only=True)
class _Group:
    """Points that are eliminated together, because few of many images show them."""

    points: Int[ndarray, " n"]
    rows: Int[ndarray, " k"]
    """Row numbers of their observations, point by point."""
    batches: list[tuple[slice, slice]]
    """Points with equally many observations, and these observations."""
    images: Int[ndarray, " i"]
    """Images that show any of them."""
    pairs: Int[ndarray, " j"]
    """First observation of each point in each image: rigs see a point by several cameras."""
    point: Int[ndarray, " j"]
    """Index of each pair's point in `points`."""
    image: Int[ndarray, " j"]
    """Index of each pair's image in `images`."""


@dataclass(frozen=True)
class Sightings:
    """Points and the images that show them."""

    rows: list[Int[ndarray, "..."]]
    """Observations of each image."""
    starts: Int[ndarray, " p"]
    """Each point's first observation."""
    groups: list[_Group]

    @staticmethod
    def of(point: Int[ndarray, " k"], image: Int[ndarray, " k"], images: int) -> "Sightings":
        """Return the sightings of observations sorted by point and then by image, each point with at least one."""
        starts = np.flatnonzero(np.diff(point, prepend=-1))
        rows = [np.flatnonzero(image == i) for i in range(images)]
        return Sightings(rows, starts, _groups(starts, image))


@dataclass(frozen=True)
class Normal:
    """The normal equations after the points are eliminated."""

    hessian: Float[ndarray, "d d"]
    right: Float[ndarray, " d"]
    _blocks: list[tuple[ndarray, ndarray, ndarray, ndarray]]
    """Per group its points, its columns, the inverse roots of the points' own blocks, and these times their coupling to
    the columns and their gradients."""

    def stepped(self, points: Float[ndarray, "p 3"], step: Float[ndarray, " d"]) -> Float[ndarray, "p 3"]:
        """Return the points after the Gauss-Newton step that belongs to a step of all other unknowns."""
        points = points.copy()
        for chosen, columns, root, half in self._blocks:
            along = half @ np.append(step[columns], 1.0)
            points[chosen] -= (np.swapaxes(root, 1, 2) @ along[..., None])[..., 0]
        return points


def with_fixed_points(
    rows: Derivatives, seen: Sightings
) -> tuple[Float[ndarray, "d d"], Float[ndarray, " d"]]:
    """Return Hessian and right side of all unknowns but the points."""
    s, o = rows.shared.shape[2], rows.own.shape[2]
    size = s + o * len(seen.rows)
    hessian, right = np.zeros((size, size)), np.zeros(size)
    shared = rows.shared.reshape(2 * len(rows.shared), s)
    hessian[:s, :s], right[:s] = shared.T @ shared, -(shared.T @ rows.residual.ravel())
    for i, of_image in enumerate(seen.rows):
        columns = slice(s + o * i, s + o * (i + 1))
        own = rows.own[of_image].reshape(-1, o)
        coupling = rows.shared[of_image].reshape(len(own), s).T @ own
        hessian[:s, columns], hessian[columns, :s] = coupling, coupling.T
        hessian[columns, columns], right[columns] = own.T @ own, -(own.T @ rows.residual[of_image].ravel())
    return hessian, right


def without_points(
    hessian: Float[ndarray, "d d"],
    right: Float[ndarray, " d"],
    rows: Derivatives,
    seen: Sightings,
    damping: float = 0.0,
) -> Normal:
    """Return the equations of all unknowns but the points, in place, with the Schur complement of the points."""
    s, o = rows.shared.shape[2], rows.own.shape[2]
    blocks = []
    for group in seen.groups:
        own_columns = s + o * np.arange(len(group.images))[:, None] + np.arange(o)
        columns = np.r_[:s, (s + o * group.images[:, None] + np.arange(o)).ravel()]
        root, half = np.empty((len(group.points), 3, 3)), np.zeros((len(group.points), 3, len(columns) + 1))
        by_point = np.empty((len(group.rows), 2, 3))
        for points, observations in group.batches:
            of_batch, count = group.rows[observations], points.stop - points.start
            of_point = rows.by_point[of_batch].reshape(count, -1, 3)
            block = _regular(np.swapaxes(of_point, 1, 2) @ of_point, damping)
            root[points] = np.linalg.inv(np.linalg.cholesky(block))
            of_point = of_point @ np.swapaxes(root[points], 1, 2)
            by_point[observations], flat = of_point.reshape(-1, 2, 3), np.swapaxes(of_point, 1, 2)
            half[points, :, :s] = flat @ rows.shared[of_batch].reshape(count, flat.shape[2], s)
            half[points, :, -1:] = flat @ rows.residual[of_batch].reshape(count, -1, 1)
        places = group.point[:, None, None], np.arange(3)[:, None], own_columns[group.image][:, None]
        half[places] = np.add.reduceat(np.swapaxes(by_point, 1, 2) @ rows.own[group.rows], group.pairs)
        flat = half.reshape(3 * len(half), -1)
        hessian[np.ix_(columns, columns)] -= flat[:, :-1].T @ flat[:, :-1]
        right[columns] += flat[:, :-1].T @ flat[:, -1]
        blocks.append((group.points, columns, root, half))
    return Normal(hessian, right, blocks)


def point_blocks(by_point: Float[ndarray, "k 2 3"], starts: Int[ndarray, " n"]) -> Float[ndarray, "n 3 3"]:
    """Return each point's own block of the normal equations."""
    return _regular(np.add.reduceat(np.swapaxes(by_point, 1, 2) @ by_point, starts), 0.0)


def _regular(v: Float[ndarray, "n 3 3"], damping: float) -> Float[ndarray, "n 3 3"]:
    """Return blocks that are damped, and regular where the rays of a point are parallel."""
    v[:, range(3), range(3)] *= 1 + damping
    v[:, range(3), range(3)] += 1e-9 * np.trace(v, axis1=1, axis2=2)[:, None] + 1e-12
    return v


def _groups(starts: Int[ndarray, " p"], image: Int[ndarray, " k"]) -> list[_Group]:
    """Return groups of points in the order of the first image that shows them, which few other images share.

    Within a group the points are in the order of the number of their observations.
    """
    if len(starts) == 0:
        return []
    seen = np.diff(np.r_[starts, len(image)])
    by_first = np.argsort(image[starts], kind="stable")
    groups = []
    for points in np.array_split(by_first, -(-len(by_first) // POINTS_AT_ONCE)):
        points = points[np.argsort(seen[points], kind="stable")]
        counts = seen[points]
        begins = np.cumsum(counts) - counts
        rows = np.repeat(starts[points] - begins, counts) + np.arange(counts.sum())
        images, of_image = np.unique(image[rows], return_inverse=True)
        of_point = np.repeat(np.arange(len(points)), counts)
        pairs = np.flatnonzero(np.diff(of_point * len(images) + of_image, prepend=-1))
        edges = np.r_[np.flatnonzero(np.diff(counts, prepend=-1)), len(counts)].tolist()
        ends = np.r_[0, np.cumsum(counts)].tolist()
        groups.append(
            _Group(
                points=points,
                rows=rows,
                batches=[(slice(a, b), slice(ends[a], ends[b])) for a, b in pairwise(edges)],
                images=images,
                pairs=pairs,
                point=of_point[pairs],
                image=of_image[pairs],
            )
        )
    return groups
