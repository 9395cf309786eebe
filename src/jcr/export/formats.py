"""Table of export formats for calibration and map of a run."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.calibration.record import UNCERTAINTY
from jcr.calibration.summary import intrinsics_in_words
from jcr.cell.cameras_json import FILE as CAMERAS
from jcr.errors import InputError, RejectedError, did_you_mean
from jcr.export import ros
from jcr.export.options import ExportName, ExportOptions, provenance
from jcr.extras import extra
from jcr.files import as_path, written_whole
from jcr.findings.finding import joined, sentence
from jcr.geometry import scale_translation, transform
from jcr.number_format import significant
from jcr.options import checked_options
from jcr.result import CALIBRATION, CLOUD, DEPTH, LOG, RECONSTRUCTION, REPORT, STATE, RunResult
from jcr.scene.cloud import read_cloud
from jcr.scene.map_file import MAP_FILE, load_map

if TYPE_CHECKING:
    from jcr.cell.cameras_json import CameraPlacement
    from jcr.export.nerfstudio_colmap import PosedImages
    from jcr.records import Intrinsics, PointCloud, Pointmaps
    from jcr.scene.scene_map import SceneMap


@dataclass(frozen=True)
class ExportFormat:
    """One export format of `jcr export`: its name, default file, and the function that writes it."""

    name: str
    file: str
    """Default file name in OUT/export; ends with / if the format is a folder."""
    about: str
    writer: str
    """Module and function in jcr.export that write the format, as MODULE.FUNCTION. The module is imported on use,
    because torch and pycolmap take seconds. Functions of TEXTS return a text; the others take the path to write as
    first argument."""
    contents: str
    """Attributes of `ExportedRun` that are passed to the writer, separated by spaces."""
    options: str
    """Options that concern the format, separated by spaces; all formats take `force` and `overwrite`."""


OWN_FILES = (STATE, CALIBRATION, UNCERTAINTY, RECONSTRUCTION, DEPTH, CLOUD, MAP_FILE, CAMERAS, REPORT, LOG)
"""Files of a run folder, which no export replaces."""
TEXTS = ("ros", "simulators")
"""Modules whose writers return a text."""
CAMERA = "parent_frame child_frame base_frame camera intrinsics"
"""Options of the formats that contain the transform of one camera to its parent frame."""
FRAMES = f"{CAMERA} to_root root_from_optical"
"""Options of the formats that contain frames."""
# fmt: off
FORMATS = (
    ExportFormat("ros2", "hand_eye.launch.xml", "static_transform_publisher line and launch file",
                 "ros.ros2_launch", "mount others", FRAMES),
    ExportFormat("moveit", "hand_eye.launch.py", "launch file as MoveIt Calibration saves it",
                 "ros.moveit_launch", "mount", FRAMES),
    ExportFormat("urdf", "hand_eye.urdf", "camera link and fixed joint", "ros.urdf", "mount others options",
                 f"{FRAMES} into"),
    ExportFormat("easy_handeye2", "hand_eye.calib", ".calib for its publisher",
                 "ros.easy_handeye2", "mount_with_gripper path.stem", FRAMES),
    ExportFormat("camera_info", "camera_info.yaml", "intrinsics for camera_info_manager",
                 "ros.camera_info", "camera_frame", CAMERA),
    ExportFormat("ply", "cloud.ply", "points, colours, labels",
                 "nerfstudio_colmap.write_cloud", "cloud notes", "base_frame"),
    ExportFormat("glb", "map.glb", "mesh of the seen surface with colours",
                 "planner_maps.write_glb", "scene map_notes", "base_frame"),
    ExportFormat("octomap", "map.bt", "occupied, free and unknown voxels",
                 "planner_maps.write_octomap", "scene map_notes options", "base_frame voxel_size"),
    ExportFormat("esdf", "esdf.npz", "voxels of signed distance",
                 "planner_maps.write_esdf", "scene map_notes options", "base_frame voxel_size unknown"),
    ExportFormat("spheres", "spheres.npz", "spheres that cover what is solid",
                 "planner_maps.write_spheres", "scene map_notes options", "base_frame unknown excess"),
    ExportFormat("nerfstudio", "nerfstudio/", "transforms.json, images and first points for a splat or NeRF",
                 "nerfstudio_colmap.write_nerfstudio", "views cloud notes options", "base_frame undistort link_images"),
    ExportFormat("colmap", "colmap/", "COLMAP model in the base frame, binary and text",
                 "nerfstudio_colmap.write_colmap", "views notes options", "base_frame undistort link_images"),
    ExportFormat("depth", "depth/", "depth and colour images with their cameras, for TSDF mappers",
                 "nerfstudio_colmap.write_depth", "pointmaps views notes options", "base_frame float_depth"),
    ExportFormat("lerobot", "cameras.parquet", "cameras of a LeRobot data set, by episode",
                 "lerobot.write_lerobot", "episodes notes", "base_frame"),
    ExportFormat("mjcf", "hand_eye.xml", "camera for MuJoCo", "simulators.mjcf", "mount", CAMERA),
    ExportFormat("usd", "hand_eye.usda", "camera for Isaac Sim and others that read USD", "simulators.usd", "mount",
                 CAMERA),
    ExportFormat("rerun", "run.rrd", "recording for the Rerun viewer",
                 "planner_maps.write_rrd", "views cloud scene map_notes", "base_frame"),
)
# fmt: on


def export_run(
    out: str | Path,
    format: ExportName,
    path: str | Path | None = None,
    options: ExportOptions | Mapping[str, Any] | None = None,
) -> Path:
    """Export the run folder `out` in a format of `jcr export` and return the path of the new file or folder.

    `path` None: the format's default file in `out`/export. `options` are those of the command line. Raises InputError
    for a run, format, option or path that cannot be used, and RejectedError if the calibration is rejected; with
    `force` it is exported, and the file contains the reason.
    """
    file = None if path is None else as_path(path, "path")
    return write_run(as_path(out, "out"), format, file, checked_options(options, ExportOptions))[2]


def write_run(
    out: Path, format: ExportName, path: Path | None, options: ExportOptions
) -> "tuple[ExportedRun, ExportFormat, Path]":
    """Write a run in an export format; return the exported run, the description of the format and the written path.

    Raises InputError for an unknown format, for options that do not fit, for a run that lacks the data of the format,
    and for a path with other content unless `options.overwrite` is set. Raises RejectedError if the calibration is
    rejected, unless `options.force` is set.
    """
    row = next((row for row in FORMATS if row.name == format), None)
    if row is None:
        names = get_args(ExportName)
        raise InputError(f"{format}: no such format{did_you_mean(format, names)}; choose {', '.join(names)}")
    if options.root_from_optical and not options.to_root:
        raise InputError("--root-from-optical: needs --to-root LINK, the link it is given in")
    used = ("force", "overwrite", *row.options.split())
    for one in fields(options):
        if getattr(options, one.name) != one.default and one.name not in used:
            takers = joined([other.name for other in FORMATS if one.name in other.options.split()])
            flag = f"--{one.name.replace('_', '-')}"
            raise InputError(f"{flag}: the format {format} does not use it, only {takers}; leave it out")
    # Files of several cameras stand side by side.
    own_name = row.file if options.camera is None else f"{options.camera}_{row.file}"
    path = path or out / "export" / (own_name if options.into is None else options.into.name)
    runs = [out]
    if format == "lerobot" and out.is_dir() and not (out / CALIBRATION).is_file():  # the folder of a batch
        runs = sorted(file.parent for file in out.glob(f"*/{CALIBRATION}")) or runs
        runs = [one for one in runs if options.force or RunResult(one).calibration.doubt is None] or runs[:1]
    run = ExportedRun(*runs, options=options, path=path)
    if run.doubt is not None and not options.force:
        raise RejectedError(
            f"{out}: its calibration is rejected, and nothing was exported: {run.doubt}; to export it nevertheless, "
            "with this reason in the file, add --force"
        )
    _require_path(out, row, path)
    if row.name == "rerun":  # The map takes seconds to load.
        extra("rerun", "rerun", "a .rrd file")
    values = [attrgetter(content)(run) for content in row.contents.split()]
    module, function = row.writer.split(".")
    write: Any = getattr(import_module(f"jcr.export.{module}"), function)
    if row.file.endswith("/"):
        write(path, *values)
        return run, row, path
    with written_whole(path) as temporary:
        if module in TEXTS:
            temporary.write_text(write(*values), "utf-8", newline="")
        else:
            write(temporary, *values)
        if path.is_file() and not options.overwrite and path.read_bytes() != temporary.read_bytes():
            raise InputError(
                f"{path}: is there with other content (frames, options or another calibration); to replace it add "
                "--overwrite, or name another PATH"
            )
    return run, row, path


def _require_path(out: Path, row: ExportFormat, path: Path) -> None:
    """Raise InputError for a path that the format cannot have, and for a file of the run itself."""
    if path.resolve().parent == out.resolve() and path.name in OWN_FILES:
        raise InputError(f"{path}: is a file of the run itself; name another one")
    if row.name in ("ros2", "moveit") and path.suffix != (suffix := Path(row.file).suffix):
        raise InputError(
            f"{path}: ros2 launch reads this format from a file that ends with {suffix}; name one"
        )
    if path.is_dir() and not row.file.endswith("/"):
        raise InputError(f"{path}: is a folder; name a file for {row.name}")


class ExportedRun:
    """Contents of a run folder for export; each property reads its data from the folder when it is used."""

    def __init__(self, out: Path, *others: Path, options: ExportOptions, path: Path) -> None:
        self.options, self.run, self.path, self.folders = options, RunResult(out), path, (out, *others)
        self.calibration = self.run.calibration
        if self.calibration.parent_from_camera is None:
            raise InputError(f"{out}: no calibration to export ({self.calibration.doubt}); fix the capture")
        cameras = () if self.run.cameras is None else self.run.cameras.cameras
        self.placed = [camera for camera in cameras if camera.parent_from_camera is not None]
        """Cameras other than the calibrated one whose pose was found."""
        self.camera = next((camera for camera in self.placed if camera.name == options.camera), None)
        if self.camera is None and options.camera is not None:
            raise InputError(f"--camera {options.camera}: {out} has no such camera; see its cameras.json")
        self.doubt = self.calibration.doubt
        """Reason why the calibration or the chosen camera is rejected; None if accepted."""
        if self.doubt is None and self.camera is not None:
            self.doubt = self.camera.doubt

    @property
    def short_in_words(self) -> str | None:
        """Reason in words why the exported transform misses the required accuracy; None if it reaches it."""
        found = self.calibration
        kept, required = found.with_given_intrinsics, found.requirement
        if self.options.intrinsics == "estimated" or self.camera is not None or kept is None:
            return None if found.short is None else sentence(found.short)
        mm, deg = kept.seen.within_95_mm, kept.seen.rotation_95_deg
        if required is None or (mm <= required.translation_mm and deg <= required.rotation_deg):
            return None
        return (
            f"with the given intrinsics a point is within {significant(mm)} mm and {significant(deg)}° (95 %), and "
            f"{required.translation_mm:g} mm and {required.rotation_deg:g}° are required; "
            "export the estimated ones, and set them in the driver"
        )

    @property
    def notes(self) -> dict[str, str]:
        """Notes to store in files with data in the base frame, by key: frame, unit, version, reason of a rejection."""
        ros.require_frame_name(self.base_frame)
        return provenance(self.base_frame, self.doubt)

    @property
    def map_notes(self) -> dict[str, str]:
        """Notes for files made from the map: `notes`, and the margin (m) for 95 % of the surface's errors, if known."""
        if self.scene.uncertainty is None:
            return self.notes
        return self.notes | {"margin_95_m": f"{self.scene.margin_95:.5f}"}

    @property
    def base_frame(self) -> str:
        """Name of the robot's base: that of the options, else of the capture, else BASE."""
        return self.options.base_frame or self.calibration.frame_names.base or ros.BASE

    @property
    def gripper_frame(self) -> str | None:
        """Name of the gripper frame: that of the options, else of the capture; None if it is unknown."""
        return self.options.parent_frame or self.calibration.frame_names.gripper

    @property
    def mount(self) -> ros.CameraMount:
        """Transform of the exported camera to its parent frame, as `camera_frame`.

        Raises InputError also if the name of the gripper frame is needed and unknown.
        """
        mount = self.camera_frame
        return mount if mount.is_fixed else self.mount_with_gripper

    @property
    def mount_with_gripper(self) -> ros.CameraMount:
        """Transform as `mount`, for a format that states the gripper frame also for a fixed camera."""
        # FRAME stands for a name in messages, and is none.
        if self.gripper_frame in (None, "FRAME"):
            raise InputError(
                f"{self.run.out}: the capture does not name the gripper frame of its poses, which this format states; "
                "add --parent-frame FRAME (the frame that the robot reports: tool0, flange, panda_hand, a TCP, …)"
            )
        return self.camera_frame

    @property
    def camera_frame(self) -> ros.CameraMount:
        """Transform of the exported camera (or its root link) to its parent frame, with names of options and capture.

        The parent is the gripper or, for a fixed camera, the base. Raises InputError if options and run do not fit.
        """
        options, found = self.options, self.calibration
        matrix, intrinsics = found.parent_from_camera, found.intrinsics
        if options.intrinsics == "given" and self.camera is None:
            if (kept := found.with_given_intrinsics) is None:
                raise InputError(
                    f"--intrinsics given: {self.run.out} has no transform for given intrinsics: the capture gave "
                    "none, or no others were estimated beside them; leave it out"
                )
            matrix, intrinsics = kept.gripper_from_camera, kept.intrinsics
        if self.camera is not None:
            mount = self._mount_of(self.camera, options.child_frame or f"{self.camera.name}_optical_frame")
        else:
            child = options.child_frame or found.frame_names.camera or ros.CHILD
            mount = self._mount(found.mount, child, matrix, self.doubt, intrinsics)
        if options.to_root is None:
            return mount
        if options.root_from_optical is None:
            return ros.on_root(mount, options.to_root)
        x, y, z, *quat_xyzw = options.root_from_optical
        length = float(np.linalg.norm(quat_xyzw))
        if not abs(length - 1) < 1e-2 or not np.isfinite([x, y, z]).all():
            raise InputError(
                f"--root-from-optical: a quaternion of length {length:.3g}; give x y z (m) qx qy qz qw"
            )
        rotation = Rotation.from_quat(quat_xyzw).as_matrix()
        return ros.on_root(mount, options.to_root, transform(rotation, np.array([x, y, z])))

    def root_in_words(self) -> str | None:
        """Return a sentence on the assumed origin of the camera's root link; None for an export without that link."""
        options = self.options
        if options.to_root is None or options.root_from_optical is not None:
            return None
        return (
            f"{options.to_root} is taken to have its origin in the optical frame's, with x forward; if a driver states "
            "another pose, such as 15 mm beside it, give --root-from-optical"
        )

    def pair_in_words(self, contents: str) -> str | None:
        """Return a sentence on the intrinsics that belong to an export with these contents, and on the other pair.

        None for an export without cameras, or if the run has no intrinsics.
        """
        found = self.calibration
        if "views" in contents.split():
            views = self.views
            off = views.base_from_camera - views.base_from_gripper @ found.gripper_from_camera
            mm = 1e3 * float(np.median(np.linalg.norm(off[:, :3, 3], axis=1)))
            camera = found.intrinsics
            other = "" if camera is not None and camera.fx == views.intrinsics.fx else " and other intrinsics"
            return (
                f"camera poses and intrinsics ({intrinsics_in_words(views.intrinsics)}) fit each other and the map to "
                f"a fraction of a pixel; gripper poses times the hand-eye transform differ from them by "
                f"{significant(mm)} mm (median), by the robot's errors{other}"
            )
        camera = (
            self.camera_frame.intrinsics
            if {"mount", "mount_with_gripper", "camera_frame"} & {*contents.split()}
            else None
        )
        if camera is None:
            return None
        words, given = f"belongs to {intrinsics_in_words(camera)}", found.with_given_intrinsics
        of_camera = f" --camera {self.options.camera}" if self.options.camera is not None else ""
        command = "" if contents == "camera_frame" else f"jcr export {self.run.out} camera_info{of_camera}"
        if self.camera is not None or given is None:
            return f"{words}; {command} writes them" if command else words
        if self.options.intrinsics == "given":
            return f"{words}, the given ones; without --intrinsics given: for the refined ones"
        return (
            f"{words}, the refined ones{command and f' ({command})'}; for the given ones (fx "
            f"{given.intrinsics.fx:.2f}): --intrinsics given"
        )

    @property
    def others(self) -> list[ros.CameraMount]:
        """Transforms of the run's other cameras and arms to their parent frames; empty if the options choose one camera.

        Rejected cameras are included only with `options.force`.
        """
        if self.run.cameras is None or self.camera is not None:
            return []
        shown = [camera for camera in self.placed if camera.doubt is None or self.options.force]
        mounts = [self._mount_of(camera, f"{camera.name}_optical_frame") for camera in shown]
        return mounts + [
            self._mount("base", f"{arm.name}_{self.base_frame}", arm.base_from_other_base)
            for arm in self.run.cameras.arms
        ]

    @property
    def cloud(self) -> "PointCloud":
        """Point cloud of the run in the base frame (m), from cloud.ply."""
        return read_cloud(self.run.out / CLOUD)

    @cached_property
    def scene(self) -> "SceneMap":
        """Map of the run in the base frame (m), from map.safetensors."""
        return load_map(self.run.out)

    def _mount_of(self, camera: "CameraPlacement", child: str) -> ros.CameraMount:
        """Return the frame `child` of a camera other than the calibrated one, with its transform to its parent frame."""
        matrix = camera.parent_from_camera
        return self._mount(camera.mount, child, matrix, camera.doubt, camera.intrinsics, camera.arm)

    def _mount(
        self,
        on: str,
        child: str,
        parent_from_child: Float[ndarray, "4 4"] | None,
        doubt: str | None = None,
        intrinsics: "Intrinsics | None" = None,
        arm: str | None = None,
    ) -> ros.CameraMount:
        """Return the frame `child` with its transform to the base (`on` is "base") or else to the gripper.

        `doubt` is the reason if the transform is rejected. `arm` is the name of another arm (None: the calibrated arm),
        which is put before the names of its frames.
        """
        of_arm = "" if arm is None else f"{arm}_"
        base, effector = of_arm + self.base_frame, of_arm + (self.gripper_frame or ros.PARENT)
        return ros.CameraMount(
            parent=base if on == "base" else effector,
            child=child,
            parent_from_child=np.array(parent_from_child),
            base=base,
            effector=effector,
            doubt=doubt,
            intrinsics=intrinsics,
        )

    @property
    def episodes(self) -> list[dict[str, Any]]:
        """Row of each run of an episode of a LeRobot data set."""
        from jcr.export.lerobot import episodes_of

        return episodes_of(self.folders)

    @property
    def pointmaps(self) -> "Pointmaps":
        """Dense depth of the registered images; raises InputError for a run without depth."""
        if (found := self.run.reconstruction.pointmaps) is None:
            raise InputError(f"{self.run.out}: has no dense depth; make it with `jcr map {self.run.out}`")
        return found

    @property
    def views(self) -> "PosedImages":
        """Registered images with their camera poses, tracks and points in the base frame (m).

        The camera poses are those of the reconstruction after one similarity transform, so they agree with each other
        to a fraction of a pixel. Poses computed from the gripper poses of most arms do not.
        """
        from jcr.export.nerfstudio_colmap import PosedImages

        calibration, capture, found = self.run.of_wrist_camera()
        base_from_recon = calibration.base_from_recon
        return PosedImages(
            folder=capture.folder,
            images=tuple(capture.images[row] for row in found.image_index),
            base_from_camera=base_from_recon.rigid
            @ scale_translation(found.recon_from_camera, base_from_recon.scale),
            base_from_gripper=capture.base_from_gripper[found.image_index],
            intrinsics=found.intrinsics,
            tracks=found.tracks,
            points_in_base=base_from_recon(found.tracks.points_in_recon),
            base_from_recon=base_from_recon,
        )
