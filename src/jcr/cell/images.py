"""All images of a cell, those of the capture's own camera first, and how they are adjusted with its arms."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.case import MIN_OBSERVATIONS, of_images
from jcr.calibration.options import CalibrateOptions
from jcr.cell.camera_views import CameraViews
from jcr.cell.rigs import Rigs
from jcr.estimation.intrinsics_prior import CameraPrior, camera_about
from jcr.estimation.observations import Observations
from jcr.estimation.problem import Problem, RigGaussian, State, with_observations
from jcr.estimation.score_test import freed, with_camera
from jcr.estimation.solve import Solution, solve
from jcr.findings import FindingKind
from jcr.records import Capture, HandEye, Intrinsics, Reconstruction
from jcr.sfm.register import KnownImages
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
    """Problem and initial state of a cell; cameras by their numbers, the capture's own is 0."""

    problem: Problem
    """Without its observations."""
    state: State
    observations: Observations

    def adjusted(self) -> Solution:
        """Adjust images and arms together."""
        return solve(*with_observations(self.problem, self.state, self.observations))

    def with_freed(
        self, prior: CameraPrior, camera: int, combinations: Float[ndarray, "e p"] | None = None
    ) -> "CellImages":
        """Return the cell with another prior of a camera's intrinsics.

        `combinations` of the columns of its score_test.Alternatives are free too.
        """
        problem = with_camera(self.problem, prior, camera)
        if combinations is not None:
            mine = np.flatnonzero(self.observations.camera == camera)
            problem = freed(problem, combinations, mine, len(self.observations.rig), camera)
        return replace(self, problem=problem)

    def with_confirmed(self, arm: int | None, errors: Float[ndarray, "s b"] | None) -> "CellImages":
        """Return the cell with confirmed errors of the poses of an arm, of one standard deviation each."""
        if arm is None or errors is None:
            return self
        arms = list(self.problem.arms)
        arms[arm] = replace(arms[arm], confirmed_errors=errors)
        return replace(self, problem=replace(self.problem, arms=tuple(arms)))


def cell_images(
    capture: Capture,
    reconstruction: Reconstruction,
    hand_eye: HandEye,
    known: KnownImages,
    members: Sequence[CameraViews],
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
        assert member.rig is not None
        for k, one in member.used.items():
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
    arms, starts = rigs.arm_poses(options)
    return CellImages(
        problem=Problem(
            arms=tuple(arms),
            n_rigs=len(rigs.poses),
            cameras=_cameras(capture, reconstruction.intrinsics, hand_eye, members),
            known_rigs=prior,
            robot_noise_floor=options.robot_noise_m_rad,
        ),
        state=State(
            x=np.stack([x for x, _ in starts]),
            scale=1.0,
            z=np.stack([z for _, z in starts]),
            world_from_rig=np.stack(rigs.poses),
            rig_from_camera=np.stack([np.eye(4), *mounts]),
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
    )


def _cameras(
    capture: Capture, own: Intrinsics, hand_eye: HandEye, members: Sequence[CameraViews]
) -> tuple[CameraPrior, ...]:
    """Return the cameras with the prior of their intrinsics; a mount is free only beside another camera on its rig.

    Given intrinsics that the own camera's images contradict count as estimated.
    """
    contradicted = any(one.kind is FindingKind.INTRINSICS and one.shift is None for one in hand_eye.findings)
    given = capture.intrinsics is not None and not contradicted
    cameras = [camera_about(own, given, capture.intrinsics_std)]
    for member in members:
        known = member.camera.intrinsics is not None
        camera = camera_about(member.intrinsics, known, member.camera.intrinsics_std)
        cameras.append(replace(camera, mount_free=member.rig_from_camera is not None))
    return tuple(cameras)


def _as_given(reconstruction: Reconstruction, hand_eye: HandEye, known: KnownImages) -> RigGaussian:
    """Return the distribution of the used images' poses, where other than features found in the images decided them."""
    rows = np.flatnonzero(hand_eye.inliers)
    spread_of = np.zeros((6 * len(rows), 6 * len(rows)))
    if (evidence := reconstruction.evidence) is not None:
        unit = np.tile(np.repeat([hand_eye.scale, 1.0], 3), len(rows))
        among = (6 * rows[:, None] + np.arange(6)).ravel()
        spread_of = unit[:, None] * evidence.covariance[np.ix_(among, among)] * unit
    return RigGaussian(known.recon_from_camera, spread_of + EXACT**2 * np.eye(len(spread_of)))
