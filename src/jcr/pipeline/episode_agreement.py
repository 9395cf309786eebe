"""Agreement of the wrist camera over the episodes of a data set: groups of one pose, motions, other intrinsics."""

from collections.abc import Sequence
from itertools import groupby, pairwise
from typing import NamedTuple

import numpy as np

from jcr.calibration.difference import Difference, compare
from jcr.calibration.record import Calibration, PublishedCalibration
from jcr.distributions import chi2
from jcr.pipeline.verify import ALPHA

Found = Calibration | PublishedCalibration


class Agreement(NamedTuple):
    """Cameras of the episodes of one data set, in the order of the episodes."""

    group: list[int]
    """Group of each episode: those of one group have one pose of the camera, as far as their covariances tell."""
    apart: list[Difference]
    """Difference of each episode from the most exact one of the largest group."""
    sentences: list[str]
    """The groups, each motion between two episodes, and episodes whose intrinsics differ, in words."""


def agreement(episodes: Sequence[int], found: Sequence[Found]) -> Agreement:
    """Return which of the episodes have one pose of the camera; `found` are their calibrations, in their order.

    An episode belongs to the last group from whose most exact member it differs by no more than chance explains once in
    a thousand; otherwise it begins a group.
    """
    best, group = list[int](), list[int]()
    for k, one in enumerate(found):
        fits = (
            number for number in reversed(range(len(best))) if not _differs(compare(found[best[number]], one))
        )
        number = next(fits, len(best))
        group.append(number)
        if number == len(best):
            best.append(k)
        elif _size(one) < _size(found[best[number]]):
            best[number] = k
    most = max(range(len(best)), key=group.count)
    sentences = list[str]()
    for number in range(len(best)):
        own = [episode for episode, at in zip(episodes, group, strict=True) if at == number]
        sentences.append(f"{letter(number)}: {_ranges(own, episodes)}")
    for k, after in pairwise(range(len(found))):
        if group[k] != group[after]:
            size = _in_words(compare(found[best[group[k]]], found[best[group[after]]]))
            sentences.append(
                f"the camera moved by {size} between episodes {episodes[k]} and {episodes[after]}"
            )
    odd = [str(episode) for episode, is_odd in zip(episodes, _other_intrinsics(found), strict=True) if is_odd]
    sentences += [f"the intrinsics differ from those of most episodes in {', '.join(odd)}"] if odd else []
    return Agreement(group, [compare(found[best[most]], one) for one in found], sentences)


def letter(number: int) -> str:
    """Return the name of a group: A to Z, then A1 and so on."""
    return chr(ord("A") + number % 26) + (str(number // 26) if number >= 26 else "")


def _differs(apart: Difference) -> bool:
    """Test whether two calibrations differ by more than chance; by 1 mm or 0.1° if their covariances are unknown."""
    if apart.p_value is not None:
        return apart.p_value < ALPHA
    return bool(
        np.linalg.norm(apart.translation_m) > 1e-3 or np.linalg.norm(apart.rotation_vector) > np.radians(0.1)
    )


def _size(one: Found) -> float:
    """Return the largest standard deviation (mm) of a calibration's translation; 0 if it is unknown."""
    return max(one.uncertainty.translation_std_mm) if isinstance(one, Calibration) else 0.0


def _in_words(apart: Difference) -> str:
    """Return translation and rotation of a difference in words."""
    mm, deg = 1e3 * np.linalg.norm(apart.translation_m), np.degrees(np.linalg.norm(apart.rotation_vector))
    return f"{mm:.1f} mm and {deg:.2f}°"


def _ranges(own: Sequence[int], episodes: Sequence[int]) -> str:
    """Return episodes in words, those that follow each other in `episodes` as a range."""
    places = {episode: place for place, episode in enumerate(episodes)}
    parts = []
    for _, run in groupby(enumerate(own), key=lambda pair: places[pair[1]] - pair[0]):
        first, *rest = (episode for _, episode in run)
        parts.append(f"{first} to {rest[-1]}" if rest else f"{first}")
    return f"episode{'s' * (len(own) > 1)} {', '.join(parts)}"


def _other_intrinsics(found: Sequence[Found]) -> list[bool]:
    """Test for each calibration whether focal lengths and principal point differ from the median by more than chance."""
    cameras = [one.intrinsics if isinstance(one, Calibration) else None for one in found]
    known = [camera for camera in cameras if camera is not None and camera.std is not None]
    if len(known) < 3:
        return [False] * len(found)
    middle = np.median([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in known], axis=0)
    odd = []
    for camera in cameras:
        std = None if camera is None or camera.std is None else np.array(camera.std[:4])
        if camera is None or std is None or not std.all():
            odd.append(False)
            continue
        off = (np.array([camera.fx, camera.fy, camera.cx, camera.cy]) - middle) / std
        # fx and fy err together, and so do their errors here: the larger sum of squares of either pair.
        odd.append(bool(chi2.sf(max(off[0] ** 2, off[1] ** 2) + (off[2:] ** 2).sum(), 3) < ALPHA))
    return odd
