"""Errors that are no bug, input that cannot be used and a rejected result, and the parts of their messages."""

from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError

LONGEST_SHOWN = 80
"""Characters of the longest value that a message quotes."""


def printable(text: str) -> str:
    """Return the text without control characters of a terminal: names in files may hold any character."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return a question for the known word that is like this one; empty where none is."""
    like = get_close_matches(word.lower(), known, n=1)
    return f"; did you mean {like[0]}?" if like else ""


def shown(value: object) -> str:
    """Return a value of a file as a message quotes it: a long one is cut."""
    text = repr(value)
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}… ({len(text)} characters)"


def first_fault(error: "ValidationError") -> str:
    """Return the first fault that a schema finds, with its place."""
    first = error.errors()[0]
    place = ".".join(str(part)[:LONGEST_SHOWN] for part in first["loc"])
    what = "is missing" if first["type"] == "missing" else first["msg"].removeprefix("Value error, ")
    return f"{place}: {what}" if place else what


class InputError(ValueError):
    """Input that cannot be used; the message says what, where and how to fix it (exit status 2)."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class RejectedError(RuntimeError):
    """Rejection of the result of sound input: reason, remedies, and further sentences (exit status 3).

    `despite_texture`: the images show features enough, so that their lack is not the reason.
    """

    def __init__(
        self, what: str, *remedies: str, also: Sequence[str] = (), despite_texture: bool = False
    ) -> None:
        super().__init__("; ".join((what, *remedies, *also)))
        self.what, self.remedies, self.also = what, remedies, tuple(also)
        self.despite_texture = despite_texture

    def with_more(self, *also: str) -> "RejectedError":
        """Return the error with further sentences."""
        return RejectedError(
            self.what, *self.remedies, also=(*self.also, *also), despite_texture=self.despite_texture
        )
