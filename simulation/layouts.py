"""Layouts in which people store images and gripper poses: a table of templates and writers of arrays."""

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from unicodedata import normalize

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from jcr.geometry import inverse
from simulation.recordings import Recording

BEGIN_NS = 1_714_730_400_123_456_789
"""Time stamp of the first image."""
SCALAR_FIRST, SCALAR_LAST = [3, 0, 1, 2], [0, 1, 2, 3]
Poses = Float[ndarray, "n 4 4"]
Save = Callable[[Path, Poses, Float[ndarray, "n k"], Sequence[str]], None]
"""Function that writes the file of a layout from poses as they are stored (matrices with positions in the stored unit),
the same as rows of numbers, and the names of the images."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Notation of the poses, and the syntax and place of the files that hold them.

    In `line`, `{0}` to `{15}` are the numbers of a pose, `{p}` all of them, `{j}` joint angles (rad), `{b}` the position
    (mm) and rotation vector of a board in the camera. `{name}` and `{stem}` are the image's file name with and without
    ending, `{k}` is its number from 1, `{s}` and `{ns}` are its time stamp.
    """

    name: str
    rotation: str
    """`matrix` (16 numbers by rows), `columns` (16 by columns), `3x4` (12 by rows), `xyzw`, `wxyz`, `rotvec`, or SciPy's
    sequence of Euler angles."""
    units: str = "m-rad"
    inverted: bool = False
    """True: the poses are gripper_from_base."""
    file: str = "poses.csv"
    """Path of the pose file in the folder; with `{stem}` there is a file for each image."""
    images: str = "images"
    """Subfolder of the images; empty: none."""
    stem: str = "{stem}"
    """Names that the images get, without ending."""
    head: str = ""
    line: str = ""
    between: str = "\n"
    foot: str = "\n"
    separator: str = ","
    """Text between the numbers of `{p}`, `{j}` and `{b}`."""
    comma: bool = False
    """Whether the numbers have a decimal comma."""
    encoding: str = "utf-8"
    times_s: tuple[float, ...] = (0.0,)
    """Times of the rows of an image, s, relative to the image's time stamp."""
    save: Save | None = None
    """Writer of a file that is no text; None: the file is written from the templates."""
    names_fix: bool = False
    """Whether names, brackets or numbers leave one notation, unit and direction."""
    by_key: bool = True
    """Whether the rows state their image by name, number or time stamp; else rows have the order of the images."""
    n_min: int = 3
    """Smallest number of images with which the layout can be read."""


def numbers_of(poses: Poses, rotation: str, angle: str) -> Float[ndarray, "n k"]:
    """Return the rows of numbers of poses in a notation of `Layout.rotation`; `angle` is deg or rad."""
    if rotation in ("matrix", "columns", "3x4"):
        by_rows = np.swapaxes(poses, 1, 2) if rotation == "columns" else poses
        return by_rows.reshape(len(poses), 16)[:, : 12 if rotation == "3x4" else 16]
    turned, per_rad = Rotation.from_matrix(poses[:, :3, :3]), np.degrees(1.0) if angle == "deg" else 1.0
    if rotation in ("xyzw", "wxyz"):
        numbers = turned.as_quat()[:, SCALAR_FIRST if rotation == "wxyz" else SCALAR_LAST]
    elif rotation == "rotvec":
        numbers = per_rad * turned.as_rotvec()
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # gimbal lock: the third angle is 0
            numbers = per_rad * turned.as_euler(rotation)
    return np.hstack([poses[:, :3, 3], numbers])


def write_layout(
    folder: Path, layout: Layout, recording: Recording, poses: Poses, rows: Sequence[int] | None = None
) -> None:
    """Write the recording's images and the poses (n,4,4; base_from_gripper) into a new folder, as the layout says.

    `rows` are the indices of the images that have a pose in the file; None: all. Images are hard links.
    """
    rows = list(range(len(recording))) if rows is None else list(rows)
    stamps = [
        BEGIN_NS + 2_300_000_000 * k + (k * k * 137_035_999) % 900_000_000 for k in range(len(recording))
    ]
    names = []
    (folder / layout.images).mkdir(parents=True)
    for file, stamp in zip(recording.files, stamps, strict=True):
        names.append(layout.stem.format(stem=file.stem, **_times(stamp)) + file.suffix)
        os.link(file, folder / layout.images / names[-1])
    length, angle = layout.units.split("-")
    stored = inverse(poses) if layout.inverted else poses.copy()
    stored[:, :3, 3] *= {"m": 1.0, "cm": 100.0, "mm": 1000.0}[length]
    numbers = numbers_of(stored, layout.rotation, angle)
    # Texts are written in the composed form, whatever form the file system has.
    written = [normalize("NFC", names[row]) for row in rows]
    if layout.save is not None:
        file = folder / layout.file
        file.parent.mkdir(parents=True, exist_ok=True)
        layout.save(file, stored[rows], numbers[rows], written)
        return
    lines = []
    for row, name in zip(rows, written, strict=True):
        for time_s in layout.times_s:
            text = _line(layout, recording, row, numbers[row], name, stamps[row] + round(1e9 * time_s))
            lines.append((Path(name).stem, text))
    _write_text(folder, layout, lines)


