"""Options of `jcr batch` and `jcr verify`, separate from their modules so that the command-line help loads fast."""

from dataclasses import dataclass

TOLERANCE = (0.5, 0.05)
"""Default tolerance of `jcr verify` (mm, degrees): drifts smaller than both raise no alarm, however significant."""


@dataclass(frozen=True, kw_only=True)
class BatchOptions:
    """Options of a batch of runs: processes, Ray cluster, and resources of each capture."""

    processes: int | None = None
    """Number of captures that run at a time on this machine and share its cores; by default one for every two cores."""
    calibrate_only: bool = False
    """Calibrate and write the report only, without cloud and map."""
    ray: str | None = None
    """Address of a Ray cluster to run on; auto is the cluster of this machine. Every node must see the same folders.
    This needs the extra jcr-handeye[cluster]."""
    cpus_per_task: int = 2
    """Number of cores for a capture, with --ray."""
    gpus_per_task: float = 0.0
    """Number of GPUs for a capture, with --ray; with 0.25 four captures share one."""
