"""Valid files of every kind that jcr reads, with their readers: the corpus of the fuzz tests."""

import csv
import io
import json
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

import capture_writers as writers
from jcr.backends import ReconstructOptions
from jcr.calibration.calibrate import calibrate_pose_pairs
from jcr.calibration.difference import read_hand_eye
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import read_calibration, write_calibration
from jcr.capture.added_capture import read_added
from jcr.capture.formats import capture_json
from jcr.capture.formats.lerobot import Info, read_episode
from jcr.capture.images import read_image
from jcr.capture.intrinsics import intrinsics_of_file
from jcr.capture.options import ReadOptions
from jcr.capture.read import read_source
from jcr.capture.urdf_chain import read_chain
from jcr.cli.map_query_export_view import read_points
from jcr.depth.densify import pointmaps_of
from jcr.depth.depth_npz import read_depth, write_depth
from jcr.geometry import inverse
from jcr.live.folder import LiveFolder
from jcr.live.server import sample_pose
from jcr.pointmaps.pair_predictions import pairs_from_arrays, read_arrays
from jcr.records import Attempt, Capture, Intrinsics
from jcr.records.reconstruction_npz import read_reconstruction, write_reconstruction
from jcr.result import RunResult
from jcr.scene.cloud import read_cloud, write_cloud
from jcr.scene.map_file import load_map
from jcr.scene.options import MapOptions
from jcr.segments.segmentation import _read_names
from jcr.sfm.given import read_model
from scenes import NO_TRACKS, capture_of, cloud_of, maps_of, pairs_of, reconstruction_of
from simulation.problems import hand_eye_problem
from simulation.ros_bag import write_bag

SIZE = (16, 12)
COUNT = 4
RUN_IMAGES = 6
FRAMES = ReadOptions(base_frame="base_link", gripper_frame="tool0")
RECORDED = replace(FRAMES, frames=3)
Read = Callable[[Path], object]


def to_json(content: Any) -> str:
    """Return JSON; infinity as a number that is too large for any."""
    return json.dumps(content).replace("Infinity", "1e309")


def to_yaml(content: Any) -> str:
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    return yaml.dump(content, Dumper=dumper, width=10_000_000)


def to_csv(rows: Any) -> str:
    lines = rows if isinstance(rows, list) else [rows]
    return "\n".join(",".join(map(str, line)) if isinstance(line, list) else str(line) for line in lines)


STRUCTURES: dict[str, tuple[Callable[[str], Any], Callable[[Any], str]]] = {
    ".json": (json.loads, to_json), ".yaml": (yaml.safe_load, to_yaml), ".samples": (yaml.safe_load, to_yaml),
    ".csv": (lambda text: list(csv.reader(io.StringIO(text))), to_csv),
}  # fmt: skip
"""Parser and writer of the files whose values are exchanged, by their endings."""


@dataclass(frozen=True)
class Target:
    """Valid file that is changed, and its reader."""

    file: Path
    read: Read

    def feed(self, data: bytes) -> object:
        """Return the content that the reader finds in these bytes."""
        self.file.write_bytes(data)
        return self.read(self.file)


def small_capture(folder: Path, size=SIZE, count: int = COUNT, place: str = "images/") -> Capture:
    """Write tiny images, and poses of a hand-eye problem."""
    (folder / place).mkdir(parents=True)
    draw = np.random.default_rng(0)
    images = tuple(f"{place}{k}.png" for k in range(count))
    for name in images:
        Image.fromarray(draw.integers(0, 255, (*size[::-1], 3), dtype=np.uint8)).save(folder / name)
    centre = (size[0] - 1) / 2, (size[1] - 1) / 2
    intrinsics = Intrinsics(0.94 * size[0], 0.94 * size[0], *centre, *size, (0.01, 0.0, 0.0, 0.0, 0.0))
    poses = hand_eye_problem(np.random.default_rng(0), count).base_from_gripper
    capture = capture_of(poses, folder=folder, images=images, image_size=size, intrinsics=intrinsics)
    capture_json.write(folder, capture)
    return capture


