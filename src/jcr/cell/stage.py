"""Further cameras of a cell, placed with the calibration of the capture's own: images first, then robots.

Every image of another camera is localised in the reconstruction (localise.py); all images are adjusted together
(bundle.py), and the arms' poses tie them to their bases (ties.py). The calibration of the capture's own camera stays as
it was found: what is said here of others rests on the same images.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.intrinsics_prior import prior_about
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.robot_errors import robot_errors
from jcr.calibration.stage import MIN_OBSERVATIONS, of_images
from jcr.camera import usable_lens
from jcr.capture.images import read_image
from jcr.cell.bundle import Freedom, Imaged, Pictures, Scene, adjust_images
from jcr.cell.found import ArmFound, CameraFound, CellFound, PictureFound
from jcr.cell.localise import (
    LEAST_SPREAD,
    Known,
    Shared,
    distance,
    guessed_lens,
    known_images,
    localised,
    spread,
)
from jcr.cell.ties import Answer, Placed, Tie, tied
from jcr.geometry import inverse, motion_length, scale_translation, step_between
from jcr.handeye.solve import MAX_STD, solve_hand_eye
from jcr.handeye.systematic import smooth_errors
from jcr.least_squares import one_blas_thread
from jcr.progress import Progress, silent, steps
from jcr.records import Capture, CellCamera, HandEye, Intrinsics, Reconstruction
from jcr.rounding import significant

SAME_PLACE = (0.02, np.radians(2.0))
"""m, rad: images of one fixed camera, or places of a camera on its gripper, differ by no more."""
SAME_PLACE_OF_UNKNOWN = (0.2, np.radians(6.0))
"""Of the distance of the scene, rad: the same where a focal length estimated from one image is in it."""
MEDIAN_PX = 3.0
"""Images of a camera that miss by more, of one 1600 px wide, do not fit one place."""
AT_A_FRAME = (0.01, np.radians(1.0))
"""m, rad: nearer than this to where the wrist camera was, a fixed camera is likely to be that camera."""
EXACT = 1e-6
"""m, rad: of poses that were given, beside what is known of their errors."""
NOTHING: dict[str, ndarray] = {
    "image": np.zeros(0, int),
    "x_px": np.zeros((0, 2)),
    "point": np.zeros(0, int),
    "points_in_recon": np.zeros((0, 3)),
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
    if not hand_eye.converged:
        why = f"the {capture.camera_name} camera's own calibration is rejected"
        return CellFound(tuple(_Seen.nothing_of(camera).refused(why) for camera in others), (), None)
    used = np.flatnonzero(hand_eye.inliers)
    rows = reconstruction.image_index[used]
    # In metres from the first: the equations that follow are better for it, and distances can be spoken of.
    own = scale_translation(reconstruction.recon_from_camera[used], hand_eye.scale)
    images = [read_image(capture.folder / capture.images[row]) for row in rows]
    known = known_images(images, reconstruction.intrinsics, own)
    found: dict[str, list[Shared | int]] = {camera.name: [] for camera in others}
    todo = [(camera, image) for camera in others for image in camera.images]
    for camera, image in steps(progress, "other cameras", todo):
        lens, _ = usable_lens(camera.intrinsics)
        picture = read_image((camera.folder or capture.folder) / image)
        start = lens or guessed_lens(camera.image_size)
        found[camera.name].append(localised(known, picture, start, lens is not None))
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
    imaged, medians = _adjusted(capture, reconstruction, hand_eye, known, placed, rigs)
    answer = tied(imaged, rigs.ties(options), 1.0, options.robot_noise_m_rad)
    of = {member.camera.name: _place_of(member, c) for c, member in enumerate(placed, start=1)}
    cameras = {
        member.camera.name: _found(member, c, answer, of[member.camera.name], medians, hand_eye)
        for c, member in enumerate(placed, start=1)
    }
    cameras |= {camera.name: camera for camera in failed}
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
    def lens(self) -> Intrinsics:
        """Given, or as the image with most points has it."""
        lens, _ = usable_lens(self.camera.intrinsics)
        best = max((one for one in self.shared if one is not None), key=lambda one: len(one.x_px))
        return lens or best.lens

    def without(self, reasons: Mapping[int, str]) -> "_Seen":
        """With why some images are not used."""
        return replace(self, reasons=tuple(reasons.get(k, before) for k, before in enumerate(self.reasons)))

    def refused(self, why: str) -> CameraFound:
        """The camera is not placed."""
        camera = self.camera
        pictures = [
            PictureFound(image, False, count, None, reason or "the camera was not placed")
            for image, count, reason in zip(camera.images, self.counts, self.reasons, strict=True)
        ]
        return CameraFound(camera.name, camera.mount, camera.arm, tuple(pictures), warnings=(why,))


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
    notes: tuple[str, ...] = ()

    @property
    def camera(self) -> CellCamera:
        return self.seen.camera


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
            return seen.refused(
                f"{seen.camera.images[most]} shares {seen.counts[most]} points with the mapped scene, too few: it must "
                "see the same scene, unchanged, from a direction not too different"
            )
        if seen.camera.arm is not None:
            return self._on_other_arm(seen, seen.camera.arm)
        return self._on_same_gripper(seen) if seen.camera.mount == "gripper" else self._fixed(seen)

    def _fixed(self, seen: _Seen) -> _Member | CameraFound:
        places = seen.places
        names = [seen.camera.images[k] for k in seen.rows]
        apart = step_between(places[:, None], places[None])
        metres, radians = (np.linalg.norm(apart[..., part], axis=-1) for part in (slice(0, 3), slice(3, 6)))
        most_m, most_rad = SAME_PLACE
        if seen.camera.intrinsics is None:
            most_m, most_rad = SAME_PLACE_OF_UNKNOWN[0] * seen.distance, SAME_PLACE_OF_UNKNOWN[1]
        if metres.max() > most_m or radians.max() > most_rad:
            a, b = np.unravel_index((metres / most_m + radians / most_rad).argmax(), metres.shape)
            return seen.refused(
                f"{names[a]} and {names[b]} were taken from places {1e3 * metres[a, b]:.0f} mm and "
                f"{np.degrees(radians[a, b]):.1f}° apart: it is not fixed; of a camera on the gripper write mount "
                "gripper, of several cameras give each its own name"
            )
        middle = int(metres.sum(1).argmin())
        rig = np.full(len(seen.shared), -1)
        rig[seen.rows] = len(self.poses)
        self.poses.append(places[middle])
        notes = []
        own = np.stack(self.poses[: len(self._rows)])
        off = step_between(own, places[middle])
        near = np.flatnonzero(
            (np.linalg.norm(off[:, :3], axis=1) < AT_A_FRAME[0])
            & (np.linalg.norm(off[:, 3:], axis=1) < AT_A_FRAME[1])
        )
        if len(near):
            at = self._capture.images[self._rows[near[0]]]
            notes.append(
                f"it stands where the {self._capture.camera_name} camera was at {at}: if its image is one of that "
                "camera, it is not fixed"
            )
        return _Member(seen, rig, None, None, tuple(notes))

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
            return seen.refused("none of its images was taken with an image that is used")
        on_rig = inverse(np.stack(self.poses)[rig[taken]]) @ seen.places[np.isin(seen.rows, taken)]
        between = np.asarray(motion_length(inverse(on_rig)[:, None] @ on_rig[None]))
        middle = int(np.median(between, axis=1).argmin())
        off = step_between(on_rig[middle], on_rig)
        astray = (np.linalg.norm(off[:, :3], axis=1) > SAME_PLACE[0]) | (
            np.linalg.norm(off[:, 3:], axis=1) > SAME_PLACE[1]
        )
        if astray.mean() > 0.4:
            return seen.refused(
                f"its place beside the {self._capture.camera_name} camera differs by up to "
                f"{1e3 * np.linalg.norm(off[:, :3], axis=1).max():.0f} mm between images: the two are not rigid, or "
                "the images are not of the frames that they stand for"
            )
        rig[taken[astray]] = -1
        why = "its place on the gripper is not that of its other images"
        seen = seen.without(dict.fromkeys(taken[astray].tolist(), why))
        return _Member(seen, rig, on_rig[middle], 0)

    def _on_other_arm(self, seen: _Seen, arm: str) -> _Member | CameraFound:
        assert seen.camera.base_from_gripper is not None
        if arm in self.arms:
            return seen.refused(f"a second camera on arm {arm}: one each is supported")
        if len(seen.rows) < LEAST_POSES:
            return seen.refused(
                f"{len(seen.rows)} of its images share enough of the mapped scene; {LEAST_POSES} are needed"
            )
        places, gripper = seen.places, seen.camera.base_from_gripper[seen.rows]
        std = max(float(np.sqrt(self._hand_eye.covariance[6, 6])), 1e-4)
        found = solve_hand_eye(gripper, places, scale=1.0, scale_std=std)
        if not found.converged:
            return seen.refused(found.warnings[0])
        rig = np.full(len(seen.shared), -1)
        used = np.flatnonzero(found.inliers)
        rig[seen.rows[used]] = len(self.poses) + np.arange(len(used))
        why = {int(seen.rows[k]): str(found.reasons[k]) for k in np.flatnonzero(~found.inliers)}
        self.poses += list(places[used])
        self.arms.append(arm)
        self._of_arms.append((rig[seen.rows[used]], gripper[used], found))
        return _Member(seen.without(why), rig, None, len(self.arms))

    def ties(self, options: CalibrateOptions) -> list[Tie]:
        """The arms, the capture's own first."""
        systematic, _, _ = robot_errors(self._capture, options)
        own = (6 * self._rows[:, None] + np.arange(6)).ravel()
        hand_eye = self._hand_eye
        first = Tie(
            np.arange(len(self._rows)),
            self._capture.base_from_gripper[self._rows],
            systematic[np.ix_(own, own)],
            (hand_eye.gripper_from_camera, hand_eye.base_from_recon),
        )
        others = [
            Tie(rigs, gripper, smooth_errors(gripper), (found.gripper_from_camera, found.base_from_recon))
            for rigs, gripper, found in self._of_arms
        ]
        return [first, *others]


