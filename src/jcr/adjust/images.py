"""Bundle adjustment of images, and what they alone show of their rigs and cameras: one similarity of the world is open.

Reprojection errors under a Cauchy loss, over intrinsics, nuisances of single images, mounts, rigs and points. Points are
eliminated (elimination.py); the rest is a small dense system, solved by Levenberg-Marquardt: least_squares.py without
that elimination would hold a matrix of thousands of points. Where the images are weak, what the robots report may hold
the rigs while everything moves (robots.py); `evidence` is what is left without it, so that nothing counts twice.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.adjust.elimination import Derivatives, Normal, Sightings, with_points_held, without_points
from jcr.adjust.model_error import TYPICAL, displacements, size_of
from jcr.adjust.pixel_noise import (
    Layout,
    PixelNoise,
    common_share,
    left_of_points,
    pixel_noise,
    variance_ratios,
)
from jcr.adjust.scene import (
    OF_IMAGE,
    PRISM,
    Freedom,
    Nuisances,
    Observations,
    Scene,
    at_start,
    similarities,
    similarities_of_rigs,
    stepped,
)
from jcr.camera import by_parameters, by_point, project, unproject
from jcr.geometry import apply, inverse, scale_translation, skew, step_between
from jcr.least_squares import one_blas_thread

ROUNDS = 12
"""Of an adjustment, with the sizes of errors estimated in between."""
SIZES_SETTLED = 0.01
"""Relative change of the sizes of errors, of pixels and of robots, from one round to the next that ends them."""
ENOUGH = 1e-5
"""Of the cost, which is in squared standard deviations: what less than it would gain, nobody sees."""
STEPS = 60
CENTRE = slice(2, 4)
"""Of the parameters of a camera."""
FAINT = 1e-6
"""Information that every column has (1/m², 1/rad²): an image that shows nothing is anywhere within a kilometre."""


@dataclass(frozen=True)
class RigInformation:
    """Twice a cost that is quadratic in steps of the first rigs from a place of reference: sᵀ H s + 2 gᵀ s."""

    world_from_rig: Float[ndarray, "m 4 4"]
    information: Float[ndarray, "r r"]
    gradient: Float[ndarray, " r"]

    def steps(self, scene: Scene) -> Float[ndarray, " r"]:
        """How far the rigs of a scene are from the reference."""
        return step_between(self.world_from_rig, scene.world_from_rig[: len(self.world_from_rig)]).ravel()


@dataclass(frozen=True, kw_only=True)
class ImageProblem:
    """What stays fixed; observations sorted by point, then by rig."""

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
        widths = np.array([camera.width for camera in freedom.start])
        layout = Layout.of(used, widths)
        by = displacements(freedom.start, freedom.intrinsics, used.x_px, layout.camera)
        return ImageProblem(
            observations=used,
            points=kept,
            freedom=replace(freedom, model_error_std=np.full(by.shape[2], TYPICAL)),
            prior=prior,
            seen=Sightings.of(point, used.rig[used.image], len(scene.world_from_rig)),
            layout=layout,
            displacements=by,
        )

    @cached_property
    def prism(self) -> Float[ndarray, "k 2 4"]:
        """Displacement (px) of each observation by the coefficients of a thin prism, whatever the scene is."""
        out = np.zeros((len(self.layout.camera), 2, PRISM))
        for c, lens in enumerate(self.freedom.start):
            rows = np.flatnonzero(self.layout.camera == c)
            r2 = (unproject(lens, self.observations.x_px[rows])[:, :2] ** 2).sum(1)
            for axis, focal in enumerate((lens.fx, lens.fy)):
                out[rows, axis, 2 * axis] = focal * r2
                out[rows, axis, 2 * axis + 1] = focal * r2**2
        return out

    def with_model_error(self, std: Float[ndarray, " e"]) -> "ImageProblem":
        """With displacements of another size."""
        return replace(self, freedom=replace(self.freedom, model_error_std=std))


@dataclass(frozen=True)
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


@dataclass(frozen=True, kw_only=True)
class ImageEvidence:
    """What the images alone show, a normal distribution about a scene in the order of Freedom's columns."""

    scene: Scene
    problem: ImageProblem
    information: Float[ndarray, "d d"]
    """Priors of intrinsics and nuisances included; of the similarity as much as keeps it from being infinite, which is
    nothing beside what it is tied by."""
    gradient: Float[ndarray, " d"]
    """Of half the squared distance, at the scene."""
    noise: PixelNoise
    view: View

    def rig_covariance(self) -> Float[ndarray, "r r"]:
        """Of steps of the rigs, r = 6m, in the frame of the first and at one size of the world, everything else
        eliminated: those of the first rig are 0."""
        freedom, rigs = self.problem.freedom, self.scene.world_from_rig
        unseen, others = similarities(self.scene, freedom), slice(freedom.first_rig + 6, None)
        gauge = np.zeros((7, len(unseen)))
        gauge[:6, freedom.first_rig : others.start] = np.eye(6)
        gauge[6, freedom.first_rig :].reshape(-1, 6)[:, :3] = rigs[:, :3, 3] - rigs[0, :3, 3]
        to_gauge = (np.eye(len(unseen)) - unseen @ np.linalg.solve(gauge @ unseen, gauge))[others]
        covariance = np.zeros((6 * len(rigs), 6 * len(rigs)))
        covariance[6:, 6:] = to_gauge @ np.linalg.solve(self.information, to_gauge.T)
        return (covariance + covariance.T) / 2


