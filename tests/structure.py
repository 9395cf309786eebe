"""What structural fuzz is made of: every structured file that jcr reads, its values exchanged for others in turn.

What may be a document, and how reading it ends; tests/fuzz has what tries them.
"""

import json
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from PIL import Image

import capture_writers as writers
from fuzz_targets import NAMES, SIZE, small_capture, sound_run
from jcr.calibration.known_transform import read_hand_eye
from jcr.capture.added import read_added
from jcr.capture.camera_info import read_camera_info
from jcr.capture.formats import capture_json
from jcr.capture.options import ReadOptions
from jcr.capture.read import read_source
from jcr.capture.urdf_chain import read_chain
from jcr.errors import InputError, RejectedError
from jcr.live.folder import LiveFolder
from jcr.live.server import sample_pose
from jcr.reconstruction_npz import read_reconstruction, write_reconstruction
from jcr.records import Capture
from jcr.run_folder import RunFolder
from jcr.segments.labels import _read_names
from simulation.problems import hand_eye_problem
from simulation.ros_bag import write_bag

TOO_LONG_S = 5.0
VALUES = {
    "null": None,
    "-1": -1,
    "0": 0,
    "1e309": float("inf"),
    "empty text": "",
    "list": [],
    "object": {},
    "text of 10⁶": "x" * 1_000_000,
}
"""What takes a value's place; infinity is written as 1e309, which JSON has no other word for."""
Place = tuple[str | int, ...]


@dataclass(frozen=True)
class Document:
    """A structured file, and who reads it."""

    content: Any
    write: Callable[[Any], object]
    """Put content where `read` finds it."""
    read: Callable[[], object]


def places(content: object, place: Place = ()) -> Iterator[Place]:
    """Every place of a value, of each list the first and the last."""
    if place:
        yield place
    if isinstance(content, dict):
        for key, value in content.items():
            yield from places(value, (*place, key))
    if isinstance(content, list) and content:
        for k in sorted({0, len(content) - 1}):
            yield from places(content[k], (*place, k))


def exchanged(content: Any, place: Place, value: object) -> Any:
    """A copy of the content with another value at a place."""
    if not place:
        return value
    copy = dict(content) if isinstance(content, dict) else list(content)
    copy[place[0]] = exchanged(content[place[0]], place[1:], value)
    return copy


def tried(document: Document, place: Place, value: object) -> tuple[str, float]:
    """How reading ends: `read`, `status 2` or `3`, or the exception that would be status 1; and the seconds."""
    document.write(exchanged(document.content, place, value))
    start = time.process_time()  # of a busy machine the clock tells nothing
    try:
        document.read()
        ended = "read"
    except InputError as error:
        ended = (
            "status 2" if "\0" not in str(error) and "Traceback" not in str(error) else "unreadable message"
        )
    except RejectedError:
        ended = "status 3"
    except Exception as error:  # what a user would see as a traceback
        ended = f"status 1: {type(error).__name__}: {str(error)[:200]}"
    return ended, time.process_time() - start


def as_json(file: Path, content: Any) -> None:
    """Write JSON; infinity as a number that is too large for any."""
    file.write_text(json.dumps(content).replace("Infinity", "1e309"))


def as_yaml(file: Path, content: Any) -> None:
    """Write YAML."""
    file.write_text(
        yaml.dump(content, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper), width=10_000_000)
    )


def xml_content(element: ElementTree.Element) -> dict[str, Any]:
    """Attributes and children of an XML element."""
    return {
        "tag": element.tag,
        "attributes": dict(element.attrib),
        "children": [xml_content(e) for e in element],
    }


def as_xml(file: Path, content: Any) -> None:
    """Write what `xml_content` gives; whatever takes an attribute's place is its text, and no child is no element."""

    def element(node: Any) -> ElementTree.Element | None:
        if not isinstance(node, dict) or not isinstance(node.get("tag"), str) or not node["tag"]:
            return None
        attributes = node["attributes"] if isinstance(node.get("attributes"), dict) else {}
        made = ElementTree.Element(
            node["tag"], {name: str(value) for name, value in attributes.items() if value is not None}
        )
        children = node["children"] if isinstance(node.get("children"), list) else []
        made.extend(child for child in map(element, children) if child is not None)
        return made

    root = element(content)
    file.write_bytes(b"" if root is None else ElementTree.tostring(root))


def documents(folder: Path) -> dict[str, Document]:
    """Every structured file's document, each in a folder of its own below `folder`."""
    capture = small_capture(folder / "capture")
    draw = np.random.default_rng(1)
    cameras = capture.base_from_gripper @ hand_eye_problem(draw, 3).gripper_from_camera
    found: dict[str, Document] = {}

    def in_file(
        name: str, file: Path, read: Callable[[], object], write: Callable[[Path, Any], None] = as_json
    ):
        text = file.read_text()
        content = json.loads(text) if write is as_json else yaml.safe_load(text)
        found[name] = Document(content, partial(write, file), read)

    def source(path: Path, options: ReadOptions = NAMES) -> Callable[[], object]:
        def read() -> object:
            with tempfile.TemporaryDirectory(dir=path.parent) as into:
                return read_source(path, options, into=Path(into))

        return read

    file = capture.folder / "capture.json"
    (capture.folder / "arm.urdf").write_text(writers.URDF)
    content = json.loads(file.read_text()) | {"robot": "ur5e", "urdf": "arm.urdf"}
    content["frames"] = [frame | {"joints": [0.1] * 6} for frame in content["frames"]]
    as_json(file, content)
    in_file("capture.json", file, lambda: capture_json.read(capture.folder))
    in_file("capture.json, gone on with", file, lambda: gone_on(capture.folder))
    _of_others(folder, capture, cameras, in_file, source)
    _of_runs(folder, capture, in_file, found)
    _of_robots(folder, capture, in_file, found, source)
    return found


