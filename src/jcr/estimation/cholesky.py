"""Positive definite matrices V = L Lᵀ by their lower Cholesky factor L, one matrix or a stack of k.

LAPACK is called directly: SciPy's checks take longer than a system of a few dozen poses, and NumPy solves stacks of
triangular systems by a general elimination.
"""

import numpy as np
from jaxtyping import Float
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
