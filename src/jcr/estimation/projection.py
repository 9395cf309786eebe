"""Observations as a scene projects them, and their derivatives by everything that moves.

An image takes its points as its camera does, but for nuisances of its own. With the camera's projection π and principal
point c it is x = c + A (π − c) + offset, where A = [[e^l, a], [0, e^l]] holds the image's own focal length e^l and the
shear a of a rolling shutter. To that come a thin prism and what the camera's model leaves (model_error.py).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import by_parameters, by_point, project, unproject
from jcr.estimation.elimination import Derivatives, Sightings, in_order
from jcr.estimation.model_error import TYPICAL, displacements
from jcr.estimation.pixel_noise import Layout
from jcr.estimation.scene import OF_IMAGE, PRISM, Freedom, Nuisances, Observations, RigInformation, Scene
from jcr.geometry import skew

CENTRE = slice(2, 4)
"""Of the parameters of a camera."""


@dataclass(frozen=True, kw_only=True)
class ImageProblem:
    """What stays fixed; observations sorted by point, then by rig.

    The rows of the equations are the observations and, where there are boards, what these show of their own corners.
    """

    observations: Observations
    points: Int[ndarray, " p"]
    """Of the points that were given, those that two or more observations show."""
    freedom: Freedom
    prior: RigInformation | None
    """What others than these images and the robots know of the rigs; it is part of the evidence."""
    seen: Sightings
    """By rigs."""
    layout: Layout
    displacements: Float[ndarray, "k 2 e"]
    """Of each observation by what its camera's model leaves (px); no column where intrinsics are exact."""
    rows_order: Int[ndarray, " r"]
    """That sorts the rows of the equations by point: observations first, then two a corner."""
    rows_point: Int[ndarray, " r"]
    """Of each row, sorted."""
    rows_rig: Int[ndarray, " r"]
    """Of each row, sorted."""
    rows_seen: Sightings
    """By rigs, of the sorted rows."""

    @staticmethod
    def of(
        scene: Scene, observations: Observations, freedom: Freedom, prior: RigInformation | None = None
    ) -> "ImageProblem":
        """Of observations in any order; of several of one point in one image the first counts."""
        order = np.lexsort((observations.image, observations.rig[observations.image], observations.point))
        point, image = observations.point[order], observations.image[order]
        order = order[np.r_[True, (np.diff(point) != 0) | (np.diff(image) != 0)]]
        count = np.bincount(observations.point[order], minlength=len(scene.points_in_world))
        order = order[count[observations.point[order]] >= 2]
        kept, point = np.unique(observations.point[order], return_inverse=True)
        used = replace(
            observations,
            image=observations.image[order],
            x_px=observations.x_px[order],
            point=point,
            std_px=observations.std_px[order],
        )
        boards = None if observations.boards is None else observations.boards.of_points(kept)
        used = replace(used, boards=boards)
        layout = Layout.of(used, np.array([camera.width for camera in freedom.start]))
        rig, rigs = used.rig[used.image], len(scene.world_from_rig)
        rows = np.stack([point, rig])
        if boards is not None:
            rows = np.concatenate([rows, np.repeat([boards.point, boards.rig], 2, axis=1)], axis=1)
        rows_order = np.lexsort(rows[::-1])
        rows_point, rows_rig = rows[:, rows_order]
        by = displacements(freedom.start, freedom.intrinsics, used.x_px, layout.camera)
        return ImageProblem(
            observations=used,
            points=kept,
            freedom=replace(
                freedom,
                model_error_std=np.full(by.shape[2], TYPICAL),
                board_std=np.zeros(0) if boards is None else boards.shape_std,
            ),
            prior=prior,
            seen=(seen := Sightings.of(point, rig, rigs)),
            layout=layout,
            displacements=by,
            rows_order=rows_order,
            rows_point=rows_point,
            rows_rig=rows_rig,
            rows_seen=seen if boards is None else Sightings.of(rows_point, rows_rig, rigs),
        )

    @cached_property
    def rows(self) -> list[Int[ndarray, "..."]]:
        """The observations of each camera."""
        return [np.flatnonzero(self.layout.camera == c) for c in range(len(self.freedom.start))]

    @cached_property
    def prism(self) -> Float[ndarray, "k 2 4"]:
        """Displacement (px) of each observation by the coefficients of a thin prism, whatever the scene is."""
        out = np.zeros((len(self.layout.camera), 2, PRISM))
        for camera, rows in zip(self.freedom.start, self.rows, strict=True):
            r2 = (unproject(camera, self.observations.x_px[rows])[:, :2] ** 2).sum(1)
            for axis, focal in enumerate((camera.fx, camera.fy)):
                out[rows, axis, 2 * axis] = focal * r2
                out[rows, axis, 2 * axis + 1] = focal * r2**2
        return out

    @property
    def has_nuisances(self) -> bool:
        """Whether images may differ from their camera."""
        return len(self.freedom.nuisance.std) > 0

    def with_model_error(self, std: Float[ndarray, " e"]) -> "ImageProblem":
        """With displacements of another size."""
        return replace(self, freedom=replace(self.freedom, model_error_std=std))


