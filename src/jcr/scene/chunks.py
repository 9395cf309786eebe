"""Evaluation of many points in pieces that fit a processor's cache, on all cores."""

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor

CHUNK = {"cpu": 1 << 15, "cuda": 1 << 22}


def in_chunks(ask: Callable[..., tuple[Tensor, ...]], *columns: Tensor) -> tuple[Tensor, ...]:
    """Return what `ask` returns for the rows of `columns`, called piece by piece and joined.

    Gradients are kept where a column wants them. Without them, each core takes pieces of its own.
    """
    wanted = any(column.requires_grad for column in columns)

    def answer(piece: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        with torch.inference_mode(not wanted):
            return ask(*piece)

    device = columns[0].device.type
    pieces = list(zip(*(column.split(CHUNK[device]) for column in columns), strict=True))
    if wanted or len(pieces) == 1 or device != "cpu":
        answers = [answer(piece) for piece in pieces]
    else:
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            answers = list(pool.map(answer, pieces))
    with torch.inference_mode(not wanted):
        return tuple(torch.cat(column) for column in itertools.zip_longest(*answers))
