"""Known shapes of boards and tags, as a normal prior on their corners in bundle adjustment.

A body (board or tag) is a rig that no arm moves. Let R and t be its pose, e^l its size and D a its deformation. A corner
printed at x whose point is at p in the world has the residual e^(-l) Rᵀ (p - t) - x - D a, independent of the world's
similarity. All bodies of a capture come from one printer, so they share l. A deformation is a stretch or a smooth bend;
the remaining errors are independent from corner to corner.

Measured sizes: ten real boards of 100 to 250 mm have 0.05 to 0.25 mm rms about a second-order surface, triangulation
included (docs/results/real.md). Sheets bend by up to 3.6 mm, which the corners show to a few hundredths.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from numpy.polynomial.legendre import legvander2d

from jcr.estimation.elimination import Derivatives
from jcr.geometry import apply, fit_similarity, skew
from jcr.records import Boards

CORNER_STD_M = np.array([5e-5, 5e-5, 1e-4])
"""Standard deviation of a single corner along each axis of its body."""
STRETCH_STD = 1e-3
"""Prior standard deviation of the relative stretch of a printed board's x axis over its y axis."""
STRETCHED_STD = 0.1
"""Prior standard deviation of the stretch of a board that is known to be stretched; large, to have no influence."""
BEND_STD_M = {2: 3e-4, 3: 1e-4}
"""Prior standard deviation of a board's bend (m rms) by each polynomial of degree 2, and of degree 3."""
SIZE_STD = 10.0
"""Prior standard deviation of the log size l; large, because the unit of the world is unknown."""
FEWEST_TO_BEND = 9
"""Smallest number of corners of a body whose deformation is estimated."""
FEWEST_CORNERS = 4
"""Smallest number of corners that determine the pose of a body."""


@dataclass(frozen=True, kw_only=True)
class BoardShapes:
    """Prior on the positions of c board and tag corners: printed positions and s shape parameters.

    The shape parameters are the log size, which all bodies (boards, tags) share, then the deformations of each body.
    """

    point: Int[ndarray, " c"]
    """Point of each corner, ascending."""
    body: Int[ndarray, " c"]
    """Body of each corner."""
    first_rig: int
    """Rig of the first body."""
    x_in_body: Float[ndarray, "c 3"]
    """Printed position of each corner in its body, in units of the world at the initial state."""
    by_shape: Float[ndarray, "c 3 s"]
    """Displacement of each corner by each shape parameter; 0 for the first, the log size."""
    shape_std: Float[ndarray, " s"]
    """Prior standard deviation of each shape parameter."""
    unit: float
    """Length of one stated metre, in units of the world at the initial state."""

    @property
    def rig(self) -> Int[ndarray, " c"]:
        """Rig number of each corner's body (board or tag)."""
        return self.first_rig + self.body

    def residual(
        self,
        world_from_rig: Float[ndarray, "m 4 4"],
        points_in_world: Float[ndarray, "p 3"],
        shape: Float[ndarray, " s"],
    ) -> Float[ndarray, "c 3"]:
        """Return corner minus expected corner (printed position + deformation) along body axes, in standard deviations.

        `shape` are the s shape parameters; the corners are the rows `point` of `points_in_world`. Corner positions are
        divided by the estimated size, the exponential of `shape[0]`.
        """
        pose = world_from_rig[self.rig]
        ahead = points_in_world[self.point] - pose[:, :3, 3]
        in_body = np.exp(-shape[0]) * (ahead[:, None] @ pose[:, :3, :3])[:, 0]
        return (in_body - self.x_in_body - self.by_shape @ shape) / CORNER_STD_M

    def derivatives(
        self,
        world_from_rig: Float[ndarray, "m 4 4"],
        points_in_world: Float[ndarray, "p 3"],
        shape: Float[ndarray, " s"],
        columns: slice,
        shared: int,
    ) -> Derivatives:
        """Return residuals and derivatives of the corners as two observations each: (x, y), and (z, 0).

        The image equations have `shared` columns that are common to all images; `columns` are the s shape parameters
        among them. Other arguments are those of `residual`; residuals are in standard deviations.
        """
        c = len(self.point)
        residual, by = np.zeros((c, 4)), np.zeros((c, 4, shared + 9))
        residual[:, :3] = self.residual(world_from_rig, points_in_world, shape)
        to_body = np.exp(-shape[0]) * np.swapaxes(world_from_rig[self.rig, :3, :3], 1, 2)
        ahead = points_in_world[self.point] - world_from_rig[self.rig, :3, 3]
        by_shape = -self.by_shape
        by_shape[:, :, 0] -= (to_body @ ahead[..., None])[..., 0]
        by[:, :3, columns] = by_shape
        by[:, :3, shared : shared + 3] = -to_body
        by[:, :3, shared + 3 : shared + 6] = to_body @ skew(ahead)
        by[:, :3, shared + 6 :] = to_body
        by[:, :3] /= CORNER_STD_M[:, None]
        by = by.reshape(2 * c, 2, -1)
        return Derivatives(
            shared=by[:, :, :shared],
            own=by[:, :, shared : shared + 6],
            by_point=by[:, :, shared + 6 :],
            residual=residual.reshape(-1, 2),
        )


