"""The table of formats: a run's calibration and map as other tools read them."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from jcr.errors import InputError, RejectedError, did_you_mean
from jcr.export import ros
from jcr.export.options import ExportOptions, FormatName
from jcr.export.provenance import Provenance
from jcr.files import write_text
from jcr.geometry import transform
from jcr.options import checked_options
from jcr.run_folder import RunFolder

if TYPE_CHECKING:
    from jcr.calibration.calibration_json import CalibrationFile, GivenIntrinsicsKept
    from jcr.cell.cameras_json import CameraPlaced
    from jcr.export.views import PosedImages
    from jcr.records import Capture, Intrinsics, Reconstruction


@dataclass(frozen=True)
class Format:
    """One row of the table."""

    name: FormatName
    file: str
    """Its name in OUT/export, where the user gives no path; ends with / for a folder."""
    about: str
    write: Callable[["Run", Path], None]


def export_run(
    out: str | Path,
    format: FormatName,
    path: str | Path | None = None,
    options: ExportOptions | Mapping[str, Any] | None = None,
    **named: Any,
) -> Path:
    """Export the run folder `out` in a format of `jcr export` and return the path of the new file or folder.

    `options` are those of the command line; `named` are single ones of them, as 0.1.0 took them, and are removed in
    0.3.0. Raises InputError as the command does, and RejectedError if the calibration is rejected; with `force` it is
    exported, and the file contains the reason.
    """
    if named:
        warnings.warn("export_run: give jcr.ExportOptions(...)", DeprecationWarning, stacklevel=2)
        given = options if isinstance(options, Mapping) else vars(options or ExportOptions())
        options = {**given, **named}
    file = None if path is None else Path(path)
    return written(Path(out), format, file, checked_options(options, ExportOptions))[2]


def written(
    out: Path, format: FormatName, path: Path | None, options: ExportOptions
) -> "tuple[Run, Format, Path]":
    """Write a run folder in a format, and return what was exported, the row of the table and the path.

    Raises InputError for a format that does not exist, options that it cannot serve, and a run that lacks what it
    needs; RejectedError for a calibration that is rejected, unless `options` force it.
    """
    row = next((row for row in FORMATS if row.name == format), None)
    if row is None:
        names = get_args(FormatName)
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
    row.write(run, path)
    return run, row, path


class Run:
    """A run folder and how to export it; what a format does not need is not read."""

    def __init__(self, out: Path, options: ExportOptions) -> None:
        self.options, self.folder = options, RunFolder(out)
        if self.calibration.parent_from_camera is None:
            raise InputError(
                f"{out}: found no calibration to export ({self.doubt}); run it on a fixed capture"
            )

    @cached_property
    def calibration(self) -> "CalibrationFile":
        """calibration.json."""
        return self.folder.calibration()

    @property
    def doubt(self) -> str | None:
        """Why the calibration is rejected, or that of the camera asked for; None where it is accepted."""
        if self.calibration.doubt is not None or self.options.camera is None:
            return self.calibration.doubt
        return self._camera(self.options.camera).doubt

    @property
    def provenance(self) -> Provenance:
        """Of what is in the base frame."""
        ros.require_frame_name(self.options.base_frame)
        return Provenance(self.options.base_frame, self.doubt)

    @property
    def mount(self) -> ros.CameraMount:
        """The camera on the gripper, as the user wants its frames."""
        options = self.options
        if options.camera is not None:
            mount = self._mount_of(self._camera(options.camera), options.child_frame)
        else:
            fixed = self.calibration.mount == "base"
            mount = ros.camera_mount(
                *self._transform,
                options.base_frame if fixed else options.parent_frame,
                options.child_frame,
                options.base_frame,
                self.doubt,
                None if self.calibration.intrinsics is None else self.intrinsics,
            )
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
    def _transform(self) -> tuple[np.ndarray, np.ndarray]:
        """parent_from_camera and its covariance, of the intrinsics that were chosen."""
        if (kept := self._kept) is not None:
            return np.array(kept.gripper_from_camera), np.array(kept.covariance)
        uncertainty = self.calibration.uncertainty
        assert uncertainty is not None  # wherever there is a transform
        return np.array(self.calibration.parent_from_camera), np.array(uncertainty.covariance)

    @property
    def _kept(self) -> "GivenIntrinsicsKept | None":
        """The pair of the intrinsics that were given; None where the estimated ones are used."""
        if self.options.intrinsics == "estimated" or self.options.camera is not None:
            return None
        kept = self.calibration.with_given_intrinsics
        if kept is None:
            raise InputError(
                f"--intrinsics given: {self.folder.path} has no transform for given intrinsics: the capture gave "
                "none, or no others were estimated beside them; leave it out"
            )
        return kept

    @property
    def others(self) -> list[ros.CameraMount]:
        """Further cameras that are accepted (all of them by force) and arms; none where one camera is asked for."""
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
            ros.CameraMount(
                parent=base,
                child=f"{arm.name}_{base}",
                parent_from_child=np.array(arm.base_from_other_base),
                covariance=np.array(arm.uncertainty.covariance),
                base=base,
            )
            for arm in cameras.arms
        ]

    def _camera(self, name: str) -> "CameraPlaced":
        cameras = self.folder.cameras()
        for camera in () if cameras is None else cameras.cameras:
            if camera.name == name and camera.parent_from_camera is not None:
                return camera
        raise InputError(
            f"--camera {name}: {self.folder.path} has placed no camera of that name; see its cameras.json"
        )

    def _mount_of(self, camera: "CameraPlaced", child: str) -> ros.CameraMount:
        options = self.options
        assert camera.uncertainty is not None  # wherever there is a transform
        parent = options.base_frame if camera.mount == "base" else options.parent_frame
        if camera.arm is not None:
            parent = f"{camera.arm}_{parent}"
        return ros.camera_mount(
            np.array(camera.parent_from_camera),
            np.array(camera.uncertainty.covariance),
            parent,
            child,
            options.base_frame,
            camera.doubt,
            None if camera.intrinsics is None else camera.intrinsics.record(),
        )

    @property
    def intrinsics(self) -> "Intrinsics":
        """As estimated, or as given where these are asked for."""
        found = self.calibration.intrinsics if self._kept is None else self._kept.intrinsics
        if self.options.camera is not None:
            found = self._camera(self.options.camera).intrinsics
        if found is None:
            raise InputError(
                f"{self.folder.path}: knows no intrinsics, for camera poses were given and no images; export "
                "something else"
            )
        return found.record()

    @cached_property
    def capture(self) -> "Capture":
        """The images and poses the run was made from."""
        return self.folder.capture()

    @cached_property
    def reconstruction(self) -> "Reconstruction":
        """reconstruction.npz."""
        return self.folder.reconstruction()

    @property
    def views(self) -> "PosedImages":
        """The registered images in the base frame."""
        from jcr.export.views import posed_images

        scale = self.calibration.scale
        assert scale is not None  # wherever there is a transform
        if self.calibration.mount == "base":
            raise InputError(
                f"{self.folder.path}: a fixed camera watched the gripper: its images show no scene in the base frame"
            )
        base_from_recon = np.array(self.calibration.base_from_recon)
        return posed_images(self.capture, self.reconstruction, base_from_recon, scale)

    @property
    def other_views(self) -> "list[PosedImages]":
        """The images of further cameras that see the scene, in the base frame."""
        from jcr.cell.added import read_added_cameras
        from jcr.export.cell_views import posed_cameras

        cameras = self.folder.cameras()
        if cameras is None:
            return []
        others = (*self.capture.others, *read_added_cameras(self.folder.path, self.capture))
        own = np.array(self.calibration.gripper_from_camera)
        return posed_cameras(self.capture, others, cameras, self.views, self.reconstruction.image_index, own)


def _of_mount(text: Callable[[ros.CameraMount], str]) -> Callable[[Run, Path], None]:
    """The format whose file is that text about the camera on the gripper."""
    return lambda run, path: write_text(path, text(run.mount))


def _ros2(run: Run, path: Path) -> None:
    write_text(path, ros.ros2_launch(run.mount, *run.others))


def _urdf(run: Run, path: Path) -> None:
    write_text(path, ros.urdf(run.mount, *run.others))


def _easy_handeye2(run: Run, path: Path) -> None:
    write_text(path, ros.easy_handeye2(run.mount, path.stem))


def _camera_info(run: Run, path: Path) -> None:
    write_text(path, ros.camera_info(run.mount, run.intrinsics))


def _joint_offsets(run: Run, path: Path) -> None:
    errors = run.calibration.robot_errors
    if errors is None or errors.joints is None:
        raise InputError(
            f"{run.folder.path}: no joint offsets were estimated; name the arm (--robot, or robot in capture.json)"
        )
    offsets = [(joint.offset_deg, joint.std_deg) for joint in errors.joints]
    write_text(path, ros.joint_offsets(offsets, errors.p, run.doubt))


def _ply(run: Run, path: Path) -> None:
    from jcr.represent.cloud_ply import write_cloud

    write_cloud(path, run.folder.cloud(), run.provenance.notes)


# A map that is missing is named before what writes it is imported, which needs torch as well.


def _glb(run: Run, path: Path) -> None:
    scene = run.folder.scene()
    from jcr.export.volume import write_glb

    write_glb(path, scene, run.provenance)


def _octomap(run: Run, path: Path) -> None:
    scene = run.folder.scene()
    from jcr.export.volume import write_octomap

    write_octomap(path, scene, run.provenance, run.options.voxel_size)


def _esdf(run: Run, path: Path) -> None:
    scene = run.folder.scene()
    from jcr.export.volume import write_esdf

    write_esdf(path, scene, run.provenance, run.options.unknown or "occupied", run.options.voxel_size)


def _spheres(run: Run, path: Path) -> None:
    scene = run.folder.scene()
    from jcr.export.volume import write_spheres

    write_spheres(path, scene, run.provenance, run.options.unknown or "free", run.options.excess)


def _nerfstudio(run: Run, path: Path) -> None:
    from jcr.export.views import write_nerfstudio

    images = run.options.undistort, run.options.link_images
    write_nerfstudio(path, run.views, run.folder.cloud(), run.provenance, *images, others=run.other_views)


def _colmap(run: Run, path: Path) -> None:
    from jcr.export.views import write_colmap

    images = run.options.undistort, run.options.link_images
    write_colmap(path, run.views, run.provenance, *images, others=run.other_views)


def _rerun(run: Run, path: Path) -> None:
    scene = run.folder.scene()
    from jcr.export.rrd import write_rrd

    base_from_gripper = run.capture.base_from_gripper[run.reconstruction.image_index]
    write_rrd(path, run.views, base_from_gripper, run.folder.cloud(), scene, run.provenance)


FORMATS = (
    Format("ros2", "hand_eye.launch.xml", "static_transform_publisher line and launch file", _ros2),
    Format(
        "moveit",
        "hand_eye.launch.py",
        "launch file as MoveIt Calibration saves it",
        _of_mount(ros.moveit_launch),
    ),
    Format("urdf", "hand_eye.urdf", "camera link and fixed joint", _urdf),
    Format("xacro", "hand_eye.xacro", "macro that adds the camera link and joint", _of_mount(ros.xacro)),
    Format("easy_handeye2", "hand_eye.calib", ".calib for its publisher", _easy_handeye2),
    Format(
        "covariance",
        "hand_eye.yaml",
        "PoseWithCovarianceStamped, 36 numbers",
        _of_mount(ros.pose_with_covariance),
    ),
    Format("camera_info", "camera_info.yaml", "intrinsics for camera_info_manager", _camera_info),
    Format(
        "joint_offsets", "joint_offsets.yaml", "by how much each joint of the arm seems off", _joint_offsets
    ),
    Format("ply", "cloud.ply", "points, colours, labels", _ply),
    Format("glb", "map.glb", "mesh of the seen surface with colours", _glb),
    Format("octomap", "map.bt", "occupied, free and unknown voxels", _octomap),
    Format("esdf", "esdf.npz", "voxels of signed distance", _esdf),
    Format("spheres", "spheres.npz", "spheres that cover what is solid", _spheres),
    Format(
        "nerfstudio",
        "nerfstudio/",
        "transforms.json, images and first points for a splat or NeRF",
        _nerfstudio,
    ),
    Format("colmap", "colmap/", "COLMAP model in the base frame, binary and text", _colmap),
    Format("rerun", "run.rrd", "recording for the Rerun viewer", _rerun),
)
