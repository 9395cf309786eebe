"""Validation of options that are given in Python."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from types import NoneType
from typing import TypeVar, get_args, get_type_hints

from jcr.errors import InputError, did_you_mean

Options = TypeVar("Options")


def checked_options(options: object, kind: type[Options], where: str = "", none: str = "") -> Options:
    """Return validated options of the class `kind`, from an object of it, a dict of its fields, or None (defaults).

    In messages, `where` is the place of the options, and `none` states what None does there. Text is converted to paths,
    and lists to tuples. Raises InputError that names the field for invalid values.
    """
    if options is None:
        return kind()
    if not isinstance(options, kind | Mapping):
        raise InputError(f"{where}{options!r:.80}: give jcr.{kind.__name__}(...) or a dict{none}")
    known = {field.name for field in fields(kind)}  # pyright: ignore[reportArgumentType]
    content, hints = dict(options if isinstance(options, Mapping) else vars(options)), get_type_hints(kind)
    for name, value in content.items():
        if name not in known:
            raise InputError(
                f"{kind.__name__}: no option {name!r}{did_you_mean(str(name), known)}; it has {', '.join(sorted(known))}"
            )
        record = next(filter(is_dataclass, (hints[name], *get_args(hints[name]))), None)
        if isinstance(record, type) and value is not None:
            without = f", or None for no {name}" if NoneType in get_args(hints[name]) else ""
            content[name] = checked_options(value, record, f"{kind.__name__}: {name}: ", without)
    from pydantic import TypeAdapter, ValidationError  # takes 0.5 s, which the help avoids

    try:
        return TypeAdapter(kind).validate_python(content)
    except ValidationError as error:
        first = error.errors()[0]
        # The command line's help has the form of a tuple, such as "MM DEG|none"; pydantic's message does not.
        described = get_type_hints(kind, include_extras=True).get(str(first["loc"][0]))
        form = next(
            (one for m in get_args(described)[1:] if " " in (one := getattr(m, "metavar", None) or "")), ""
        )
        if form:
            written = " or ".join(
                f"({part.replace(' ', ', ')})" if " " in part else repr(part) for part in form.split("|")
            )
            raise InputError(
                f"{kind.__name__}: {first['loc'][0]}: give {written}, not {content[str(first['loc'][0])]!r:.80}"
            ) from None
        # pydantic puts the type of a union's member into the place.
        place = ".".join(str(part) for part in first["loc"] if "[" not in str(part))
        allowed = str(first.get("ctx", {}).get("expected", "")).replace("'", "").replace(" or ", ", ")
        like = did_you_mean(str(first["input"]), allowed.split(", ")) if allowed else ""
        raise InputError(f"{kind.__name__}: {place}: {first['input']!r:.80}: {first['msg']}{like}") from None
