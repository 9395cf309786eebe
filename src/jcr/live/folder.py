"""The capture folder while it grows: whole after every image, so that stopping loses nothing."""

import json
import re
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray

from jcr.capture.camera_json import read_intrinsics, read_std
from jcr.capture.capture_json import FILE, read_joints
from jcr.capture.checks import read_rigid
from jcr.capture.images import encode_png, read_image
from jcr.capture.plain_files import contained, read_json
from jcr.errors import InputError
from jcr.files import write_bytes, write_text
from jcr.handeye.arms import ROBOT_NAMES
from jcr.records import Capture

THUMBNAIL_PX = 240


class LiveFolder:
    """A capture folder that images are added to; what it holds already is kept."""

    def __init__(self, folder: Path, intrinsics: dict[str, Any] | None = None, robot: str | None = None):
        """Raises InputError when `folder` holds a capture.json that cannot be resumed."""
        self.folder = folder
        self._lock = threading.Lock()
        self.names: list[str] = []
        self.poses: list[Float[ndarray, "4 4"]] = []
        self.joints: list[Float[ndarray, " dof"] | None] = []
        self.depths: list[str | None] = []
        self.times_s: list[float | None] = []
        self.intrinsics = intrinsics
        self.size: tuple[int, int] | None = None
        self.rest: dict[str, Any] = {"source": {"program": "jcr capture"}}
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file; name a folder for the capture")
        if (folder / FILE).exists():
            self._resume(read_json(folder / FILE))
        if robot is not None:
            self.rest["robot"] = robot
        self._stamped_before = tuple(self.names)

    def _resume(self, content: Any) -> None:
        file = self.folder / FILE
        if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
            raise InputError(f'{file}: has no list "frames"; name a new folder for the capture')
        for row, frame in enumerate(content["frames"]):
            if not isinstance(frame, dict) or not isinstance(frame.get("image"), str):
                raise InputError(f"{file}: frame {row} names no image; name a new folder for the capture")
            where = f"{file}: frame {row}"
            height, width = read_image(contained(self.folder, frame["image"], where)).shape[:2]
            self.size = (width, height)
            self.names.append(frame["image"])
            self.poses.append(read_rigid(frame.get("base_from_gripper"), where))
            angles, depth = frame.get("joints"), frame.get("depth")
            self.joints.append(None if angles is None else read_joints(angles, f"{where}: joints"))
            self.depths.append(depth if isinstance(depth, str) else None)
            time_s = frame.get("time_s")
            self.times_s.append(float(time_s) if isinstance(time_s, int | float) else None)
        self.intrinsics = self.intrinsics or content.get("intrinsics")
        self.rest = {key: content[key] for key in content if key not in ("frames", "intrinsics")}

    def add(
        self,
        image: UInt8[ndarray, "h w 3"],
        base_from_gripper: Float[ndarray, "4 4"],
        joints: Float[ndarray, " dof"] | None = None,
        depth_mm: UInt16[ndarray, "h w"] | None = None,
        time_s: float | None = None,
    ) -> str:
        """Keep an image (RGB) and its pose, and return the image's name; capture.json is whole again after.

        `joints` (rad) are kept when all images have them. Raises InputError where the image's size is not that of the
        others.
        """
        size = (image.shape[1], image.shape[0])
        if self.size not in (None, size):
            raise InputError(
                f"{self.folder}: holds images of {self.size[0]}x{self.size[1]} pixels, the camera gives "
                f"{size[0]}x{size[1]}; set its old resolution or name a new folder"
            )
        if self.intrinsics is not None:
            read_intrinsics(self.intrinsics, size, self.folder / FILE)
        name = f"images/{self._next_number():03d}.png"
        write_bytes(self.folder / name, encode_png(image))
        depth = None
        if depth_mm is not None:
            depth = f"depth/{Path(name).stem}.png"
            write_bytes(self.folder / depth, encode_png(depth_mm))
        height = round(THUMBNAIL_PX * size[1] / size[0])
        bgr = np.ascontiguousarray(image[..., ::-1])
        small = cv2.resize(bgr, (THUMBNAIL_PX, height), interpolation=cv2.INTER_AREA)
        write_bytes(self.folder / self.thumbnail(name), cv2.imencode(".jpg", small)[1].tobytes())
        with self._lock:
            self.size = size
            self.names.append(name)
            self.poses.append(base_from_gripper)
            self.joints.append(joints)
            self.depths.append(depth)
            self.times_s.append(time_s)
            self._write()
        return name

    def remove(self, name: str) -> None:
        """Take an image out of the capture; capture.json is whole before its files are deleted."""
        with self._lock:
            row = self.names.index(name)
            files = [name, self.thumbnail(name), *filter(None, [self.depths[row]])]
            for of_images in (self.names, self.poses, self.joints, self.depths, self.times_s):
                del of_images[row]
            self._stamped_before = tuple(one for one in self._stamped_before if one != name)
            self._write()
        for file in files:
            contained(self.folder, file, str(self.folder)).unlink(missing_ok=True)

    def places(self) -> list[tuple[str, Float[ndarray, "4 4"]]]:
        """The images and their gripper poses, while another thread may add to them."""
        with self._lock:
            return list(zip(self.names, self.poses, strict=True))

    def seconds_back(self, name: str) -> float | None:
        """By how much an image was stamped before the one taken before it; None where it was not, or has no stamp.

        Another run of the program, which took the images that were there before, may have had another clock.
        """
        with self._lock:
            row = self.names.index(name) if name in self.names else 0
            if row == 0 or (self.names[row - 1] in self._stamped_before) != (name in self._stamped_before):
                return None
            now, before = self.times_s[row], self.times_s[row - 1]
        return before - now if now is not None and before is not None and now <= before else None

    def capture(self) -> Capture:
        """The images so far as a capture, of one image too; they were checked when they were taken."""
        with self._lock:
            return self._capture()

    def _capture(self) -> Capture:
        assert self.size is not None
        intrinsics = read_intrinsics(self.intrinsics, self.size, self.folder / FILE)
        return Capture(
            folder=self.folder,
            images=tuple(self.names),
            base_from_gripper=np.stack(self.poses),
            image_size=self.size,
            intrinsics=intrinsics,
            intrinsics_std=read_std(self.rest.get("intrinsics_std"), intrinsics, self.folder / FILE),
            joints=self.all_joints(),
            robot=name if (name := self.rest.get("robot")) in ROBOT_NAMES else None,
            depths=tuple(self.depths) if any(self.depths) else None,
        )

    def all_joints(self) -> Float[ndarray, "n dof"] | None:
        """Joint angles (rad) of all images, or None where one lacks them."""
        known = [angles for angles in self.joints if angles is not None]
        return np.stack(known) if known and len(known) == len(self.joints) else None

    def _write(self) -> None:
        frames: list[dict[str, Any]] = []
        for row, (name, pose) in enumerate(zip(self.names, self.poses, strict=True)):
            frame: dict[str, Any] = {"image": name, "base_from_gripper": pose.tolist()}
            if all(angles is not None for angles in self.joints):
                frame["joints"] = np.asarray(self.joints[row]).tolist()
            if self.depths[row] is not None:
                frame["depth"] = self.depths[row]
            if self.times_s[row] is not None:
                frame["time_s"] = self.times_s[row]
            frames.append(frame)
        content = {"frames": frames, "intrinsics": self.intrinsics, **self.rest}
        write_text(self.folder / FILE, json.dumps(content, indent=1) + "\n")

    @staticmethod
    def thumbnail(name: str) -> str:
        """Where the small copy of an image lies, in the folder."""
        return f"thumbnails/{Path(name).stem}.jpg"

    def _next_number(self) -> int:
        numbers = [int(match[1]) for name in self.names if (match := re.match(r"images/(\d+)\.", name))]
        return max(numbers, default=-1) + 1
