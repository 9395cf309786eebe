"""Reading and writing of images, and measures of their exposure and sharpness."""

import io
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from numpy import ndarray
from PIL import Image

from jcr.errors import InputError, other_size
from jcr.files import require_file

MAX_PIXELS = 64_000_000
"""Largest number of pixels of an image. No wrist camera has more; a larger file may be a decompression bomb, which is
refused before it is unpacked."""
IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "GIF", "PPM")
"""Pillow's names of the formats that are read, by the content of the file. Others have readers that are little used, or
that start programs (PostScript)."""
MAX_SCANS = 100
"""Largest number of scans of a JPEG with its previews; progressive ones have about ten."""
ONE_CHANNEL = {"1": np.uint8, "L": np.uint8} | dict.fromkeys(("I", "I;16", "I;16B", "I;16L"), np.uint16)
"""Type of the values of a grey image by Pillow's mode; older versions of Pillow read 16 bits as 32."""
BLURRED = 0.25
"""Sharpness below which a frame is blurred, as a share of the median sharpness of the frames."""
ORIENTATION = 0x0112
"""EXIF tag that holds an image's orientation."""
TILE = 0x0142, 0x0143
"""Tags of a TIFF that hold width and height of its tiles (px); a tile may be larger than the image."""
BLURRED_EDGE = 1 / 80
"""Largest `edge_width` of a sharp image; images of eleven real arms have 1/300 to 1/98."""
EDGES_AT = 640
"""Long side (px) to which images are reduced before edges are measured; smaller images are measured as they are."""
FAR_PX = 16
"""Distance over which the whole rise of grey levels across an edge is measured."""
LEAST_CONTRAST = 20
"""Smallest rise of grey levels across the strongest edges from which their width is measured."""
ONE_VIEW = 0.25
"""Largest ratio, in images of one view, of the mean squared difference of details to the sum of both mean squares. On
fourteen real captures the ratio is below 0.1 for images of one place with noise of 6 levels, 0.35 where the robot holds
a board that fills a third of them, and above 0.75 between places."""
USUAL_GREY = 2.0
"""Smallest contrast (grey levels) by which details are normalised; noise of 4 levels has 0.6 after the filter."""
JPEG_QUALITY = 80
DARK, BRIGHT = 12, 243
"""Mean grey levels (0 to 255) below and above which an image is too dark or too bright to be used."""


@contextmanager
def opened_image(source: Path | bytes, where: str) -> Iterator[Image.Image]:
    """Open an image file, or the bytes of one, and yield it with its header read and its pixels not yet decoded.

    Raises InputError if it is no image, has more than MAX_PIXELS pixels or several images, or if decoding it under
    `with` fails.
    """
    if isinstance(source, Path):
        require_file(source)
    try:
        with warnings.catch_warnings():
            # Pillow's own bomb warning would end a run that treats warnings as errors; our limit is lower.
            warnings.simplefilter("ignore")
            file = source if isinstance(source, Path) else io.BytesIO(source)
            with Image.open(file, formats=IMAGE_FORMATS) as opened:
                require_pixels(opened.size, where)
                if opened.format in ("JPEG", "MPO"):
                    data = source.read_bytes() if isinstance(source, Path) else source
                    # Each scan decodes the whole image; the marker of a scan cannot be in its data.
                    if (count := data.count(b"\xff\xda")) > MAX_SCANS:
                        raise InputError(f"{where}: a JPEG of {count} scans; save it again")
                # Phones write MPO: a JPEG with previews behind it, whose first image is the photograph.
                # Counting the images would take hours for a file of a million.
                if opened.format != "MPO" and getattr(opened, "is_animated", False):
                    raise InputError(f"{where}: holds several images; save one as PNG or JPEG")
                if opened.format == "TIFF":
                    require_pixels(tuple(opened.getexif().get(tag, 1) for tag in TILE), where)
                yield opened
    except FileNotFoundError:
        raise InputError(f"{where}: no such image; correct its name or add the file") from None
    except InputError:
        raise
    except Image.DecompressionBombError:  # Pillow's own limit is above ours, but for previews and tiles
        raise InputError(f"{where}: over {MAX_PIXELS // 1_000_000} million pixels; shrink it") from None
    except Exception as error:  # decoders raise errors of many types for a damaged file
        raise InputError(f"{where}: not a readable image ({error}); save it again as PNG or JPEG") from None


