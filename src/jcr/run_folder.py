"""Files of a run folder: writing under a lock, the fingerprints of what they were made from, and validated reading.

A run folder is input like any other: it may have been edited or cut. An invalid file raises InputError of one line.
"""

import fcntl
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jcr import __version__
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration, read_calibration, write_calibration
from jcr.calibration.words import log
from jcr.capture.added import FOLDER as ADDED
from jcr.capture.formats.capture_json import kept
from jcr.capture.plain_files import first_fault
from jcr.capture.read import read_capture
from jcr.cell.placement import FILE as CAMERAS
from jcr.cell.placement import CamerasFile, read_cameras, write_cameras
from jcr.depth.depth_npz import FILE as DEPTH
from jcr.depth.depth_npz import FORMAT as DEPTH_FORMAT
from jcr.depth.depth_npz import is_made_from, read_depth, write_depth
from jcr.depth.options import DepthOptions
from jcr.errors import InputError
from jcr.files import read_bytes, remove_unfinished, write_text
from jcr.reconstruct import ReconstructOptions, candidates
from jcr.reconstruction_npz import FORMAT, read_reconstruction, write_reconstruction
from jcr.records import Attempt, Capture, PointCloud, Reconstruction
from jcr.scene.cloud_ply import read_cloud, write_cloud
from jcr.scene.map_file import FILE as MAP
from jcr.scene.map_file import load_map

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap

LOCK = ".lock"
"""Locked by the run that writes there."""
MOVING = "moving"
"""Images of a fixed camera without what stands still; a carried thing is reconstructed from them."""
CAPTURE = "capture"
"""Images and poses that were read from another format than capture.json."""
LIVE = "result"
"""Run folder of all images, in the folder of a capture that was calibrated while it was taken."""
STATE = "run.json"
"""The capture, the options of its calibration, and what reconstruction.npz was made from."""
RECONSTRUCTION, CALIBRATION, LOG = "reconstruction.npz", "calibration.json", "log.txt"
CLOUD, REPORT = "cloud.ply", "report.html"
OF_RECONSTRUCTION = (STATE, DEPTH, RECONSTRUCTION)
"""A kill between two of them leaves none without what it was made from."""
OF_CALIBRATION = (CLOUD, MAP, REPORT, CAMERAS)
"""Files that belong to one calibration alone."""
PASSING = {"timings_s", "warnings", "notes", "version", "attempts", "requirement", "next_poses"}
"""Fields of calibration.json that may differ between two files of the same calibration."""


class MadeWith(BaseModel):
    """Options that a calibration was made with."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    reconstruct: ReconstructOptions
    calibrate: CalibrateOptions
    depth: DepthOptions = DepthOptions()


class State(BaseModel):
    """Content of run.json."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    capture: Annotated[str, Field(max_length=4096, pattern=r"^[^\x00]+$")]
    """Folder of the capture."""
    reconstruct: str
    """The fingerprint of what reconstruction.npz was made from."""
    options: MadeWith
    attempts: tuple[Attempt, ...] = ()
    """Attempts from which that reconstruction was selected."""
    complete: str | None = None
    """The fingerprint of all that a finished run was made from and of its calibration.json; None of one that was not
    finished."""

    @property
    def depth(self) -> str:
        """The fingerprint of the depth.npz that belongs to it."""
        options = asdict(self.options.depth)
        del options["dense"]  # whether it is made changes nothing in it
        return hashlib.sha256(json.dumps([self.reconstruct, options, DEPTH_FORMAT]).encode()).hexdigest()