@one_blas_thread
def adjust_images(scene: Scene, observations: Observations, freedom: Freedom) -> ImageEvidence:
    """Adjust images alone, from a scene that is near: the first rig stays where it is, depths keep their median.

    Points that fewer than two images see are left out.
    """
    scene, problem = posed(scene, observations, freedom)
    start, view = scene.world_from_rig, view_of(scene, problem)
    noise, depth, damping = noise_of(scene, view, problem), view.depth, 1e-4
    held = similarity_held(similarities_of_rigs(start), 1.0)
    world = RigInformation(start, held, np.zeros(len(held)))
    for _ in range(ROUNDS):
        before = noise
        scene, view, damping = minimised(scene, problem, noise, world, damping)
        noise = noise_of(scene, view, problem, before)
        images, change = with_model_error_of(evidence(scene, problem, noise))
        problem = images.problem
        if max(noise.change(before), change) < SIZES_SETTLED:
            break
    unit = float(np.median(np.abs(depth / view.depth)))
    back = inverse(scale_translation(scene.world_from_rig[0], unit))
    scene = replace(
        scene,
        world_from_rig=start[0] @ back @ scale_translation(scene.world_from_rig, unit),
        rig_from_camera=scale_translation(scene.rig_from_camera, unit),
        points_in_world=apply(start[0] @ back, unit * scene.points_in_world),
    )
    return evidence(scene, problem, noise)


def posed(
    scene: Scene, observations: Observations, freedom: Freedom, prior: RigInformation | None = None
) -> tuple[Scene, ImageProblem]:
    """Where an adjustment starts: with the points that two or more observations show, and cameras where their priors
    have their middle."""
    problem = ImageProblem.of(scene, observations, freedom, prior)
    seen = replace(scene, points_in_world=scene.points_in_world[problem.points])
    return at_start(seen, problem.freedom), problem


def similarity_held(steps: Float[ndarray, "d 7"], strength: float) -> Float[ndarray, "d d"]:
    """Information of this size along the steps that a similarity of the world makes (scene.similarities): nothing else
    holds the world, and without it what is quadratic would rotate and shrink with it."""
    unseen = np.linalg.qr(steps)[0]
    return strength * unseen @ unseen.T


def view_of(scene: Scene, problem: ImageProblem) -> View:
    """The observations' points as a scene projects them."""
    observations = problem.observations
    camera, k = problem.layout.camera, len(observations.image)
    from_rig = np.empty((k, 3))
    for pose, rows in zip(scene.world_from_rig, problem.seen.rows, strict=True):
        points = scene.points_in_world[observations.point[rows]]
        from_rig[rows] = (points - pose[:3, 3]) @ pose[:3, :3]
    from_camera, in_camera, from_centre = np.empty((k, 3)), np.empty((k, 3)), np.empty((k, 2))
    residual = np.empty((k, 2))
    own = Nuisances.of(scene.nuisances(problem.freedom))
    log_focal, shear = own.log_focal[observations.image], own.shear[observations.image]
    for c, (lens, mount) in enumerate(zip(scene.cameras, scene.rig_from_camera, strict=True)):
        rows = np.flatnonzero(camera == c)
        from_camera[rows] = from_rig[rows] - mount[:3, 3]
        in_camera[rows] = from_camera[rows] @ mount[:3, :3]
        centre = np.array([lens.cx, lens.cy])
        about = project(lens, in_camera[rows]) - centre
        from_centre[rows] = about
        moved = np.exp(log_focal[rows])[:, None] * about
        moved[:, 0] += lens.fx / lens.height * shear[rows] * about[:, 1]
        moved += lens.width * own.offset[observations.image[rows]]
        residual[rows] = moved + centre - observations.x_px[rows]
    if own.prism.any():
        residual += problem.prism @ own.prism
    residual += problem.displacements @ scene.camera_steps[problem.freedom.model_error_columns]
    return View(from_rig, from_camera, in_camera, from_centre, residual)


