"""What an adjustment moves, what was observed, and along which directions everything is free.

A rig is what moves as one: the wrist of an arm at one instant with all cameras on it, or a fixed camera. A wrist camera
alone is a rig an image. `world` has any origin and unit: images leave one similarity of it open.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.camera import parameters, with_parameters
from jcr.estimation.boards import BoardShapes
from jcr.estimation.intrinsics_prior import IntrinsicsPrior
from jcr.geometry import retract, skew, step_between
from jcr.records import Intrinsics, Tracks


@dataclass(frozen=True, kw_only=True)
class Observations:
    """Which rig and which camera each image is of, and which points are seen in it."""

    rig: Int[ndarray, " n"]
    """Of each image."""
    camera: Int[ndarray, " n"]
    """Of each image."""
    image: Int[ndarray, " k"]
    """Of each observation; no point twice in one image."""
    x_px: Float[ndarray, "k 2"]
    """In the original image, distorted."""
    point: Int[ndarray, " k"]
    std_px: Float[ndarray, " k"]
    """Of one coordinate, as matching states it, up to a factor; all 1 where it states nothing."""
    boards: BoardShapes | None = None
    """What is known of the shape of boards and tags whose corners are among the points; each is a rig that no arm
    moves."""

    @staticmethod
    def of_one_camera(tracks: Tracks, images: int, boards: BoardShapes | None = None) -> "Observations":
        """Of the images of one camera, a rig an image; `boards` are the rigs after them."""
        each = np.arange(images)
        return Observations(
            rig=each,
            camera=np.zeros_like(each),
            image=tracks.image,
            x_px=tracks.x_px,
            point=tracks.point,
            std_px=np.ones(len(tracks.image)) if tracks.std_px is None else tracks.std_px,
            boards=boards,
        )


OF_IMAGE, PRISM = 4, 4
"""Nuisances of each image, and those of the glass, which all share."""


@dataclass(frozen=True)
class NuisancePrior:
    """Independent directions in which images may differ from their camera's model, with their standard deviations.

    An image has four such parameters: the logarithm of its own focal length over the camera's; a shear, by which x
    moves from the image's top to its bottom in focal lengths, as a rolling shutter does it; and an offset in x and in y,
    in widths of the image, as image stabilisation makes it. All images share the coefficients s1 to s4 of OpenCV's thin
    prism distortion, which no model of camera.py has.
    """

    directions: Float[ndarray, "r e"]
    """r = 4n + 4: of the logarithms of all n images, of their shears, of their offsets in x, in y, then of the prism."""
    std: Float[ndarray, " e"]


@dataclass(frozen=True)
class Nuisances:
    """How n images differ from their camera's model."""

    log_focal: Float[ndarray, " n"]
    shear: Float[ndarray, " n"]
    offset: Float[ndarray, "n 2"]
    """In widths of the image."""
    prism: Float[ndarray, " 4"]

    @staticmethod
    def of(flat: Float[ndarray, " r"]) -> "Nuisances":
        """In the order of NuisancePrior's rows."""
        log_focal, shear, x, y = flat[:-PRISM].reshape(OF_IMAGE, -1)
        return Nuisances(log_focal, shear, np.stack([x, y], axis=1), flat[-PRISM:])


