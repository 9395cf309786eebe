"""A run folder: what its files are, which stage made each and from what, who may write there, and reading them back.

Whatever a command is given as OUT is input like any other: somebody may have edited or cut it. What is read here has
been validated; what has not raises InputError in one line.
"""

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jcr import __version__
from jcr.calibration.calibration_json import CalibrationFile, read_calibration, write_calibration
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.words import log
from jcr.capture.added import FOLDER as ADDED
from jcr.capture.capture_json import kept
from jcr.capture.plain_files import first_fault
from jcr.capture.read import read_capture
from jcr.cell.cameras_json import FILE as CAMERAS
from jcr.cell.cameras_json import CamerasFile, read_cameras, write_cameras
from jcr.errors import InputError
from jcr.files import read_bytes, remove_unfinished, write_text
from jcr.reconstruct.backends import ReconstructOptions, candidates
from jcr.reconstruct.reconstruction_npz import FORMAT, read_reconstruction, write_reconstruction
from jcr.records import Attempt, Capture, PointCloud, Reconstruction
from jcr.represent.cloud_ply import read_cloud, write_cloud
from jcr.represent.map_file import FILE as MAP
from jcr.represent.map_file import load_map

if TYPE_CHECKING:
    from jcr.represent.scene import SceneMap

LOCK = ".lock"
"""Held by the run that writes there."""
MOVING = "moving"
"""Images of a fixed camera without what stands still; a carried thing is reconstructed from them."""
CAPTURE = "capture"
"""Images and poses that were read from another format than capture.json."""
STATE = "run.json"
"""The capture, the options of its calibration, and what reconstruction.npz was made from."""
RECONSTRUCTION, CALIBRATION, LOG = "reconstruction.npz", "calibration.json", "log.txt"
CLOUD, REPORT = "cloud.ply", "report.html"
OF_RECONSTRUCTION = (STATE, RECONSTRUCTION)
OF_CALIBRATION = (CLOUD, MAP, REPORT, CAMERAS)
"""What holds of one calibration alone."""
PASSING = {"timings_s", "warnings", "notes", "version", "attempts", "requirement", "next_poses"}
"""Of calibration.json: what may differ between two of the same calibration."""


class MadeWith(BaseModel):
    """The options that a calibration was made with."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    reconstruct: ReconstructOptions
    calibrate: CalibrateOptions


class State(BaseModel):
    """The content of run.json."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    capture: Annotated[str, Field(max_length=4096, pattern=r"^[^\x00]+$")]
    """Its folder."""
    reconstruct: str
    """The fingerprint of what reconstruction.npz was made from."""
    options: MadeWith
    attempts: tuple[Attempt, ...] = ()
    """How that reconstruction was chosen."""


