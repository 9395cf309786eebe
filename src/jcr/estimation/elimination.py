"""Linear algebra of normal equations: Cholesky factors of dense matrices, and the Schur complement of points.

Each point has a 3x3 block of the normal equations and is coupled to the images that observe it. Eliminating all points
leaves a small dense system (Triggs et al., "Bundle adjustment: a modern synthesis", 2000, section 6).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.linalg import get_lapack_funcs
from scipy.sparse import bsr_array

Matrices = Float[ndarray, "*k n n"]
Columns = Float[ndarray, "*#k n r"]
JITTER = (0.0, 1e-14, 1e-12, 1e-10)
"""Values tried in turn on the diagonal of a correlation matrix whose smallest eigenvalue is lost in rounding."""
_factor, _solve_triangular, _invert, _invert_triangle = get_lapack_funcs(
    ("potrf", "trtrs", "potri", "trtri"), dtype=np.float64
)


def cholesky(matrix: Matrices) -> Matrices:
    """Return the lower Cholesky factors L (...,n,n) of positive semidefinite matrices (...,n,n): L Lᵀ = `matrix`.

    The diagonal of a matrix that is singular up to rounding, as of degenerate motions, is increased slightly.
    """
    if matrix.ndim > 2:
        return np.array([cholesky(each) for each in matrix])
    size = np.sqrt(np.maximum(np.diagonal(matrix), 1e-300))
    scaled = np.empty_like(matrix)
    for rounding in np.cumsum(JITTER):
        np.divide(matrix, size[:, None], out=scaled)
        scaled /= size
        scaled[np.diag_indices(len(scaled))] += rounding
        # A row-major L is a column-major Lᵀ; the factor takes the place of `scaled`.
        root, failed = _factor(scaled.T, lower=0, overwrite_a=1)
        if not failed:
            return np.multiply(root.T, size[:, None], out=scaled)
    np.divide(matrix, np.outer(size, size), out=scaled)
    values, vectors = np.linalg.eigh(scaled)
    r = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, JITTER[-1]))).T, mode="r"))
    return size[:, None] * (r.T * np.sign(np.diag(r)))


def lower(root: Matrices, right: Columns) -> Float[ndarray, "*k n r"]:
    """Return L⁻¹ · right (...,n,r), for lower Cholesky factors L = `root` (...,n,n)."""
    return _triangular(root, right, transposed=False)


def upper(root: Matrices, right: Columns) -> Float[ndarray, "*k n r"]:
    """Return L⁻ᵀ · right (...,n,r), for lower Cholesky factors L = `root` (...,n,n)."""
    return _triangular(root, right, transposed=True)


def over(root: Matrices, right: Columns) -> Float[ndarray, "*k n r"]:
    """Return V⁻¹ · right (...,n,r), for V = L Lᵀ with lower Cholesky factors L = `root` (...,n,n)."""
    return upper(root, lower(root, right))


def inverse_of(root: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    """Return V⁻¹ for V = L Lᵀ, with the lower Cholesky factor L = `root`."""
    half = np.tril(_invert(root, lower=1)[0])
    return half + np.tril(half, -1).T


def inverse_root(root: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    """Return L⁻¹ for the lower Cholesky factor L = `root`."""
    return _invert_triangle(root.T, lower=0)[0].T


def log_root_determinant(root: Matrices) -> Float[ndarray, "*k"] | np.floating:
    """Return log √det V for each V = L Lᵀ, with lower Cholesky factors L = `root` (...,n,n)."""
    return np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(-1)


def _triangular(root: Matrices, right: Columns, transposed: bool) -> Float[ndarray, "*k n r"]:
    """Return L⁻¹ · right (...,n,r), or L⁻ᵀ · right if `transposed`, for lower triangular L = `root` (...,n,n)."""
    # A row-major L is a column-major Lᵀ, which LAPACK takes without a copy.
    if root.ndim == right.ndim == 2:
        return _solve_triangular(root.T, right, lower=0, trans=not transposed)[0]
    right = np.broadcast_to(right, (*root.shape[:-2], *right.shape[-2:]))
    out = np.empty(right.shape)
    for k in np.ndindex(root.shape[:-2]):
        out[k] = _solve_triangular(root[k].T, right[k], lower=0, trans=not transposed)[0]
    return out


POINTS_AT_ONCE = 1024
"""Number of points that are eliminated together, which bounds the memory."""


@dataclass(frozen=True, kw_only=True)
class Derivatives:
    """Derivatives and residuals of k observations, each multiplied by the square root of its weight."""

    shared: Float[ndarray, "k 2 s"]
    """Derivatives by the s columns that all images share (intrinsics, boards, mounts)."""
    own: Float[ndarray, "k 2 o"]
    """Derivatives by the o columns of the observation's own rig (its pose)."""
    by_point: Float[ndarray, "k 2 3"]
    """Derivatives by the observed point, in axes of the world."""
    residual: Float[ndarray, "k 2"]


@dataclass(frozen=True)
class Sightings:
    """Index of observations that are sorted by point and then by image (or by rig: cameras that move together)."""

    image: Int[ndarray, " k"]
    """Image, or rig, of each observation."""
    starts: Int[ndarray, " p"]
    """First observation of each point."""
    rows: list[Int[ndarray, "..."]]
    """Observations of each image, or rig."""

    @staticmethod
    def of(point: Int[ndarray, " k"], image: Int[ndarray, " k"], images: int) -> "Sightings":
        """Return the index of observations from the point and the image (or rig) of each, sorted by point, then image.

        Points are numbered from 0, each with one observation or more. `images` is the number of images (or rigs).
        """
        rows = [np.flatnonzero(image == i) for i in range(images)]
        return Sightings(image, np.flatnonzero(np.diff(point, prepend=-1)), rows)