def _write_text(folder: Path, layout: Layout, lines: Sequence[tuple[str, str]]) -> None:
    """Write lines, each with the stem of its image, to one file, or to a file for each."""
    if "{stem}" in layout.file:
        texts = {layout.file.format(stem=stem): line for stem, line in lines}
    else:
        texts = {layout.file: layout.between.join(line for _, line in lines)}
    for name, text in texts.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes((layout.head + text + layout.foot).encode(layout.encoding))


def _line(
    layout: Layout, recording: Recording, row: int, numbers: Float[ndarray, " k"], name: str, stamp_ns: int
) -> str:
    """Return the text of one image's pose."""
    length, angle = layout.units.split("-")
    is_length = np.isin(np.arange(len(numbers)), _LENGTHS.get(layout.rotation, (0, 1, 2)))
    has_angles = layout.rotation not in (*_LENGTHS, "xyzw", "wxyz")
    digits = np.where(
        is_length, {"m": 6, "cm": 4, "mm": 3}[length], 4 if has_angles and angle == "deg" else 7
    )
    board = recording.camera_from_board[row]
    seen = np.r_[1e3 * board[:3, 3], Rotation.from_matrix(board[:3, :3]).as_rotvec()]

    def texts(values: Float[ndarray, " k"], places: Sequence[int]) -> list[str]:
        """Return the numbers with their decimals."""
        plain = [f"{value:.{count}f}" for value, count in zip(values, places, strict=True)]
        return [text.replace(".", ",") for text in plain] if layout.comma else plain

    pose, separator = texts(numbers, digits.tolist()), layout.separator
    return layout.line.format(
        *pose,
        p=separator.join(pose),
        j=separator.join(texts(recording.joints[row], [6] * 6)),
        b=separator.join(texts(seen, [6] * 6)),
        name=name,
        stem=Path(name).stem,
        k=row + 1,
        **_times(stamp_ns),
    )


_LENGTHS = {"matrix": (3, 7, 11), "columns": (12, 13, 14), "3x4": (3, 7, 11)}
"""Indices of the position in the numbers of matrices."""


