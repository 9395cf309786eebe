"""reconstruction.npz: a Reconstruction on disk, from which calibration and map can be made again."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from jcr.allocator import require_memory
from jcr.capture.plain_files import first_fault, shown
from jcr.errors import InputError
from jcr.files import require_file, written_whole
from jcr.geometry import require_rigid
from jcr.intrinsics_json import IntrinsicsJson, Positive
from jcr.records import Boards, Body, CameraEvidence, Pointmaps, Reconstruction, Tracks

FORMAT = "jcr.reconstruction/8"
"""Changes with what the file holds."""
OF_TRACKS = ("image", "x_px", "point", "points_in_recon", "std_px")
OF_POINTMAPS = ("points_in_recon", "confidence", "colors", "reason", "depth_std")


class BoardsJson(BaseModel):
    """Fields of records.Boards that are no arrays."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    spec: str
    side: Positive
    size_std: Positive | None
    numbers: list[int]
    """Numbers of the bodies."""
    elsewhere: list[int]
    proposed: str | None


class About(BaseModel):
    """Fields of a reconstruction that are no arrays."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    format: str
    backend: str
    is_metric: bool
    metric_std: Positive | None
    notes: list[str]
    warnings: list[str]
    intrinsics: IntrinsicsJson
    pointmap_intrinsics: IntrinsicsJson | None = None
    boards: BoardsJson | None = None
    predicted_focal: tuple[float, float] | None = None


def write_reconstruction(path: Path, reconstruction: Reconstruction) -> None:
    """Write the record whole or not at all."""
    pointmaps, tracks, evidence = reconstruction.pointmaps, reconstruction.tracks, reconstruction.evidence
    about = {
        "format": FORMAT,
        "backend": reconstruction.backend,
        "is_metric": reconstruction.is_metric,
        "metric_std": reconstruction.metric_std,
        "notes": list(reconstruction.notes),
        "warnings": list(reconstruction.warnings),
        "intrinsics": asdict(reconstruction.intrinsics),
        "pointmap_intrinsics": None if pointmaps is None else asdict(pointmaps.intrinsics),
        "boards": None if tracks.boards is None else _about_boards(tracks.boards),
        "predicted_focal": reconstruction.predicted_focal,
    }
    arrays = {
        "image_index": reconstruction.image_index,
        "recon_from_camera": reconstruction.recon_from_camera,
        "tracks_from_pointmaps": np.array(tracks.from_pointmaps),
        "tracks_from_board": np.array(tracks.from_board),
    }
    arrays |= {f"track_{name}": array for name in OF_TRACKS if (array := getattr(tracks, name)) is not None}
    if tracks.boards is not None and (bodies := tracks.boards.bodies):
        arrays |= {
            "board_body": np.repeat(np.arange(len(bodies)), [len(body.point) for body in bodies]),
            "board_point": np.concatenate([body.point for body in bodies]),
            "board_x_in_body": np.concatenate([body.x_in_body for body in bodies]),
        }
    if evidence is not None:
        arrays |= {
            "evidence_recon_from_camera": evidence.recon_from_camera,
            "evidence_covariance": evidence.covariance,
        }
    if pointmaps is not None:
        arrays |= arrays_of(pointmaps)
    write_npz(path, about, arrays)


def arrays_of(pointmaps: Pointmaps) -> dict[str, np.ndarray]:
    """Return the arrays of pointmaps by their names in a file; `pointmaps_in` reads them."""
    return {name: array for name in OF_POINTMAPS if (array := getattr(pointmaps, name)) is not None}


def pointmaps_in(file: Mapping[str, np.ndarray], intrinsics: IntrinsicsJson, images: int) -> Pointmaps:
    """Return the pointmaps of this many images in a file; raise KeyError or ValueError where they are not whole."""
    found = Pointmaps(
        intrinsics=intrinsics.record(),
        points_in_recon=file["points_in_recon"],
        confidence=file["confidence"],
        colors=file["colors"],
        reason=file.get("reason"),
        depth_std=file.get("depth_std"),
    )
    size = images, found.intrinsics.height, found.intrinsics.width
    shapes = {
        name: (array, (*size, 3) if name in ("points_in_recon", "colors") else size)
        for name, array in arrays_of(found).items()
    }
    check_arrays(shapes)
    return found


def write_npz(path: Path, about: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays, and what is none as JSON, whole or not at all."""
    with written_whole(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, about=np.array(json.dumps(about)), allow_pickle=False, **arrays)


@contextmanager
def read_npz(path: Path, expected: str) -> Iterator[tuple[str, Mapping[str, np.ndarray]]]:
    """Read the JSON, whose `format` is `expected`, and the arrays that `write_npz` wrote.

    What goes wrong in reading them raises InputError: no such file, damaged, or of another format.
    """
    require_file(path)
    try:
        # NumPy leaves a file open that it cannot read.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            if file.zip is not None:
                require_memory(sum(member.file_size for member in file.zip.infolist()), str(path))
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