def noise_of(scene: Scene, view: View, problem: ImageProblem, before: PixelNoise | None = None) -> PixelNoise:
    """Of the observations at a scene; several cameras are distinguished where an estimate was made before, and so
    are observations by what their matches state."""
    layout, residual_px, depth = problem.layout, view.residual_px, view.depth
    if before is None:
        return pixel_noise(layout, residual_px, depth, np.ones(len(scene.cameras)))
    by_world = _by_world(_by_rig(scene, view, problem), scene, problem)
    left = left_of_points(layout, before, residual_px, depth, by_world, problem.seen.starts)
    ratio = variance_ratios(layout, before, residual_px, depth, left)
    return pixel_noise(layout, residual_px, depth, ratio, common_share(layout, residual_px, left, ratio))


def minimised(
    scene: Scene,
    problem: ImageProblem,
    noise: PixelNoise,
    robots: RigInformation | None,
    damping: float = 1e-4,
) -> tuple[Scene, View, float]:
    """Levenberg-Marquardt with the weights that observations have at the start; also the damping at the end."""
    view = view_of(scene, problem)
    weight = noise.weights(view.residual_px, view.depth, problem.layout)
    held = [one for one in (problem.prior, robots) if one is not None]
    least = cost(scene, view, problem, weight, held)
    for _ in range(STEPS):
        moved = _moved(scene, problem, _equations(scene, view, problem, weight, held, damping))
        moved_view = view_of(moved, problem)
        new_cost = cost(moved, moved_view, problem, weight, held)
        gained = least - new_cost
        if gained >= 0:
            scene, view, least, damping = moved, moved_view, new_cost, max(damping / 10, 1e-10)
        else:
            damping *= 10
        if abs(gained) < ENOUGH:
            break
        if damping > 1e8:
            return scene, view, 1e-4
    return scene, view, damping


def evidence(scene: Scene, problem: ImageProblem, noise: PixelNoise) -> ImageEvidence:
    """What the images and the priors of their cameras show about a scene, whoever helped to find it."""
    return linearised(scene, view_of(scene, problem), problem, noise)[0]


def linearised(
    scene: Scene, view: View, problem: ImageProblem, noise: PixelNoise
) -> tuple[ImageEvidence, Normal]:
    """The same, and the equations that it is made of, which step the points."""
    weight = noise.weights(view.residual_px, view.depth, problem.layout)
    held = [] if problem.prior is None else [problem.prior]
    normal = _equations(scene, view, problem, weight, held, 0.0)
    information = normal.hessian
    information[np.diag_indices(len(information))] += FAINT
    if problem.prior is None:
        # A unit of the world that is that of its rigs' places, all alike: what λ is counted in.
        of_rigs = information.diagonal()[problem.freedom.first_rig :]
        information += similarity_held(similarities(scene, problem.freedom), float(of_rigs.mean()))
    found = ImageEvidence(
        scene=scene,
        problem=problem,
        information=information,
        gradient=-normal.right,
        noise=noise,
        view=view,
    )
    return found, normal


def with_model_error_of(images: ImageEvidence) -> tuple[ImageEvidence, float]:
    """The evidence with displacements as large as it shows them, and the relative change of that."""
    freedom = images.problem.freedom
    columns, std = freedom.model_error_columns, freedom.model_error_std
    if len(std) == 0:
        return images, 0.0
    covariance = np.linalg.inv(images.information)
    steps = images.scene.camera_steps[columns]
    likeliest = steps - covariance[columns] @ images.gradient
    size = size_of(likeliest, covariance[columns, columns], std)
    information, gradient = images.information.copy(), images.gradient.copy()
    change = size**-2.0 - std**-2.0
    information[columns, columns] += np.diag(change)
    gradient[columns] += change * steps
    resized = images.problem.with_model_error(size)
    return (
        replace(images, problem=resized, information=information, gradient=gradient),
        abs(float(np.log(size[0] / std[0]))),
    )


