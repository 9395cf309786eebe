"""Findings in words, and nothing else: one sentence of what was found, one of what would help.

Beside the records, for `warnings` of a calibration are these sentences. Nothing is decided by them.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy import ndarray

from jcr.records.findings import Finding, Kind
from jcr.records.requirement import Requirement
from jcr.rounding import significant, with_std

SHORT = "not as exact as needed"
SURE = 4.0
"""Standard deviations from which a parameter of the intrinsics is named by itself."""
CALIBRATE_INTRINSICS = (
    "calibrate the intrinsics again at this resolution, or give no intrinsics (null) to have them estimated"
)
LENGTHS = {
    "robot": "the robot's positions",
    "board": "the size of the board",
    "known length": "the known length",
    "depth camera": "the depth camera",
    "network": "the network's metre",
}
"""Names of what a scale is known from."""
AT_REST = "take the images at rest"
NEARER = "take two or more images 20 % nearer to or farther from the point you look at"
PAIRS = (
    (("fx", "fy"), "focal lengths of", " px", 1),
    (("cx", "cy"), "a principal point of", " px", 1),
    (("k1", "k2"), "a distortion k1, k2 of", "", 3),
    (("p1", "p2"), "a distortion p1, p2 of", "", 4),
)
"""Parameters of intrinsics that are named together, how, their unit and their decimals."""


Words = str | Callable[[Finding], str]
"""Of a kind: a template of the names in `_quantities`, or what makes the sentence of a finding."""


def text(finding: Finding) -> str:
    """What was found, in one sentence."""
    return _said(_TEXT[finding.kind], finding)


def remedy(finding: Finding) -> str:
    """What would help, in one sentence; empty where nothing would, or nothing need be done."""
    return _said(_REMEDY.get(finding.kind, ""), finding)


def sentence(finding: Finding) -> str:
    """Both in one line."""
    return "; ".join(filter(None, (text(finding), remedy(finding))))


def doubt_of(findings: Iterable[Finding]) -> str | None:
    """The first reason of a rejection, by findings that are strongest first; None where nothing rejects."""
    return next((sentence(finding) for finding in findings if finding.severity == "rejects"), None)


def warnings_of(findings: Iterable[Finding]) -> tuple[str, ...]:
    """A sentence for each finding that rejects or warns."""
    return tuple(sentence(finding) for finding in findings if finding.severity != "informs")


def reached_in_words(required: Requirement) -> str:
    """What 95 % of the errors stay below, and whether that is what was asked."""
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
    """How far a network's own scale is from the robot's, and how sure that is."""
    off, std = off_percent, std_percent
    if abs(off) < 2 * std:
        return f"the network's own metre agrees with the robot's ({off:+.2g} ± {std:.2g} %)"
    if off > 100:
        return f"the network's own lengths are {1 + off / 100:.3g} times the robot's"
    direction = "long" if off > 0 else "short"
    return f"the network's own lengths are {abs(off):.3g} ± {std:.2g} % too {direction} compared with the robot's"


def worst_direction(gripper_from_camera: ndarray, covariance: ndarray) -> str:
    """The least certain direction of the translation, e.g. "along the optical axis: ±4.0 mm", by a covariance (7,7) in
    COVARIANCE_ORDER."""
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
    """A list as one says it."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def _said(words: Words, finding: Finding) -> str:
    return words.format(**_quantities(finding)) if isinstance(words, str) else words(finding)


def _quantities(finding: Finding) -> dict[str, Any]:
    """What templates name: the finding's details and its numbers in the units in which they are read."""
    named = {"images": finding.images, "p": finding.p, "value": finding.value} | dict(finding.details)
    for name, number in finding.details.items():
        if not isinstance(number, str):
            named |= {f"{name}_mm": 1e3 * number, f"{name}_deg": np.degrees(number)}
    if finding.p is not None:
        named["chance"] = f"p = {finding.p:.0e}"
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
    """A number whose sign a template names: {way:long|short}."""

    def __format__(self, words: str) -> str:
        return words.split("|")[self <= 0]