@dataclass(frozen=True, kw_only=True)
class Freedom:
    """What may move beside rigs and points: the cameras' parameters, and where cameras are mounted on their rig.

    The columns of all equations are, in this order: the intrinsics of each camera, nuisances, what the cameras' models
    leave (model_error.py), the shape of boards (boards.py), mounts (six each, rig axes), rigs (six each, world axes).
    """

    intrinsics: tuple[IntrinsicsPrior, ...]
    """One a camera, about where its parameters start."""
    mounts: Bool[ndarray, " c"]
    """Cameras whose place on the rig is sought; that of others is exact."""
    nuisance: NuisancePrior
    start: tuple[Intrinsics, ...]
    """Of each camera, where its prior has its middle."""
    model_error_std: Float[ndarray, " e"] = field(default_factory=lambda: np.zeros(0))
    """Of each displacement, in widths of the image."""
    board_std: Float[ndarray, " s"] = field(default_factory=lambda: np.zeros(0))
    """Of what is free of the shape of boards: first the logarithm of their size."""

    @staticmethod
    def of(
        cameras: Sequence[Intrinsics],
        priors: Sequence[IntrinsicsPrior],
        images: int,
        mounts: Sequence[bool] | Bool[ndarray, " c"] | None = None,
    ) -> "Freedom":
        """Cameras about where they are now, each of their images as its camera is; of the mounts only `mounts` move."""
        return Freedom(
            intrinsics=tuple(priors),
            mounts=np.zeros(len(cameras), bool) if mounts is None else np.asarray(mounts, bool),
            nuisance=NuisancePrior(np.zeros((OF_IMAGE * images + PRISM, 0)), np.zeros(0)),
            start=tuple(cameras),
        )

    @property
    def std(self) -> Float[ndarray, " l"]:
        """Of all camera columns."""
        of_cameras = (prior.std for prior in self.intrinsics)
        return np.concatenate([*of_cameras, self.nuisance.std, self.model_error_std, self.board_std])

    @property
    def intrinsics_columns(self) -> list[slice]:
        """Of each camera."""
        ends = np.cumsum([0, *(len(prior.std) for prior in self.intrinsics)])
        return [slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]

    @property
    def nuisance_columns(self) -> slice:
        """After the intrinsics."""
        begin = self.intrinsics_columns[-1].stop
        return slice(begin, begin + len(self.nuisance.std))

    @property
    def model_error_columns(self) -> slice:
        """After the nuisances."""
        begin = self.nuisance_columns.stop
        return slice(begin, begin + len(self.model_error_std))

    @property
    def board_columns(self) -> slice:
        """After what the models leave."""
        begin = self.model_error_columns.stop
        return slice(begin, begin + len(self.board_std))

    @property
    def mount_columns(self) -> list[slice | None]:
        """Of each camera; None where it does not move."""
        begin, out = self.board_columns.stop, list[slice | None]()
        for free in self.mounts:
            out.append(slice(begin, begin + 6) if free else None)
            begin += 6 * int(free)
        return out

    @property
    def first_rig(self) -> int:
        """Column; six for each rig follow."""
        return self.board_columns.stop + 6 * int(self.mounts.sum())


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Where everything is."""

    world_from_rig: Float[ndarray, "m 4 4"]
    rig_from_camera: Float[ndarray, "c 4 4"]
    cameras: tuple[Intrinsics, ...]
    points_in_world: Float[ndarray, "p 3"]
    camera_steps: Float[ndarray, " l"] = field(default_factory=lambda: np.zeros(0))
    """Of the intrinsics from where they start, along the directions of their priors, of the nuisances, of what the
    models leave, and of the shape of boards; empty: all are where they start."""

    def nuisances(self, freedom: Freedom) -> Float[ndarray, " r"]:
        """How the images differ from their camera's model, in the order of NuisancePrior's rows."""
        return freedom.nuisance.directions @ self.camera_steps[freedom.nuisance_columns]


def at_start(scene: Scene, freedom: Freedom) -> Scene:
    """The scene with its cameras where their priors have their middle."""
    return replace(scene, cameras=freedom.start, camera_steps=np.zeros(len(freedom.std)))


def with_freedom(scene: Scene, before: Freedom, freedom: Freedom) -> Scene:
    """The scene with its cameras as they are, as far as another freedom about the same start can express them."""
    along = np.zeros(len(freedom.std))
    each = zip(scene.cameras, freedom.start, freedom.intrinsics, freedom.intrinsics_columns, strict=True)
    for camera, start, prior, columns in each:
        along[columns] = _along(prior.directions, prior.std, parameters(camera) - parameters(start))
    nuisance = freedom.nuisance
    of_images = scene.nuisances(before).ravel()
    along[freedom.nuisance_columns] = _along(nuisance.directions, nuisance.std, of_images)
    left = scene.camera_steps[before.model_error_columns]
    if len(left) == len(freedom.model_error_std):
        along[freedom.model_error_columns] = left
    along[freedom.board_columns] = scene.camera_steps[before.board_columns]
    nothing = np.zeros(freedom.first_rig + 6 * len(scene.world_from_rig))
    return stepped(replace(scene, camera_steps=along), freedom, nothing)


def _along(
    directions: Float[ndarray, "q c"], std: Float[ndarray, " c"], off: Float[ndarray, " q"]
) -> Float[ndarray, " c"]:
    """The likeliest steps along directions that come nearest to a displacement."""
    return std * (np.linalg.pinv(directions * std) @ off)


def stepped(scene: Scene, freedom: Freedom, step: Float[ndarray, " d"]) -> Scene:
    """Cameras, mounts and rigs after a step in the order of the columns; points stay."""
    along = scene.camera_steps + step[: len(freedom.std)]
    each = zip(freedom.start, freedom.intrinsics, freedom.intrinsics_columns, strict=True)
    cameras = tuple(
        with_parameters(start, parameters(start) + prior.directions @ along[columns])
        for start, prior, columns in each
    )
    mounts = scene.rig_from_camera.copy()
    for c, columns in enumerate(freedom.mount_columns):
        if columns is not None:
            mounts[c] = retract(mounts[c], step[columns])
    rigs = retract(scene.world_from_rig, step[freedom.first_rig :].reshape(-1, 6))
    return replace(scene, world_from_rig=rigs, rig_from_camera=mounts, cameras=cameras, camera_steps=along)


def similarities(scene: Scene, freedom: Freedom) -> Float[ndarray, "d 7"]:
    """Steps of everything that a similarity of the world makes, which no image shows; scale first."""
    first = freedom.first_rig
    out = np.zeros((first + 6 * len(scene.world_from_rig), 7))
    out[first:] = similarities_of_rigs(scene.world_from_rig)
    out[freedom.board_columns, 0][:1] = 1.0  # the logarithm of their size
    for c, columns in enumerate(freedom.mount_columns):
        if columns is not None:
            out[columns.start : columns.start + 3, 0] = scene.rig_from_camera[c, :3, 3]
    return out


@dataclass(frozen=True)
class RigInformation:
    """Twice a cost that is quadratic in steps of the first rigs from a place of reference: sᵀ H s + 2 gᵀ s."""

    world_from_rig: Float[ndarray, "m 4 4"]
    information: Float[ndarray, "r r"]
    gradient: Float[ndarray, " r"]

    def steps(self, scene: Scene) -> Float[ndarray, " r"]:
        """How far the rigs of a scene are from the reference."""
        return step_between(self.world_from_rig, scene.world_from_rig[: len(self.world_from_rig)]).ravel()


def information_along(steps: Float[ndarray, "d 7"], strength: float) -> Float[ndarray, "d d"]:
    """Information of this size along steps: those of a similarity of the world, which nothing else keeps where it is,
    and without it what is quadratic would rotate and shrink with it."""
    unseen = np.linalg.qr(steps)[0]
    return strength * unseen @ unseen.T


def similarities_of_rigs(world_from_rig: Float[ndarray, "m 4 4"]) -> Float[ndarray, "r 7"]:
    """The same of the rigs alone, r = 6m."""
    position = world_from_rig[:, :3, 3]
    rigs = np.zeros((len(position), 6, 7))
    rigs[:, :3, 0], rigs[:, :3, 1:4] = position, np.eye(3)
    rigs[:, :3, 4:], rigs[:, 3:, 4:] = -skew(position), np.eye(3)
    return rigs.reshape(-1, 7)
