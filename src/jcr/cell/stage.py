"""Further cameras of a cell, placed with the calibration of the capture's own: images first, then robots.

Every image of another camera is localised in the reconstruction (localise.py); all images are adjusted together with
the arms' poses (adjust/). The calibration of the capture's own camera stays as it was found: what is found here of
others rests on the same images.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.adjust.images import median_reprojection_px
from jcr.adjust.intrinsics_prior import ESTIMATED, prior_about, prior_of
from jcr.adjust.robots import Adjusted, ArmPoses, Placed
from jcr.adjust.scene import Freedom, Observations, RigInformation, Scene
from jcr.calibration.case import MIN_OBSERVATIONS, of_images
from jcr.calibration.checks.camera import camera_faults, with_contradiction
from jcr.calibration.checks.given_intrinsics import contradicted_by
from jcr.calibration.checks.imaged import Imaged
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.robot_errors import robot_errors
from jcr.camera import usable_lens
from jcr.capture.images import read_image
from jcr.cell.found import ArmFound, CameraFound, CellFound, ImageFound
from jcr.cell.images import CellImages
from jcr.cell.localise import (
    LEAST_SPREAD,
    Known,
    Shared,
    distance,
    guessed_intrinsics,
    known_images,
    localised,
    spread,
)
from jcr.geometry import inverse, motion_length, scale_translation, step_between
from jcr.handeye.bent import bends
from jcr.handeye.solve import MAX_STD, solve_hand_eye
from jcr.handeye.systematic import smooth_errors
from jcr.least_squares import one_blas_thread
from jcr.progress import Progress, silent, steps
from jcr.reconstruct.least_squares_matching import KEYPOINT_STD_PX
from jcr.records import (
    BENT,
    Capture,
    CellCamera,
    Finding,
    HandEye,
    Intrinsics,
    Kind,
    Mend,
    Reconstruction,
)

SAME_PLACE = (0.02, np.radians(2.0))
"""m, rad: images of one fixed camera, or places of a camera on its gripper, differ by no more."""
SAME_PLACE_OF_UNKNOWN = (0.2, np.radians(6.0))
"""Of the distance of the scene, rad: the same where a focal length estimated from one image is in it."""
MEDIAN_PX = 3.0
"""Images of a camera that miss by more, of one 1600 px wide, do not fit one place."""
FAR_FROM_GRIPPER = 0.5
"""m: the camera of a gripper that is farther from its frame is likely to be another's."""
SURE_OF_INTRINSICS = 3.5
"""Standard deviations from which a further camera's images are said to contradict its intrinsics: one image of 127
points showed those of another camera, 3.5 % too long, by 4.4."""
AT_A_FRAME = (0.01, np.radians(1.0))
"""m, rad: nearer than this to where the wrist camera was, a fixed camera is likely to be that camera."""
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
LEAST_POSES = 3
"""Of another arm, or of another camera on the gripper: images."""


@one_blas_thread
def place_cameras(
    capture: Capture,
    others: Sequence[CellCamera],
    reconstruction: Reconstruction,
    hand_eye: HandEye,
    options: CalibrateOptions | None = None,
    progress: Progress | None = None,
) -> CellFound:
    """The cameras of `others` that see the scene of a capture whose own camera is calibrated.

    One that cannot be placed is in the result with the reason.
    """
    options, progress = options or CalibrateOptions(), progress or silent
    if not others:
        return CellFound((), (), None)
    if not hand_eye.is_sound:
        seen = map(_Seen.nothing_of, others)
        refused = [one.refused(Kind.OWN_REJECTED, camera=capture.camera_name) for one in seen]
        return CellFound(tuple(refused), (), None)
    used = np.flatnonzero(hand_eye.inliers)
    rows = reconstruction.image_index[used]
    # In metres from the first: the equations that follow are better for it, and distances can be spoken of.
    own = scale_translation(reconstruction.recon_from_camera[used], hand_eye.scale)
    images = [read_image(capture.folder / capture.images[row]) for row in rows]
    known = known_images(images, reconstruction.intrinsics, own)
    found: dict[str, list[Shared | int]] = {camera.name: [] for camera in others}
    todo = [(camera, image) for camera in others for image in camera.images]
    for camera, image in steps(progress, "other cameras", todo):
        intrinsics, _ = usable_lens(camera.intrinsics)
        pixels = read_image((camera.folder or capture.folder) / image)
        start = intrinsics or guessed_intrinsics(camera.image_size)
        found[camera.name].append(localised(known, pixels, start, intrinsics is not None))
    rigs = _Rigs(capture, hand_eye, own, rows)
    placed: list[_Member] = []
    failed: list[CameraFound] = []
    for camera in others:
        member = rigs.add(_Seen.of(camera, found[camera.name]))
        if isinstance(member, CameraFound):
            failed.append(member)
        else:
            placed.append(member)
    if not placed:
        return CellFound(tuple(failed), (), None)
    images = _images_of(capture, reconstruction, hand_eye, known, placed, rigs, options)
    of = {member.camera.name: _place_of(member, c) for c, member in enumerate(placed, start=1)}
    answer, faults = _examined(images, placed, list(of.values()), hand_eye)
    cameras = {camera.name: camera for camera in failed}
    for c, (member, shown) in enumerate(zip(placed, faults, strict=True), start=1):
        name = member.camera.name
        cameras[name] = _with_faults(_found(member, c, answer, of[name], hand_eye), member, shown)
    arms = []
    for k, arm in enumerate(rigs.arms, start=1):
        transform, covariance = answer.transform(lambda p, k=k: p.z[0] @ inverse(p.z[k]))
        arms.append(ArmFound(arm, transform, covariance))
    return CellFound(tuple(cameras[camera.name] for camera in others), tuple(arms), answer, of)


