"""Capture folder that grows image by image and is complete after every change, so that stopping loses nothing."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray

from jcr.capture.camera_info import read_intrinsics, read_std
from jcr.capture.checks import read_rigid
from jcr.capture.formats.capture_json import FILE, read_joints
from jcr.capture.images import encode_png, other_size, read_image
from jcr.capture.plain_files import contained, read_json
from jcr.errors import InputError
from jcr.estimation.arms import ROBOT_NAMES
from jcr.files import remove_unfinished, write_bytes, write_text
from jcr.live.stillness import ImageSummary
from jcr.records import Capture

IMAGES = "images"


@dataclass(frozen=True, eq=False, kw_only=True)
class TakenImage:
    """Image of the capture with the data recorded with it."""

    name: str
    """File in the folder."""
    base_from_gripper: Float[ndarray, "4 4"]
    joints: Float[ndarray, " dof"] | None
    """Joint angles (rad); None where they are not known."""
    depth: str | None
    """File of a depth camera's image."""
    time_s: float | None
    """Time on the camera's clock."""


class LiveFolder:
    """Capture folder whose images are added, replaced and removed; images that it holds already are kept.

    One thread at a time makes changes; others may read at any time. The files of removed images stay until `close`, so
    that a change can be undone.
    """

    def __init__(self, folder: Path, intrinsics: dict[str, Any] | None = None, robot: str | None = None):
        """Open or begin a capture; `intrinsics` in the form of capture.json. Raise InputError for unusable folders."""
        self.folder = folder
        self.images: tuple[TakenImage, ...] = ()
        self.intrinsics = intrinsics
        self.size: tuple[int, int] | None = None
        self.rest: dict[str, Any] = {"source": {"program": "jcr capture"}}
        """Other keys of capture.json."""
        self._earlier: list[tuple[TakenImage, ...]] = []
        """Images before each change of this session."""
        self._summaries: dict[str, ImageSummary] = {}
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file; name a folder for the capture")
        if (folder / FILE).exists():
            self._resume(read_json(folder / FILE))
        remove_unfinished(folder / IMAGES)
        if robot is not None:
            self.rest["robot"] = robot
        self._before_session = frozenset(self.names)
        self._ever: dict[str, TakenImage] = {one.name: one for one in self.images}
        self._next_number = self._first_free_number()

    def _resume(self, content: Any) -> None:
        """Take the images and other keys of an existing capture.json."""
        file = self.folder / FILE
        if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
            raise InputError(f'{file}: has no list "frames"; name a new folder for the capture')
        self.images = tuple(self._frame(frame, row) for row, frame in enumerate(content["frames"]))
        self.intrinsics = self.intrinsics or content.get("intrinsics")
        self.rest = {key: content[key] for key in content if key not in ("frames", "intrinsics")}

    def _frame(self, frame: Any, row: int) -> TakenImage:
        """Return the image of one entry of "frames", and set the size of images."""
        where = f"{self.folder / FILE}: frame {row}"
        if not isinstance(frame, dict) or not isinstance(frame.get("image"), str):
            raise InputError(f"{where} names no image; name a new folder for the capture")
        height, width = read_image(contained(self.folder, frame["image"], where)).shape[:2]
        self.size = (width, height)
        angles, depth, time_s = (frame.get(key) for key in ("joints", "depth", "time_s"))
        return TakenImage(
            name=frame["image"],
            base_from_gripper=read_rigid(frame.get("base_from_gripper"), where),
            joints=None if angles is None else read_joints(angles, f"{where}: joints"),
            depth=depth if isinstance(depth, str) else None,
            time_s=float(time_s) if isinstance(time_s, int | float) else None,
        )

    @property
    def names(self) -> list[str]:
        """Names of the images, in the order in which they were taken."""
        return [one.name for one in self.images]

    def summary(self, name: str) -> ImageSummary:
        """Return the summary of an image of the folder."""
        if name not in self._summaries:
            self._summaries[name] = ImageSummary.of(read_image(self.folder / name))
        return self._summaries[name]

    def add(
        self,
        image: UInt8[ndarray, "h w 3"],
        base_from_gripper: Float[ndarray, "4 4"],
        joints: Float[ndarray, " dof"] | None = None,
        depth_mm: UInt16[ndarray, "h w"] | None = None,
        time_s: float | None = None,
        replaces: str | None = None,
    ) -> str:
        """Write an image (RGB) with its pose and return its name; capture.json is complete again after that.

        `replaces` names an image that is removed. `joints` (rad) are written when all images have them. Raises
        InputError where the size differs from that of the others, and OSError where a file cannot be written; the
        capture is then unchanged.
        """
        size = (image.shape[1], image.shape[0])
        if self.size is not None and self.size != size:
            remedy = "set its old resolution or name a new folder"
            raise other_size("the camera's image", size, self.size, f"those in {self.folder}", remedy)
        if self.intrinsics is not None:
            read_intrinsics(self.intrinsics, size, self.folder / FILE)
        stem = f"{self._next_number:03d}"
        new = TakenImage(
            name=f"{IMAGES}/{stem}.png",
            base_from_gripper=base_from_gripper,
            joints=joints,
            depth=None if depth_mm is None else f"depth/{stem}.png",
            time_s=time_s,
        )
        try:
            write_bytes(self.folder / new.name, encode_png(image))
            if new.depth is not None and depth_mm is not None:
                write_bytes(self.folder / new.depth, encode_png(depth_mm))
            self._change((*(one for one in self.images if one.name != replaces), new))
        except OSError:
            self._delete(new)
            raise
        self.size = size
        self._summaries[new.name] = ImageSummary.of(image)
        self._ever[new.name] = new
        self._next_number += 1
        return new.name

    def remove(self, name: str) -> None:
        """Remove an image from the capture."""
        self._change(tuple(one for one in self.images if one.name != name))

    @property
    def can_undo(self) -> bool:
        """Whether this session made a change that is not undone."""
        return len(self._earlier) > 0

    def undo(self) -> bool:
        """Take back the last change of this session; return whether there was one."""
        if not self._earlier:
            return False
        self._write(self._earlier[-1])
        self.images = self._earlier.pop()
        return True

    def close(self) -> None:
        """Delete the files of images that this session removed; no change can be undone after that."""
        for name in self._ever.keys() - set(self.names):
            self._delete(self._ever.pop(name))
        self._earlier.clear()

    def _change(self, images: tuple[TakenImage, ...]) -> None:
        """Write capture.json with these images, and remember the present ones for `undo`."""
        self._write(images)
        self._earlier.append(self.images)
        self.images = images

    def _delete(self, one: TakenImage) -> None:
        """Delete the files of an image."""
        for file in filter(None, (one.name, one.depth)):
            contained(self.folder, file, str(self.folder)).unlink(missing_ok=True)

    def seconds_back(self, name: str) -> float | None:
        """Return the time by which an image was stamped before its predecessor; None where it was not, or is unknown.

        Images of an earlier session may have had another clock.
        """
        row = self.names.index(name) if name in self.names else 0
        before, now = self.images[row - 1 : row + 1] if row else (None, None)
        if before is None or now is None or now.time_s is None or before.time_s is None:
            return None
        if (before.name in self._before_session) != (name in self._before_session):
            return None
        return before.time_s - now.time_s if now.time_s <= before.time_s else None

    def capture(self) -> Capture | None:
        """Return the images as a capture, a single one too; None where there is none."""
        images = self.images
        if not images or self.size is None:
            return None
        intrinsics = read_intrinsics(self.intrinsics, self.size, self.folder / FILE)
        return Capture(
            folder=self.folder,
            images=tuple(one.name for one in images),
            base_from_gripper=np.stack([one.base_from_gripper for one in images]),
            image_size=self.size,
            intrinsics=intrinsics,
            intrinsics_std=read_std(self.rest.get("intrinsics_std"), intrinsics, self.folder / FILE),
            joints=_all_joints(images),
            robot=name if (name := self.rest.get("robot")) in ROBOT_NAMES else None,
            depths=tuple(one.depth for one in images) if any(one.depth for one in images) else None,
        )

    def _write(self, images: tuple[TakenImage, ...]) -> None:
        """Write capture.json with these images."""
        joints = _all_joints(images)
        frames: list[dict[str, Any]] = []
        for row, one in enumerate(images):
            frame: dict[str, Any] = {"image": one.name, "base_from_gripper": one.base_from_gripper.tolist()}
            optional = {
                "joints": None if joints is None else joints[row].tolist(),
                "depth": one.depth,
                "time_s": one.time_s,
            }
            frames.append(frame | {key: value for key, value in optional.items() if value is not None})
        content = {"frames": frames, "intrinsics": self.intrinsics, **self.rest}
        write_text(self.folder / FILE, json.dumps(content, indent=1) + "\n")

    def _first_free_number(self) -> int:
        """Return a number above those of all image files, files that no capture.json names included."""
        names = [*self.names, *(f"{IMAGES}/{file.name}" for file in (self.folder / IMAGES).glob("*.png"))]
        numbers = [int(match[1]) for name in names if (match := re.match(r"images/(\d+)\.", name))]
        return max(numbers, default=-1) + 1


def _all_joints(images: tuple[TakenImage, ...]) -> Float[ndarray, "n dof"] | None:
    """Return the joint angles (rad) of all images, or None where one lacks them."""
    known = [one.joints for one in images if one.joints is not None]
    return np.stack(known) if known and len(known) == len(images) else None
