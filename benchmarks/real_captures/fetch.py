"""`python -m benchmarks fetch-captures DIR`: build real captures from the public repositories that hold them."""

import hashlib
import io
import json
import re
import subprocess
import sys
import tarfile
import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypedDict

import numpy as np
import tyro
from jaxtyping import Float
from numpy import ndarray
from PIL import Image
from scipy.io import loadmat

from jcr.capture.formats import capture_json
from jcr.capture.notations import angle_unit, length_unit, notation_of, poses_of
from jcr.capture.options import UnitsName
from jcr.errors import InputError
from jcr.estimation.arms import RobotName, arm_named
from jcr.estimation.kinematics import forward_kinematics
from jcr.files import write_bytes
from jcr.records import Capture, CellCamera, Intrinsics, Mount

RECIPES = Path(__file__).with_name("recipes.toml")
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
"""Number in a text, of any notation that the repositories use."""
WIDTHS = {"matrix": 16, "quat:xyzw": 7}
"""Numbers of a pose, by its convention, where these are not six."""


class Other(TypedDict):
    """Further camera of a cell with the same intrinsics: paths of its images and of its truth, and the rows it has."""

    images: str
    truth: str
    rows: list[int]
    """Numbers of its images among those of the pattern; they are numbers of the frames' images, too."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Public repository of a capture, and the places and notations of its parts."""

    repository: str
    commit: str
    licence: str
    images: str
    """Path of the images in the repository, `*` for what differs."""
    poses: str
    """Path of one file with a pose a row, or of one file an image."""
    key: str = ""
    """Field of JSON that holds the numbers of a pose."""
    doubles: dict[str, int] = field(default_factory=dict)
    """Places in the doubles of a MATLAB table: first rotation, step to the next, count, position after a rotation."""
    convention: str = "matrix"
    units: UnitsName = "auto"
    """Notation and units of the numbers, as in jcr.capture.notations."""
    robot: RobotName | None = None
    """Arm whose joint angles (rad) are stored in place of poses."""
    joints: list[int] = field(default_factory=list)
    """Places of its joints among the numbers."""
    use_images: str | list[int] = ":"
    use_poses: str | list[int] = ":"
    """Rows, or a slice of them, that belong together."""
    intrinsics: list[float] = field(default_factory=list)
    """fx, fy, cx, cy and distortion that are stored in the repository; none where empty."""
    intrinsics_std: list[float] = field(default_factory=list)
    """Standard deviations of the intrinsics; none stated where empty."""
    board: str = ""
    """Board in the images, as in `--board`."""
    mount: Mount = "gripper"
    camera: str = "wrist"
    """Name of the frames' camera."""
    truth: str = ""
    """Path of a file with base_from_camera, of a repository that knows it."""
    others: dict[str, Other] = field(default_factory=dict)
    """Further cameras that watch the gripper, by name."""
    sha256: str = ""
    """Hash of images and poses."""


@dataclass(frozen=True)
class Arguments:
    """Build captures from public repositories, for the bench of real captures.

    Commits are fetched with git, shallow and without the files that a capture does not need. The images belong to
    their authors, whose licences recipes.toml names; do not pass them on.

    examples:
      python -m benchmarks fetch-captures captures
      python -m benchmarks fetch-captures captures --only floor_carton
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder for the captures."""
    only: tuple[str, ...] = ()
    """Names of the captures to build (unset: all)."""


def recipes(path: Path = RECIPES) -> dict[str, Recipe]:
    """Return the recipes by the names of their captures."""
    return {name: Recipe(**content) for name, content in tomllib.loads(path.read_text()).items()}


def main(words: Sequence[str]) -> int:
    """Build the captures, report each on stderr, and return 1 if one failed, else 0."""
    arguments = tyro.cli(Arguments, prog="python -m benchmarks fetch-captures", args=words)
    known, failed = recipes(), 0
    if unknown := set(arguments.only) - known.keys():
        raise InputError(f"{', '.join(sorted(unknown))}: no such capture; there are {', '.join(known)}")
    for name in arguments.only or known:
        try:
            build(known[name], arguments.out / name)
        except InputError as error:
            failed += 1
            sys.stderr.write(f"{name}: {error}\n")
        else:
            sys.stderr.write(f"{name}: done\n")
    return int(failed > 0)


