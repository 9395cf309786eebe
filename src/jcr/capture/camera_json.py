"""Intrinsics and their standard deviations as a capture.json states them."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.checks import checked_intrinsics
from jcr.errors import InputError
from jcr.records import COEFFICIENTS, Intrinsics

FAR_OFF_CENTRE = 0.3
"""Of the width or height: no model has its principal point so far from the middle, unless images were cropped."""


def read_intrinsics(intrinsics: Any, size: tuple[int, int], where: Path | str) -> Intrinsics | None:
    """The intrinsics of images of `size` from the "intrinsics" of a capture.json; InputError if it cannot be.

    `where` begins its message: the file, or the file and a camera of it.
    """
    if intrinsics is None:
        return None
    where = f"{where}: intrinsics"
    if not isinstance(intrinsics, dict) or not {"fx", "fy", "cx", "cy"} <= intrinsics.keys():
        raise InputError(f"{where}: need numbers fx, fy, cx, cy and distortion [k1,k2,p1,p2,k3], or null")
    focal_and_centre = [intrinsics[key] for key in ("fx", "fy", "cx", "cy")]
    model = intrinsics.get("model", "pinhole")
    if model not in COEFFICIENTS:
        raise InputError(
            f"{where}: distortion model {model!r} is not known; give one of {', '.join(COEFFICIENTS)}"
        )
    distortion = intrinsics.get("distortion") or [0.0] * len(COEFFICIENTS[model])
    if not isinstance(distortion, list):
        raise InputError(f"{where}: distortion must be a list [{','.join(COEFFICIENTS[model])}]")
    return checked_intrinsics(focal_and_centre, distortion, size, where, model)


def intrinsics_as_json(intrinsics: Intrinsics) -> dict[str, Any]:
    """The "intrinsics" of a capture.json."""
    model = {} if intrinsics.model == "pinhole" else {"model": intrinsics.model}
    numbers = {key: getattr(intrinsics, key) for key in ("fx", "fy", "cx", "cy")}
    return model | numbers | {"distortion": list(intrinsics.distortion)}


def read_intrinsics_of_size(intrinsics: Any, size: tuple[int, int], where: Path | str) -> Intrinsics | None:
    """The same of a camera whose intrinsics come from elsewhere: InputError where they are of another resolution.

    By their own "width" and "height" where they have these, else by the principal point.
    """
    found = read_intrinsics(intrinsics, size, where)
    if found is None:
        return None
    stated = intrinsics.get("width", size[0]), intrinsics.get("height", size[1])
    off = abs(found.cx / size[0] - 0.5), abs(found.cy / size[1] - 0.5)
    if stated != size or max(off) > FAR_OFF_CENTRE:
        sign = f"of {stated[0]}x{stated[1]}" if stated != size else f"centre ({found.cx:.4g}, {found.cy:.4g})"
        raise InputError(
            f"{where}: intrinsics of another resolution ({sign}) than its {size[0]}x{size[1]} images; give those of "
            "this resolution, or null to estimate them"
        )
    return found


def read_std(given: Any, intrinsics: Intrinsics | None, where: Path | str) -> Float[ndarray, " p"] | None:
    """Standard deviations in the units of "intrinsics", some or all; 0 is exact."""
    if given is None:
        return None
    where = f"{where}: intrinsics_std"
    if intrinsics is None:
        raise InputError(f"{where}: there are no intrinsics whose errors these could be; give both or none")
    names = ("fx", "fy", "cx", "cy")
    if not isinstance(given, dict) or not given.keys() <= {*names, "distortion"}:
        raise InputError(f"{where}: need some of fx, fy, cx, cy (px) and distortion [k1,k2,p1,p2,k3]")
    distortion = given.get("distortion") or []
    if not isinstance(distortion, list) or len(distortion) > len(intrinsics.distortion):
        raise InputError(
            f"{where}: distortion must be a list of at most {len(intrinsics.distortion)} numbers"
        )
    values = [given.get(name) for name in names] + distortion
    if not all(
        value is None or (type(value) in (int, float) and 0 <= value < intrinsics.width) for value in values
    ):
        raise InputError(f"{where}: standard deviations are numbers of 0 or more, or null")
    std = np.full(4 + len(intrinsics.distortion), np.nan)
    std[: len(values)] = [np.nan if value is None else value for value in values]
    return std


def std_as_json(std: Float[ndarray, " p"]) -> dict[str, Any]:
    """The "intrinsics_std" of a capture.json."""
    values = [None if np.isnan(value) else value for value in std.tolist()]
    return dict(zip(("fx", "fy", "cx", "cy"), values, strict=False)) | {"distortion": values[4:]}
