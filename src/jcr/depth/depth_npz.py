"""depth.npz: the pointmaps that densify estimated on the cameras of reconstruction.npz."""

from dataclasses import asdict
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from jcr.intrinsics_json import IntrinsicsJson
from jcr.reconstruct.reconstruction_npz import arrays_of, pointmaps_in, read_npz, write_npz
from jcr.records import Pointmaps

FILE = "depth.npz"
FORMAT = "jcr.depth/1"
"""Changes with what the file holds."""


class About(BaseModel):
    """What is no array."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    format: str
    made_from: str
    """The fingerprint of the reconstruction and of the options."""
    intrinsics: IntrinsicsJson


def write_depth(path: Path, pointmaps: Pointmaps, made_from: str) -> None:
    """Write estimated pointmaps whole or not at all."""
    about = {"format": FORMAT, "made_from": made_from, "intrinsics": asdict(pointmaps.intrinsics)}
    write_npz(path, about, arrays_of(pointmaps))


def read_depth(path: Path, images: int, made_from: str | None = None) -> Pointmaps | None:
    """The pointmaps of this many images; None where they were made from something else than `made_from`, if given.

    Raises InputError when the file is damaged, of a newer format, or of other images.
    """
    with read_npz(path, FORMAT) as (text, file):
        about = About.model_validate_json(text, strict=True)
        if made_from not in (None, about.made_from):
            return None
        return pointmaps_in(file, about.intrinsics, images)