@dataclass(frozen=True)
class _Seen:
    """What the images of one camera share with the images of known pose, in the order of its images."""

    camera: CellCamera
    shared: tuple[Shared | None, ...]
    counts: tuple[int, ...]
    """Points."""
    reasons: tuple[str | None, ...]
    """Why each is not used."""

    @staticmethod
    def of(camera: CellCamera, found: Sequence[Shared | int]) -> "_Seen":
        """Of what localised() said of each image."""
        return _Seen(
            camera,
            tuple(one if isinstance(one, Shared) else None for one in found),
            tuple(len(one.x_px) if isinstance(one, Shared) else one for one in found),
            tuple(
                None if isinstance(one, Shared) else f"shares {one} points with the mapped scene"
                for one in found
            ),
        )

    @staticmethod
    def nothing_of(camera: CellCamera) -> "_Seen":
        """Before anything is looked at."""
        count = len(camera.images)
        return _Seen(camera, (None,) * count, (0,) * count, (None,) * count)

    @property
    def rows(self) -> Int[ndarray, " k"]:
        """Images that were localised."""
        return np.flatnonzero([one is not None for one in self.shared])

    @property
    def places(self) -> Float[ndarray, "k 4 4"]:
        """Of these."""
        return np.stack([one.recon_from_camera for one in self.shared if one is not None])

    @property
    def distance(self) -> float:
        """Of the scene."""
        return float(np.median([distance(one) for one in self.shared if one is not None]))

    @property
    def intrinsics(self) -> Intrinsics:
        """Given, or as the image with most points has it."""
        intrinsics, _ = usable_lens(self.camera.intrinsics)
        best = max((one for one in self.shared if one is not None), key=lambda one: len(one.x_px))
        return intrinsics or best.intrinsics

    @property
    def agrees_with_given(self) -> bool:
        """Whether all places were found with intrinsics that were given, and none with a focal length of its own."""
        intrinsics, _ = usable_lens(self.camera.intrinsics)
        return all(one is None or one.intrinsics == intrinsics for one in self.shared)

    def without(self, reasons: Mapping[int, str]) -> "_Seen":
        """With why some images are not used."""
        return replace(self, reasons=tuple(reasons.get(k, before) for k, before in enumerate(self.reasons)))

    def refused(
        self,
        kind: Kind,
        mend: Mend = "none",
        images: tuple[str, ...] = (),
        value: float | None = None,
        **details: float | str,
    ) -> CameraFound:
        """The camera is not placed, for this finding."""
        why = Finding(kind=kind, severity="rejects", mend=mend, images=images, value=value, details=details)
        return self.not_placed(why)

    def not_placed(self, *why: Finding) -> CameraFound:
        """The camera with why it is not placed."""
        camera = self.camera
        images = [
            ImageFound(image, False, count, None, reason or "the camera was not placed")
            for image, count, reason in zip(camera.images, self.counts, self.reasons, strict=True)
        ]
        return CameraFound(
            name=camera.name, mount=camera.mount, arm=camera.arm, images=tuple(images), findings=why
        )


