"""Taking a capture: each request for an image is judged, answered, and kept before the next is heard."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import tyro

from jcr.capture.images import brightness_and_sharpness, read_image
from jcr.live.arm_words import ArmWords
from jcr.live.asks import Answer, Ask
from jcr.live.camera import Camera, Frame
from jcr.live.coverage import as_answer, coverage, in_words
from jcr.live.folder import LiveFolder
from jcr.live.look import Picture, grid, picture
from jcr.live.page import ENOUGH, Window, write_page
from jcr.live.rest import REST, farther

SAME_PLACE = (0.005, np.radians(1.0))
"""m, rad: a second image from within this adds nothing."""


@dataclass(frozen=True)
class CollectOptions:
    """How images are taken."""

    images: int = 12
    """Stop with this many images."""
    patience: float = 5.0
    """Seconds to wait for an image at rest."""
    reach: Annotated[
        tuple[float, float, float, float, float, float] | None,
        tyro.conf.arg(metavar="XMIN YMIN ZMIN XMAX YMAX ZMAX"),
    ] = None
    """Box that contains all proposed gripper positions (m, base frame)."""
    wanted: Annotated[tuple[float, float], tyro.conf.arg(metavar="MM DEG")] = ENOUGH
    """Target accuracy for the live page: 95 % of errors of a point seen at the distance of the scene."""


def collect(
    live: LiveFolder,
    camera: Camera,
    asks: Iterator[Ask],
    options: CollectOptions,
    tell: Callable[[Answer, list[str]], None],
    words: ArmWords | None = None,
) -> None:
    """Take images into the folder until there are enough, or nobody asks any more, or the video ends.

    `tell` hears each answer, with the lines a person reads, where the next pose is in the arm's own `words`.
    live.html in the folder shows how it goes.
    """
    reach = None if options.reach is None else np.array(options.reach).reshape(2, 3)
    kept = [_as_kept(live, name) for name in live.names]
    found = coverage(live, reach, words)
    write_page(live, found, f"{len(live.names)} images of {options.images}", options.wanted)
    frames = iter(camera.frames)
    with Window(live, camera.latest):
        for ask in asks if len(live.names) < options.images else ():
            try:
                taken = _taken(live, frames, kept, ask, options.patience)
            except StopIteration:
                tell({"accepted": False, "reason": "the video has ended"}, ["the video has ended"])
                ask.answer({"accepted": False, "reason": "the video has ended", "done": True})
                return
            if isinstance(taken, str):
                answer: Answer = {"accepted": False, "reason": taken}
                lines, headline = [f"refused: {taken}"], f"Refused: {taken}"
            else:
                name = live.add(taken.image, ask.base_from_gripper, ask.joints, taken.depth_mm)
                kept.append(taken)
                found = coverage(live, reach, words, found)
                answer = {"accepted": True, "image": name, "done": len(live.names) >= options.images}
                answer |= as_answer(found)
                headline = f"{len(live.names)} images of {options.images}"
                lines = [f"kept {name}", *in_words(found)]
            write_page(live, found, headline, options.wanted)
            ask.answer(answer)
            tell(answer, lines)
            if len(live.names) >= options.images:
                return


def _taken(
    live: LiveFolder, frames: Iterator[Frame], kept: list[Picture], ask: Ask, patience_s: float
) -> Picture | str:
    for name, pose in zip(live.names, live.poses, strict=True):
        if not farther(pose, ask.base_from_gripper, SAME_PLACE):
            return f"the gripper is where {name} was taken; move to another pose"
    taken = picture(frames, kept, patience_s)
    if ask.current is not None and farther(ask.base_from_gripper, ask.current(), REST):
        return "the arm moved while the image was taken; let it rest"
    return taken


def _as_kept(live: LiveFolder, name: str) -> Picture:
    image = read_image(live.folder / name)
    return Picture(image, grid(image), brightness_and_sharpness(image)[1])