@dataclass(frozen=True)
class RunFolder:
    """Folder with the files of one run."""

    path: Path

    def state(self) -> State:
        """Read run.json; raise InputError where there is no run, or its file was damaged."""
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
        """Return the capture that the run was made from; raise InputError without a run, or without the capture."""
        name = self.state().capture
        try:
            return read_capture(name)
        except InputError:
            raise
        except OSError as error:  # a path that no file system takes
            raise InputError(f"{self.path / STATE}: capture: {error.strerror}; run `jcr run` again") from None

    def capture_of(self, calibration: Calibration) -> Capture:
        """Return the capture that a calibration was made from; InputError where it has other images now."""
        capture = self.capture()
        if [image.image for image in calibration.images] != list(capture.images):
            raise InputError(
                f"{capture.folder}: has changed since {self.path} was made; run `jcr calibrate` again"
            )
        return capture

    def options(self) -> MadeWith:
        """Return the options that the calibration was made with; raise as `state` does."""
        return self.state().options

    def calibration(self) -> Calibration:
        """Read calibration.json; raise InputError where there is none, or it was damaged."""
        return read_calibration(self.path)

    def reconstruction(self, depth: str | None = None) -> Reconstruction:
        """Read reconstruction.npz, with the pointmaps of a depth.npz (of the fingerprint `depth` alone).

        InputError where there is no reconstruction, or a file was damaged.
        """
        found = read_reconstruction(self.path / RECONSTRUCTION)
        file = self.path / DEPTH
        there = file.is_file() if depth is None else is_made_from(file, depth)
        if found.pointmaps is None and there:
            found = replace(found, pointmaps=read_depth(file, found, self._capture_if_there()))
        return found

    def _capture_if_there(self) -> Capture | None:
        """Return the capture that the run was made from; None where it is no longer there."""
        try:
            return self.capture()
        except InputError:
            return None

    def calibrated(self) -> tuple[Calibration, Reconstruction]:
        """Return a calibration and the reconstruction that it was made from.

        Raises InputError where either is missing or damaged, nothing was found, or they are not of the same images.
        """
        calibration = self.calibration()
        if calibration.mount == "base":
            raise InputError(
                f"{self.path}: is for a camera that watches the gripper; this needs a camera on the gripper"
            )
        if calibration.parent_from_camera is None:
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
        """Read cloud.ply; raise InputError where there is none, or it was damaged."""
        return read_cloud(self.path / CLOUD)

    def scene(self) -> "SceneMap":
        """Read map.safetensors; raise InputError where there is none, it is damaged, or its packages are missing."""
        return load_map(self.path)

    def has_map(self) -> bool:
        """Test whether there is a map, sound or not."""
        return (self.path / MAP).is_file()

    def earlier(self, state: State) -> State | None:
        """Return the state of an earlier run whose reconstruction was made from the same input; None without one.

        A state that cannot be read proves nothing: to make every stage again is always right.
        """
        try:
            found = self.state()
        except InputError:
            return None
        same = found.reconstruct == state.reconstruct and (self.path / RECONSTRUCTION).is_file()
        return found if same else None

    def reuse_reconstruction(self, state: State) -> tuple[Reconstruction, State] | None:
        """Return the reconstruction of an earlier run of the same input, with its pointmaps, and that run's state."""
        earlier = self.earlier(state)
        return None if earlier is None else (self.reconstruction(state.depth), earlier)

    def reuse_live(self, capture: Capture, state: State) -> tuple[Reconstruction, State] | None:
        """Return reconstruction and state that `jcr capture` left in the capture's folder, and keep them here, too."""
        live = RunFolder(capture.folder / LIVE)
        if live.path.resolve() == self.path.resolve():
            return None
        try:
            found = live.reuse_reconstruction(state)
        except InputError:
            return None  # Damaged; it is made again.
        if found is not None:
            self.keep_reconstruction(found[0], state.model_copy(update={"attempts": found[1].attempts}))
        return found

    def keep_capture(self, capture: Capture) -> Capture:
        """Return the capture as later commands will find it: where it lies, or copied if it is of another format."""
        return kept(capture, self.path / CAPTURE)

    def keep_reconstruction(self, reconstruction: Reconstruction, state: State) -> None:
        """Write a reconstruction, then its fingerprint; pointmaps that were estimated become depth.npz."""
        for name in (STATE, DEPTH):  # of the one before
            (self.path / name).unlink(missing_ok=True)
        pointmaps = reconstruction.pointmaps
        predicted = pointmaps if pointmaps is not None and pointmaps.is_predicted else None
        write_reconstruction(self.path / RECONSTRUCTION, replace(reconstruction, pointmaps=predicted))
        self.keep_state(state)
        self.keep_depth(reconstruction, state)

    def has_depth(self, reconstruction: Reconstruction, state: State) -> bool:
        """Test whether depth.npz was made from this reconstruction with these options."""
        return is_made_from(self.path / DEPTH, state.depth)

    def keep_depth(self, reconstruction: Reconstruction, state: State) -> None:
        """Write depth.npz, where the reconstruction has estimated pointmaps and they are not there already."""
        pointmaps = reconstruction.pointmaps
        if pointmaps is None or pointmaps.is_predicted or self.has_depth(reconstruction, state):
            return
        write_depth(self.path / DEPTH, reconstruction, state.depth)

    def keep_state(self, state: State) -> None:
        """Write run.json."""
        write_text(
            self.path / STATE, json.dumps(state.model_dump(mode="json", warnings=False), indent=2) + "\n"
        )

    def forget_reconstruction(self) -> None:
        """Remove the reconstruction of another capture, or of other options."""
        for name in OF_RECONSTRUCTION:
            (self.path / name).unlink(missing_ok=True)

    def keep_calibration(self, content: Calibration) -> None:
        """Write calibration.json and log.txt; what was made from another one goes first, so that the two never mix."""
        try:
            same = self.calibration().model_dump(exclude=PASSING) == content.model_dump(exclude=PASSING)
        except InputError:
            same = False
        if not same:
            for name in OF_CALIBRATION:
                (self.path / name).unlink(missing_ok=True)
        self.amend_calibration(content)

    def amend_calibration(self, content: Calibration) -> None:
        """Write calibration.json and log.txt with more of the same calibration: times, warnings of the map."""
        write_calibration(self.path / CALIBRATION, content)
        write_text(self.path / LOG, log(content))

    def keep_map(self, cloud: PointCloud, scene: "SceneMap") -> None:
        """Write cloud.ply and map.safetensors."""
        write_cloud(self.path / CLOUD, cloud)
        scene.save(self.path / MAP)

    def cameras(self) -> CamerasFile | None:
        """Read cameras.json; return None where there is none, raise InputError where it was damaged."""
        return read_cameras(self.path)

    def keep_cameras(self, content: CamerasFile | None) -> None:
        """Write cameras.json, or remove it where there are no cameras."""
        if content is None:
            (self.path / CAMERAS).unlink(missing_ok=True)
        else:
            write_cameras(self.path, content)

    def keep_complete(self, capture: Capture, options: Any) -> None:
        """Note in run.json that all files of a run of this capture with these options are there."""
        self.keep_state(self.state().model_copy(update={"complete": self._completion(capture, options)}))

    def is_complete(self, capture: Capture, options: Any) -> bool:
        """Test whether a run of the same input is finished, and its files were neither changed nor removed since."""
        try:
            files = [REPORT]
            if self.calibration().parent_from_camera is not None:
                files += [RECONSTRUCTION] + ([] if options.map is None else [CLOUD, MAP])
            if not all((self.path / name).is_file() for name in files):
                return False
            return self.state().complete == self._completion(capture, options)
        except InputError:
            return False

    def _completion(self, capture: Capture, options: Any) -> str:
        made = fingerprint(capture, _deciding(options.reconstruct))
        paths = [] if capture.urdf is None else [capture.urdf]
        paths += [capture.folder / name for name in capture.depths or () if name is not None]
        paths += [
            (camera.folder or capture.folder) / name for camera in capture.others for name in camera.images
        ]
        paths += sorted((self.path / ADDED).rglob("*"))
        states = [[str(path), path.stat().st_size, path.stat().st_mtime_ns] for path in paths]
        digest = hashlib.sha256(json.dumps([made, asdict(options), states], default=str).encode())
        with np.printoptions(threshold=sys.maxsize):
            digest.update(repr(capture).encode())
        digest.update(read_bytes(self.path / CALIBRATION))
        return digest.hexdigest()

    def keep_report(self, page: str) -> None:
        """Write report.html."""
        write_text(self.path / REPORT, page)


