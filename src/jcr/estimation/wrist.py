"""Estimation problem of one wrist camera, each of whose images is a rig, and its estimate."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.boards import shapes_of
from jcr.estimation.hypotheses import freed
from jcr.estimation.intrinsics_prior import FIXED, CameraPrior, camera_with_prior, expressed
from jcr.estimation.point_uncertainty import joint_covariance
from jcr.estimation.problem import (
    Observations,
    Problem,
    ReportedPoses,
    Start,
    State,
    transferred,
    with_observations,
    wrist_arm,
)
from jcr.estimation.solve import START_NOISE, Solution, solve
from jcr.geometry import Poses, Transform, apply, fit_similarity, scale_translation
from jcr.records import Intrinsics, ModelError, Tracks, Uncertainty


def wrist_problem(
    arm: ReportedPoses,
    start: Start,
    recon_from_camera: Poses,
    camera: CameraPrior,
    tracks: Tracks,
    *,
    noise: tuple[float, float] | None = None,
    combinations: Float[ndarray, "e p"] | None = None,
) -> tuple[Problem, State]:
    """Return the problem of images and reported poses together, and its initial state; the world is in metres.

    `arm` moves rig i at image i. `noise` is a lower bound on the random errors of the poses (m, rad), and
    `combinations` of the columns of hypotheses.Alternatives are free.
    """
    x, scale, z = start
    points_in_world = scale * tracks.points_in_recon.astype(float)
    twice = np.bincount(tracks.point, minlength=len(points_in_world)) >= 2
    boards, world_from_board = shapes_of(tracks.boards, points_in_world, twice, len(arm.rigs))
    problem = Problem(
        arms=(arm,),
        n_rigs=len(arm.rigs) + len(world_from_board),
        cameras=(camera,),
        boards=boards,
        robot_noise_floor=noise,
    )
    state = State(
        x=x[None],
        scale=1.0,
        z=z[None],
        world_from_rig=np.concatenate([scale_translation(recon_from_camera, scale), world_from_board]),
        points_in_world=points_in_world,
    )
    if combinations is not None:
        problem = freed(problem, combinations, arm.rigs, len(arm.rigs))
    return with_observations(problem, state, Observations.of_one_camera(tracks, len(arm.rigs)))


def adjust_wrist(  # noqa: PLR0913 (each is a fact about the capture)
    arm: ReportedPoses | Poses,
    start: Start,
    recon_from_camera: Poses,
    camera: CameraPrior | Intrinsics,
    tracks: Tracks,
    *,
    noise: tuple[float, float] | None = None,
    combinations: Float[ndarray, "e p"] | None = None,
    near: Solution | None = None,
    start_noise: tuple[float, float] = START_NOISE,
) -> Solution:
    """Adjust images and reported poses together, from a result of a fit to poses.

    The arguments are those of `wrist_problem`; the systematic errors of poses without an arm are smooth over the poses,
    and intrinsics without a prior are exact. `start_noise` is the initial size of the random errors of the poses
    (m, rad). `near` is a solution of the same poses and of the same points or more, from which the adjustment starts.
    """
    arm = arm if isinstance(arm, ReportedPoses) else wrist_arm(arm)
    if isinstance(camera, Intrinsics):
        camera = camera_with_prior(camera, FIXED)
    problem, state = wrist_problem(
        arm, start, recon_from_camera, camera, tracks, noise=noise, combinations=combinations
    )
    if near is not None:
        state = transferred(near.problem, near.state, problem)
    return solve(problem, state, start_noise=start_noise)


def uncertainty_of(found: Solution) -> Uncertainty:
    """Return the uncertainty of the first arm's transform, of the scale, and of the first camera's intrinsics."""
    problem, (camera, *_), observations = found.problem, found.problem.cameras, found.problem.observations
    intrinsics = found.camera_unknowns(problem.columns.intrinsics[0])
    own, model_error = problem.columns.model_error[0], None
    if own.stop > own.start:
        assert observations is not None
        unknowns = found.camera_unknowns(own)
        model_error = ModelError(
            likeliest=found.state.camera_steps[own],
            covariance=found.covariance[unknowns, unknowns],
            expressed=expressed(camera, observations.x_px[problem.camera_rows[0]]),
        )
    covariance, cross = found.covariance[:7, :7], found.covariance[:7, intrinsics] @ camera.directions.T
    known = problem.intrinsics(found.state)[0]
    joint = joint_covariance(covariance, cross, found.intrinsics_covariance(0), known)
    return Uncertainty(covariance=covariance, budget=found.budget, joint=joint, model_error=model_error)


def recon_frame(solution: Solution, tracks: Tracks) -> tuple[float, Transform]:
    """Return scale (metres per unit) and base_from_recon of the reconstruction whose tracks were adjusted.

    A similarity is fitted to its points and the adjusted ones, points that disagree having less weight.
    """
    state, observations = solution.state, solution.problem.observations
    assert observations is not None and observations.point_rows is not None
    points = apply(state.z[0], state.scale * state.points_in_world)
    recon = tracks.points_in_recon[observations.point_rows].astype(np.float64)
    weight = np.ones(len(points))
    base_from_recon, scale = fit_similarity(points, recon, weight)
    for _ in range(5):
        gap = np.linalg.norm(apply(base_from_recon, scale * recon) - points, axis=1)
        weight = 1 / (1 + (gap / max(float(np.median(gap)), 1e-9)) ** 2)
        base_from_recon, scale = fit_similarity(points, recon, weight)
    return float(scale), base_from_recon
