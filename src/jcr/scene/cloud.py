"""Point cloud (m, base frame) from pointmaps and a calibration (JCR paper, section IV-C), and its file cloud.ply."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Integer, UInt8
from numpy import ndarray

from jcr.calibration.record import Calibration, PublishedCalibration
from jcr.errors import InputError
from jcr.files import read_bytes, write_bytes
from jcr.geometry import apply, by_similarity, inverse, scale_translation
from jcr.records import MATCHED, PRIOR, Capture, PointCloud, Reconstruction
from jcr.scene.options import CloudOptions

LEAST_SURE = 40.0
"""Percentage of the points from matching alone, the least confident, whose rays show no free space: few images agree on
them, and depths that are too large are among them. This removes a third of the space that is wrongly called free."""
_PLY_COLUMNS = {
    **dict.fromkeys("xyz", "f4"),
    **dict.fromkeys(("red", "green", "blue"), "u1"),
    **{"label": "i4", "confidence": "f4", "margin": "f4", "image": "i4", "reason": "u1", "depth_std": "f4"},
}
"""Properties of a point in the PLY file and their types; `margin`, `reason` and `depth_std` are written only if they are
known."""
_AS_READ = {"f4": np.float64, "u1": np.uint8, "i4": int}
"""Type in a PointCloud of each type in the file."""
_PLY_TYPES = {"f4": "float", "u1": "uchar", "i4": "int"}
"""PLY's name of each type in the file."""
_MOST_NAMED = 10_000
"""Largest number of cameras and of labels of a cloud; each camera is compared with planes, and a map has 1024 labels."""
_LAYOUT = "format binary_little_endian 1.0"
"""Line of the header that states the layout of the points."""
_PLY_MARK = "comment jcr cloud in the base frame, metres"
"""Line of the header that identifies a cloud of jcr."""


def point_cloud(
    capture: Capture,
    reconstruction: Reconstruction,
    hand_eye: Calibration | PublishedCalibration,
    labels: Integer[ndarray, "m h w"] | None = None,
    options: CloudOptions | None = None,
    label_names: tuple[str, ...] = ("none",),
) -> PointCloud:
    """Return the confident points of the depth images in the base frame, with colour, label, std (m) and image of each.

    `options` set the percentile of the least confidence, and the largest number of points. `labels` (m,h,w) are indices
    into `label_names`, 0 = none, at the pixels of the m registered images' depth. None gives label 0 to all points.
    A calibration by the published method gives no std of the points.
    Raises InputError if no point has enough confidence.
    """
    options = options or CloudOptions()
    dense = reconstruction.dense
    confidence = dense.confidence
    keep = confidence > 0
    # Only points from matching alone are tested by percentile: other points passed tests of their planes.
    alone = keep if dense.reason is None else keep & (dense.reason == MATCHED)
    if alone.any():
        keep &= ~alone | (confidence >= np.percentile(confidence[alone], options.confidence_percentile))
    pixel = np.flatnonzero(keep)
    if len(pixel) == 0:
        best = float(confidence.max()) if confidence.size else 0.0
        raise InputError(
            f"{capture.folder}: no point is confident enough for a map (the best confidence is {best:.3g}); "
            "lower --confidence-percentile or add images with more overlap"
        )
    if len(pixel) > options.max_points:
        draw = np.random.default_rng(options.cloud_seed)
        pixel = np.sort(draw.choice(pixel, options.max_points, replace=False))

    image = pixel // confidence[0].size
    confident = confidence.reshape(-1)[pixel].astype(np.float64)
    reason = None if dense.reason is None else dense.reason.reshape(-1)[pixel]
    x_in_recon = dense.points_in_recon.reshape(-1, 3)[pixel].astype(np.float64)
    recon_from_camera = scale_translation(reconstruction.recon_from_camera, hand_eye.scale)
    return PointCloud(
        points_in_base=hand_eye.base_from_recon(x_in_recon),
        color=dense.colors.reshape(-1, 3)[pixel],
        confidence=confident,
        margin=position_std(hand_eye, recon_from_camera, image, hand_eye.scale * x_in_recon)
        if isinstance(hand_eye, Calibration)
        else None,
        label=np.zeros(len(pixel), int) if labels is None else labels.reshape(-1)[pixel].astype(int),
        image=image,
        camera_centers_in_base=apply(hand_eye.base_from_recon.rigid, recon_from_camera[:, :3, 3]),
        label_names=label_names,
        reason=reason,
        depth_std=None
        if dense.depth_std is None
        else hand_eye.scale * dense.depth_std.reshape(-1)[pixel].astype(np.float64),
        clears=None
        if reason is None
        else _clears(reason, confident, reconstruction.image_index[image] >= len(capture)),
    )


def _clears(
    reason: UInt8[ndarray, " n"], confidence: Float[ndarray, " n"], added: Bool[ndarray, " n"]
) -> Bool[ndarray, " n"]:
    """Return True for each point whose ray marks the space between camera and point as free.

    `reason` is the origin of a point's depth. False for depth from plane priors, and for the 40 % of matched points
    with the lowest confidence. Matched points of images `added` to a run later always give True, because these images
    show that an object was removed.
    """
    alone = (reason == MATCHED) & ~added
    least = np.percentile(confidence[alone], LEAST_SURE) if alone.any() else 0.0
    return (reason != PRIOR) & ~(alone & (confidence < least))


