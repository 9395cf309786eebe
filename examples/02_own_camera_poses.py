"""Hand-eye calibration from camera poses of your own: a SLAM system, a network, a marker, in any frame and unit.

    python examples/02_own_camera_poses.py

`jcr.solve_hand_eye` takes two stacks (n,4,4): the gripper's poses in the base (m) and the camera's poses in
whatever frame and unit your system has, of the same instants. It needs no images. Here both are simulated, so
that the answer can be held against the truth; put your own arrays in their place.
"""

import sys
from pathlib import Path

import numpy as np

import jcr
from jcr.geometry import rotation_between_deg

sys.path.append(str(Path(__file__).resolve().parents[1]))  # of the checkout, for what is simulated
from simulation.problems import hand_eye_problem

# Ten poses of an arm that reports them with 0.5 mm and 0.1° of noise.
noise = (0.0005, np.radians(0.1))
problem = hand_eye_problem(np.random.default_rng(1), count=10, robot_noise=noise)
solve = jcr.solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)

sigma = np.sqrt(np.diag(solve.covariance))  # x y z (m), rotation vector (rad), log of scale
off_m = np.linalg.norm((solve.gripper_from_camera - problem.gripper_from_camera)[:3, 3])
off_deg = rotation_between_deg(solve.gripper_from_camera[:3, :3], problem.gripper_from_camera[:3, :3])
print(f"gripper_from_camera (m):\n{solve.gripper_from_camera.round(4)}")
print(f"scale: {solve.scale:.4f} m per unit ± {100 * sigma[6]:.2f} %")
print(f"one sigma: {1e3 * sigma[:3].max():.2f} mm, {np.degrees(sigma[3:6].max()):.3f}°")
print(f"off the truth: {1e3 * off_m:.2f} mm, {off_deg:.3f}°")
print(f"used: {solve.inliers.sum()} of {len(solve.inliers)} poses")

# An arm that only slides and never turns its wrist: the answer names what it cannot know, and the cure.
sliding = hand_eye_problem(np.random.default_rng(1), count=10, pattern="translation", robot_noise=noise)
solve = jcr.solve_hand_eye(sliding.base_from_gripper, sliding.recon_from_camera)
print(f"without rotating: observable {solve.observability.observable}, {solve.verdict}")
for unseen, cure in zip(solve.observability.unobservable, solve.observability.advice, strict=True):
    print(f"- {unseen}; {cure}")
