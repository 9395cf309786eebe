"""Field types of the JSON files: arrays as lists, covariances, rigid transforms, and numbers in the file's units."""

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

from jcr.number_format import HUGE


class Part(BaseModel):
    """Base class of a JSON file's content: unknown keys and numbers that are not finite are errors."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        defer_build=True,
        from_attributes=True,
        protected_namespaces=(),
    )

    def __eq__(self, other: object) -> bool:
        """Test whether two records have the same type and JSON; comparing arrays would give no single truth value."""
        return (
            isinstance(other, Part) and type(self) is type(other) and self.model_dump() == other.model_dump()
        )


def _listed(array: Any) -> Any:
    """Return an array as nested lists, and any other value unchanged."""
    return array.tolist() if isinstance(array, ndarray) else array


def _rigid(rows: list[list[float]]) -> Float[ndarray, "4 4"]:
    """Return a rigid transform from nested lists; raise InputError if it is not rigid."""
    from jcr.geometry import require_rigid  # SciPy, which help need not wait for

    matrix = np.array(rows)
    require_rigid(matrix, "the matrix")
    return matrix


LEAST_EIGENVALUE = 1e-14
"""Smallest eigenvalue of a valid correlation matrix; a smaller one means linearly dependent errors or lost digits."""
LOST_DIGITS = 1e-3
"""Largest rounding error of a part's correlation matrix: its eigenvalues may be that far below 0."""
ROUNDING_STD = 1e-15
"""Smallest standard deviation by which a part's covariance is normalized; smaller ones are rounding errors."""


def _covariance(rows: list[list[float]], *, least: float = -LOST_DIGITS) -> Float[ndarray, "n n"]:
    """Return a covariance matrix from nested lists.

    Raises ValueError if it is not symmetric, or if an eigenvalue of its correlation matrix is below `least`.
    """
    matrix = np.array(rows)
    std = np.sqrt(np.maximum(np.diag(matrix), ROUNDING_STD**2))
    correlation = matrix / np.outer(std, std)
    if not (eigenvalue := np.linalg.eigvalsh(correlation)[0]) >= least:
        what = "no variance" if eigenvalue > -LOST_DIGITS else "a negative variance"
        raise ValueError(f"no covariance: some combination of errors has {what}")
    if (np.abs(correlation - correlation.T) > LOST_DIGITS).any():
        raise ValueError("no covariance: not symmetric")
    return matrix


def in_json(kind: Any) -> GetPydanticSchema:
    """Return the pydantic annotation of a field that is validated and written as the type `kind`, its form in JSON."""
    return GetPydanticSchema(lambda _source, handler: handler.generate_schema(kind))


def rounded(value: float) -> float:
    """Return a number rounded to 15 significant digits, so that a conversion to another unit and back preserves it."""
    return float(f"{value:.15g}")


def in_unit(per_unit: float) -> GetPydanticSchema:
    """Return the pydantic annotation of a number in metres or radians that JSON states in another unit.

    `per_unit` is the value in the unit of JSON of 1 m or 1 rad, such as 1000 for mm.
    """
    in_file = PlainSerializer(lambda value: rounded(value * per_unit), return_type=float)
    return in_json(Annotated[float, AfterValidator(lambda value: value / per_unit), in_file])


def _arrays(*counts: int | None, made: Any = np.array) -> GetPydanticSchema:
    """Return the pydantic annotation of arrays that JSON has as nested lists; `made` converts the lists to an array.

    `counts` is the shape of the arrays, with None for an axis of any length.
    """
    lists: Any = float
    for count in reversed(counts):
        lists = Annotated[list[lists], Field(min_length=count, max_length=count)]
    return in_json(
        Annotated[lists, AfterValidator(made), BeforeValidator(_listed), PlainSerializer(_listed, lists)]
    )


Positive = Annotated[float, Field(gt=0, lt=HUGE)]
Spread = Annotated[float, Field(ge=0)]
"""Standard deviation or size: a number that is not negative."""
Spread3 = Annotated[list[Spread], Field(min_length=3, max_length=3), BeforeValidator(_listed)]
Numbers = Annotated[Float[ndarray, " _"], _arrays(None)]
Numbers3 = Annotated[Float[ndarray, "3"], _arrays(3)]
Square = Annotated[Float[ndarray, "_ _"], _arrays(None, None)]
Matrix = Annotated[Float[ndarray, "4 4"], _arrays(4, 4, made=_rigid)]
"""Rigid transform, a 4x4 matrix."""
_whole = partial(_covariance, least=LEAST_EIGENVALUE)
Covariance6 = Annotated[Float[ndarray, "6 6"], _arrays(6, 6, made=_whole)]
Covariance7 = Annotated[Float[ndarray, "7 7"], _arrays(7, 7, made=_whole)]
"""Positive definite covariance of all estimated quantities."""
PartCovariance7 = Annotated[Float[ndarray, "7 7"], _arrays(7, 7, made=_covariance)]
"""Positive semidefinite covariance due to one cause of error, which may be 0."""
