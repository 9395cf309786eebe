"""Conversion between COLMAP's databases and models and this project's conventions.

COLMAP has the centre of the top-left pixel at (0.5, 0.5). This module alone converts this half pixel, the working size
and COLMAP's camera models. The image of row k has the COLMAP id k + 1.
"""

import signal
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import HALF_PIXEL, resized
from jcr.features.matchers import Geometries
from jcr.features.sift import WORKING_SIZE_PX
from jcr.geometry import inverse, transform
from jcr.records import Intrinsics, Reconstruction, Tracks

COST_TOLERANCE = 1e-6
"""Relative change of cost that ends an adjustment; COLMAP's 0 takes three times as long and changes 1e-5."""


def colmap_camera(intrinsics: Intrinsics, known: bool) -> pycolmap.Camera:
    """Return COLMAP's camera with these intrinsics, for images of their size.

    If the intrinsics are not `known`, the camera's model is RADIAL with their focal length and no distortion; COLMAP
    then refines the focal length and two coefficients.
    """
    centre = [intrinsics.cx + HALF_PIXEL, intrinsics.cy + HALF_PIXEL]
    both = [intrinsics.fx, intrinsics.fy, *centre]
    if not known:
        name, params = "RADIAL", [intrinsics.fx, *centre, 0.0, 0.0]
    elif intrinsics.model == "fisheye":
        name, params = "OPENCV_FISHEYE", [*both, *intrinsics.distortion]
    elif any(intrinsics.distortion):
        name, params = "FULL_OPENCV", [*both, *[*intrinsics.distortion, 0.0, 0.0, 0.0][:8]]
    else:
        name, params = "PINHOLE", both
    size = {"width": intrinsics.width, "height": intrinsics.height}
    camera = pycolmap.Camera(model=name, params=params, camera_id=1, **size)
    camera.has_prior_focal_length = known
    return camera


def working_cameras(
    all_intrinsics: Sequence[Intrinsics], known: bool, working_size_px: int = WORKING_SIZE_PX
) -> list[pycolmap.Camera]:
    """Return COLMAP's camera of each of the intrinsics, for images reduced to a long side of at most `working_size_px`.

    If the intrinsics are not `known`, COLMAP refines focal length and distortion.
    """
    width, height = all_intrinsics[0].width, all_intrinsics[0].height
    scale = min(1.0, working_size_px / max(width, height))
    size = round(width * scale), round(height * scale)
    return [colmap_camera(resized(intrinsics, *size), known) for intrinsics in all_intrinsics]


def intrinsics_of(camera: pycolmap.Camera, like: Intrinsics, known: bool) -> Intrinsics:
    """Return the intrinsics of COLMAP's `camera`, scaled to images of the size of `like`; `like` itself if `known`."""
    if known:
        return like
    focal, cx, cy, k1, k2 = (float(p) for p in camera.params)
    centre, distortion = (cx - HALF_PIXEL, cy - HALF_PIXEL), (k1, k2, 0.0, 0.0, 0.0)
    intrinsics = Intrinsics(focal, focal, *centre, camera.width, camera.height, distortion)
    return resized(intrinsics, like.width, like.height)


def write_database(
    folder: Path, camera: pycolmap.Camera, x_px: Sequence[Float[ndarray, "_ 2"]], geometries: Geometries
) -> Path:
    """Write `database.db` for COLMAP to `folder`: images of one camera, keypoints and verified matches; return its path.

    `x_px` has the keypoints (x, y) of each image, in pixels of the images of `camera`.
    """
    with closing(pycolmap.Database.open(folder / "database.db")) as db:
        db.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        db.write_rig(rig, use_rig_id=True)
        for row, x in enumerate(x_px):
            image = pycolmap.Image(name=f"{row:05d}", camera_id=1, image_id=row + 1)
            db.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=row + 1, rig_id=1)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)
            db.write_keypoints(row + 1, (x + HALF_PIXEL).astype(np.float32))
        for (i, j), geometry in geometries.items():
            db.write_two_view_geometry(i + 1, j + 1, geometry)
    return folder / "database.db"


def rows_of(model: pycolmap.Reconstruction) -> list[int]:
    """Return the rows of the images that a model has registered (COLMAP's ids minus 1), ascending."""
    return sorted(image_id - 1 for image_id in model.reg_image_ids())


def poses_of(model: pycolmap.Reconstruction, rows: Sequence[int]) -> Float[ndarray, "m 4 4"]:
    """Return recon_from_camera of the images `rows` of the model, in the model's frame and unit."""
    mapped = [model.image(row + 1).cam_from_world() for row in rows]
    if not mapped:
        return np.zeros((0, 4, 4))
    return inverse(np.stack([transform(m.rotation.matrix(), m.translation) for m in mapped]))


