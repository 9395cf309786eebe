"""The adjustment of one wrist camera, a rig an image: what a capture's own camera needs of robots.py."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.boards import shapes_of
from jcr.estimation.fit import Unknowns
from jcr.estimation.image_robots import Adjusted, ArmPoses
from jcr.estimation.intrinsics_prior import FIXED, IntrinsicsPrior, prior_of
from jcr.estimation.pose_equations import Poses
from jcr.estimation.scene import Freedom, Observations, Scene
from jcr.estimation.score_test import freed
from jcr.estimation.systematic import smooth_errors
from jcr.estimation.together import START_NOISE, adjust
from jcr.geometry import Transform, apply, fit_similarity, scale_translation
from jcr.records import Intrinsics, Tracks


@dataclass(frozen=True, kw_only=True)
class WristOptions:
    """What is free beside the intrinsics, what was found of the robot before, and where to begin."""

    systematic: Float[ndarray, "s s"] | None = None
    """Covariance of the systematic errors of the gripper poses at 1 rad; None: that of errors smooth over the poses."""
    combinations: Float[ndarray, "e p"] | None = None
    """Of the columns of score_test.Alternatives, that are free too."""
    exchanged: bool = False
    """The camera stands still, and the arm carries what it sees."""
    near: Adjusted | None = None
    """An adjustment of the same poses and tracks, or of more of them, to begin from."""
    start_noise: tuple[float, float] = START_NOISE
    """m, rad; of the gripper poses, until it is estimated."""
    bent: Float[ndarray, "s b"] | None = None
    """Errors that were found of the gripper poses (estimation/pose_effects.py), of one standard deviation each."""


def adjust_wrist(
    base_from_gripper: Poses,
    start: Unknowns,
    recon_from_camera: Poses,
    intrinsics: Intrinsics,
    tracks: Tracks,
    *,
    noise: tuple[float, float] | None = None,
    prior: IntrinsicsPrior | None = None,
    options: WristOptions = WristOptions(),
) -> Adjusted:
    """Images and robot adjusted from a pose fit's (gripper_from_camera, scale, base_from_recon).

    `noise` is the robot's (m, rad), at least; it is estimated with the rest. `prior` is what is known of the
    intrinsics; None: that they are exact.
    """
    x, scale, z = start
    each, systematic = np.arange(len(base_from_gripper)), options.systematic
    prior = prior_of(intrinsics, FIXED) if prior is None else prior
    points_in_world = scale * tracks.points_in_recon.astype(float)
    twice = np.bincount(tracks.point, minlength=len(points_in_world)) >= 2
    boards, world_from_board = shapes_of(tracks.boards, points_in_world, twice, len(each))
    freedom = Freedom.of((intrinsics,), (prior,), len(each))
    if options.combinations is not None:
        freedom = freed(freedom, options.combinations, each)
    arm = ArmPoses(
        rigs=each,
        base_from_gripper=base_from_gripper,
        systematic=smooth_errors(base_from_gripper) if systematic is None else systematic,
        start=(x, z),
        exchanged=options.exchanged,
        bent=options.bent,
    )
    return adjust(
        Scene(
            world_from_rig=np.concatenate([scale_translation(recon_from_camera, scale), world_from_board]),
            rig_from_camera=np.eye(4)[None],
            cameras=(intrinsics,),
            points_in_world=points_in_world,
        ),
        Observations.of_one_camera(tracks, len(each), boards),
        freedom,
        [arm],
        noise,
        near=options.near,
        start_noise=options.start_noise,
    )


def recon_frame(adjusted: Adjusted, tracks: Tracks) -> tuple[float, Transform]:
    """Scale (metres per unit) and base_from_recon of the reconstruction whose tracks were adjusted.

    Its points against the adjusted ones, weighed down where the two disagree.
    """
    placed, problem = adjusted.placed, adjusted.given.evidence.problem
    points = apply(placed.z[0], placed.scale * placed.scene.points_in_world)
    recon = tracks.points_in_recon[problem.points].astype(np.float64)
    weight = np.ones(len(points))
    base_from_recon, scale = fit_similarity(points, recon, weight)
    for _ in range(5):
        gap = np.linalg.norm(apply(base_from_recon, scale * recon) - points, axis=1)
        weight = 1 / (1 + (gap / max(float(np.median(gap)), 1e-9)) ** 2)
        base_from_recon, scale = fit_similarity(points, recon, weight)
    return float(scale), base_from_recon
