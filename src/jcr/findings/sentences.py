"""Words of findings: the quantities that templates name, and the sentences that need more than a template."""

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray

from jcr.rounding import significant, with_std

if TYPE_CHECKING:
    from jcr.findings.finding import Finding
    from jcr.findings.requirement import Requirement

SHORT = "not as exact as needed"
SURE = 4.0
"""Standard deviations from which a parameter of the intrinsics is named by itself (4: p = 6e-5)."""
FLAGS = ("nearly", "noise_unknown", "more_images", "estimated", "marker")
"""Numbers of templates that are 0 of findings without them."""
LENGTHS = {
    "robot": "the robot's positions",
    "board": "the size of the board",
    "known length": "the known length",
    "depth camera": "the depth camera",
    "network": "the network's metre",
}
"""Names of the sources of a scale."""
NEARER = "take two or more images 20 % nearer to or farther from the point you look at"
PAIRS = (
    (("fx", "fy"), "focal lengths of", " px", 1),
    (("cx", "cy"), "a principal point of", " px", 1),
    (("k1", "k2"), "a distortion k1, k2 of", "", 3),
    (("p1", "p2"), "a distortion p1, p2 of", "", 4),
)
"""Parameters of intrinsics that are named together: names, words, unit and decimals."""


class _Number(float):
    """Number whose sign selects a word of a template: {way:long|short}."""

    def __format__(self, spec: str) -> str:
        return spec.split("|")[self <= 0] if "|" in spec else super().__format__(spec)


class _Text(str):
    """Text of a template: {name:a=words of a|b=words of b}, or {name:words around $}, which are empty without it."""

    def __format__(self, spec: str) -> str:
        if "=" in spec:
            return dict(part.split("=", 1) for part in spec.split("|") if part).get(self, "")
        return spec.replace("$", self) if spec and self else str(self)


class _Images(tuple[str, ...]):
    """Images of a template: {images} names at most three, {images:is|are} agrees with their number."""

    def __format__(self, spec: str) -> str:
        if spec:
            return spec.split("|")[len(self) > 1]
        more = [f"{len(self) - 3} more"] if len(self) > 3 else []
        return joined([*self[:3], *more])


class _Quantities(dict[str, Any]):
    """Quantities that templates name; those that a finding lacks are empty texts."""

    def __missing__(self, name: str) -> _Text:
        return _Text("")


def joined(words: Iterable[str]) -> str:
    """Return the words as an enumeration: "a, b and c"."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def filled(words: "str | Callable[[Finding], str]", finding: "Finding") -> str:
    """Return the sentence of a template filled with the finding's quantities, or of a function."""
    return words.format_map(_quantities(finding)) if isinstance(words, str) else words(finding)


def _quantities(finding: "Finding") -> _Quantities:
    """Return what templates name: the details of a finding, and its numbers in the units for people."""
    named = _Quantities(dict.fromkeys(FLAGS, _Number(0)))
    named |= {"images": _Images(finding.images), "concerns": _Text(finding.concerns), "p": finding.p}
    for name, detail in finding.details.items():
        if isinstance(detail, str):
            named[name] = _Text(LENGTHS.get(detail, detail))
            continue
        named |= {name: _Number(detail), f"{name}_mm": 1e3 * detail, f"{name}_deg": np.degrees(detail)}
        named[f"{name}_percent"] = _Text(significant(100 * detail))
    if (value := finding.value) is not None:
        named |= {"value": value, "mm": 1e3 * value, "percent": 100 * value, "size": abs(value)}
        named["percent_rounded"] = significant(100 * value)
        named |= {"way": _Number(value), "size_percent": 100 * abs(value), "size_deg": np.degrees(abs(value))}
    if (std := finding.std) is not None:
        for unit, per in (("", 1), ("_percent", 100), ("_mm", 1e3), ("_deg", np.degrees(1))):
            named[f"std{unit}"] = significant(per * std)
        if value is not None:
            named["value_std_mm"] = with_std(1e3 * value, 1e3 * std)
    if "rotation" in finding.details:
        named["deg"] = named["rotation_deg"]
    named |= _of_axis(finding)
    if "motion" in finding.details:
        direction, move = _UNOBSERVABLE[str(finding.details["motion"])]
        named |= {"direction": direction.format_map(named), "move": move.format_map(named)}
    return named


