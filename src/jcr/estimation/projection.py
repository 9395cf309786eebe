"""Projection of the points of a state into its images, and the derivatives by all columns of the image equations.

An image shows a point at the pixel x = c + A (π − c) + offset, with the projection π and principal point c of its
camera. A = [[e^l, a], [0, e^l]] contains the image's log focal factor l and its shear a (rolling shutter). A thin prism
and the remaining distortion of the camera's model (intrinsics_prior.py) are added.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import by_parameters, by_point, project
from jcr.estimation.elimination import Derivatives
from jcr.estimation.problem import OF_IMAGE, PRISM, Problem, State
from jcr.geometry import skew
from jcr.records import Intrinsics

CENTRE = slice(2, 4)
"""Rows of the principal point among the parameters of a camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ProjectedObservations:
    """Projection of k observed points for one state, with residuals."""

    cameras: tuple[Intrinsics, ...]
    """Intrinsics of each camera in this state."""
    from_rig: Float[ndarray, "k 3"]
    """Vector from the rig to the point, rig axes."""
    from_camera: Float[ndarray, "k 3"]
    """Vector from the camera to the point, rig axes."""
    in_camera: Float[ndarray, "k 3"]
    """Point in the frame of its camera."""
    from_centre_px: Float[ndarray, "k 2"]
    """Pixel predicted by the intrinsics alone, minus the principal point."""
    own_map: Float[ndarray, "k 2"]
    """Focal factor e^l and shear a (px/px) of each observation's image."""
    residual_px: Float[ndarray, "k 2"]
    """Predicted minus observed pixel."""

    @property
    def depth(self) -> Float[ndarray, " k"]:
        """Depth (z in the camera frame) of each point, in units of the world."""
        return self.in_camera[:, 2]


def view_of(problem: Problem, state: State) -> ProjectedObservations:
    """Return the projection of all k observations' points by a state, with residuals (predicted minus observed, px)."""
    observations = problem.observations
    assert observations is not None
    cameras, k = problem.intrinsics(state), len(observations.image)
    from_rig = np.empty((k, 3))
    for pose, rows in zip(state.world_from_rig, problem.seen.rows, strict=True):
        points = state.points_in_world[observations.point[rows]]
        from_rig[rows] = (points - pose[:3, 3]) @ pose[:3, :3]
    from_camera, in_camera = np.empty((k, 3)), np.empty((k, 3))
    from_centre, centre = np.empty((k, 2)), np.empty((k, 2))
    for camera, mount, rows in zip(cameras, state.rig_from_camera, problem.camera_rows, strict=True):
        from_camera[rows] = from_rig[rows] - mount[:3, 3]
        in_camera[rows] = from_camera[rows] @ mount[:3, :3]
        centre[rows] = camera.cx, camera.cy
        from_centre[rows] = project(camera, in_camera[rows]) - centre[rows]
    off = problem.displacement(state)[problem.parameters_of[-1].stop :]
    of_images = off[:-PRISM].reshape(OF_IMAGE, -1)[:, observations.image]
    per_height = _focal_per_height(problem, cameras)
    own_map = np.stack([np.exp(of_images[0]), of_images[1] * per_height], axis=1)
    projected = centre + _mapped(own_map, from_centre[..., None])[..., 0]
    projected += problem.prism @ off[-PRISM:]
    columns = problem.columns
    projected += problem.displacements @ state.camera_steps[columns.cameras.stop : columns.boards.start]
    return ProjectedObservations(
        cameras=cameras,
        from_rig=from_rig,
        from_camera=from_camera,
        in_camera=in_camera,
        from_centre_px=from_centre,
        own_map=own_map,
        residual_px=projected - observations.x_px,
    )


def derivatives(
    problem: Problem, state: State, view: ProjectedObservations, weight: Float[ndarray, " k"]
) -> Derivatives:
    """Return residuals of observations and board corners with their derivatives, times the roots of the weights.

    `weight` (1/px²) is that of each of k observations; corner residuals are in standard deviations. `view` is the
    projection of `state`. Observations and corners are in the order of `Problem.rows`.
    """
    columns, root = problem.columns, np.sqrt(weight)[:, None, None]
    by_rig = root * _by_rig(problem, state, view)
    shared = np.zeros((len(weight), 2, columns.first_rig))
    np.multiply(_by_cameras(problem, state, view), root, out=shared[:, :, columns.cameras])
    np.multiply(problem.displacements, root, out=shared[:, :, columns.cameras.stop : columns.boards.start])
    for own, rows in zip(columns.mounts, problem.camera_rows, strict=True):
        if own is not None:
            rotated = by_rig[rows] @ skew(view.from_camera[rows])
            shared[rows, :, own] = np.concatenate([-by_rig[rows], rotated], axis=2)
    by_world, own = np.empty_like(by_rig), np.empty((len(weight), 2, 6))
    for pose, rows in zip(state.world_from_rig, problem.seen.rows, strict=True):
        rotation = pose[:3, :3]
        here = _rotated(by_rig[rows], rotation)
        by_world[rows] = here
        own[rows, :, :3] = -here
        # A cross product, several times faster than NumPy's.
        away = (view.from_rig[rows] @ rotation.T)[:, None]
        own[rows, :, 3:] = (
            here[..., [1, 2, 0]] * away[..., [2, 0, 1]] - here[..., [2, 0, 1]] * away[..., [1, 2, 0]]
        )
    residual = view.residual_px * root[..., 0]
    of_images = Derivatives(shared=shared, own=own, by_point=by_world, residual=residual)
    if problem.boards is None:
        return of_images
    of_boards = problem.boards.derivatives(
        state.world_from_rig,
        state.points_in_world,
        state.camera_steps[columns.boards],
        columns.boards,
        columns.first_rig,
    )
    both, order = [vars(of_images), vars(of_boards)], problem.rows[0]
    return Derivatives(**{name: np.concatenate([part[name] for part in both])[order] for name in both[0]})