def shapes_of(
    boards: Boards | None, points_in_world: Float[ndarray, "p 3"], seen: Bool[ndarray, " p"], first_rig: int
) -> tuple[BoardShapes | None, Float[ndarray, "b 4 4"]]:
    """Return the shape prior of boards with corners among the points, and initial world_from_body of each of b bodies.

    A body is a board or tag; its rig number is `first_rig` plus the number of the body. Only corners whose points are
    `seen` (observed), and bodies with at least four of them, are used. The prior is None without bodies. World is the
    frame of `points_in_world`.
    """
    bodies = []
    for body in () if boards is None else boards.bodies:
        rows = np.flatnonzero(seen[body.point])
        x, there = body.x_in_body[rows], points_in_world[body.point[rows]]
        if len(rows) < FEWEST_CORNERS or np.linalg.matrix_rank(x - x.mean(0), tol=0.1 * np.ptp(x)) < 2:
            continue
        pose, size = fit_similarity(there, x)
        if np.abs(apply(pose, size * x) - there).max() < size * np.ptp(x):
            bodies.append((body.point[rows], x, pose, size))
    if not bodies:
        return None, np.zeros((0, 4, 4))
    points, x_in_body, poses, sizes = zip(*bodies, strict=True)
    corners = [len(point) for point in points]
    unit = float(np.average(sizes, weights=corners))
    assert boards is not None
    stretch_std = STRETCHED_STD if boards.is_stretched else STRETCH_STD
    ways, std = zip(*(_deformations(unit * x, stretch_std) for x in x_in_body), strict=True)
    each = np.split(np.arange(sum(corners)), np.cumsum(corners)[:-1])
    by_shape, column = np.zeros((sum(corners), 3, 1 + sum(map(len, std)))), 1
    for rows, own in zip(each, ways, strict=True):
        by_shape[rows, :, column : column + own.shape[2]] = own
        column += own.shape[2]
    point = np.concatenate(points)
    order = np.argsort(point)
    shapes = BoardShapes(
        point=point[order],
        body=np.repeat(np.arange(len(bodies)), corners)[order],
        first_rig=first_rig,
        x_in_body=unit * np.concatenate(x_in_body)[order],
        by_shape=by_shape[order],
        shape_std=np.concatenate([[SIZE_STD], *std]),
        unit=unit,
    )
    return shapes, np.stack(poses)


def _deformations(
    x: Float[ndarray, "c 3"], stretch_std: float
) -> tuple[Float[ndarray, "c 3 w"], Sequence[float]]:
    """Return w deformations of a body with corners printed at `x` (m), and the prior standard deviation of each.

    Each is a displacement of the c corners: a relative stretch of x over y, then bends in z with an rms of 1. With
    fewer than nine corners w is 0.
    """
    if len(x) < FEWEST_TO_BEND:
        return np.zeros((len(x), 3, 0)), ()
    across = x[:, :2] - x[:, :2].mean(0)
    stretch = np.column_stack([across[:, 0] / 2, -across[:, 1] / 2, np.zeros(len(x))])
    ways, std = [stretch], [stretch_std]
    u, v = (2 * across / np.ptp(across, axis=0)).T
    every = legvander2d(u, v, [3, 3]).reshape(-1, 4, 4)
    degree = np.add.outer(np.arange(4), np.arange(4))
    basis = np.concatenate([every[:, degree == d] for d in range(4)], axis=1)
    heights, found = np.linalg.qr(basis)
    shown = np.abs(found.diagonal()) > 1e-3 * np.sqrt(len(x))
    for k, d in enumerate(np.repeat(range(4), range(1, 5))):
        if d >= 2 and shown[k]:
            ways.append(np.column_stack([np.zeros((len(x), 2)), np.sqrt(len(x)) * heights[:, k]]))
            std.append(BEND_STD_M[int(d)])
    return np.stack(ways, axis=2), std