def gone_on(folder: Path) -> object:
    """A live capture resumed and one image added, which is then taken away."""
    live = LiveFolder(folder)
    pixels = np.full((SIZE[1], SIZE[0], 3), 7, np.uint8)
    return live.add(pixels, np.eye(4))


def _of_others(folder: Path, capture: Capture, cameras: np.ndarray, in_file: Any, source: Any) -> None:
    place = folder / "table"
    writers.write_table(place, capture)
    in_file("camera_info.yaml", place / "camera_info.yaml", source(place), as_yaml)
    lists = folder / "lists"
    writers.write_list(lists, capture)
    in_file("poses.json", lists / "poses.json", source(lists))
    alone = folder / "camera_info"
    alone.mkdir()
    writers.write_camera_info(capture, alone)
    intrinsics = alone / "camera_info.yaml"
    in_file("camera_info.yaml, by itself", intrinsics, lambda: read_camera_info(intrinsics, SIZE), as_yaml)
    file = writers.write_moveit(folder / "moveit", capture.base_from_gripper, cameras)
    in_file("samples.yaml", file, source(file), as_yaml)
    other = writers.write_easy_handeye2(folder / "easy", capture.base_from_gripper, cameras)
    in_file("wrist.samples", other, source(other), as_yaml)


def _of_runs(folder: Path, capture: Capture, in_file: Any, found: dict[str, Document]) -> None:
    run = sound_run(folder / "run")
    in_file("calibration.json", run / "calibration.json", lambda: RunFolder(run).calibration())
    in_file("calibration.json, compared", run / "calibration.json", lambda: read_hand_eye(run))
    in_file("run.json", run / "run.json", lambda: (RunFolder(run).capture(), RunFolder(run).options()))
    reference = folder / "reference.json"
    as_json(
        reference,
        {"gripper_from_camera": np.eye(4).tolist(), "uncertainty": {"covariance": np.eye(7).tolist()}},
    )
    in_file("reference.json", reference, lambda: read_hand_eye(reference))
    added = folder / "with_added" / "added"
    added.mkdir(parents=True)
    (added / "000.png").write_bytes((capture.folder / capture.images[0]).read_bytes())
    frames = [{"image": "000.png", "base_from_gripper": np.eye(4).tolist()}]
    as_json(added / "capture.json", {"added_to": str(capture.folder.resolve()), "frames": frames})
    in_file("added/capture.json", added / "capture.json", lambda: read_added(added.parent, capture))
    names = folder / "names.json"
    as_json(names, {"1": "mug", "2": "box"})
    in_file("labels/names.json", names, lambda: _read_names(names))
    _archive(folder, found)


def _archive(folder: Path, found: dict[str, Document]) -> None:
    """The JSON inside of reconstruction.npz."""
    from fuzz_targets import results

    place = folder / "archive"
    capture = small_capture(folder / "archived")
    results(place, capture, capture.base_from_gripper)
    file = place / "reconstruction.npz"
    write_reconstruction(file, read_reconstruction(file))
    with np.load(file) as arrays:
        kept = dict(arrays)
    about = json.loads(str(kept.pop("about")))

    def write(content: Any) -> None:
        with file.open("wb") as stream:
            text = json.dumps(content).replace("Infinity", "1e309")
            np.savez(stream, about=np.array(text), allow_pickle=False, **kept)

    found["reconstruction.npz, about"] = Document(about, write, lambda: read_reconstruction(file))


def _of_robots(folder: Path, capture: Capture, in_file: Any, found: dict[str, Document], source: Any) -> None:
    pixels = [np.asarray(Image.open(capture.folder / name).convert("RGB")) for name in capture.images]
    images = [image for image in pixels for _ in range(3)]
    states = np.repeat(writers.rows_as("rpy", capture.base_from_gripper), 3, axis=0)
    numbers = ["x", "y", "z", "roll", "pitch", "yaw"]
    episode = [(images, states)]
    for version in ("v2.1", "v3.0"):
        place = writers.write_lerobot(
            folder / version, episode, version, "observation.state", numbers, codec=None
        )
        (place / "videos").mkdir(exist_ok=True)
        in_file(f"info.json {version}", place / "meta" / "info.json", source(place, ReadOptions(frames=3)))
    bag = write_bag(folder / "bag", capture, "sqlite3", 2.0, fps=4.0, tf_hz=10.0)
    in_file("metadata.yaml of a bag", bag / "metadata.yaml", source(bag), as_yaml)
    urdf = folder / "chain.urdf"
    content = xml_content(ElementTree.fromstring(writers.URDF))
    found["URDF"] = Document(content, partial(as_xml, urdf), lambda: read_chain(urdf, 3))
    table = folder / "table"
    writers.write_table(table, capture)
    cells = [line.split(",") for line in (table / "poses.csv").read_text().splitlines()]

    def write_rows(rows: Any) -> None:
        lines = [",".join(map(str, row)) if isinstance(row, list) else str(row) for row in rows]
        (table / "poses.csv").write_text("\n".join(lines))

    found["poses.csv"] = Document(cells, write_rows, source(table))
    line = {"base_from_gripper": np.eye(4).tolist()}
    sent: list[bytes] = []

    def send(content: Any) -> None:
        sent[:] = [json.dumps(content).replace("Infinity", "1e309").encode()]

    def take() -> object:
        return sample_pose(sent[0])

    found["a sample for `jcr capture`"] = Document(line, send, take)
