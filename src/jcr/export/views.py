"""The images with their camera poses in the robot's metric frame: for splats, radiance fields and COLMAP."""

import json
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float
from numpy import ndarray
from PIL import Image

from jcr.camera import pinhole_inside, project, undistort_image, unproject
from jcr.capture.images import encode_png, read_image
from jcr.errors import InputError
from jcr.export.provenance import Provenance
from jcr.geometry import apply_similarity, inverse, scale_translation
from jcr.reconstruct.sfm import camera_of
from jcr.records import COEFFICIENTS, Capture, Intrinsics, PointCloud, Reconstruction, Tracks
from jcr.represent.cloud_ply import write_cloud

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_ORIENTATION = 0x0112
"""The EXIF tag of the rotation in which an image is shown."""


@dataclass(frozen=True, kw_only=True)
class PosedImages:
    """The registered images of a capture, their cameras in the base frame and what they saw in common."""

    folder: Path
    """Folder of the capture."""
    images: tuple[str, ...]
    """Paths relative to that folder."""
    base_from_camera: Float[ndarray, "m 4 4"]
    intrinsics: Intrinsics
    tracks: Tracks
    """Tracks of the reconstruction; `points_in_base` has their points in the base frame."""
    points_in_base: Float[ndarray, "p 3"]
    beside: tuple[int, ...] | None = None
    """Of a further camera on the same gripper: rows of the capture's own images that its images were taken with."""


def posed_images(
    capture: Capture, reconstruction: Reconstruction, base_from_recon: Float[ndarray, "4 4"], scale: float
) -> PosedImages:
    """The images of a run in the base frame, metres.

    The cameras are the reconstruction's, moved as one body: they agree with each other to a fraction of a pixel,
    which the gripper poses of most arms do not.
    """
    return PosedImages(
        folder=capture.folder,
        images=tuple(capture.images[row] for row in reconstruction.image_index),
        base_from_camera=base_from_recon @ scale_translation(reconstruction.recon_from_camera, scale),
        intrinsics=reconstruction.intrinsics,
        tracks=reconstruction.tracks,
        points_in_base=apply_similarity(base_from_recon, scale, reconstruction.tracks.points_in_recon),
    )


def write_nerfstudio(
    folder: Path,
    views: PosedImages,
    cloud: PointCloud,
    provenance: Provenance,
    undistorted: bool,
    link: bool,
    others: Sequence[PosedImages] = (),
) -> None:
    """Write transforms.json, images/ and points.ply (where a splat starts from) into a new folder.

    `others` are images of further cameras; every frame then has intrinsics of its own.

    Cameras are camera-to-world with OpenGL's axes (x right, y up, z backward). nerfstudio rotates, shifts and scales
    the scene unless asked not to: `--orientation-method none --center-method none --auto-scale-poses False`.
    """
    with _new_folder(folder) as made:
        (made / "images").mkdir()
        frames, models = [], []
        for k, one in enumerate((views, *others)):
            below = "images" if k == 0 else f"images/{k}"
            names, placed = _place_images(made / below, one, undistorted, link)
            model, intrinsics = _nerfstudio_camera(placed)
            models.append((model, intrinsics))
            frames += [
                {
                    "file_path": f"{below}/{name}",
                    "transform_matrix": (base_from_camera @ _OPENGL_FROM_OPENCV).tolist(),
                    **(intrinsics if others else {}),
                }
                for name, base_from_camera in zip(names, one.base_from_camera, strict=True)
            ]
        if len({model for model, _ in models}) > 1:
            raise InputError("nerfstudio has one kind of distortion for all cameras; export with --undistort")
        content = {
            "camera_model": models[0][0],
            **models[0][1],
            "ply_file_path": "points.ply",
            "frames": frames,
            "about": provenance.notes
            | {"axes": "camera x right, y up, z backward; world as the robot's base"},
        }
        (made / "transforms.json").write_text(json.dumps(content, indent=2) + "\n", "utf-8")
        write_cloud(made / "points.ply", cloud, provenance.notes)


