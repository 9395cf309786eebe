"""`benchmarks density`: how much of a plain table and what stands on it a cloud covers, beside COLMAP's points."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from scipy.spatial import KDTree

from benchmarks.figure import blank, png
from benchmarks.page import table
from benchmarks.synthetic_pairs import pairs_of_capture
from benchmarks.table1 import PUBLISHED, WEBCAM
from jcr.calibration.stage import calibrate
from jcr.capture.images import read_image
from jcr.capture.read import read_capture
from jcr.depth.densify import densify
from jcr.files import write_bytes
from jcr.geometry import apply_similarity
from jcr.reconstruct.backends import ReconstructOptions, reconstruct
from jcr.reconstruct.global_alignment.pairs import write_pairs
from jcr.records import Capture, HandEye, Reconstruction
from jcr.represent.cloud import point_cloud
from simulation.capture import SimulateOptions, simulate
from simulation.surface import truth_points

if TYPE_CHECKING:
    from matplotlib.axes import Axes

IMAGES, SEED = 12, 0
NEAR = 0.01
"""m. A place of the surface is covered when a point of the cloud is so near."""
PLACES = 20_000
"""Places of the true surface that are asked."""
DRAWN = 60_000
TABLE = 1
"""The truth's label of the table."""


@dataclass(frozen=True)
class Cloud:
    """Points in the base frame, with or without colours."""

    name: str
    x_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"] | None = None


def run(out: Path | None = None) -> str:
    """Markdown: shares of table and objects covered; density.png in `out` shows the clouds from above."""
    with tempfile.TemporaryDirectory() as folder:
        made = simulate(
            Path(folder) / "capture", SimulateOptions(scene="light8", images=IMAGES, seed=SEED, **WEBCAM)
        )
        capture = read_capture(made)
        sparse, swept = _clouds(
            capture, ReconstructOptions(backend="colmap"), "dense depth on COLMAP's cameras (ours)"
        )
        pairs = Path(folder) / "pairs.npz"
        write_pairs(pairs, pairs_of_capture(made, errors=PUBLISHED, seed=SEED)[0])
        options = ReconstructOptions(predictions=pairs)
        _, predicted = _clouds(capture, options, "simulated predictions")
        surface, labels = truth_points(made)
        image = read_image(capture.folder / capture.images[0])
    drawn = np.random.default_rng(SEED).choice(len(surface), PLACES, replace=False)
    clouds = [sparse, swept, predicted]
    covered = {cloud.name: _covered(cloud, surface[drawn], labels[drawn]) for cloud in clouds}
    if out is not None:
        write_bytes(out / "density.png", _figure(image, clouds))
    on_table, things = covered[sparse.name]
    best_table, best_things = covered[predicted.name]
    swept_table, swept_things = covered[swept.name]
    lines = [
        f"> On a plain table COLMAP's points cover {on_table:.0f} % of the table and {things:.0f} % of the objects; our "
        f"dense depth on its cameras {swept_table:.0f} % and {swept_things:.0f} %, simulated predictions of a network "
        f"{best_table:.0f} % and {best_things:.0f} %.",
        "",
        f"Scene `light8` of seed {SEED} by a webcam, {IMAGES} images, calibrated by ours. Covered: a point of the cloud "
        f"within {1e3 * NEAR:g} mm of the place on the true surface, asked at {PLACES:,} places that the images show. "
        "COLMAP's own densification needs a CUDA device, which it did not have here. Simulated predictions: as in "
        "table1.",
        "",
        "![the clouds from above](density.png)",
        "",
        *table(
            "cloud | points | table covered, % | objects covered, %",
            (
                [cloud.name, f"{len(cloud.x_in_base):,}", *(f"{share:.1f}" for share in covered[cloud.name])]
                for cloud in clouds
            ),
        ),
    ]
    return "\n".join(lines) + "\n"


def _clouds(capture: Capture, options: ReconstructOptions, name: str) -> tuple[Cloud, Cloud]:
    """The points that were matched, and the dense cloud."""
    found = densify(capture, reconstruct(capture, options))
    hand_eye = calibrate(capture, found)
    dense = point_cloud(capture, found, hand_eye)
    return _matched(found, hand_eye), Cloud(name, dense.points_in_base, dense.color)


def _matched(found: Reconstruction, hand_eye: HandEye) -> Cloud:
    x = found.tracks.points_in_recon.astype(np.float64)
    return Cloud("COLMAP's points", apply_similarity(hand_eye.base_from_recon, hand_eye.scale, x))


def _covered(cloud: Cloud, surface: Float[ndarray, "n 3"], labels: ndarray) -> tuple[float, float]:
    """Percent of the table and of the objects."""
    near = KDTree(cloud.x_in_base).query(surface, distance_upper_bound=NEAR)[0] <= NEAR
    return 100 * float(near[labels == TABLE].mean()), 100 * float(near[labels > TABLE].mean())


def _figure(image: UInt8[ndarray, "h w 3"], clouds: list[Cloud]) -> bytes:
    """PNG: an image, and each dense cloud from above in its colours with COLMAP's points in red (paper, Fig. 8)."""
    sparse, *dense = clouds
    figure = blank(12, 4.2, "constrained")
    first, *others = figure.subplots(1, 1 + len(dense))
    first.imshow(image)
    first.set_title("one of the images", fontsize=9)
    first.set_axis_off()
    for axis, cloud in zip(others, dense, strict=True):
        _from_above(axis, cloud)
        axis.scatter(*sparse.x_in_base[:, 1::-1].T * [[-1], [1]], s=1.5, c="red", linewidths=0)
        axis.set_title(f"{cloud.name}\nred: COLMAP's points", fontsize=9)
    return png(figure, 110)


def _from_above(axis: "Axes", cloud: Cloud) -> None:
    """The highest points last, x upwards and y to the left, as the robot has it before itself."""
    drawn = np.random.default_rng(0).permutation(len(cloud.x_in_base))[:DRAWN]
    drawn = drawn[np.argsort(cloud.x_in_base[drawn, 2])]
    assert cloud.color is not None
    axis.scatter(
        -cloud.x_in_base[drawn, 1], cloud.x_in_base[drawn, 0], s=0.6, c=cloud.color[drawn] / 255, linewidths=0
    )
    middle = np.median(cloud.x_in_base, axis=0)
    axis.set(
        xlim=(-middle[1] - 0.35, -middle[1] + 0.35), ylim=(middle[0] - 0.3, middle[0] + 0.3), aspect="equal"
    )
    axis.set_xticks([])
    axis.set_yticks([])
