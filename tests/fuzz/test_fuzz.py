"""Hostile bytes and hostile numbers: a right reading, an InputError or an honest doubt, and nothing else.

JCR_TEST_FUZZ=20 looks twenty times as long.
"""

import os
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jcr
from corpus import Target, corpus
from jcr.errors import InputError
from jcr.geometry import rotation_exp, transform
from simulation.poses import Pattern
from simulation.problems import HandEyeProblem, error, hand_eye_problem

pytestmark = pytest.mark.slow

LONGER = int(os.environ.get("JCR_TEST_FUZZ", "1"))
TOKENS = [
    b"NaN", b"-Infinity", b"1e999", b"1e-999", b"sNaN", b"1e99999999", b"9" * 5000, b"0x10", b"null", b"true", b"{}",
    b"[]", b"[[", b"}", b'"', b"'", b",", b":", b"\n", b"\t", b"- ", b"&a [*a]", b"*a", b"2001-99-99",
    b"!!python/name:os", b"? [x]\n: y", b"<<: 1", b"../", b"/etc/passwd", b"\0", b"\xff\xfe",
    b"\x1f\x8b", b"\xe2\x80\xa8", b"-1", b"0",
    b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"PK\x03\x04", b"\x93NUMPY\x03\x00",
]  # fmt: skip
bounded = settings(
    max_examples=60 * LONGER,
    derandomize=LONGER == 1,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)


@st.composite
def changes(draw: st.DrawFn) -> list[tuple[float, str, int, bytes]]:
    """Where in a file (a share of its length), what is done there, to how many bytes, and with which."""
    what = st.sampled_from(["replace", "insert", "delete", "repeat", "flip", "cut"])
    new = st.one_of(st.sampled_from(TOKENS), st.binary(min_size=1, max_size=8))
    where = st.floats(0, 1, exclude_max=True)
    return draw(st.lists(st.tuples(where, what, st.integers(1, 64), new), min_size=1, max_size=4))


def changed(data: bytes, edits: list[tuple[float, str, int, bytes]]) -> bytes:
    for share, what, length, new in edits:
        at = int(share * len(data))
        before, here, after = data[:at], data[at : at + length], data[at + length :]
        data = {
            "replace": before + new + data[at + len(new) :],
            "insert": before + new + data[at:],
            "delete": before + after,
            "repeat": before + here * 3 + after,
            "flip": before + bytes(byte ^ 1 << length % 8 for byte in here[:1]) + data[at + 1 :],
            "cut": before,
        }[what]
    return data


@pytest.fixture(scope="module")
def readers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return corpus(tmp_path_factory.mktemp("fuzz") / "targets")


NAMES = [
    "about.json", "added/capture.json", "arm.urdf", "calibration.json", "camera_info.yaml", "cameras.bin",
    "capture.json", "cloud.ply", "compared calibration.json", "depth.npz", "episode.parquet",
    "info.json v2.1", "info.json v3.0", "map.safetensors", "metadata.yaml", "names.json", "pairs.npz", "picture.bmp",
    "picture.gif", "picture.jpg", "picture.png", "picture.tif", "picture.webp", "points.csv", "points.npy",
    "points.ply", "poses.csv", "poses.json", "poses.npy", "poses.tsv", "poses.txt", "reconstruction.npz",
    "reference.json", "resumed capture.json", "run.json", "sample.json", "samples.yaml", "scan.bag", "scan.mcap",
    "weights.pth", "wrist.samples",
]  # fmt: skip


def test_every_target_reads_as_it_is(readers: dict[str, Target]):
    assert sorted(readers) == sorted(NAMES)
    for name, target in readers.items():
        try:
            target.read(target.file)
        except InputError:
            assert name == "weights.pth"  # of no network


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_changed_bytes_are_read_or_refused(name: str, readers: dict[str, Target]):
    target = readers[name]
    valid = target.file.read_bytes()

    @bounded
    @given(changes())
    def feed(edits: list[tuple[float, str, int, bytes]]) -> None:
        try:
            target.feed(changed(valid, edits))
        except InputError as error:
            assert "\0" not in str(error)

    try:
        feed()
    finally:
        target.file.write_bytes(valid)


@st.composite
def poses(draw: st.DrawFn) -> tuple[HandEyeProblem, bool]:
    """Poses of 2 to 14 images, degenerate, noisy, wrong or doubled as it comes; and whether their unit is true."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    robot = [size * draw(st.sampled_from([0, 1e-3, 0.3, 1, 5])) for size in (1e-3, np.radians(0.3))]
    camera = [size * draw(st.sampled_from([0, 0.3, 3])) for size in (1e-3, np.radians(0.1))]
    count = draw(st.integers(2, 14))
    pattern = draw(st.sampled_from(["varied", *get_args(Pattern)]))
    deviation = draw(st.sampled_from([0.0, 1e-6, 1e-3, 0.05, 0.3]))
    problem = hand_eye_problem(rng, count, pattern, (robot[0], robot[1]), (camera[0], camera[1]), deviation)
    gripper, cameras = problem.base_from_gripper.copy(), problem.recon_from_camera.copy()
    for wrong in rng.permutation(len(gripper))[: draw(st.integers(0, max(0, (count - 1) // 3)))]:
        rotation = rotation_exp(rng.normal(size=3) * draw(st.sampled_from([0, 0.05, 1])))
        off = rng.normal(size=3) * draw(st.sampled_from([0.005, 0.05, 0.5]))
        gripper[wrong] = gripper[wrong] @ transform(rotation, off)
    if draw(st.booleans()):
        gripper[0], cameras[0] = gripper[-1], cameras[-1]
    unit = draw(st.sampled_from([1.0, 1.0, 1e-9, 1e9]))
    cameras[:, :3, 3] *= unit
    return replace(problem, base_from_gripper=gripper, recon_from_camera=cameras), unit == 1.0


@pytest.mark.long
@settings(bounded, max_examples=60 * LONGER)
@given(poses())
def test_no_poses_make_the_solver_fail_or_trust_what_is_wrong(given_poses: tuple[HandEyeProblem, bool]):
    problem, unit_is_true = given_poses
    solved = jcr.solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    if solved.converged:
        off = error(problem, solved.gripper_from_camera, solved.scale)
        std = np.sqrt(np.diag(solved.covariance))
        known = slice(None) if unit_is_true else slice(6)
        assert (np.abs(off) <= 5 * std + 1e-7)[known].all(), off / std
    else:
        assert solved.warnings
