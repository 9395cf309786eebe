"""Findings in words, and nothing else: one sentence of what was found, one of what would help.

Beside the records, for `warnings` of a calibration are these sentences. Nothing is decided by them.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jcr.records.findings import Finding, Kind
from jcr.rounding import significant

if TYPE_CHECKING:
    from jcr.records.calibration import Requirement

SHORT = "not as exact as needed"
SURE = 4.0
"""Standard deviations from which a parameter of the intrinsics is named by itself."""
CALIBRATE_INTRINSICS = (
    "calibrate the intrinsics again at this resolution, or give no intrinsics (null) to have them estimated"
)
AT_REST = "take the images at rest"
NEARER = "take two or more images 20 % nearer to or farther from the point you look at"
PAIRS = (
    (("fx", "fy"), "focal lengths of", " px", 1),
    (("cx", "cy"), "a principal point of", " px", 1),
    (("k1", "k2"), "a distortion k1, k2 of", "", 3),
    (("p1", "p2"), "a distortion p1, p2 of", "", 4),
)
"""Parameters of intrinsics that are named together, how, their unit and their decimals."""


def text(finding: Finding) -> str:
    """What was found, in one sentence."""
    return _TEXT[finding.kind](finding)


def remedy(finding: Finding) -> str:
    """What would help, in one sentence; empty where nothing would, or nothing need be done."""
    say = _REMEDY.get(finding.kind, "")
    return say if isinstance(say, str) else say(finding)


def sentence(finding: Finding) -> str:
    """Both in one line."""
    return "; ".join(filter(None, (text(finding), remedy(finding))))


def reached_in_words(required: "Requirement") -> str:
    """What 95 % of the errors stay below, and whether that is what was asked."""
    return _reached(vars(required))


def _reached(required: Mapping[str, Any]) -> str:
    far = required["distance_mm"]
    where = f" {significant(far, 3)} mm ahead of the camera" if far else ""
    asked = "asked for" if required["asked"] else "needed to grasp"
    return (
        f"95 % of errors are below {significant(required['reached_mm'])} mm{where} and "
        f"{significant(required['reached_deg'])}°; {required['translation_mm']:g} mm and "
        f"{required['rotation_deg']:g}° are {asked}"
    )


def network_scale(off_percent: float, std_percent: float) -> str:
    """How far a network's own scale is from the robot's, and how sure that is."""
    off, std = off_percent, std_percent
    if abs(off) < 2 * std:
        return f"the network's own metre agrees with the robot's ({off:+.2g} ± {std:.2g} %)"
    if off > 100:
        return f"the network's own lengths are {1 + off / 100:.3g} times the robot's"
    direction = "long" if off > 0 else "short"
    return f"the network's own lengths are {abs(off):.3g} ± {std:.2g} % too {direction} compared with the robot's"


def joined(words: Iterable[str]) -> str:
    """A list as one says it."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def _number(finding: Finding, name: str) -> float:
    value = finding.details[name]
    assert isinstance(value, int | float), name
    return float(value)


def _value(finding: Finding) -> float:
    assert finding.value is not None, finding.kind
    return finding.value


def _std(finding: Finding) -> float:
    assert finding.std is not None, finding.kind
    return finding.std


def _mm(finding: Finding, digits: str = ".1f") -> str:
    return f"{1e3 * _value(finding):{digits}} mm"


def _deg(finding: Finding, digits: str = ".2f") -> str:
    return f"{np.degrees(_number(finding, 'rotation')):{digits}}°"


def _chance(finding: Finding) -> str:
    assert finding.p is not None, finding.kind
    return f"p = {finding.p:.0e}"


def _stated(finding: Finding) -> str:
    return str(finding.details["text"])


def _stated_remedy(finding: Finding) -> str:
    return str(finding.details.get("remedy", ""))


# Motion.


