"""Export of images with their camera poses in the base frame, for Gaussian splats, radiance fields and COLMAP."""

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

from jcr.camera import is_distorted, pinhole_inside, project, undistortion, unproject
from jcr.capture.images import encode_png, read_image
from jcr.errors import InputError
from jcr.export.options import ExportOptions
from jcr.files import writable
from jcr.geometry import Similarity, apply, inverse
from jcr.records import COEFFICIENTS, Intrinsics, PointCloud, Pointmaps, Tracks
from jcr.scene.cloud import write_cloud
from jcr.sfm.model import colmap_camera

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class PosedImages:
    """Registered images of a capture, with the camera poses and tracked points in the base frame."""

    folder: Path
    images: tuple[str, ...]
    base_from_camera: Float[ndarray, "m 4 4"]
    base_from_gripper: Float[ndarray, "m 4 4"]
    """Gripper poses as reported by the robot, one per image."""
    intrinsics: Intrinsics
    tracks: Tracks
    points_in_base: Float[ndarray, "p 3"]
    base_from_recon: Similarity


def write_nerfstudio(
    folder: Path, views: PosedImages, cloud: PointCloud, notes: dict[str, str], options: ExportOptions
) -> None:
    """Write transforms.json, images/ and points.ply (`cloud`, initial points of a splat) into a new folder.

    The matrices are base_from_camera (m) with OpenGL's camera axes (x right, y up, z backward). nerfstudio rotates,
    shifts and scales the scene unless called with `--orientation-method none --center-method none --auto-scale-poses
    False`. `notes` are stored in the files. Raises InputError if nerfstudio does not support the distortion model.
    """
    with _new_folder(folder) as made:
        names, intrinsics = _place_images(made / "images", views, options)
        if intrinsics.model in ("rational", "thin_prism"):
            raise InputError(f"nerfstudio has no {intrinsics.model} distortion; export with --undistort")
        distortion = dict(zip(COEFFICIENTS[intrinsics.model], intrinsics.distortion, strict=True))
        camera_model = "OPENCV_FISHEYE" if intrinsics.model == "fisheye" else "OPENCV"
        if not is_distorted(intrinsics):
            camera_model, distortion = "PINHOLE", {}
        content = {
            "camera_model": camera_model,
            "fl_x": intrinsics.fx,
            "fl_y": intrinsics.fy,
            # The centre of the first pixel is (0, 0) here and (0.5, 0.5) in nerfstudio.
            "cx": intrinsics.cx + 0.5,
            "cy": intrinsics.cy + 0.5,
            "w": intrinsics.width,
            "h": intrinsics.height,
            **distortion,
            "ply_file_path": "points.ply",
            "frames": [
                {"file_path": f"images/{name}", "transform_matrix": (pose @ _OPENGL_FROM_OPENCV).tolist()}
                for name, pose in zip(names, views.base_from_camera, strict=True)
            ],
            "about": notes | {"axes": "camera x right, y up, z backward; world as the robot's base"},
        }
        (made / "transforms.json").write_text(json.dumps(content, indent=2) + "\n", "utf-8")
        write_cloud(made / "points.ply", cloud, notes)


def write_colmap(folder: Path, views: PosedImages, notes: dict[str, str], options: ExportOptions) -> None:
    """Write the images and a COLMAP model with their tracks (sparse/0, binary and text) into a new folder.

    The model's world is the base frame, in metres. Observations outside of the written images, and points with fewer
    than two remaining observations, are left out. `notes` are stored in README.txt. Raises InputError if COLMAP lacks
    the distortion model.
    """
    with _new_folder(folder) as made:
        names, intrinsics = _place_images(made / "images", views, options)
        if intrinsics.model == "thin_prism":
            raise InputError("COLMAP has no thin_prism distortion model; export with --undistort")
        model = pycolmap.Reconstruction()
        camera = colmap_camera(intrinsics, known=True)
        camera.camera_id = 1
        model.add_camera_with_trivial_rig(camera)
        x_px = views.tracks.x_px
        if intrinsics != views.intrinsics:
            x_px = project(intrinsics, unproject(views.intrinsics, x_px))
        inside = ((x_px >= -0.5) & (x_px < [intrinsics.width - 0.5, intrinsics.height - 0.5])).all(1)
        place = np.zeros(len(x_px), int)  # index of each observation within its image
        for row, name in enumerate(names):
            mine = inside & (views.tracks.image == row)
            place[mine] = np.arange(mine.sum())
            image = pycolmap.Image(name=name, keypoints=x_px[mine] + 0.5, camera_id=1, image_id=row + 1)
            camera_from_base = pycolmap.Rigid3d(inverse(views.base_from_camera[row])[:3])
            model.add_image_with_trivial_frame(image, camera_from_base)
        tracks = [pycolmap.Track() for _ in views.points_in_base]
        for k in np.flatnonzero(inside):
            tracks[views.tracks.point[k]].add_element(int(views.tracks.image[k]) + 1, int(place[k]))
        for xyz, track in zip(views.points_in_base, tracks, strict=True):
            if track.length() >= 2:
                model.add_point3D(xyz, track)
        model.update_point_3d_errors()
        model.extract_colors_for_all_images(str(made / "images"))
        sparse = made / "sparse" / "0"
        sparse.mkdir(parents=True)
        model.write_binary(str(sparse))
        model.write_text(str(sparse))
        about = "".join(f"{name}: {text}\n" for name, text in notes.items())
        (made / "README.txt").write_text(
            f"{about}The world is that frame; cameras are world to camera. "
            "Pixel coordinates are 0 at the image's corner, as COLMAP has them, half a pixel more than those of jcr.\n"
        )


