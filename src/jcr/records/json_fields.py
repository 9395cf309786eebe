"""Fields of the JSON files that jcr writes: arrays as lists, covariances, transforms and intrinsics, all checked."""

from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    model_validator,
)

from jcr.geometry import HUGE, require_rigid
from jcr.records.capture import COEFFICIENTS, DistortionModel, Intrinsics, coefficients_of


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


Spread = Annotated[float, Field(ge=0)]
"""Standard deviation, or a size."""
Listed = BeforeValidator(_listed)
"""Validator that takes an array for the lists that stand for it in JSON."""
AsArray = AfterValidator(np.array)
AsLists = PlainSerializer(_listed, return_type=list)
Spreads = Annotated[list[Spread], Listed]
Spread3 = Annotated[list[Spread], Field(min_length=3, max_length=3), Listed]
Numbers4 = Annotated[list[float], Field(min_length=4, max_length=4)]
Numbers6 = Annotated[list[float], Field(min_length=6, max_length=6)]
_Numbers7 = Annotated[list[float], Field(min_length=7, max_length=7)]
if TYPE_CHECKING:
    Numbers3 = Numbers7 = Numbers = Square = Matrix = Covariance6 = Covariance7 = PartCovariance7 = ndarray
else:
    Numbers = Annotated[list[float], AsArray, Listed, AsLists]
    Numbers3 = Annotated[list[float], Field(min_length=3, max_length=3), AsArray, Listed, AsLists]
    Numbers7 = Annotated[list[float], Field(min_length=7, max_length=7), AsArray, Listed, AsLists]
    Square = Annotated[list[list[float]], AsArray, Listed, AsLists]
    Matrix = Annotated[
        list[Numbers4], Field(min_length=4, max_length=4), AfterValidator(_rigid), Listed, AsLists
    ]
    """Rigid transform."""
    Covariance6 = Annotated[
        list[Numbers6], Field(min_length=6, max_length=6), AfterValidator(_whole), Listed, AsLists
    ]
    Covariance7 = Annotated[
        list[_Numbers7], Field(min_length=7, max_length=7), AfterValidator(_whole), Listed, AsLists
    ]
    """Covariance of everything that was estimated: positive definite."""
    PartCovariance7 = Annotated[
        list[_Numbers7], Field(min_length=7, max_length=7), AfterValidator(_part), Listed, AsLists
    ]
    """Part of a covariance that one cause adds, which may be nothing."""

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
