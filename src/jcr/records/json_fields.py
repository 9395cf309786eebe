"""Fields of the JSON files that jcr writes: arrays as lists, covariances, transforms and numbers in other units."""

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
NOTHING = 1e-27
"""Standard deviation below which an error of a part is rounding."""
LOST_DIGITS = 1e-3
"""By which an eigenvalue of a part may be below 0: of motions that show little, the last digits are not exact."""


def _part(rows: list[list[float]]) -> Float[ndarray, "n n"]:
    matrix = np.array(rows)
    std = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    std[std < NOTHING] = 0.0
    largest = np.outer(std, std)  # Cauchy-Schwarz
    if (np.diag(matrix) < 0).any() or not (np.abs(matrix) <= (1 + LOST_DIGITS) * largest + 1e-30).all():
        raise ValueError("no covariance: two errors vary together more than each by itself")
    if not (np.abs(matrix - matrix.T) <= LOST_DIGITS * largest + 1e-30).all():
        raise ValueError("no covariance: not symmetric")
    if _least_eigenvalue(matrix, std) < -LOST_DIGITS:
        raise ValueError("no covariance: some combination of errors has a negative variance")
    return matrix


def _whole(rows: list[list[float]]) -> Float[ndarray, "n n"]:
    matrix = _part(rows)
    std = np.sqrt(np.diag(matrix))
    if not std.all() or _least_eigenvalue(matrix, std) < LEAST_EIGENVALUE:
        raise ValueError("no covariance: some error, or a combination of errors, has no variance")
    return matrix


def _least_eigenvalue(matrix: Float[ndarray, "n n"], std: Float[ndarray, " n"]) -> float:
    unit = np.where(std > 0, std, 1.0)
    return float(np.linalg.eigvalsh(matrix / np.outer(unit, unit))[0])


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


def _arrays(kind: Any, made: Any = np.array, count: int | None = None) -> GetPydanticSchema:
    """Return the annotation of arrays that JSON has as lists: of `count` times `kind`, made an array by `made`."""
    lists: Any = Annotated[list[kind], Field(min_length=count, max_length=count)]
    return in_json(
        Annotated[lists, AfterValidator(made), BeforeValidator(_listed), PlainSerializer(_listed, lists)]
    )


HUGE = 1e15
"""Largest number of a file."""
Positive = Annotated[float, Field(gt=0, lt=HUGE)]
Spread = Annotated[float, Field(ge=0)]
"""Standard deviation, or a size."""
Spread3 = Annotated[list[Spread], Field(min_length=3, max_length=3), BeforeValidator(_listed)]
Numbers = Annotated[Float[ndarray, " _"], _arrays(float)]
Numbers3 = Annotated[Float[ndarray, "3"], _arrays(float, count=3)]
Numbers7 = Annotated[Float[ndarray, "7"], _arrays(float, count=7)]
Square = Annotated[Float[ndarray, "_ _"], _arrays(list[float])]
_Row4, _Row6, _Row7 = (
    Annotated[list[float], Field(min_length=count, max_length=count)] for count in (4, 6, 7)
)
Matrix = Annotated[Float[ndarray, "4 4"], _arrays(_Row4, _rigid, 4)]
"""Rigid transform."""
Covariance6 = Annotated[Float[ndarray, "6 6"], _arrays(_Row6, _whole, 6)]
Covariance7 = Annotated[Float[ndarray, "7 7"], _arrays(_Row7, _whole, 7)]
"""Covariance of everything that was estimated: positive definite."""
PartCovariance7 = Annotated[Float[ndarray, "7 7"], _arrays(_Row7, _part, 7)]
"""Part of a covariance that one cause adds, which may be nothing."""
