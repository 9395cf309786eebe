"""The benches: what each measures, where its page stands in the index, and what makes that page old."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Bench:
    """A row of the table of benches, a module of this package each."""

    title: str
    """Of its page."""
    part: str
    """Of the index that its page belongs to, one of PARTS."""
    what: str
    """What it measures."""
    timed: bool = False
    """Measures time, so that nothing else may run beside it."""
    draws: bool = False
    """Writes images beside its page."""
    of_captures: bool = False
    """Asks for the folder of captures."""
    of_boards: bool = False
    """And takes --boards."""
    keeps_runs: bool = False
    """Takes --runs."""
    measures: tuple[str, ...] = ()
    """Files and folders whose change makes its page old, beside the bench's own."""
    long: str = ""
    """What `--long` measures more of, for which `all` has no time."""


ROBOTS, HONEST, MAPPED, TIME, OTHERS = PARTS = (
    "Real robots and captures",
    "Is the stated accuracy true, and are faults found?",
    "Depth, map and objects",
    "Time and memory",
    "Beside other methods",
)
SOLVER = (
    "src/jcr/estimation",
    "src/jcr/calibration",
    "src/jcr/camera.py",
    "src/jcr/geometry.py",
    "src/jcr/least_squares.py",
)
FEATURES = (
    "src/jcr/match",
    "src/jcr/reconstruct/colmap.py",
    "src/jcr/reconstruct/sfm.py",
    "src/jcr/attempts.py",
)
DEPTH = ("src/jcr/depth", "src/jcr/reconstruct/pointmaps.py")
MAP = ("src/jcr/represent", "src/jcr/mapping.py")
READING = ("src/jcr/capture",)
LIVE = (
    "src/jcr/reconstruct/growing.py",
    "src/jcr/live/calibration.py",
    "src/jcr/live/next_pose.py",
)
WHOLE = (*SOLVER, *FEATURES, *DEPTH, *MAP, *READING, "src/jcr/pipeline.py", "src/jcr/report")


