"""Placement of the further cameras of a cell, given the calibration of the capture's own camera.

Every image of another camera is localised in the reconstruction (localise.py); all images are adjusted together with
the arms' poses (estimation/). The calibration of the capture's own camera stays as it was found: what is found here of
others rests on the same images.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.checks.camera import CameraAdjustment, all_combinations
from jcr.calibration.checks.effects import as_adopted, effects
from jcr.calibration.options import CalibrateOptions
from jcr.capture.images import read_image
from jcr.cell.camera_views import CameraViews, localise
from jcr.cell.images import CellImages, cell_images
from jcr.cell.placement import ArmPlacement, CameraPlacement, CellPlacement, ImageUse, TransformUncertainty
from jcr.cell.rigs import Rigs
from jcr.estimation.hand_eye import MAX_STD
from jcr.estimation.image_equations import median_reprojection_px
from jcr.estimation.problem import State
from jcr.estimation.solve import Solution
from jcr.findings import Finding, FindingKind
from jcr.geometry import apply, inverse, scale_translation
from jcr.least_squares import one_blas_thread
from jcr.progress import Progress, silent, steps
from jcr.records import Capture, CellCamera, HandEye, Reconstruction
from jcr.records.json_fields import IntrinsicsAndStd
from jcr.sfm.register import KnownImages, Registration

CONTRADICTS = 5.0
"""Factor of the median reprojection error of all images of the cell from which an image contradicts a pose."""
LEAST_PX = 1.0
"""Smallest median reprojection error (px) that contradicts a pose, for images up to 1600 px wide."""
LEAST_SPREAD = 0.05
"""Smallest share of the image's area that the points should span; crowded points determine a pose badly."""
FAR_FROM_GRIPPER = 0.5
"""Distance (m) from the gripper's frame beyond which a camera is likely to be mounted elsewhere."""


@one_blas_thread
def place_cameras(
    capture: Capture,
    others: Sequence[CellCamera],
    reconstruction: Reconstruction,
    hand_eye: HandEye,
    options: CalibrateOptions | None = None,
    progress: Progress | None = None,
) -> CellPlacement:
    """Place the cameras of `others` that see the scene of a capture whose own camera is calibrated.

    A camera that cannot be placed is in the result with the reason.
    """
    options, progress = options or CalibrateOptions(), progress or silent
    if not others:
        return CellPlacement(())
    if not hand_eye.is_sound:
        why = (Finding.of(FindingKind.OWN_REJECTED, "rejects", camera=capture.camera_name),)
        return CellPlacement(tuple(CameraPlacement.rejected(one, why) for one in others))
    used = np.flatnonzero(hand_eye.inliers)
    rows = reconstruction.image_index[used]
    # In metres from the first: the equations that follow are better for it, and distances can be spoken of.
    own = scale_translation(reconstruction.recon_from_camera[used], hand_eye.scale)
    images = [read_image(capture.folder / capture.images[row]) for row in rows]
    known = KnownImages.of(images, reconstruction.intrinsics, own)
    found: dict[str, list[Registration | int]] = {camera.name: [] for camera in others}
    todo = [(camera, image) for camera in others for image in camera.images]
    for camera, image in steps(progress, "other cameras", todo):
        pixels = read_image((camera.folder or capture.folder) / image)
        found[camera.name].append(localise(known, pixels, camera))
    rigs = Rigs(capture, hand_eye, own, rows)
    placed: list[CameraViews] = []
    failed: list[CameraPlacement] = []
    for camera in others:
        member = rigs.add(CameraViews(camera=camera, found=tuple(found[camera.name])))
        if isinstance(member, CameraPlacement):
            failed.append(member)
        else:
            placed.append(member)
    if not placed:
        return CellPlacement(tuple(failed))
    images = cell_images(capture, reconstruction, hand_eye, known, placed, rigs, options)
    of = {member.camera.name: _place_of(member, c) for c, member in enumerate(placed, start=1)}
    answer, faults = _examined(images, placed, list(of.values()), hand_eye)
    cameras = {camera.name: camera for camera in failed}
    for c, (member, shown) in enumerate(zip(placed, faults, strict=True), start=1):
        name = member.camera.name
        cameras[name] = _placement(member, c, answer, of[name], hand_eye, shown)
    arms = []
    for k, arm in enumerate(rigs.arms, start=1):
        transform, covariance = answer.transform(lambda p, k=k: p.z[0] @ inverse(p.z[k]))
        arms.append(
            ArmPlacement(
                name=arm,
                base_from_other_base=transform.tolist(),
                uncertainty=TransformUncertainty.of(covariance),
            )
        )
    return CellPlacement(tuple(cameras[camera.name] for camera in others), tuple(arms), answer, of)


