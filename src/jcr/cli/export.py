"""`jcr export`: writes a run's calibration and map in the formats of other tools."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from jcr.cli.output import Output
from jcr.errors import InputError, NotTrustedError
from jcr.export import ros
from jcr.export.provenance import Provenance
from jcr.files import write_text
from jcr.geometry import transform

if TYPE_CHECKING:
    from jcr.calibration.calibration_json import CalibrationFile
    from jcr.cell.cameras_json import CameraPlaced
    from jcr.export.views import PosedImages
    from jcr.records import Capture, Intrinsics, PointCloud, Reconstruction
    from jcr.represent.scene import SceneMap

FormatName = Literal[
    "ros2", "moveit", "urdf", "xacro", "easy_handeye2", "covariance", "camera_info", "joint_offsets", "ply", "glb",
    "octomap", "esdf", "spheres", "nerfstudio", "colmap", "rerun",
]  # fmt: skip


@dataclass(frozen=True)
class Arguments:
    """Write a run's calibration or map in another tool's format; without FORMAT, list the formats.

    Every file names its frames and units. Map, images and cameras are in the robot's base frame, in metres.

    examples:
      jcr export out/table ros2 --parent-frame tool0 --child-frame camera_color_optical_frame
      jcr export out/table urdf --to-root camera_link
      jcr export out/table octomap table.bt --voxel-size 0.02
      jcr export out/table nerfstudio splat/ --undistort
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    format: Annotated[
        FormatName | None,
        tyro.conf.Positional,
        tyro.conf.arg(
            help=f"{', '.join(get_args(FormatName))}; without it, all are listed with their contents."
        ),
    ] = None
    path: Annotated[Path | None, tyro.conf.Positional] = None
    """File or (nerfstudio, colmap) new folder to write; by default in OUT/export."""
    parent_frame: Annotated[str, tyro.conf.arg(metavar="FRAME")] = "tool0"
    """The gripper frame whose poses the capture contains."""
    child_frame: Annotated[str, tyro.conf.arg(metavar="FRAME")] = "camera_color_optical_frame"
    """The camera's optical frame: x right, y down, z forward."""
    base_frame: Annotated[str, tyro.conf.arg(metavar="FRAME")] = "base_link"
    """The robot's base, the frame of the map."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Another camera of the cell (cameras.json), for formats with one camera; unset: the run's own camera, and for ros2
    and urdf all cameras. The parent of a fixed camera is the base frame."""
    to_root: Annotated[str | None, tyro.conf.arg(metavar="FRAME")] = None
    """Export the transform to this link instead, the root of the camera's own frames (e.g. camera_link)."""
    root_from_optical: Annotated[
        tuple[float, float, float, float, float, float, float] | None,
        tyro.conf.arg(metavar="X Y Z QX QY QZ QW"),
    ] = None
    """Pose of the optical frame in that link: x y z (m) qx qy qz qw, as `ros2 run tf2_ros tf2_echo LINK OPTICAL`
    prints it; by default the same origin, with axes as in REP-103."""
    voxel_size: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Voxel size (m) for octomap and esdf; by default the map's cell."""
    unknown: Literal["occupied", "free"] | None = None
    """How unseen space counts: by default as occupied in esdf, as free (left out) in spheres."""
    excess: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Metres by which spheres may extend into free space; by default two cells of the map."""
    undistort: bool = False
    """Resample the images of nerfstudio and colmap to a pinhole camera."""
    link_images: bool = False
    """Link to the capture's images instead of copying them."""
    output: Output = field(default_factory=Output)


@dataclass(frozen=True)
class Format:
    """One row of the table."""

    name: FormatName
    file: str
    """In OUT/export, where the user names none; ends with / for a folder."""
    about: str
    write: Callable[["Run", Path], None]


def main(arguments: Arguments) -> int:
    """Write the file, say where, and warn where the calibration is rejected: exit status 0 or 3."""
    if arguments.format is None:
        lines = "".join(f"{row.name:<14} {row.about}\n" for row in FORMATS)
        arguments.output.result(
            f"{lines}for one: jcr export {arguments.out} FORMAT\n",
            {"formats": {row.name: row.about for row in FORMATS}},
        )
        return 0
    run, row, path = _written(arguments)
    sys.stderr.write(f"wrote {path}: {row.about}\n")
    line, facts = "", {"file": str(path), "format": row.name, "about": row.about}
    if row.name == "ros2":
        mount = run.mount
        line = ros.static_transform_publisher(mount.parent, mount.child, mount.parent_from_child)
        facts["line"] = line
    arguments.output.result(line and line + "\n", facts)
    if run.doubt is not None:
        raise NotTrustedError(f"the calibration is rejected, as the file says too: {run.doubt}")
    return 0