def reconstruction_of(
    model: pycolmap.Reconstruction,
    rows: Sequence[int],
    intrinsics: Intrinsics,
    image_index: Sequence[int] | None = None,
) -> Reconstruction:
    """Return the cameras and tracks of the model's images `rows` as a reconstruction with these intrinsics.

    COLMAP's id of an image is its row + 1. All must be registered. `image_index` are the images' rows of the capture,
    ascending; None: `rows`.
    """
    return Reconstruction(
        image_index=np.array(rows if image_index is None else image_index),
        recon_from_camera=poses_of(model, rows),
        intrinsics=intrinsics,
        tracks=tracks_of(model, [row + 1 for row in rows], (intrinsics.width, intrinsics.height)),
        backend="colmap",
    )


def tracks_of(model: pycolmap.Reconstruction, image_ids: Sequence[int], size: tuple[int, int]) -> Tracks:
    """Return the tracks of a model in the images with COLMAP's ids `image_ids`, in pixels of images of `size`.

    The size is (width, height); rows of images are counted in the order of the ids.
    """
    camera = model.camera(model.image(image_ids[0]).camera_id)
    original_from_working = np.array([size[0] / camera.width, size[1] / camera.height])
    seen = observations(model, image_ids)
    image, _, point = zip(*seen, strict=True) if seen else ((), (), ())
    x_px = [model.image(image_ids[row]).point2D(index).xy for row, index, _ in seen]
    points = [model.point3D(point_id).xyz for point_id in sorted(model.point3D_ids())]
    return Tracks(
        image=np.array(image, dtype=int),
        x_px=np.reshape(x_px, (-1, 2)) * original_from_working - HALF_PIXEL,
        point=np.array(point, dtype=int),
        points_in_recon=np.reshape(points, (-1, 3)),
    )


def observations(model: pycolmap.Reconstruction, image_ids: Sequence[int]) -> list[tuple[int, int, int]]:
    """Return all observations of a model as (image, keypoint, point), point by point.

    The image is an index into `image_ids`, and the keypoint is a row of the image's keypoints. The point is its rank
    among the ascending point ids.
    """
    row_of = {image_id: row for row, image_id in enumerate(image_ids)}
    return [
        (row_of[element.image_id], element.point2D_idx, point)
        for point, point_id in enumerate(sorted(model.point3D_ids()))
        for element in model.point3D(point_id).track.elements
        if element.image_id in row_of
    ]


def triangulated_model(
    database: Path,
    camera: pycolmap.Camera,
    recon_from_camera: Mapping[int, Float[ndarray, "4 4"]],
    largest_px: float = 4.0,
    refinements: int = 5,
) -> pycolmap.Reconstruction:
    """Return a model with fixed poses, and points triangulated from all matches of the database.

    `recon_from_camera` has the poses by image row; other images are left out. Points with a reprojection error above
    `largest_px` are removed, in at most `refinements` rounds. The same input gives the same bits.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.ba_global_max_refinements = refinements
    options.random_seed = options.triangulation.random_seed = 0
    options.mapper.filter_max_reproj_error = largest_px
    options.triangulation.merge_max_reproj_error = largest_px
    options.triangulation.complete_max_reproj_error = largest_px
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    with closing(pycolmap.Database.open(database)) as db:
        for row, pose in sorted(recon_from_camera.items()):
            image = db.read_image(row + 1)
            keypoints = [pycolmap.Point2D(xy) for xy in db.read_keypoints(row + 1)[:, :2]]
            image.points2D = pycolmap.Point2DList(keypoints)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(inverse(pose)[:3]))
    with tempfile.TemporaryDirectory(prefix="jcr-points-") as folder:
        return pycolmap.triangulate_points(
            model, database, folder, Path(folder), refine_intrinsics=False, options=options
        )


def adjust_robustly(
    model: pycolmap.Reconstruction,
    fix_intrinsics: bool,
    enough: float = COST_TOLERANCE,
    scale_px: float = 0.5,
) -> None:
    """Adjust all cameras and points of a model, which is changed, under a Cauchy loss of scale `scale_px`.

    The intrinsics are adjusted, too, unless `fix_intrinsics`. `enough` is the relative change of the cost that ends the
    adjustment. In COLMAP's plain least squares mismatches distort the result; the loss halves the error of the camera
    centres (0.20 to 0.11 mm rms over 12 simulated views).
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = not fix_intrinsics
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = scale_px
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.function_tolerance = enough
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # pycolmap.bundle_adjustment() does the same, but enables the log again.
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Suppress COLMAP's log on stderr, except fatal errors, within the context; restore Python's handler of SIGTERM.

    The import of pycolmap installs glog's handler of SIGTERM, which prints a page of C++ frames and of which Python has
    no record. Setting Python's handler again removes it.
    """
    on_termination = signal.getsignal(signal.SIGTERM)
    # Python can set signal handlers only in its main thread, and not those of a host program in C (None).
    if on_termination is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, on_termination)
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
