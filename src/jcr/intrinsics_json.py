"""Intrinsics as the JSON that jcr writes holds them."""

from typing import Annotated, Any

from jaxtyping import Float
from numpy import ndarray
from pydantic import Field, model_validator

from jcr.arrays_json import Part, Spreads
from jcr.geometry import HUGE
from jcr.records import COEFFICIENTS, DistortionModel, Intrinsics, coefficients_of

LARGEST = 100_000
"""Pixels across; no camera's image is wider."""
Pixels = Annotated[int, Field(ge=1, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, lt=HUGE)]


class IntrinsicsJson(Part):
    """Every number of an Intrinsics, in range."""

    fx: Positive
    fy: Positive
    cx: float
    cy: float
    distortion: Annotated[list[float], Field(min_length=4, max_length=12)]
    width: Pixels
    height: Pixels
    model: DistortionModel = "pinhole"

    @model_validator(mode="after")
    def _as_many_as_the_model_has(self) -> "IntrinsicsJson":
        names = COEFFICIENTS[self.model]
        if len(self.distortion) != len(names):
            raise ValueError(f"{len(self.distortion)} coefficients, but a {self.model} model has {names}")
        return self

    def record(self) -> Intrinsics:
        """Without what a file says beside it."""
        given: dict[str, Any] = {name: getattr(self, name) for name in IntrinsicsJson.model_fields}
        given["distortion"] = coefficients_of(self.distortion)
        return Intrinsics(**given)


class IntrinsicsAndStd(IntrinsicsJson):
    """Intrinsics with their standard deviations."""

    std: Spreads | None = None
    """Standard deviations of fx, fy, cx, cy and the distortion; null where the intrinsics were not refined."""

    @model_validator(mode="after")
    def _one_of_each(self) -> "IntrinsicsAndStd":
        if self.std is not None and len(self.std) != 4 + len(self.distortion):
            raise ValueError(
                f"{len(self.std)} standard deviations, but a {self.model} model has "
                f"{4 + len(self.distortion)} parameters"
            )
        return self

    @classmethod
    def of(
        cls, intrinsics: Intrinsics | None, std: Float[ndarray, " q"] | None = None
    ) -> "IntrinsicsAndStd | None":
        """Return the intrinsics of a record; None where there are none."""
        if intrinsics is None:
            return None
        return cls.model_validate(vars(intrinsics) | {"std": std})