def _number(finding: Finding, name: str) -> float:
    value = finding.details[name]
    assert isinstance(value, int | float), name
    return float(value)


def _value_and_std(finding: Finding) -> tuple[float, float]:
    assert finding.value is not None and finding.std is not None, finding.kind
    return finding.value, finding.std


def _given_remedy(finding: Finding) -> str:
    return str(finding.details.get("remedy", ""))


# Motion.


def unobservable(finding: Finding) -> str:
    """Return the direction that is unobservable, or nearly so, in words."""
    grade = "nearly unobservable: " if "nearly" in finding.details else ""
    return grade + _direction(finding)


def _direction(finding: Finding) -> str:
    """Return the unobservable direction and the motion that leaves it so, in words."""
    return _UNSEEN[str(finding.details["motion"])][0].format(**_of_axis(finding))


def _unobservable_text(finding: Finding) -> str:
    """Return the message of an unobservable or nearly unobservable direction."""
    grade = "nearly unobservable" if "nearly" in finding.details else "unobservable"
    return f"{grade} from these motions: {_direction(finding)}"


def _to_observe(finding: Finding) -> str:
    # Of images that are missing the motions would do: moving otherwise is no remedy.
    if finding.mend != "motion":
        return ""
    return _UNSEEN[str(finding.details["motion"])][1].format(**_of_axis(finding))


