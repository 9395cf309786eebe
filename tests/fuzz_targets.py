"""What hostile bytes are fed to: every reader, with a valid file of its format to start from."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

import capture_writers as writers
from jcr.calibration.known_transform import read_hand_eye
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.poses import calibrate_poses
from jcr.calibration.record import (
    calibration_of,
    read_calibration,
    write_calibration,
)
from jcr.capture.camera_info import read_camera_info
from jcr.capture.formats import capture_json
from jcr.capture.formats.lerobot import Info, read_episode
from jcr.capture.images import read_image
from jcr.capture.options import ReadOptions
from jcr.capture.read import read_source
from jcr.cli.query import read_points
from jcr.depth.dense import pointmaps_of
from jcr.depth.depth_npz import read_depth, write_depth
from jcr.geometry import inverse
from jcr.pointmaps.pairs import pairs_from_arrays, read_arrays
from jcr.reconstruct import ReconstructOptions
from jcr.reconstruction_npz import read_reconstruction, write_reconstruction
from jcr.records import (
    Attempt,
    Capture,
    Intrinsics,
    PointCloud,
    Pointmaps,
    PosePairs,
    Reconstruction,
    Tracks,
)
from jcr.scene.cloud_ply import read_cloud, write_cloud
from jcr.scene.map_file import load_map
from jcr.scene.options import MapOptions
from simulation.problems import hand_eye_problem
from simulation.ros_bag import write_bag

SIZE = (16, 12)
COUNT = 4
RUN_IMAGES = 6
NAMES = ReadOptions(base_frame="base_link", gripper_frame="tool0", frames=3)


@dataclass(frozen=True)
class Target:
    """A file that is changed, and who reads it."""

    file: Path
    """Valid as it is."""
    read: Callable[[Path], object]
    """Of that file."""

    def feed(self, data: bytes) -> object:
        """What the reader makes of these bytes."""
        self.file.write_bytes(data)
        return self.read(self.file)


def small_capture(folder: Path) -> Capture:
    """Four tiny images, and poses of a hand-eye problem."""
    (folder / "images").mkdir(parents=True)
    draw = np.random.default_rng(0)
    images = tuple(f"images/{k}.png" for k in range(COUNT))
    for name in images:
        Image.fromarray(draw.integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)).save(folder / name)
    poses = hand_eye_problem(draw, COUNT).base_from_gripper
    intrinsics = Intrinsics(15.0, 15.0, 7.5, 5.5, *SIZE, (0.01, 0.0, 0.0, 0.0, 0.0))
    capture = Capture(
        folder=folder, images=images, base_from_gripper=poses, image_size=SIZE, intrinsics=intrinsics
    )
    capture_json.write(folder, capture)
    return capture


def targets(folder: Path) -> dict[str, Target]:
    """Every reader's target, its valid file in a folder of its own below `folder`."""
    found: dict[str, Target] = {}
    capture = small_capture(folder / "capture")
    cameras = capture.base_from_gripper @ hand_eye_problem(np.random.default_rng(1), 3).gripper_from_camera

    def whole(path: Path) -> Callable[[Path], object]:
        return lambda file: read_source(path, NAMES, into=path.parent / "frames")

    found["capture.json"] = Target(folder / "capture" / "capture.json", capture_json.read)
    for name, write in writers.CORPUS.items():
        place = folder / name.replace(".", "-")
        write(place, capture)
        found[name] = Target(place / name, whole(place))
    for name, write in (
        ("samples.yaml", writers.write_moveit),
        ("wrist.samples", writers.write_easy_handeye2),
    ):
        place = folder / name.replace(".", "-")
        write(place, capture.base_from_gripper, cameras)
        found[name] = Target(place / name, whole(place / name))
    place = folder / "camera_info"
    place.mkdir()
    writers.write_camera_info(capture, place)
    found["camera_info.yaml"] = Target(place / "camera_info.yaml", lambda file: read_camera_info(file, SIZE))
    found |= images(folder / "pictures") | results(folder / "results", capture, cameras)
    found |= networks(folder / "networks") | recordings(folder / "recordings", capture)
    place = folder / "colmap"
    writers.write_colmap(place, capture, cameras)
    for name in ("cameras.bin", "images.bin"):
        found[name] = Target(place / "sparse" / "0" / name, whole(place))
    return found


