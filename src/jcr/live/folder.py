"""Capture folder to which images are added one by one; its files are a complete capture after every change."""

import re
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray
from numpy.typing import ArrayLike

from jcr.calibration.checks.images import STILL as MOVED
from jcr.capture.checks import far_faults
from jcr.capture.formats.capture_json import FILE, frame_of, read_capture_json, stated_fields
from jcr.capture.images import encode_png, read_image, size_of_all
from jcr.errors import InputError, other_size
from jcr.files import IMAGES, capture_file, path_inside, remove_unfinished, write_bytes, write_text
from jcr.geometry import largest_motion
from jcr.live.kept_frames import ImageSummary
from jcr.records import Capture, FrameNames
from jcr.records.capture_schema import CaptureFile, FrameEntry, IntrinsicsEntry, read_rigid
from jcr.records.json_file import validated_content

Channels = Literal["rgb", "bgr"]
"""Order of the colour channels of an image."""


class LiveFolder:
    """Capture folder to which images are added and from which they are removed; an existing capture is continued.

    Only one thread at a time may change it, but any thread may read it at any time. The files of removed images are
    deleted by `close`, so that a removal can be undone before.
    """

    def __init__(
        self,
        folder: Path,
        intrinsics: IntrinsicsEntry | None = None,
        robot: str | None = None,
        frame_names: FrameNames | None = None,
    ) -> None:
        """Open or begin a capture; raise InputError if the folder or its capture.json cannot be used.

        `intrinsics`, `robot` (name of the arm) and `frame_names` replace those of an existing capture.json; None: they
        are kept.
        """
        self.folder, file = folder, folder / FILE
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file; name a folder for the capture")
        content = CaptureFile(frames=[], intrinsics=None, source={"program": "jcr capture"})  # pyright: ignore[reportCallIssue]
        if file.exists():
            content = read_capture_json(file)
        self.images = tuple(frame_of(content, row, file) for row in range(len(content.frames)))
        given = {"intrinsics": intrinsics, "robot": robot, "frame_names": frame_names}
        update = {key: value for key, value in given.items() if value is not None}
        self._content = content.model_copy(update=update)
        files = {name: capture_file(folder, name, str(file)) for name in self.names}
        sizes = {name: read_image(path).shape[1::-1] for name, path in files.items()}
        self.size = size_of_all(sizes, str(file)) if sizes else None
        remove_unfinished(folder / IMAGES)
        self._earlier: list[tuple[FrameEntry, ...]] = []
        """Entries of the images before each change since the folder was opened, the newest change last."""
        self._summaries: dict[str, ImageSummary] = {}
        self._ever = {one.image: one for one in self.images}
        # The next number is above those of all image files, including files that capture.json does not name.
        files = [*self.names, *(f"{IMAGES}/{file.name}" for file in (folder / IMAGES).glob("*.png"))]
        numbers = [int(match[1]) for name in files if (match := re.match(r"images/([0-9]{1,9})\.", name))]
        self._next_number = max(numbers, default=0) + 1  # the first file is 001, as the page counts

    @property
    def names(self) -> list[str]:
        """Names of the images, in the order in which they were taken."""
        return [one.image for one in self.images]

    @property
    def can_undo(self) -> bool:
        """Whether `undo` has a change to undo, made since the folder was opened."""
        return len(self._earlier) > 0

    def summary(self, name: str) -> ImageSummary:
        """Return the summary (grey levels, sharpness) of the image of this name in the folder, computed once."""
        if name not in self._summaries:
            self._summaries[name] = ImageSummary.of(read_image(self.folder / name))
        return self._summaries[name]

    def add(
        self,
        image: ArrayLike,
        base_from_gripper: ArrayLike,
        joints: ArrayLike | None = None,
        time_s: float | None = None,
        depth_mm: UInt16[ndarray, "h w"] | None = None,
        color: Channels = "rgb",
        replaces: str | None = None,
    ) -> str:
        """Check an image and its gripper pose, write both, and return the name of the image.

        The arguments are those of `LiveCalibration.add`; `joints` are written only if all images have them. The image
        named `replaces` is removed in the same step; None: none is. Raises
        InputError if the image or the pose does not fit the capture, and OSError if a file cannot be written. The
        capture is then unchanged.
        """
        number, stem = f"image {len(self.images) + 1}", f"{self._next_number:03d}"
        pixels = checked_image(image, color, number)
        where = f"{number}: base_from_gripper"
        if np.shape(base_from_gripper) == (3, 3):
            lacks = "a rotation (3x3) has no translation; give 4x4 with the position in metres"
            raise InputError(f"{where}: {lacks}")
        pose = read_rigid(base_from_gripper, where)
        far_faults(pose[None, :3, 3], where, [where])
        size, summary = (pixels.shape[1], pixels.shape[0]), ImageSummary.of(pixels)
        if self.size not in (None, size):
            remedy = "set its old resolution or name a new folder"
            raise other_size("the camera's image", size, self.size, f"those in {self.folder}", remedy)
        others = tuple(one for one in self.images if one.image != replaces)
        self._refuse_repeated(summary, pose, number, others)
        entry = {"image": f"{IMAGES}/{stem}.png", "base_from_gripper": pose, "time_s": time_s}
        entry |= {"joints": None if joints is None else np.asarray(joints, np.float64).tolist()}
        entry |= {"depth": None if depth_mm is None else f"depth/{stem}.png"}
        new: FrameEntry = validated_content(FrameEntry, entry, number)
        images = (*others, new)
        if len({len(one.joints) for one in images if one.joints is not None}) > 1:
            raise InputError(f"joints of {new.image}: not as many angles as the other images have; give all")
        self._capture_of(images, size)
        try:
            write_bytes(path_inside(self.folder, new.image, str(self.folder)), encode_png(pixels))
            if new.depth is not None and depth_mm is not None:
                write_bytes(path_inside(self.folder, new.depth, str(self.folder)), encode_png(depth_mm))
            self._change(images)
        except OSError:
            self._delete(new)
            raise
        self.size = size
        self._summaries[new.image], self._ever[new.image] = summary, new
        self._next_number += 1
        return new.image

    def remove(self, name: str) -> None:
        """Remove the image of this name from capture.json; its files stay until `close`."""
        self._change(tuple(one for one in self.images if one.image != name))

    def undo(self) -> bool:
        """Undo the last addition or removal since the folder was opened; return whether there was one."""
        if not self._earlier:
            return False
        self._write(self._earlier[-1])
        self.images = self._earlier.pop()
        return True

    def close(self) -> None:
        """Delete the files of the removed images; earlier changes can no longer be undone."""
        for name in self._ever.keys() - set(self.names):
            self._delete(self._ever.pop(name))
        self._earlier.clear()

    def capture(self) -> Capture | None:
        """Return a capture of all images that the folder has now; None before the first image."""
        images = self.images
        return None if not images or self.size is None else self._capture_of(images, self.size)

    def _refuse_repeated(
        self, new: ImageSummary, base_from_gripper: ndarray, number: str, others: tuple[FrameEntry, ...]
    ) -> None:
        """Raise InputError if the image `new` is the same as one of the `others`, whether the gripper moved or not."""
        for one in others:
            if not new.is_like(self.summary(one.image)):
                continue
            metres, radians = largest_motion(np.stack([one.base_from_gripper, base_from_gripper]))
            if metres < MOVED[0] and radians < MOVED[1]:
                raise InputError(f"{number}: repeats {one.image}, image and pose; move the arm")
            raise InputError(
                f"{number}: is the same as {one.image}, though the gripper moved by {1e3 * metres:.0f} mm and "
                f"{np.degrees(radians):.0f}°; check that the camera's stream is live"
            )

    def _capture_of(self, images: tuple[FrameEntry, ...], size: tuple[int, int]) -> Capture:
        """Return the capture with these entries of images of `size` (width, height) px.

        Raises InputError if other entries of capture.json, such as the intrinsics, do not fit the images.
        """
        return Capture(
            folder=self.folder,
            images=tuple(one.image for one in images),
            base_from_gripper=np.stack([one.base_from_gripper for one in images]),
            image_size=size,
            **stated_fields(self._content, images, size, self.folder / FILE),
        )

    def _change(self, images: tuple[FrameEntry, ...]) -> None:
        """Replace the images of capture.json by these; keep the previous ones for `undo`."""
        self._write(images)
        self._earlier.append(self.images)
        self.images = images

    def _write(self, images: tuple[FrameEntry, ...]) -> None:
        """Write capture.json with these images; joint angles are left out unless all images have them."""
        some_joints = None if all(one.joints is not None for one in images) else {"joints"}
        frames = [one.model_dump(mode="json", exclude_none=True, exclude=some_joints) for one in images]
        write_text(self.folder / FILE, self._content.model_copy(update={"frames": frames}).as_text())

    def _delete(self, one: FrameEntry) -> None:
        """Delete the files of an image: colour and depth."""
        for file in filter(None, (one.image, one.depth)):
            path_inside(self.folder, file, str(self.folder)).unlink(missing_ok=True)


def checked_image(image: ArrayLike, color: str, number: str) -> UInt8[ndarray, "h w 3"]:
    """Return an image in RGB, (h,w,3) uint8; grey images (h,w) or (h,w,1) are converted.

    Raises InputError for any other array or a path; its message starts with `number`, the image's name for the user.
    """
    if isinstance(image, str | Path):
        raise InputError(
            f"{number}: {image} is a path; give the pixels, numpy.array(PIL.Image.open(path).convert('RGB'))"
        )
    if color not in ("rgb", "bgr"):
        raise InputError(f'color={color!r}: give "rgb", or "bgr" for images of OpenCV')
    pixels = np.asarray(image)
    if pixels.dtype != np.uint8:
        raise InputError(
            f"{number}: {pixels.dtype} values; give uint8 from 0 to 255 "
            "(of floats from 0 to 1: (255 * image).round().astype(numpy.uint8))"
        )
    if pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 1):
        pixels = np.repeat(pixels.reshape(*pixels.shape[:2], 1), 3, axis=2)
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise InputError(f"{number}: shape {pixels.shape}; give (height, width, 3), of RGBA image[..., :3]")
    return np.ascontiguousarray(pixels[..., ::-1] if color == "bgr" else pixels)