def _nerfstudio_camera(intrinsics: Intrinsics) -> tuple[str, dict[str, float]]:
    """The kind of a camera, and its numbers."""
    if intrinsics.model == "rational":
        raise InputError("nerfstudio knows no rational distortion; export with --undistort")
    plain = intrinsics.model == "pinhole" and not any(intrinsics.distortion)
    return "PINHOLE" if plain else "OPENCV_FISHEYE" if intrinsics.model == "fisheye" else "OPENCV", {
        "fl_x": intrinsics.fx,
        "fl_y": intrinsics.fy,
        # The centre of the first pixel is (0, 0) here and (0.5, 0.5) there.
        "cx": intrinsics.cx + 0.5,
        "cy": intrinsics.cy + 0.5,
        "w": intrinsics.width,
        "h": intrinsics.height,
        **({} if plain else dict(zip(COEFFICIENTS[intrinsics.model], intrinsics.distortion, strict=True))),
    }


def write_colmap(
    folder: Path,
    views: PosedImages,
    provenance: Provenance,
    undistorted: bool,
    link: bool,
    others: Sequence[PosedImages] = (),
) -> None:
    """Write images/ and sparse/0, as binary and as text, with every track into a new folder.

    `others` are images of further cameras, which see no tracks.
    """
    with _new_folder(folder) as made:
        (made / "images").mkdir()
        names, intrinsics = _place_images(made / "images", views, undistorted, link)
        further = []
        for k, one in enumerate(others, start=1):
            theirs, of_other = _place_images(made / "images" / str(k), one, undistorted, link)
            further.append(_Further(one, of_other, [f"{k}/{name}" for name in theirs]))
        model = _colmap_model(views, names, intrinsics, further)
        model.extract_colors_for_all_images(str(made / "images"))
        sparse = made / "sparse" / "0"
        sparse.mkdir(parents=True)
        model.write_binary(str(sparse))
        model.write_text(str(sparse))
        about = "".join(f"{name}: {text}\n" for name, text in provenance.notes.items())
        (made / "README.txt").write_text(
            f"{about}COLMAP's world is that frame; cameras are world to camera.\n"
        )


@dataclass(frozen=True)
class _Further:
    """A further camera as it is exported."""

    views: PosedImages
    intrinsics: Intrinsics
    names: list[str]
    """Names in the folder of images."""


