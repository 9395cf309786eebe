"""The catalogue of faults: what is fed to the command line, with which status it ends, and what it says.

After each the message is one line with a remedy, no traceback, nothing is half-written, and the results that were
there are what they were.
"""

import hashlib
import json
import os
import pickle
import re
import shutil
import struct
import subprocess
import zlib
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import jcr
from jcr.calibration.record import read_calibration
from jcr.cli import dispatch
from jcr.estimation.arms import arm_named
from jcr.estimation.kinematics import forward_kinematics
from jcr.pipeline import stages
from jcr.records import Reconstruction
from jcr.result import RunResult
from simulation.problems import hand_eye_problem

SIZE = (96, 72)
COUNT = 6


@dataclass(frozen=True)
class Case:
    """Where a fault may be planted."""

    capture: Path
    out: Path
    done: Path
    """A finished run of the bundled capture, a copy of this case's own."""

    @property
    def first(self) -> Path:
        return self.capture / "images" / "0.png"

    @property
    def calibrate(self) -> list[str]:
        return ["calibrate", str(self.capture), str(self.out), "--quiet"]

    def content(self) -> dict[str, Any]:
        return json.loads((self.capture / "capture.json").read_text())

    def write(self, content: dict[str, Any]) -> None:
        (self.capture / "capture.json").write_text(json.dumps(content))

    def edit(self, change: Callable[[dict[str, Any]], Any]) -> None:
        content = self.content()
        change(content)
        self.write(content)

    def poses(self, change: Callable[[np.ndarray], np.ndarray], only: int | None = None) -> None:
        """Change all gripper poses, or one."""
        content = self.content()
        for k, frame in enumerate(content["frames"]):
            if only is None or k == only:
                frame["base_from_gripper"] = change(np.array(frame["base_from_gripper"])).tolist()
        self.write(content)


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small capture with nothing wrong but its images, which are noise."""
    folder = tmp_path_factory.mktemp("sound")
    (folder / "images").mkdir()
    draw = np.random.default_rng(0)
    poses = hand_eye_problem(draw, COUNT).base_from_gripper
    frames = []
    for k in range(COUNT):
        pixels = draw.integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"images/{k}.png")
        frames.append({"image": f"images/{k}.png", "base_from_gripper": poses[k].tolist()})
    intrinsics = {"fx": 90.0, "fy": 90.0, "cx": 47.5, "cy": 35.5, "distortion": [0.0] * 5}
    (folder / "capture.json").write_text(json.dumps({"frames": frames, "intrinsics": intrinsics}))
    return folder


@pytest.fixture
def case(tmp_path: Path, sound: Path, done: Path) -> Case:
    shutil.copytree(sound, tmp_path / "capture")
    shutil.copytree(done, tmp_path / "done", ignore=shutil.ignore_patterns("*.npz", "*.ply", "*.html"))
    return Case(tmp_path / "capture", tmp_path / "out", tmp_path / "done")


Plant = Callable[[Case], list[str]]


def written(change: Callable[[Case], Any]) -> Plant:
    """A fault of the capture."""

    def plant(case: Case) -> list[str]:
        change(case)
        return case.calibrate

    return plant


def image(change: Callable[[Path], Any]) -> Plant:
    """A fault of the first image."""
    return written(lambda case: change(case.first))


def text(content: str | bytes) -> Plant:
    """Another capture.json."""
    data = content if isinstance(content, bytes) else content.encode()
    return written(lambda case: (case.capture / "capture.json").write_bytes(data))


def posed(change: Callable[[np.ndarray], np.ndarray], only: int | None = None) -> Plant:
    return written(lambda case: case.poses(change, only))


def too_long(case: Case) -> None:
    """Gripper positions in another unit than the arm's joint angles say; no image would show it."""
    arm, content = arm_named("ur5e"), case.content()
    joints = arm.rest + 0.4 * np.random.default_rng(1).normal(size=(COUNT, arm.dof))
    poses = forward_kinematics(arm, joints)
    poses[:, :3, 3] *= 1.05
    for frame, angles, pose in zip(content["frames"], joints, poses, strict=True):
        frame |= {"joints": angles.tolist(), "base_from_gripper": pose.tolist()}
    case.write(content | {"robot": "ur5e"})


def by_colmap(plant: Plant) -> Plant:
    """One back end tries, and not each in turn: they read the same images."""
    return lambda case: [*plant(case), "--backend", "colmap"]