def build(recipe: Recipe, out: Path, clone: str | None = None) -> Path:
    """Write the capture of a recipe into `out` and return `out`.

    Raises InputError where the repository cannot be had, or its content is not that of the recipe.
    """
    with tempfile.TemporaryDirectory() as folder:
        if clone is None:
            # The commit of the recipe without files, which git adds when they are read.
            clone = folder
            _git(clone, "init", "--quiet", "--bare")
            _git(clone, "remote", "add", "origin", recipe.repository)
            _git(clone, "fetch", "--quiet", "--depth=1", "--filter=blob:none", "origin", recipe.commit)
        names = _git(clone, "ls-tree", "-r", "-z", "--name-only", recipe.commit).decode().split("\0")
        images = _chosen(_matching(names, recipe.images), recipe.use_images)
        others = _others(recipe, names)
        of_others = [path for own in others.values() for path in own.values()]
        truths = [one for one in (recipe.truth, *(other["truth"] for other in recipe.others.values())) if one]
        if not images:
            raise InputError(f"{recipe.repository}: no file {recipe.images} at {recipe.commit[:10]}")
        wanted = [*images, *_matching(names, recipe.poses), *truths, *of_others]
        files = _files(clone, recipe.commit, wanted)
    poses = _poses(recipe, files)
    if len(images) != len(poses):
        raise InputError(
            f"{recipe.repository}: {len(images)} images and {len(poses)} poses; correct the recipe"
        )
    found = digest([files[name] for name in (*images, *of_others)], poses)
    if recipe.sha256 not in ("", found):
        raise InputError(f"{recipe.repository}: content is not that of the recipe (sha256 {found})")
    # Images that have the same name in folders of their own are named by their folders.
    apart = len({Path(name).name for name in images}) == len(images)
    named = {
        f"images/{Path(name).name if apart else Path(name).parent.name + Path(name).suffix}": name
        for name in images
    }
    beside = {f"{camera}/{Path(path).name}": path for camera, own in others.items() for path in own.values()}
    for name, path in (named | beside).items():
        write_bytes(out / name, files[path])
    _write(out, recipe, poses, [*named], others, files)
    return out


def _write(
    out: Path,
    recipe: Recipe,
    poses: Float[ndarray, "n 4 4"],
    images: Sequence[str],
    others: dict[str, dict[int, str]],
    files: dict[str, bytes],
) -> None:
    """Write the capture.json of a recipe into `out`, where its images are.

    `images` are the names of the frames' images, `others` the paths of other cameras' images by frame, `files` the
    content of the repository's files.
    """
    with Image.open(out / images[0]) as image:
        size = image.size
    known: dict[str, Any] = {"image_size": size, "intrinsics": None}
    if recipe.intrinsics:
        fx, fy, cx, cy, *distortion = recipe.intrinsics
        known["intrinsics"] = Intrinsics(fx, fy, cx, cy, *size, tuple(distortion or [0.0] * 5))
    if recipe.intrinsics_std:
        known["intrinsics_std"] = np.array(recipe.intrinsics_std)
    cameras = [
        CellCamera(
            name=name,
            mount="base",
            images=tuple(f"{name}/{Path(path).name}" for path in own.values()),
            frame=np.array([*own]),
            **known,
        )
        for name, own in others.items()
    ]
    capture = Capture(
        folder=out,
        images=tuple(images),
        base_from_gripper=poses,
        mount=recipe.mount,
        camera_name=recipe.camera,
        others=tuple(cameras),
        **known,
    )
    truths = {recipe.camera: recipe.truth} | {name: one["truth"] for name, one in recipe.others.items()}
    truth = {
        name: np.loadtxt(io.BytesIO(files[path])).reshape(4, 4).tolist()
        for name, path in truths.items()
        if path
    }
    source = {name: getattr(recipe, name) for name in ("repository", "commit", "licence", "board")}
    capture_json.write(out, capture, source=source | {"truth": truth})


def digest(images: Sequence[bytes], poses: Float[ndarray, "n 4 4"]) -> str:
    """Return the SHA-256 of image files and of poses rounded to 1e-6."""
    text = json.dumps((np.round(poses, 6) + 0.0).tolist()).encode()
    return hashlib.sha256(b"".join([*images, text])).hexdigest()


