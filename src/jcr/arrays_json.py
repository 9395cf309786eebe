"""Arrays, and parts of files, as the JSON that jcr writes holds them."""

from typing import Annotated

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from jcr.geometry import require_rigid


class Part(BaseModel):
    """A part of a file: what it names and nothing else, numbers that are finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


def _rigid(rows: list[list[float]]) -> list[list[float]]:
    require_rigid(np.array(rows), "the matrix")
    return rows


def _covariance(rows: list[list[float]]) -> list[list[float]]:
    matrix = np.array(rows)
    std = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    largest = np.outer(std, std)  # Cauchy-Schwarz; of motions that show little, the last digits are not exact
    if (np.diag(matrix) < 0).any() or not (np.abs(matrix) <= 1.001 * largest + 1e-30).all():
        raise ValueError("no covariance: two errors vary together more than each by itself")
    if not (np.abs(matrix - matrix.T) <= 1e-3 * largest + 1e-30).all():
        raise ValueError("no covariance: not symmetric")
    return rows


Spread = Annotated[float, Field(ge=0)]
"""A standard deviation, or a size."""
Spread3 = Annotated[list[Spread], Field(min_length=3, max_length=3)]
Numbers4 = Annotated[list[float], Field(min_length=4, max_length=4)]
Numbers6 = Annotated[list[float], Field(min_length=6, max_length=6)]
Numbers7 = Annotated[list[float], Field(min_length=7, max_length=7)]
Matrix = Annotated[list[Numbers4], Field(min_length=4, max_length=4), AfterValidator(_rigid)]
"""Of a rigid transform."""
Covariance6 = Annotated[list[Numbers6], Field(min_length=6, max_length=6), AfterValidator(_covariance)]
Covariance7 = Annotated[list[Numbers7], Field(min_length=7, max_length=7), AfterValidator(_covariance)]
