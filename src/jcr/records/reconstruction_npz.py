"""Reading and writing of reconstruction.npz, a Reconstruction from which calibration and map can be made again."""

import json
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import jaxtyped
from pydantic import BaseModel, ConfigDict, ValidationError

from jcr.errors import InputError, first_fault, shown
from jcr.files import require_file, written_whole
from jcr.geometry import require_rigid
from jcr.memory import require_memory
from jcr.records.reconstruction import Reconstruction

FORMAT = "jcr.reconstruction/9"
"""Name and version of the format; the version increases with every change of the content."""
ARRAY = "array"
"""Key of the JSON object that stands for an array; its value is the name of the array in the file."""


class ReconstructionContent(BaseModel):
    """Content of reconstruction.npz: format and reconstruction, whose arrays are stored outside the JSON."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True)
    format: str
    reconstruction: Reconstruction


def write_reconstruction(path: Path, reconstruction: Reconstruction) -> None:
    """Write a reconstruction as an npz file; a failed write leaves an existing file unchanged."""
    arrays: dict[str, np.ndarray] = {}
    content = _named(reconstruction, "", arrays)
    write_npz(path, {"format": FORMAT, "reconstruction": content}, arrays)


def _named(value: Any, name: str, arrays: dict[str, np.ndarray]) -> Any:
    """Return a value as JSON that refers to arrays by name, and add these arrays to `arrays`.

    `value` is a dataclass, tuple, array or plain value. The names of its arrays begin with `name`, followed by the path
    of fields and indices.
    """
    if isinstance(value, np.ndarray):
        arrays[name] = value
        return {ARRAY: name}
    prefix = name and f"{name}."
    if is_dataclass(value):
        return {
            own.name: _named(getattr(value, own.name), prefix + own.name, arrays) for own in fields(value)
        }
    if isinstance(value, tuple):
        return [_named(one, f"{prefix}{k}", arrays) for k, one in enumerate(value)]
    return value


def _filled(value: Any, file: Mapping[str, np.ndarray]) -> Any:
    """Return the JSON `value` that `_named` made, with the arrays of `file` in place of references to them.

    Raises KeyError for an array that the file lacks, and ValueError for an array with values that are not finite.
    """
    if isinstance(value, list):
        return tuple(_filled(one, file) for one in value)
    if not isinstance(value, dict):
        return value
    if value.keys() != {ARRAY}:
        return {name: _filled(one, file) for name, one in value.items()}
    array = file[value[ARRAY]]
    require_shapes({value[ARRAY]: (array, array.shape)})
    return array


def read_reconstruction(path: Path) -> Reconstruction:
    """Read a reconstruction.npz; raise InputError if it is missing, damaged or of another format."""
    with read_npz(path, FORMAT) as (text, file), jaxtyped("context"):
        found = ReconstructionContent.model_validate(_filled(json.loads(text), file)).reconstruction
        evidence = () if found.evidence is None else found.evidence.recon_from_camera
        for row, camera in enumerate((*found.recon_from_camera, *evidence)):
            require_rigid(camera, f"camera {row % len(found.image_index)}")
        return found


def write_npz(path: Path, about: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write an npz file with named arrays and the JSON object `about`; a failed write leaves an old file unchanged.

    The key "format" of `about` is the name that `read_npz` expects.
    """
    content: dict[str, Any] = {"about": np.array(json.dumps(about)), **arrays}
    with written_whole(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **content)


@contextmanager
def read_npz(path: Path, expected: str) -> Iterator[tuple[str, Mapping[str, np.ndarray]]]:
    """Open an npz file of `write_npz`: yield its JSON text and its arrays by name.

    Raises InputError if the file is missing or damaged, or if its `format` is not `expected`. Raises InputError also if
    the block under `with` fails for a value of the file.
    """
    require_file(path)
    try:
        # The file is opened here, because NumPy does not close a file that it fails to read.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            if file.zip is not None:
                require_memory(sum(member.file_size for member in file.zip.infolist()), str(path))
                if any(member.compress_type != zipfile.ZIP_STORED for member in file.zip.infolist()):
                    raise ValueError(
                        "its content is compressed"
                    )  # which may unpack to a thousand times its size
            text = str(file["about"])
            kind = json.loads(text)["format"]
            if kind != expected:
                raise InputError(f"{path}: format {shown(kind)}, not {expected!r}; delete it and run again")
            yield text, file
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; run `jcr calibrate` or `jcr run` first") from None
    except ValidationError as error:
        raise InputError(f"{path}: about: {first_fault(error)}; delete it and run again") from None
    except InputError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy's parser of headers have errors of their own
        raise InputError(f"{path}: damaged ({error}); delete it and run again") from None


def require_shapes(shapes: Mapping[str, tuple[np.ndarray, tuple[int, ...]]]) -> None:
    """Raise ValueError if an array does not have its expected shape or holds values that are not finite."""
    for name, (array, shape) in shapes.items():
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, not {shape}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name} holds NaN or infinity")
