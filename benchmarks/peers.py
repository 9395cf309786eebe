"""Other people's hand-eye solvers, to be measured beside ours on the same poses."""

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import inverse, nearest_rotation, rotation_log, scale_translation, transform

Poses = Float[ndarray, "n 4 4"]
Answer = tuple[Float[ndarray, "4 4"], float]

OPENCV_METHODS = {
    "Tsai": cv2.CALIB_HAND_EYE_TSAI,
    "Park": cv2.CALIB_HAND_EYE_PARK,
    "Horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "Andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "Daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}


def opencv(method: str, base_from_gripper: Poses, recon_from_camera: Poses, scale: float) -> Answer:
    """One of OpenCV's five methods; they cannot find scale and are given it."""
    camera_from_recon = inverse(scale_translation(recon_from_camera, scale))
    rotation, translation = cv2.calibrateHandEye(
        list(base_from_gripper[:, :3, :3]),
        list(base_from_gripper[:, :3, 3]),
        list(camera_from_recon[:, :3, :3]),
        list(camera_from_recon[:, :3, 3]),
        method=OPENCV_METHODS[method],
    )
    # With wrong poses among them some methods answer with a reflection.
    return transform(nearest_rotation(rotation), translation[:, 0]), scale


def grid_search(base_from_gripper: Poses, recon_from_camera: Poses, steps: int = 20_000) -> Answer:
    """The paper's: Park-Martin over consecutive images, then λ by trying `steps` values from 1 to 4.

    All values are tried at once; the authors' loop over them takes a second.
    """
    a = inverse(base_from_gripper[:-1]) @ base_from_gripper[1:]
    b = inverse(recon_from_camera[:-1]) @ recon_from_camera[1:]
    m = np.einsum("ni,nj->ij", rotation_log(b[:, :3, :3]), rotation_log(a[:, :3, :3]))
    rotation = nearest_rotation(m.T)
    rows = (np.eye(3) - a[:, :3, :3]).reshape(-1, 3)
    scales = np.linspace(1.0, 4.0, steps)
    right = a[:, :3, 3].reshape(-1, 1) - scales * (b[:, :3, 3] @ rotation.T).reshape(-1, 1)
    translations = np.linalg.pinv(rows) @ right
    best = int(((rows @ translations - right) ** 2).sum(0).argmin())
    return transform(rotation, translations[:, best]), float(scales[best])


def andreff_with_scale(base_from_gripper: Poses, recon_from_camera: Poses) -> Answer:
    """Linear in rotation, translation and scale at once (Andreff, Horaud and Espiau, IJRR 2001)."""
    a = inverse(base_from_gripper[:-1]) @ base_from_gripper[1:]
    b = inverse(recon_from_camera[:-1]) @ recon_from_camera[1:]
    unit = np.linalg.norm(b[:, :3, 3]) / np.linalg.norm(a[:, :3, 3])
    rows = np.zeros((len(a), 12, 13))
    for k in range(len(a)):
        rows[k, :9, :9] = np.eye(9) - np.kron(a[k, :3, :3], b[k, :3, :3])
        rows[k, 9:, :9] = np.kron(np.eye(3), b[k, :3, 3] / unit)
        rows[k, 9:, 9:12] = np.eye(3) - a[k, :3, :3]
        rows[k, 9:, 12] = -a[k, :3, 3]
    null = np.linalg.svd(rows.reshape(-1, 13))[2][-1]
    # The null vector is (R, t/λ, 1/λ) up to a factor that makes det R = 1.
    null = null / np.cbrt(np.linalg.det(null[:9].reshape(3, 3)))
    rotation = nearest_rotation(null[:9].reshape(3, 3))
    return transform(rotation, null[9:12] / null[12]), float(1 / (null[12] * unit))