def _of_axis(finding: "Finding") -> dict[str, str]:
    """Return the axis and the point of a finding in words."""
    if "x" not in finding.details:
        return {}
    at = np.array([finding.details[name] for name in "xyz"], float)
    frame = str(finding.details["frame"])
    k = int(np.abs(at).argmax())
    axis = f"the axis ({', '.join(f'{x:.2f}' for x in at)}) of the {frame}"
    if abs(at[k]) > np.cos(np.radians(10)):
        axis = f"the {frame}'s {'xyz'[k]} axis"
    return {"axis": axis, "point": ", ".join(f"{1e3 * x:.0f}" for x in at)}


def unobservable(finding: "Finding") -> str:
    """Return the direction that is unobservable, or nearly so, in words."""
    return filled("{nearly:nearly unobservable: |}{direction}", finding)


_TILT = "tilt the wrist by 20° or more away from {axis} in two images"
_UNOBSERVABLE = {
    "no camera poses": ("everything: no camera poses", "{advice}"),
    "two images": (
        "translation along, and rotation about, the one axis that two images share",
        "add one image or more, rotated by 20° or more about another axis",
    ),
    "no rotation": (
        "translation of the camera in x, y and z: the gripper never rotates (pure translation)",
        "tilt the wrist by 20° or more, about two different axes, in at least three images",
    ),
    "planar": (
        "translation along {axis}: all rotations are about it (planar or SCARA motion)",
        f"{_TILT}, or give the camera's known height along it",
    ),
    "one axis, translation": ("translation along {axis}: all rotations are about it (one fixed axis)", _TILT),
    "one axis, scale": (
        "scale: the camera moves on circles about one axis only",
        "move the gripper sideways and in height as well",
    ),
    "one axis, rotation": ("rotation of the camera about {axis}", _TILT),
    "weak translation": (
        "translation of the camera along {axis}",
        "rotate the wrist more, about perpendicular axes, in three or more images",
    ),
    "weak rotation": (
        "rotation of the camera along {axis}",
        "rotate the wrist more, about perpendicular axes, in three or more images",
    ),
    "one point": ("scale: all views rotate about the one point ({point}) mm in the gripper frame", NEARER),
    "own centre": (
        "scale: the camera only rotates about its own centre",
        "move the camera sideways by 10 cm or more between images",
    ),
    "look-at": (
        "scale and the translation along the optical axis: all views rotate about one point on it "
        "(look-at orbit at a constant radius)",
        NEARER,
    ),
    "tool point": (
        "scale: all views rotate about one tool point fixed at ({point}) mm in the gripper frame",
        "move that point too: take two or more images with it 10 cm away from where it was",
    ),
}
"""Unobservable direction and remedy of each kind of motion."""


def reached_in_words(required: "Requirement") -> str:
    """Return the bound of 95 % of the errors beside the requirement, in words."""
    return _reached(vars(required))


def _reached(required: Mapping[str, Any]) -> str:
    far = required["distance_mm"]
    at = required.get("at", "seen" if far else "camera")
    asked = "asked for" if required["asked"] else "needed to grasp"
    mm, degrees = significant(required["reached_mm"]), significant(required["reached_deg"])
    reached = {
        "seen": f"a point seen at {significant(1e-3 * far)} m is placed within {mm} mm and {degrees}° in the robot's "
        "base frame (95 % of errors)",
        "camera": f"95 % of errors of the camera on the gripper are below {mm} mm and {degrees}°",
        "scene": f"95 % of errors of mapped points are below {mm} mm and {degrees}°",
    }
    return f"{reached[at]}; {required['translation_mm']:g} mm and {required['rotation_deg']:g}° are {asked}"


