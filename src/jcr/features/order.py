"""Order in which images are reconstructed: by their gripper poses, independent of names and listing.

Matches, RANSAC's draws and the first pair of a map depend on the order: by names, calibrations differed by up to 1.7 σ.
"""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

DECIMALS = 9
"""Number of decimals of a pose that count, so that rounding by a file format changes no order."""


def order_by_pose(base_from_gripper: Float[ndarray, "n 4 4"]) -> Int[ndarray, " n"]:
    """Return rows of gripper poses in the order of reconstruction; equal poses keep their order."""
    # Adding zero makes -0 and 0 the same. A pose is sorted by its position, x first, then by its rotation.
    pose = np.round(base_from_gripper, DECIMALS) + 0.0
    keys = np.concatenate([pose[:, :3, 3], pose[:, :3, :3].reshape(-1, 9)], axis=1)
    return np.lexsort(keys.T[::-1])