def _place_of(member: CameraViews, c: int) -> Callable[[State], Float[ndarray, "4 4"]]:
    """Return parent_from_camera of the c-th camera as a function of the state."""
    assert member.rig is not None
    rig, arm = int(member.rig[next(iter(member.used))]), member.arm

    def parent_from_camera(placed: State) -> Float[ndarray, "4 4"]:
        if arm is None:
            return placed.z[0] @ scale_translation(placed.world_from_rig[rig], placed.scale)
        return placed.x[arm] @ scale_translation(placed.rig_from_camera[c], placed.scale)

    return parent_from_camera


def _examined(
    images: CellImages,
    members: Sequence[CameraViews],
    places: Sequence[Callable[[State], Float[ndarray, "4 4"]]],
    hand_eye: HandEye,
) -> tuple[Solution, list[tuple[Finding, ...]]]:
    """Adjust all images, and test those of each camera (calibration/checks/effects.py).

    The adjustment adopts the effects on the cameras: of one image given intrinsics that are wrong would weigh more than
    what it shows.
    """
    answer, found = images.adjusted(), list[tuple[Finding, ...]]()
    tested: set[int | None] = {0}
    for c, (member, place) in enumerate(zip(members, places, strict=True), start=1):
        if not len(images.problem.cameras[c].std):  # exact, as of a camera that is compared with itself
            found.append(())
            continue
        is_given = member.camera.intrinsics is not None
        # The poses of the capture's own arm were tested with its own camera, those of others are with their first one.
        arm = None if member.arm in tested else member.arm
        tested.add(arm)
        imaged = _imaged(
            images, answer, _placement(member, c, answer, place, hand_eye), c, (arm, place), is_given
        )
        state, faults = effects(imaged)
        if state.found:
            images = images.with_freed(imaged.prior, c, all_combinations(state.found))
            answer = images.adjusted()
            faults = tuple(as_adopted(one) if one.kind.row.group == "camera" else one for one in faults)
        found.append(faults)
    return answer, found


def _imaged(
    images: CellImages,
    answer: Solution,
    found: CameraPlacement,
    c: int,
    arm_and_place: tuple[int | None, Callable[[State], Float[ndarray, "4 4"]]],
    is_given: bool,
) -> CameraAdjustment:
    """Return a further camera, the c-th, as its checks take it, with the arm whose poses are tested with it."""
    assert found.covariance is not None
    arm, place = arm_and_place
    return CameraAdjustment(
        adjusted=answer,
        adjust=lambda prior, combinations, bent: (
            images.with_confirmed(arm, bent).with_freed(prior, c, combinations).adjusted()
        ),
        arm=arm,
        names=[image.image for image in found.images if image.used],
        is_given=is_given,
        prior=images.problem.cameras[c],
        std=np.sqrt(np.diag(found.covariance)) * found.converged,
        answer=lambda adjusted: (place(adjusted.state), adjusted.state.scale),
        camera=c,
        place=place,
    )