@dataclass(frozen=True)
class _Member:
    """A camera with the images that are used."""

    seen: _Seen
    rig: Int[ndarray, " k"]
    """Of each image; -1 where it is not used."""
    rig_from_camera: Float[ndarray, "4 4"] | None
    """Where it is not the rig's first camera."""
    arm: int | None
    """Place of its arm among the ties; None: fixed."""
    findings: tuple[Finding, ...] = ()

    @property
    def camera(self) -> CellCamera:
        return self.seen.camera

    @property
    def used(self) -> list[tuple[int, Shared]]:
        """The images that are used, with their numbers."""
        return [(k, one) for k, one in enumerate(self.seen.shared) if one is not None and self.rig[k] >= 0]


class _Rigs:
    """What moves as one: the capture's own camera at each used image, then what other cameras add."""

    def __init__(
        self, capture: Capture, hand_eye: HandEye, own: Float[ndarray, "m 4 4"], rows: Int[ndarray, " m"]
    ) -> None:
        self._capture, self._hand_eye, self._rows = capture, hand_eye, rows
        self.poses = list(own)
        self.arms: list[str] = []
        self._of_arms: list[tuple[Int[ndarray, " n"], Float[ndarray, "n 4 4"], HandEye]] = []

    def add(self, seen: _Seen) -> _Member | CameraFound:
        """The camera's images among the rigs; or why it cannot be placed."""
        if not len(seen.rows):
            most = int(np.argmax(seen.counts))
            best, count = seen.camera.images[most], float(seen.counts[most])
            return seen.refused(Kind.FEW_POINTS_SHARED, "images", (best,), count)
        if seen.camera.arm is not None:
            return self._on_other_arm(seen, seen.camera.arm)
        return self._on_same_gripper(seen) if seen.camera.mount == "gripper" else self._fixed(seen)

    def _fixed(self, seen: _Seen) -> _Member | CameraFound:
        places = seen.places
        names = [seen.camera.images[k] for k in seen.rows]
        apart = step_between(places[:, None], places[None])
        metres, radians = (np.linalg.norm(apart[..., part], axis=-1) for part in (slice(0, 3), slice(3, 6)))
        most_m, most_rad = SAME_PLACE
        if not seen.agrees_with_given:
            most_m, most_rad = SAME_PLACE_OF_UNKNOWN[0] * seen.distance, SAME_PLACE_OF_UNKNOWN[1]
        if metres.max() > most_m or radians.max() > most_rad:
            a, b = np.unravel_index((metres / most_m + radians / most_rad).argmax(), metres.shape)
            apart_m, apart_rad = float(metres[a, b]), float(radians[a, b])
            return seen.refused(Kind.NOT_FIXED, "mount", (names[a], names[b]), apart_m, rotation=apart_rad)
        middle = int(metres.sum(1).argmin())
        rig = np.full(len(seen.shared), -1)
        rig[seen.rows] = len(self.poses)
        self.poses.append(places[middle])
        return _Member(seen, rig, None, None, self._at_own_camera(places[middle]))

    def _at_own_camera(self, place: Float[ndarray, "4 4"]) -> tuple[Finding, ...]:
        """That a camera stands where the capture's own camera was at an image."""
        off = step_between(np.stack(self.poses[: len(self._rows)]), place)
        near = np.flatnonzero(
            (np.linalg.norm(off[:, :3], axis=1) < AT_A_FRAME[0])
            & (np.linalg.norm(off[:, 3:], axis=1) < AT_A_FRAME[1])
        )
        if not len(near):
            return ()
        return (
            Finding(
                kind=Kind.AT_ANOTHER_CAMERA,
                severity="warns",
                mend="mount",
                images=(self._capture.images[self._rows[near[0]]],),
                details={"camera": self._capture.camera_name},
            ),
        )

    def _on_same_gripper(self, seen: _Seen) -> _Member | CameraFound:
        assert seen.camera.frame is not None
        rig, unused = np.full(len(seen.shared), -1), dict[int, str]()
        for k in seen.rows.tolist():
            frame = int(seen.camera.frame[k])
            at = np.flatnonzero(self._rows == frame)
            if len(at):
                rig[k] = at[0]
            else:
                unused[k] = f"{self._capture.images[frame]}, taken with it, is not used"
        seen = seen.without(unused)
        taken = np.flatnonzero(rig >= 0)
        if not len(taken):
            return seen.refused(Kind.NO_COMMON_POSE, "images")
        wrist = np.stack(self.poses)[rig[taken]]
        if not _differ(wrist):
            names = tuple(seen.camera.images[k] for k in taken)
            return seen.refused(Kind.ONE_GRIPPER_POSE, "images", names)
        on_rig = inverse(wrist) @ seen.places[np.isin(seen.rows, taken)]
        between = np.asarray(motion_length(inverse(on_rig)[:, None] @ on_rig[None]))
        middle = int(np.median(between, axis=1).argmin())
        off = step_between(on_rig[middle], on_rig)
        astray = (np.linalg.norm(off[:, :3], axis=1) > SAME_PLACE[0]) | (
            np.linalg.norm(off[:, 3:], axis=1) > SAME_PLACE[1]
        )
        if astray.mean() > 0.4:
            most_m = float(np.linalg.norm(off[:, :3], axis=1).max())
            return seen.refused(Kind.NOT_RIGID, "mount", value=most_m, camera=self._capture.camera_name)
        rig[taken[astray]] = -1
        why = "its place on the gripper is not that of its other images"
        seen = seen.without(dict.fromkeys(taken[astray].tolist(), why))
        return _Member(seen, rig, on_rig[middle], 0)

    def _on_other_arm(self, seen: _Seen, arm: str) -> _Member | CameraFound:
        assert seen.camera.base_from_gripper is not None
        if arm in self.arms:
            return seen.refused(Kind.SECOND_ON_ARM, arm=arm)
        if len(seen.rows) < LEAST_POSES:
            return seen.refused(
                Kind.FEW_LOCALISED, "images", value=float(len(seen.rows)), needed=float(LEAST_POSES)
            )
        places, gripper = seen.places, seen.camera.base_from_gripper[seen.rows]
        std = max(float(np.sqrt(self._hand_eye.covariance[6, 6])), 1e-4)
        found = solve_hand_eye(gripper, places, scale=1.0, scale_std=std)
        if not found.converged:
            return seen.not_placed(*found.findings)
        rig = np.full(len(seen.shared), -1)
        used = np.flatnonzero(found.inliers)
        rig[seen.rows[used]] = len(self.poses) + np.arange(len(used))
        why = {int(seen.rows[k]): str(found.images.reasons[k]) for k in np.flatnonzero(~found.inliers)}
        self.poses += list(places[used])
        self.arms.append(arm)
        self._of_arms.append((rig[seen.rows[used]], gripper[used], found))
        return _Member(seen.without(why), rig, None, len(self.arms))

    def arm_poses(self, options: CalibrateOptions) -> list[ArmPoses]:
        """The arms, the capture's own first."""
        robot = robot_errors(self._capture, options).of(self._rows)
        hand_eye = self._hand_eye
        poses = self._capture.base_from_gripper[self._rows]
        bent = [one.kind for one in hand_eye.findings if one.kind in BENT]
        first = ArmPoses(
            rigs=np.arange(len(self._rows)),
            base_from_gripper=poses,
            bent=bends(bent, poses) if bent else None,
            systematic=robot.systematic,
            start=(hand_eye.gripper_from_camera, hand_eye.base_from_recon),
        )
        others = [
            ArmPoses(
                rigs=rigs,
                base_from_gripper=gripper,
                systematic=smooth_errors(gripper),
                start=(found.gripper_from_camera, found.base_from_recon),
            )
            for rigs, gripper, found in self._of_arms
        ]
        return [first, *others]