def images(folder: Path) -> dict[str, Target]:
    """An image in each format that cameras write."""
    folder.mkdir()
    pixels = np.random.default_rng(2).integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    names = [f"picture.{ending}" for ending in ("png", "jpg", "tif", "bmp", "webp", "gif")]
    for name in names:
        Image.fromarray(pixels).save(folder / name)
    return {name: Target(folder / name, read_image) for name in names}


def results(folder: Path, capture: Capture, cameras: np.ndarray) -> dict[str, Target]:
    """The files of a run folder that are read again."""
    from jcr.scene.build import build_scene

    folder.mkdir()
    draw = np.random.default_rng(3)
    pairs = PosePairs(
        source=capture.folder,
        images=capture.images,
        base_from_gripper=capture.base_from_gripper,
        recon_from_camera=cameras,
        is_metric=True,
    )
    found = calibration_of(pairs, pairs, calibrate_poses(pairs), {}, "0")
    write_calibration(folder / "calibration.json", found)
    height, width = SIZE[1], SIZE[0]
    tracks = Tracks(
        image=np.zeros(2, int),
        x_px=draw.random((2, 2)),
        point=np.arange(2),
        points_in_recon=draw.random((2, 3)),
    )
    assert capture.intrinsics is not None
    reconstruction = Reconstruction(
        image_index=np.arange(COUNT),
        recon_from_camera=cameras,
        intrinsics=capture.intrinsics,
        pointmaps=Pointmaps(
            intrinsics=capture.intrinsics,
            points_in_recon=draw.random((COUNT, height, width, 3)).astype(np.float32),
            confidence=np.ones((COUNT, height, width), np.float32),
            colors=np.zeros((COUNT, height, width, 3), np.uint8),
        ),
        tracks=tracks,
        backend="colmap",
    )
    write_reconstruction(folder / "reconstruction.npz", reconstruction)
    dense = pointmaps_of(
        draw.uniform(0.5, 1.0, (COUNT, height, width)).astype(np.float32),
        np.full((COUNT, height, width), 0.01, np.float16),
        np.ones((COUNT, height, width), np.float16),
        np.ones((COUNT, height, width), np.uint8),
        np.zeros((COUNT, height, width, 3), np.uint8),
        cameras,
        capture.intrinsics,
    )
    write_depth(folder / "depth.npz", replace(reconstruction, pointmaps=dense), "y")
    ones = np.ones(200)
    cloud = PointCloud(
        points_in_base=draw.random((200, 3)),
        color=np.zeros((200, 3), np.uint8),
        confidence=ones,
        margin=ones,
        label=ones.astype(int),
        image=np.zeros(200, int),
        camera_centers_in_base=inverse(cameras)[:, :3, 3],
        label_names=("none", "cup"),
    )
    write_cloud(folder / "cloud.ply", cloud)
    (folder / "run.json").write_text(json.dumps({"capture": "x", "reconstruct": "y", "options": {}}))
    (folder / "reference.json").write_text(
        json.dumps({"gripper_from_camera": capture.base_from_gripper[0].tolist()})
    )
    (folder / "points.csv").write_text("x,y,z\n0.1,0.2,0.3\n")
    np.save(folder / "points.npy", draw.random((4, 3)))
    write_cloud(folder / "points.ply", cloud)
    build_scene(cloud, MapOptions(cell=0.2, max_seconds=0.1)).save(folder / "map.safetensors")
    readers: dict[str, Callable[[Path], object]] = {
        "calibration.json": read_calibration,
        "reconstruction.npz": read_reconstruction,
        "depth.npz": lambda path: read_depth(path, reconstruction, None),
        "cloud.ply": read_cloud,
        "map.safetensors": load_map,
        "reference.json": read_hand_eye,
        "points.csv": read_points,
        "points.npy": read_points,
        "points.ply": read_points,
    }
    return {name: Target(folder / name, read) for name, read in readers.items()}


