"""Points in the base frame, from which the map is made."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from jcr.records.reconstruction import PRIOR


@dataclass(frozen=True, kw_only=True)
class PointCloud:
    """Confident points in the base frame, with the rays that saw them."""

    points_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"]
    confidence: Float[ndarray, " n"]
    margin: Float[ndarray, " n"]
    """One-sigma position uncertainty (m) that the calibration leaves at the point."""
    label: Int[ndarray, " n"]
    """Segment; 0 = none."""
    image: Int[ndarray, " n"]
    """Row of `camera_centers_in_base`."""
    camera_centers_in_base: Float[ndarray, "m 3"]
    label_names: tuple[str, ...] = field(default=("none",))
    reason: UInt8[ndarray, " n"] | None = None
    """MATCHED, PRIOR or BOTH; None: no point is a prior."""
    depth_std: Float[ndarray, " n"] | None = None
    """One sigma (m) of the depth in its image; None: not known."""
    clears: Bool[ndarray, " n"] | None = None
    """Whether the way from the camera to the point counts as seen free; None: every one but to a PRIOR."""

    @property
    def cleared(self) -> Bool[ndarray, " n"]:
        """`clears`, with what None stands for."""
        if self.clears is not None:
            return self.clears
        return np.ones(len(self.image), bool) if self.reason is None else self.reason != PRIOR
