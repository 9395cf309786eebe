"""The hand-eye transform from rough correspondences: what the robot's motion makes of them, from no start at all.

A correspondence of two images, whose cameras are base_from_gripper[i] · gripper_from_camera, must lie on the
epipolar line that this motion draws (Longuet-Higgins 1981). The motion being known in metres, the unknowns of
all pairs together are seven: gripper_from_camera, and the focal length where no lens is given. So even matches
that are pixels off and wrong by half determine them to a few degrees, though no pair's own motion could be told.

Shapes: s hypotheses, k matches.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.errors import InputError, NotTrustedError
from jcr.geometry import inverse, rotation_between_deg, rotation_exp, transform
from jcr.records import Intrinsics

FOCAL_PRIOR = (0.9, 0.2)
"""Focal length over the image's width, and one sigma of its logarithm: 45 to 80 degrees are within 1.5 of these."""


@dataclass(frozen=True)
class Matches:
    """k places in two images each that are said to be the same, in pixels of undistorted images."""

    first: Int[ndarray, " k"]
    """Row of the image."""
    second: Int[ndarray, " k"]
    first_px: Float[ndarray, "k 2"]
    """x, y; (0, 0) is the centre of the upper left pixel."""
    second_px: Float[ndarray, "k 2"]
    weight: Float[ndarray, " k"]
    """From 0 to 1."""
    size: tuple[int, int]
    """Width and height of the images, pixels."""

    def __len__(self) -> int:
        return len(self.first)

    def rows(self, which: Int[ndarray, " r"] | Bool[ndarray, " k"]) -> "Matches":
        """Some of them."""
        return Matches(
            self.first[which],
            self.second[which],
            self.first_px[which],
            self.second_px[which],
            self.weight[which],
            self.size,
        )


@dataclass(frozen=True)
class EpipolarOptions:
    """How the seven unknowns are searched for."""

    starts: int = 400
    """Rotations drawn evenly."""
    offset: float = 0.1
    """One-sigma prior of each coordinate of the camera on the gripper, metres."""
    noise_px: tuple[float, ...] = (5.0, 3.0, 1.5, 1.0)
    """Scale of the robust loss, of images 64 pixels wide, round by round."""
    kept: tuple[int, ...] = (32, 12, 6, 4)
    """Hypotheses that each round refines."""
    sample: int = 300
    """Matches of the first round; the last one has all."""
    independent: float = 0.1
    """Share of the matches that errs on its own: neighbours err alike."""
    least_share: float = 0.3
    """Of the matches (by weight) that must lie within three times the last scale of their epipolar line, with the
    point ahead of both cameras."""
    seed: int = 0


@dataclass(frozen=True)
class EpipolarHandEye:
    """Where the camera sits on the gripper, roughly."""

    gripper_from_camera: Float[ndarray, "4 4"]
    focal_px: tuple[float, float]
    """fx and fy in the pixels of the matches."""
    share: float
    """Of the matches, by weight, that agree with it."""
    rival_share: float
    """Of the best other solution, turned by 20 degrees or more; 0: there is none."""


