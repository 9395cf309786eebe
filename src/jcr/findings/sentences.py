"""Sentences of findings whose message or remedy needs more than a template."""

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


def joined(words: Iterable[str]) -> str:
    """Return the words as an enumeration: "a, b and c"."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def filled(words: "str | Callable[[Finding], str]", finding: "Finding") -> str:
    """Return the sentence of a template filled with the finding's quantities, or of a function."""
    return words.format(**_quantities(finding)) if isinstance(words, str) else words(finding)


def _quantities(finding: "Finding") -> dict[str, Any]:
    """Return what templates name: the details of a finding, and its numbers in the units for people."""
    named = {"images": finding.images, "p": finding.p, "value": finding.value} | dict(finding.details)
    for name, number in finding.details.items():
        if not isinstance(number, str):
            named |= {f"{name}_mm": 1e3 * number, f"{name}_deg": np.degrees(number)}
    if (value := finding.value) is not None:
        named |= {"mm": 1e3 * value, "percent": 100 * value, "way": _Way(value), "size": abs(value)}
        named |= {"size_percent": 100 * abs(value), "size_deg": np.degrees(abs(value))}
    if (std := finding.std) is not None:
        for unit, per in (("", 1), ("_percent", 100), ("_mm", 1e3), ("_deg", np.degrees(1))):
            named[f"std{unit}"] = significant(per * std)
    if "rotation" in finding.details:
        named["deg"] = named["rotation_deg"]
    return named | _of_axis(finding)


class _Way(float):
    """Number whose sign selects a word of a template: {way:long|short}."""

    def __format__(self, words: str) -> str:
        return words.split("|")[self <= 0]


def _number(finding: "Finding", name: str) -> float:
    value = finding.details[name]
    assert isinstance(value, int | float), name
    return float(value)


def _value_and_std(finding: "Finding") -> tuple[float, float]:
    assert finding.value is not None and finding.std is not None, finding.kind
    return finding.value, finding.std


def given_remedy(finding: "Finding") -> str:
    return str(finding.details.get("remedy", ""))


def not_exact_enough(finding: "Finding") -> str:
    return f"{SHORT}: {_reached(finding.details)}"


def network_scale_of(finding: "Finding") -> str:
    return network_scale(*(100 * number for number in _value_and_std(finding)))


# Motion.


def unobservable(finding: "Finding") -> str:
    """Return the direction that is unobservable, or nearly so, in words."""
    grade = "nearly unobservable: " if "nearly" in finding.details else ""
    return grade + _direction(finding)


def _direction(finding: "Finding") -> str:
    """Return the unobservable direction and the motion that leaves it so, in words."""
    return _UNOBSERVABLE[str(finding.details["motion"])][0].format(**_of_axis(finding))


def unobservable_text(finding: "Finding") -> str:
    """Return the message of an unobservable or nearly unobservable direction."""
    grade = "nearly unobservable" if "nearly" in finding.details else "unobservable"
    return f"{grade} from these motions: {_direction(finding)}"


def to_observe(finding: "Finding") -> str:
    # Of images that are missing the motions would do: moving otherwise is no remedy.
    if finding.concerns != "motion":
        return ""
    return _UNOBSERVABLE[str(finding.details["motion"])][1].format(**_of_axis(finding))


def _of_axis(finding: "Finding") -> dict[str, str]:
    if "x" not in finding.details:
        return {}
    at = np.array([_number(finding, name) for name in "xyz"])
    frame = str(finding.details["frame"])
    k = int(np.abs(at).argmax())
    axis = f"the axis ({', '.join(f'{x:.2f}' for x in at)}) of the {frame}"
    if abs(at[k]) > np.cos(np.radians(10)):
        axis = f"the {frame}'s {'xyz'[k]} axis"
    return {"axis": axis, "point": ", ".join(f"{1e3 * x:.0f}" for x in at)}