def _of_axis(finding: Finding) -> dict[str, str]:
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
_UNSEEN = {
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
"""For each kind of motion what is unobservable, and the remedy."""


# Poses and images.


def _uncertain(finding: Finding) -> str:
    sizes = {"translation": "{mm:.0f} mm", "rotation": "{degrees:.1f}°", "scale": "{percent:.0f} %"}
    size = sizes[str(finding.details["part"])]
    degrees = np.degrees(finding.value or 0.0)
    return f"the {{part}} is known to ±{size} only".format(degrees=degrees, **_quantities(finding))


def _to_be_sure(finding: Finding) -> str:
    more = ", or give the robot's repeatability (--robot-noise MM DEG)"
    return (
        "add images, rotated by 20° or more about different axes"
        f"{more if finding.details.get('noise_unknown') else ''}"
    )


def _to_be_exact(finding: Finding) -> str:
    if finding.mend == "images":
        more = int(_number(finding, "more_images"))
        return f"add {more} image{'s' * (more > 1)} at the poses of next_poses"
    if finding.mend == "robot":
        return "most of it comes from systematic robot errors: name the arm (--robot) or add its joint angles"
    return (
        "a dozen more images would not be enough; move closer to the scene, or use a better camera or robot"
    )


def _blurred(finding: Finding) -> str:
    edges = _said("edges {value:.0f} px wide", finding)
    if len(finding.images) == 1:
        return f"{finding.images[0]} is blurred ({edges})"
    count = f"{len(finding.images)} of {_number(finding, 'of'):.0f}"
    return f"{count} images are blurred, such as {finding.images[0]} ({edges})"


def _not_registered(finding: Finding) -> str:
    if len(finding.images) == 1 and finding.value:
        return f"{finding.images[0]} is not registered: it matches {finding.value:.0f} other images, too little of each"
    if len(finding.images) == 1:
        return f"{finding.images[0]} matches no other image"
    return f"{len(finding.images)} images are not registered, such as {finding.images[0]}"


# The camera.


def _intrinsics(finding: Finding) -> str:
    if finding.p is None:
        return f"the images show {' and '.join(_of_image_parts(finding))}"
    return f"the images show {' and '.join(_of_parameters(finding))} ({_said('{chance}', finding)})"


def _of_image_parts(finding: Finding) -> list[str]:
    """What is off by enough to matter: focal length, distortion where the points are, principal point."""
    by, said = finding.details, []
    if "focal" in by:
        focal, std, given = (_number(finding, f"focal{of}") for of in ("", "_std", "_given"))
        said.append(f"a focal length of {focal:.0f} ± {significant(std)} px where {given:.0f} is given")
    if "bend" in by:
        px, std = (_number(finding, f"bend{of}") for of in ("", "_std"))
        said.append(f"a distortion up to {px:.1f} ± {significant(std)} px from the one used")
    if "cx" in by:
        cx, cy, std, cx_given, cy_given = (
            _number(finding, name) for name in ("cx", "cy", "centre_std", "cx_given", "cy_given")
        )
        said.append(
            f"a principal point of ({cx:.0f}, {cy:.0f}) ± {significant(std)} px where ({cx_given:.0f}, {cy_given:.0f}) "
            "is given"
        )
    return said


def _of_parameters(finding: Finding) -> list[str]:
    """Each parameter that differs surely, as it is and as it was given."""
    by, said = finding.details, []
    common = {"fx_std", "fy_std"} <= by.keys() and _is_common(finding)
    if common:
        fx, std, given = (_number(finding, f"fx{of}") for of in ("", "_std", "_given"))
        said.append(f"a focal length of {fx:.1f} ± {significant(std)} px where {given:.1f} is given")
    for pair, what, px, digits in PAIRS[common:]:
        known = [name for name in pair if f"{name}_std" in by]
        if any(_sigmas(finding, name) > SURE for name in known):
            found, was = (
                ", ".join(f"{_number(finding, f'{name}{of}'):.{digits}f}" for name in pair)
                for of in ("", "_given")
            )
            most = significant(max(_number(finding, f"{name}_std") for name in known))
            said.append(f"{what} ({found}) ± {most}{px} where ({was}) is given")
    return said or ["other intrinsics than those used, no one of them surely by itself"]


def _sigmas(finding: Finding, name: str) -> float:
    return abs(_number(finding, name) - _number(finding, f"{name}_given")) / _number(finding, f"{name}_std")


def _is_common(finding: Finding) -> bool:
    """Whether fx and fy are off by one factor, surely."""
    x, y = (_number(finding, name) / _number(finding, f"{name}_given") - 1 for name in ("fx", "fy"))
    sure = min(_sigmas(finding, "fx"), _sigmas(finding, "fy")) > SURE
    return sure and abs(x - y) < max(0.2 * abs(x), 2e-3)


# The order of the images.


def _one_part(finding: Finding) -> str:
    part = {"before": "up to {images[0]}", "after": "from {images[1]} on"}[str(finding.details["longer"])]
    return _said(
        f"calibrate the {{count:.0f}} images {part} alone, and those of the other part only where the camera still sits "
        "as it did then",
        finding,
    )


# The robot.


def _joints_off(finding: Finding) -> str:
    sizes = joined(
        f"{np.degrees(_number(finding, f'joint_{k}')):+.2f} ± {np.degrees(_number(finding, f'joint_{k}_std')):.2f}°"
        for k in finding.joints
    )
    named = f"joint{'s' * (len(finding.joints) > 1)} {joined(str(k) for k in finding.joints)}"
    return f"robot: {named} seem off by {sizes}"


# Scale.


def _board_size(finding: Finding) -> str:
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


def _scales(finding: Finding) -> str:
    off, std = _value_and_std(finding)
    names = (LENGTHS[str(finding.details[name])] for name in ("one", "other"))
    return f"{' and '.join(names)} contradict each other by {100 * abs(off):.1f} ± {100 * std:.1f} %"


def _to_lengths(finding: Finding) -> str:
    named = finding.details
    if "third" not in named:
        return "measure both again"
    wrong = named["one"] if named["agrees_with"] == named["other"] else named["other"]
    right, third = (LENGTHS[str(named[name])] for name in ("agrees_with", "third"))
    return f"check {LENGTHS[str(wrong)]}: {right} and {third} agree"


def _board_side(finding: Finding) -> str:
    side, std = (1e3 * value for value in _value_and_std(finding))
    return f"by the robot's positions the sides of {finding.details['board']} are {with_std(side, std)} mm"


def _to_board_side(finding: Finding) -> str:
    side, std = (1e3 * value for value in _value_and_std(finding))
    printed = round(2 * side) / 2  # boards are printed in halves of a millimetre
    if abs(side - printed) < 2 * std:
        return "measure one, and give it in --board: the scale is then known twice"
    longer = "long" if side > printed else "short"
    return (
        f"if they measure {printed:g} mm, give {1e-3 * printed:g} in --board: the positions are "
        f"{100 * abs(side / printed - 1):.1f} % too {longer}"
    )


def _board_not_found(finding: Finding) -> str:
    proposed = finding.details.get("proposed")
    shown = f", but they seem to show {proposed}" if proposed else ""
    return _said("no two images show {board}: features alone are used", finding) + shown


def _board_moved(finding: Finding) -> str:
    names = joined(finding.images[:3]) + (
        f" and {len(finding.images) - 3} more" if len(finding.images) > 3 else ""
    )
    where = "is at another place than in the other images: it was moved, or there are two"
    return f"in {names} {finding.details['board']} {where}"


def _to_size(finding: Finding) -> str:
    if "third" in finding.details:
        return _to_lengths(finding)
    measure = "measure its squares, and check that the gripper poses are in metres"
    return "" if finding.details.get("marker") else measure


def _board_lengths(finding: Finding) -> str:
    kind, *parts = str(finding.details["board"]).split(":")
    board = (
        f", or --board charuco:COLUMNSxROWS:SIDE:MARKER:{parts[-1]} for a ChArUco board,"
        if kind == "aruco"
        else ""
    )
    return _said(f"try --board {{board}}{board} with its SIDE in metres (jcr docs markers)", finding)


# Further cameras of a cell.


def _misses(finding: Finding) -> str:
    moved = {"base": "it is not fixed", "gripper": "it is not rigid on the gripper"}
    return _said(
        "{images[0]} misses the place that fits its images together by {value:.0f} px (median): "
        f"{moved[str(finding.details['mount'])]}, the scene changed, or the intrinsics are wrong",
        finding,
    )


def _place_uncertain(finding: Finding) -> str:
    size = _said("its place is known to ±{mm:.0f} mm and {deg:.1f}° only", finding)
    if "focal_std" not in finding.details:
        return size
    percent = significant(100 * _number(finding, "focal_std"))
    return f"{size}, for its images do not show its intrinsics (focal length ± {percent} %)"


def _to_place(finding: Finding) -> str:
    if finding.mend == "intrinsics":
        return "give them, or images with more of the scene, at other depths"
    return "let it see more of the mapped scene, or add images to the wrist camera's capture"


_TEXT: dict[Kind, Words] = {
    Kind.UNOBSERVABLE: _unobservable_text,
    Kind.FEW_IMAGES: "with {value:.0f} images a wrong one cannot be identified",
    Kind.FEW_AGREE: "only {value:.0f} of {images:.0f} images agree on one calibration",
    Kind.POSES_CONTRADICT_IMAGES: "gripper poses and images disagree by {mm:.0f} mm and {deg:.1f}° per axis",
    Kind.POSE_CONVENTION: "the poses fit when read as {reading}: {fits}, instead of {given}",
    Kind.NOISE_ABOVE_GIVEN: (
        "gripper poses and images disagree by {mm:.2g} mm and {deg:.2g}° per axis, more than the given robot noise "
        "({given_mm:.2g} mm, {given_rotation_deg:.2g}°): the larger is used"
    ),
    Kind.UNCERTAIN: _uncertain,
    Kind.LEAVE_ONE_OUT: (
        "the leave-one-out error ({mm:.1f} mm) is well above the fit's residual ({residual_mm:.1f} mm): too few images "
        "for this motion"
    ),
    Kind.NOT_EXACT_ENOUGH: lambda f: f"{SHORT}: {_reached(f.details)}",
    Kind.FOCUS_BY_DISTANCE: (
        "the focal length {way:grows|shrinks} by {size_percent:.1f} ± {std_percent} % from the nearest view to the "
        "farthest ({chance})"
    ),
    Kind.FOCUS_BY_IMAGE: (
        "the focal length differs between images by {percent:.1f} % (rms, each ± {std_percent} %; {chance})"
    ),
    Kind.ZOOM: (
        "the focal length changes by {percent:+.1f} ± {std_percent} % after {images[0]} ({chance}): the zoom or focus "
        "was moved"
    ),
    Kind.ROLLING_SHUTTER: (
        "the images are sheared by {value:.1f} ± {std} px from top to bottom ({chance}), as by the rolling shutter of a "
        "moving camera"
    ),
    Kind.ROLLING_SHUTTER_BY_IMAGE: (
        "each image is sheared by itself, {value:.1f} px from top to bottom (rms, {chance}), as by the rolling shutter "
        "of a moving camera"
    ),
    Kind.THIN_PRISM: (
        "the images show a thin-prism distortion of up to {value:.1f} ± {std} px ({chance}): the sensor is tilted, or "
        "the optics are decentred"
    ),
    Kind.CENTRE_SAGS: (
        "the principal point moves with gravity, by {value:.1f} ± {std} px when it lies in the image ({chance}): the "
        "optics are image-stabilised or loose"
    ),
    Kind.INTRINSICS: _intrinsics,
    Kind.SLIP: (
        "the camera seems to have moved on the gripper by {mm:.1f} mm and {deg:.2f}° after {images[0]} ({chance})"
    ),
    Kind.DRIFT: (
        "the camera seems to drift on the gripper by {mm:.1f} mm and {deg:.2f}° from the first image to the last "
        "({chance})"
    ),
    Kind.BASE_MOVED: (
        "the robot's base and the scene moved against each other by {mm:.1f} mm and {deg:.2f}° after {images[0]} "
        "({chance})"
    ),
    Kind.DELAY: (
        "the gripper poses look as if read {size:.3f} ± {std} of the time from one image to the next too "
        "{way:late|early} ({chance})"
    ),
    Kind.WRONG_MOUNT: "the images fit a camera that the gripper carries, not a fixed one",
    Kind.ROBOT_UNUSED: "the capture's robot is not used: {text}",
    Kind.JOINT_OFFSETS: _joints_off,
    Kind.LENGTHS: (
        "along {axis} the robot's positions are {size_percent:.1f} ± {std_percent} % too {way:long|short} beside those "
        "across it ({chance})"
    ),
    Kind.BASE_LEANS: (
        "the robot's base leans {way:towards|away from} the gripper by {size_deg:.1f} ± {std_deg}° per metre of reach, "
        "which its poses do not say ({chance})"
    ),
    Kind.TOOL_SAGS: (
        "the gripper rotates by {size_deg:.2f} ± {std_deg}° where it is level, as a tool does that sags under its "
        "weight ({chance})"
    ),
    Kind.BOARD_SIZE: _board_size,
    Kind.SCALES: _scales,
    Kind.BOARD_SIDE: _board_side,
    Kind.BOARD_MOVED: _board_moved,
    Kind.BOARD_NOT_FOUND: _board_not_found,
    Kind.NETWORK_SCALE: lambda f: network_scale(*(100 * x for x in _value_and_std(f))),
    Kind.SCALE_ASSUMED: "the scale is unobservable from these motions: it is taken as 1, from the marker's size",
    Kind.SCALE_FROM_ROBOT: (
        "the scale comes from the robot's positions alone: if all of them are wrong by one factor, no image shows it, "
        "and ± does not include it"
    ),
    Kind.IMAGES_ROTATED: (
        "EXIF orientation {value:.0f}: the images are {rotated}, as viewers show them, and gripper_from_camera and the "
        "intrinsics are of the camera that would see them so"
    ),
    Kind.BOARD_IN_VIEW: "a calibration board is in view",
    Kind.RECONSTRUCTION: "{text}",
    Kind.NO_RECONSTRUCTION: "{text}",
    Kind.OWN_REJECTED: "the {camera} camera's own calibration is rejected",
    Kind.FEW_POINTS_SHARED: "{images[0]} shares {value:.0f} points with the mapped scene, too few",
    Kind.FEW_LOCALISED: "{value:.0f} of its images share enough of the mapped scene; {needed:.0f} are needed",
    Kind.NO_COMMON_POSE: "none of its images was taken with an image that is used",
    Kind.ONE_GRIPPER_POSE: (
        "its images show one gripper pose only: whether it is on the gripper, and at which frame each image was taken, "
        "cannot be tested"
    ),
    Kind.SECOND_ON_ARM: "a second camera on arm {arm}: one each is supported",
    Kind.NOT_FIXED: (
        "{images[0]} and {images[1]} were taken from places {mm:.0f} mm and {deg:.1f}° apart: it is not fixed"
    ),
    Kind.NOT_RIGID: (
        "its place beside the {camera} camera differs by up to {mm:.0f} mm between images: the two are not rigid, or "
        "the images are not of the frames that they stand for"
    ),
    Kind.FAR_FROM_GRIPPER: "it is {value:.2f} m from the gripper's frame",
    Kind.IMAGE_MISSES: _misses,
    Kind.PLACE_UNCERTAIN: _place_uncertain,
    Kind.AT_ANOTHER_CAMERA: (
        "it stands where the {camera} camera was at {images[0]}: if its image is one of that camera, it is not fixed"
    ),
    Kind.POINTS_CROWDED: "its points lie in {percent:.0f} % of the image",
    Kind.STATIC_IMAGES: (
        "all images show the same view but for noise, while the gripper moves by {mm:.0f} mm and rotates by {deg:.0f}°"
    ),
    Kind.BLURRED: _blurred,
    Kind.FEW_USED: (
        "only {value:.0f} of {of:.0f} images are used, and their motions alone are degenerate, those of all are not"
    ),
    Kind.POSES_SWAPPED: "{images[0]} and {images[1]} have each other's gripper pose",
    Kind.POSE_CONTRADICTS_IMAGE: (
        "the gripper pose of {images[0]} is {mm:.0f} mm and {deg:.1f}° from where its image shows the gripper"
    ),
    Kind.NOT_REGISTERED: _not_registered,
    Kind.SAMPLE_REPEATED: "the image and the gripper pose are those of {images[0]}: not kept",
    Kind.POSE_UNIT: "the gripper would be {value:.4g} m from the base, as of a pose in {unit}: not kept",
    Kind.FRAME_REPEATED: (
        "the image is the same as {images[0]}, though the gripper moved by {mm:.0f} mm and {deg:.0f}°: not kept"
    ),
    Kind.SIZE_DIFFERS: "the image has {size} pixels, the others {before}: not kept",
    Kind.CLOCK_JUMPS: "the time of {images[0]} is {value:.3g} s before that of the image before it",
}
_REMEDY: dict[Kind, Words] = {
    Kind.UNOBSERVABLE: _to_observe,
    Kind.FEW_IMAGES: "take 8 or more",
    Kind.FEW_AGREE: "check that images and poses are paired, and how the poses are written (jcr docs captures)",
    Kind.POSES_CONTRADICT_IMAGES: "check the pairing, and how the poses are written (jcr docs captures)",
    Kind.POSE_CONVENTION: _given_remedy,
    Kind.UNCERTAIN: _to_be_sure,
    Kind.LEAVE_ONE_OUT: "add some",
    Kind.NOT_EXACT_ENOUGH: _to_be_exact,
    Kind.FOCUS_BY_DISTANCE: "lock the focus, or --focus varies",
    Kind.FOCUS_BY_IMAGE: "lock the focus and take the images again, or --focus varies",
    Kind.ZOOM: "calibrate the images before or after it, or --focus varies",
    Kind.ROLLING_SHUTTER: AT_REST,
    Kind.ROLLING_SHUTTER_BY_IMAGE: AT_REST,
    Kind.THIN_PRISM: "use the transform with the estimated intrinsics, which have the thin prism coefficients s1 to s4",
    Kind.CENTRE_SAGS: "switch image stabilisation off, or fix the optics",
    Kind.INTRINSICS: CALIBRATE_INTRINSICS,
    Kind.SLIP: _one_part,
    Kind.DRIFT: "tighten its mount, let it warm up, and take the images again",
    Kind.BASE_MOVED: _one_part,
    Kind.DELAY: "stop the arm at each image, or read pose and image by the same clock",
    Kind.WRONG_MOUNT: "write mount gripper for {camera}",
    Kind.LENGTHS: "check that axis (a lift, a rail, a gantry): its gear ratio, its unit",
    Kind.BASE_LEANS: "bolt the stand to the floor, or brace it",
    Kind.TOOL_SAGS: "stiffen its mount, and check the zero of the wrist's joints, which looks like it",
    Kind.BOARD_SIZE: _to_size,
    Kind.SCALES: _to_lengths,
    Kind.BOARD_SIDE: _to_board_side,
    Kind.BOARD_MOVED: "its corners there are left out; keep one board of a kind, and keep it still",
    Kind.BOARD_NOT_FOUND: "check its kind and its numbers of squares or corners (jcr docs markers)",
    Kind.NETWORK_SCALE: "check the unit of the gripper poses",
    Kind.SCALE_FROM_ROBOT: "the size of a board or --known-length would show it",
    Kind.IMAGES_ROTATED: (
        "for a driver that gives the sensor's own images remove the tag (exiftool -Orientation= FILES) and calibrate "
        "again"
    ),
    Kind.BOARD_IN_VIEW: _board_lengths,
    Kind.RECONSTRUCTION: _given_remedy,
    Kind.NO_RECONSTRUCTION: _given_remedy,
    Kind.FEW_POINTS_SHARED: "it must see the same scene, unchanged, from a direction not too different",
    Kind.FEW_LOCALISED: "add images of the mapped scene",
    Kind.ONE_GRIPPER_POSE: ("add an image at another gripper pose, or write mount base for a fixed camera"),
    Kind.FAR_FROM_GRIPPER: "check that it is on the gripper, and that the images are of the frames that they stand for",
    Kind.NOT_FIXED: "of a camera on the gripper write mount gripper, of several cameras give each its own name",
    Kind.PLACE_UNCERTAIN: _to_place,
    Kind.POINTS_CROWDED: "more of the scene in view would help",
    Kind.STATIC_IMAGES: (
        "check that the camera is on the gripper and its stream is live, and take each image at its own pose"
    ),
    Kind.BLURRED: "take them again at rest, in focus and with more light",
    Kind.FEW_USED: "let the views overlap more and show more texture, or use a board (jcr docs markers)",
    Kind.POSES_SWAPPED: "exchange the two poses",
    Kind.POSE_CONTRADICTS_IMAGE: "correct that pose, or drop the image",
    Kind.NOT_REGISTERED: "take such a view again, nearer to a pose that registered, with textured things in view",
    Kind.SAMPLE_REPEATED: "move the gripper, or press retake",
    Kind.POSE_UNIT: "divide the translation by {a_metre:.0f}",
    Kind.FRAME_REPEATED: "check that the camera's stream is live",
    Kind.SIZE_DIFFERS: "set the camera's old resolution, or name a new folder",
    Kind.CLOCK_JUMPS: "check that images and poses are stamped by one clock",
}
"""The remedy of each kind that has one."""