def export_run(
    out: str | Path, format: FormatName, path: str | Path | None = None, **options: object
) -> Path:
    """Export the run folder `out` in a format of `jcr export` and return the path of the new file or folder.

    `options` are those of the command line (parent_frame, voxel_size, …). Raises InputError as the command does; if the
    calibration is rejected, the file says so.
    """
    named = None if path is None else Path(path)
    return _written(Arguments(Path(out), format, named, **options))[2]  # pyright: ignore[reportArgumentType]


def _written(arguments: Arguments) -> "tuple[Run, Format, Path]":
    """What was written, and where."""
    row = next((row for row in FORMATS if row.name == arguments.format), None)
    if row is None:
        raise InputError(
            f"{arguments.format}: no such format; choose one of {', '.join(get_args(FormatName))}"
        )
    if arguments.root_from_optical and not arguments.to_root:
        raise InputError("--root-from-optical: needs --to-root LINK, the link it is given in")
    run = Run(arguments)
    path = arguments.path or arguments.out / "export" / row.file
    if path.is_dir() and not row.file.endswith("/"):
        raise InputError(f"{path}: is a folder; name a file for {row.name}")
    row.write(run, path)
    return run, row, path


class Run:
    """A run folder and how to export it; what a format does not need is not read."""

    def __init__(self, arguments: Arguments) -> None:
        from jcr.run_folder import RunFolder

        self.arguments, self.folder = arguments, RunFolder(arguments.out)
        if self.calibration.parent_from_camera is None:
            raise InputError(
                f"{arguments.out}: found no calibration to export ({self.doubt}); run it on a fixed capture"
            )

    @cached_property
    def calibration(self) -> "CalibrationFile":
        """calibration.json."""
        return self.folder.calibration()

    @property
    def doubt(self) -> str | None:
        """Why the calibration is rejected; None when it is."""
        return self.calibration.doubt

    @property
    def provenance(self) -> Provenance:
        """Of what is in the base frame."""
        ros.require_frame_name(self.arguments.base_frame)
        return Provenance(self.arguments.base_frame, self.doubt)

    @property
    def mount(self) -> ros.CameraMount:
        """The camera on the gripper, as the user wants its frames."""
        arguments = self.arguments
        if arguments.camera is not None:
            mount = self._mount_of(self._camera(arguments.camera), arguments.child_frame)
        else:
            uncertainty = self.calibration.uncertainty
            assert uncertainty is not None  # wherever there is a transform
            fixed = self.calibration.mount == "base"
            mount = ros.camera_mount(
                np.array(self.calibration.parent_from_camera),
                np.array(uncertainty.covariance),
                arguments.base_frame if fixed else arguments.parent_frame,
                arguments.child_frame,
                arguments.base_frame,
                self.doubt,
            )
        if arguments.to_root is None:
            return mount
        if arguments.root_from_optical is None:
            return ros.on_root(mount, arguments.to_root)
        x, y, z, *quat_xyzw = arguments.root_from_optical
        length = float(np.linalg.norm(quat_xyzw))
        if not abs(length - 1) < 1e-2 or not np.isfinite([x, y, z]).all():
            raise InputError(
                f"--root-from-optical: its quaternion has length {length:.3g}, not 1; give x y z (m) qx qy qz qw"
            )
        rotation = Rotation.from_quat(quat_xyzw).as_matrix()
        return ros.on_root(mount, arguments.to_root, transform(rotation, np.array([x, y, z])))

    @property
    def others(self) -> list[ros.CameraMount]:
        """Further cameras and arms; none where one camera is asked for."""
        cameras = self.folder.cameras()
        if cameras is None or self.arguments.camera is not None:
            return []
        mounts = [
            self._mount_of(camera, f"{camera.name}_optical_frame")
            for camera in cameras.cameras
            if camera.parent_from_camera is not None
        ]
        base = self.arguments.base_frame
        return mounts + [
            ros.CameraMount(
                base,
                f"{arm.name}_{base}",
                np.array(arm.base_from_other_base),
                np.array(arm.uncertainty.covariance),
                base,
            )
            for arm in cameras.arms
        ]

    def _camera(self, name: str) -> "CameraPlaced":
        cameras = self.folder.cameras()
        for camera in () if cameras is None else cameras.cameras:
            if camera.name == name and camera.parent_from_camera is not None:
                return camera
        raise InputError(
            f"--camera {name}: {self.arguments.out} has placed no camera of that name; see its cameras.json"
        )

    def _mount_of(self, camera: "CameraPlaced", child: str) -> ros.CameraMount:
        arguments = self.arguments
        assert camera.uncertainty is not None  # wherever there is a transform
        parent = arguments.base_frame if camera.mount == "base" else arguments.parent_frame
        if camera.arm is not None:
            parent = f"{camera.arm}_{parent}"
        return ros.camera_mount(
            np.array(camera.parent_from_camera),
            np.array(camera.uncertainty.covariance),
            parent,
            child,
            arguments.base_frame,
            camera.doubt,
        )

    @property
    def lens(self) -> "Intrinsics":
        """As calibrated."""
        lens = self.calibration.intrinsics
        if self.arguments.camera is not None:
            lens = self._camera(self.arguments.camera).intrinsics
        if lens is None:
            raise InputError(
                f"{self.arguments.out}: knows no intrinsics, for camera poses were given and no images; export "
                "something else"
            )
        return lens.record()

    @cached_property
    def scene(self) -> "SceneMap":
        """map.safetensors; asked for before what writes it is imported, which needs torch as well."""
        return self.folder.scene()

    @cached_property
    def cloud(self) -> "PointCloud":
        """cloud.ply."""
        return self.folder.cloud()

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
                f"{self.arguments.out}: a fixed camera watched the gripper: its images show no scene in the base frame"
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
    write_text(path, ros.camera_info(run.mount, run.lens))