def unobservable(finding: Finding) -> str:
    """The direction that is unobservable, in words."""
    grade = "nearly unseen: " if finding.details.get("nearly") else ""
    return grade + _UNSEEN[str(finding.details["motion"])][0].format(**_of_axis(finding))


def _to_observe(finding: Finding) -> str:
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
    "one axis, translation": (
        "translation along {axis}: all rotations are about it (one fixed axis)",
        _TILT,
    ),
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
"""By what the motions are like: what is unobservable, and the remedy."""


# Poses and images.


def _uncertain(finding: Finding) -> str:
    part, std = str(finding.details["part"]), _value(finding)
    size = {
        "translation": f"{1e3 * std:.0f} mm",
        "rotation": f"{np.degrees(std):.1f}°",
        "scale": f"{100 * std:.0f} %",
    }
    return f"the {part} is known to ±{size[part]} only"


def _to_be_sure(finding: Finding) -> str:
    tell = ", or give the robot's repeatability (--robot-noise MM DEG)"
    return (
        "add images, rotated by 20° or more about different axes"
        f"{tell if finding.details.get('noise_unknown') else ''}"
    )


def _noisier(finding: Finding) -> str:
    given = f"{1e3 * _number(finding, 'given'):.2g} mm, {np.degrees(_number(finding, 'given_rotation')):.2g}°"
    return (
        f"gripper poses and images disagree by {_mm(finding, '.2g')} and {_deg(finding, '.2g')} per axis, more than the "
        f"given robot noise ({given}): the larger is used"
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


def _left_out(finding: Finding) -> str:
    typical = 1e3 * _number(finding, "residual")
    return (
        f"the leave-one-out error ({_mm(finding)}) is well above the fit's residual ({typical:.1f} mm): too few images "
        "for this motion"
    )


# The camera.


def _by_distance(finding: Finding) -> str:
    percent = 100 * _value(finding)
    return (
        f"the focal length {'grows' if percent > 0 else 'shrinks'} by {abs(percent):.1f} ± "
        f"{significant(100 * _std(finding))} % from the nearest view to the farthest ({_chance(finding)})"
    )


def _zoomed(finding: Finding) -> str:
    return (
        f"the focal length changes by {100 * _value(finding):+.1f} ± {significant(100 * _std(finding))} % after "
        f"{finding.images[0]} ({_chance(finding)}): the zoom or focus was moved"
    )


def _intrinsics(finding: Finding) -> str:
    said = _of_image_parts(finding) if finding.p is None else _of_parameters(finding)
    chance = "" if finding.p is None else f" ({_chance(finding)})"
    return f"the images show {' and '.join(said)}{chance}"


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


def _slipped(finding: Finding) -> str:
    size = f"{_mm(finding)} and {_deg(finding)}"
    return f"the camera seems to have moved on the gripper by {size} after {finding.images[0]} ({_chance(finding)})"


def _one_part(finding: Finding) -> str:
    count = int(_number(finding, "count"))
    before, after = finding.images
    part = {
        "before": f"the {count} images up to {before}",
        "after": f"the {count} images from {after} on",
    }[str(finding.details["longer"])]
    return (
        f"calibrate {part} alone, and those of the other part only where the camera still sits as it did then"
    )


def _delayed(finding: Finding) -> str:
    value, error = _value(finding), _std(finding)
    how = f"{abs(value):.3f} ± {significant(error)} of the time from one image to the next"
    if finding.details["unit"] == "s":
        how = f"{1e3 * abs(value):.0f} ± {significant(1e3 * error)} ms"
    late = "late" if value > 0 else "early"
    return f"the gripper poses look as if read {how} too {late} ({_chance(finding)})"


# The robot.


def _rough_chance(finding: Finding) -> str:
    assert finding.p is not None
    return f"p = {finding.p:.1g}" if finding.p > 1e-6 else "p < 1e-6"


def _joints_off(finding: Finding) -> str:
    sizes = joined(
        f"{np.degrees(_number(finding, f'joint_{k}')):+.2f} ± {np.degrees(_number(finding, f'joint_{k}_std')):.2f}°"
        for k in finding.joints
    )
    named = joined(str(k) for k in finding.joints)
    return f"robot: joint{'s' * (len(finding.joints) > 1)} {named} seem off by {sizes} ({_rough_chance(finding)})"


def _angles_differ(finding: Finding) -> str:
    off, std = _value(finding) - 1, _std(finding)
    return (
        f"the camera rotates {100 * abs(off):.2f} ± {100 * std:.2f} % {'more' if off > 0 else 'less'} than the gripper: "
        "the focal length or the robot's joints are off"
    )


# Scale.


def _board_size(finding: Finding) -> str:
    off = _value(finding)
    if finding.details.get("marker"):
        scale = 1 + off
        size = f"{100 * abs(1 / scale - 1):.1f} % too {'large' if scale < 1 else 'small'}"
        return (
            f"the scale is {scale:.4f} where a marker of known size gives 1: its size was given {size}, or the camera's "
            "focal length is off"
        )
    return (
        f"by the robot's motion the board is {100 * abs(off):.1f} ± {100 * _std(finding):.1f} % "
        f"{'larger' if off > 0 else 'smaller'} than given"
    )


def _board_in_view(finding: Finding) -> str:
    board = str(finding.details["board"])
    lengths = "SIDE of a square and MARKER" if "MARKER" in board else "SIDE"
    return f"try --board {board} with its {lengths} in metres (jcr docs markers)"


_TEXT: dict[Kind, Callable[[Finding], str]] = {
    Kind.UNOBSERVABLE: lambda f: f"unobservable from these motions: {unobservable(f)}",
    Kind.FEW_IMAGES: lambda f: f"with {_value(f):.0f} images a wrong one cannot be identified",
    Kind.FEW_AGREE: lambda f: (
        f"only {_value(f):.0f} of {_number(f, 'images'):.0f} images agree on one calibration"
    ),
    Kind.POSES_CONTRADICT_IMAGES: lambda f: (
        f"gripper poses and images disagree by {_mm(f, '.0f')} and {_deg(f, '.1f')} per axis"
    ),
    Kind.POSE_CONVENTION: lambda f: (
        f"the poses fit when read as {f.details['reading']}: {f.details['fits']}, instead of {f.details['given']}"
    ),
    Kind.NOISE_ABOVE_GIVEN: _noisier,
    Kind.UNCERTAIN: _uncertain,
    Kind.LEAVE_ONE_OUT: _left_out,
    Kind.NOT_EXACT_ENOUGH: lambda f: f"{SHORT}: {_reached(f.details)}",
    Kind.FOCUS_BY_DISTANCE: _by_distance,
    Kind.FOCUS_BY_IMAGE: lambda f: (
        f"the focal length differs between images by {100 * _value(f):.1f} % (rms, each ± "
        f"{significant(100 * _std(f))} %; {_chance(f)})"
    ),
    Kind.ZOOM: _zoomed,
    Kind.ROLLING_SHUTTER: lambda f: (
        f"the images are sheared by {_value(f):.1f} ± {significant(_std(f))} px from top to bottom ({_chance(f)}), as "
        "by the rolling shutter of a moving camera"
    ),
    Kind.ROLLING_SHUTTER_BY_IMAGE: lambda f: (
        f"each image is sheared by itself, {_value(f):.1f} px from top to bottom (rms, {_chance(f)}), as by the rolling "
        "shutter of a moving camera"
    ),
    Kind.INTRINSICS: _intrinsics,
    Kind.SLIP: _slipped,
    Kind.DRIFT: lambda f: (
        f"the camera seems to drift on the gripper by {_mm(f)} and {_deg(f)} from the first image to the last "
        f"({_chance(f)})"
    ),
    Kind.DELAY: _delayed,
    Kind.WRONG_MOUNT: lambda f: "the images fit a camera that the gripper carries, not a fixed one",
    Kind.ROBOT_UNUSED: lambda f: f"the capture's robot is not used: {_stated(f)}",
    Kind.SYSTEMATIC_ERRORS: lambda f: (
        f"robot: neighbouring poses have similar errors, {_mm(f, '.2g')} and {_deg(f, '.2g')} per axis "
        f"({_rough_chance(f)}): joint offsets or link errors"
    ),
    Kind.JOINT_OFFSETS: _joints_off,
    Kind.ANGLE_RATIO: _angles_differ,
    Kind.BOARD_SIZE: _board_size,
    Kind.NETWORK_SCALE: lambda f: network_scale(100 * _value(f), 100 * _std(f)),
    Kind.SCALE_ASSUMED: lambda f: (
        "the scale is unobservable from these motions: it is taken as 1, from the marker's size"
    ),
    Kind.SCALE_FROM_ROBOT: lambda f: (
        "the scale comes from the robot's positions alone: if all of them are wrong by one factor, no image shows it, "
        "and ± does not include it"
    ),
    Kind.IMAGES_ROTATED: lambda f: (
        f"EXIF orientation {_value(f):.0f}: the images are {f.details['rotated']}, as viewers show them, and "
        "gripper_from_camera and the intrinsics are of the camera that would see them so"
    ),
    Kind.BOARD_IN_VIEW: lambda f: "a calibration board is in view",
    Kind.RECONSTRUCTION: _stated,
    Kind.NO_RECONSTRUCTION: _stated,
    Kind.EARLIER_VERSION: _stated,
}
_REMEDY: dict[Kind, str | Callable[[Finding], str]] = {
    Kind.UNOBSERVABLE: _to_observe,
    Kind.FEW_IMAGES: "take 8 or more",
    Kind.FEW_AGREE: "check that images and poses are paired, and the convention of the poses (jcr check)",
    Kind.POSES_CONTRADICT_IMAGES: "check the pairing and the convention of the poses (jcr check)",
    Kind.POSE_CONVENTION: _stated_remedy,
    Kind.UNCERTAIN: _to_be_sure,
    Kind.LEAVE_ONE_OUT: "add some",
    Kind.NOT_EXACT_ENOUGH: _to_be_exact,
    Kind.FOCUS_BY_DISTANCE: "lock the focus, or --focus varies",
    Kind.FOCUS_BY_IMAGE: "lock the focus and take the images again, or --focus varies",
    Kind.ZOOM: "calibrate the images before or after it, or --focus varies",
    Kind.ROLLING_SHUTTER: AT_REST,
    Kind.ROLLING_SHUTTER_BY_IMAGE: AT_REST,
    Kind.INTRINSICS: CALIBRATE_INTRINSICS,
    Kind.SLIP: _one_part,
    Kind.DRIFT: "tighten its mount, let it warm up, and take the images again",
    Kind.DELAY: "stop the arm at each image, or read pose and image by the same clock",
    Kind.WRONG_MOUNT: lambda f: f"write mount gripper for {f.details['camera']}",
    Kind.BOARD_SIZE: lambda f: (
        ""
        if f.details.get("marker")
        else "measure its squares, and check that the gripper poses are in metres"
    ),
    Kind.NETWORK_SCALE: "check the unit of the gripper poses",
    Kind.SCALE_FROM_ROBOT: "the size of a board or --known-length would show it",
    Kind.IMAGES_ROTATED: (
        "for a driver that gives the sensor's own images remove the tag (exiftool -Orientation= FILES) and calibrate "
        "again"
    ),
    Kind.BOARD_IN_VIEW: _board_in_view,
    Kind.RECONSTRUCTION: _stated_remedy,
    Kind.NO_RECONSTRUCTION: _stated_remedy,
    Kind.EARLIER_VERSION: _stated_remedy,
}
