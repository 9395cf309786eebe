"""Does the error change with the order of the images? A slip of the camera, a drift, poses that are read late.

One calibration holds for all images, in whatever order they were taken. Against that stand hypotheses with few more
unknowns, linear about the fit: another X after some image (6), an X that drifts evenly (6), poses that are those of a
moment later (1). Each is an F test of the poses' residuals (Seber and Lee, Linear Regression Analysis, 2003, ch. 4),
whose p is multiplied by the number of places that were tried.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.linalg import solve_triangular

from jcr.calibration.case import Case, Checked
from jcr.calibration.robot_errors import of_poses
from jcr.distributions import f as f_distribution
from jcr.estimation.pose_equations import PRIOR_STD, ROTATION, TRANSLATION, Poses, residuals
from jcr.records import Finding, HandEye, Kind

LOG_P = float(np.log(1e-4))
"""Chance of any one alarm where there is nothing."""
MATERIAL = 0.5
"""Standard deviations by which a fault must move the camera's place on some axis to be reported."""
BY_CHANCE = 0.02
"""Share of groupings in any other order that may explain as much: the errors of real arms have heavy tails."""
GROUPINGS = 200
LARGE_SLIP = 3e-3, float(np.radians(0.5))
"""m, rad: a larger one no answer with its uncertainty can hold; robots whose joints have play show smaller ones."""
LEAST_PART = 3
"""Images on either side of a change."""
MIN_IMAGES = 7
MANY_PLACES = 60
"""Of a longer capture changes are looked for at this many places."""


@dataclass(frozen=True, kw_only=True)
class _Found:
    log_p: float
    base: Float[ndarray, "13"]
    """Step of the calibration beside it."""
    value: Float[ndarray, " p"]
    covariance: Float[ndarray, "p p"]
    shift: Float[ndarray, "7"]


def check_sequence(case: Case) -> Checked:
    """A slip, a drift or a delay that the order of the images shows."""
    found = sequence_fault(
        case.hand_eye,
        case.base_from_gripper,
        case.reconstruction.recon_from_camera,
        case.names,
        case.robot.systematic,
    )
    return Checked(() if found is None else (found,))


def sequence_fault(
    hand_eye: HandEye,
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    images: Sequence[str],
    systematic: Float[ndarray, "r r"],
) -> Finding | None:
    """What the order of the images shows against one calibration of them; None where that is nothing.

    `images` are their names in the order of taking, `systematic` is the covariance of the systematic errors of their
    poses at 1 rad. Delay is counted in intervals between images.
    """
    m = len(base_from_gripper)
    if m < MIN_IMAGES or not hand_eye.observability.observable:
        return None
    # The residuals of camera poses have the errors that the fit to these poses found, not those that are left once
    # features correct the cameras: these call a sound capture moved, and leave a moved one unsaid.
    fit = hand_eye.before or hand_eye
    residual, by = residuals(
        fit.gripper_from_camera, fit.scale, fit.base_from_recon, base_from_gripper, recon_from_camera
    )
    robot, every = fit.robot_noise, np.arange(m)
    noise = robot.translation, robot.rotation
    problem = _Equations(
        images=every, residual=residual, by=by, systematic=robot.systematic**2 * systematic, noise=noise
    )
    # An image that is rejected between others that agree is wrong by itself; after a slip several in a row are.
    rejected = np.pad(~hand_eye.inliers, 1)
    in_order = problem.of(np.flatnonzero(hand_eye.inliers | rejected[:-2] | rejected[2:]))
    places = np.unique(
        np.linspace(LEAST_PART, m - LEAST_PART, min(m - 2 * LEAST_PART + 1, MANY_PLACES)).astype(int)
    )
    after = {k: (every >= k).astype(float) for k in places.tolist()}
    slip, k = min(((in_order.moved_by(after[k]), k) for k in after), key=lambda one: one[0].log_p)
    drift = in_order.moved_by(np.linspace(-0.5, 0.5, m))
    delay = problem.tested(_velocity(base_from_gripper)[..., None])
    # Of each fault the shares of its X in the images, which other orders must not explain as well.
    found = [
        (slip.log_p + np.log(len(places)), slip, Kind.SLIP, after[k]),
        (drift.log_p, drift, Kind.DRIFT, every / m),
        (delay.log_p, delay, Kind.DELAY, None),
    ]
    log_p, best, kind, share = min(found, key=lambda one: one[0])
    if log_p > LOG_P or (share is not None and not in_order.is_of_the_order(share, best)):
        return None
    std = np.sqrt(np.diag(hand_eye.covariance)[:6])
    if not (np.abs(best.shift[:6] if share is None else best.value) > MATERIAL * std).any():
        return None
    finding = Finding.of(kind, "warns", "mount", p=float(np.exp(max(log_p, -700))))
    return replace(finding, **_size(kind, best, k, images))


def _size(kind: Kind, found: _Found, place: int, images: Sequence[str]) -> dict[str, Any]:
    """The fields of a finding that state how large the fault is; a slip is before the image at `place`."""
    if kind is Kind.DELAY:
        std = float(np.sqrt(found.covariance[0, 0]))
        shift, unit = tuple(found.shift.tolist()), {"unit": "interval"}
        return {"mend": "poses", "value": float(found.value[0]), "std": std, "shift": shift, "details": unit}
    metres, radians = np.linalg.norm(found.value.reshape(2, 3), axis=1).tolist()
    if kind is Kind.DRIFT:
        shift = (*(found.value / 2).tolist(), 0.0)
        return {"value": metres, "shift": shift, "details": {"rotation": radians}}
    count, longer = max((place, "before"), (len(images) - place, "after"))
    return {
        "severity": "rejects" if metres > LARGE_SLIP[0] or radians > LARGE_SLIP[1] else "warns",
        "images": (images[place - 1], images[place]),
        "value": metres,
        "shift": (*found.value.tolist(), 0.0),
        "details": {"rotation": radians, "longer": longer, "count": float(count)},
    }


