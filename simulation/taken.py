"""Simulated intrinsics, errors of cheaper cameras, and reported poses of a true capture."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.capture.images import encode_png
from jcr.files import write_bytes
from jcr.geometry import retract
from jcr.records import Intrinsics
from simulation.options import SimulateOptions

_WIDTH, _HEIGHT = 640, 480


def pinhole(rng: np.random.Generator) -> Intrinsics:
    """Draw intrinsics of 40° to 48° vertical field of view, as webcams and the colour side of depth cameras have.

    MuJoCo's image spans [-½, W-½] when pixel (0, 0) is the centre of a pixel, so its middle is (W-1)/2.
    """
    focal_px = float(0.5 * _HEIGHT / np.tan(0.5 * np.radians(rng.uniform(40, 48))))
    return Intrinsics(focal_px, focal_px, (_WIDTH - 1) / 2, (_HEIGHT - 1) / 2, _WIDTH, _HEIGHT)


def with_intrinsics_error(camera: Intrinsics, percent: float, rng: np.random.Generator) -> Intrinsics:
    """Add Gaussian errors to intrinsics: fx and fy by one of `percent`, cx and cy each by that share of the width."""
    focal, x, y = 0.01 * percent * rng.normal(size=3)
    return replace(
        camera,
        fx=camera.fx * (1 + focal),
        fy=camera.fy * (1 + focal),
        cx=camera.cx + x * camera.width,
        cy=camera.cy + y * camera.width,
    )


def stated_intrinsics(
    camera: Intrinsics, options: SimulateOptions, rng: np.random.Generator
) -> Intrinsics | None:
    """Return the intrinsics of capture.json with the errors of the options, or None where it gives none."""
    if options.unknown_intrinsics:
        return None
    return with_intrinsics_error(camera, options.intrinsics_error, rng)


def with_robot_noise(
    base_from_gripper: Float[ndarray, "n 4 4"],
    translation_mm: float,
    rotation_deg: float,
    rng: np.random.Generator,
) -> Float[ndarray, "n 4 4"]:
    """Return the reported poses: each pose after a step of independent Gaussians in every axis."""
    sizes = np.repeat([1e-3 * translation_mm, np.radians(rotation_deg)], 3)
    return retract(base_from_gripper, sizes * rng.normal(size=(len(base_from_gripper), 6)))


def degraded(
    image: UInt8[ndarray, "h w 3"], options: SimulateOptions, rng: np.random.Generator
) -> UInt8[ndarray, "h w 3"]:
    """Return the image of a cheaper camera: blurred, darker towards the corners, noisy."""
    light = image.astype(np.float32)
    if options.blur:
        light = cv2.GaussianBlur(light, (0, 0), options.blur)
    if options.vignetting:
        height, width = image.shape[:2]
        x, y = np.linspace(-1, 1, width), np.linspace(-1, 1, height)[:, None]
        light *= (1 - options.vignetting * 0.5 * (x * x + y * y))[..., None]
    if options.noise:
        light += rng.normal(0, options.noise, image.shape)
    return np.clip(light + 0.5, 0, 255).astype(np.uint8)


def image_suffix(options: SimulateOptions) -> str:
    """Return the ending of the images' names, without dot."""
    return "png" if options.jpeg_quality == "lossless" else "jpg"


def write_image(
    path: Path, pixels: UInt8[ndarray, "h w 3"], options: SimulateOptions, stream: Sequence[int]
) -> None:
    """Write the image that the camera of the options takes of `pixels`; its noise is drawn from `stream`."""
    rng = np.random.default_rng([options.seed, *stream])
    write_bytes(path, encoded(degraded(pixels, options, rng), options.jpeg_quality))


def encoded(image: UInt8[ndarray, "h w 3"], jpeg_quality: int | Literal["lossless"]) -> bytes:
    """Encode RGB as JPEG of that quality, or as PNG."""
    if jpeg_quality == "lossless":
        return encode_png(image)
    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])[1].tobytes()
