"""One capture written in every format that jcr reads: the mirror of src/jcr/capture."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from jcr.capture.images import encode_png
from jcr.capture.urdf_chain import read_chain
from jcr.estimation.kinematics import forward_kinematics
from jcr.geometry import inverse
from jcr.records import Capture

HALF_PIXEL = 0.5


def rows_as(convention: str, poses: np.ndarray) -> np.ndarray:
    """Poses (n,4,4) as the rows of numbers that a controller writes; written apart from the reader's table."""
    position, rotation = poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3])
    if convention == "abb":
        return np.hstack([1e3 * position, rotation.as_quat()[:, [3, 0, 1, 2]]])
    turned = {
        "quat:xyzw": rotation.as_quat, "rotvec": rotation.as_rotvec, "ur": rotation.as_rotvec,
        "rpy": lambda: rotation.as_euler("ZYX")[:, ::-1],
    }  # fmt: skip
    return np.hstack([position, turned[convention]()])


def begin(folder: Path, capture: Capture) -> Path:
    """Write the images and a camera_info.yaml with the intrinsics."""
    for name in capture.images:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(capture.folder / name, folder / name)
    write_camera_info(capture, folder)
    return folder


def write_camera_info(capture: Capture, folder: Path) -> None:
    intrinsics = capture.intrinsics
    content = {
        "image_width": intrinsics.width, "image_height": intrinsics.height, "camera_name": "wrist",
        "camera_matrix": {"rows": 3, "cols": 3, "data": intrinsics.matrix.ravel().tolist()},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": list(intrinsics.distortion)},
    }  # fmt: skip
    (folder / "camera_info.yaml").write_text(yaml.safe_dump(content))


def write_table(folder: Path, capture: Capture) -> Path:
    """poses.csv with the images' names in front."""
    begin(folder, capture)
    rows = rows_as("quat:xyzw", capture.base_from_gripper).tolist()
    named = zip(capture.images, rows, strict=True)
    lines = ["image,x,y,z,qx,qy,qz,qw", *(",".join([name, *map(repr, row)]) for name, row in named)]
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    return folder / "poses.csv"


def write_npy(folder: Path, capture: Capture) -> Path:
    np.save(begin(folder, capture) / "poses.npy", capture.base_from_gripper)
    return folder


def write_tum(folder: Path, capture: Capture, start: int = 1_700_000_000_123_456_789) -> Path:
    """Write a trajectory beside images that are named by their time stamps (ns), half-way between samples.

    The gripper stands at each image's pose from one sample to the next.
    """
    (folder / "images").mkdir(parents=True, exist_ok=True)
    write_camera_info(capture, folder)
    lines, rows = list[str](), rows_as("quat:xyzw", capture.base_from_gripper).tolist()
    for k, (name, row) in enumerate(zip(capture.images, rows, strict=True)):
        stamp = start + k * 10**9
        shutil.copy(capture.folder / name, folder / "images" / f"{stamp}{Path(name).suffix}")
        for at in (stamp - 10**7, stamp + 10**7):
            lines.append(" ".join([f"{at // 10**9}.{at % 10**9:09d}", *map(repr, row)]))
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")
    return folder


