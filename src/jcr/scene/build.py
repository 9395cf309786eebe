"""Construction of a map from a point cloud: grid of seen space, then training of the fields."""

import math
import time
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from threadpoolctl import threadpool_limits

from jcr.progress import Progress, silent
from jcr.records import PointCloud
from jcr.scene.fields import Field, Fields, Lattice
from jcr.scene.options import MapOptions
from jcr.scene.scene_map import SceneMap
from jcr.scene.seen_space import HIT, SeenGrid, carve, dilate, halve, without_doubts
from jcr.scene.train import NEAR, rows_inside, train, workspace_box, workspace_rays

HIDDEN = 32
"""Number of hidden units of a field's network."""
OCCUPANCY_GRIDS, SURFACE_GRIDS = ((0, 4), (1, 2)), ((0, 4), (2, 4))
"""Feature grids of the occupancy field and of the field of surface properties, each as (row of `feature_lattices`,
features per node)."""


def build_scene(
    cloud: PointCloud,
    options: MapOptions | None = None,
    progress: Progress = silent,
    device: str = "cpu",
) -> SceneMap:
    """Return the map of a cloud: a grid of the seen space, and networks for occupancy, colour and label at a position.

    The networks are those of the preset "default". Raises InputError if fewer than 100 points lie in the workspace.
    `device` is a torch device, such as "cuda".
    """
    options = options or MapOptions()
    assert options.preset == "default", "paper.fields.published_scene trains the published networks"
    start = time.perf_counter()
    with threads_of_one_core(torch.device(device)) as pool:
        seen, cell, box = carved_workspace(cloud, options, progress, device)
        carved = time.perf_counter()
        rays = workspace_rays(cloud, box, cell, device)
        heads = {"color": 3} | ({"label": len(cloud.label_names)} if "label" in rays.targets else {})
        lattices, generator = feature_lattices(seen), torch.Generator().manual_seed(options.map_seed)
        occupancy, surface = (
            Field(own, HIDDEN, seen.box, lattices, grids=grids, generator=generator)
            for own, grids in (({"occupancy": 1}, OCCUPANCY_GRIDS), (heads, SURFACE_GRIDS))
        )
        fields = Fields([occupancy, surface], lattices).to(device)

        def fit(field: Field) -> int:
            stage = f"map: {', '.join(field.heads)}"
            return train(field, rays, seen, options.map_seed, options.max_seconds, partial(progress, stage))

        steps = " + ".join(map(str, pool.map(fit, fields.of)))
    history = {"preset": "default", "carving_s": f"{carved - start:.3f}", "steps": steps}
    history["training_s"] = f"{time.perf_counter() - carved:.3f}"
    return SceneMap(fields, without_doubts(seen), cloud.label_names, history)


def carved_workspace(
    cloud: PointCloud, options: MapOptions, progress: Progress, device: str
) -> tuple[SeenGrid, float, Float[ndarray, "2 3"]]:
    """Return the grid of seen space of a cloud, the side (m) of a map cell, and the corners (m) of the workspace.

    Raises InputError if fewer than 100 points lie in the workspace.
    """
    box = workspace_box(cloud, options.workspace)
    cell = max(options.cell, float(np.prod(box[1] - box[0]) / options.max_cells) ** (1 / 3))
    box[1] = box[0] + np.ceil((box[1] - box[0]) / cell - 1e-6) * cell
    rows_inside(cloud, box)
    progress("what was seen", 0.0)
    # All points are used, because rays that end outside of the workspace may cross it.
    ends = cloud.points_in_base, cloud.image, cloud.camera_centers_in_base
    return carve(*ends, box, cell / 2, cloud.cleared, device), cell, box


def feature_lattices(seen: SeenGrid) -> list[Lattice]:
    """Return three grids of trainable features: nodes 4 map cells apart everywhere, 1 near surfaces, 1/2 on surfaces.

    A map cell has twice the side of a cell of `seen`. Near surfaces are map cells up to two cells (NEAR) from a hit
    one. On surfaces are cells of `seen` up to one cell from a hit one.
    """
    hit = (seen.state & HIT) != 0
    nz, ny, nx = ((n // 2 + 3) // 4 for n in hit.shape)
    everywhere = torch.ones(nz, ny, nx, dtype=torch.bool, device=hit.device)
    cell = 2 * seen.cell
    return [
        Lattice.around(everywhere, seen.lower, 4 * cell),
        Lattice.around(dilate(halve(hit), math.ceil(NEAR)), seen.lower, cell),
        Lattice.around(dilate(hit, 1), seen.lower, cell / 2),
    ]


def threads_of_one_core(device: torch.device) -> Executor:
    """Return a pool with one thread per core (for a GPU, one thread), in which torch starts no further threads.

    The threads inside torch wait for each other in a busy loop after every short operation. When another process used
    one core, a training of one second therefore lasted a minute. The limit holds in the threads of this pool only.
    """

    def limit() -> None:
        torch.zeros(1)  # torch sets its number of threads at a thread's first operation
        threadpool_limits(1, user_api="openmp")

    return ThreadPoolExecutor(torch.get_num_threads() if device.type == "cpu" else 1, initializer=limit)
