"""reconstruction.npz: a Reconstruction on disk, from which calibration and map can be made again."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from jcr.errors import InputError
from jcr.files import written_whole
from jcr.records import CameraEvidence, Intrinsics, Reconstruction, Tracks

FORMAT = "jcr.reconstruction/4"
"""Changes with what the file holds."""
OLD = "jcr.reconstruction/3"
"""Without reasons and sigmas of depths, which were all matched; else the same."""


def write_reconstruction(path: Path, reconstruction: Reconstruction) -> None:
    """Write the record whole or not at all."""
    about = {
        "format": FORMAT,
        "backend": reconstruction.backend,
        "is_metric": reconstruction.is_metric,
        "metric_std": reconstruction.metric_std,
        "notes": list(reconstruction.notes),
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
    try:
        # NumPy leaves a file open that it cannot read.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            about = json.loads(str(file["about"]))
            if about["format"] not in (FORMAT, OLD):
                raise InputError(
                    f"{path}: format {about['format']!r}, not {FORMAT!r}; delete it and run again"
                )
            return Reconstruction(
                image_index=file["image_index"],
                recon_from_camera=file["recon_from_camera"],
                intrinsics=_intrinsics(about["intrinsics"]),
                pointmap_intrinsics=_intrinsics(about["pointmap_intrinsics"]),
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
                backend=about["backend"],
                is_metric=about["is_metric"],
                metric_std=about["metric_std"],
                notes=tuple(about["notes"]),
                reason=file.get("reason"),
                depth_std=file.get("depth_std"),
                evidence=_evidence(file),
            )
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; run `jcr calibrate` or `jcr run` first") from None
    except InputError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy's parser of headers have errors of their own
        raise InputError(f"{path}: damaged ({error}); delete it and run again") from None


def _evidence(file: Mapping[str, np.ndarray]) -> CameraEvidence | None:
    if "evidence_covariance" not in file:
        return None
    return CameraEvidence(file["evidence_recon_from_camera"], file["evidence_covariance"])


def _intrinsics(fields: dict[str, Any]) -> Intrinsics:
    numbers: dict[str, Any] = fields | {"distortion": tuple(fields["distortion"])}
    return Intrinsics(**numbers)
