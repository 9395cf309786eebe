"""Hand-eye calibration from camera poses of your own: a SLAM system, a network, a marker, in any frame and unit.

    python examples/02_own_camera_poses.py

`jcr.solve_hand_eye` takes two stacks (n,4,4): the gripper's poses in the base (m) and the camera's poses in
whatever frame and unit your system has, of the same instants. It needs no images. Here both are simulated, so
that the answer can be held against the truth; put your own arrays in their place.
"""

import numpy as np
from scipy.spatial.transform import Rotation

import jcr

rng = np.random.default_rng(1)


def transforms(rotation_vectors, translations):
    """Return stacked transforms (n,4,4) of rotation vectors (rad) and translations."""
    stack = np.tile(np.eye(4), (len(rotation_vectors), 1, 1))
    stack[:, :3, :3] = Rotation.from_rotvec(rotation_vectors).as_matrix()
    stack[:, :3, 3] = translations
    return stack


def simulated(base_from_gripper):
    """Return reported gripper poses, camera poses in a frame and unit of their own, and the true transform."""
    (gripper_from_camera,) = transforms([[0.1, -0.2, 0.8]], [[0.03, -0.05, 0.08]])
    (recon_from_base,) = transforms([[0.5, 1.0, -0.3]], [[1.0, 2.0, -1.0]])
    recon_from_camera = recon_from_base @ base_from_gripper @ gripper_from_camera
    recon_from_camera[:, :3, 3] *= 3.7  # units a metre
    noise = transforms(rng.normal(0, np.radians(0.1), (10, 3)), rng.normal(0, 0.0005, (10, 3)))
    return base_from_gripper @ noise, recon_from_camera, gripper_from_camera


# Ten poses of an arm that reports them with 0.5 mm and 0.1° of noise.
positions = rng.uniform(-0.2, 0.2, (10, 3)) + [0.5, 0.0, 0.4]
reported, recon_from_camera, truth = simulated(transforms(rng.normal(0, 0.4, (10, 3)), positions))
solve = jcr.solve_hand_eye(reported, recon_from_camera)

sigma = np.sqrt(np.diag(solve.covariance))  # x y z (m), rotation vector (rad), log of scale
off = np.linalg.inv(truth) @ solve.gripper_from_camera
off_m, off_deg = np.linalg.norm(off[:3, 3]), np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude())
print(f"gripper_from_camera (m):\n{solve.gripper_from_camera.round(4)}")
print(f"scale: {solve.scale:.4f} m per unit ± {100 * sigma[6]:.2f} %")
print(f"one sigma: {1e3 * sigma[:3].max():.2f} mm, {np.degrees(sigma[3:6].max()):.3f}°")
print(f"off the truth: {1e3 * off_m:.2f} mm, {off_deg:.3f}°")
print(f"used: {solve.images_used} of {len(solve.images)} poses")

# An arm that only slides and never turns its wrist: the answer names the unobservable part, and the remedy.
sliding, recon_from_camera, _ = simulated(transforms(np.zeros((10, 3)), positions))
solve = jcr.solve_hand_eye(sliding, recon_from_camera)
print(f"without rotating: observable {solve.observability.observable}, {solve.verdict}")
for unobservable, remedy in zip(solve.observability.unobservable, solve.observability.advice, strict=True):
    print(f"- {unobservable}; {remedy}")