def hand_eye_from_matches(
    matches: Matches,
    base_from_gripper: Float[ndarray, "n 4 4"],
    pinhole: Intrinsics | None = None,
    options: EpipolarOptions | None = None,
) -> EpipolarHandEye:
    """Search all rotations for the hand-eye transform with which most matches agree; `pinhole` is of their pixels.

    Of pairs of which the robot did not move nothing is learnt. Raises InputError for fewer than 3 images, and
    NotTrustedError where too few matches agree with any hypothesis.
    """
    options = options or EpipolarOptions()
    if len(base_from_gripper) < 3:
        raise InputError(f"{len(base_from_gripper)} images: the motion needs 3 or more; take more")
    if len(matches) < 20:
        raise NotTrustedError(
            f"only {len(matches)} places were found again in another picture; 20 are needed"
        )
    rng = np.random.default_rng(options.seed)
    problem = _Problem(matches, base_from_gripper, pinhole, options)
    hypotheses = _Hypotheses(
        Rotation.random(options.starts, rng=rng).as_matrix(),
        np.zeros((options.starts, 3)),
        np.full(options.starts, np.log(FOCAL_PRIOR[0] * matches.size[0])),
    )
    last, noise_px = len(options.kept) - 1, 0.0
    for step, (noise, kept) in enumerate(zip(options.noise_px, options.kept, strict=True)):
        part, sample = problem, options.sample * (step + 1)
        if step < last and sample < len(matches):
            share = matches.weight / matches.weight.sum()
            part = problem.rows(rng.choice(len(matches), sample, replace=False, p=share))
        noise_px = noise * matches.size[0] / 64
        best = np.argsort(part.cost(hypotheses, noise_px))[:kept]
        hypotheses = _refined(part, hypotheses.rows(best), noise_px)
    shares = problem.agreeing(hypotheses, 3 * noise_px)
    best = int(np.argmax(shares))
    turned = rotation_between_deg(hypotheses.rotation, hypotheses.rotation[best]) > 20
    if shares[best] < options.least_share:
        raise NotTrustedError(
            f"of the places found again in other pictures {100 * shares[best]:.0f} % fit the robot's motion, "
            f"{100 * options.least_share:.0f} % are needed; take pictures whose views overlap more"
        )
    focal = float(np.exp(hypotheses.log_focal[best]))
    return EpipolarHandEye(
        transform(hypotheses.rotation[best], hypotheses.offset[best]),
        (focal, focal) if pinhole is None else (pinhole.fx, pinhole.fy),
        float(shares[best]),
        float(shares[turned].max(initial=0.0)),
    )


@dataclass(frozen=True)
class _Hypotheses:
    rotation: Float[ndarray, "s 3 3"]
    """gripper_from_camera."""
    offset: Float[ndarray, "s 3"]
    log_focal: Float[ndarray, " s"]

    def rows(self, which: Int[ndarray, " r"]) -> "_Hypotheses":
        return _Hypotheses(self.rotation[which], self.offset[which], self.log_focal[which])

    def moved(self, step: Float[ndarray, "s 7"]) -> "_Hypotheses":
        """Turned in camera axes, shifted, and with another focal length."""
        return _Hypotheses(
            self.rotation @ rotation_exp(step[:, :3]), self.offset + step[:, 3:6], self.log_focal + step[:, 6]
        )

    def where(self, better: Bool[ndarray, " s"], other: "_Hypotheses") -> "_Hypotheses":
        """Those of the other where better."""
        return _Hypotheses(
            np.where(better[:, None, None], other.rotation, self.rotation),
            np.where(better[:, None], other.offset, self.offset),
            np.where(better, other.log_focal, self.log_focal),
        )


