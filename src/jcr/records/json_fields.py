"""Fields of the JSON files that jcr writes: arrays as lists, covariances, transforms and numbers in other units."""

from functools import partial
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetPydanticSchema,
    PlainSerializer,
)


class Part(BaseModel):
    """A part of a file: what it names and nothing else, numbers that are finite; made of its fields, or of a record."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        defer_build=True,
        from_attributes=True,
        protected_namespaces=(),
    )

    def __eq__(self, other: object) -> bool:
        """Compare the JSON of both, for arrays have no truth value."""
        return (
            isinstance(other, Part) and type(self) is type(other) and self.model_dump() == other.model_dump()
        )


def _listed(array: Any) -> Any:
    return array.tolist() if isinstance(array, ndarray) else array


def _rigid(rows: list[list[float]]) -> Float[ndarray, "4 4"]:
    from jcr.geometry import require_rigid  # SciPy, which help need not wait for

    matrix = np.array(rows)
    require_rigid(matrix, "the matrix")
    return matrix


LEAST_EIGENVALUE = 1e-14
"""Least eigenvalue of a correlation matrix: below it the errors depend on each other, or digits were lost."""
LOST_DIGITS = 1e-3
"""By which an eigenvalue of a part may be below 0: of motions that show little, the last digits are not exact."""
EXACT = 1e-15
"""Standard deviation below which an error of a part is rounding."""


def _covariance(rows: list[list[float]], *, least: float = -LOST_DIGITS) -> Float[ndarray, "n n"]:
    """Return a covariance; raise ValueError where an eigenvalue of its correlation matrix is below `least`."""
    matrix = np.array(rows)
    std = np.sqrt(np.maximum(np.diag(matrix), EXACT**2))
    correlation = matrix / np.outer(std, std)
    if not (eigenvalue := np.linalg.eigvalsh(correlation)[0]) >= least:
        what = "no variance" if eigenvalue > -LOST_DIGITS else "a negative variance"
        raise ValueError(f"no covariance: some combination of errors has {what}")
    if (np.abs(correlation - correlation.T) > LOST_DIGITS).any():
        raise ValueError("no covariance: not symmetric")
    return matrix


def in_json(kind: Any) -> GetPydanticSchema:
    """Return the annotation of a type that JSON has as `kind`."""
    return GetPydanticSchema(lambda _source, handler: handler.generate_schema(kind))


def rounded(value: float) -> float:
    """Return a number with the 15 digits that survive a change of the unit and back."""
    return float(f"{value:.15g}")


def in_unit(per_unit: float) -> GetPydanticSchema:
    """Return the annotation of a number in metres or radians that JSON has in another unit, `per_unit` in each."""

    def from_unit(value: float) -> float:
        return value / per_unit

    def to_unit(value: float) -> float:
        return rounded(value * per_unit)

    return in_json(Annotated[float, AfterValidator(from_unit), PlainSerializer(to_unit, return_type=float)])


def _arrays(*counts: int | None, made: Any = np.array) -> GetPydanticSchema:
    """Return the annotation of arrays of this shape that JSON has as lists, made arrays by `made`; None: any length."""
    lists: Any = float
    for count in reversed(counts):
        lists = Annotated[list[lists], Field(min_length=count, max_length=count)]
    return in_json(
        Annotated[lists, AfterValidator(made), BeforeValidator(_listed), PlainSerializer(_listed, lists)]
    )


HUGE = 1e15
"""Largest number of a file."""
Positive = Annotated[float, Field(gt=0, lt=HUGE)]
Spread = Annotated[float, Field(ge=0)]
"""Standard deviation, or a size."""
Spread3 = Annotated[list[Spread], Field(min_length=3, max_length=3), BeforeValidator(_listed)]
Numbers = Annotated[Float[ndarray, " _"], _arrays(None)]
Numbers3 = Annotated[Float[ndarray, "3"], _arrays(3)]
Numbers7 = Annotated[Float[ndarray, "7"], _arrays(7)]
Square = Annotated[Float[ndarray, "_ _"], _arrays(None, None)]
Matrix = Annotated[Float[ndarray, "4 4"], _arrays(4, 4, made=_rigid)]
"""Rigid transform."""
_whole = partial(_covariance, least=LEAST_EIGENVALUE)
Covariance6 = Annotated[Float[ndarray, "6 6"], _arrays(6, 6, made=_whole)]
Covariance7 = Annotated[Float[ndarray, "7 7"], _arrays(7, 7, made=_whole)]
"""Covariance of everything that was estimated: positive definite."""
PartCovariance7 = Annotated[Float[ndarray, "7 7"], _arrays(7, 7, made=_covariance)]
"""Part of a covariance that one cause adds, which may be nothing."""
