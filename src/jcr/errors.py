"""The two things that can be wrong and are no bug: the user's input, and a rejected answer."""

from collections.abc import Iterable, Sequence
from difflib import get_close_matches


def printable(text: str) -> str:
    """Return the text without control characters of a terminal: names in files may hold any character."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """ "; did you mean …?" where one of the known words is like it; else nothing."""
    like = get_close_matches(word.lower(), known, n=1)
    return f"; did you mean {like[0]}?" if like else ""


class InputError(ValueError):
    """The user's input cannot be used; the message says what, where and how to fix it (exit status 2)."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class RejectedError(RuntimeError):
    """The input is sound but the result is rejected: the reason, what would help, and what else is worth saying (exit
    status 3). `despite_texture`: the images show features enough, so that their lack is not the reason."""

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
