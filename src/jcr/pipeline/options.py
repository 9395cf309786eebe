"""Options of `jcr batch` and `jcr verify`, separate from their modules so that the command-line help loads fast."""

from dataclasses import dataclass

TOLERANCE = (0.5, 0.05)
"""Default tolerance of `jcr verify` (mm, degrees): drifts smaller than both raise no alarm, however significant."""


@dataclass(frozen=True, kw_only=True)
class BatchOptions:
    """Options of a batch of runs: processes, Ray cluster, and resources of each capture."""

    processes: int | None = None
    """Captures at a time on this machine (unset: one for every two cores); cores are shared out among them."""
    calibrate_only: bool = False
    """Calibration and report alone: no cloud and no map."""
    ray: str | None = None
    """Run on a Ray cluster at this address (auto: the one this machine belongs to). Every node must see the same
    folders. Needs the extra jcr-handeye[cluster]."""
    cpus_per_task: int = 2
    """Cores that a capture takes, with --ray."""
    gpus_per_task: float = 0.0
    """GPUs that a capture takes, with --ray; 0.25 lets four share one."""
