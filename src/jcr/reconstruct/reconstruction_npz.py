"""reconstruction.npz: a Reconstruction on disk, from which calibration and map can be made again."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from jcr.capture.plain_files import first_fault, shown
from jcr.errors import InputError
from jcr.files import require_file, written_whole
from jcr.geometry import require_rigid
from jcr.intrinsics_json import IntrinsicsJson, Positive
from jcr.records import CameraEvidence, Reconstruction, Tracks

FORMAT = "jcr.reconstruction/5"
"""Changes with what the file holds."""
OLD = ("jcr.reconstruction/3", "jcr.reconstruction/4")
"""Without warnings, which were among the notes; 3 without reasons and sigmas of depths, which were all matched, too."""


class About(BaseModel):
    """What is no array."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    format: str
    backend: str
    is_metric: bool
    metric_std: Positive | None
    notes: list[str]
    warnings: list[str] = []
    intrinsics: IntrinsicsJson
    pointmap_intrinsics: IntrinsicsJson


def write_reconstruction(path: Path, reconstruction: Reconstruction) -> None:
    """Write the record whole or not at all."""
    about = {
        "format": FORMAT,
        "backend": reconstruction.backend,
        "is_metric": reconstruction.is_metric,
        "metric_std": reconstruction.metric_std,
        "notes": list(reconstruction.notes),
        "warnings": list(reconstruction.warnings),
        "intrinsics": asdict(reconstruction.intrinsics),
        "pointmap_intrinsics": asdict(reconstruction.pointmap_intrinsics),
    }
    arrays = {
        "image_index": reconstruction.image_index,
        "recon_from_camera": reconstruction.recon_from_camera,
        "points_in_recon": reconstruction.points_in_recon,
        "confidence": reconstruction.confidence,
        "colors": reconstruction.colors,
        "track_image": reconstruction.tracks.image,
        "track_x_px": reconstruction.tracks.x_px,
        "track_point": reconstruction.tracks.point,
        "track_points_in_recon": reconstruction.tracks.points_in_recon,
        "tracks_from_pointmaps": np.array(reconstruction.tracks.from_pointmaps),
    }
    if (evidence := reconstruction.evidence) is not None:
        arrays |= {
            "evidence_recon_from_camera": evidence.recon_from_camera,
            "evidence_covariance": evidence.covariance,
        }
    if reconstruction.reason is not None:
        arrays["reason"] = reconstruction.reason
    if reconstruction.depth_std is not None:
        arrays["depth_std"] = reconstruction.depth_std
    with written_whole(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, about=np.array(json.dumps(about)), allow_pickle=False, **arrays)


def read_reconstruction(path: Path) -> Reconstruction:
    """The record in a reconstruction.npz; InputError when it is damaged or of a newer format."""
    require_file(path)
    try:
        # NumPy leaves a file open that it cannot read.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            text = str(file["about"])
            kind = json.loads(text)["format"]
            if kind not in (FORMAT, *OLD):
                raise InputError(f"{path}: format {shown(kind)}, not {FORMAT!r}; delete it and run again")
            about = About.model_validate_json(text, strict=True)
            found = Reconstruction(
                image_index=file["image_index"],
                recon_from_camera=file["recon_from_camera"],
                intrinsics=about.intrinsics.record(),
                pointmap_intrinsics=about.pointmap_intrinsics.record(),
                points_in_recon=file["points_in_recon"],
                confidence=file["confidence"],
                colors=file["colors"],
                tracks=Tracks(
                    file["track_image"],
                    file["track_x_px"],
                    file["track_point"],
                    file["track_points_in_recon"],
                    bool(file["tracks_from_pointmaps"]),
                ),
                backend=about.backend,
                is_metric=about.is_metric,
                metric_std=about.metric_std,
                notes=tuple(about.notes),
                warnings=tuple(about.warnings),
                reason=file.get("reason"),
                depth_std=file.get("depth_std"),
                evidence=_evidence(file),
            )
            _check(found)
            return found
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; run `jcr calibrate` or `jcr run` first") from None
    except ValidationError as error:
        raise InputError(f"{path}: about: {first_fault(error)}; delete it and run again") from None
    except InputError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy's parser of headers have errors of their own
        raise InputError(f"{path}: damaged ({error}); delete it and run again") from None


def _evidence(file: Mapping[str, np.ndarray]) -> CameraEvidence | None:
    if "evidence_covariance" not in file:
        return None
    return CameraEvidence(file["evidence_recon_from_camera"], file["evidence_covariance"])


def _check(found: Reconstruction) -> None:
    """ValueError where the arrays do not belong together, or hold what cannot be."""
    m, tracks, evidence = len(found.image_index), found.tracks, found.evidence
    height, width = found.pointmap_intrinsics.height, found.pointmap_intrinsics.width
    k, p = len(tracks.image), len(tracks.points_in_recon)
    maps = found.points_in_recon.shape[1:3]  # none at all where no depth was made
    shapes = {
        "recon_from_camera": (found.recon_from_camera, (m, 4, 4)),
        "image_index": (found.image_index, (m,)),
        "points_in_recon": (found.points_in_recon, (m, *maps, 3)),
        "confidence": (found.confidence, (m, *maps)),
        "colors": (found.colors, (m, *maps, 3)),
        "track_image": (tracks.image, (k,)),
        "track_x_px": (tracks.x_px, (k, 2)),
        "track_point": (tracks.point, (k,)),
        "track_points_in_recon": (tracks.points_in_recon, (p, 3)),
    }
    if evidence is not None:
        shapes["evidence_recon_from_camera"] = evidence.recon_from_camera, (m, 4, 4)
        shapes["evidence_covariance"] = evidence.covariance, (6 * m, 6 * m)
    if found.reason is not None:
        shapes["reason"] = found.reason, (m, *maps)
    if found.depth_std is not None:
        shapes["depth_std"] = found.depth_std, (m, *maps)
    for name, (array, shape) in shapes.items():
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, not {shape}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name} holds NaN or infinity")
    if maps not in ((height, width), (0, 0)):
        raise ValueError(f"pointmaps of {maps}, their intrinsics of {(height, width)} pixels")
    for name, index, end in (
        ("image_index", found.image_index, np.inf),
        ("track_image", tracks.image, m),
        ("track_point", tracks.point, p),
    ):
        if index.dtype.kind not in "iu" or (index < 0).any() or (index >= end).any():
            raise ValueError(f"{name} counts rows that are not there")
    if (np.diff(found.image_index) <= 0).any():
        raise ValueError("image_index does not ascend")
    for cameras in (found.recon_from_camera, *(() if evidence is None else (evidence.recon_from_camera,))):
        for row, camera in enumerate(cameras):
            require_rigid(camera, f"camera {row}")