def networks(folder: Path) -> dict[str, Target]:
    """What networks leave, or are."""
    import torch

    from jcr.hub import Weights
    from jcr.pointmaps.dust3r.weights import load_weights

    folder.mkdir()
    shape = (2, 4, 4)
    arrays = {name: np.zeros((*shape, 3), np.float32) for name in ("pts3d", "pts3d_in_other_view")}
    arrays |= {name: np.ones(shape, np.float32) for name in ("conf", "conf2")}
    np.savez(folder / "pairs.npz", edges=np.array([[0, 1], [1, 0]]), allow_pickle=False, **arrays)
    torch.save({"model": {"weight": torch.zeros(4)}}, folder / "weights.pth")
    return {
        "pairs.npz": Target(
            folder / "pairs.npz", lambda file: pairs_from_arrays(read_arrays(file), file.name)
        ),
        "weights.pth": Target(
            folder / "weights.pth", lambda file: load_weights(Weights(file, file.name, "unknown"))
        ),
    }


def recordings(folder: Path, capture: Capture) -> dict[str, Target]:
    """Data that robots record."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    (folder / "set" / "data").mkdir(parents=True)
    table = folder / "set" / "data" / "0.parquet"
    columns = {
        "timestamp": [0.0, 0.1],
        "episode_index": [0, 0],
        "frame_index": [0, 1],
        "state": [[0.0, 1.0], [2.0, 3.0]],
    }
    pq.write_table(pa.table(columns), table)
    info = {"codebase_version": "v2.1", "total_episodes": 1, "data_path": "data/0.parquet"}
    info |= {"video_path": "videos/0.mp4", "fps": 10, "features": {"state": {"shape": [2]}}}
    info["features"]["wrist"] = {"dtype": "video"}
    found = {
        "episode.parquet": Target(
            table, lambda file: read_episode(folder / "set", Info.model_validate(info), "wrist", "state", 0)
        )
    }
    for kind, name, bag in (("mcap", "scan.mcap", "scan"), ("ros1", "scan.bag", "scan.bag")):
        file = write_bag(folder / bag, capture, kind, 2.0, fps=4.0, tf_hz=10.0)
        file = next(file.glob("*.mcap")) if file.is_dir() else file
        found[name] = Target(file, lambda file: read_source(file, NAMES, into=file.parent / "frames"))
    return found


def sound_run(out: Path) -> Path:
    """A run folder with calibration.json and run.json, of poses without noise; its capture lies in it."""
    (out / "capture").mkdir(parents=True)
    problem = hand_eye_problem(np.random.default_rng(0), RUN_IMAGES)
    names = tuple(f"{k}.png" for k in range(RUN_IMAGES))
    frames = []
    for name, pose in zip(names, problem.base_from_gripper, strict=True):
        Image.fromarray(np.random.default_rng(len(frames)).integers(0, 255, (72, 96, 3), np.uint8)).save(
            out / "capture" / name
        )
        frames.append({"image": name, "base_from_gripper": pose.tolist()})
    (out / "capture" / "capture.json").write_text(json.dumps({"frames": frames}))
    pairs = PosePairs(
        source=out,
        images=names,
        base_from_gripper=problem.base_from_gripper,
        recon_from_camera=problem.recon_from_camera,
        is_metric=False,
    )
    attempt = Attempt(
        backend="colmap", images_registered=RUN_IMAGES, reconstruct_s=1.0, calibrate_s=0.5, why_not=None
    )
    content = calibration_of(pairs, pairs, calibrate_poses(pairs), {}, "0", [attempt]).as_json()
    intrinsics = {
        "fx": 90.0,
        "fy": 90.0,
        "cx": 47.5,
        "cy": 35.5,
        "distortion": [0.0] * 5,
        "width": 96,
        "height": 72,
    }
    (out / "calibration.json").write_text(json.dumps(content | {"intrinsics": intrinsics}))
    write_calibration(out / "calibration.json", read_calibration(out))
    options = {"reconstruct": asdict(ReconstructOptions()), "calibrate": asdict(CalibrateOptions())}
    options["calibrate"] |= {"robot_noise": [0.1, 0.05], "known_length": ["0.png", 1.0, 2.0, 30.0, 4.0, 50.0]}
    state = {
        "capture": str(out / "capture"),
        "reconstruct": "0",
        "options": options,
        "attempts": [asdict(attempt)],
    }
    (out / "run.json").write_text(json.dumps(state))
    return out