def median_reprojection_px(view: View, problem: ImageProblem) -> Float[ndarray, " n"]:
    """Median reprojection error of every image; not a number where it took no part."""
    length = np.linalg.norm(view.residual_px, axis=1)
    image = problem.observations.image
    out = np.full(len(problem.observations.rig), np.nan)
    for k in np.unique(image):
        out[k] = np.median(length[image == k])
    return out


def _by_rig(scene: Scene, view: View, problem: ImageProblem) -> Float[ndarray, "k 2 3"]:
    """Derivative of every observation by its point, rig axes."""
    camera = problem.layout.camera
    out = np.empty((len(camera), 2, 3))
    for c, lens in enumerate(scene.cameras):
        rows = np.flatnonzero(camera == c)
        out[rows] = _rotated(by_point(lens, view.in_camera[rows]), scene.rig_from_camera[c, :3, :3])
    return _nuisances_applied(out, scene, problem)


def _by_world(
    by_rig: Float[ndarray, "k 2 3"], scene: Scene, problem: ImageProblem
) -> Float[ndarray, "k 2 3"]:
    """The same, world axes."""
    out = np.empty_like(by_rig)
    for pose, rows in zip(scene.world_from_rig, problem.seen.rows, strict=True):
        out[rows] = _rotated(by_rig[rows], pose[:3, :3])
    return out


def _nuisances_applied(
    by: Float[ndarray, "k 2 p"], scene: Scene, problem: ImageProblem
) -> Float[ndarray, "k 2 p"]:
    """Derivatives of projections by the cameras as derivatives of projections by the images' own, in place."""
    if len(problem.freedom.nuisance.std) == 0:
        return by
    own, image = Nuisances.of(scene.nuisances(problem.freedom)), problem.observations.image
    log_focal, shear = own.log_focal[image], own.shear[image]
    along = np.array([camera.fx / camera.height for camera in scene.cameras])[problem.layout.camera] * shear
    sheared = along[:, None] * by[:, 1]
    by *= np.exp(log_focal)[:, None, None]
    by[:, 0] += sheared
    return by


def _by_cameras(scene: Scene, view: View, problem: ImageProblem) -> Float[ndarray, "k 2 l"]:
    """Derivative of every observation by the steps of intrinsics and nuisances."""
    freedom, camera = problem.freedom, problem.layout.camera
    out = np.zeros((len(camera), 2, freedom.nuisance_columns.stop))
    for c, (lens, prior, columns) in enumerate(
        zip(scene.cameras, freedom.intrinsics, freedom.intrinsics_columns, strict=True)
    ):
        rows = np.flatnonzero(camera == c)
        out[rows, :, columns] = by_parameters(lens, view.in_camera[rows]) @ prior.directions
    if len(freedom.nuisance.std):
        out = _with_nuisances(out, scene, view, problem)
    return out


def _with_nuisances(
    out: Float[ndarray, "k 2 l"], scene: Scene, view: View, problem: ImageProblem
) -> Float[ndarray, "k 2 l"]:
    """Derivatives by the intrinsics with those by the nuisances of each image."""
    freedom, camera = problem.freedom, problem.layout.camera
    image, about = problem.observations.image, view.from_centre_px
    own = Nuisances.of(scene.nuisances(freedom))
    log_focal, shear = own.log_focal[image], own.shear[image]
    # Nuisances are about the principal point, which they leave where it is; a shear counts in the focal length.
    beside, of_shear = np.zeros_like(out), np.zeros((len(camera), out.shape[2]))
    for c, (lens, prior, columns) in enumerate(
        zip(scene.cameras, freedom.intrinsics, freedom.intrinsics_columns, strict=True)
    ):
        rows = np.flatnonzero(camera == c)
        beside[rows, :, columns] = prior.directions[CENTRE]
        of_shear[rows, columns] = (shear * about[:, 1])[rows, None] / lens.height * prior.directions[0]
    out = _nuisances_applied(out - beside, scene, problem) + beside
    out[:, 0] += of_shear
    by_shear = np.array([lens.fx / lens.height for lens in scene.cameras])[camera] * about[:, 1]
    directions, columns = freedom.nuisance.directions, freedom.nuisance_columns
    of_images = directions[:-PRISM].reshape(OF_IMAGE, -1, directions.shape[1])
    focal, sheared, *offset = of_images[:, image]
    scaled = np.exp(log_focal)[:, None] * about
    out[:, :, columns] = scaled[:, :, None] * focal[:, None]
    out[:, 0, columns] += by_shear[:, None] * sheared
    width = np.array([lens.width for lens in scene.cameras])[camera]
    out[:, :, columns] += width[:, None, None] * np.stack(offset, axis=1)
    if directions[-PRISM:].any():
        out[:, :, columns] += problem.prism @ directions[-PRISM:]
    return out


