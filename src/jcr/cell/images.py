"""All images of a cell, those of the capture's own camera first, and how they are adjusted with its arms."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.case import MIN_OBSERVATIONS, of_images
from jcr.calibration.options import CalibrateOptions
from jcr.cell.localise import Known
from jcr.cell.rigs import Member, Rigs
from jcr.estimation.image_robots import Adjusted, ArmPoses
from jcr.estimation.intrinsics_prior import IntrinsicsPrior, prior_about
from jcr.estimation.scene import Freedom, Observations, RigInformation, Scene
from jcr.estimation.score_test import freed, with_intrinsics
from jcr.estimation.together import adjust
from jcr.records import Capture, HandEye, Intrinsics, Kind, Reconstruction
from jcr.sfm.track_refinement import KEYPOINT_STD_PX

EXACT = 1e-6
"""m, rad: of poses that were given, beside what is known of their errors."""
NOTHING: dict[str, ndarray] = {
    "image": np.zeros(0, int),
    "x_px": np.zeros((0, 2)),
    "point": np.zeros(0, int),
    "points_in_recon": np.zeros((0, 3)),
    "std_px": np.ones(0),
}
"""Fields of tracks without an observation."""


@dataclass(frozen=True, kw_only=True)
class CellImages:
    """What an adjustment of a cell starts from; cameras by their numbers, the capture's own is 0."""

    scene: Scene
    observations: Observations
    freedom: Freedom
    arms: Sequence[ArmPoses]
    noise: tuple[float, float] | None
    """m, rad: of the gripper poses, at least."""
    prior: RigInformation | None
    """What others than the images and the robots know of the own camera's poses."""

    def adjusted(self) -> Adjusted:
        """Images and arms together."""
        return adjust(self.scene, self.observations, self.freedom, self.arms, self.noise, self.prior)

    def with_freed(
        self,
        prior: IntrinsicsPrior,
        camera: int,
        combinations: Float[ndarray, "e p"] | None = None,
    ) -> "CellImages":
        """Return the images with another prior of a camera's intrinsics, and with combinations of the columns of its
        score_test.Alternatives free too."""
        freedom = with_intrinsics(self.freedom, prior, camera)
        if combinations is not None:
            mine = np.flatnonzero(self.observations.camera == camera)
            freedom = freed(freedom, combinations, mine, camera)
        return replace(self, freedom=freedom)

    def with_bent(self, arm: int | None, bent: Float[ndarray, "s b"] | None) -> "CellImages":
        """Return the images with errors of one standard deviation each of the poses of an arm."""
        if arm is None or bent is None:
            return self
        arms = list(self.arms)
        arms[arm] = replace(arms[arm], bent=bent)
        return replace(self, arms=arms)


def cell_images(
    capture: Capture,
    reconstruction: Reconstruction,
    hand_eye: HandEye,
    known: Known,
    members: Sequence[Member],
    rigs: Rigs,
    options: CalibrateOptions,
) -> CellImages:
    """All images; those of the further cameras follow the own camera's, camera by camera, as they are used."""
    m = len(known.recon_from_camera)
    own = of_images(reconstruction.tracks, hand_eye.inliers)
    prior = None
    # Where bundle adjustment did not decide the calibration, the images' own geometry is not used here either.
    if hand_eye.before is None or own.from_pointmaps or len(own.image) < MIN_OBSERVATIONS:
        prior, own = _as_given(reconstruction, hand_eye, known), replace(own, **NOTHING)
    rig, camera = list(range(m)), [0] * m
    image, x_px, point = [own.image], [own.x_px], [own.point]
    std_px = [np.full(len(own.image), KEYPOINT_STD_PX) if own.std_px is None else own.std_px]
    points = [hand_eye.scale * own.points_in_recon.astype(float)]
    count = len(own.points_in_recon)
    for c, member in enumerate(members, start=1):
        for k, one in member.used:
            n = len(one.x_px)
            image += [np.full(n, len(rig)), one.row]
            x_px += [one.x_px, one.row_x_px]
            point += [count + np.arange(n), count + one.row_point]
            std_px.append(np.full(n + len(one.row), KEYPOINT_STD_PX))
            points.append(one.points_in_recon)
            count += n
            rig.append(int(member.rig[k]))
            camera.append(c)
    mounts = [np.eye(4) if one.rig_from_camera is None else one.rig_from_camera for one in members]
    cameras = (reconstruction.intrinsics, *(member.seen.intrinsics for member in members))
    return CellImages(
        scene=Scene(
            world_from_rig=np.stack(rigs.poses),
            rig_from_camera=np.stack([np.eye(4), *mounts]),
            cameras=cameras,
            points_in_world=np.concatenate(points),
        ),
        observations=Observations(
            rig=np.array(rig),
            camera=np.array(camera),
            image=np.concatenate(image),
            x_px=np.concatenate(x_px),
            point=np.concatenate(point),
            std_px=np.concatenate(std_px),
        ),
        freedom=_freedom(capture, hand_eye, members, cameras, len(rig)),
        arms=rigs.arm_poses(options),
        noise=options.robot_noise_m_rad,
        prior=prior,
    )


def _freedom(
    capture: Capture, hand_eye: HandEye, members: Sequence[Member], cameras: Sequence[Intrinsics], images: int
) -> Freedom:
    """Intrinsics free about what was given or found of each camera; a mount only beside another camera on its rig.

    Those that the own camera's images contradict were found, not given.
    """
    contradicted = any(one.kind is Kind.INTRINSICS and one.shift is None for one in hand_eye.findings)
    own = prior_about(cameras[0], capture.intrinsics is not None and not contradicted, capture.intrinsics_std)
    priors, mounts = [own], [False]
    for start, member in zip(cameras[1:], members, strict=True):
        known = member.camera.intrinsics is not None
        priors.append(prior_about(start, known, member.camera.intrinsics_std))
        mounts.append(member.rig_from_camera is not None)
    return Freedom.of(cameras, priors, images, mounts)


def _as_given(reconstruction: Reconstruction, hand_eye: HandEye, known: Known) -> RigInformation:
    """Information on the used images' poses, where other than features found in the images decided them."""
    rows = np.flatnonzero(hand_eye.inliers)
    spread_of = np.zeros((6 * len(rows), 6 * len(rows)))
    if (evidence := reconstruction.evidence) is not None:
        unit = np.tile(np.repeat([hand_eye.scale, 1.0], 3), len(rows))
        among = (6 * rows[:, None] + np.arange(6)).ravel()
        spread_of = unit[:, None] * evidence.covariance[np.ix_(among, among)] * unit
    information = np.linalg.inv(spread_of + EXACT**2 * np.eye(len(spread_of)))
    return RigInformation(known.recon_from_camera, information, np.zeros(len(information)))