def by_points(problem: Problem, state: State, view: ProjectedObservations) -> Float[ndarray, "k 2 3"]:
    """Return the derivative of each of k projected pixels by its point (px per world unit), in world axes."""
    out = _by_rig(problem, state, view)
    for pose, rows in zip(state.world_from_rig, problem.seen.rows, strict=True):
        out[rows] = _rotated(out[rows], pose[:3, :3])
    return out


def _by_rig(problem: Problem, state: State, view: ProjectedObservations) -> Float[ndarray, "k 2 3"]:
    """Return the derivative of each of k projected pixels by its point (px per world unit), in axes of its rig."""
    out = np.empty((len(view.in_camera), 2, 3))
    for camera, mount, rows in zip(view.cameras, state.rig_from_camera, problem.camera_rows, strict=True):
        out[rows] = _rotated(by_point(camera, view.in_camera[rows]), mount[:3, :3])
    return _mapped(view.own_map, out)


def _by_cameras(problem: Problem, state: State, view: ProjectedObservations) -> Float[ndarray, "k 2 l"]:
    """Return the derivative of each of k projected pixels by steps along the l columns of `Problem.directions`."""
    directions, own_map = problem.directions, view.own_map
    out = np.zeros((len(view.in_camera), 2, directions.shape[1]))
    for camera, own, rows in zip(view.cameras, problem.parameters_of, problem.camera_rows, strict=True):
        columns = _slice(directions[own])
        along = directions[own, columns]
        by_camera = by_parameters(camera, view.in_camera[rows]) @ along
        by_camera = _mapped(own_map[rows], by_camera - along[CENTRE]) + along[CENTRE]
        # The shear is a multiple of the focal length, so it changes with fx.
        sheared_px = own_map[rows, 1] * view.from_centre_px[rows, 1]
        by_camera[:, 0] += (sheared_px / camera.fx)[:, None] * along[0]
        out[rows, :, columns] = by_camera
    assert problem.observations is not None
    first, image = problem.parameters_of[-1].stop, problem.observations.image
    # No column frees parameters of images together with intrinsics, so that these columns are contiguous.
    columns = _slice(directions[first:])
    about, of_images, by_image = view.from_centre_px, directions[first:, columns], out[:, :, columns]
    focal, sheared = of_images[:-PRISM].reshape(OF_IMAGE, problem.n_images, -1)
    shear_px = _focal_per_height(problem, view.cameras) * about[:, 1]
    # Each parameter is added in turn: with hundreds of images one term takes hundreds of megabytes.
    by_image += (own_map[:, :1] * about)[..., None] * focal[image][:, None]
    by_image[:, 0] += shear_px[:, None] * sheared[image]
    if of_images[-PRISM:].any():
        by_image += problem.prism @ of_images[-PRISM:]
    return out


def _slice(directions: Float[ndarray, "r l"]) -> slice:
    """Return the slice of columns from the first to the last with a non-zero entry; an empty slice if all are zero."""
    columns = np.flatnonzero(directions.any(0))
    return slice(columns[0], columns[-1] + 1) if len(columns) else slice(0)


def _mapped(own_map: Float[ndarray, "k 2"], v: Float[ndarray, "k 2 p"]) -> Float[ndarray, "k 2 p"]:
    """Return A v for each observation, A = [[m, a], [0, m]]; focal factor m and shear a are its row of `own_map`."""
    out = own_map[:, :1, None] * v
    out[:, 0] += own_map[:, 1:] * v[:, 1]
    return out


def _focal_per_height(problem: Problem, cameras: tuple[Intrinsics, ...]) -> Float[ndarray, " k"]:
    """Return for each of k observations the focal length fx of its camera over the height of the image (px/px)."""
    return np.array([camera.fx / camera.height for camera in cameras])[problem.layout.camera]


def _rotated(by: Float[ndarray, "k 2 3"], rotation: Float[ndarray, "3 3"]) -> Float[ndarray, "k 2 3"]:
    """Return derivatives (k,2,3) by points in axes of b, from derivatives `by` in axes of a; `rotation` is b_from_a."""
    return (by.reshape(-1, 3) @ rotation.T).reshape(by.shape)
