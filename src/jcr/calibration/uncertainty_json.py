"""The uncertainty of a calibration as calibration.json has it: in mm and degrees, with covariance and budget."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import AfterValidator, model_validator

from jcr.arrays_json import Covariance7, Part, PartCovariance7, Spread, Spread3, Square
from jcr.calibration.seen import joint_covariance
from jcr.camera import parameter_names
from jcr.findings.sentences import worst_direction
from jcr.records import COVARIANCE_ORDER, Budget, Estimate, InUse, Seen


def mm_and_deg(metres: float, radians: float) -> dict[str, float]:
    """A translation and a rotation in the units of the file."""
    return {"translation_mm": 1e3 * float(metres), "rotation_deg": float(np.degrees(radians))}


def _order(names: list[str]) -> list[str]:
    if tuple(names) != COVARIANCE_ORDER:
        raise ValueError(f"not {', '.join(COVARIANCE_ORDER)}")
    return names


class Share(Part):
    """One sigma per axis, root mean square over the axes: squares of shares add up to that of the whole."""

    translation_mm: Spread
    rotation_deg: Spread
    covariance: PartCovariance7 | None = None
    """In the order of `uncertainty`; the parts' sum is the whole."""

    @classmethod
    def of(cls, covariance: Float[ndarray, "7 7"]) -> "Share":
        """What a part of the covariance amounts to."""
        metres, radians = np.sqrt(np.diag(covariance)[:6].reshape(2, 3).mean(1))
        return cls(**mm_and_deg(metres, radians), covariance=covariance.tolist())


class UncertaintyBudget(Part):
    """What the uncertainty of the camera on the gripper comes from."""

    robot_random: Share
    robot_systematic: Share
    intrinsics: Share
    images: Share
    faults: Share | None = None
    """Share of the findings."""

    @classmethod
    def of(cls, budget: Budget | None) -> "UncertaintyBudget | None":
        """The same parts as shares."""
        if budget is None:
            return None
        return cls(**{name: Share.of(part) for name, part in vars(budget).items()})

    @property
    def mostly_systematic(self) -> bool:
        """Whether the robot's systematic errors are most of it."""
        others = (self.robot_random, self.intrinsics, self.images, self.faults)
        squares = sum(share.translation_mm**2 for share in others if share is not None)
        return self.robot_systematic.translation_mm**2 >= squares


def _sizes(found: Seen) -> Seen:
    if min(size for size in vars(found).values() if isinstance(size, float)) < 0:
        raise ValueError("a size below 0")
    return found


SeenJson = Annotated[Seen, AfterValidator(_sizes)]


@dataclass(frozen=True, kw_only=True)
class SeenAndCorners(Seen):
    """At the centre of the image, and at its worst corner."""

    corners: SeenJson


class Joint(Part):
    """Covariance of X, scale and intrinsics together, from which the place of any seen point follows."""

    covariance: Square
    order: list[str]
    """Names of the rows: those of `uncertainty`, then fx, fy, cx, cy and the distortion."""

    @model_validator(mode="after")
    def _is_square(self) -> "Joint":
        if {len(self.order)} != {len(self.covariance), *(len(row) for row in self.covariance)}:
            raise ValueError(f"a covariance that is not {len(self.order)} x {len(self.order)}")
        return self

    @classmethod
    def of(cls, estimate: Estimate) -> "Joint | None":
        """That of an estimate; None where its intrinsics were not estimated."""
        if estimate.intrinsics is None or estimate.intrinsics_cross is None:
            return None
        order = [*COVARIANCE_ORDER, *parameter_names(estimate.intrinsics)]
        return cls.model_validate({"covariance": joint_covariance(estimate), "order": order})


class Uncertainty(Part):
    """One-sigma uncertainty; axes of the gripper frame."""

    translation_std_mm: Spread3
    rotation_std_deg: Spread3
    scale_std_percent: Spread
    covariance: Covariance7
    order: Annotated[list[str], AfterValidator(_order)]
    worst: str
    """The least certain direction of the translation in words, and its size."""
    budget: UncertaintyBudget | None = None
    seen: Annotated[SeenAndCorners, AfterValidator(_sizes)] | None = None
    """Point uncertainty at the working distance."""
    scene_95_mm: Spread | None = None
    """95 % of the errors of points of the reconstruction in the base frame are smaller, at the median point."""
    joint: Joint | None = None
    """Null where the intrinsics were not estimated."""

    @property
    def corner(self) -> Seen | None:
        """Point uncertainty in the worst corner of the image; None where the intrinsics were not estimated."""
        return None if self.seen is None or self.joint is None else self.seen.corners

    @classmethod
    def of(cls, estimate: Estimate, in_use: InUse | None) -> "Uncertainty":
        """That of an estimate, and how exact it is in use."""
        std = np.sqrt(np.diag(estimate.covariance))
        return cls(
            translation_std_mm=(1e3 * std[:3]).tolist(),
            rotation_std_deg=np.degrees(std[3:6]).tolist(),
            scale_std_percent=float(100 * std[6]),
            covariance=estimate.covariance.tolist(),
            order=list(COVARIANCE_ORDER),
            worst=worst_direction(estimate.gripper_from_camera, estimate.covariance),
            budget=UncertaintyBudget.of(estimate.budget),
            seen=None if in_use is None else SeenAndCorners(**vars(in_use.seen), corners=in_use.corners),
            scene_95_mm=None if in_use is None or in_use.scene is None else 1e3 * in_use.scene.within_95_m,
            joint=Joint.of(estimate),
        )
