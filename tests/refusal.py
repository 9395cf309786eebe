from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from jcr.errors import InputError


@contextmanager
def refused(words: str) -> Iterator[None]:
    """Expect an InputError of one line that contains a match of these words."""
    with pytest.raises(InputError, match=words) as caught:
        yield
    message = str(caught.value)
    del caught  # its traceback holds this frame, and what the caller opened, until garbage is collected
    assert "\n" not in message, message