def corpus(folder: Path) -> dict[str, Target]:
    """Return every reader's target, its valid file in a folder of its own below `folder`."""
    capture = small_capture(folder / "images")
    cameras = capture.base_from_gripper @ hand_eye_problem(np.random.default_rng(1), 3).gripper_from_camera
    found = captures(folder, capture, cameras) | recordings(folder / "recordings", capture)
    found |= pictures(folder / "pictures") | results(folder / "results", capture, cameras)
    return found | networks(folder / "networks") | runs(folder, capture)


def source(path: Path, options: ReadOptions = FRAMES) -> Read:
    """Return a function that reads the capture at a path, a recording into a new folder."""

    def read(file: Path) -> object:
        with tempfile.TemporaryDirectory(dir=path.parent) as into:
            return read_source(path, options, into=into)

    return read


def captures(folder: Path, capture: Capture, cameras: np.ndarray) -> dict[str, Target]:
    """Return captures and samples in every format that is no recording."""
    own = small_capture(folder / "capture").folder / "capture.json"
    (own.parent / "arm.urdf").write_text(writers.URDF)
    content = json.loads(own.read_text()) | {"robot": "ur5e", "urdf": "arm.urdf"}
    content["frames"] = [frame | {"joints": [0.1] * 6} for frame in content["frames"]]
    own.write_text(json.dumps(content))
    found = {
        "capture.json": Target(own, capture_json.read),
        "resumed capture.json": Target(own, lambda file: resumed(file.parent)),
        "arm.urdf": Target(own.parent / "arm.urdf", lambda file: read_chain(file, 3)),
    }
    for name, write in writers.CORPUS.items():
        place = folder / name.replace(".", "-")
        write(place, capture)
        found[name] = Target(place / name, source(place))
    table = folder / "poses-csv"
    found["camera_info.yaml"] = Target(
        table / "camera_info.yaml", lambda file: intrinsics_of_file(file, SIZE)
    )
    samples = {"samples.yaml": writers.write_moveit, "wrist.samples": writers.write_easy_handeye2}
    for name, write in samples.items():
        file = write(folder / name.replace(".", "-"), capture.base_from_gripper, cameras)
        found[name] = Target(file, source(file))
    place = folder / "colmap"
    writers.write_colmap(place, capture, cameras)
    found["cameras.bin"] = Target(
        place / "sparse" / "0" / "cameras.bin", lambda file: read_model(file.parent)
    )
    (folder / "sample.json").write_text(json.dumps({"base_from_gripper": np.eye(4).tolist()}))
    found["sample.json"] = Target(folder / "sample.json", lambda file: sample_pose(file.read_bytes()))
    return found


def resumed(folder: Path) -> object:
    """Resume a live capture and add an image."""
    return LiveFolder(folder).add(np.full((SIZE[1], SIZE[0], 3), 7, np.uint8), np.eye(4))


def pictures(folder: Path) -> dict[str, Target]:
    """Return an image in each format that cameras write."""
    folder.mkdir()
    pixels = np.random.default_rng(2).integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    names = [f"picture.{ending}" for ending in ("png", "jpg", "tif", "bmp", "webp", "gif")]
    for name in names:
        Image.fromarray(pixels).save(folder / name)
    return {name: Target(folder / name, read_image) for name in names}