_TILT = "tilt the wrist by 20° or more away from {axis} in two images"
_UNOBSERVABLE = {
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


# Poses and images.


def uncertain(finding: "Finding") -> str:
    sizes = {"translation": "{mm:.0f} mm", "rotation": "{degrees:.1f}°", "scale": "{percent:.0f} %"}
    size = sizes[str(finding.details["part"])]
    degrees = np.degrees(finding.value or 0.0)
    return f"the {{part}} is known to ±{size} only".format(degrees=degrees, **_quantities(finding))


def to_be_sure(finding: "Finding") -> str:
    more = ", or give the robot's repeatability (--robot-noise MM DEG)"
    return (
        "add images, rotated by 20° or more about different axes"
        f"{more if finding.details.get('noise_unknown') else ''}"
    )


def to_be_exact(finding: "Finding") -> str:
    if finding.concerns == "images":
        more = int(_number(finding, "more_images"))
        return f"add {more} image{'s' * (more > 1)} at the poses of next_poses"
    if finding.concerns == "robot":
        return "most of it comes from systematic robot errors: name the arm (--robot) or add its joint angles"
    return (
        "a dozen more images would not be enough; move closer to the scene, or use a better camera or robot"
    )


def blurred(finding: "Finding") -> str:
    edges = filled("edges {value:.0f} px wide", finding)
    if len(finding.images) == 1:
        return f"{finding.images[0]} is blurred ({edges})"
    count = f"{len(finding.images)} of {_number(finding, 'of'):.0f}"
    return f"{count} images are blurred, such as {finding.images[0]} ({edges})"


def not_registered(finding: "Finding") -> str:
    if len(finding.images) == 1 and finding.value:
        return f"{finding.images[0]} is not registered: it matches {finding.value:.0f} other images, too little of each"
    if len(finding.images) == 1:
        return f"{finding.images[0]} matches no other image"
    return f"{len(finding.images)} images are not registered, such as {finding.images[0]}"


# The camera.


def intrinsics(finding: "Finding") -> str:
    if "focal" in finding.details:
        focal, std, given = (_number(finding, f"focal{of}") for of in ("", "_std", "_given"))
        return f"the pointmaps show a focal length of {focal:.0f} ± {significant(std)} px where {given:.0f} is given"
    return f"the images show {' and '.join(_of_parameters(finding))}"


def to_intrinsics(finding: "Finding") -> str:
    if "estimated" in finding.details:
        return "use the transform with the intrinsics of this calibration"
    return "calibrate the intrinsics again at this resolution, or give no intrinsics (null) to have them estimated"


def _of_parameters(finding: "Finding") -> list[str]:
    """Return each parameter that differs surely, as found and as given."""
    by, said = finding.details, []
    before = "was estimated first" if "estimated" in by else "is given"
    common = {"fx_std", "fy_std"} <= by.keys() and _is_common(finding)
    if common:
        fx, std, given = (_number(finding, f"fx{of}") for of in ("", "_std", "_given"))
        said.append(f"a focal length of {fx:.1f} ± {significant(std)} px where {given:.1f} {before}")
    for pair, what, px, digits in PAIRS[common:]:
        known = [name for name in pair if f"{name}_std" in by]
        if any(_sigmas(finding, name) > SURE for name in known):
            found, was = (
                ", ".join(f"{_number(finding, f'{name}{of}'):.{digits}f}" for name in pair)
                for of in ("", "_given")
            )
            most = significant(max(_number(finding, f"{name}_std") for name in known))
            said.append(f"{what} ({found}) ± {most}{px} where ({was}) {before}")
    return said or ["other intrinsics than those used, no one of them surely by itself"]


def _sigmas(finding: "Finding", name: str) -> float:
    return abs(_number(finding, name) - _number(finding, f"{name}_given")) / _number(finding, f"{name}_std")


def _is_common(finding: "Finding") -> bool:
    """Test whether fx and fy are surely off by one common factor."""
    x, y = (_number(finding, name) / _number(finding, f"{name}_given") - 1 for name in ("fx", "fy"))
    sure = min(_sigmas(finding, "fx"), _sigmas(finding, "fy")) > SURE
    return sure and abs(x - y) < max(0.2 * abs(x), 2e-3)


# The order of the images.


def one_part(finding: "Finding") -> str:
    """Return which part of the images to calibrate after a change, and what must be as it was for the other part."""
    part = {"before": "up to {images[0]}", "after": "from {images[1]} on"}[str(finding.details["longer"])]
    kept = "the camera still sits" if finding.concerns == "mount" else "base and scene still stand"
    return filled(
        f"calibrate the {{count:.0f}} images {part} alone, and those of the other part only where {kept} as then",
        finding,
    )


# The robot.


def joints_off(finding: "Finding") -> str:
    sizes = joined(
        f"{np.degrees(_number(finding, f'joint_{k}')):+.2f} ± {np.degrees(_number(finding, f'joint_{k}_std')):.2f}°"
        for k in finding.joints
    )
    named = f"joint{'s' * (len(finding.joints) > 1)} {joined(str(k) for k in finding.joints)}"
    return f"robot: {named} seem off by {sizes}"


# Scale.


def board_size(finding: "Finding") -> str:
    off, std = _value_and_std(finding)
    if finding.details.get("marker"):
        scale = 1 + off
        size = f"{100 * abs(1 / scale - 1):.1f} % too {'large' if scale < 1 else 'small'}"
        return (
            f"the scale is {scale:.4f} where a marker of known size gives 1: its size was given {size}, or the camera's "
            "focal length is off"
        )
    return (
        f"by the robot's motion the board is {100 * abs(off):.1f} ± {100 * std:.1f} % "
        f"{'larger' if off > 0 else 'smaller'} than given"
    )


def scales(finding: "Finding") -> str:
    off, std = _value_and_std(finding)
    names = (LENGTHS[str(finding.details[name])] for name in ("one", "other"))
    return f"{' and '.join(names)} contradict each other by {100 * abs(off):.1f} ± {100 * std:.1f} %"


def board_side(finding: "Finding") -> str:
    side, std = (1e3 * value for value in _value_and_std(finding))
    return f"by the robot's positions the sides of {finding.details['board']} are {with_std(side, std)} mm"


def to_board_side(finding: "Finding") -> str:
    side, std = (1e3 * value for value in _value_and_std(finding))
    printed = round(2 * side) / 2  # boards are printed in halves of a millimetre
    if abs(side - printed) < 2 * std:
        return "measure one, and give it in --board: the scale is then known twice"
    longer = "long" if side > printed else "short"
    return (
        f"if they measure {printed:g} mm, give {1e-3 * printed:g} in --board: the positions are "
        f"{100 * abs(side / printed - 1):.1f} % too {longer}"
    )


def board_not_found(finding: "Finding") -> str:
    proposed = finding.details.get("proposed")
    shown = f", but they seem to show {proposed}" if proposed else ""
    return filled("no two images show {board}: features alone are used", finding) + shown


def board_moved(finding: "Finding") -> str:
    names = joined(finding.images[:3]) + (
        f" and {len(finding.images) - 3} more" if len(finding.images) > 3 else ""
    )
    where = "is at another place than in the other images: it was moved, or there are two"
    return f"in {names} {finding.details['board']} {where}"


def to_size(finding: "Finding") -> str:
    measure = "measure its squares, and check that the gripper poses are in metres"
    return "" if finding.details.get("marker") else measure


def board_lengths(finding: "Finding") -> str:
    kind, *parts = str(finding.details["board"]).split(":")
    board = (
        f", or --board charuco:COLUMNSxROWS:SIDE:MARKER:{parts[-1]} for a ChArUco board,"
        if kind == "aruco"
        else ""
    )
    return filled(f"try --board {{board}}{board} with its SIDE in metres (jcr docs markers)", finding)


# Further cameras of a cell.


def misses(finding: "Finding") -> str:
    moved = {"base": "it is not fixed", "gripper": "it is not rigid on the gripper"}
    return filled(
        "{images[0]} misses the place that fits its images together by {value:.0f} px (median): "
        f"{moved[str(finding.details['mount'])]}, the scene changed, or the intrinsics are wrong",
        finding,
    )


def place_uncertain(finding: "Finding") -> str:
    size = filled("its place is known to ±{mm:.0f} mm and {deg:.1f}° only", finding)
    if "focal_std" not in finding.details:
        return size
    percent = significant(100 * _number(finding, "focal_std"))
    return f"{size}, for its images do not show its intrinsics (focal length ± {percent} %)"


def to_place(finding: "Finding") -> str:
    if finding.concerns == "intrinsics":
        return "give them, or images with more of the scene, at other depths"
    return "let it see more of the mapped scene, or add images to the wrist camera's capture"