def require_pixels(size: tuple[int, int], where: str) -> None:
    """Raise InputError if a `size` (width, height) is empty or has more than MAX_PIXELS pixels."""
    if min(size) < 1:
        raise InputError(f"{where}: {size[0]}x{size[1]} pixels, an empty image; take it again")
    if size[0] * size[1] > MAX_PIXELS:
        raise InputError(f"{where}: over {MAX_PIXELS // 1_000_000} million pixels; shrink it")


def read_image(source: Path | bytes, where: str | None = None) -> UInt8[ndarray, "h w 3"]:
    """Read an image file, or the bytes of one, as RGB; raise InputError if it is no image of 8 bits a channel.

    An image with an EXIF tag of rotation is refused, because viewers and other readers would turn its axes. Messages
    begin with `where`, by default the path.
    """
    where = where or str(source if isinstance(source, Path) else "image")
    with opened_image(source, where) as opened:
        # Pillow reads coloured 16-bit images with a mode of 8 bits; only the tile names the 16 bits.
        if ";16" in str(getattr(opened, "tile", ())) or opened.mode[0] in "IF":
            raise InputError(f"{where}: pixels of more than 8 bits a channel; save it with 8 bits")
        orientation = opened.getexif().get(ORIENTATION, 1)
        if orientation in range(2, 9):
            text = f"EXIF orientation {orientation}, by which viewers turn the image"
            raise InputError(f"{where}: {text}; remove the tag (exiftool -Orientation= FILES)")
        return np.asarray(opened.convert("RGB"))


def read_one_channel(source: Path | bytes, where: str) -> UInt8[ndarray, "h w"] | UInt16[ndarray, "h w"]:
    """Read the values of a grey image of 8 or 16 bits: labels, or depth (mm).

    `source` is a file or the bytes of one. Raises InputError for any other file.
    """
    with opened_image(source, where) as opened:
        kind = ONE_CHANNEL.get(opened.mode)
        if kind is None:
            raise InputError(f"{where}: mode {opened.mode}; save it as PNG with one channel of 8 or 16 bits")
        pixels = np.asarray(opened)
        if pixels.dtype.itemsize > 2 and pixels.size and not 0 <= pixels.min() <= pixels.max() <= 65535:
            raise InputError(f"{where}: values beyond 65535; save it as PNG with one channel of 16 bits")
        return pixels.astype(kind)


def read_depth_images(path: Path, size: tuple[int, int]) -> Float32[ndarray, "h w"]:
    """Read a depth image (in mm): return the depth along the optical axis (m) at each pixel, 0 where none was measured.

    Raises InputError if the file is not a 16-bit grey image of `size` (width, height).
    """
    depth = read_one_channel(path, str(path))
    if depth.dtype != np.uint16:
        raise InputError(f"{path}: no depth image of 16 bits and one channel (mm); save it as 16-bit PNG")
    if (found := depth.shape[::-1]) != size:
        remedy = "align depth with colour (ROS: align_depth.enable, librealsense: rs.align)"
        raise other_size(f"{path}: depth", found, size, remedy=remedy)
    return depth.astype(np.float32) / 1000


def size_of_all(sizes: Mapping[str, tuple[int, int]], where: str) -> tuple[int, int]:
    """Return the size (width, height in px) that all images share; raise InputError if one has another size.

    `sizes` maps the name of each image to its size.
    """
    (first, size), *others = sizes.items()
    if other := [one for one in others if one[1] != size]:
        raise other_size(f"{where}: {other[0][0]}", other[0][1], size, first)
    return size