def recordings(folder: Path, capture: Capture) -> dict[str, Target]:
    """Return data that robots record."""
    pixels = [np.asarray(Image.open(capture.folder / name).convert("RGB")) for name in capture.images]
    states = np.repeat(writers.rows_as("rpy", capture.base_from_gripper), 3, axis=0)
    episode = [image for image in pixels for _ in range(3)], states
    names, found = ["x", "y", "z", "roll", "pitch", "yaw"], dict[str, Target]()
    for version in ("v2.1", "v3.0"):
        key = "observation.state"
        place = writers.write_lerobot(folder / version, [episode], version, key, names, codec=None)
        found[f"info.json {version}"] = Target(place / "meta/info.json", source(place, RECORDED))
    place = folder / "v2.1"
    info = Info.model_validate_json((place / "meta/info.json").read_text())
    camera = "observation.images.wrist"
    found["episode.parquet"] = Target(
        place / "data/chunk-000/episode_000000.parquet",
        lambda file: read_episode(place, info, camera, "observation.state", 0),
    )
    kinds = ("mcap", "scan.mcap", "scan"), ("ros1", "scan.bag", "scan.bag"), ("sqlite3", "metadata.yaml", "s")
    for kind, name, bag in kinds:
        file = write_bag(folder / bag, capture, kind, 2.0, fps=4.0, tf_hz=10.0)
        inside = next(file.glob(f"*{Path(name).suffix}")) if file.is_dir() else file
        found[name] = Target(inside, source(file if kind == "sqlite3" else inside, RECORDED))
    return found


def results(folder: Path, capture: Capture, cameras: np.ndarray) -> dict[str, Target]:
    """Return the files of a run folder that are read again."""
    from jcr.scene.build import build_scene

    folder.mkdir()
    draw, shape = np.random.default_rng(3), (COUNT, SIZE[1], SIZE[0])
    assert capture.intrinsics is not None
    seen = {"x_px": draw.random((2, 2)), "points_in_recon": draw.random((2, 3))}
    reconstruction = reconstruction_of(
        cameras,
        intrinsics=capture.intrinsics,
        pointmaps=maps_of(draw.random((*shape, 3)).astype(np.float32), capture.intrinsics),
        tracks=replace(NO_TRACKS, image=np.zeros(2, int), point=np.arange(2), **seen),
    )
    write_reconstruction(folder / "reconstruction.npz", reconstruction)
    layers = [np.full(shape, 0.01, np.float16), np.ones(shape, np.float16), np.ones(shape, np.uint8)]
    depth, colors = draw.uniform(0.5, 1.0, shape).astype(np.float32), np.zeros((*shape, 3), np.uint8)
    dense = pointmaps_of(depth, *layers, colors, cameras, capture.intrinsics)
    write_depth(folder / "depth.npz", replace(reconstruction, pointmaps=dense))
    labels = {"label": np.ones(200, int), "label_names": ("none", "cup")}
    cloud = cloud_of(draw.random((200, 3)), camera_centers_in_base=inverse(cameras)[:, :3, 3], **labels)
    write_cloud(folder / "cloud.ply", cloud)
    (folder / "points.csv").write_text("x,y,z\n0.1,0.2,0.3\n")
    np.save(folder / "points.npy", draw.random((4, 3)))
    build_scene(cloud, MapOptions(cell=0.2, max_seconds=0.1)).save(folder / "map.safetensors")
    readers: dict[str, Read] = {
        "reconstruction.npz": read_reconstruction,
        "depth.npz": lambda path: read_depth(path, reconstruction, None), "cloud.ply": read_cloud,
        "map.safetensors": load_map, "points.csv": read_points, "points.npy": read_points,
    }  # fmt: skip
    with np.load(folder / "reconstruction.npz") as stored:
        arrays = dict(stored)
    (folder / "about.json").write_text(str(arrays.pop("about")))

    def read_about(file: Path) -> object:
        """Read a reconstruction whose JSON is that of a file."""
        about = np.array(file.read_text(errors="replace"))
        np.savez(folder / "about.npz", about=about, allow_pickle=False, **arrays)
        return read_reconstruction(folder / "about.npz")

    readers["about.json"] = read_about
    return {name: Target(folder / name, read) for name, read in readers.items()}


