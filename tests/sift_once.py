"""SIFT features and matches of the same images are found once in a process: dozens of tests take the bundled capture."""

import hashlib
import threading
from collections.abc import Callable

import numpy as np

from jcr.features import sift

MOST = {"detect": 64, "matches": 4000}
"""Answers that are kept, the newest; features of an image are up to 4 MB."""

Arrays = tuple[np.ndarray, ...]


def once(function: Callable[..., Arrays], most: int) -> Callable[..., Arrays]:
    """Return the function with its results kept, so that it computes nothing twice."""
    known: dict[object, Arrays] = {}
    lock = threading.Lock()

    def recalled(*arrays: np.ndarray) -> Arrays:
        key = tuple((array.shape, hashlib.sha1(array.tobytes()).digest()) for array in arrays)
        with lock:
            answer = known.get(key)
        if answer is None:
            answer = function(*arrays)
            with lock:
                if len(known) == most:
                    del known[next(iter(known))]
                known[key] = answer
        return tuple(part.copy() for part in answer)

    return recalled


def find_sift_once() -> None:
    """From now on in this process; what imported the functions by name before goes on without."""
    for name, most in MOST.items():
        setattr(sift, name, once(getattr(sift, name), most))
