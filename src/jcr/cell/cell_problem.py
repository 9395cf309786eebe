"""Estimation problem of a whole cell: images of all cameras, the capture's own first, and poses of all arms."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.cell.rigs import CameraViews, Rigs
from jcr.estimation.boards import shapes_of
from jcr.estimation.intrinsics_prior import camera_about
from jcr.estimation.problem import Observations, Problem, State
from jcr.estimation.robot_noise import of_poses
from jcr.findings import FindingKind
from jcr.records import Tracks
from jcr.sfm.track_refinement import KEYPOINT_STD_PX

GIVEN_POSE_STD = 1e-6
"""Standard deviation (m, rad) added to the covariance of given camera poses."""


def cell_images(rigs: Rigs, members: Sequence[CameraViews]) -> tuple[Problem, State]:
    """Return the estimation problem of a cell and its initial state: own images, then used ones of `members`.

    Camera 0 is the capture's own camera. The world is its recon frame, in metres.
    """
    case, hand_eye = rigs.case, rigs.case.numbers
    tracks, prior = case.model.observations, None
    # If the calibration does not come from bundle adjustment, the own camera's tracks are not used here either.
    if hand_eye.source == "poses" or tracks.from_pointmaps or not case.model.is_determined:
        prior, tracks = _given_poses(rigs), tracks.only(np.zeros(len(tracks.image), bool))
    observations, points_in_world = _observations(rigs, members, tracks)
    contradicted = (one.kind is FindingKind.INTRINSICS and one.shift is None for one in hand_eye.findings)
    given = case.capture.intrinsics is not None and not any(contradicted)
    cameras = [camera_about(case.reconstruction.intrinsics, given, case.capture.intrinsics_std)]
    mounts = [np.eye(4)]
    for member in members:
        own = member.camera
        prior_of_it = camera_about(member.intrinsics, own.intrinsics is not None, own.intrinsics_std)
        # A mount is estimated only for a camera that shares its rig with another camera.
        cameras.append(replace(prior_of_it, mount_free=member.rig_from_camera is not None))
        mounts.append(np.eye(4) if member.rig_from_camera is None else member.rig_from_camera)
    arms, starts, effects = rigs.arm_poses()
    twice = np.bincount(observations.point, minlength=len(points_in_world)) >= 2
    boards, world_from_board = shapes_of(tracks.boards, points_in_world, twice, len(rigs.poses))
    problem = Problem(
        arms=tuple(arms),
        n_rigs=len(rigs.poses) + len(world_from_board),
        cameras=tuple(cameras),
        observations=observations,
        known_rigs=prior,
        boards=boards,
        effects=effects,
        robot_noise_floor=case.options.robot_noise_m_rad,
    )
    state = State(
        x=np.stack([x for x, _ in starts]),
        scale=1.0,
        z=np.stack([z for _, z in starts]),
        world_from_rig=np.concatenate([rigs.poses, world_from_board]),
        rig_from_camera=np.stack(mounts),
        points_in_world=points_in_world,
    )
    return problem, state


def _observations(
    rigs: Rigs, members: Sequence[CameraViews], tracks: Tracks
) -> tuple[Observations, Float[ndarray, "p 3"]]:
    """Return the observations by all cameras, and the p points (m, in the world): those of the own `tracks` first."""
    rig, camera = list(range(len(rigs.rows))), [0] * len(rigs.rows)
    image, x_px, point = [tracks.image], [tracks.x_px], [tracks.point]
    std_px = [np.full(len(tracks.image), KEYPOINT_STD_PX) if tracks.std_px is None else tracks.std_px]
    points = [rigs.case.numbers.scale * tracks.points_in_recon.astype(float)]
    count = len(tracks.points_in_recon)
    for c, member in enumerate(members, start=1):
        for at, one in zip(member.rig.tolist(), member.used.values(), strict=True):
            n = len(one.x_px)
            image += [np.full(n, len(rig)), one.row]
            x_px += [one.x_px, one.row_x_px]
            point += [count + np.arange(n) if one.point is None else one.point, count + one.row_point]
            std_px.append(np.full(n + len(one.row), KEYPOINT_STD_PX))
            if one.point is None:
                points.append(one.points_in_recon)
                count += n
            rig.append(at)
            camera.append(c)
    observations = Observations(
        rig=np.array(rig),
        camera=np.array(camera),
        image=np.concatenate(image),
        x_px=np.concatenate(x_px),
        point=np.concatenate(point),
        std_px=np.concatenate(std_px),
    )
    return observations, np.concatenate(points)


def _given_poses(rigs: Rigs) -> tuple[Float[ndarray, "m 4 4"], Float[ndarray, "6*m 6*m"]]:
    """Return mean and covariance of the own camera's used poses, for a reconstruction without image features.

    The mean is recon_from_camera in metres. The covariance is pose by pose: translation (m), then rotation (rad).
    """
    rows = rigs.case.used
    covariance = GIVEN_POSE_STD**2 * np.eye(6 * len(rows))
    if (evidence := rigs.case.reconstruction.evidence) is not None:
        unit = np.tile(np.repeat([rigs.case.numbers.scale, 1.0], 3), len(rows))
        covariance += unit[:, None] * of_poses(evidence.covariance, rows) * unit
    return rigs.known.recon_from_camera, covariance
