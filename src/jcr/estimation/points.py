"""Where the points of an solution scene are in the arm's frame, and how well that is known.

The mixed model of robots.py has eliminated the rigs and the points. What is left unknown of them follows backwards: of
the rigs given everything else, then of the points given rigs and cameras.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.estimation.cholesky import cholesky, over
from jcr.estimation.elimination import point_blocks
from jcr.estimation.equation import BASE_ROTATION, BASE_TRANSLATION, SCALE, pose_by_pose
from jcr.estimation.pose_equations import reported_poses
from jcr.estimation.projection import derivatives
from jcr.estimation.solve import Solution
from jcr.geometry import by_similarity

SOME = 300
"""Points whose uncertainty stands for that of all."""


@dataclass(frozen=True)
class PointsPlaced:
    """Some points in the frame that the first arm's poses are in, and how they err there (m²)."""

    in_base: Float[ndarray, "p 3"]
    together: Float[ndarray, "p 3 p 3"]
    """Covariance that rigs, cameras and arms give them, which they share."""
    own: Float[ndarray, "p 3 3"]
    """Of the triangulation of each by itself."""


def points_in_base(solution: Solution) -> PointsPlaced:
    """Some of the solution points."""
    placed, images = solution.most_likely, solution.images
    count = len(images.state.points_in_world)
    some = np.sort(np.random.default_rng(0).permutation(count)[:SOME])
    base_from_world, scale = placed.z[0][:3, :3], placed.scale
    ahead = scale * images.state.points_in_world[some] @ base_from_world.T
    by_column, own = _of_points(solution, some)
    by_column = scale * base_from_world @ by_column
    by_unknown, of_columns = _of_columns(solution)
    j = by_column @ by_unknown
    of_frame = by_similarity(ahead)
    j[:, :, BASE_TRANSLATION] += of_frame[:, :, :3]
    j[:, :, BASE_ROTATION] += of_frame[:, :, 3:6]
    j[:, :, SCALE] += of_frame[:, :, 6:]
    j, by_column = j.reshape(3 * len(some), -1), by_column.reshape(3 * len(some), -1)
    together = j @ solution.covariance @ j.T + by_column @ of_columns @ by_column.T
    return PointsPlaced(
        ahead + placed.z[0][:3, 3],
        together.reshape(len(some), 3, len(some), 3),
        scale**2 * base_from_world @ own @ base_from_world.T,
    )


def _of_points(
    solution: Solution, some: Int[ndarray, " n"]
) -> tuple[Float[ndarray, "n 3 d"], Float[ndarray, "n 3 3"]]:
    """How points move with the columns of the images' evidence, and their covariance where these stand still."""
    images, problem = solution.images, solution.problem
    _, rows_point, rows_rig, _ = problem.rows
    rows = np.flatnonzero(np.isin(rows_point, some))
    point = np.searchsorted(some, rows_point[rows])
    by = derivatives(problem, images.state, images.view, images.weight)
    by_point = by.by_point[rows]
    starts = np.flatnonzero(np.diff(point, prepend=-1))
    blocks = point_blocks(by_point, starts)
    first = problem.columns.first_rig
    columns = np.zeros((len(rows), 2, len(images.gradient)))
    columns[:, :, :first] = by.shared[rows]
    own = first + 6 * rows_rig[rows][:, None] + np.arange(6)
    columns[np.arange(len(rows))[:, None, None], np.arange(2)[:, None], own[:, None]] = by.own[rows]
    coupling = np.add.reduceat(np.swapaxes(by_point, 1, 2) @ columns, starts)
    return -np.linalg.solve(blocks, coupling), np.linalg.inv(blocks)


def _of_columns(solution: Solution) -> tuple[Float[ndarray, "d p"], Float[ndarray, "d d"]]:
    """How the columns of the images' evidence step with the unknowns of the mixed model, and their covariance where
    these stand still: of rigs, what the reported poses and the images leave."""
    problem, equations, rigs = solution.problem, solution.equations, solution.images.rigs
    by_rig = reported_poses(problem, solution.most_likely)[2]
    shown = pose_by_pose(by_rig, rigs.covariance)
    gain = over(cholesky(equations.covariance(solution.log_sizes)), shown).T
    robots, columns, free, by_arm = problem.arm_unknowns, problem.columns.count, problem.free, problem.by_arm
    by_unknown = np.zeros((columns, len(solution.covariance)))
    by_unknown[free, robots + np.arange(len(free))] = 1.0
    by_unknown[by_arm] = -gain @ equations.jacobian
    by_unknown[by_arm, robots:] -= rigs.follow
    left = np.zeros((columns, columns))
    left[np.ix_(by_arm, by_arm)] = rigs.covariance - gain @ shown
    return by_unknown, left
