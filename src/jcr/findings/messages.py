"""Table of the kinds of findings, each with its message, remedy, consequences and documentation."""

from dataclasses import dataclass
from enum import StrEnum

MISFIT = (
    "few images agree",
    "gripper poses contradict the images",
    "noise above the given one",
    "too uncertain",
    "leave-one-out error",
)
"""Kinds that are consequences of a rejecting fault of camera, robot, mount or image order: poses and images misfit."""
TOO_FEW = (
    "unobservable motion",
    "camera moved on the gripper",
    "camera drifts on the gripper",
    "robot base moved against the scene",
    "gripper poses early or late",
)
"""Kinds that are consequences in addition to MISFIT if too few of the images can be used."""
UNMATCHED = (*MISFIT, *TOO_FEW, "few images", "most images left out", "reconstruction")
"""Kinds that are consequences of images that cannot be matched with each other."""
ONE_PART = (
    "calibrate the {count:.0f} images {longer:before=up to {images[0]}|after=from {images[1]} on} alone; use the other "
    "images only if "
)
REACHED = (
    "a point seen at {distance_m:~} m is placed within {reached_mm:~} mm and {reached_deg:~}° in the robot's base frame "
    "(95 % of errors); "
    "{translation_mm:g} mm and {rotation_deg:g}° are required"
)
"""Template of the sentence with the reached and the required bound on 95 % of the errors."""
NEARER = "take two or more images 20 % nearer to or farther from the point that all views show"
ROTATED = "rotated by 20° or more about different axes"
TILT = "tilt the wrist by 20° or more away from {axis} in two images"
MOTIONS = {
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
        f"{TILT}, or give the camera's known height along it",
    ),
    "one axis, translation": ("translation along {axis}: all rotations are about it (one fixed axis)", TILT),
    "one axis, scale": (
        "scale: the camera moves on circles about one axis only",
        "move the gripper sideways and in height as well",
    ),
    "one axis, rotation": ("rotation of the camera about {axis}", TILT),
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
"""Templates of the unobservable direction and of its remedy, for each kind of degenerate motion."""
GROUPS = {
    "motion": "Motions, poses and accuracy",
    "camera": "The camera",
    "order": "Order of the images",
    "robot": "The robot",
    "strain": "Gripper poses that depend on the reach",
    "lengths": "Lengths and boards",
    "images": "Images by themselves",
    "reconstruction": "Images and reconstruction",
    "cell": "Further cameras",
    "single": "Single images",
}
"""Title of each group of kinds of findings in the documentation."""


@dataclass(frozen=True)
class KindRow:
    """Row of the table of findings for one kind: group, templates of message and remedy, kinds that it explains."""

    group: str
    """Group of the kind in the documentation, a key of GROUPS."""
    message: str
    """Template of the message in one sentence, filled with the values of finding.quantities."""
    remedy: str = ""
    """Template of the remedy in one sentence; empty if there is none or none is needed."""
    explains: tuple[str, ...] = ()
    """Kinds that are consequences of this kind if it rejects a calibration; empty for a kind that is no cause."""
    means: str = ""
    """Meaning of the kind in the documentation; empty if the message is enough."""
    help: str = ""
    """Remedy in the documentation; empty if `remedy` is enough."""