def _joint_offsets(run: Run, path: Path) -> None:
    errors = run.calibration.robot_errors
    if errors is None or errors.joints is None:
        raise InputError(
            f"{run.arguments.out}: no joint offsets were estimated; name the arm (--robot, or robot in capture.json)"
        )
    offsets = [(joint.offset_deg, joint.std_deg) for joint in errors.joints]
    write_text(path, ros.joint_offsets(offsets, errors.p, run.doubt))


def _ply(run: Run, path: Path) -> None:
    from jcr.represent.cloud_ply import write_cloud

    write_cloud(path, run.cloud, run.provenance.notes)


def _glb(run: Run, path: Path) -> None:
    scene = run.scene
    from jcr.export.mesh import write_glb

    write_glb(path, scene, run.provenance)


def _octomap(run: Run, path: Path) -> None:
    scene = run.scene
    from jcr.export.volume import write_octomap

    write_octomap(path, scene, run.provenance, run.arguments.voxel_size)


def _esdf(run: Run, path: Path) -> None:
    scene = run.scene
    from jcr.export.volume import write_esdf

    unknown = run.arguments.unknown or "occupied"
    write_esdf(path, scene, run.provenance, unknown, run.arguments.voxel_size)


def _spheres(run: Run, path: Path) -> None:
    scene = run.scene
    from jcr.export.volume import write_spheres

    write_spheres(path, scene, run.provenance, run.arguments.unknown or "free", run.arguments.excess)


def _nerfstudio(run: Run, path: Path) -> None:
    from jcr.export.views import write_nerfstudio

    options = run.arguments.undistort, run.arguments.link_images
    write_nerfstudio(path, run.views, run.cloud, run.provenance, *options, others=run.other_views)


def _colmap(run: Run, path: Path) -> None:
    from jcr.export.views import write_colmap

    options = run.arguments.undistort, run.arguments.link_images
    write_colmap(path, run.views, run.provenance, *options, others=run.other_views)


def _rerun(run: Run, path: Path) -> None:
    scene = run.scene
    from jcr.export.rrd import write_rrd

    base_from_gripper = run.capture.base_from_gripper[run.reconstruction.image_index]
    write_rrd(path, run.views, base_from_gripper, run.cloud, scene, run.provenance)


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