def _placement(
    member: CameraViews,
    c: int,
    answer: Solution,
    parent_from_camera: Callable[[State], Float[ndarray, "4 4"]],
    hand_eye: HandEye,
    faults: Sequence[Finding] = (),
) -> CameraPlacement:
    """Return the placement of the c-th camera with its findings; the shifts of `faults` add to its covariance."""
    camera, problem = member.camera, answer.problem
    assert problem.observations is not None
    transform, covariance = answer.transform(parent_from_camera)
    covariance = covariance + _by_faults(answer, answer.derivative(parent_from_camera), hand_eye)
    of_all = median_reprojection_px(problem, answer.images.view)
    medians = of_all[problem.observations.camera == c].tolist()
    px = dict(zip(member.used, medians, strict=True))
    images = [
        ImageUse(image=image, used=k in px, points=count, reprojection_px=px.get(k), reason=member.reason(k))
        for k, (image, count) in enumerate(zip(camera.images, member.counts, strict=True))
    ]
    intrinsics, std = problem.intrinsics(answer.state)[c], np.sqrt(np.diag(answer.intrinsics_covariance(c)))

    def uncertain() -> Finding | None:
        """Return the finding of a pose that is too uncertain; for unknown intrinsics with that of the focal length."""
        metres, radians = np.sqrt(np.diag(covariance)).reshape(2, 3).max(1).tolist()
        if metres <= MAX_STD[0] and radians <= MAX_STD[1]:
            return None
        if camera.intrinsics is not None:
            return Finding.of(
                FindingKind.PLACE_UNCERTAIN, "rejects", "images", value=metres, rotation=radians
            )
        more = {"rotation": radians, "focal_std": float(std[0]) / intrinsics.fx}
        return Finding.of(FindingKind.PLACE_UNCERTAIN, "rejects", "intrinsics", value=metres, **more)

    findings = list(member.findings)
    worst = max(images, key=lambda image: image.reprojection_px or 0.0)
    limit_px = max(CONTRADICTS * float(np.median(of_all)), LEAST_PX * max(1.0, camera.image_size[0] / 1600))
    if (most_px := worst.reprojection_px or 0.0) > limit_px:  # which also makes the pose uncertain
        details = {"value": most_px, "mount": camera.mount}
        findings.insert(0, Finding.of(FindingKind.IMAGE_MISSES, "rejects", "mount", worst.image, **details))
    elif (found := uncertain()) is not None:
        findings.insert(0, found)
    registered = list(member.registered.values())
    if (widest := max(map(_spread, registered))) < LEAST_SPREAD:
        findings.append(Finding.of(FindingKind.POINTS_CROWDED, "warns", "images", value=widest))
    away = float(np.linalg.norm(transform[:3, 3]))
    if camera.mount == "gripper" and away > FAR_FROM_GRIPPER:
        findings.append(Finding.of(FindingKind.FAR_FROM_GRIPPER, "warns", "mount", value=away))
    for fault in faults:
        covariance = covariance + fault.covariance[:6, :6]
        rejected = any(one.severity == "rejects" for one in findings)
        findings.append(replace(fault, severity="rejects") if rejected or uncertain() else fault)
    depths = [apply(inverse(one.pose.a_from_camera), one.points_in_recon)[:, 2] for one in registered]
    distance_m = answer.state.scale * float(np.median([np.median(depth) for depth in depths]))
    return CameraPlacement.of(
        camera,
        images,
        findings,
        transform,
        TransformUncertainty.of(covariance, transform, distance_m),
        IntrinsicsAndStd.of(intrinsics, std),
    )


def _spread(found: Registration) -> float:
    """Return the share of the image's area that the standard deviations of its points span."""
    sides = 4 * np.sqrt(np.linalg.eigvalsh(np.cov(found.x_px.T)))
    return float(sides.prod() / (found.pose.camera.width * found.pose.camera.height))


def _by_faults(
    answer: Solution, derivative: Float[ndarray, "6 p"], hand_eye: HandEye
) -> Float[ndarray, "6 6"]:
    """Return the covariance that faults of the capture's own calibration, such as a slip, add to a further camera.

    The part of its covariance beside images and robot moves everything that varies with it.
    """
    size = np.sqrt(np.diag(hand_eye.covariance))
    more = (hand_eye.covariance - answer.covariance[:7, :7]) / np.outer(size, size)
    values, vectors = np.linalg.eigh(more)
    root = size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    follows = derivative @ np.linalg.solve(answer.covariance[:7, :7], answer.covariance[:7]).T
    return follows @ root @ root.T @ follows.T