class FindingKind(StrEnum):
    """Kinds of findings; each member's value is its name, and `row` its row of the table."""

    row: KindRow

    def __new__(cls, name: str, row: KindRow) -> "FindingKind":
        """Make a member from its name and its row of the table; the name becomes the member's value."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.row = row
        return member

    # fmt: off
    UNOBSERVABLE = "unobservable motion", KindRow("motion",
        "{nearly:nearly unobservable|unobservable} from these motions: {direction}", "{concerns:motion={move}|}",
        means="the motions do not determine a direction of translation, rotation or scale",
        help="other motions; `details.motion` says what these are like")
    FEW_IMAGES = "few images", KindRow("motion", "with so few images ({value:.0f}) a wrong one cannot be identified",
        "take 8 or more")
    FEW_AGREE = "few images agree", KindRow("motion",
        "only {value:.0f} of {images:.0f} images agree on one calibration",
        "check the pairing of images and poses, and the pose convention (jcr docs captures)")
    POSES_CONTRADICT_IMAGES = "gripper poses contradict the images", KindRow("motion",
        "gripper poses and images disagree by {mm:.0f} mm and {rotation_deg:.1f}° per axis",
        "check the pairing of images and poses, and the pose convention (jcr docs captures)")
    POSE_CONVENTION = "pose convention", KindRow("motion",
        "the poses fit when read as {reading}: {fits}, instead of {given}", "{remedy}", explains=MISFIT,
        help="the option in `remedy`, or correct them at their source")
    INVERTED_PAIR = "inverted poses", KindRow("motion",
        "either the gripper poses or the marker poses are inverted, and pairs of poses do not tell which: the camera "
        "is {value:.3g} m from the gripper if the gripper poses are, and {other:.3g} m if the marker poses are ({fits})",
        "measure that distance, and write base_from_gripper and camera_from_marker into the file",
        explains=MISFIT)
    POSES_OF_CAMERA = "poses of the camera", KindRow("motion",
        "camera and gripper frame coincide within {mm:.1f} mm and {rotation_deg:.1f}°: these are poses of the camera "
        "itself, measured from a board for example, and not of the gripper",
        "give the gripper's poses in the robot's base", explains=MISFIT)
    NOISE_ABOVE_GIVEN = "noise above the given one", KindRow("motion",
        "gripper poses and images disagree by {mm:.2g} mm and {rotation_deg:.2g}° per axis, more than the given "
        "robot noise ({given_mm:.2g} mm, {given_rotation_deg:.2g}°); the larger is used",
        "check the mount, the pairing of images and poses, and the value of --robot-noise")
    UNCERTAIN = "too uncertain", KindRow("motion",
        "the {part} is known to ±{part:translation={mm:.0f} mm|rotation={deg:!.1f}°|scale={percent:.0f} %} only",
        f"add images, {ROTATED}{{noise_unknown:, or give the robot's repeatability (--robot-noise MM DEG)|}}",
        means="translation, rotation or scale (`details.part`) is less certain than 20 mm, 3° or 5 %")
    LEAVE_ONE_OUT = "leave-one-out error", KindRow("motion",
        "the leave-one-out error ({mm:.1f} mm) is well above the fit's residual ({residual_mm:.1f} mm): "
        "there are too few images for this motion", f"add images, {ROTATED}")
    NOT_CHECKED = "nothing checked", KindRow("motion",
        "the published method checks nothing: poses, intrinsics and motions may be wrong, and the result has no ±",
        "run the default method on the same capture, and compare (jcr compare)",
        means="the calibration is that of `--method paper`")
    NOT_EXACT_ENOUGH = "requirement not met", KindRow("motion", REACHED,
        f"{{concerns:images=add {{more_images:.0f}} more, {ROTATED}|robot=most of the error is systematic robot "
        "error: name the arm (--robot), or add joint angles and a URDF (jcr docs captures)|intrinsics=most of the error "
        "is due to intrinsics: give calibrated ones (--camera-info or capture.json), or add images at other distances, "
        "rolled about the optical axis|mount=part of the error is a change that a warning states: remove its cause and "
        "take the images again|none=more than 12 further images would be needed: move closer to the scene, or use a "
        "more accurate camera or robot}",
        means="the calibration is sound, and not as exact as `--require` states; the default is 5 mm and 1°",
        help="more images; or the arm's name")
    FOCUS_BY_DISTANCE = "focal length changes with distance", KindRow("camera",
        "the focal length {value:grows|shrinks} by {percent:!.1f} ± {std_percent:~} % from the nearest "
        "view to the farthest", "lock the focus", explains=MISFIT)
    FOCUS_BY_IMAGE = "focal length differs between images", KindRow("camera",
        "the focal length differs between images by {percent:~} % (rms, each ± {std_percent:~} %)",
        "lock the focus and take the images again", explains=MISFIT)
    ZOOM = "focal length changed once", KindRow("camera",
        "the focal length changes by {percent:+.1f} ± {std_percent:~} % after {images[0]}: the "
        "zoom or focus was moved", "calibrate the images before or after it", explains=MISFIT)
    ROLLING_SHUTTER = "images sheared alike", KindRow("camera",
        "the images are sheared by {value:.1f} ± {std:~} px from top to bottom, as by the rolling "
        "shutter of a moving camera", "take the images at rest", explains=MISFIT)
    THIN_PRISM = "thin prism", KindRow("camera",
        "the images show a thin-prism distortion of up to {value:.1f} ± {std:~} px: the sensor is "
        "tilted, or the lens is decentred",
        "use the transform with the estimated intrinsics, which have the coefficients s1 to s4", explains=MISFIT)
    INTRINSICS = "intrinsics contradict the images", KindRow("camera", "the {source} show {shown}",
        "{estimated:use the transform with the intrinsics of this calibration|calibrate the intrinsics again at this "
        "resolution, or give no intrinsics (null) to have them estimated}", explains=MISFIT,
        help="calibrate them again at this resolution, or give none (null) to have them estimated",
        means="the given intrinsics are not those of the images; parameters in `details`")
    SLIP = "camera moved on the gripper", KindRow("order",
        "the camera seems to have moved on the gripper, or the TCP to have changed, by {mm:.1f} mm and "
        "{rotation_deg:.2f}° after {images[0]}",
        ONE_PART + "camera mount and TCP are still as in them", explains=MISFIT)
    DRIFT = "camera drifts on the gripper", KindRow("order",
        "the camera seems to drift on the gripper by {mm:.1f} mm and {rotation_deg:.2f}° from the first image to "
        "the last", "tighten the camera's mount, let the camera warm up, and take the images again", explains=MISFIT)
    BASE_MOVED = "robot base moved against the scene", KindRow("order",
        "the robot's base and the scene moved against each other by {mm:.1f} mm and {rotation_deg:.2f}° after "
        "{images[0]}", ONE_PART + "base and scene are still as in them", explains=MISFIT)
    DELAY = "gripper poses early or late", KindRow("order",
        "the gripper poses look as if read {value:!.3f} ± {std:~} of the time from one image to the next too "
        "{value:late|early}", "stop the arm at each image, or read pose and image by the same clock",
        explains=MISFIT)
    WRONG_MOUNT = "wrong mount", KindRow("robot",
        "the images fit a camera that the gripper carries, not a fixed one",
        "set mount: gripper for {camera} in capture.json", explains=MISFIT)
    ROBOT_UNUSED = "robot not used", KindRow("robot", "the capture's robot is not used: {text}",
        "correct the robot's name, URDF or joint angles")
    JOINT_OFFSETS = "joint offsets", KindRow("robot", "robot: {shown}",
        "master the joints",
        means="`joints` are off; each in `details`")
    SMOOTH_ERRORS = "gripper poses err smoothly", KindRow("robot",
        "the gripper poses err smoothly by {mm:.1f} mm and {rotation_deg:.2f}° per axis; the leave-one-out error "
        "({held_out_mm:.2f} mm) does not show it, because near poses share their errors{joint_deg:. Joints of this arm "
        "would be off by $°}",
        "take the poses of the robot's controller, not those computed from nominal lengths; spread the views",
        means="the estimated smooth errors of the poses are five times the leave-one-out error or more")
    LENGTHS = "robot lengths differ by direction", KindRow("strain",
        "along {axis} the robot's positions are {percent:!.1f} ± {std_percent:~} % too {value:long|short} "
        "compared with those across it",
        "check that axis (a lift, a rail, a gantry): its gear ratio, its unit", explains=MISFIT)
    BASE_LEANS = "robot base leans with reach", KindRow("strain",
        "the robot's base leans {value:towards|away from} the gripper by {deg:!.1f} ± {std_deg:~}° per "
        "metre of reach, and the reported poses do not contain this",
        "bolt the stand to the floor, or brace it", explains=MISFIT)
    TOOL_SAGS = "tool sags", KindRow("strain",
        "the gripper rotates by {deg:!.2f} ± {std_deg:~}° where it is level, as by a tool that sags "
        "under its weight",
        "stiffen the tool's mount, and check the zero of the wrist's joints, which has the same effect", explains=MISFIT)
    BOARD_SIZE = "board size contradicts the robot", KindRow("lengths",
        "by the robot's motion the {marker:marker|board} is {percent:!.1f} ± {std_percent:~} % {value:larger|smaller} "
        "than given",
        "measure its squares, and check that the gripper poses are in metres", explains=MISFIT)
    SCALES = "lengths contradict each other", KindRow("lengths",
        "{one} and {other} contradict each other by {percent:!.1f} ± {std_percent:~} %",
        "measure both again", explains=MISFIT,
        means="two of what the scale is known from (`details.one`, `details.other`: robot, board, "
        "depth camera, network) differ by more than they may")
    BOARD_SIDE = "side of a board", KindRow("lengths",
        "by the robot's positions the sides of {board} are {mm:.2f} ± {std_mm:.2f} mm",
        "measure one side and give it in --board: the scale is then known from the robot and from the board")
    BOARD_MOVED = "board at several places", KindRow("lengths",
        "in {images} {board} is at another place than in the other images: it was moved, the robot holds it, or "
        "there are two",
        "keep one board of each kind and do not move it; its corners in these images are hardly used")
    BOARD_STRETCHED = "board stretched", KindRow("lengths",
        "{board} is {percent:!.1f} ± {std_percent:~} % longer along one side than along the other: it was not printed "
        "at its size",
        "print it without scaling (jcr board) and measure both sides; its size is not used for the scale")
    BOARD_BENT = "board bent", KindRow("lengths",
        "{board} is bent: its highest corner is {mm:.1f} mm above its lowest one; its shape is estimated",
        help="nothing for this calibration; mount the board on a flat plate for methods that take it as flat")
    BOARD_NOT_FOUND = "board not found", KindRow("lengths",
        "no two images show {board}: features alone are used{proposed:, but the images seem to show $}",
        "check its kind and its numbers of squares or corners (jcr docs markers)",
        means="no two images show what `--board` names; `details.proposed` is what they seem to show")
    NETWORK_SCALE = "a network's metre contradicts the robot", KindRow("lengths",
        "the network's own lengths are {percent:!.3g} ± {std_percent:~} % too {value:long|short} compared with the "
        "robot's", "check the unit of the gripper poses", means="by far more than networks err")
    SCALE_ASSUMED = "scale assumed", KindRow("lengths",
        "the scale is unobservable from these motions: it is taken as 1, from the marker's size",
        f"translate the gripper in all directions, and add samples {ROTATED}")
    SCALE_FROM_ROBOT = "scale from the robot alone", KindRow("lengths",
        "the scale comes from the robot's positions alone: if all of them are wrong by one factor, no "
        "image shows it, and ± does not include it", "to test it, add a board of known size (--board)")
    BOARD_IN_VIEW = "board in view", KindRow("reconstruction", "a calibration board is in view",
        "try --board {board} with its SIDE in metres, or for tags of a ChArUco board "
        "charuco:COLUMNSxROWS:SIDE:MARKER:DICTIONARY (jcr docs markers)")
    RECONSTRUCTION = "reconstruction", KindRow("reconstruction", "{text}", "{remedy:$}",
        means="what a back end says to act on, in words", help="in its words")
    NO_RECONSTRUCTION = "no reconstruction", KindRow("reconstruction", "{text}", "{remedy}",
        means="no back end found camera poses", help="in its words")
    NOT_SETTLED = "adjustment not settled", KindRow("reconstruction",
        "the adjustment has not converged: its last round moved the result by {value:.2g} standard deviations",
        "add images of textured objects at rest")
    OWN_REJECTED = "the capture's own camera is rejected", KindRow("cell",
        "the {camera} camera's own calibration is rejected", "correct that calibration first")
    FEW_POINTS_SHARED = "few points shared with the scene", KindRow("cell",
        "{images[0]} shares too few points with the mapped scene ({value:.0f})",
        "take an image of the unchanged scene from a similar direction")
    BOARD_NEEDED = "no board before several cameras", KindRow("cell",
        "cameras that watch the gripper are located together by a board that it carries, and none was found",
        "put a board into the gripper and name it (--board)")
    FEW_LOCALISED = "few images localised", KindRow("cell",
        "{value:.0f} of its images share enough of the mapped scene; {needed:.0f} are needed",
        "add images of the mapped scene")
    NO_COMMON_POSE = "no image taken with one that is used", KindRow("cell",
        "none of its images was taken with an image that is used",
        "add images at gripper poses of used images")
    ONE_GRIPPER_POSE = "camera seen at one gripper pose", KindRow("cell",
        "its images show one gripper pose only: whether it is on the gripper, and at which frame each "
        "image was taken, cannot be tested",
        "add an image at another gripper pose, or set mount: base for a fixed camera")
    SECOND_ON_ARM = "second camera on another arm", KindRow("cell",
        "arm {arm} has a second camera, and one is supported", "calibrate that camera in a capture of its own")
    NOT_FIXED = "camera not fixed", KindRow("cell",
        "{images[0]} and {images[1]} were taken from places {mm:.0f} mm and {rotation_deg:.1f}° apart: the camera is "
        "not fixed", "set mount: gripper for a camera on the gripper, or give each of several cameras its own name")
    NOT_RIGID = "camera not rigid on the gripper", KindRow("cell",
        "its place relative to the {camera} camera differs by up to {mm:.0f} mm between images: a mount is not "
        "rigid, or images belong to other frames",
        "tighten the mounts, and check that each image belongs to its frame")
    IMAGE_MISSES = "image contradicts the camera's place", KindRow("cell",
        "{images[0]} contradicts the common place of all images by {value:.0f} px (median): the camera is not {mount:"
        "base=fixed|gripper=rigid on the gripper}, the scene changed, or the intrinsics are wrong",
        "tighten the mount, or remove the image")
    PLACE_UNCERTAIN = "camera's place too uncertain", KindRow("cell",
        "its place is known only to ±{mm:.0f} mm and {rotation_deg:.1f}°{focal_std_percent:, because its images do not "
        "determine its intrinsics (focal length ± $ %)}",
        "{concerns:intrinsics=give the intrinsics, or add images with more of the scene at other depths|images=let it "
        "see more of the mapped scene, or add images to the wrist camera's capture}",
        means="a further camera is known worse than to 20 mm and 3°",
        help="intrinsics, or more images")
    AT_ANOTHER_CAMERA = "camera stands where another was", KindRow("cell",
        "it is at the place of the {camera} camera at {images[0]}, so its image may be one of that camera",
        "check that the image is of the fixed camera")
    STATIC_IMAGES = "images show no motion", KindRow("images",
        "all images show the same view, while the gripper moves by {mm:.0f} mm and rotates "
        "by {rotation_deg:.0f}°",
        "check that the camera is on the gripper and its stream is live, and take each image at its own pose",
        explains=UNMATCHED)
    BLURRED = "images blurred", KindRow("images", "{images} {images:is|are} blurred (edges {value:.0f} px wide)",
        "take them again at rest, in focus and with more light", explains=UNMATCHED,
        means="the strongest edges of these `images` climb over more than 1/80 of the long side; rejects "
        "where a quarter of all are and the calibration is rejected")
    REPETITIVE = "repetitive scene", KindRow("images",
        "the scene repeats itself: {percent:.0f} % of the features look like others of the same image, so that images "
        "may be matched in the wrong places",
        "put different, textured objects on the table", explains=UNMATCHED,
        means="regular tiles or patterns; rejects where the calibration is rejected")
    HALF_UNUSED = "most images left out", KindRow("images",
        "only {value:.0f} of {of:.0f} images are used: {lost:.0f} not registered, {wrong:.0f} in contradiction to "
        "the others",
        "check the unused images and their poses; take more images that overlap"),
    FEW_USED = "few images used", KindRow("reconstruction",
        "only {value:.0f} of {of:.0f} images are used, whose motions alone are degenerate; those of "
        "all images are not", "take views that overlap more and show more texture, or use a board (jcr docs markers)",
        explains=(*MISFIT, *TOO_FEW))
    PIECES = "reconstruction in pieces", KindRow("reconstruction",
        "the reconstruction is in pieces: {value:.0f} of {of:.0f} images, such as {images[0]}, agree with their gripper "
        "poses among themselves and contradict the other images",
        "avoid patterns that repeat, as of a board alone, or name the board (--board); let the views overlap more",
        explains=MISFIT)
    POSES_SWAPPED = "gripper poses exchanged", KindRow("single",
        "{images} have each other's gripper poses", "correct the pairing of images and poses", explains=MISFIT)
    POSE_CONTRADICTS_IMAGE = "gripper pose contradicts its image", KindRow("single",
        "the gripper pose of {images[0]} is {mm:.0f} mm and {rotation_deg:.1f}° from where its image shows the "
        "gripper", "correct that pose, or remove the image")
    NOT_REGISTERED = "image not registered", KindRow("single",
        "{images} {images:is|are} not registered, with matches to {value:.0f} of the other images"
        "{concerns:images=: too little overlap|poses= that show another rotation than the reported gripper poses}",
        "{concerns:images=take the view again, nearer to the pose of a registered image, with textured objects in view|"
        "poses=check the pose of this image, or take it again}",
        means="while a capture is taken (`jcr capture`): its camera is not in the reconstruction",
        help="take the view again nearer to a registered one; where its matches contradict its pose, check the pose")
    # fmt: on


def kinds_of(*groups: str) -> frozenset[FindingKind]:
    """Return the kinds of findings that belong to the named groups (keys of GROUPS)."""
    return frozenset(kind for kind in FindingKind if kind.row.group in groups)