def position_std(
    hand_eye: Calibration,
    recon_from_camera: Float[ndarray, "m 4 4"],
    image: Integer[ndarray, " n"],
    x_in_recon: Float[ndarray, "n 3"],
) -> Float[ndarray, " n"]:
    """Return the standard deviation (m) of n points in the base frame along their worst direction, from the calibration.

    It is the root of the largest eigenvalue of each point's covariance. `recon_from_camera` (m,4,4) and points
    `x_in_recon` (n,3) are scaled to metres; `image` is the index of the image of each point. After a bundle adjustment
    the covariance of the scene's pose in the base frame is propagated. Otherwise that of gripper_from_camera and scale
    is propagated, at the point's position in its camera.
    """
    placed = hand_eye.uncertainty.scene
    if placed is not None:
        covariance = placed.covariance_at(apply(hand_eye.base_from_recon.rigid, x_in_recon))
    else:
        recon_to_camera = inverse(recon_from_camera)
        x_in_camera = np.einsum("nij,nj->ni", recon_to_camera[image, :3, :3], x_in_recon)
        x_in_camera += recon_to_camera[image, :3, 3]
        by = by_similarity(x_in_camera @ hand_eye.gripper_from_camera[:3, :3].T)
        covariance = by @ hand_eye.covariance @ np.swapaxes(by, -1, -2)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[:, -1], 0.0))


def write_cloud(path: Path, cloud: PointCloud, notes: Mapping[str, str] | None = None) -> None:
    """Write a cloud as binary PLY: points with colour, label, confidence, margin and image.

    The margin is the standard deviation (m) of a point due to the calibration. Origin and standard deviation (m) of the
    depth are written if the cloud has them. Comments in the header hold the label names and camera centres, which
    `read_cloud` reads. `notes` are further comments, one line per name and text.
    """
    columns = dict(zip(_PLY_COLUMNS, (*cloud.points_in_base.T, *cloud.color.T), strict=False))
    for name in list(_PLY_COLUMNS)[6:]:
        if (column := getattr(cloud, name)) is not None:
            columns[name] = column
    vertices = np.empty(len(cloud.image), [(name, f"<{_PLY_COLUMNS[name]}") for name in columns])
    for name, column in columns.items():
        vertices[name] = column
    centers = cloud.camera_centers_in_base.tolist()
    header = [
        "ply",
        _LAYOUT,
        _PLY_MARK,
        *(f"comment {name} {text}" for name, text in (notes or {}).items()),
        *(f"comment label {k} {name}" for k, name in enumerate(cloud.label_names)),
        *(f"comment camera {k} {x} {y} {z}" for k, (x, y, z) in enumerate(centers)),
        f"element vertex {len(vertices)}",
        *(f"property {_PLY_TYPES[_PLY_COLUMNS[name]]} {name}" for name in columns),
        "end_header\n",
    ]
    write_bytes(path, "\n".join(header).encode() + vertices.tobytes())


def read_cloud(path: Path) -> PointCloud:
    """Read a PLY file of `write_cloud`; raise InputError for any other file."""
    try:
        header, _, body = read_bytes(path).partition(b"\nend_header\n")  # a label may be called end_header
        lines = header.decode().splitlines()
        names = [
            name for name, kind in _PLY_COLUMNS.items() if f"property {_PLY_TYPES[kind]} {name}" in lines
        ]
        vertices = np.frombuffer(body, [(name, f"<{_PLY_COLUMNS[name]}") for name in names])
        columns = {name: vertices[name].astype(_AS_READ[_PLY_COLUMNS[name]]) for name in names}
        own = [line for line in lines if not line.startswith("comment")]
        elements = [
            f"element vertex {len(vertices)}",
            *(f"property {_PLY_TYPES[_PLY_COLUMNS[name]]} {name}" for name in names),
        ]
        if (
            own != ["ply", _LAYOUT, *elements]
            or _PLY_MARK not in lines
            or {*names, "margin", "reason", "depth_std"} != _PLY_COLUMNS.keys()
        ):
            raise ValueError  # cut between two points, or of another writer
        words = [line.split(maxsplit=3) for line in lines]
        cameras, labels = (
            [word[2:] for word in words if word[:2] == ["comment", of]] for of in ("camera", "label")
        )
        for one in (cameras, labels):
            if len(one) > _MOST_NAMED or [int(number) for number, _ in one] != list(range(len(one))):
                raise ValueError
        centers = [[float(x) for x in text.split()] for _, text in cameras]
        return PointCloud(
            points_in_base=np.stack([columns.pop(name) for name in "xyz"], 1),
            color=np.stack([columns.pop(name) for name in ("red", "green", "blue")], 1),
            margin=columns.pop("margin", None),
            camera_centers_in_base=np.array(centers, np.float64).reshape(-1, 3),
            label_names=tuple(name for _, name in labels),
            **columns,
        )
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    except OSError as error:
        raise InputError(
            f"{path}: no map here ({error.strerror}); name the folder of a run, and make its map with jcr map OUT"
        ) from None
    except (ValueError, IndexError):
        raise InputError(f"{path}: is no cloud of jcr, or damaged; run jcr map OUT again") from None
