"""Intrinsics as the JSON that jcr writes holds them."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

from jcr.geometry import HUGE
from jcr.records import COEFFICIENTS, Intrinsics, LensModel, coefficients_of

LARGEST = 100_000
"""Pixels across; no camera's image is wider."""
Pixels = Annotated[int, Field(ge=1, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, lt=HUGE)]


class IntrinsicsJson(BaseModel):
    """Every number of an Intrinsics, in range."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    distortion: Annotated[list[float], Field(min_length=4, max_length=8)]
    width: Pixels
    height: Pixels
    model: LensModel = "pinhole"

    @model_validator(mode="after")
    def _as_many_as_the_model_has(self) -> "IntrinsicsJson":
        names = COEFFICIENTS[self.model]
        if len(self.distortion) != len(names):
            raise ValueError(f"{len(self.distortion)} coefficients, but a {self.model} model has {names}")
        return self

    def record(self) -> Intrinsics:
        """Without what a file says beside it."""
        return Intrinsics(
            self.fx,
            self.fy,
            self.cx,
            self.cy,
            self.width,
            self.height,
            coefficients_of(self.distortion),
            self.model,
        )
