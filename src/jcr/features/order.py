"""The order in which images are reconstructed: by their gripper poses, whatever they are called and however listed.

Matches of a pair, RANSAC's draws and the first pair of a map depend on which image comes first. By names, 10.png came
before 2.png, and the same images taken live before both: calibrations differed by up to 1.7 σ.
"""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

DECIMALS = 9
"""Number of decimals of a pose that count, so that rounding by a file format changes no order."""


def order_key(base_from_gripper: Float[ndarray, "4 4"]) -> tuple[float, ...]:
    """Return the sort key of a gripper pose: position (m), x first, then rotation."""
    # Adding zero makes -0 and 0 the same.
    pose = np.round(base_from_gripper, DECIMALS) + 0.0
    return (*pose[:3, 3].tolist(), *pose[:3, :3].ravel().tolist())


def order_by_pose(base_from_gripper: Float[ndarray, "n 4 4"]) -> Int[ndarray, " n"]:
    """Return rows of gripper poses in the order of reconstruction; equal poses keep their order."""
    return np.array(sorted(range(len(base_from_gripper)), key=lambda k: order_key(base_from_gripper[k])))