def bomb(path: Path) -> None:
    """A PNG whose header promises 60000 x 60000 pixels, with little behind it."""
    data = path.read_bytes()
    header = data[12:16] + struct.pack(">II", 60_000, 60_000) + data[24:29]
    path.write_bytes(data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:])


def animated(path: Path) -> None:
    frames = [Image.new("RGB", SIZE, color) for color in ("red", "green")]
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:])


def big_json(case: Case) -> None:
    case.edit(lambda content: content.update(padding="x" * 10_000_000, frames=content["frames"][:2]))


def image_named(name: str) -> Plant:
    return written(lambda case: case.edit(lambda c: c["frames"][0].update(image=name)))


def linked_to_itself(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to(path.name)


def pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def mapped(case: Case) -> list[str]:
    return ["map", str(case.done), "--quiet"]


def verify(case: Case) -> list[str]:
    return ["verify", str(case.done), str(case.capture), "--quiet"]


def linked_out(case: Case) -> None:
    secret = case.capture.parent / "secret.png"
    case.first.rename(secret)
    case.first.symlink_to(secret)


def read_only(case: Case) -> list[str]:
    # Root may write anywhere but where the kernel itself forbids it.
    return ["calibrate", str(case.capture), "/proc/jcr-out", "--quiet"]


def a_file_as_output(case: Case) -> list[str]:
    case.out.write_text("precious")
    return case.calibrate


def damaged(name: str, command: Callable[[Case], list[str]], change: Callable[[Path], Any]) -> Plant:
    """A fault of a file in a finished run folder."""

    def plant(case: Case) -> list[str]:
        change(case.done / name)
        return command(case)

    return plant


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def other_format(path: Path) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": "jcr.calibration/9"}))


def compare(case: Case) -> list[str]:
    return ["compare", str(case.done), str(case.done)]


def query(case: Case) -> list[str]:
    points = case.capture.parent / "points.csv"
    points.write_text("x,y,z\n0.4,0,0.2\n")
    return ["query", str(case.done), str(points)]


@dataclass(frozen=True)
class Evil:
    """Unpickling it writes a file."""

    file: Path

    def __reduce__(self):
        return Path.touch, (self.file,)


def executed(file: Path) -> Path:
    """What code in a file would leave beside that file."""
    return file.with_name("executed")


def beside(name: str, *options: str) -> Callable[[Callable[[Path], Any]], Plant]:
    """A fault of a file beside the capture, named after these options."""

    def of(change: Callable[[Path], Any]) -> Plant:
        def plant(case: Case) -> list[str]:
            change(case.capture.parent / name)
            return [*case.calibrate, *options, str(case.capture.parent / name)]

        return plant

    return of


weights = beside("weights.pth", "--backend", "dust3r", "--weights")
predictions = beside("pairs.npz", "--predictions")


def pickled_weights(path: Path) -> None:
    with path.open("wb") as stream:
        pickle.dump({"model": Evil(executed(path))}, stream)


def saved_weights(path: Path, shape: tuple[int, ...], **more: object) -> None:
    import torch

    torch.save({"model": {"conv.weight": torch.zeros(shape)}, **more}, path)


def torch_pickled_weights(path: Path) -> None:
    saved_weights(path, (2,), args=Evil(executed(path)))


def pickled_predictions(path: Path) -> None:
    np.savez(path, edges=np.array([Evil(executed(path))], dtype=object))


FAULTS: dict[str, tuple[Plant, int, str]] = {
    # The folder.
    "empty folder": (written(lambda c: (shutil.rmtree(c.capture), c.capture.mkdir())), 2, "no capture.json"),
    "no such folder": (written(lambda c: shutil.rmtree(c.capture)), 2, "no such"),
    "positions too long for the joint angles": (
        written(lambda c: too_long(c)),
        2,
        r"[45]\.\d ± \d\.\d % too long for a ur5e.*check the unit",
    ),
    "positions too long, looked at by jcr check": (
        lambda c: (too_long(c), ["check", str(c.capture), "--poses-only"])[1],
        2,
        r"[45]\.\d ± \d\.\d % too long for a ur5e",
    ),
    # The images.
    "zero-byte image": (image(lambda p: p.write_bytes(b"")), 2, "not a readable image"),
    "truncated image": (image(cut), 2, "not a readable image"),
    "text file named .png": (image(lambda p: p.write_text("hello")), 2, "not a readable image"),
    "16-bit image": (
        by_colmap(
            image(lambda p: Image.fromarray(np.arange(96 * 72, dtype=np.uint16).reshape(72, 96)).save(p))
        ),
        3,
        "registered 0 of 6",  # read as it should be: the other images are noise
    ),
    "animated image": (image(animated), 2, "holds 2 images"),
    "100-megapixel image": (image(lambda p: Image.new("1", (10_000, 10_000)).save(p)), 2, "million pixels"),
    "image of fractions": (image(lambda p: Image.new("F", SIZE, 0.5).save(p, format="TIFF")), 2, "fractions"),
    "32-bit image": (
        image(lambda p: Image.new("I", SIZE, 1 << 20).save(p, format="TIFF")),
        2,
        "more than 16 bits",
    ),
    "decompression bomb": (image(bomb), 2, "million pixels"),
    "one image under two names": (
        written(lambda c: shutil.copy(c.first, c.first.with_name("1.png"))),
        2,
        "same image",
    ),
    "one image of another size": (image(lambda p: Image.new("RGB", (48, 36)).save(p)), 2, "96x72|48x36"),
    "missing image": (image(Path.unlink), 2, "no such image"),
    "image that is a folder": (image(lambda p: (p.unlink(), p.mkdir())), 2, "a folder, a pipe"),
    "image that is a pipe": (image(lambda p: (p.unlink(), os.mkfifo(p))), 2, "a folder, a pipe"),
    "image that is a link to itself": (image(linked_to_itself), 2, "leads back to itself"),
    "folder of images that is a link to itself": (
        image(lambda p: (shutil.rmtree(p.parent), linked_to_itself(p.parent))),
        2,
        "leads back to itself",
    ),
    # The poses.
    "NaN in a pose": (posed(lambda p: p * np.nan, only=2), 2, "NaN or infinity"),
    "infinity in a pose": (posed(lambda p: p + np.inf, only=2), 2, "NaN or infinity"),
    "reflected pose": (posed(lambda p: p @ np.diag([1, 1, -1, 1]), only=2), 2, "reflection"),
    "scaled pose": (posed(lambda p: p @ np.diag([2.0, 2.0, 2.0, 1.0]), only=2), 2, "scaled by 2"),
    "transposed pose": (posed(lambda p: p.T, only=2), 2, "transposed"),
    "poses in millimetres": (
        posed(lambda p: np.vstack([np.column_stack([p[:3, :3], 1e3 * p[:3, 3]]), p[3:]])),
        2,
        "millimetres",
    ),
    "missing pose": (
        written(lambda c: c.edit(lambda j: j["frames"][1].pop("base_from_gripper"))),
        2,
        "frame 1 .*base_from_gripper: is missing",
    ),
    "two frames": (written(lambda c: c.edit(lambda j: j.update(frames=j["frames"][:2]))), 2, "at least 3"),
    # capture.json.
    "no JSON": (text("frames: []"), 2, "not JSON"),
    "one key twice": (text('{"frames": [], "frames": []}'), 2, "appears twice"),
    "10 MB of JSON": (written(big_json), 2, "MB|at least 3"),
    "deep nesting": (text("[" * 200_000), 2, "nested too deeply"),
    "not UTF-8": (text(b'{"frames": "\xff\xfe"}'), 2, "not UTF-8"),
    "a number of 5000 digits": (text(f'{{"frames": [{"9" * 5000}]}}'), 2, "4300 digits"),
    "NUL in a path": (image_named("images/0\0.png"), 2, "no path inside"),
    "half a surrogate in a path": (image_named("images/\ud800.png"), 2, "no path inside"),
    "a name of 300 letters": (image_named("images/" + "x" * 300), 2, "no path inside"),
    "../ in a path": (image_named("../secret.png"), 2, "leads out"),
    "absolute path": (image_named("/etc/hostname"), 2, "no path inside"),
    "link out of the folder": (written(linked_out), 2, "leads out"),
    # The output.
    "output below a folder nobody can write": (read_only, 2, "cannot be written"),
    "output that is a file": (a_file_as_output, 2, "is a file"),
    # Files of a finished run.
    "calibration.json of a newer format": (damaged("calibration.json", compare, other_format), 2, "format"),
    "calibration.json cut in half": (damaged("calibration.json", compare, cut), 2, "JSON|damaged"),
    "map.safetensors cut in half": (damaged("map.safetensors", query, cut), 2, "damaged"),
    "map.safetensors of noise": (
        damaged("map.safetensors", query, lambda p: p.write_bytes(b"\x07" * 1000)),
        2,
        "damaged",
    ),
    "run.json that is a pipe": (damaged("run.json", mapped, pipe), 2, "a pipe or a device"),
    "run.json that is a link to itself": (damaged("run.json", mapped, linked_to_itself), 2, "holds no run"),
    "reconstruction.npz that is a pipe": (
        damaged("reconstruction.npz", verify, pipe),
        2,
        "a pipe or a device",
    ),
    "cloud.ply that is a pipe": (
        damaged("cloud.ply", lambda c: ["measure", str(c.done)], pipe),
        2,
        "a pipe or a device",
    ),
    "no map": (damaged("map.safetensors", query, Path.unlink), 2, "no map here"),
    # Weights and predictions.
    "weights that are a pickle with code": (weights(pickled_weights), 2, "weights.pth"),
    "weights that are torch's pickle with code": (weights(torch_pickled_weights), 2, "weights.pth"),
    "truncated weights": (weights(lambda p: (saved_weights(p, (999,)), cut(p))), 2, "weights.pth"),
    "weights of another network": (weights(lambda p: saved_weights(p, (3, 3))), 2, "weights.pth"),
    "no such kind of board": (lambda c: [*c.calibrate, "--board", "chess:9x6:0.025"], 2, "--board"),
    "no such weights": (weights(lambda p: None), 2, "weights.pth"),
    "predictions that are a pickle with code": (predictions(pickled_predictions), 2, "pairs.npz"),
    "predictions of noise": (predictions(lambda p: p.write_bytes(b"PK\x03\x04 noise")), 2, "pairs.npz"),
    "predictions of other things": (predictions(lambda p: np.savez(p, a=np.zeros(3))), 2, "pairs.npz"),
}


def state(folder: Path) -> dict[str, str]:
    """What every file in a folder holds."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


OF_ONE_SAMPLE = {
    *("zero-byte image", "truncated image", "text file named .png", "animated image", "100-megapixel image"),
    *(
        "image of fractions",
        "32-bit image",
        "decompression bomb",
        "one image under two names",
        "missing image",
    ),
    *("one image of another size", "NaN in a pose", "infinity in a pose", "reflected pose", "scaled pose"),
    *("transposed pose", "missing pose"),
}
"""Faults of one sample, which is left out with a note that names it."""


@pytest.mark.parametrize("fault", sorted(OF_ONE_SAMPLE))
def test_a_sample_that_cannot_be_used_is_left_out_and_named(case: Case, fault: str):
    plant, _, words = FAULTS[fault]
    plant(case)
    found = jcr.read_capture(case.capture)
    assert len(found) == COUNT - 1
    (note,) = (note for note in found.notes if note.startswith("left out: "))
    assert re.search(words, note), note


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault not in OF_ONE_SAMPLE])
def test_each_fault_ends_in_one_line_and_harms_nothing(
    case: Case, fault: str, capsys: pytest.CaptureFixture[str]
):
    plant, status, words = FAULTS[fault]
    arguments = plant(case)
    before = state(case.done), case.out.read_bytes() if case.out.is_file() else None
    assert dispatch(arguments) == status
    printed = capsys.readouterr()
    said = printed.out if status == 3 else printed.err
    begins = (
        said.startswith("REJECTED") if status == 3 else said.startswith("error: ") and said.count("\n") == 1
    )
    assert begins and "Traceback" not in printed.err, printed
    assert re.search(words, said), said
    assert (state(case.done), case.out.read_bytes() if case.out.is_file() else None) == before
    assert not executed(case.capture).exists(), "code in the file was run"
    assert not list(case.capture.parent.rglob("*.part*"))
    if status == 2:
        assert not case.out.is_dir(), "a folder that holds nothing was left"
    if status == 3:
        assert json.loads((case.out / "calibration.json").read_text())["converged"] is False


@pytest.mark.parametrize("name", ["reconstruction.npz", "depth.npz"])
def test_a_damaged_reconstruction_is_named_and_nothing_else_is_touched(
    tmp_path: Path, done: Path, name: str, capsys
):
    copy = tmp_path / "done"
    shutil.copytree(done, copy)
    cut(copy / name)
    before = state(copy)
    assert dispatch(["map", str(copy), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert f"{name}: damaged" in said and said.count("\n") == 1
    assert state(copy) == before


@pytest.mark.parametrize("name", ["calibration.json", "log.txt", "report.html", "run.json"])
def test_a_folder_where_a_result_belongs_is_named(tmp_path: Path, sound: Path, capsys, name: str):
    (tmp_path / "out" / name).mkdir(parents=True)
    assert dispatch(["calibrate", str(sound), str(tmp_path / "out"), "--backend", "colmap", "--quiet"]) == 2
    said = capsys.readouterr().err
    assert f"{name}: Is a directory" in said and said.count("\n") == 1
    assert not list((tmp_path / "out").rglob("*.part*"))


def test_a_failed_run_leaves_no_map_of_an_earlier_one(tmp_path: Path, sound: Path, done: Path, capsys):
    out = tmp_path / "out"
    shutil.copytree(done, out)
    assert dispatch(["calibrate", str(sound), str(out), "--backend", "colmap", "--quiet"]) == 3
    assert read_calibration(out).parent_from_camera is None
    kept = {path.name for path in out.iterdir()}
    assert kept == {".lock", "calibration.json", "log.txt", "report.html", "run.json"}
    capsys.readouterr()
    # The folder has the state of the failed run, and nothing to make a map of.
    assert dispatch(["map", str(out), "--quiet"]) == 3
    assert capsys.readouterr().err.startswith("error: ") and not (out / "map.safetensors").exists()


def test_a_state_never_vouches_for_a_reconstruction_that_it_does_not_know(
    tmp_path: Path, small_done: Path, monkeypatch: pytest.MonkeyPatch
):
    """Killed between the two files of another capture, the first capture's run would take the wrong one."""
    out, made = tmp_path / "out", RunResult(small_done)
    shutil.copytree(small_done, out)

    def killed(*_) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(stages, "write_reconstruction", killed)
    with pytest.raises(KeyboardInterrupt):
        stages.keep_reconstruction(made.with_parts(out=out), made.reconstruction)
    assert not (out / "run.json").exists()


ARRAYS = {
    "jcr.reconstruction/9": {
        "about", "image_index", "recon_from_camera", "tracks.image", "tracks.point", "tracks.points_in_recon",
        "tracks.std_px", "tracks.x_px",
    },
    "jcr.depth/2": {"about", "confidence", "depth", "filled", "matched", "relative_std"},
}  # fmt: skip


def test_a_reconstruction_of_another_version_is_distinguished(
    tmp_path: Path, done: Path, tabletop: Path, capsys
):
    """And the name of the format changes with what it holds."""
    with np.load(done / "reconstruction.npz") as file:
        arrays = dict(file)
    about = json.loads(str(arrays["about"]))
    assert ARRAYS[about["format"]] == set(arrays)
    assert set(about["reconstruction"]) == {field.name for field in fields(Reconstruction)}
    with np.load(done / "depth.npz") as file:
        assert ARRAYS[json.loads(str(file["about"]))["format"]] == set(file)
    out = tmp_path / "out"
    shutil.copytree(done, out)
    del about["reconstruction"]["metric_std"]
    old = json.dumps(about | {"format": "jcr.reconstruction/1"})
    np.savez(out / "reconstruction.npz", **arrays | {"about": np.array(old)})
    assert dispatch(["map", str(out), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert "'jcr.reconstruction/1', not 'jcr.reconstruction/9'; delete it and run again" in said


def test_a_full_disk_leaves_the_earlier_results(tmp_path: Path, small_done: Path, capsys):
    disk = tmp_path / "disk"
    disk.mkdir()
    size = sum(path.stat().st_size for path in small_done.iterdir())
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size + (2 << 20)}", "tmpfs", str(disk)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("a small file system to fill cannot be mounted here")
    try:
        shutil.copytree(small_done, disk, dirs_exist_ok=True)
        (disk / "filler").write_bytes(b"x" * (1 << 20))
        before = state(disk)
        assert dispatch(["map", str(disk), "--max-seconds", "1", "--quiet"]) == 2
        said = capsys.readouterr().err
        assert "No space left" in said and said.count("\n") == 1
        changed = {name for name, digest in state(disk).items() if before.get(name) != digest}
        assert changed <= {"calibration.json", "log.txt", "run.json"}, "a result was lost or is half-written"
        assert read_calibration(disk).converged
    finally:
        subprocess.run(["umount", str(disk)], check=True)