def _differ(places: Float[ndarray, "k 4 4"]) -> bool:
    """Whether two of them are farther apart than SAME_PLACE."""
    apart = step_between(places[:, None], places[None])
    metres, radians = (np.linalg.norm(apart[..., part], axis=-1) for part in (slice(0, 3), slice(3, 6)))
    return bool((metres > SAME_PLACE[0]).any() or (radians > SAME_PLACE[1]).any())


def _images_of(
    capture: Capture,
    reconstruction: Reconstruction,
    hand_eye: HandEye,
    known: Known,
    members: Sequence[_Member],
    rigs: _Rigs,
    options: CalibrateOptions,
) -> CellImages:
    """All images; those of the further cameras follow the own camera's, camera by camera, as they are used."""
    m = len(known.recon_from_camera)
    own = of_images(reconstruction.tracks, hand_eye.inliers)
    prior = None
    # Where bundle adjustment did not decide the calibration, the images' own geometry is not believed here either.
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
    capture: Capture,
    hand_eye: HandEye,
    members: Sequence[_Member],
    cameras: Sequence[Intrinsics],
    images: int,
) -> Freedom:
    """Intrinsics free about what was given or found of each camera; a mount only beside another camera on its rig.

    Those that the own camera's images contradict were found, not given.
    """
    contradicted = any(one.kind is Kind.INTRINSICS and one.shift is None for one in hand_eye.findings)
    own = prior_about(cameras[0], capture.intrinsics is not None and not contradicted, capture.intrinsics_std)
    priors = [
        own,
        *(
            prior_about(start, member.camera.intrinsics is not None, member.camera.intrinsics_std)
            for start, member in zip(cameras[1:], members, strict=True)
        ),
    ]
    return Freedom.of(
        cameras, priors, images, [False, *(member.rig_from_camera is not None for member in members)]
    )


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


