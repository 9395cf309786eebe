"""Placement of the further cameras of a cell, given the calibration of the capture's own camera.

Every image of another camera is localised in the reconstruction (rigs.py); then all images are adjusted together with
the arms' poses (estimation/). The calibration of the capture's own camera is not changed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr import __version__
from jcr.calibration.arm_of_capture import robot_errors
from jcr.calibration.case import MATERIAL, Case, Model, camera_of
from jcr.calibration.checks.effects import LARGE_MOTION, effects, straight_shift
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.calibration.verdict import MAX_STD
from jcr.capture.images import read_image
from jcr.cell.board_images import located_by_board
from jcr.cell.cameras_json import ArmPlacement, CameraPlacement, CamerasFile, TransformUncertainty
from jcr.cell.cell_problem import cell_images
from jcr.cell.rigs import APART, CameraViews, Rigs, localise
from jcr.estimation.covariance import positive_part
from jcr.estimation.hypotheses import Examined
from jcr.estimation.image_equations import median_reprojection_px
from jcr.estimation.problem import Effect, Problem, State, columns_of_arm, with_observations
from jcr.estimation.solve import Solution, solve, solve_again
from jcr.findings import Finding, FindingKind
from jcr.geometry import Transform, apply, inverse, step_between
from jcr.least_squares import one_blas_thread
from jcr.progress import Progress, silent, steps
from jcr.records import Capture, CellCamera, Reconstruction

CONTRADICTS = 5.0
"""Reprojection error of an image, as a multiple of the median of all images, from which it contradicts the pose."""
LEAST_PX = 1.0
"""Lower bound (px) of the median reprojection error that contradicts a pose, for images up to 1600 px wide."""


@one_blas_thread
def place_cameras(
    capture: Capture,
    others: Sequence[CellCamera],
    reconstruction: Reconstruction,
    hand_eye: Calibration,
    options: CalibrateOptions | None = None,
    progress: Progress | None = None,
) -> tuple[CamerasFile, Solution | None, Mapping[str, Callable[[State], Transform]]]:
    """Return the poses of the cameras `others` of the cell; `hand_eye` is the calibration of the capture's own camera.

    `reconstruction` is that of the own camera. The first result is the content of cameras.json; a camera that cannot be
    placed is in it with the reason. The others are the joint solution (None if no camera was placed), and for each
    placed camera a function that returns base_from_camera or gripper_from_camera from a state of the solution.
    """
    if not hand_eye.converged or not others:
        why = (Finding.of(FindingKind.OWN_REJECTED, "rejects", camera=capture.camera_name),)
        rejected = [CameraPlacement.of(one, why) for one in others]
        return CamerasFile(cameras=rejected, arms=[], version=__version__), None, {}
    options = options or CalibrateOptions()
    case = Case(
        capture=capture,
        reconstruction=reconstruction,
        options=options,
        robot=robot_errors(capture, options).of(reconstruction.image_index),
        fit=hand_eye,
        numbers=hand_eye,
        model=Model(
            tracks=reconstruction.tracks,
            used=hand_eye.inliers,
            camera=camera_of(capture, reconstruction),
        ),
    )
    rigs = Rigs(case)
    cameras, mounted = dict[str, CameraPlacement](), list[CameraViews]()
    for camera, views in zip(others, _registered(rigs, others, progress or silent), strict=True):
        if views is None:
            no_board = Finding.of(FindingKind.BOARD_NEEDED, "rejects", "images")
            cameras[camera.name] = CameraPlacement.of(camera, (no_board,))
            continue
        moved = _moved(rigs, views) if views.is_fixed and len(views.used) > 1 else ()
        refused = any(one.severity == "rejects" for one in moved)
        views = views.refused(*moved) if refused else rigs.add(replace(views, findings=moved))
        if isinstance(views, CameraPlacement):
            cameras[camera.name] = views
        else:
            mounted.append(replace(views, number=len(mounted) + 1))
    if not mounted:
        return CamerasFile(cameras=[*cameras.values()], arms=[], version=__version__), None, {}
    solution, faults = _examined(*cell_images(rigs, mounted), mounted, hand_eye)
    for one, shown in zip(mounted, faults, strict=True):
        cameras[one.camera.name] = _placement(one, solution, hand_eye, shown)
    arms = []
    for k, arm in enumerate(rigs.arms, start=1):
        transform, covariance = solution.transform(lambda p, k=k: p.z[0] @ inverse(p.z[k]))
        uncertainty = TransformUncertainty.of(covariance)
        arms.append(ArmPlacement(name=arm, base_from_other_base=transform.tolist(), uncertainty=uncertainty))
    poses = {one.camera.name: one.parent_from_camera for one in mounted}
    placed = [cameras[camera.name] for camera in others]
    return CamerasFile(cameras=placed, arms=arms, version=__version__), solution, poses


def _registered(rigs: Rigs, others: Sequence[CellCamera], progress: Progress) -> list[CameraViews | None]:
    """Return the registrations of each camera's images; None for one before a gripper whose board is unknown.

    Images are registered by the features of the scene or, before the gripper, by the board that it carries.
    """
    case, every = rigs.case, list[CameraViews | None]()
    tracks, is_fixed = case.model.tracks, case.carries == "scene"
    points = case.numbers.scale * tracks.points_in_recon.astype(float)
    why = "shows {} corners of the board, too few" if is_fixed else "shares {} points with the mapped scene"
    for camera in steps(progress, "other cameras", others):
        folder = camera.folder or case.capture.folder
        if not is_fixed:
            found = [localise(rigs.known, read_image(folder / image), camera) for image in camera.images]
        elif tracks.boards is not None:
            found = located_by_board(tracks.boards, points, replace(camera, folder=folder))
        else:
            found = []
        views = CameraViews(
            camera=camera,
            points=[count for _, count in found],
            used={k: one for k, (one, _) in enumerate(found) if one is not None},
            reasons={k: why.format(n) for k, (one, n) in enumerate(found) if one is None},
        )
        every.append(views if found else None)
    return every


def _moved(rigs: Rigs, views: CameraViews) -> tuple[Finding, ...]:
    """Return a finding if the images of a fixed camera have different poses; an empty tuple if the poses agree.

    Poses differ if their squared Mahalanobis distance exceeds APART and a step exceeds MATERIAL standard deviations.
    Each image is adjusted with its own pose; common errors, as of the intrinsics, cancel in the covariance of a
    difference.
    """
    alone = Rigs(rigs.case, rigs.known)
    alone.poses += list(views.places)
    own = len(rigs.known.recon_from_camera)
    apart = replace(views, rig=own + np.arange(len(views.used)))
    solution = solve(*with_observations(*cell_images(alone, [apart])))
    cameras = [replace(views, rig=np.array([own + k])) for k in range(len(views.used))]
    places = [one.parent_from_camera(solution.state) for one in cameras]
    derivatives = [solution.derivative(one.parent_from_camera) for one in cameras]
    std, farthest, found = np.sqrt(np.diag(solution.transform(cameras[0].parent_from_camera)[1])), APART, ()
    for a, b in combinations(range(len(places)), 2):
        step, by = step_between(places[a], places[b]), derivatives[b] - derivatives[a]
        squared = float(step @ np.linalg.solve(by @ solution.covariance @ by.T, step))
        if squared > farthest and (np.abs(step) > MATERIAL * std).any():
            metres, radians = np.linalg.norm(step.reshape(2, 3), axis=1).tolist()
            severity = "rejects" if metres > LARGE_MOTION[0] or radians > LARGE_MOTION[1] else "warns"
            size = {"value": metres, "rotation": radians}
            one = Finding.of(FindingKind.NOT_FIXED, severity, "mount", views.names[a], views.names[b], **size)
            farthest, found = squared, (replace(one, shift=(*(step / 2).tolist(), 0.0)),)
    return found


def _examined(
    problem: Problem, start: State, mounted: Sequence[CameraViews], hand_eye: Calibration
) -> tuple[Solution, list[tuple[Finding, ...]]]:
    """Return the joint solution of all images, and for each camera the findings on effects such as a slip.

    `mounted` are the cameras of `problem` other than the capture's own, `start` is the initial state. Confirmed effects
    on the camera's parameters are adopted in the solution. Findings are in the order of `mounted`, and empty for a
    camera with exact intrinsics or one that is known to have moved. Another arm's poses are tested with its camera;
    those of the capture's own arm were tested in its calibration.
    """
    solution, found = solve(*with_observations(problem, start)), list[tuple[Finding, ...]]()
    for one in mounted:
        # Exact intrinsics are not tested, and neither is a camera that is known to have moved.
        if not len(problem.cameras[one.number].std) or any(fault.shift is not None for fault in one.findings):
            found.append(())
            continue
        placed = _placement(one, solution, hand_eye)
        assert placed.covariance is not None
        tested = Examined(
            solution=solution,
            arm=one.arm or None,
            names=one.names,
            is_given=one.camera.intrinsics is not None,
            std=np.sqrt(np.diag(placed.covariance)) * placed.converged,
            camera=one.number,
            place=one.parent_from_camera,
        )
        solution, faults = _adopted(tested, *effects(tested))
        found.append(faults)
    return solution, found


def _adopted(
    tested: Examined, confirmed: Sequence[Effect], faults: Sequence[Finding]
) -> tuple[Solution, tuple[Finding, ...]]:
    """Return the solution with the effects on a camera and its arm, and the findings on them.

    Findings on the camera lose their shifts. The first finding on the arm's lengths or angles (a strain) gets the shift
    of the camera's pose from reported to true gripper poses. Effects of the image order are not adopted.
    """
    kept = [one for one in confirmed if one.of_camera or one.kind.row.group == "strain"]
    if not kept:
        return tested.solution, tuple(faults)
    solution, adopted = (
        solve_again(tested.solution, effects=(*tested.solution.problem.effects, *kept)),
        list[Finding](),
    )
    strains = [one for one in kept if not one.of_camera]
    for one in faults:
        if one.kind.row.group == "camera":
            one = replace(one, shift=None, intrinsics_shift=None)
        elif strains and one.kind is strains[0].kind:
            bent = np.concatenate([each.unit * each.columns for each in strains], axis=1)
            shift = straight_shift(solution, bent)[columns_of_arm(strains[0].part)[:6]]
            one = replace(one, shift=(*shift.tolist(), 0.0))
        adopted.append(one)
    return solution, tuple(adopted)


def _placement(
    views: CameraViews, solution: Solution, hand_eye: Calibration, faults: Sequence[Finding] = ()
) -> CameraPlacement:
    """Return the placement of a camera from the joint solution; `faults` are findings on effects such as a slip.

    The covariances of `faults` add to the covariance of the camera's pose.
    """
    c, problem = views.number, solution.problem
    assert problem.observations is not None
    transform, covariance = solution.transform(views.parent_from_camera)
    # Findings of the own calibration, such as a slip, increase its covariance; the increase is propagated to this camera
    # by the correlation of both poses.
    own = solution.covariance[:7, :7]
    follows = solution.derivative(views.parent_from_camera) @ np.linalg.solve(own, solution.covariance[:7]).T
    added = positive_part(hand_eye.covariance - own, hand_eye.covariance)
    covariance = covariance + follows @ added @ follows.T
    covariance = covariance + sum(fault.covariance[:6, :6] for fault in views.findings)
    of_all = median_reprojection_px(problem, solution.images.view)
    px = dict(zip(views.used, of_all[problem.observations.camera == c].tolist(), strict=True))
    intrinsics = problem.intrinsics(solution.state)[c]
    std = np.sqrt(np.diag(solution.intrinsics_covariance(c)))
    findings = list(views.findings)
    worst = max(px, key=lambda k: px[k])
    limit_px = max(
        CONTRADICTS * float(np.median(of_all)), LEAST_PX * max(1.0, views.camera.image_size[0] / 1600)
    )
    if px[worst] > limit_px:  # a reason for uncertainty too, which is therefore not reported
        image, details = views.camera.images[worst], {"value": px[worst], "mount": views.camera.mount}
        findings.insert(0, Finding.of(FindingKind.IMAGE_MISSES, "rejects", "mount", image, **details))
    else:
        findings += _uncertain(views.camera, covariance, float(std[0]) / intrinsics.fx)
    used = list(views.used.values())
    for fault in faults:
        covariance = covariance + fault.covariance[:6, :6]
        rejected = any(one.severity == "rejects" for one in findings) or _uncertain(views.camera, covariance)
        findings.append(replace(fault, severity="rejects") if rejected else fault)
    depths = [apply(inverse(one.pose.a_from_camera), one.points_in_recon)[:, 2] for one in used]
    distance_m = solution.state.scale * float(np.median([np.median(depth) for depth in depths]))
    return CameraPlacement.of(
        views.camera,
        findings,
        views.points,
        views.reasons,
        px,
        **{f"{views.camera.mount}_from_camera": transform.tolist()},
        uncertainty=TransformUncertainty.of(covariance, transform, distance_m),
        intrinsics=intrinsics.with_std(std),
    )


def _uncertain(
    camera: CellCamera, covariance: Float[ndarray, "6 6"], focal_std: float = 0.0
) -> list[Finding]:
    """Return a list with one finding if the pose is too uncertain, else an empty list.

    `covariance` is translation (m), then rotation (rad); the limits are MAX_STD. `focal_std` is the relative standard
    deviation of the focal length, for the message on a camera without given intrinsics.
    """
    metres, radians = np.sqrt(np.diag(covariance)).reshape(2, 3).max(1).tolist()
    if metres <= MAX_STD[0] and radians <= MAX_STD[1]:
        return []
    size = {"value": metres, "rotation": radians}
    if camera.intrinsics is not None:
        return [Finding.of(FindingKind.PLACE_UNCERTAIN, "rejects", "images", **size)]
    return [Finding.of(FindingKind.PLACE_UNCERTAIN, "rejects", "intrinsics", **size, focal_std=focal_std)]