def _adjusted(
    capture: Capture,
    reconstruction: Reconstruction,
    hand_eye: HandEye,
    known: Known,
    members: Sequence[_Member],
    rigs: _Rigs,
) -> tuple[Imaged, dict[tuple[str, int], float]]:
    """All images adjusted together, and the median reprojection error (px) of each camera's by their number."""
    m = len(known.recon_from_camera)
    own = of_images(reconstruction.tracks, hand_eye.inliers)
    held = None
    # Where bundle adjustment did not decide the calibration, the images' own geometry is not believed here either.
    if hand_eye.refinement is None or own.from_pointmaps or len(own.image) < MIN_OBSERVATIONS:
        held, own = _as_given(reconstruction, hand_eye), replace(own, **NOTHING)
    rig, camera, number = list(range(m)), [0] * m, dict[tuple[str, int], int]()
    picture, x_px, point = [own.image], [own.x_px], [own.point]
    points = [hand_eye.scale * own.points_in_recon.astype(float)]
    count = len(own.points_in_recon)
    for c, member in enumerate(members, start=1):
        for k, one in enumerate(member.seen.shared):
            if one is None or member.rig[k] < 0:
                continue
            number[member.camera.name, k] = len(rig)
            n = len(one.x_px)
            picture += [np.full(n, len(rig)), one.row]
            x_px += [one.x_px, one.row_x_px]
            point += [count + np.arange(n), count + one.row_point]
            points.append(one.points_in_recon)
            count += n
            rig.append(int(member.rig[k]))
            camera.append(c)
    mounts = [np.eye(4) if one.rig_from_camera is None else one.rig_from_camera for one in members]
    lenses = [member.seen.lens for member in members]
    priors = [
        prior_about(lens, member.camera.intrinsics is not None, member.camera.intrinsics_std)
        for lens, member in zip(lenses, members, strict=True)
    ]
    first = prior_about(reconstruction.intrinsics, capture.intrinsics is not None, capture.intrinsics_std)
    movable = np.array([False, *(member.rig_from_camera is not None for member in members)])
    imaged = adjust_images(
        Scene(
            np.stack(rigs.poses),
            np.stack([np.eye(4), *mounts]),
            (reconstruction.intrinsics, *lenses),
            np.concatenate(points),
        ),
        Pictures(
            np.array(rig),
            np.array(camera),
            np.concatenate(picture),
            np.concatenate(x_px),
            np.concatenate(point),
        ),
        Freedom((first, *priors), movable),
        held,
    )
    return imaged, {key: float(imaged.reprojection_px[row]) for key, row in number.items()}