def cost(
    scene: Scene,
    view: View,
    problem: ImageProblem,
    weight: Float[ndarray, " k"],
    held: list[RigInformation],
) -> float:
    """In squared standard deviations, with these weights of the observations.

    `held` is what is known of the rigs beside."""
    total = float(weight @ (view.residual_px**2).sum(1))
    total += float(((scene.camera_steps / problem.freedom.std) ** 2).sum())
    for one in held:
        steps = one.steps(scene)
        total += float(steps @ one.information @ steps + 2 * one.gradient @ steps)
    return total


def derivatives(scene: Scene, view: View, problem: ImageProblem, weight: Float[ndarray, " k"]) -> Derivatives:
    """Derivatives of all observations by everything, and their residuals, times the roots of their weights."""
    freedom, root = problem.freedom, np.sqrt(weight)[:, None, None]
    by_rig = _by_rig(scene, view, problem)
    by_rig *= root
    shared = np.zeros((len(weight), 2, freedom.first_rig))
    np.multiply(_by_cameras(scene, view, problem), root, out=shared[:, :, : freedom.nuisance_columns.stop])
    np.multiply(problem.displacements, root, out=shared[:, :, freedom.model_error_columns])
    for c, columns in enumerate(freedom.mount_columns):
        if columns is not None:
            mine = np.flatnonzero(problem.layout.camera == c)
            rotated = by_rig[mine] @ skew(view.from_camera[mine])
            shared[mine, :, columns] = np.concatenate([-by_rig[mine], rotated], axis=2)
    by_world, own = np.empty_like(by_rig), np.empty((len(weight), 2, 6))
    for pose, rows in zip(scene.world_from_rig, problem.seen.rows, strict=True):
        rotation = pose[:3, :3]
        here = _rotated(by_rig[rows], rotation)
        by_world[rows] = here
        own[rows, :, :3] = -here
        own[rows, :, 3:] = _crossed(here, (view.from_rig[rows] @ rotation.T)[:, None])
    return Derivatives(shared, own, by_world, view.residual_px * root[..., 0])


def _rotated(by: Float[ndarray, "k 2 3"], rotation: Float[ndarray, "3 3"]) -> Float[ndarray, "k 2 3"]:
    """Derivatives by a point in other axes: one product, where NumPy would make one of every observation."""
    return (by.reshape(-1, 3) @ rotation.T).reshape(by.shape)


def _crossed(a: Float[ndarray, "k 2 3"], b: Float[ndarray, "k 1 3"]) -> Float[ndarray, "k 2 3"]:
    """Cross products; NumPy's takes as long as all else about them."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


def _equations(
    scene: Scene,
    view: View,
    problem: ImageProblem,
    weight: Float[ndarray, " k"],
    held: list[RigInformation],
    damping: float,
) -> Normal:
    """The normal equations in the order of Freedom's columns, without the points."""
    freedom, first, cameras = problem.freedom, problem.freedom.first_rig, len(problem.freedom.std)
    weighted = derivatives(scene, view, problem, weight)
    hessian, right = with_points_held(weighted, problem.seen)
    hessian[range(cameras), range(cameras)] += freedom.std**-2.0
    right[:cameras] -= scene.camera_steps / freedom.std**2
    for one in held:
        of_rigs = slice(first, first + len(one.gradient))
        hessian[of_rigs, of_rigs] += one.information
        right[of_rigs] -= one.information @ one.steps(scene) + one.gradient
    hessian[np.diag_indices(len(right))] *= 1 + damping
    return without_points(hessian, right, weighted, problem.seen, damping)


def _moved(scene: Scene, problem: ImageProblem, normal: Normal) -> Scene:
    """The scene after one Gauss-Newton step; along the similarity that no image shows, the least one."""
    scale = 1 / np.sqrt(np.maximum(normal.hessian.diagonal(), FAINT))
    scaled = scale[:, None] * normal.hessian * scale
    scaled[np.diag_indices(len(scale))] += 1e-12
    step = scale * np.linalg.solve(scaled, scale * normal.right)
    points = normal.stepped(scene.points_in_world, step)
    return replace(stepped(scene, problem.freedom, step), points_in_world=points)