BENCHES = {
    "run": Bench(
        "The whole job",
        TIME,
        "the whole job on the bundled capture: error, time and memory",
        True,
        measures=WHOLE,
        long="the median of three",
    ),
    "speed": Bench(
        "Processor time, beside COLMAP alone",
        TIME,
        "processor time of every stage on the bundled capture, beside COLMAP alone",
        True,
        measures=WHOLE,
        long="the median of five rounds instead of three, and 200 images",
    ),
    "table1": Bench(
        "Few images, beside the paper",
        OTHERS,
        "hand-eye calibration from few images of three scenes, by the paper and by ours",
        measures=(*SOLVER, *FEATURES, "src/jcr/reconstruct/global_alignment", "simulation"),
        long="two captures behind each line instead of one",
    ),
    "real": Bench(
        "Real captures",
        ROBOTS,
        "real captures in DIR, against the references stored beside them",
        of_captures=True,
        of_boards=True,
        measures=(
            *SOLVER,
            *FEATURES,
            *READING,
            "src/jcr/reconstruct/direct",
            "src/jcr/reconstruct/marker.py",
            "src/jcr/reconstruct/board.py",
        ),
    ),
    "check_points": Bench(
        "Boards that took no part",
        ROBOTS,
        "corners of boards that took no part in the calibration, where it puts them in the base: captures in DIR",
        of_captures=True,
        of_boards=True,
        keeps_runs=True,
        measures=(
            *SOLVER,
            *FEATURES,
            *READING,
            "src/jcr/reconstruct/direct",
            "src/jcr/reconstruct/board.py",
            "src/jcr/reconstruct/board_in_view.py",
            "benchmarks/corners.py",
        ),
    ),
    "boards": Bench(
        "A board beside features",
        ROBOTS,
        "features alone, a board alone and both in one adjustment: captures in DIR that --boards names, and simulated",
        of_captures=True,
        of_boards=True,
        keeps_runs=True,
        measures=(
            *SOLVER,
            *FEATURES,
            *READING,
            "src/jcr/reconstruct/marker.py",
            "src/jcr/reconstruct/board.py",
            "src/jcr/reconstruct/board_corners.py",
            "simulation/boards.py",
            "simulation/faults.py",
        ),
        long="40 draws of every simulated row instead of 2",
    ),
    "seen": Bench(
        "Points that the camera sees",
        HONEST,
        "points that the camera sees, in simulation: are they placed as exactly as is said?",
        measures=(*SOLVER, "simulation"),
        long="40 draws of every row instead of 10",
    ),
    "expected": Bench(
        "Expected before the run",
        HONEST,
        "what jcr check expects, against what the calibration reports: captures in DIR, and simulated",
        of_captures=True,
        measures=(
            *SOLVER,
            *FEATURES,
            *READING,
            "src/jcr/check.py",
            "simulation",
            "benchmarks/seen.py",
        ),
    ),
    "matching": Bench(
        "Learned features on real captures",
        ROBOTS,
        "SIFT and XFeat on real captures in DIR, with the robot's gate and without",
        of_captures=True,
        of_boards=True,
        measures=(*SOLVER, *FEATURES, *READING),
        long="all captures, SIFT with and without the gate, and XFeat without it, too",
    ),
    "cameras": Bench(
        "Further cameras",
        ROBOTS,
        "fixed cameras, several on a wrist, two arms, eye-to-hand: simulated, and withheld images of captures in DIR",
        of_captures=True,
        measures=(*SOLVER, *FEATURES, *READING, "src/jcr/cell", "simulation"),
        long="40 draws of every kind of cell instead of 10",
    ),
    "many": Bench(
        "Many images",
        TIME,
        "seconds and peak memory by number of images",
        measures=(*SOLVER, *FEATURES, *DEPTH, "simulation"),
        long="up to 200 images instead of 32",
    ),
    "calibrate": Bench(
        "Hand-eye solvers",
        OTHERS,
        "hand-eye solvers on the same simulated poses, for accuracy and time",
        draws=True,
        measures=("src/jcr/estimation", "simulation/problem.py"),
        long="15 draws instead of 4",
    ),
    "robots": Bench(
        "Arms with systematic errors",
        HONEST,
        "arms with systematic errors: is the result within its sigma, and nearer than others'",
        draws=True,
        measures=("src/jcr/estimation", "simulation/robots.py", "simulation/problem.py"),
        long="8 draws of every arm instead of 1",
    ),
    "attack": Bench(
        "Silent faults",
        HONEST,
        "captures with one silent fault: reported, rejected, or wrong; and false alarms",
        measures=(*SOLVER, "simulation"),
        long="three times as many draws of everything",
    ),
    "attack_images": Bench(
        "Faults from images on",
        HONEST,
        "images with one fault through jcr calibrate: named, rejected, or wrong; and false alarms",
        measures=(
            *SOLVER,
            *FEATURES,
            "src/jcr/reconstruct/direct",
            "simulation",
            "simulation",
        ),
        long="ten draws of every fault instead of one, and 200 captures with nothing wrong instead of 5",
    ),
    "table2": Bench(
        "Heights of objects",
        MAPPED,
        "heights of objects in simulated scenes, from 8 and 10 images",
        measures=(*SOLVER, *FEATURES, *DEPTH, "src/jcr/segment", "simulation"),
        long="five scenes instead of three",
    ),
    "density": Bench(
        "How much a cloud covers",
        MAPPED,
        "how much of a plain table and its objects a cloud covers, beside COLMAP's points",
        draws=True,
        measures=(*FEATURES, *DEPTH, "simulation"),
    ),
    "depth": Bench(
        "Dense depth",
        MAPPED,
        "dense depth on simulated scenes: completeness, accuracy, map, by texture and reason",
        True,
        measures=(*FEATURES, *DEPTH, *MAP, "simulation"),
        long="everything plain, too",
    ),
    "map": Bench(
        "The map",
        MAPPED,
        "the map: accuracy of both presets, training, queries, distances, spheres beside python-fcl",
        True,
        measures=(*MAP, *DEPTH, "simulation"),
    ),
    "predictions": Bench(
        "The whole job from a network's pointmaps",
        OTHERS,
        "the whole job from pointmaps with a network's errors: error, honesty, map, time",
        measures=(*SOLVER, "src/jcr/reconstruct/global_alignment", "src/jcr/reconstruct/from_pairs.py", *MAP),
        long="three draws instead of one",
    ),
    "align": Bench(
        "Global alignment",
        OTHERS,
        "global alignment: fast against adam, kinematic against free, in error, time and memory",
        True,
        measures=("src/jcr/reconstruct/global_alignment",),
        long="3 draws of every number of images instead of 1, 10 of every calibration instead of 4",
    ),
    "live": Bench(
        "Calibrated while capturing",
        HONEST,
        "images until 2 mm and 0.3° are claimed and confirmed, at proposed poses, varied ones, random ones and a grid",
        measures=(*SOLVER, *FEATURES, *LIVE, "simulation"),
        long="ten scenes instead of two, and up to 40 images instead of 24",
    ),
    "live_real": Bench(
        "Fed image by image",
        HONEST,
        "captures in DIR fed image by image, against the same captures calibrated at once; seconds after each image",
        True,
        of_captures=True,
        measures=(*SOLVER, *FEATURES, *LIVE),
    ),
}
"""In the order of the README's claims."""
LONG = "_long"
"""Ends the name of a page that --long wrote."""


def paths_of(page: str) -> tuple[str, ...] | None:
    """What the numbers of a page come from, the bench itself included; None for the index."""
    name = page.removesuffix(LONG)
    return (*BENCHES[name].measures, f"benchmarks/{name}.py") if name in BENCHES else None


def title_of(page: str) -> str:
    """The heading of a page by the name of its file."""
    return BENCHES[page.removesuffix(LONG)].title + (", the long bench" if page.endswith(LONG) else "")