def _times(stamp_ns: int) -> dict[str, str]:
    """Return a time stamp in the forms of templates: seconds, nanoseconds, date and time, ISO."""
    moment = datetime.fromtimestamp(stamp_ns // 10**9, UTC)
    seconds = f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
    date, iso = f"{moment:%Y-%m-%d_%H-%M-%S}", f"{moment:%Y-%m-%dT%H:%M:%S}.{stamp_ns % 10**9 // 1000:06d}Z"
    return {"s": seconds, "ns": str(stamp_ns), "date": date, "iso": iso}


def _npy(file: Path, poses: Poses, numbers: Float[ndarray, "n k"], _: Sequence[str]) -> None:
    """Write the matrices (n,4,4)."""
    np.save(file, poses)


def _npy_rows(file: Path, poses: Poses, numbers: Float[ndarray, "n k"], _: Sequence[str]) -> None:
    """Write the rows of numbers (n,k)."""
    np.save(file, numbers)


def _npy_each(file: Path, poses: Poses, numbers: Float[ndarray, "n k"], names: Sequence[str]) -> None:
    """Write a matrix (4,4) for each image."""
    for name, pose in zip(names, poses, strict=True):
        np.save(file.with_name(file.name.format(stem=Path(name).stem)), pose)


def _npz_opencv(file: Path, poses: Poses, numbers: Float[ndarray, "n k"], _: Sequence[str]) -> None:
    """Write rotations (n,3,3) and translations (n,3,1) under the names of OpenCV's cv::calibrateHandEye."""
    np.savez(file, R_gripper2base=poses[:, :3, :3], t_gripper2base=poses[:, :3, 3:])


def _npz_inverse(file: Path, poses: Poses, numbers: Float[ndarray, "n k"], _: Sequence[str]) -> None:
    """Write rotations (n,3,3) and translations (n,3) under names that state the inverse."""
    np.savez(file, R_base2gripper=poses[:, :3, :3], t_base2gripper=poses[:, :3, 3])


def _mat_stack(file: Path, poses: Poses, numbers: Float[ndarray, "n k"], _: Sequence[str]) -> None:
    """Write the matrices (4,4,n), the usual order of MATLAB."""
    savemat(file, {"T_robot": np.moveaxis(poses, 0, 2)})


def _opencv_each(file: Path, poses: Poses, numbers: Float[ndarray, "n k"], _: Sequence[str]) -> None:
    """Write a matrix for each image by cv::FileStorage, as YAML or XML."""
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    storage.write("count", len(poses))
    for k, pose in enumerate(poses):
        storage.write(f"T_base_gripper_{k}", pose)
    storage.release()


def _opencv_rows(file: Path, poses: Poses, numbers: Float[ndarray, "n k"], _: Sequence[str]) -> None:
    """Write one matrix with the rows of numbers by cv::FileStorage."""
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    storage.write("robot_poses", numbers)
    storage.release()


_ROWS = "{0} {1} {2} {3}\n{4} {5} {6} {7}\n{8} {9} {10} {11}\n{12} {13} {14} {15}\n"
"""Matrix in four lines."""
_RTDE = ",".join((*(f"actual_q_{k}" for k in range(6)), *(f"actual_TCP_pose_{k}" for k in range(6))))
_MATRIX_NAMES = ",".join(f"r{row}{column}" for row in range(4) for column in range(4))
_DOUBLE = "mm-deg"

LAYOUTS: tuple[Layout, ...] = (
    # Tables with names of columns.
    Layout(
        name="CSV, image, x … qw",
        rotation="xyzw",
        head="image,x,y,z,qx,qy,qz,qw\n",
        line="{name},{p}",
        names_fix=True,
    ),
    Layout(
        name="CSV above the images, img, w first",
        rotation="wxyz",
        file="robot_log.csv",
        images="run_2/rgb",
        head="img,tx,ty,tz,qw,qx,qy,qz\n",
        line="{name},{p}",
        names_fix=True,
    ),
    Layout(
        name="CSV, Bild, q0 … q3, mm",
        rotation="wxyz",
        units="mm-rad",
        file="ee_poses.csv",
        images="",
        head="Bild,x_mm,y_mm,z_mm,q0,q1,q2,q3\n",
        line="{name},{p}",
    ),
    Layout(
        name="CSV, frame_path, roll pitch yaw, mm, deg",
        rotation="xyz",
        units=_DOUBLE,
        head="frame_path,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n",
        line="images/{name},{p}",
        names_fix=True,
    ),
    Layout(
        name="CSV in order, X Y Z A B C (KUKA), CRLF, BOM",
        rotation="ZYX",
        units=_DOUBLE,
        file="kuka_log.csv",
        encoding="utf-8-sig",
        head="X,Y,Z,A,B,C\r\n",
        line="{p}",
        between="\r\n",
        foot="\r\n\r\n",
        names_fix=True,
        by_key=False,
    ),
    Layout(
        name="TSV, No., X Y Z W P R (Fanuc)",
        rotation="xyz",
        units=_DOUBLE,
        file="fanuc.tsv",
        separator="\t",
        head="No.\tX\tY\tZ\tW\tP\tR\n",
        line="{k}\t{p}",
        names_fix=True,
        by_key=False,
    ),
    Layout(
        name="semicolons, decimal comma, X;Y;Z;RX;RY;RZ (Stäubli)",
        rotation="XYZ",
        units=_DOUBLE,
        file="Posen.csv",
        separator=";",
        comma=True,
        head="Bild;X;Y;Z;RX;RY;RZ\n",
        line="{name};{p}",
    ),
    Layout(
        name="semicolons, decimal comma, Latin-1, X [mm] … Rz [°]",
        rotation="xyz",
        units=_DOUBLE,
        file="Messung.csv",
        encoding="latin-1",
        separator=";",
        comma=True,
        head="sep=;\nNr;X [mm];Y [mm];Z [mm];Rx [°];Ry [°];Rz [°]\n",
        line="{k};{p}",
        by_key=False,
    ),
    Layout(
        name="TSV in UTF-16, X Y Z O A T (Kawasaki)",
        rotation="ZYZ",
        units=_DOUBLE,
        file="points.txt",
        encoding="utf-16",
        separator="\t",
        head="file\tX\tY\tZ\tO\tA\tT\n",
        line="{name}\t{p}",
        names_fix=True,
    ),
    Layout(
        name="CSV, joints and TCP of UR's RTDE",
        rotation="rotvec",
        file="rtde_log.csv",
        head=f"img,{_RTDE}\n",
        line="{name},{j},{p}",
        names_fix=True,
    ),
    Layout(
        name="CSV, board's pose beside the robot's",
        rotation="xyzw",
        head="image,board_x,board_y,board_z,board_rx,board_ry,board_rz,tcp_x,tcp_y,tcp_z,tcp_qx,tcp_qy,tcp_qz,tcp_qw\n",
        line="{name},{b},{p}",
        names_fix=True,
    ),
    Layout(
        name="CSV, 16 columns r00 … r33, inverted",
        rotation="matrix",
        inverted=True,
        file="extrinsics.csv",
        head=f"id,{_MATRIX_NAMES}\n",
        line="{stem},{p}",
    ),
    # Plain numbers and brackets.
    Layout(
        name="text in order, six numbers, m, rad, Rz·Ry·Rx",
        rotation="xyz",
        file="poses.txt",
        images="",
        separator=" ",
        line="{p}",
        by_key=False,
    ),
    Layout(
        name="text in order, ZYZ, mm, deg (Doosan)",
        rotation="ZYZ",
        units=_DOUBLE,
        file="robot/pose_list.txt",
        images="",
        separator=", ",
        line="{p}",
        by_key=False,
    ),
    Layout(
        name="brackets in order, XYZ, mm, deg (Mecademic)",
        rotation="XYZ",
        units=_DOUBLE,
        file="poses.txt",
        separator=", ",
        line="[{p}]",
        by_key=False,
    ),
    Layout(
        name="NumPy's print in order, above the images, rotation vector",
        rotation="rotvec",
        file="tcp_pose.txt",
        images="capture_1/images",
        separator="  ",
        head="[",
        line="[ {p}]",
        between="\n ",
        foot="]\n",
        by_key=False,
    ),
    Layout(
        name="script of UR, movej(p[…])",
        rotation="rotvec",
        file="calib.script",
        head="# viewpoints\n",
        line="movej(p[{p}], a=0.5, v=0.2)",
        separator=", ",
        names_fix=True,
        by_key=False,
    ),
    Layout(
        name="image and p[…] of UR",
        rotation="rotvec",
        file="log.txt",
        separator=", ",
        line="{name} p[{p}]",
        names_fix=True,
    ),
    Layout(
        name="KUKA's {X …, A …} in order",
        rotation="ZYX",
        units=_DOUBLE,
        file="kuka.dat",
        line="{{X {0}, Y {1}, Z {2}, A {3}, B {4}, C {5}}}",
        names_fix=True,
        by_key=False,
    ),
    Layout(
        name="robtargets of ABB in order",
        rotation="wxyz",
        units="mm-rad",
        file="Module1.mod",
        head="MODULE Module1\n",
        line="  CONST robtarget p{k}:=[[{0},{1},{2}],[{3},{4},{5},{6}],[0,0,-1,0],[9E9,9E9,9E9,9E9,9E9,9E9]];",
        foot="\nENDMODULE\n",
        names_fix=True,
        by_key=False,
    ),
    Layout(
        name="image and six numbers, rotation vector, deg, mm",
        rotation="rotvec",
        units=_DOUBLE,
        file="arm_poses.txt",
        separator=" ",
        head="# image position rotation\n",
        line="{name} {p}",
    ),
    Layout(
        name="3x4 by rows, 12 numbers, inverted",
        rotation="3x4",
        inverted=True,
        file="world2cam.txt",
        separator=" ",
        line="{p}",
        by_key=False,
    ),
    Layout(
        name="blocks of four lines, mm",
        rotation="matrix",
        units="mm-rad",
        file="matrices.txt",
        separator=" ",
        line=_ROWS,
        by_key=False,
    ),
    Layout(
        name="image and quaternion w first, no names",
        rotation="wxyz",
        file="poses.txt",
        separator=" ",
        line="{name} {p}",
    ),
    # JSON and YAML.
    Layout(
        name="JSON records, image and posx (Doosan)",
        rotation="ZYZ",
        units=_DOUBLE,
        file="samples.json",
        separator=", ",
        head="[",
        line='{{"image": "{name}", "posj": [{j}], "posx": [{p}]}}',
        between=",\n",
        foot="]\n",
    ),
    Layout(
        name="JSON records, robot_coords beside a board's pose (myCobot)",
        rotation="xyz",
        units=_DOUBLE,
        file="handeye_chessboard.json",
        separator=", ",
        head="[",
        line='{{"file": "{name}", "board_pose": [{b}], "robot_coords": [{p}]}}',
        between=",\n",
        foot="]\n",
    ),
    Layout(
        name="JSON records, O_T_EE by columns and q (Franka)",
        rotation="columns",
        file="states.json",
        separator=", ",
        head='{"frames": [',
        line='{{"rgb": "{name}", "q": [{j}], "O_T_EE": [{p}]}}',
        between=",\n",
        foot="]}\n",
        names_fix=True,
    ),
    Layout(
        name="JSON map by image, mm, rotation vector",
        rotation="rotvec",
        units="mm-rad",
        file="poses.json",
        images="color",
        separator=", ",
        head="{",
        line='"{name}": [{p}]',
        between=",\n",
        foot="}\n",
    ),
    Layout(
        name="JSON for each image, joints and pose_flange (UR)",
        rotation="rotvec",
        file="{stem}.json",
        images="",
        separator=", ",
        line='{{"joints": [{j}], "pose_flange": [{p}]}}',
    ),
    Layout(
        name="text for each image, 4x4",
        rotation="matrix",
        file="poses/{stem}.txt",
        separator=" ",
        line=_ROWS,
        foot="",
        names_fix=True,
    ),
    Layout(
        name="JSON for each image, R and t, mm",
        rotation="matrix",
        units="mm-rad",
        file="poses/{stem}.json",
        line='{{"R": [[{0}, {1}, {2}], [{4}, {5}, {6}], [{8}, {9}, {10}]], "t": [{3}, {7}, {11}]}}',
    ),
    Layout(
        name="YAML map by image, translation and rotation",
        rotation="xyzw",
        file="ee2base.yaml",
        line=(
            '"{name}":\n  translation: {{x: {0}, y: {1}, z: {2}}}\n'
            "  rotation: {{x: {3}, y: {4}, z: {5}, w: {6}}}"
        ),
        names_fix=True,
    ),
    Layout(
        name="YAML for each image, position and quat without order",
        rotation="xyzw",
        file="poses/{stem}.yaml",
        line="position: [{0}, {1}, {2}]\nquat: [{3}, {4}, {5}, {6}]",
    ),
    Layout(
        name="OpenCV's YAML, a matrix for each image",
        rotation="matrix",
        file="robot_poses.yml",
        save=_opencv_each,
        by_key=False,
    ),
    Layout(
        name="OpenCV's XML, rows of Rz·Ry·Rx, mm, deg",
        rotation="xyz",
        units=_DOUBLE,
        file="robot_poses.xml",
        save=_opencv_rows,
        by_key=False,
    ),
    # Arrays.
    Layout(
        name="npy (n,4,4), inverted",
        rotation="matrix",
        inverted=True,
        file="poses.npy",
        save=_npy,
        by_key=False,
    ),
    Layout(
        name="npy (n,6), rotation vector, m",
        rotation="rotvec",
        file="arm/tcp.npy",
        images="",
        save=_npy_rows,
        by_key=False,
    ),
    Layout(
        name="npz of OpenCV's names, mm",
        rotation="matrix",
        units="mm-rad",
        file="handeye.npz",
        save=_npz_opencv,
        names_fix=True,
        by_key=False,
    ),
    Layout(
        name="npz, R_base2gripper",
        rotation="matrix",
        inverted=True,
        file="handeye.npz",
        save=_npz_inverse,
        names_fix=True,
        by_key=False,
    ),
    Layout(name="mat (4,4,n)", rotation="matrix", file="T_robot.mat", save=_mat_stack, by_key=False),
    Layout(
        name="npy (4,4) for each image, mm",
        rotation="matrix",
        units="mm-rad",
        file="poses/{stem}.npy",
        save=_npy_each,
    ),
    # Time stamps.
    Layout(
        name="TUM, images named by ns",
        rotation="xyzw",
        file="trajectory.txt",
        stem="{ns}",
        separator=" ",
        head="# timestamp tx ty tz qx qy qz qw\n",
        line="{s} {p}",
        times_s=(-0.02, 0.0, 0.02),
        names_fix=True,
    ),
    Layout(
        name="ISO times, images named by seconds, pose_position_x …",
        rotation="xyzw",
        file="ee_pose.csv",
        stem="frame_{s}",
        head=(
            "time,pose_position_x,pose_position_y,pose_position_z,"
            "pose_orientation_x,pose_orientation_y,pose_orientation_z,pose_orientation_w\n"
        ),
        line="{iso},{p}",
        times_s=(-0.03, 0.01),
        names_fix=True,
    ),
    Layout(
        name="stamps without names, clock 1 h ahead",
        rotation="xyzw",
        file="odom.txt",
        stem="{ns}",
        separator=" ",
        line="{s} {p}",
        times_s=(3599.98, 3600.02),
        n_min=6,
    ),
)
"""The layouts of the bench `inputs`."""