def _as_given(reconstruction: Reconstruction, hand_eye: HandEye) -> Float[ndarray, "r r"]:
    """Information on the used images' poses, where other than features found in the images decided them."""
    rows = np.flatnonzero(hand_eye.inliers)
    spread_of = np.zeros((6 * len(rows), 6 * len(rows)))
    if (evidence := reconstruction.evidence) is not None:
        unit = np.tile(np.repeat([hand_eye.scale, 1.0], 3), len(rows))
        among = (6 * rows[:, None] + np.arange(6)).ravel()
        spread_of = unit[:, None] * evidence.covariance[np.ix_(among, among)] * unit
    return np.linalg.inv(spread_of + EXACT**2 * np.eye(len(spread_of)))


def _place_of(member: _Member, c: int) -> Callable[[Placed], Float[ndarray, "4 4"]]:
    """Where the camera, the c-th of the images', is on its parent."""
    rig, arm = int(member.rig[member.rig >= 0][0]), member.arm

    def parent_from_camera(placed: Placed) -> Float[ndarray, "4 4"]:
        if arm is None:
            return placed.z[0] @ scale_translation(placed.scene.world_from_rig[rig], placed.scale)
        return placed.x[arm] @ scale_translation(placed.scene.rig_from_camera[c], placed.scale)

    return parent_from_camera


