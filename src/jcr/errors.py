"""The two things that can be wrong and are no bug: the user's input, and an answer not to be trusted."""


class InputError(ValueError):
    """The user's input cannot be used; the message says what, where and how to mend it (exit status 2)."""


class NotTrustedError(RuntimeError):
    """No trustworthy answer exists for sound input; the message gives the reason and the cure (exit 3)."""