def _place_of(member: _Member, c: int) -> Callable[[Placed], Float[ndarray, "4 4"]]:
    """Where the camera, the c-th of the images', is on its parent."""
    rig, arm = int(member.rig[member.rig >= 0][0]), member.arm

    def parent_from_camera(placed: Placed) -> Float[ndarray, "4 4"]:
        if arm is None:
            return placed.z[0] @ scale_translation(placed.scene.world_from_rig[rig], placed.scale)
        return placed.x[arm] @ scale_translation(placed.scene.rig_from_camera[c], placed.scale)

    return parent_from_camera


def _examined(
    images: CellImages,
    members: Sequence[_Member],
    places: Sequence[Callable[[Placed], Float[ndarray, "4 4"]]],
    hand_eye: HandEye,
) -> tuple[Adjusted, list[tuple[Finding, ...]]]:
    """All images adjusted, and what those of each camera show against it (calibration/checks/camera.py).

    Where they contradict intrinsics that were given, or leave doubt of them, the images are adjusted as if none had
    been: of one image the given ones would weigh more than what it shows, and the answer be wrong by many sigmas.
    """
    answer, found = images.adjusted(), list[tuple[Finding, ...]]()
    for c, (member, place) in enumerate(zip(members, places, strict=True), start=1):
        if not len(images.freedom.intrinsics[c].std):  # exact, as of a camera that is held against itself
            found.append(())
            continue
        is_given = member.camera.intrinsics is not None
        imaged = _imaged(images, answer, _found(member, c, answer, place, hand_eye), c, place, is_given)
        faults = camera_faults(imaged)
        contradiction = None
        if is_given and all(one.kind is Kind.INTRINSICS for one in faults):
            contradiction = contradicted_by(imaged, SURE_OF_INTRINSICS)
        if contradiction is not None:
            answer, contradicted = contradiction
            images = images.with_freed(prior_of(imaged.start, ESTIMATED), c)
            faults = with_contradiction(faults, (contradicted,))
        found.append(faults)
    return answer, found


def _imaged(
    images: CellImages,
    answer: Adjusted,
    found: CameraFound,
    c: int,
    place: Callable[[Placed], Float[ndarray, "4 4"]],
    is_given: bool,
) -> Imaged:
    """A further camera, the c-th, as its checks take it."""
    assert found.covariance is not None
    return Imaged(
        adjusted=answer,
        adjust=lambda prior, combinations: images.with_freed(prior, c, combinations).adjusted(),
        names=[image.image for image in found.images if image.used],
        start=images.freedom.start[c],
        is_given=is_given,
        prior=images.freedom.intrinsics[c],
        std=np.sqrt(np.diag(found.covariance)) * found.converged,
        answer=lambda adjusted: (place(adjusted.placed), adjusted.placed.scale),
        camera=c,
        place=place,
    )


