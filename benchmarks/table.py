"""The benches: title, part of the index and subject of each."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Bench:
    """Row of the table of benches; each bench is a module of this package with a function `run`."""

    title: str
    """Title of its page."""
    part: str
    """Part of the index that lists it, one of PARTS."""
    what: str
    """Quantity that it measures."""
    timed: bool = False
    """Whether it measures time, so that nothing else may run beside it."""


ROBOTS, HONEST, MAPPED, TIME, OTHERS = PARTS = (
    "Real robots and captures",
    "Is the stated accuracy true, and are faults found?",
    "Depth, map and objects",
    "Time and memory",
    "Beside other methods",
)
BENCHES = {
    "run": Bench(
        "The whole job",
        TIME,
        "the whole job on the bundled capture: error, time and memory",
        True,
    ),
    "speed": Bench(
        "Processor time, beside COLMAP alone",
        TIME,
        "processor time of every stage on the bundled capture, beside COLMAP alone",
        True,
    ),
    "table1": Bench(
        "Few images, beside the paper",
        OTHERS,
        "hand-eye calibration from few images of three scenes, by the paper and by ours",
    ),
    "real": Bench(
        "Real captures",
        ROBOTS,
        "real captures in DIR, against the references stored beside them",
    ),
    "check_points": Bench(
        "Boards that took no part",
        ROBOTS,
        "corners of boards that took no part in the calibration, where it puts them in the base: captures in DIR",
    ),
    "boards": Bench(
        "A board beside features",
        ROBOTS,
        "features alone, a board alone and both in one adjustment: captures in DIR that --boards names, and simulated",
    ),
    "seen": Bench(
        "Points that the camera sees",
        HONEST,
        "points that the camera sees, in simulation: are they placed as exactly as is said?",
    ),
    "expected": Bench(
        "Expected before the run",
        HONEST,
        "what jcr check expects, against what the calibration reports: captures in DIR, and simulated",
    ),
    "matching": Bench(
        "Learned features on real captures",
        ROBOTS,
        "SIFT and XFeat on real captures in DIR, with the robot's gate and without",
    ),
    "cameras": Bench(
        "Further cameras",
        ROBOTS,
        "fixed cameras, several on a wrist, two arms, eye-to-hand: simulated, and withheld images of captures in DIR",
    ),
    "many": Bench(
        "Many images",
        TIME,
        "seconds and peak memory by number of images",
    ),
    "calibrate": Bench(
        "Hand-eye solvers",
        OTHERS,
        "hand-eye solvers on the same simulated poses, for accuracy and time",
    ),
    "robots": Bench(
        "Arms with systematic errors",
        HONEST,
        "arms with systematic errors: is the result within its sigma, and nearer than others'",
    ),
    "attack": Bench(
        "Silent faults",
        HONEST,
        "captures with one silent fault: reported, rejected, or wrong; and false alarms",
    ),
    "attack_images": Bench(
        "Faults from images on",
        HONEST,
        "images with one fault through jcr calibrate: named, rejected, or wrong; and false alarms",
    ),
    "table2": Bench(
        "Heights of objects",
        MAPPED,
        "heights of objects in simulated scenes, from 8 and 10 images",
    ),
    "depth": Bench(
        "Dense depth",
        MAPPED,
        "dense depth on simulated scenes: completeness, accuracy, map, by texture and reason",
        True,
    ),
    "map": Bench(
        "The map",
        MAPPED,
        "the map: accuracy of both presets, training, queries, distances, spheres beside python-fcl",
        True,
    ),
    "predictions": Bench(
        "The whole job from a network's pointmaps",
        OTHERS,
        "the whole job from pointmaps with a network's errors: error, honesty, map, time",
    ),
    "align": Bench(
        "Global alignment",
        OTHERS,
        "global alignment: fast against adam, in error, time and memory",
        True,
    ),
    "live": Bench(
        "Calibrated while capturing",
        HONEST,
        "images until 2 mm and 0.3° are claimed and confirmed, at proposed poses, varied ones, random ones and a grid",
    ),
    "live_real": Bench(
        "Fed image by image",
        HONEST,
        "captures in DIR fed image by image, against the same captures calibrated at once; seconds after each image",
        True,
    ),
}
"""In the order of the index."""