@dataclass(frozen=True)
class RunFolder:
    """What one run left, and where."""

    path: Path

    def state(self) -> State:
        """run.json; InputError where there is no run, or its file was damaged."""
        file = self.path / STATE
        try:
            return State.model_validate_json(read_bytes(file), strict=True)
        except ValidationError as error:
            raise InputError(
                f"{file}: {first_fault(error)}; run `jcr calibrate` or `jcr run` again"
            ) from None
        except OSError:
            raise InputError(
                f"{self.path}: holds no run; make one with `jcr run` or `jcr calibrate`"
            ) from None

    def capture(self) -> Capture:
        """The capture that the run was made from; InputError where there is no run, or no such capture any more."""
        name = self.state().capture
        try:
            return read_capture(name)
        except InputError:
            raise
        except OSError as error:  # a path that no file system takes
            raise InputError(f"{self.path / STATE}: capture: {error.strerror}; run `jcr run` again") from None

    def options(self) -> MadeWith:
        """What the calibration was made with; raises as `state` does."""
        return self.state().options

    def calibration(self) -> CalibrationFile:
        """calibration.json; InputError where there is none, or it was damaged."""
        return read_calibration(self.path)

    def reconstruction(self) -> Reconstruction:
        """reconstruction.npz; InputError where there is none, or it was damaged."""
        return read_reconstruction(self.path / RECONSTRUCTION)

    def calibrated(self) -> tuple[CalibrationFile, Reconstruction]:
        """A calibration and the reconstruction behind it.

        Raises InputError where either is missing or damaged, nothing was found, or they are not of the same images.
        """
        calibration = self.calibration()
        if calibration.mount == "base":
            raise InputError(
                f"{self.path}: is for a camera that watches the gripper; this needs a camera on the gripper"
            )
        if calibration.gripper_from_camera is None:
            raise InputError(
                f"{self.path}: found no calibration ({calibration.doubt}); fix the capture, run it again"
            )
        reconstruction = self.reconstruction()
        if len(calibration.images) <= reconstruction.image_index.max(initial=-1):
            raise InputError(
                f"{self.path / CALIBRATION}: names {len(calibration.images)} images and {RECONSTRUCTION} has more; "
                "run `jcr calibrate` or `jcr run` again"
            )
        return calibration, reconstruction

    def cloud(self) -> PointCloud:
        """cloud.ply; InputError where there is none, or it was damaged."""
        return read_cloud(self.path / CLOUD)

    def scene(self) -> "SceneMap":
        """map.safetensors; InputError where there is none, it was damaged, or its packages are not installed."""
        return load_map(self.path)

    def has_map(self) -> bool:
        """Whether there is a map, sound or not."""
        return (self.path / MAP).is_file()

    def earlier(self, state: State) -> State | None:
        """The state of an earlier run whose reconstruction was made from the same; else it is to be made again.

        A state that cannot be read vouches for nothing: to make every stage again is always right.
        """
        try:
            found = self.state()
        except InputError:
            return None
        return found if found.reconstruct == state.reconstruct else None

    def keep_capture(self, capture: Capture) -> Capture:
        """The capture as later commands will find it: where it lies, or copied if it is of another format."""
        return kept(capture, self.path / CAPTURE)

    def keep_reconstruction(self, reconstruction: Reconstruction, state: State) -> None:
        """Write it, then the state that vouches for it."""
        (self.path / STATE).unlink(missing_ok=True)  # or it would vouch for a file that it does not know
        write_reconstruction(self.path / RECONSTRUCTION, reconstruction)
        self.keep_state(state)

    def keep_state(self, state: State) -> None:
        """Write run.json."""
        write_text(
            self.path / STATE, json.dumps(state.model_dump(mode="json", warnings=False), indent=2) + "\n"
        )

    def forget_reconstruction(self) -> None:
        """Remove what is another capture's, or of other options."""
        for name in OF_RECONSTRUCTION:
            (self.path / name).unlink(missing_ok=True)

    def keep_calibration(self, content: CalibrationFile) -> None:
        """Write calibration.json and log.txt; what was made from another one goes first, so that the two never mix."""
        try:
            same = self.calibration().model_dump(exclude=PASSING) == content.model_dump(exclude=PASSING)
        except InputError:
            same = False
        if not same:
            for name in OF_CALIBRATION:
                (self.path / name).unlink(missing_ok=True)
        self.amend_calibration(content)

    def amend_calibration(self, content: CalibrationFile) -> None:
        """Write calibration.json and log.txt with more of the same calibration: times, warnings of the map."""
        write_calibration(self.path / CALIBRATION, content)
        write_text(self.path / LOG, log(content))

    def keep_map(self, cloud: PointCloud, scene: "SceneMap") -> None:
        """Write cloud.ply and map.safetensors."""
        write_cloud(self.path / CLOUD, cloud)
        scene.save(self.path / MAP)

    def cameras(self) -> CamerasFile | None:
        """cameras.json; None where there is none, InputError where it was damaged."""
        return read_cameras(self.path)

    def keep_cameras(self, content: CamerasFile | None) -> None:
        """Write cameras.json, or remove what is of no camera any more."""
        if content is None:
            (self.path / CAMERAS).unlink(missing_ok=True)
        else:
            write_cameras(self.path, content)

    def keep_report(self, page: str) -> None:
        """Write report.html."""
        write_text(self.path / REPORT, page)


@contextmanager
def held(path: Path) -> Iterator[RunFolder]:
    """The folder, made and held, so that a second run on it writes nothing between the first one's files.

    What a killed run had begun to write is removed, and so is a new folder into which nothing came.
    """
    new = not path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
        lock = (path / LOCK).open("w", encoding="utf-8")
    except (FileExistsError, NotADirectoryError):
        raise InputError(f"{path}: is a file; name a folder for the results") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another folder") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{path}: another jcr is writing there; wait for it or choose another") from None
        for place in (path, *(path / CAPTURE).rglob("."), path / ADDED):
            remove_unfinished(place)
        try:
            yield RunFolder(path)
        finally:
            if new and os.listdir(path) == [LOCK]:
                shutil.rmtree(path)


def state_of(capture: Capture, reconstruct: ReconstructOptions, calibrate: CalibrateOptions) -> State:
    """The state of a run with these options, before anything was tried."""
    # What auto stands for changes with the weights that are on this machine.
    options = reconstruct.as_json() | {"backend": candidates(reconstruct)}
    return State(
        capture=str(capture.folder.resolve()),
        reconstruct=fingerprint(capture, options),
        options=MadeWith(reconstruct=reconstruct.with_absolute_paths(), calibrate=calibrate),
    )


def fingerprint(capture: Capture, options: dict[str, Any]) -> str:
    """A hash of all that a stage's result depends on: images, poses, intrinsics, options and version."""
    digest = hashlib.sha256()
    for name in capture.images:
        digest.update(name.encode() + b"\0" + hashlib.sha256((capture.folder / name).read_bytes()).digest())
    digest.update(capture.base_from_gripper.tobytes())
    lens = None if capture.intrinsics is None else asdict(capture.intrinsics)
    for name in ("weights", "predictions", "cameras"):
        if options[name] is None:
            continue
        # Gigabytes at times: size and date tell one file of that name from another.
        path = Path(options[name])
        files = sorted(path.iterdir()) if path.is_dir() else [path] if path.is_file() else []
        states = [[str(file), file.stat().st_size, file.stat().st_mtime_ns] for file in files]
        options = options | {name: states or options[name]}
    digest.update(json.dumps([lens, options, __version__, FORMAT], sort_keys=True).encode())
    return digest.hexdigest()
