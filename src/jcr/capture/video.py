"""Frames of a video file at given times, decoded one by one."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.errors import InputError
from jcr.extras import extra


def frames_at(
    file: Path, time_s: Float[ndarray, " n"], tolerance_s: float
) -> Iterator[UInt8[ndarray, "h w 3"]]:
    """RGB frames nearest to ascending times; InputError when one is farther off than the tolerance, or damaged."""
    av = extra("av", "lerobot", "a video")
    try:
        with av.open(str(file)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            container.seek(max(int((time_s[0] - tolerance_s) / stream.time_base), 0), stream=stream)
            wanted = iter(time_s.tolist())
            due = next(wanted, None)
            for frame in container.decode(stream):
                if due is None:
                    return
                if frame.time is None or frame.time < due - tolerance_s:
                    continue
                while due is not None and abs(frame.time - due) <= tolerance_s:
                    yield np.asarray(frame.to_ndarray(format="rgb24"))
                    due = next(wanted, None)
                if due is not None and frame.time > due + tolerance_s:
                    raise InputError(
                        f"{file}: no frame at {due:.3f} s, the next is at {frame.time:.3f} s; damaged"
                    )
            if due is not None:
                raise InputError(f"{file}: ends before {due:.3f} s; it is shorter than the data set says")
    except (av.FFmpegError, IndexError) as error:
        raise InputError(f"{file}: not a readable video ({error}); download it again") from None