def _colmap_model(
    views: PosedImages, names: list[str], intrinsics: Intrinsics, others: Sequence[_Further] = ()
) -> pycolmap.Reconstruction:
    """The cameras on the gripper are one rig, and a frame of it is what they saw at one pose."""
    model = pycolmap.Reconstruction()
    rig = _add_cameras(model, views, intrinsics, others)
    x_px = views.tracks.x_px
    if intrinsics != views.intrinsics:
        x_px = project(intrinsics, unproject(views.intrinsics, x_px))
    inside = ((x_px >= -0.5) & (x_px < [intrinsics.width - 0.5, intrinsics.height - 0.5])).all(1)
    place = np.zeros(len(x_px), int)  # of each observation among those of its image
    images: dict[int, list[pycolmap.Image]] = {}
    for row, name in enumerate(names):
        mine = inside & (views.tracks.image == row)
        place[mine] = np.arange(mine.sum())
        image = pycolmap.Image(name=name, keypoints=x_px[mine] + 0.5, camera_id=1, image_id=row + 1)
        images[row] = [image]
    _add_other_images(model, images, others)
    _add_frames(model, rig, images, views)
    tracks = [pycolmap.Track() for _ in views.points_in_base]
    for k in np.flatnonzero(inside):
        tracks[views.tracks.point[k]].add_element(int(views.tracks.image[k]) + 1, int(place[k]))
    for xyz, track in zip(views.points_in_base, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(xyz, track)
    model.update_point_3d_errors()
    return model


def _add_cameras(
    model: pycolmap.Reconstruction, views: PosedImages, intrinsics: Intrinsics, others: Sequence[_Further]
) -> pycolmap.Rig:
    """Add camera 1 with those beside it on the gripper, which make the rig, and each other camera on its own."""
    rig = pycolmap.Rig(rig_id=1)
    own = camera_of(intrinsics, known=True)
    own.camera_id = 1
    model.add_camera(own)
    rig.add_ref_sensor(own.sensor_id)
    for number, other in enumerate(others, start=2):
        camera = camera_of(other.intrinsics, known=True)
        camera.camera_id = number
        if (beside := other.views.beside) is None:
            model.add_camera_with_trivial_rig(camera)
            continue
        model.add_camera(camera)
        camera_from_own = inverse(other.views.base_from_camera[0]) @ views.base_from_camera[beside[0]]
        rig.add_sensor(camera.sensor_id, _rigid(camera_from_own))
    model.add_rig(rig)
    return rig


def _add_other_images(
    model: pycolmap.Reconstruction, images: dict[int, list[pycolmap.Image]], others: Sequence[_Further]
) -> None:
    """Add the images of cameras on their own to the model, those of the rig to `images` of the row at the same pose."""
    count = len(images)
    for number, other in enumerate(others, start=2):
        for k, name in enumerate(other.names):
            count += 1
            image = pycolmap.Image(name=name, keypoints=np.zeros((0, 2)), camera_id=number, image_id=count)
            if other.views.beside is None:
                camera_from_base = inverse(other.views.base_from_camera[k])
                model.add_image_with_trivial_frame(image, _rigid(camera_from_base))
            else:
                images[other.views.beside[k]].append(image)


def _add_frames(
    model: pycolmap.Reconstruction,
    rig: pycolmap.Rig,
    images: dict[int, list[pycolmap.Image]],
    views: PosedImages,
) -> None:
    """Add a frame of the rig for the images of each row."""
    first = max([0, *model.frames.keys()]) + 1
    for row, together in images.items():
        frame = pycolmap.Frame(frame_id=first + row, rig_id=rig.rig_id)
        for image in together:
            frame.add_data_id(image.data_id)
            image.frame_id = frame.frame_id
        frame.rig_from_world = _rigid(inverse(views.base_from_camera[row]))
        model.add_frame(frame)
        for image in together:
            model.add_image(image)
        model.register_frame(frame.frame_id)


def _rigid(a_from_b: Float[ndarray, "4 4"]) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(a_from_b[:3])


def _place_images(
    folder: Path, views: PosedImages, undistorted: bool, link: bool
) -> tuple[list[str], Intrinsics]:
    """Copy, link or undistort the images into a folder; their names there, and the intrinsics that then hold."""
    folder.mkdir(exist_ok=True)
    names = [Path(image).name for image in views.images]
    if len(set(names)) < len(names):
        names = [image.replace("/", "_") for image in views.images]
    if undistorted:
        names = [f"{Path(name).stem}.png" for name in names]
        pinhole = pinhole_inside(views.intrinsics, max(views.intrinsics.width, views.intrinsics.height))
        for image, name in zip(views.images, names, strict=True):
            pixels = undistort_image(read_image(views.folder / image), views.intrinsics, pinhole)
            (folder / name).write_bytes(encode_png(pixels))
        return names, pinhole
    for k, (image, name) in enumerate(zip(views.images, names, strict=True)):
        source = (views.folder / image).resolve()
        with Image.open(source) as opened:
            is_rotated = opened.getexif().get(_ORIENTATION, 1) != 1
        if is_rotated:  # which not every reader heeds
            names[k] = f"{Path(name).stem}.png"
            (folder / names[k]).write_bytes(encode_png(read_image(source)))
        elif link:
            (folder / name).symlink_to(source)
        else:
            shutil.copyfile(source, folder / name)
    return names, views.intrinsics


@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """A folder that appears whole or not at all; InputError where something is in the way."""
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise InputError(f"{folder}: is there already; name a new folder, or remove it first")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as temporary:
        made = Path(temporary) / "made"
        made.mkdir()
        yield made
        made.replace(folder)
