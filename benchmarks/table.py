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
    "real": Bench(
        "Real captures",
        ROBOTS,
        "Real captures against references, their halves, and boards that took no part.",
    ),
    "features": Bench(
        "Features on real captures",
        ROBOTS,
        "SIFT and XFeat on real captures, with the robot's gate and without it.",
    ),
    "cameras": Bench(
        "Several cameras", ROBOTS, "Fixed cameras, second wrist cameras, second arms and eye-to-hand."
    ),
    "coverage": Bench(
        "Is ± true?", HONEST, "Shares of errors inside the stated uncertainty, and predicted uncertainty."
    ),
    "faults": Bench("Faults", HONEST, "Captures with one fault each, and captures without a fault."),
    "live": Bench(
        "Live calibration",
        HONEST,
        "Images until a claimed accuracy is confirmed, and live beside at once.",
        True,
    ),
    "map": Bench(
        "The map", MAPPED, "Map, dense depth and heights of objects, against simulated truth.", True
    ),
    "speed": Bench("Speed", TIME, "Processor time and memory of jobs and stages, beside COLMAP alone.", True),
    "peers": Bench(
        "Peers", OTHERS, "Hand-eye solvers, images and global alignment beside other methods.", True
    ),
    "kinhec": Bench("KinHEC", OTHERS, "Hand-eye solvers on KinHEC's tier small by its own protocol."),
    "pointmaps": Bench("Pointmaps", OTHERS, "The whole job from pairwise pointmaps with a network's errors."),
}
"""Benches in the order of the index."""