def _others(recipe: Recipe, names: Sequence[str]) -> dict[str, dict[int, str]]:
    """Return for each further camera the paths of its images by the frame that each was taken with."""
    frames = _chosen([*range(len(_matching(names, recipe.images)))], recipe.use_images)
    return {
        name: {frames.index(row): _matching(names, other["images"])[row] for row in other["rows"]}
        for name, other in recipe.others.items()
    }


def _files(repository: str, commit: str, names: Sequence[str]) -> dict[str, bytes]:
    """Return the content of the files of a commit by their paths."""
    archive = io.BytesIO(_git(repository, "archive", commit, "--", *names))
    with tarfile.open(fileobj=archive) as tar:
        return {one.name: tar.extractfile(one).read() for one in tar if one.isfile()}  # type: ignore[union-attr]


def _git(repository: str, *words: str) -> bytes:
    """Run git on a repository and return its output."""
    done = subprocess.run(["git", "-C", repository, *words], capture_output=True)
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
        raise InputError(f"git {words[0]} failed: {lines[-1]}")
    return done.stdout


def _matching(names: Sequence[str] | dict[str, bytes], pattern: str) -> list[str]:
    """Return the names of a pattern, in the order of the numbers in them."""
    form = re.compile("[^/]*".join(map(re.escape, pattern.split("*"))))
    return sorted(filter(form.fullmatch, names), key=lambda name: [int(n) for n in re.findall(r"\d+", name)])


def _chosen(values: Any, rows: str | list[int]) -> Any:
    """Return the chosen rows of a list or array; a slice is written as in Python."""
    if isinstance(rows, str):
        return values[slice(*(int(part) if part else None for part in rows.split(":")))]
    return [values[row] for row in rows]


def _poses(recipe: Recipe, files: dict[str, bytes]) -> Float[ndarray, "n 4 4"]:
    """Return base_from_gripper of the chosen rows."""
    names = _matching(files, recipe.poses)
    width = len(recipe.joints) or WIDTHS.get(recipe.convention, 6)
    rows = [row[-width:] for name in names for row in _numbers(recipe, files[name], width, len(names) > 1)]
    numbers = np.array(_chosen(rows, recipe.use_poses))
    if recipe.robot:
        return forward_kinematics(arm_named(recipe.robot), numbers[:, recipe.joints])
    position, rotation, notation = numbers[:, :3], numbers[:, 3:], notation_of(recipe.convention)
    if notation == "matrix":
        matrix = numbers.reshape(-1, 4, 4)
        position, rotation = matrix[:, :3, 3], matrix[:, :3, :3].reshape(-1, 9)
    length, angle = (None, None) if recipe.units == "auto" else recipe.units.split("-")
    length = length_unit(position, length, recipe.poses)
    return poses_of(
        position, rotation, notation, f"{length}-{angle_unit(rotation, notation, angle, recipe.poses)}"
    )


def _numbers(recipe: Recipe, content: bytes, width: int, alone: bool) -> list[list[float]]:
    """Return the numbers of each pose in one file, which holds one pose or, a line each, all."""
    if recipe.poses.endswith(".npy"):
        return np.reshape(np.load(io.BytesIO(content)), (-1, 16)).tolist()
    if recipe.poses.endswith(".mat"):
        return _doubles(content, **recipe.doubles)
    if recipe.key:
        loaded = json.loads(content)
        return [one[recipe.key] for one in (loaded if isinstance(loaded, list) else [loaded])]
    text = content.decode()
    rows = [[float(x) for x in NUMBER.findall(part)] for part in ([text] if alone else text.splitlines())]
    return [row for row in rows if len(row) >= width]


def _doubles(content: bytes, first: int, step: int, count: int, position: int) -> list[list[float]]:
    """Return the matrices of a MATLAB table, whose objects SciPy leaves as bytes: columns of each rotation, position."""
    workspace = loadmat(io.BytesIO(content))["__function_workspace__"].tobytes()
    values = np.frombuffer(workspace, "<f8")
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, start in zip(poses, range(first, first + step * count, step), strict=True):
        pose[:3, :3] = values[start : start + 9].reshape(3, 3).T
        pose[:3, 3] = values[start + position : start + position + 3]
    return poses.reshape(-1, 16).tolist()
