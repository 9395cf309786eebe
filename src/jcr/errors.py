"""Exceptions for invalid input and rejected results, and functions that format parts of their messages."""

from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from reprlib import Repr
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError

LONGEST_SHOWN = 80
"""Largest number of characters of a value that a message quotes in full."""
NAMED, LONGEST_NAME = 10, 255
"""Largest number of names that a message lists, and of characters of each; the other names are counted."""


def printable(text: str) -> str:
    """Return the text with unprintable characters, except line ends, replaced by Python's escape sequences."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return "; did you mean …?" with the known word most similar to `word`; empty if none is similar.

    Words are similar if their ratio of matching characters is 0.6 or more (difflib.get_close_matches), or if one is the
    other with an underscore and more at its end. The dashes of options are not compared.
    """
    plain = {one.lstrip("-"): one for one in known}
    like = get_close_matches(word.lower().lstrip("-"), plain, n=1) or [
        one for one in plain if one.startswith(f"{word}_")
    ]
    return f"; did you mean {plain[like[0]]}?" if like else ""


def count_of(count: int, noun: str) -> str:
    """Return a number with its noun, such as "1 image" or "2 images"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def first_few(names: Sequence[str]) -> str:
    """Return the first ten names as text, separated by commas, and the number of the remaining ones."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(name[:LONGEST_NAME] for name in names[:NAMED]) + more


class _ShortRepr(Repr):
    """Repr of plain data without most of its parts: that of a small file can have gigabytes, or no end."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxother = 3, LONGEST_SHOWN + 1
        self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = self.maxdict = 30

    def repr_str(self, x: str | bytes, level: int) -> str:
        """Return the repr of the first part of a text."""
        return repr(x[: LONGEST_SHOWN + 1])

    repr_bytes = repr_bytearray = repr_str


def shown(value: object) -> str:
    """Return the repr of a value for a message, cut after 80 characters."""
    try:
        text = _ShortRepr().repr(value)
    except ValueError:
        return "a number of thousands of digits"
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}…"


def first_fault(error: "ValidationError") -> str:
    """Return the first fault of a validation as "place: fault"; the place is a path of keys such as frames.0.pose."""
    first = error.errors()[0]
    place = ".".join(str(part)[:LONGEST_SHOWN] for part in first["loc"])
    what = first["msg"].removeprefix("Value error, ")
    if first["type"] == "missing":
        name = str(first["loc"][-1])
        like = get_close_matches(name, map(str, first["input"]), n=1)
        what = "is missing" + "".join(f", but there is {shown(key)}" for key in like)
    elif isinstance(first["input"], str | int | float) and first["type"] != "value_error":
        what = f"{shown(first['input'])}: {what}"
    return f"{place}: {what}" if place else what


class InputError(ValueError):
    """Error for invalid input (exit status 2); the message states the fault, its place, and the remedy.

    Messages of functions with an argument `where`, which is the place in words, begin with it.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


def other_size(
    what: str,
    size: Sequence[object],
    expected: tuple[int, int],
    whose: str = "images",
    remedy: str = "take all with one camera at one resolution",
) -> InputError:
    """Return the error that `what` has another resolution than `whose`: `size` instead of `expected`.

    Both are width and height (px). `remedy` is the end of the message. The error is not raised.
    """
    return InputError(
        f"{what} of {shown(size[0])}x{shown(size[1])} pixels, {whose} of {expected[0]}x{expected[1]}; {remedy}"
    )


class RejectedError(RuntimeError):
    """Error for a rejected result of valid input (exit status 3).

    It holds the reason `what`, `remedies`, and additional sentences `also`. `despite_texture` states that the images
    have enough features, so that a lack of texture is not the reason.
    """

    def __init__(
        self, what: str, *remedies: str, also: Sequence[str] = (), despite_texture: bool = False
    ) -> None:
        super().__init__("; ".join((what, *remedies, *also)))
        self.what, self.remedies, self.also = what, remedies, tuple(also)
        self.despite_texture = despite_texture

    def with_more(self, *also: str) -> "RejectedError":
        """Return a copy of the error with the sentences of the argument `also` appended to those of its attribute."""
        return RejectedError(
            self.what, *self.remedies, also=(*self.also, *also), despite_texture=self.despite_texture
        )
