"""Joint calibration and representation: a wrist camera's images to a calibrated camera and a map.

capture = jcr.read_capture("captures/table")
result = jcr.run(capture, "out/table")
scene = jcr.load_map("out/table")
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from jcr import deflate  # noqa: F401
from jcr.errors import InputError, RejectedError

if TYPE_CHECKING:
    from jcr.calibration.calibration_json import CalibrationFile
    from jcr.calibration.difference import Difference, compare
    from jcr.calibration.options import CalibrateOptions
    from jcr.calibration.seen import SeenInBase
    from jcr.capture.options import ReadOptions
    from jcr.capture.read import read_capture
    from jcr.cell.cameras_json import CamerasFile
    from jcr.check import Examination
    from jcr.check import check as check_capture
    from jcr.depth.options import DepthOptions
    from jcr.estimation.hand_eye import solve_hand_eye
    from jcr.estimation.kinematics import Arm
    from jcr.export.formats import export_run
    from jcr.export.options import ExportOptions
    from jcr.live.calibration import LiveCalibration
    from jcr.live.calibration_progress import Progress, Reached
    from jcr.pipeline import add_camera, build_map, calibrate, measure, run
    from jcr.pointmaps.global_alignment.align import global_align
    from jcr.pointmaps.global_alignment.alignment import Alignment, AlignOptions
    from jcr.pointmaps.pairs import PairPredictions
    from jcr.reconstruct import ReconstructOptions
    from jcr.records import (
        Budget,
        Capture,
        CellCamera,
        Finding,
        HandEye,
        Intrinsics,
        NextPose,
        Observability,
        PointCloud,
        Pointmaps,
        PosePairs,
        Reconstruction,
        Requirement,
        RobotNoise,
    )
    from jcr.records import Kind as FindingKind
    from jcr.results import RunOptions, RunResult, SavedRun, load_run
    from jcr.scene.distance import DistanceGrid
    from jcr.scene.map_file import load_map
    from jcr.scene.options import CloudOptions, MapOptions
    from jcr.scene.robot import RobotSpheres, load_robot
    from jcr.scene.sample import Sample
    from jcr.scene.scene_map import SceneMap
    from jcr.segments.measure import Measured
    from jcr.segments.options import SegmentOptions, TabletopOptions
    from jcr.touch_test import Touched, touch
    from jcr.verify import Verification, VerifyOptions
    from jcr.verify import verify as verify_run

    __version__: str

_MODULE_OF = {
    "ReadOptions": "jcr.capture.options",
    "CalibrateOptions": "jcr.calibration.options",
    "ReconstructOptions": "jcr.reconstruct",
    "CloudOptions": "jcr.scene.options",
    "MapOptions": "jcr.scene.options",
    "SegmentOptions": "jcr.segments.options",
    "TabletopOptions": "jcr.segments.options",
    "DepthOptions": "jcr.depth.options",
    "ExportOptions": "jcr.export.options",
    "VerifyOptions": "jcr.verify",
    "RunOptions": "jcr.results",
    "Budget": "jcr.records",
    "Capture": "jcr.records",
    "CellCamera": "jcr.records",
    "Intrinsics": "jcr.records",
    "PosePairs": "jcr.records",
    "Reconstruction": "jcr.records",
    "PointCloud": "jcr.records",
    "Pointmaps": "jcr.records",
    "HandEye": "jcr.records",
    "Observability": "jcr.records",
    "Requirement": "jcr.records",
    "RobotNoise": "jcr.records",
    "Finding": "jcr.records",
    "FindingKind": "jcr.records:Kind",
    "NextPose": "jcr.records",
    "Arm": "jcr.estimation.kinematics",
    "SeenInBase": "jcr.calibration.seen",
    "RunResult": "jcr.results",
    "SavedRun": "jcr.results",
    "Difference": "jcr.calibration.difference",
    "Examination": "jcr.check",
    "Touched": "jcr.touch_test",
    "Verification": "jcr.verify",
    "SceneMap": "jcr.scene.scene_map",
    "DistanceGrid": "jcr.scene.distance",
    "RobotSpheres": "jcr.scene.robot",
    "Measured": "jcr.segments.measure",
    "Sample": "jcr.scene.sample",
    "CalibrationFile": "jcr.calibration.calibration_json",
    "CamerasFile": "jcr.cell.cameras_json",
    "compare": "jcr.calibration.difference",
    "load_run": "jcr.results",
    "touch": "jcr.touch_test",
    "check_capture": "jcr.check:check",
    "verify_run": "jcr.verify:verify",
    "export_run": "jcr.export.formats",
    "read_capture": "jcr.capture.read",
    "solve_hand_eye": "jcr.estimation.hand_eye",
    "Alignment": "jcr.pointmaps.global_alignment.alignment",
    "AlignOptions": "jcr.pointmaps.global_alignment.alignment",
    "PairPredictions": "jcr.pointmaps.pairs",
    "global_align": "jcr.pointmaps.global_alignment.align",
    "LiveCalibration": "jcr.live.calibration",
    "Progress": "jcr.live.calibration_progress",
    "Reached": "jcr.live.calibration_progress",
    "run": "jcr.pipeline",
    "add_camera": "jcr.pipeline",
    "calibrate": "jcr.pipeline",
    "build_map": "jcr.pipeline",
    "measure": "jcr.pipeline",
    "load_map": "jcr.scene.map_file",
    "load_robot": "jcr.scene.robot",
}
"""Of each name that is imported when it is asked for, and its name there where that differs."""

__all__ = [
    "AlignOptions",
    "Alignment",
    "Arm",
    "Budget",
    "CalibrateOptions",
    "CalibrationFile",
    "CamerasFile",
    "Capture",
    "CellCamera",
    "CloudOptions",
    "DepthOptions",
    "Difference",
    "Examination",
    "ExportOptions",
    "Finding",
    "FindingKind",
    "HandEye",
    "InputError",
    "Intrinsics",
    "LiveCalibration",
    "MapOptions",
    "Measured",
    "NextPose",
    "Observability",
    "PairPredictions",
    "PointCloud",
    "Pointmaps",
    "PosePairs",
    "Progress",
    "Reached",
    "ReadOptions",
    "ReconstructOptions",
    "Reconstruction",
    "RejectedError",
    "Requirement",
    "RobotNoise",
    "RobotSpheres",
    "RunOptions",
    "RunResult",
    "SavedRun",
    "SeenInBase",
    "SegmentOptions",
    "TabletopOptions",
    "Touched",
    "Verification",
    "VerifyOptions",
    "add_camera",
    "build_map",
    "calibrate",
    "check_capture",
    "compare",
    "export_run",
    "global_align",
    "load_map",
    "load_robot",
    "load_run",
    "measure",
    "read_capture",
    "run",
    "solve_hand_eye",
    "touch",
    "verify_run",
]
if find_spec("torch"):
    __all__ += ["DistanceGrid", "Sample", "SceneMap"]


def __getattr__(name: str) -> Any:
    # SciPy and COLMAP take seconds to import; each name imports only the module behind it.
    if name in _MODULE_OF:
        module, _, inside = _MODULE_OF[name].partition(":")
        return getattr(import_module(module), inside or name)
    if name == "__version__":
        from importlib.metadata import version

        from jcr.extras import DISTRIBUTION

        return version(DISTRIBUTION)
    raise AttributeError(f"module 'jcr' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