def write_colmap(folder: Path, capture: Capture, recon_from_camera: np.ndarray) -> Path:
    """Write a model without points in sparse/0, its images in images/, and a table with their names."""
    import pycolmap

    write_table(folder, capture)
    (folder / "camera_info.yaml").unlink()
    intrinsics = capture.intrinsics
    centre = intrinsics.cx + HALF_PIXEL, intrinsics.cy + HALF_PIXEL
    params = [intrinsics.fx, intrinsics.fy, *centre, *intrinsics.distortion, 0, 0, 0]
    model = pycolmap.Reconstruction()
    width, height = capture.image_size
    camera = pycolmap.Camera(model="FULL_OPENCV", width=width, height=height, params=params, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for k, pose in enumerate(inverse(recon_from_camera), start=1):
        image = pycolmap.Image(name=Path(capture.images[k - 1]).name, camera_id=1, image_id=k)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write(folder / "sparse" / "0")
    return folder


def write_moveit(folder: Path, base_from_gripper: np.ndarray, recon_from_camera: np.ndarray) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    samples = [
        {"effector_wrt_world": gripper.ravel().tolist(), "object_wrt_sensor": marker.ravel().tolist()}
        for gripper, marker in zip(base_from_gripper, inverse(recon_from_camera), strict=True)
    ]
    (folder / "samples.yaml").write_text(yaml.safe_dump(samples))
    return folder / "samples.yaml"


def write_easy_handeye2(
    folder: Path, base_from_gripper: np.ndarray, recon_from_camera: np.ndarray, kind: str = "eye_in_hand"
) -> Path:
    folder.mkdir(parents=True, exist_ok=True)

    def parts(poses: np.ndarray) -> list[dict]:
        return [
            {
                "translation": dict(zip("xyz", row[:3], strict=True)),
                "rotation": dict(zip("xyzw", row[3:], strict=True)),
            }
            for row in rows_as("quat:xyzw", poses).tolist()
        ]

    pairs = zip(parts(base_from_gripper), parts(inverse(recon_from_camera)), strict=True)
    samples = [{"robot": gripper, "tracking": marker} for gripper, marker in pairs]
    content = {"parameters": {"name": "", "calibration_type": kind}, "samples": samples}
    (folder / "wrist.samples").write_text(yaml.safe_dump(content))
    return folder / "wrist.samples"


def write_list(folder: Path, capture: Capture) -> Path:
    """poses.json with named images."""
    begin(folder, capture)
    keys, rows = ("x", "y", "z", "qx", "qy", "qz", "qw"), rows_as("quat:xyzw", capture.base_from_gripper)
    named = zip(capture.images, rows.tolist(), strict=True)
    poses = [{"image": name, "pose": dict(zip(keys, row, strict=True))} for name, row in named]
    (folder / "poses.json").write_text(json.dumps({"poses": poses}))
    return folder


CORPUS: dict[str, Callable[[Path, Capture], Path]] = {
    "poses.csv": write_table, "poses.npy": write_npy, "poses.txt": write_tum, "poses.json": write_list,
}  # fmt: skip
"""Writers of each kind of file of poses, with the images beside it."""


LIMIT = '<limit lower="-3" upper="3" effort="1" velocity="1"/>'
URDF = f"""<robot name="arm">
  <link name="base_link"/><link name="upper"/><link name="fore"/><link name="hand"/><link name="tool0"/>
  <link name="finger"/>
  <joint name="pan" type="revolute"><parent link="base_link"/><child link="upper"/>
    <origin xyz="0 0 0.2"/><axis xyz="0 0 1"/>{LIMIT}</joint>
  <joint name="lift" type="revolute"><parent link="upper"/><child link="fore"/>
    <origin xyz="0.1 0 0.1" rpy="0.1 0 0"/><axis xyz="0 1 0"/>{LIMIT}</joint>
  <joint name="roll" type="revolute"><parent link="fore"/><child link="hand"/>
    <origin xyz="0.3 0 0"/><axis xyz="1 0 0"/>{LIMIT}</joint>
  <joint name="flange" type="fixed"><parent link="hand"/><child link="tool0"/><origin xyz="0.1 0 0"/></joint>
  <joint name="grip" type="prismatic"><parent link="hand"/><child link="finger"/><axis xyz="0 1 0"/>{LIMIT}</joint>
</robot>
"""


def arm_poses(angles: np.ndarray) -> np.ndarray:
    """base_link from tool0 of that URDF for (pan, lift, roll) in radians, by hand."""

    def about(axis: str, angle: np.ndarray, offset: tuple[float, float, float]) -> np.ndarray:
        poses = np.tile(np.eye(4), (len(angle), 1, 1))
        poses[:, :3, :3] = Rotation.from_euler(axis, angle[:, None]).as_matrix()
        poses[:, :3, 3] = offset
        return poses

    tilt = about("x", np.full(len(angles), 0.1), (0.1, 0, 0.1))
    tool = about("x", np.zeros(len(angles)), (0.1, 0, 0))
    lift = tilt @ about("y", angles[:, 1], (0, 0, 0))
    return about("z", angles[:, 0], (0, 0, 0.2)) @ lift @ about("x", angles[:, 2], (0.3, 0, 0)) @ tool


def assert_joints(capture: Capture, angles: np.ndarray) -> None:
    """Write these joint angles, in any order, and the URDF that explains the poses into a capture."""
    assert capture.joints is not None and capture.urdf == capture.folder / "robot.urdf"
    order, expected = np.argsort(capture.joints[:, 0]), np.argsort(angles[:, 0])
    np.testing.assert_allclose(capture.joints[order], angles[expected], atol=1e-6)
    hand = forward_kinematics(read_chain(capture.urdf, 3), capture.joints)
    tool = inverse(hand) @ capture.base_from_gripper
    np.testing.assert_allclose(tool, np.broadcast_to(tool[0], tool.shape), atol=1e-6)


def write_video(file: Path, images: list[np.ndarray], fps: int, codec: str) -> None:
    import av

    file.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(file), "w") as container:
        stream = container.add_stream(codec, rate=fps)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "20", "g": "10"} | ({"preset": "12"} if "av1" in codec else {"bf": "2"})
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def write_lerobot(
    folder: Path,
    episodes: list[tuple[list[np.ndarray], np.ndarray]],
    version: str,
    key: str,
    names: list[str],
    fps: int = 10,
    codec: str | None = "libsvtav1",
) -> Path:
    """Write a data set of episodes (images, states) with one camera; v3.0 keeps them all in one table and video.

    Without a codec the images are in the table, as PNG files.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    camera, v3 = "observation.images.wrist", version.startswith("v3")
    shape, axes = [*episodes[0][0][0].shape], ["height", "width", "channels"]
    features = {
        camera: {"dtype": "video" if codec else "image", "shape": shape, "names": axes},
        key: {"dtype": "float32", "shape": [len(names)], "names": {"axes": names}},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    paths = {
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    }
    if v3:
        paths = {
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        }
    info = {"codebase_version": version, "robot_type": "arm", "fps": fps, "features": features} | paths
    info |= {"total_episodes": len(episodes), "chunks_size": 1000}
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))

    def table(group: list[int]) -> pa.Table:
        counts = [len(episodes[k][1]) for k in group]
        columns = {
            key: pa.array(np.concatenate([episodes[k][1] for k in group]).tolist(), pa.list_(pa.float64())),
            "timestamp": np.concatenate([np.arange(count) / fps for count in counts]),
            "episode_index": np.repeat(group, counts),
            "frame_index": np.concatenate([np.arange(count) for count in counts]),
        }
        if codec is None:
            images = [image for k in group for image in episodes[k][0]]
            columns[camera] = [{"bytes": encode_png(image), "path": "x.png"} for image in images]
        return pa.table(columns)

    def save(content: pa.Table, file: Path) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(content, file)

    every = list(range(len(episodes)))
    for number, group in enumerate([every] if v3 else [[k] for k in every]):
        fields = dict.fromkeys(("chunk_index", "file_index", "episode_chunk"), 0)
        fields |= {"episode_index": number, "video_key": camera}
        save(table(group), folder / paths["data_path"].format(**fields))
        if codec:
            images = [image for k in group for image in episodes[k][0]]
            write_video(folder / paths["video_path"].format(**fields), images, fps, codec)
    if v3:
        zeros = [0] * len(episodes)
        columns = {"episode_index": every, "data/chunk_index": zeros, "data/file_index": zeros}
        if codec:
            columns |= {f"videos/{camera}/{name}": zeros for name in ("chunk_index", "file_index")}
            starts = np.cumsum([0, *(len(images) for images, _ in episodes)])[:-1] / fps
            columns[f"videos/{camera}/from_timestamp"] = starts
        save(pa.table(columns), folder / "meta/episodes/chunk-000/file-000.parquet")
    return folder