@dataclass(frozen=True)
class Normal:
    """Normal equations `hessian · step = right` of the d unknowns that are not point coordinates.

    The points were eliminated; `stepped` computes their step from that of the other unknowns.
    """

    hessian: Float[ndarray, "d d"]
    right: Float[ndarray, " d"]
    """Right side: negative gradient."""
    _blocks: list[tuple[ndarray, ndarray, ndarray, ndarray]]
    """For each group of points: rows of its points; its columns; inverse Cholesky factors L⁻¹ of the points' 3x3 blocks;
    L⁻¹ times coupling to the columns, and in the last column L⁻¹ times the gradient."""

    def stepped(self, points: Float[ndarray, "p 3"], step: Float[ndarray, " d"]) -> Float[ndarray, "p 3"]:
        """Return the p points after their Gauss-Newton step, in the same frame as `points`.

        `step` (d,) is the step of all other unknowns, which determines that of the points.
        """
        points = points.copy()
        for chosen, columns, root, half in self._blocks:
            along = half @ np.append(step[columns], 1.0)
            points[chosen] -= (np.swapaxes(root, 1, 2) @ along[..., None])[..., 0]
        return points


def with_fixed_points(
    rows: Derivatives, seen: Sightings
) -> tuple[Float[ndarray, "d d"], Float[ndarray, " d"]]:
    """Return Hessian JᵀJ (d,d) and right side −Jᵀr (d,) of all unknowns but the points, as if the points were fixed.

    The d unknowns are the columns that all images share, then the columns of each rig. J and r are the derivatives and
    residuals in `rows`, whose rigs `seen` lists.
    """
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
    """Return the normal equations of the d unknowns other than the points, which are eliminated (Schur complement).

    `hessian` and `right` are those of `with_fixed_points` for `rows` and `seen`, and are overwritten. `damping`
    increases the diagonal of each point's block by this share.
    """
    s, o = rows.shared.shape[2], rows.own.shape[2]
    blocks, ends = [], np.append(seen.starts, len(seen.image))
    # Points are grouped in the order of their first image, so that each group touches few of many images.
    by_first = np.argsort(seen.image[seen.starts], kind="stable")
    for points in np.array_split(by_first, -(-len(by_first) // POINTS_AT_ONCE)) if len(by_first) else []:
        counts = ends[points + 1] - ends[points]
        begins, of_point = np.cumsum(counts) - counts, np.repeat(np.arange(len(points)), counts)
        of_group = np.repeat(ends[points] - begins, counts) + np.arange(counts.sum())
        images, of_image = np.unique(seen.image[of_group], return_inverse=True)
        # First observation of each point in each image; a rig with several cameras may observe a point several times.
        pairs = np.flatnonzero(np.diff(of_point * len(images) + of_image, prepend=-1))
        own_columns = s + o * np.arange(len(images))[:, None] + np.arange(o)
        columns = np.r_[:s, (s + o * images[:, None] + np.arange(o)).ravel()]
        by_point = rows.by_point[of_group]
        block = np.add.reduceat(np.swapaxes(by_point, 1, 2) @ by_point, begins)
        root = np.linalg.inv(np.linalg.cholesky(_regular(block, damping)))
        by_point = root[of_point] @ np.swapaxes(by_point, 1, 2)
        half = np.zeros((len(points), 3, len(columns) + 1))
        # A sparse product, where NumPy would make one for each observation.
        blocks_of_points = bsr_array((by_point, np.arange(len(of_point)), np.append(begins, len(of_point))))
        shared = blocks_of_points @ rows.shared[of_group].reshape(2 * len(of_point), s)
        half[:, :, :s] = shared.reshape(len(points), 3, s)
        half[:, :, -1:] = np.add.reduceat(by_point @ rows.residual[of_group, :, None], begins)
        places = of_point[pairs, None, None], np.arange(3)[:, None], own_columns[of_image[pairs]][:, None]
        half[places] = np.add.reduceat(by_point @ rows.own[of_group], pairs)
        flat = half.reshape(3 * len(half), -1)
        hessian[np.ix_(columns, columns)] -= flat[:, :-1].T @ flat[:, :-1]
        right[columns] += flat[:, :-1].T @ flat[:, -1]
        blocks.append((points, columns, root, half))
    return Normal(hessian, right, blocks)


def point_blocks(by_point: Float[ndarray, "k 2 3"], starts: Int[ndarray, " n"]) -> Float[ndarray, "n 3 3"]:
    """Return the 3x3 block JᵀJ of each of n points, with a small increase of the diagonal that makes it invertible.

    J is `by_point`, the weighted derivative of k observations by their points, sorted by point. `starts` are the
    indices of the points' first observations.
    """
    return _regular(np.add.reduceat(np.swapaxes(by_point, 1, 2) @ by_point, starts), 0.0)


def _regular(v: Float[ndarray, "n 3 3"], damping: float) -> Float[ndarray, "n 3 3"]:
    """Return the points' 3x3 blocks JᵀJ with their diagonals times 1 + damping, slightly increased; changed in place.

    The small increase makes a block invertible if all rays of its point are parallel.
    """
    v[:, range(3), range(3)] *= 1 + damping
    v[:, range(3), range(3)] += 1e-9 * np.trace(v, axis1=1, axis2=2)[:, None] + 1e-12
    return v