def write_depth(
    folder: Path, pointmaps: Pointmaps, views: PosedImages, notes: dict[str, str], options: ExportOptions
) -> None:
    """Write depth and colour images without distortion, and cameras.json with K and base_from_camera, into a new folder.

    Depth is z along the optical axis: 16-bit PNG in mm, or .npy in m (float32) with `options.float_depth`; 0 where there
    is none. Pixel (0, 0) is the centre of the first pixel. `notes` are stored in cameras.json.
    """
    camera, frames = pointmaps.intrinsics, []
    with _new_folder(folder) as made:
        names = _file_names(views.images, ".png")
        for kind in ("color", "depth"):
            (made / kind).mkdir()
        for k, name in enumerate(names):
            in_base = views.base_from_recon(pointmaps.points_in_recon[k].reshape(-1, 3))
            z = apply(inverse(views.base_from_camera[k]), in_base)[:, 2].reshape(camera.height, camera.width)
            z = np.where((pointmaps.confidence[k] > 0) & (z > 0), z, 0.0)
            file = f"depth/{name}" if not options.float_depth else f"depth/{Path(name).stem}.npy"
            if options.float_depth:
                np.save(made / file, z.astype(np.float32))
            else:
                (made / file).write_bytes(encode_png((1e3 * z).round().clip(0, 65535).astype(np.uint16)))
            (made / f"color/{name}").write_bytes(encode_png(pointmaps.colors[k]))
            frames.append(
                {
                    "depth": file,
                    "color": f"color/{name}",
                    "image": views.images[k],
                    "base_from_camera": views.base_from_camera[k].tolist(),
                }
            )
        content = {
            "width": camera.width,
            "height": camera.height,
            "K": camera.matrix.tolist(),
            "depth_scale": 1.0 if options.float_depth else 1000.0,
            "frames": frames,
            "about": notes
            | {"axes": "camera x right, y down, z forward; depth z = value / depth_scale, metres"},
        }
        (made / "cameras.json").write_text(json.dumps(content, indent=2) + "\n", "utf-8")


def _place_images(folder: Path, views: PosedImages, options: ExportOptions) -> tuple[list[str], Intrinsics]:
    """Copy, link or undistort the images into a new folder; return their file names in it and their intrinsics.

    `options.undistort` and `options.link_images` choose.
    """
    folder.mkdir()
    names = _file_names(views.images, ".png" if options.undistort else None)
    if options.undistort:
        pinhole = pinhole_inside(views.intrinsics, max(views.intrinsics.width, views.intrinsics.height))
        undistort = undistortion(views.intrinsics, pinhole)
        for image, name in zip(views.images, names, strict=True):
            (folder / name).write_bytes(encode_png(undistort(read_image(views.folder / image))))
        return names, pinhole
    for image, name in zip(views.images, names, strict=True):
        source = (views.folder / image).resolve()
        if options.link_images:
            (folder / name).symlink_to(source)
        else:
            shutil.copyfile(source, folder / name)
    return names, views.intrinsics


def _file_names(images: Sequence[str], suffix: str | None) -> list[str]:
    """Return a file name for each image, different ones even without regard to case; `suffix` replaces the images' own.

    It is the image's own file name, or if two would be equal, its path in the capture with _ for /, or a number.
    """

    def ending(name: str) -> str:
        return name if suffix is None else f"{Path(name).stem}{suffix}"

    own = [ending(Path(image).name) for image in images]
    paths = [ending(image.replace("/", "_")) for image in images]
    numbered = [f"{k:04d}{suffix or Path(image).suffix}" for k, image in enumerate(images)]
    return next(
        names for names in (own, paths, numbered) if len({name.casefold() for name in names}) == len(names)
    )


@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder that is renamed to `folder` at the end; raise InputError if `folder` is not empty."""
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise InputError(f"{folder}: is there already; name a new folder, or remove it first")
    with writable(folder):
        begun = tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent)
    with begun as temporary:
        made = Path(temporary) / "made"
        made.mkdir()
        yield made
        made.replace(folder)