@dataclass(frozen=True, kw_only=True)
class View:
    """Every observation's point as one scene has it."""

    from_rig: Float[ndarray, "k 3"]
    """From the rig to the point, rig axes."""
    from_camera: Float[ndarray, "k 3"]
    """From the camera to the point, rig axes."""
    in_camera: Float[ndarray, "k 3"]
    from_centre_px: Float[ndarray, "k 2"]
    """Projection by the camera as it is in all images, from the principal point."""
    residual_px: Float[ndarray, "k 2"]
    """Projected minus observed."""

    @property
    def depth(self) -> Float[ndarray, " k"]:
        """Along the optical axis."""
        return self.in_camera[:, 2]


@dataclass(frozen=True)
class _OwnMap:
    """A of each observation's image."""

    scale: Float[ndarray, " k"]
    shear: Float[ndarray, " k"]

    @staticmethod
    def of(scene: Scene, problem: ImageProblem, nuisances: Nuisances) -> "_OwnMap":
        image = problem.observations.image
        shear = nuisances.shear[image] * _of_camera(problem, [c.fx / c.height for c in scene.cameras])
        return _OwnMap(np.exp(nuisances.log_focal[image]), shear)

    def applied(self, v: Float[ndarray, "k 2 p"]) -> Float[ndarray, "k 2 p"]:
        out = self.scale[:, None, None] * v
        out[:, 0] += self.shear[:, None] * v[:, 1]
        return out


def _of_camera(problem: ImageProblem, values: list[float] | list[int]) -> Float[ndarray, " k"]:
    """Of each observation, from a value a camera."""
    return np.array(values, float)[problem.layout.camera]


def view_of(scene: Scene, problem: ImageProblem) -> View:
    """The observations' points as a scene projects them."""
    observations, k = problem.observations, len(problem.observations.image)
    from_rig = np.empty((k, 3))
    for pose, rows in zip(scene.world_from_rig, problem.seen.rows, strict=True):
        points = scene.points_in_world[observations.point[rows]]
        from_rig[rows] = (points - pose[:3, 3]) @ pose[:3, :3]
    from_camera, in_camera = np.empty((k, 3)), np.empty((k, 3))
    from_centre, centre = np.empty((k, 2)), np.empty((k, 2))
    for camera, mount, rows in zip(scene.cameras, scene.rig_from_camera, problem.rows, strict=True):
        from_camera[rows] = from_rig[rows] - mount[:3, 3]
        in_camera[rows] = from_camera[rows] @ mount[:3, :3]
        centre[rows] = camera.cx, camera.cy
        from_centre[rows] = project(camera, in_camera[rows]) - centre[rows]
    projected = centre + from_centre
    if problem.has_nuisances:
        own = Nuisances.of(scene.nuisances(problem.freedom))
        width = _of_camera(problem, [camera.width for camera in scene.cameras])
        mapped = _OwnMap.of(scene, problem, own).applied(from_centre[..., None])[..., 0]
        projected = centre + mapped + width[:, None] * own.offset[observations.image]
        projected += problem.prism @ own.prism
    projected += problem.displacements @ scene.camera_steps[problem.freedom.model_error_columns]
    return View(
        from_rig=from_rig,
        from_camera=from_camera,
        in_camera=in_camera,
        from_centre_px=from_centre,
        residual_px=projected - observations.x_px,
    )


def derivatives(scene: Scene, view: View, problem: ImageProblem, weight: Float[ndarray, " k"]) -> Derivatives:
    """Derivatives of all rows of the equations by everything, and their residuals, times the roots of their weights."""
    freedom, root = problem.freedom, np.sqrt(weight)[:, None, None]
    by_rig = root * _by_rig(scene, view, problem)
    shared = np.zeros((len(weight), 2, freedom.first_rig))
    np.multiply(_by_cameras(scene, view, problem), root, out=shared[:, :, : freedom.nuisance_columns.stop])
    np.multiply(problem.displacements, root, out=shared[:, :, freedom.model_error_columns])
    for columns, rows in zip(freedom.mount_columns, problem.rows, strict=True):
        if columns is not None:
            rotated = by_rig[rows] @ skew(view.from_camera[rows])
            shared[rows, :, columns] = np.concatenate([-by_rig[rows], rotated], axis=2)
    by_world, own = np.empty_like(by_rig), np.empty((len(weight), 2, 6))
    for pose, rows in zip(scene.world_from_rig, problem.seen.rows, strict=True):
        rotation = pose[:3, :3]
        here = _rotated(by_rig[rows], rotation)
        by_world[rows] = here
        own[rows, :, :3] = -here
        own[rows, :, 3:] = _crossed(here, (view.from_rig[rows] @ rotation.T)[:, None])
    residual = view.residual_px * root[..., 0]
    of_images = Derivatives(shared=shared, own=own, by_point=by_world, residual=residual)
    if problem.observations.boards is None:
        return of_images
    of_boards = problem.observations.boards.derivatives(
        scene.world_from_rig,
        scene.points_in_world,
        scene.camera_steps[freedom.board_columns],
        freedom.board_columns,
        freedom.first_rig,
    )
    return in_order(problem.rows_order, of_images, of_boards)


