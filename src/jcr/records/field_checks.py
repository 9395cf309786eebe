"""Checks of records when they are made in Python, by the annotations that also check their files."""

from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import AbstractArray, jaxtyped
from numpy import ndarray
from pydantic import BaseModel, ConfigDict, ValidationError, create_model
from pydantic.fields import FieldInfo

from jcr.errors import InputError, count_of, first_fault


def require_fields(record: Any) -> None:
    """Raise InputError unless the fields of a dataclass fit their annotations: numbers, texts, and shapes of arrays.

    Axes of the same name have the same length in all arrays of the record. Fields with other records are not checked,
    because these were when they were made.
    """
    kind = type(record)
    plain, arrays = _checked_fields(kind)
    if plain is not None:
        try:
            plain.model_validate(
                {name: _unboxed(getattr(record, name)) for name in plain.model_fields}, strict=True
            )
        except ValidationError as error:
            raise InputError(f"{kind.__name__}: {first_fault(error)}; correct it") from None
    with jaxtyped("context"):
        for name, kinds in arrays.items():
            value = getattr(record, name)
            if not isinstance(value, kinds):
                is_array = isinstance(value, ndarray)
                found = f"{value.dtype} of shape {value.shape}" if is_array else type(value).__name__
                expected = " or ".join(getattr(one, "dim_str", "None").strip() for one in kinds)
                raise InputError(f"{kind.__name__}: {name}: {found}, not of shape ({expected}); correct it")


class Checked:
    """Base of the dataclasses whose fields are checked by their annotations when a record is made."""

    def __post_init__(self) -> None:
        require_fields(self)


def require_finite(kind: str, **arrays: ndarray | None) -> None:
    """Raise InputError, begun with the name `kind` of a record, if an array holds NaN or infinity."""
    for name, array in arrays.items():
        if array is not None and not np.isfinite(array).all():
            raise InputError(f"{kind}: {name} holds NaN or infinity; leave those rows out")


def require_counts(kind: str, count: int, **parts: Any) -> None:
    """Raise InputError, begun with the name `kind` of a record, if a part that is not None has not `count` rows."""
    for name, part in parts.items():
        if part is not None and len(part) != count:
            raise InputError(
                f"{kind}: {count_of(len(part), 'row')} of {name} for {count_of(count, 'image')}; give one each"
            )


def require_rows(kind: str, name: str, index: ndarray, end: int) -> None:
    """Raise InputError, begun with the name `kind` of a record, if an array of indices leaves 0 … end - 1."""
    if index.size and not 0 <= int(index.min()) <= int(index.max()) < end:
        raise InputError(
            f"{kind}: {name} has the row {index.max() if index.min() >= 0 else index.min()} of {end}"
        )


@cache
def _checked_fields(kind: type) -> tuple[type[BaseModel] | None, Mapping[str, tuple[type, ...]]]:
    """Return a pydantic model of the plain fields of a dataclass, and the types of its arrays by name."""
    hints = get_type_hints(kind, include_extras=True)
    plain, arrays = dict[str, Any](), dict[str, tuple[type, ...]]()
    for field in fields(kind):
        hint = hints[field.name]
        if _is_plain(hint):
            plain[field.name] = (hint, ...)
        elif all(
            one is NoneType or (isinstance(one, type) and issubclass(one, AbstractArray))
            for one in _alternatives(hint)
        ):
            arrays[field.name] = _alternatives(hint)
    config = ConfigDict(allow_inf_nan=False, protected_namespaces=())
    return create_model(kind.__name__, __config__=config, **plain) if plain else None, arrays


def _alternatives(hint: Any) -> tuple[Any, ...]:
    """Return the members of a union, without annotations; of another type, this type alone."""
    while get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _is_plain(hint: Any) -> bool:
    """Test whether a type consists of numbers, truth values, texts and None, annotated by pydantic's limits alone."""
    if get_origin(hint) is Annotated:
        kind, *notes = get_args(hint)
        return _is_plain(kind) and all(isinstance(note, FieldInfo) for note in notes)
    if get_origin(hint) in (Union, UnionType, tuple):
        return all(part is Ellipsis or _is_plain(part) for part in get_args(hint))
    return get_origin(hint) is Literal or hint in (float, int, bool, str, NoneType)


def _unboxed(value: Any) -> Any:
    """Return a value with the numbers of NumPy as those of Python."""
    if isinstance(value, tuple):
        return tuple(map(_unboxed, value))
    return value.item() if isinstance(value, np.generic) else value