def _found(
    member: _Member,
    c: int,
    answer: Answer,
    parent_from_camera: Callable[[Placed], Float[ndarray, "4 4"]],
    medians: dict[tuple[str, int], float],
    hand_eye: HandEye,
) -> CameraFound:
    camera = member.camera
    transform, covariance = answer.transform(parent_from_camera)
    covariance = covariance + _by_faults(answer, answer.derivative(parent_from_camera), hand_eye)
    freedom = answer.imaged.freedom
    lens, columns = freedom.lenses[c], freedom.lens_columns[c]
    first = 12 * len(answer.placed.x) + 1
    of_lens = answer.covariance[
        first + columns.start : first + columns.stop, first + columns.start : first + columns.stop
    ]
    lens_std = np.sqrt(np.diag(lens.directions @ of_lens @ lens.directions.T))
    pictures = tuple(
        PictureFound(image, reason is None, count, medians.get((camera.name, k)), reason)
        for k, (image, count, reason) in enumerate(
            zip(camera.images, member.seen.counts, member.seen.reasons, strict=True)
        )
    )
    found = CameraFound(
        camera.name,
        camera.mount,
        camera.arm,
        pictures,
        transform,
        covariance,
        member.seen.distance * answer.placed.scale,
        answer.placed.scene.cameras[c],
        lens_std,
    )
    doubt = _doubt(found, member)
    notes = list(member.notes)
    widest = max(spread(one) for one in member.seen.shared if one is not None)
    if widest < LEAST_SPREAD:
        notes.append(
            f"its points lie in {100 * widest:.0f} % of the image; more of the scene in view would help"
        )
    warnings = notes if doubt is None else [doubt, *notes]
    return replace(found, converged=doubt is None, warnings=tuple(warnings))


def _by_faults(answer: Answer, derivative: Float[ndarray, "6 p"], hand_eye: HandEye) -> Float[ndarray, "6 6"]:
    """What the calibration of the capture's own camera counts beside its images and robot, carried over.

    Wrong intrinsics, a slip: what widens gripper_from_camera and scale there moves along with all that varies with them.
    """
    size = np.sqrt(np.diag(hand_eye.covariance))
    more = (hand_eye.covariance - answer.covariance[:7, :7]) / np.outer(size, size)
    values, vectors = np.linalg.eigh(more)
    root = size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    follows = derivative @ np.linalg.solve(answer.covariance[:7, :7], answer.covariance[:7]).T
    return follows @ root @ root.T @ follows.T


def _doubt(found: CameraFound, member: _Member) -> str | None:
    """Why the camera's place is rejected, and the remedy."""
    missed = {picture.image: picture.reprojection_px or 0.0 for picture in found.pictures}
    worst = max(missed, key=lambda image: missed[image])
    if missed[worst] > MEDIAN_PX * max(1.0, member.camera.image_size[0] / 1600):
        moved = "it is not fixed" if found.mount == "base" else "it is not rigid on the gripper"
        return (
            f"{worst} misses the place that fits its images together by {missed[worst]:.0f} px (median): {moved}, the "
            "scene changed, or the intrinsics are wrong"
        )
    assert found.covariance is not None and found.intrinsics is not None and found.intrinsics_std is not None
    std = np.sqrt(np.diag(found.covariance))
    if std[:3].max() <= MAX_STD[0] and std[3:].max() <= MAX_STD[1]:
        return None
    known_to = (
        f"its place is known to ±{1e3 * std[:3].max():.0f} mm and {np.degrees(std[3:].max()):.1f}° only"
    )
    if member.camera.intrinsics is None:
        percent = 100 * found.intrinsics_std[0] / found.intrinsics.fx
        return (
            f"{known_to}, for its images do not show its intrinsics (focal length ± {significant(percent)} %): give "
            "them, or images with more of the scene, at other depths"
        )
    return f"{known_to}; let it see more of the mapped scene, or add images to the wrist camera's capture"