def read_reconstruction(path: Path) -> Reconstruction:
    """Read a reconstruction.npz; raise InputError where it is damaged or of a newer format."""
    with read_npz(path, FORMAT) as (text, file):
        about = About.model_validate_json(text, strict=True)
        found = Reconstruction(
            image_index=file["image_index"],
            recon_from_camera=file["recon_from_camera"],
            intrinsics=about.intrinsics.record(),
            tracks=Tracks(
                **{name: file[f"track_{name}"] for name in OF_TRACKS if name != "std_px"},
                from_pointmaps=bool(file["tracks_from_pointmaps"]),
                from_board=bool(file["tracks_from_board"]),
                std_px=file.get("track_std_px"),
                boards=None if about.boards is None else _boards(file, about.boards),
            ),
            backend=about.backend,
            pointmaps=_pointmaps(file, about),
            is_metric=about.is_metric,
            metric_std=about.metric_std,
            notes=tuple(about.notes),
            warnings=tuple(about.warnings),
            evidence=_evidence(file),
            predicted_focal=about.predicted_focal,
        )
        _check(found)
    return found


def _about_boards(boards: Boards) -> dict[str, Any]:
    return {
        "spec": boards.spec,
        "side": boards.side,
        "size_std": boards.size_std,
        "numbers": [body.number for body in boards.bodies],
        "elsewhere": list(boards.elsewhere),
        "proposed": boards.proposed,
    }


def _boards(file: Mapping[str, np.ndarray], about: BoardsJson) -> Boards:
    """KeyError or ValueError where its arrays are not whole."""
    bodies = []
    for k, number in enumerate(about.numbers):
        own = file["board_body"] == k
        point, x_in_body = file["board_point"][own], file["board_x_in_body"][own]
        check_arrays({"board_point": (point, (len(point),)), "board_x_in_body": (x_in_body, (len(point), 3))})
        bodies.append(Body(number, point, x_in_body))
    return Boards(
        spec=about.spec,
        side=about.side,
        size_std=about.size_std,
        bodies=tuple(bodies),
        elsewhere=tuple(about.elsewhere),
        proposed=about.proposed,
    )


def _pointmaps(file: Mapping[str, np.ndarray], about: About) -> Pointmaps | None:
    if about.pointmap_intrinsics is None:
        return None
    return pointmaps_in(file, about.pointmap_intrinsics, len(file["image_index"]))


def _evidence(file: Mapping[str, np.ndarray]) -> CameraEvidence | None:
    if "evidence_covariance" not in file:
        return None
    return CameraEvidence(file["evidence_recon_from_camera"], file["evidence_covariance"])


def check_arrays(shapes: Mapping[str, tuple[np.ndarray, tuple[int, ...]]]) -> None:
    """ValueError where an array, by name, has another shape than it should, or is not finite."""
    for name, (array, shape) in shapes.items():
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, not {shape}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name} holds NaN or infinity")


def _check(found: Reconstruction) -> None:
    """ValueError where the arrays do not belong together, or hold what cannot be."""
    m, tracks, evidence = len(found.image_index), found.tracks, found.evidence
    k, p = len(tracks.image), len(tracks.points_in_recon)
    shapes = {
        "recon_from_camera": (found.recon_from_camera, (m, 4, 4)),
        "image_index": (found.image_index, (m,)),
        "track_image": (tracks.image, (k,)),
        "track_x_px": (tracks.x_px, (k, 2)),
        "track_point": (tracks.point, (k,)),
        "track_points_in_recon": (tracks.points_in_recon, (p, 3)),
    }
    if tracks.std_px is not None:
        shapes["track_std_px"] = tracks.std_px, (k,)
        if (tracks.std_px <= 0).any():
            raise ValueError("track_std_px holds what is not positive")
    if evidence is not None:
        shapes["evidence_recon_from_camera"] = evidence.recon_from_camera, (m, 4, 4)
        shapes["evidence_covariance"] = evidence.covariance, (6 * m, 6 * m)
    check_arrays(shapes)
    for name, index, end in (
        ("image_index", found.image_index, np.inf),
        ("track_image", tracks.image, m),
        ("track_point", tracks.point, p),
        *(("board_point", body.point, p) for body in (tracks.boards.bodies if tracks.boards else ())),
        ("board elsewhere", np.array(tracks.boards.elsewhere if tracks.boards else (), int), m),
    ):
        if index.dtype.kind not in "iu" or (index < 0).any() or (index >= end).any():
            raise ValueError(f"{name} counts rows that are not there")
    if (np.diff(found.image_index) <= 0).any():
        raise ValueError("image_index does not ascend")
    for cameras in (found.recon_from_camera, *(() if evidence is None else (evidence.recon_from_camera,))):
        for row, camera in enumerate(cameras):
            require_rigid(camera, f"camera {row}")