def networks(folder: Path) -> dict[str, Target]:
    """Return predictions and weights of networks."""
    import torch
    from safetensors.torch import save_file

    from jcr.hub import Weights
    from jcr.pointmaps.dust3r.dust3r import load_weights

    folder.mkdir()
    shape = (2, 4, 4)
    arrays = {name: np.zeros((*shape, 3), np.float32) for name in ("pts3d", "pts3d_in_other_view")}
    arrays |= {name: np.ones(shape, np.float32) for name in ("conf", "conf2")}
    np.savez(folder / "pairs.npz", edges=np.array([[0, 1], [1, 0]]), allow_pickle=False, **arrays)
    save_file({"weight": torch.zeros(4)}, folder / "model.safetensors")
    (folder / "config.json").write_text("{}")
    readers: dict[str, Read] = {
        "pairs.npz": lambda file: pairs_from_arrays(read_arrays(file), file.name),
        "model.safetensors": lambda file: load_weights(Weights(file, file.name, "unknown")),
    }
    return {name: Target(folder / name, read) for name, read in readers.items()}


def runs(folder: Path, capture: Capture) -> dict[str, Target]:
    """Return the JSON files of runs."""
    run = sound_run(folder / "run")
    added = folder / "with_added" / "added"
    added.mkdir(parents=True)
    (added / "000.png").write_bytes((capture.folder / capture.images[0]).read_bytes())
    frames = [{"image": "000.png", "base_from_gripper": np.eye(4).tolist()}]
    owner = {"added_to": str(capture.folder.resolve()), "frames": frames}
    (added / "capture.json").write_text(json.dumps(owner))
    reference = {"gripper_from_camera": np.eye(4).tolist(), "uncertainty": {"covariance": np.eye(7).tolist()}}
    (folder / "reference.json").write_text(json.dumps(reference))
    (folder / "names.json").write_text(json.dumps({"1": "mug", "2": "box"}))
    readers: dict[str, tuple[Path, Read]] = {
        "calibration.json": (run / "calibration.json", lambda file: RunResult(run).calibration),
        "compared calibration.json": (run / "calibration.json", lambda file: read_hand_eye(run)),
        "run.json": (run / "run.json", lambda file: RunResult(run).capture),
        "reference.json": (folder / "reference.json", read_hand_eye),
        "added/capture.json": (added / "capture.json", lambda file: read_added(added.parent, capture)),
        "names.json": (folder / "names.json", _read_names),
    }
    return {name: Target(file, read) for name, (file, read) in readers.items()}


def sound_run(out: Path) -> Path:
    """Write a run folder with calibration.json and run.json, of poses without noise; its capture lies in it."""
    capture = small_capture(out / "capture", (96, 72), RUN_IMAGES, "")
    problem = hand_eye_problem(np.random.default_rng(0), RUN_IMAGES)
    pairs = pairs_of(problem.base_from_gripper, problem.recon_from_camera, images=capture.images)
    seconds = {"reconstruct_s": 1.0, "calibrate_s": 0.5}
    attempt = Attempt(backend="colmap", images_registered=RUN_IMAGES, why_not=None, **seconds)
    content = replace(calibrate_pose_pairs(pairs), attempts=(attempt,)).as_json()
    intrinsics = {"fx": 90.0, "fy": 90.0, "cx": 47.5, "cy": 35.5, "distortion": [0.0] * 5}
    intrinsics |= {"width": 96, "height": 72}
    (out / "calibration.json").write_text(json.dumps(content | {"intrinsics": intrinsics}))
    write_calibration(out / "calibration.json", read_calibration(out))
    options = {"reconstruct": asdict(ReconstructOptions()), "calibrate": asdict(CalibrateOptions())}
    options["calibrate"] |= {"robot_noise": [0.1, 0.05]}
    state = {"capture": str(out / "capture"), "made": {"reconstruct": "0"}, "options": options}
    state |= {"attempts": [asdict(attempt)]}
    (out / "run.json").write_text(json.dumps(state))
    return out