class _Problem:
    """Matches and the robot's motion between their images."""

    def __init__(
        self,
        matches: Matches,
        base_from_gripper: Float[ndarray, "n 4 4"],
        pinhole: Intrinsics | None,
        options: EpipolarOptions,
    ) -> None:
        self.matches, self.base_from_gripper, self.pinhole = matches, base_from_gripper, pinhole
        self.options = options
        width, height = matches.size
        self.center = np.array(
            [(width - 1) / 2, (height - 1) / 2] if pinhole is None else [pinhole.cx, pinhole.cy]
        )
        motion = inverse(base_from_gripper[matches.first]) @ base_from_gripper[matches.second]
        self.turn, self.shift = motion[:, :3, :3], motion[:, :3, 3]
        # Of the offset and the focal length; a given lens is held.
        self.prior = np.array([0, 0, 0, *[options.offset**-2] * 3, FOCAL_PRIOR[1] ** -2])
        self.weight = options.independent * matches.weight

    def rows(self, which: Int[ndarray, " r"]) -> "_Problem":
        """Some of the matches, which weigh as much as all."""
        part = _Problem(self.matches.rows(which), self.base_from_gripper, self.pinhole, self.options)
        part.weight = part.weight * (self.weight.sum() / part.weight.sum())
        return part

    def residuals(self, hypotheses: _Hypotheses) -> tuple[Float[ndarray, "s k"], Bool[ndarray, "s k"]]:
        """Distance (pixels) from the epipolar line to first order (Sampson 1982), and whether the point is ahead."""
        # Coordinates come first, so that every operation runs along memory.
        m, r = self.matches, hypotheses.rotation
        if self.pinhole is None:
            fx = fy = np.exp(hypotheses.log_focal)[:, None]
        else:
            fx, fy = self.pinhole.fx, self.pinhole.fy
        first, second = (px - self.center for px in (m.first_px, m.second_px))
        # In the axes of the first gripper.
        ray1, ray2 = (
            np.stack(
                [r[:, c, :1] * (x[:, 0] / fx) + r[:, c, 1:2] * (x[:, 1] / fy) + r[:, c, 2:] for c in range(3)]
            )
            for x in (first, second)
        )
        ray2 = np.stack([(self.turn[:, c].T[:, None] * ray2).sum(0) for c in range(3)])
        offset = hypotheses.offset.T[:, :, None]
        baseline = np.stack([(self.turn[:, c].T[:, None] * offset).sum(0) for c in range(3)])
        baseline = baseline + self.shift.T[:, None] - offset
        normal1, normal2 = _cross(baseline, ray2), _cross(ray1, baseline)
        error = (ray1 * normal1).sum(0)
        # Derivatives of the error by the pixels.
        back = np.stack([(self.turn[:, :, c].T[:, None] * normal2).sum(0) for c in range(3)])
        squares = np.zeros(error.shape)
        for normal in (normal1, back):
            for axis, focal in enumerate((fx, fy)):
                squares += ((r[:, :, axis].T[:, :, None] * normal).sum(0) / focal) ** 2
        across = _cross(ray1, ray2)
        ahead = ((normal1 * across).sum(0) > 0) & ((normal2 * across).sum(0) < 0)
        return error / np.sqrt(np.maximum(squares, 1e-24)), ahead

    def cost(self, hypotheses: _Hypotheses, noise_px: float) -> Float[ndarray, " s"]:
        """Cauchy's loss, a fine for points behind a camera, and the priors."""
        residual, ahead = self.residuals(hypotheses)
        loss = np.log1p((residual / noise_px) ** 2) + ~ahead
        return loss @ self.weight + 0.5 * (self.prior * self.deviation(hypotheses) ** 2).sum(1)

    def deviation(self, hypotheses: _Hypotheses) -> Float[ndarray, "s 7"]:
        """From the means of the priors."""
        focal = hypotheses.log_focal - np.log(FOCAL_PRIOR[0] * self.matches.size[0])
        return np.concatenate([np.zeros((len(focal), 3)), hypotheses.offset, focal[:, None]], 1)

    def agreeing(self, hypotheses: _Hypotheses, within_px: float) -> Float[ndarray, " s"]:
        """Share of the matches, by weight."""
        residual, ahead = self.residuals(hypotheses)
        return ((np.abs(residual) < within_px) & ahead) @ self.weight / self.weight.sum()


def _cross(a: Float[ndarray, "3 s k"], b: Float[ndarray, "3 s k"]) -> Float[ndarray, "3 s k"]:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _refined(problem: _Problem, hypotheses: _Hypotheses, noise_px: float, steps: int = 12) -> _Hypotheses:
    """Levenberg and Marquardt, reweighted, all hypotheses side by side."""
    delta = 1e-6 * np.eye(7)
    damping = np.full(len(hypotheses.log_focal), 0.1)
    cost = problem.cost(hypotheses, noise_px)
    for _ in range(steps):
        residual, _ = problem.residuals(hypotheses)
        ahead_of = [problem.residuals(hypotheses.moved(np.tile(d, (len(cost), 1))))[0] for d in delta]
        jacobian = np.stack([(other - residual) / 1e-6 for other in ahead_of], -1)
        weight = 2 * problem.weight / (noise_px**2 + residual**2)
        normal = np.einsum("ski,sk,skj->sij", jacobian, weight, jacobian, optimize=True)
        normal = normal + np.diag(problem.prior)
        gradient = np.einsum("ski,sk->si", jacobian, weight * residual)
        gradient = gradient + problem.prior * problem.deviation(hypotheses)
        damped = normal * (1 + damping[:, None, None] * np.eye(7)) + 1e-9 * np.eye(7)
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
        step *= np.minimum(1.0, 0.4 / np.maximum(np.linalg.norm(step[:, :3], axis=1), 1e-9))[:, None]
        other = hypotheses.moved(step)
        moved = problem.cost(other, noise_px)
        better = moved < cost
        hypotheses, cost = hypotheses.where(better, other), np.where(better, moved, cost)
        damping = np.clip(np.where(better, damping / 3, damping * 4), 1e-6, 1e6)
    return hypotheses
