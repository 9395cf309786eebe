"""All images of a cell, those of the capture's own camera first, and how they are adjusted with its arms."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.adjust.intrinsics_prior import IntrinsicsPrior
from jcr.adjust.robots import Adjusted, ArmPoses
from jcr.adjust.scene import Freedom, Observations, RigInformation, Scene
from jcr.adjust.score_test import freed, with_intrinsics
from jcr.adjust.together import adjust


@dataclass(frozen=True, kw_only=True)
class CellImages:
    """What an adjustment of a cell starts from; cameras by their numbers, the capture's own is 0."""

    scene: Scene
    observations: Observations
    freedom: Freedom
    arms: Sequence[ArmPoses]
    noise: tuple[float, float] | None
    """m, rad: of the gripper poses, at least."""
    prior: RigInformation | None
    """What others than the images and the robots know of the own camera's poses."""

    def adjusted(self) -> Adjusted:
        """Images and arms together."""
        return adjust(self.scene, self.observations, self.freedom, self.arms, self.noise, self.prior)

    def with_freed(
        self, prior: IntrinsicsPrior, camera: int, combinations: Float[ndarray, "e p"] | None = None
    ) -> "CellImages":
        """With another prior of a camera's intrinsics, and combinations of the columns of its score_test.Alternatives
        free too."""
        freedom = with_intrinsics(self.freedom, prior, camera)
        if combinations is not None:
            mine = np.flatnonzero(self.observations.camera == camera)
            freedom = freed(freedom, combinations, mine, camera)
        return replace(self, freedom=freedom)
