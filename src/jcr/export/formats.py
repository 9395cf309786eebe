"""Table of export formats for calibration and map of a run."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.errors import InputError, RejectedError, did_you_mean
from jcr.export import ros
from jcr.export.options import ExportName, ExportOptions
from jcr.export.provenance import Provenance
from jcr.files import write_text
from jcr.geometry import transform
from jcr.options import checked_options
from jcr.run_folder import RunFolder

if TYPE_CHECKING:
    from jcr.calibration.record import Calibration
    from jcr.cell.placement import CameraPlacement
    from jcr.export.views import PosedImages
    from jcr.records import Intrinsics, PointCloud
    from jcr.scene.scene_map import SceneMap


@dataclass(frozen=True)
class ExportFormat:
    """Row of the table."""

    name: ExportName
    file: str
    """Default name in OUT/export; ends with / for a folder."""
    about: str
    write: Callable[["Run", Path], None]


def export_run(
    out: str | Path,
    format: ExportName,
    path: str | Path | None = None,
    options: ExportOptions | Mapping[str, Any] | None = None,
) -> Path:
    """Export the run folder `out` in a format of `jcr export` and return the path of the new file or folder.

    `options` are those of the command line. Raises InputError as the command does, and RejectedError if the
    calibration is rejected; with `force` it is exported, and the file contains the reason.
    """
    file = None if path is None else Path(path)
    return write_run(Path(out), format, file, checked_options(options, ExportOptions))[2]


def write_run(
    out: Path, format: ExportName, path: Path | None, options: ExportOptions
) -> "tuple[Run, ExportFormat, Path, bool]":
    """Write a run folder in a format; return run, row of the table, path, and whether other content was replaced.

    Raises InputError for a format that does not exist, options that it cannot serve, and a run that lacks what it
    needs; RejectedError for a calibration that is rejected, unless `options` force it.
    """
    row = next((row for row in FORMATS if row.name == format), None)
    if row is None:
        names = get_args(ExportName)
        raise InputError(
            f"{format}: no such format{did_you_mean(format, names)}; choose one of {', '.join(names)}"
        )
    if options.root_from_optical and not options.to_root:
        raise InputError("--root-from-optical: needs --to-root LINK, the link it is given in")
    run = Run(out, options)
    if run.doubt is not None and not options.force:
        raise RejectedError(
            f"{out}: its calibration is rejected, and nothing was exported: {run.doubt}; to export it nevertheless, "
            "with this reason in the file, add --force"
        )
    path = path or out / "export" / row.file
    if path.is_dir() and not row.file.endswith("/"):
        raise InputError(f"{path}: is a folder; name a file for {row.name}")
    before = path.read_bytes() if path.is_file() else None
    row.write(run, path)
    return run, row, path, before is not None and path.read_bytes() != before


class Run:
    """Run folder with export options; only the data that a format needs are read."""

    def __init__(self, out: Path, options: ExportOptions) -> None:
        self.options, self.folder = options, RunFolder(out)
        if self.calibration.parent_from_camera is None:
            raise InputError(
                f"{out}: found no calibration to export ({self.doubt}); run it on a fixed capture"
            )

    @cached_property
    def calibration(self) -> "Calibration":
        """calibration.json."""
        return self.folder.calibration()

    @property
    def doubt(self) -> str | None:
        """Reason for the rejection of the calibration, or of the chosen camera; None where it is accepted."""
        if self.calibration.doubt is not None or self.options.camera is None:
            return self.calibration.doubt
        return self._camera(self.options.camera).doubt

    @property
    def provenance(self) -> Provenance:
        """Provenance of data in the base frame."""
        ros.require_frame_name(self.options.base_frame)
        return Provenance(self.options.base_frame, self.doubt)

    @property
    def mount(self) -> ros.CameraMount:
        """Mount of the exported camera, under the frame names of the options."""
        options = self.options
        if options.camera is not None:
            mount = self._mount_of(self._camera(options.camera), options.child_frame)
        else:
            fixed = self.calibration.mount == "base"
            parent_from_camera, intrinsics = self._pair
            parent = options.base_frame if fixed else options.parent_frame
            mount = self._named(parent_from_camera, parent, options.child_frame, self.doubt, intrinsics)
        if options.to_root is None:
            return mount
        if options.root_from_optical is None:
            return ros.on_root(mount, options.to_root)
        x, y, z, *quat_xyzw = options.root_from_optical
        length = float(np.linalg.norm(quat_xyzw))
        if not abs(length - 1) < 1e-2 or not np.isfinite([x, y, z]).all():
            raise InputError(
                f"--root-from-optical: its quaternion has length {length:.3g}, not 1; give x y z (m) qx qy qz qw"
            )
        rotation = Rotation.from_quat(quat_xyzw).as_matrix()
        return ros.on_root(mount, options.to_root, transform(rotation, np.array([x, y, z])))

    @property
    def _pair(self) -> "tuple[Float[ndarray, '4 4'], Intrinsics | None]":
        """parent_from_camera and the intrinsics that it belongs to: the estimated ones, or those of the capture."""
        if self.options.intrinsics == "estimated":
            found = self.calibration.intrinsics
            return np.array(self.calibration.parent_from_camera), None if found is None else found.record()
        kept = self.calibration.with_given_intrinsics
        if kept is None:
            raise InputError(
                f"--intrinsics given: {self.folder.path} has no transform for given intrinsics: the capture gave "
                "none, or no others were estimated beside them; leave it out"
            )
        return np.array(kept.gripper_from_camera), kept.intrinsics.record()

    @property
    def others(self) -> list[ros.CameraMount]:
        """Accepted further cameras (with `force` also rejected ones) and arms; none where one camera is chosen."""
        cameras = self.folder.cameras()
        if cameras is None or self.options.camera is not None:
            return []
        mounts = [
            self._mount_of(camera, f"{camera.name}_optical_frame")
            for camera in cameras.cameras
            if camera.parent_from_camera is not None and (camera.doubt is None or self.options.force)
        ]
        base = self.options.base_frame
        return mounts + [
            self._named(np.array(arm.base_from_other_base), base, f"{arm.name}_{base}")
            for arm in cameras.arms
        ]

    def _camera(self, name: str) -> "CameraPlacement":
        """Return a further camera by its name; raise InputError where it was not placed."""
        cameras = self.folder.cameras()
        for camera in () if cameras is None else cameras.cameras:
            if camera.name == name and camera.parent_from_camera is not None:
                return camera
        raise InputError(
            f"--camera {name}: {self.folder.path} has placed no camera of that name; see its cameras.json"
        )

    def _mount_of(self, camera: "CameraPlacement", child: str) -> ros.CameraMount:
        """Return the mount of a further camera."""
        parent = self.options.base_frame if camera.mount == "base" else self.options.parent_frame
        intrinsics = None if camera.intrinsics is None else camera.intrinsics.record()
        return self._named(
            np.array(camera.parent_from_camera), parent, child, camera.doubt, intrinsics, camera.arm
        )

    def _named(
        self,
        parent_from_child: Float[ndarray, "4 4"],
        parent: str,
        child: str,
        doubt: str | None = None,
        intrinsics: "Intrinsics | None" = None,
        arm: str | None = None,
    ) -> ros.CameraMount:
        """Return a mount; the frames of another arm have its name in front."""
        of_arm = "" if arm is None else f"{arm}_"
        return ros.CameraMount(
            parent=of_arm + parent,
            child=child,
            parent_from_child=parent_from_child,
            base=of_arm + self.options.base_frame,
            effector=of_arm + self.options.parent_frame,
            doubt=doubt,
            intrinsics=intrinsics,
        )

    @property
    def cloud(self) -> "PointCloud":
        """cloud.ply."""
        return self.folder.cloud()

    @property
    def scene(self) -> "SceneMap":
        """map.safetensors."""
        return self.folder.scene()

    @property
    def views(self) -> "PosedImages":
        """Registered images in the base frame."""
        from jcr.export.views import posed_images

        scale = self.calibration.scale
        assert scale is not None  # wherever there is a transform
        if self.calibration.mount == "base":
            raise InputError(
                f"{self.folder.path}: a fixed camera watched the gripper: its images show no scene in the base frame"
            )
        base_from_recon = self.calibration.base_from_recon.rigid
        capture = self.folder.capture_of(self.calibration)
        return posed_images(capture, self.folder.reconstruction(), base_from_recon, scale)


def _written(name: str, *contents: str) -> Callable[[Run, Path], None]:
    """Return the writer `name` (module.function of this package), given these contents and options of a run.

    The module is imported when the writer is called, because torch and pycolmap take seconds.
    """
    module, function = name.split(".")

    def write(run: Run, path: Path) -> None:
        """Write a file or folder."""
        values = [attrgetter(content)(run) for content in contents]
        getattr(import_module(f"jcr.export.{module}"), function)(path, *values)

    return write


def _text(text: Callable[[Run, Path], str]) -> Callable[[Run, Path], None]:
    """Return the writer of a text."""
    return lambda run, path: write_text(path, text(run, path))


FORMATS = (
    ExportFormat(
        "ros2",
        "hand_eye.launch.xml",
        "static_transform_publisher line and launch file",
        _text(lambda run, path: ros.ros2_launch(run.mount, *run.others)),
    ),
    ExportFormat(
        "moveit",
        "hand_eye.launch.py",
        "launch file as MoveIt Calibration saves it",
        _text(lambda run, path: ros.moveit_launch(run.mount)),
    ),
    ExportFormat(
        "urdf",
        "hand_eye.urdf",
        "camera link and fixed joint",
        _text(lambda run, path: ros.urdf(run.mount, *run.others)),
    ),
    ExportFormat(
        "easy_handeye2",
        "hand_eye.calib",
        ".calib for its publisher",
        _text(lambda run, path: ros.easy_handeye2(run.mount, path.stem)),
    ),
    ExportFormat(
        "camera_info",
        "camera_info.yaml",
        "intrinsics for camera_info_manager",
        _text(lambda run, path: ros.camera_info(run.mount)),
    ),
    ExportFormat(
        "ply", "cloud.ply", "points, colours, labels", _written("views.write_ply", "cloud", "provenance")
    ),
    ExportFormat(
        "glb",
        "map.glb",
        "mesh of the seen surface with colours",
        _written("volume.write_glb", "scene", "provenance"),
    ),
    ExportFormat(
        "octomap",
        "map.bt",
        "occupied, free and unknown voxels",
        _written("volume.write_octomap", "scene", "provenance", "options.voxel_size"),
    ),
    ExportFormat(
        "esdf",
        "esdf.npz",
        "voxels of signed distance",
        _written("volume.write_esdf", "scene", "provenance", "options.unknown", "options.voxel_size"),
    ),
    ExportFormat(
        "spheres",
        "spheres.npz",
        "spheres that cover what is solid",
        _written("volume.write_spheres", "scene", "provenance", "options.unknown", "options.excess"),
    ),
    ExportFormat(
        "nerfstudio",
        "nerfstudio/",
        "transforms.json, images and first points for a splat or NeRF",
        _written(
            "views.write_nerfstudio",
            *("views", "cloud", "provenance", "options.undistort", "options.link_images"),
        ),
    ),
    ExportFormat(
        "colmap",
        "colmap/",
        "COLMAP model in the base frame, binary and text",
        _written("views.write_colmap", "views", "provenance", "options.undistort", "options.link_images"),
    ),
    ExportFormat(
        "rerun",
        "run.rrd",
        "recording for the Rerun viewer",
        _written("rrd.write_rrd", "views", "cloud", "scene", "provenance"),
    ),
)