def _found(
    member: _Member,
    c: int,
    answer: Adjusted,
    parent_from_camera: Callable[[Placed], Float[ndarray, "4 4"]],
    hand_eye: HandEye,
) -> CameraFound:
    """Where the camera, the c-th, is, and what its place says against it."""
    camera, evidence = member.camera, answer.given.evidence
    transform, covariance = answer.transform(parent_from_camera)
    covariance = covariance + _by_faults(answer, answer.derivative(parent_from_camera), hand_eye)
    of_all = median_reprojection_px(evidence.view, evidence.problem)
    medians = of_all[evidence.problem.observations.camera == c].tolist()
    px = dict(zip((k for k, _ in member.used), medians, strict=True))
    images = tuple(
        ImageFound(image, reason is None, count, px.get(k), reason)
        for k, (image, count, reason) in enumerate(
            zip(camera.images, member.seen.counts, member.seen.reasons, strict=True)
        )
    )
    found = CameraFound(
        name=camera.name,
        mount=camera.mount,
        arm=camera.arm,
        images=images,
        parent_from_camera=transform,
        covariance=covariance,
        scene_distance=member.seen.distance * answer.placed.scale,
        intrinsics=answer.placed.scene.cameras[c],
        intrinsics_std=np.sqrt(np.diag(answer.intrinsics_covariance(c))),
    )
    # An image that contradicts the place also makes it uncertain.
    doubt = _misses(found, member) or _uncertain(found, member)
    checked = (doubt, *member.findings, _crowded(member), far_from_gripper(found))
    return found.with_findings(*(finding for finding in checked if finding is not None))


def _with_faults(found: CameraFound, member: _Member, faults: tuple[Finding, ...]) -> CameraFound:
    """A camera with what its images show against it, and with the shifts of that in its covariance.

    Such a fault explains a rejection, and rejects where its shift makes the place too uncertain.
    """
    assert found.covariance is not None
    for fault in faults:
        found = replace(found, covariance=found.covariance + fault.covariance[:6, :6])
        if not found.converged or _uncertain(found, member) is not None:
            fault = replace(fault, severity="rejects")
        found = found.with_findings(fault)
    return found


def _by_faults(
    answer: Adjusted, derivative: Float[ndarray, "6 p"], hand_eye: HandEye
) -> Float[ndarray, "6 6"]:
    """What the calibration of the capture's own camera counts beside its images and robot, carried over.

    Wrong intrinsics, a slip: what widens gripper_from_camera and scale there moves along with all that varies with them.
    """
    size = np.sqrt(np.diag(hand_eye.covariance))
    more = (hand_eye.covariance - answer.covariance[:7, :7]) / np.outer(size, size)
    values, vectors = np.linalg.eigh(more)
    root = size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    follows = derivative @ np.linalg.solve(answer.covariance[:7, :7], answer.covariance[:7]).T
    return follows @ root @ root.T @ follows.T


def _misses(found: CameraFound, member: _Member) -> Finding | None:
    """That an image contradicts the place that fits all of the camera's together."""
    worst = max(found.images, key=lambda image: image.reprojection_px or 0.0)
    px = worst.reprojection_px or 0.0
    if px <= MEDIAN_PX * max(1.0, member.camera.image_size[0] / 1600):
        return None
    return Finding(
        kind=Kind.IMAGE_MISSES,
        severity="rejects",
        mend="mount",
        images=(worst.image,),
        value=px,
        details={"mount": found.mount},
    )


def _uncertain(found: CameraFound, member: _Member) -> Finding | None:
    """That the camera's place is known too little; of unknown intrinsics with how well the focal length is known."""
    assert found.covariance is not None and found.intrinsics is not None and found.intrinsics_std is not None
    metres, radians = np.sqrt(np.diag(found.covariance)).reshape(2, 3).max(1).tolist()
    if metres <= MAX_STD[0] and radians <= MAX_STD[1]:
        return None
    details, unknown = {"rotation": radians}, member.camera.intrinsics is None
    if unknown:
        details["focal_std"] = float(found.intrinsics_std[0] / found.intrinsics.fx)
    return Finding(
        kind=Kind.PLACE_UNCERTAIN,
        severity="rejects",
        mend="intrinsics" if unknown else "images",
        value=metres,
        details=details,
    )


def _crowded(member: _Member) -> Finding | None:
    """That the points span little of every image."""
    widest = max(spread(one) for one in member.seen.shared if one is not None)
    if widest >= LEAST_SPREAD:
        return None
    return Finding(kind=Kind.POINTS_CROWDED, severity="warns", mend="images", value=widest)


def far_from_gripper(found: CameraFound) -> Finding | None:
    """That a camera said to be on a gripper is far from it."""
    assert found.parent_from_camera is not None
    away = float(np.linalg.norm(found.parent_from_camera[:3, 3]))
    if found.mount == "base" or away <= FAR_FROM_GRIPPER:
        return None
    return Finding(kind=Kind.FAR_FROM_GRIPPER, severity="warns", mend="mount", value=away)