def network_scale(off_percent: float, std_percent: float) -> str:
    """Return the difference of a network's own scale from the robot's, with its standard deviation, in words."""
    off, std = off_percent, std_percent
    if abs(off) < 2 * std:
        return f"the network's own metre agrees with the robot's ({off:+.2g} ± {std:.2g} %)"
    if off > 100:
        return f"the network's own lengths are {1 + off / 100:.3g} times the robot's"
    direction = "long" if off > 0 else "short"
    return f"the network's own lengths are {abs(off):.3g} ± {std:.2g} % too {direction} compared with the robot's"


def worst_direction(gripper_from_camera: ndarray, covariance: ndarray) -> str:
    """Return the least certain direction of the translation, e.g. "along the optical axis: ±4.0 mm".

    `covariance` (7,7) is in COVARIANCE_ORDER.
    """
    variance, vectors = np.linalg.eigh(covariance[:3, :3])
    direction = vectors[:, 2]
    std_mm = 1e3 * float(np.sqrt(variance[2]))
    named = {
        "the optical axis": gripper_from_camera[:3, 2],
        "the image's x axis": gripper_from_camera[:3, 0],
        "the image's y axis": gripper_from_camera[:3, 1],
    }
    name, axis = max(named.items(), key=lambda item: abs(item[1] @ direction))
    if abs(axis @ direction) < np.cos(np.radians(30)):
        name = f"({', '.join(f'{x:.2f}' for x in direction)}) of the gripper"
    # An offset that is unobservable may be uncertain by metres.
    size = f"{significant(std_mm)} mm" if std_mm < 1000 else f"{significant(std_mm / 1e3)} m"
    return f"along {name}: ±{size}"


def unmet_bound(finding: "Finding") -> str:
    """Return the bound of 95 % of the errors that is not within the requirement, in words."""
    return f"{SHORT}: {_reached(finding.details)}"


def network_scale_of(finding: "Finding") -> str:
    """Return the message of a network's metre that contradicts the robot's."""
    assert finding.value is not None and finding.std is not None
    return network_scale(100 * finding.value, 100 * finding.std)


def intrinsics(finding: "Finding") -> str:
    """Return each parameter that differs surely, as found and as given."""
    by, said = dict(finding.details), []
    if "focal" in by:
        return filled("the pointmaps show a focal length of {focal:.0f} ± ", finding) + (
            f"{significant(float(by['focal_std']))} px where {by['focal_given']:.0f} is given"
        )
    before = "was estimated first" if "estimated" in by else "is given"
    numbers = {name: float(number) for name, number in by.items()}
    for pair, what, px, digits in PAIRS:
        stds = {name: numbers[f"{name}_std"] for name in pair if f"{name}_std" in by}
        if any(abs(numbers[name] - numbers[f"{name}_given"]) > SURE * std for name, std in stds.items()):
            found, was = (
                ", ".join(f"{numbers[f'{name}{of}']:.{digits}f}" for name in pair) for of in ("", "_given")
            )
            said.append(f"{what} ({found}) ± {significant(max(stds.values()))}{px} where ({was}) {before}")
    return f"the images show {joined(said or ['other intrinsics than those used, no one of them surely by itself'])}"


def joints_off(finding: "Finding") -> str:
    """Return each joint that is surely off, and by how much."""
    sizes = joined(
        filled(f"{{joint_{k}_deg:+.2f}} ± {{joint_{k}_std_deg:.2f}}°", finding) for k in finding.joints
    )
    named = f"joint{'s' * (len(finding.joints) > 1)} {joined(str(k) for k in finding.joints)}"
    return f"robot: {named} seem off by {sizes}"
