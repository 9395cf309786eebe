"""The budget of `--memory-gb` is one of the peak resident set, and is kept by the whole process."""

import errno
import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks.align import CHILD
from benchmarks.synthetic_pairs import synthetic_pairs
from jcr.errors import InputError
from jcr.memory import GB, give_back, require, resident
from jcr.reconstruct.dust3r.pair_graph import complete_pairs
from jcr.reconstruct.global_alignment.align import align
from jcr.reconstruct.global_alignment.pairs import (
    PairPredictions,
    pairs_from_arrays,
    read_arrays,
    write_pairs,
)
from jcr.reconstruct.pointmap_matches import tracks_from_pairs

TINY = {"enc_embed_dim": 32, "enc_depth": 1, "enc_num_heads": 2, "dec_embed_dim": 32, "dec_depth": 1}
TINY |= {"dec_num_heads": 2}
SIDE = 320


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten images of noise, whose pairs make 0.57 GB of pointmaps, and weights beside them."""
    import torch
    from safetensors.torch import save_file

    from jcr.reconstruct.dust3r.network import Dust3r

    folder = tmp_path_factory.mktemp("capture")
    rng = np.random.default_rng(0)
    frames = []
    for k in range(10):
        Image.fromarray(rng.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)).save(folder / f"{k}.png")
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
        frames.append({"image": f"{k}.png", "base_from_gripper": pose.tolist()})
    (folder / "capture.json").write_text(json.dumps({"frames": frames, "intrinsics": None}))
    torch.manual_seed(0)
    save_file(Dust3r(**TINY).state_dict(), folder / "model.safetensors")
    (folder / "config.json").write_text(json.dumps(TINY))
    return folder


@pytest.mark.slow
def test_a_network_keeps_the_least_budget_that_is_not_refused(capture: Path, tmp_path: Path) -> None:
    arguments = ["predict", str(capture), str(tmp_path / "pairs.npz"), "--weights", str(capture)]
    arguments += ["--pair-graph", "complete", "--device", "cpu", "--cache-gb", "0"]

    def in_a_process(budget_gb: float) -> tuple[int, str]:
        command = [sys.executable, "-c", CHILD, *arguments, "--memory-gb", str(budget_gb)]
        done = subprocess.run(command, capture_output=True, text=True)
        return done.returncode, done.stderr

    status, text = in_a_process(0.1)
    least = re.search(r"raise --memory-gb to ([\d.]+)", text)
    assert status == 2 and least is not None
    status, text = in_a_process(float(least[1]))
    assert status == 0, text
    said, high = re.search(r"about ([\d.]+) GB", text), re.search(r"VmHWM:\s+(\d+) kB", text)
    assert "0.57 GB of pointmaps in a file" in text and said is not None and high is not None
    peak_gb = 1024 * int(high[1]) / GB
    assert peak_gb <= min(float(least[1]), float(said[1]) + 0.01)
    assert peak_gb + 0.57 > float(least[1]), "with the pointmaps in memory it would have passed the budget"
    with zipfile.ZipFile(tmp_path / "pairs.npz") as archive:
        assert archive.testzip() is None


@pytest.mark.slow
def test_every_back_end_names_the_budget_it_needs(capture: Path, tmp_path: Path) -> None:
    """In a process that holds nothing else, the one with a network last."""
    run = ["run", str(capture), str(tmp_path / "out"), "--device", "cpu", "--memory-gb", "0.1", "--backend"]
    others = ["colmap"], ["marker", "--board", "chessboard:9x6:0.025"], ["dust3r", "--weights", str(capture)]
    code = "import json, sys; from jcr.cli import dispatch\nfor line in json.loads(sys.argv[1]): print(dispatch(line))"
    command = [sys.executable, "-c", code, json.dumps([[*run, *other] for other in others])]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout.split() == ["2"] * 3
    errors = [line for line in done.stderr.splitlines() if line.startswith("error")]
    assert len(errors) == 3 and all("--memory-gb 0.1" in error for error in errors)
    needed = [float(gb) for error in errors for gb in re.findall(r"raise --memory-gb to ([\d.]+)", error)]
    assert len(needed) == 3 and all(0.5 < gb < 2 for gb in needed)
    assert not (tmp_path / "out" / "calibration.json").exists()


def test_pointmaps_in_a_file_leave_the_resident_set(tmp_path: Path) -> None:
    from jcr.reconstruct.dust3r import predictor

    shape = (100, 256, 256)
    points, conf = predictor._new_array((*shape, 3), False), predictor._new_array(shape, False)
    pairs = PairPredictions(
        edges=np.tile([[0, 1]], (100, 1)), pts3d=points, conf=conf, pts3d_in_other_view=points, conf2=conf
    )
    give_back()
    before = resident()
    for row in range(100):
        points[row] = 1.0
    assert resident() - before > 0.9 * points.nbytes
    pairs.release()
    assert resident() - before < 0.1 * points.nbytes
    before = resident()
    write_pairs(tmp_path / "pairs.npz", pairs)
    assert resident() - before < 0.1 * points.nbytes and points[99].min() == 1.0


def test_pairs_left_in_their_file_align_and_match_to_the_same_bits(tmp_path: Path) -> None:
    path = tmp_path / "pairs.npz"
    pairs, _ = synthetic_pairs(complete_pairs(5), (64, 48))
    write_pairs(path, pairs)
    made = []
    for limit in (np.inf, 0.0):
        read = pairs_from_arrays(read_arrays(path, limit), str(path))
        assert isinstance(read.pts3d, np.memmap) == (limit == 0)
        alignment = align(read)
        tracks = tracks_from_pairs(read, alignment.points_in_recon(), lambda x: x)
        made.append((alignment.depth, alignment.confidence, alignment.recon_from_camera, tracks.x_px))
    for one, other in zip(*made, strict=True):
        np.testing.assert_array_equal(one, other)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="no readable npz"):
        read_arrays(path, 0.0)


@pytest.mark.parametrize("system", ["linux", "macos"])
def test_pointmaps_in_a_file_have_their_space_before_they_are_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, system: str
) -> None:
    from jcr.reconstruct.dust3r import predictor

    if system == "macos":
        monkeypatch.delattr(os, "posix_fallocate")
    size = 4 * 3 * 400_001
    with (tmp_path / "reserved").open("w+b") as stream:
        monkeypatch.setattr(predictor.tempfile, "TemporaryFile", lambda: stream)
        array = predictor._new_array((400_001, 3), False)
    written = (tmp_path / "reserved").stat()
    assert written.st_size == size and 512 * written.st_blocks >= size
    array[-1] = 1.0
    assert array.sum() == 3.0


def test_a_disk_without_space_for_the_pointmaps_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from jcr.reconstruct.dust3r import predictor

    def full(*arguments: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    named = r"no space for pointmaps.*No space left.*TMPDIR"
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(InputError, match=named):
        predictor._new_array((4, 4), False)
    monkeypatch.delattr(os, "posix_fallocate")
    with Path("/dev/full").open("r+b") as stream, pytest.raises(InputError, match=named):
        monkeypatch.setattr(predictor.tempfile, "TemporaryFile", lambda: stream)
        predictor._new_array((4, 4), False)


def test_objects_in_a_mapped_file_are_refused(tmp_path: Path) -> None:
    """What stands in the file would be taken for addresses."""
    path = tmp_path / "pairs.npz"
    np.savez(path, edges=np.array([[0, 1], [1, None]], dtype=object))
    for in_memory in (0.0, 1e9):
        with pytest.raises(InputError, match=r"pairs\.npz"):
            read_arrays(path, in_memory)


def test_bytes_in_place_of_an_array_are_refused(tmp_path: Path) -> None:
    """Found by the fuzzer: NumPy reads them without a word where their first letters are damaged."""
    path = tmp_path / "pairs.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("edges.npy", b"\x93NUNPY and so on")
    for in_memory in (0.0, 1e9):
        with pytest.raises(InputError, match=r"pairs\.npz: no readable npz file"):
            read_arrays(path, in_memory)


def test_a_budget_that_is_no_number_is_refused() -> None:
    with pytest.raises(InputError, match="--memory-gb nan"):
        require(10**9, float("nan"), "a run")