def require_unlike(
    new: Mapping[str, UInt8[ndarray, "h w 3"]], old: Iterable[tuple[str, UInt8[ndarray, "h w 3"]]], of: str
) -> None:
    """Raise InputError if a new image has the pixels of an old one; `of` names the owner of the old ones."""
    for before, other in old:
        for name, image in new.items():
            if np.array_equal(image, other):
                raise InputError(f"{name}: is the same image as {before} of {of}; take a new one")


def edge_width(image: UInt8[ndarray, "h w 3"]) -> float:
    """Return the width of an RGB image's strongest edges as a share of its long side, along the axis with more blur.

    The image is first reduced to a long side of 640 px; a smaller one is not, but counts as one of 640 px. An edge is
    where the grey level changes by one of the largest 1 % of all changes over 16 px. Its width is 2 px times the ratio
    of that change to the largest change over 2 px within these 16 px. The result is the median over the edges. Sharp
    edges have 1/320, the largest width is 1/40, and 0 means no edges. An axis of 16 px or fewer is not measured.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = min(EDGES_AT / max(grey.shape), 1.0)
    grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.float32)
    widths, window = [0.0], np.ones((FAR_PX - 1, 1), np.uint8)
    for along in (grey, grey.T):
        if len(along) <= FAR_PX:
            continue
        near, far = (np.abs(along[n:] - along[:-n]) for n in (2, FAR_PX))
        steepest = cv2.dilate(near, window)[FAR_PX // 2 - 1 :][: len(far)]
        if (strong := float(np.quantile(far, 0.99))) > LEAST_CONTRAST:
            is_edge = far >= strong
            widths.append(float(np.median(2 * far[is_edge] / np.maximum(steepest[is_edge], 1.0))) / EDGES_AT)
    return max(widths)


def show_one_view(first: UInt8[ndarray, "h w 3"], other: UInt8[ndarray, "h w 3"]) -> bool:
    """Test whether two RGB images show the same view, as from a camera at rest: their details differ little.

    Details are structures of a few pixels, normalised by their contrast. After a motion by a few pixels, the details of
    two images have nothing in common.
    """
    details = []
    for image in (first, other):
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        grey = cv2.resize(grey, None, fx=(scale := 640 / max(grey.shape)), fy=scale).astype(np.float32)
        # The filter suppresses noise and shading; the division keeps a printed board in front of the camera from
        # outweighing the scene behind the board.
        band = cv2.GaussianBlur(grey, (0, 0), 2.0) - cv2.GaussianBlur(grey, (0, 0), 8.0)
        details.append(band / (np.abs(band) + max(float(np.median(np.abs(band))), USUAL_GREY)))
    one, two = details
    return float(((one - two) ** 2).mean()) < ONE_VIEW * float((one**2).mean() + (two**2).mean())


def exposure_fault(image: UInt8[ndarray, "h w 3"]) -> str | None:
    """Return "nearly black" (mean grey level up to 12 of 255) or "nearly white" (from 243); None if exposed well."""
    brightness = float(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).mean())
    return "nearly black" if brightness <= DARK else "nearly white" if brightness >= BRIGHT else None


def encode_png(pixels: UInt8[ndarray, "h w *rgb"] | UInt16[ndarray, "h w"]) -> bytes:
    """Encode grey (h,w) or RGB (h,w,3) pixels as PNG, without loss."""
    bgr = np.ascontiguousarray(pixels[..., ::-1] if pixels.ndim == 3 else pixels)
    return cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes()


def encode_jpeg(pixels: UInt8[ndarray, "h w 3"]) -> bytes:
    """Return an RGB image encoded as a JPEG of quality JPEG_QUALITY, for pages."""
    bgr = np.ascontiguousarray(pixels[..., ::-1])
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def sharpness(image: UInt8[ndarray, "h w 3"]) -> float:
    """Return the variance of the Laplacian of an RGB image, which falls as blur increases."""
    return float(cv2.Laplacian(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.CV_64F).var())