@dataclass(frozen=True, kw_only=True)
class _Equations:
    """Those of some images, linearised."""

    images: Int[ndarray, " k"]
    residual: Float[ndarray, "k 6"]
    by: Float[ndarray, "k 6 13"]
    systematic: Float[ndarray, "r r"]
    """Covariance of the systematic errors."""
    noise: tuple[float, float]
    """m, rad per axis: random errors, as they are without a fault."""

    def of(self, images: Int[ndarray, " k"]) -> "_Equations":
        """Those of some images, where these are of all."""
        return replace(
            self,
            images=images,
            residual=self.residual[images],
            by=self.by[images],
            systematic=of_poses(self.systematic, images),
        )

    def tested(self, columns: Float[ndarray, "m 6 p"]) -> _Found:
        """What columns, given for all images, explain, in units of the noise that they leave.

        A fault in translation alone is counted as noise of translations by a fit that does not know it, and beside the
        noise of rotations, which it is not, no such fault could be large.
        """
        columns = columns[self.images]
        return self._tested(columns, self._noise_left(columns))

    def _tested(self, columns: Float[ndarray, "k 6 p"], noise: tuple[float, float]) -> _Found:
        white = np.diag(np.tile(np.repeat(noise, 3), len(self.images)) ** 2)
        factor = np.linalg.cholesky(white + self.systematic)

        def whitened(rows: Float[ndarray, "k 6 q"]) -> Float[ndarray, "r q"]:
            return solve_triangular(factor, rows.reshape(len(factor), -1), lower=True)

        return _tested(whitened(self.residual[..., None])[:, 0], whitened(self.by), whitened(columns))

    def _noise_left(self, columns: Float[ndarray, "k 6 p"]) -> tuple[float, float]:
        """m, rad per axis: what the equations leave with the columns free, where that is less than without."""
        found = self._tested(columns, self.noise)
        left = self.residual + self.by @ found.base + columns @ found.value
        freedom = 1 - (self.by.shape[2] + columns.shape[2]) / left.size
        metres, radians = np.sqrt((left.reshape(-1, 2, 3) ** 2).mean(axis=(0, 2)) / freedom).tolist()
        return min(metres, self.noise[0]), min(radians, self.noise[1])

    def moved_by(self, share: Float[ndarray, " m"]) -> _Found:
        """An X that moves by a share at each image."""
        of_x = self.by[:, :, [*range(*TRANSLATION.indices(13)), *range(*ROTATION.indices(13))]]
        columns = np.zeros((len(share), 6, 6))
        columns[self.images] = of_x * share[self.images][:, None, None]
        return self.tested(columns)

    def is_of_the_order(self, share: Float[ndarray, " m"], found: _Found) -> bool:
        """Whether the same shares in other orders explain less: a permutation test."""
        rng, shuffled = np.random.default_rng(0), share.copy()
        as_much = others = 0
        for _ in range(GROUPINGS):
            shuffled[self.images] = rng.permutation(share[self.images])
            one, other = (of[self.images] - of[self.images].mean() for of in (shuffled, share))
            # A calibration takes up a constant and a sign; of 8 images one order in 35 has the same halves.
            if np.allclose(one, other) or np.allclose(one, -other):
                continue
            others += 1
            as_much += self.moved_by(shuffled).log_p <= found.log_p + 1e-9
        return as_much <= BY_CHANCE * others


def _tested(
    flat: Float[ndarray, " n"], design: Float[ndarray, "n 13"], more: Float[ndarray, "n p"]
) -> _Found:
    """The F test of more columns, in units of the noise; their size, and how X moves with them."""
    prior = np.concatenate([np.diag(1 / PRIOR_STD), np.zeros((7, 6))], axis=1)
    n, p = len(flat), more.shape[1]
    stacked = np.concatenate([design, prior])
    target = np.concatenate([-flat, np.zeros(7)])
    without, *_ = np.linalg.lstsq(stacked, target, rcond=None)
    both = np.concatenate([stacked, np.concatenate([more, np.zeros((7, p))])], axis=1)
    found, *_ = np.linalg.lstsq(both, target, rcond=None)
    least, most = (float(((a @ s - target) ** 2).sum()) for a, s in ((both, found), (stacked, without)))
    freedom = n - 13 - p
    ratio = (most - least) / p / max(least / freedom, 1e-12)
    inverse = np.linalg.pinv(both.T @ both) * least / freedom
    shift = found[:7] - without[:7]
    log_p = float(f_distribution.logsf(ratio, p, freedom))
    return _Found(log_p=log_p, base=found[:13], value=found[13:], covariance=inverse[13:, 13:], shift=shift)


def _velocity(base_from_gripper: Poses) -> Float[ndarray, "m 6"]:
    """Steps per interval (base axes) at each image of an arm that goes smoothly through all of them."""
    # They take as long to import as all of SciPy that every command needs.
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    moment, little = np.arange(len(base_from_gripper), dtype=float), 1e-3
    position = CubicSpline(moment, base_from_gripper[:, :3, 3])
    rotation = RotationSpline(moment, Rotation.from_matrix(base_from_gripper[:, :3, :3]))
    rotation_between = rotation(moment + little) * rotation(moment - little).inv()
    return np.concatenate([position(moment, 1), rotation_between.as_rotvec() / (2 * little)], axis=1)