@contextmanager
def locked(path: Path) -> Iterator[RunFolder]:
    """Make and lock the folder, so that a second run on it writes nothing between the first one's files.

    What a killed run had begun to write is removed, and so is a new folder into which nothing came.
    """
    new = not path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
        lock = (path / LOCK).open("w", encoding="utf-8")
    except (FileExistsError, NotADirectoryError):
        file = next(part for part in (path, *path.parents) if part.is_file())
        raise InputError(f"{file}: is a file; name a folder for the results") from None
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


def state_of(capture: Capture, options: MadeWith) -> State:
    """Return the state of a run with these options, before anything was tried; raise InputError for a name not UTF-8."""
    try:
        str(capture.folder.resolve()).encode()
    except UnicodeEncodeError:
        raise InputError(f"{capture.folder}: a folder whose name is not UTF-8; rename it") from None
    return State(
        capture=str(capture.folder.resolve()),
        reconstruct=fingerprint(capture, _deciding(options.reconstruct)),
        options=options.model_copy(update={"reconstruct": options.reconstruct.with_absolute_paths()}),
    )


def _deciding(options: ReconstructOptions) -> dict[str, Any]:
    """Return the options that decide a reconstruction, with the back ends that `auto` means on this machine."""
    return options.as_json() | {"backend": candidates(options)}


def fingerprint(capture: Capture, options: dict[str, Any]) -> str:
    """Return a hash of the input of a reconstruction: images, poses, intrinsics, options, version and file format."""
    digest = hashlib.sha256()
    for name in capture.images:
        digest.update(name.encode() + b"\0" + hashlib.sha256((capture.folder / name).read_bytes()).digest())
    digest.update(capture.base_from_gripper.tobytes())
    intrinsics = None if capture.intrinsics is None else asdict(capture.intrinsics)
    for name in ("weights", "predictions", "cameras"):
        if options[name] is None:
            continue
        # Gigabytes at times: size and date distinguish files of one name.
        path = Path(options[name])
        files = sorted(path.iterdir()) if path.is_dir() else [path] if path.is_file() else []
        states = [[str(file), file.stat().st_size, file.stat().st_mtime_ns] for file in files]
        options = options | {name: states or options[name]}
    digest.update(json.dumps([intrinsics, options, __version__, FORMAT], sort_keys=True).encode())
    return digest.hexdigest()