def shape_residuals(scene: Scene, problem: ImageProblem) -> Float[ndarray, "c 3"]:
    """By how much corners are off the shape of their boards, in standard deviations."""
    boards = problem.observations.boards
    if boards is None:
        return np.zeros((0, 3))
    shape = scene.camera_steps[problem.freedom.board_columns]
    return boards.residual(scene.world_from_rig, scene.points_in_world, shape)


def shape_information(scene: Scene, problem: ImageProblem) -> Float[ndarray, "p 3 3"] | None:
    """What boards show of each point; None without boards."""
    if (boards := problem.observations.boards) is None:
        return None
    shape = scene.camera_steps[problem.freedom.board_columns]
    return boards.point_information(scene.world_from_rig, shape, len(problem.points))


def by_points(scene: Scene, view: View, problem: ImageProblem) -> Float[ndarray, "k 2 3"]:
    """Derivative of every observation by its point, world axes."""
    out = _by_rig(scene, view, problem)
    for pose, rows in zip(scene.world_from_rig, problem.seen.rows, strict=True):
        out[rows] = _rotated(out[rows], pose[:3, :3])
    return out


def _by_rig(scene: Scene, view: View, problem: ImageProblem) -> Float[ndarray, "k 2 3"]:
    """The same, rig axes."""
    out = np.empty((len(view.in_camera), 2, 3))
    for camera, mount, rows in zip(scene.cameras, scene.rig_from_camera, problem.rows, strict=True):
        out[rows] = _rotated(by_point(camera, view.in_camera[rows]), mount[:3, :3])
    if problem.has_nuisances:
        own = Nuisances.of(scene.nuisances(problem.freedom))
        return _OwnMap.of(scene, problem, own).applied(out)
    return out


def _by_cameras(scene: Scene, view: View, problem: ImageProblem) -> Float[ndarray, "k 2 l"]:
    """Derivative of every observation by the steps of intrinsics and nuisances."""
    freedom = problem.freedom
    out = np.zeros((len(view.in_camera), 2, freedom.nuisance_columns.stop))
    each = list(zip(scene.cameras, freedom.intrinsics, freedom.intrinsics_columns, problem.rows, strict=True))
    for camera, prior, columns, rows in each:
        out[rows, :, columns] = by_parameters(camera, view.in_camera[rows]) @ prior.directions
    if not problem.has_nuisances:
        return out
    own = Nuisances.of(scene.nuisances(freedom))
    by_centre = np.zeros_like(out)
    for _, prior, columns, rows in each:
        by_centre[rows, :, columns] = prior.directions[CENTRE]
    out = _OwnMap.of(scene, problem, own).applied(out - by_centre) + by_centre
    for camera, prior, columns, rows in each:
        # A shear counts in the focal length, and moves with it.
        sheared = own.shear[problem.observations.image[rows]] * view.from_centre_px[rows, 1]
        out[rows, 0, columns] += sheared[:, None] / camera.height * prior.directions[0]
    out[:, :, freedom.nuisance_columns] = _by_nuisances(scene, view, problem, own)
    return out


def _by_nuisances(scene: Scene, view: View, problem: ImageProblem, own: Nuisances) -> Float[ndarray, "k 2 e"]:
    """Derivative of every observation by the steps of nuisances."""
    image, about = problem.observations.image, view.from_centre_px
    directions = problem.freedom.nuisance.directions
    of_images = directions[:-PRISM].reshape(OF_IMAGE, -1, directions.shape[1])
    focal, sheared, *offset = of_images[:, image]
    shear_px = _of_camera(problem, [camera.fx / camera.height for camera in scene.cameras]) * about[:, 1]
    width = _of_camera(problem, [camera.width for camera in scene.cameras])
    out = (np.exp(own.log_focal[image])[:, None] * about)[..., None] * focal[:, None]
    out[:, 0] += shear_px[:, None] * sheared
    out += width[:, None, None] * np.stack(offset, axis=1)
    if directions[-PRISM:].any():
        out += problem.prism @ directions[-PRISM:]
    return out


def _rotated(by: Float[ndarray, "k 2 3"], rotation: Float[ndarray, "3 3"]) -> Float[ndarray, "k 2 3"]:
    """Derivatives by a point in other axes: one product, where NumPy would make one of every observation."""
    return (by.reshape(-1, 3) @ rotation.T).reshape(by.shape)


def _crossed(a: Float[ndarray, "k 2 3"], b: Float[ndarray, "k 1 3"]) -> Float[ndarray, "k 2 3"]:
    """Cross products; NumPy's takes as long as all else about them."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]
