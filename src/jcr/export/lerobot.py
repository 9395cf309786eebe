"""Cameras of a LeRobot data set as a table with a row for each calibrated episode."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jcr.calibration.record import Calibration
from jcr.capture.formats import lerobot
from jcr.errors import InputError
from jcr.extras import extra
from jcr.records.json_file import read_json
from jcr.result import CAPTURE, RunResult

MATRIX = "gripper_from_camera"
"""Column of the hand-eye transform: 16 numbers, row by row."""


def episodes_of(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """Return the rows of the table by episode for runs of episodes of one data set; raise InputError for other runs."""
    rows = sorted((_row(folder) for folder in folders), key=lambda row: row["episode_index"])
    if len({row["dataset"] for row in rows}) > 1:
        raise InputError(f"{folders[0].parent}: holds runs of several data sets; export them one by one")
    return rows


def write_lerobot(path: Path, episodes: Sequence[dict[str, Any]], notes: dict[str, str]) -> None:
    """Write intrinsics and extrinsics of the wrist camera by episode as a Parquet table (m, px).

    `notes` are stored as metadata. LeRobot's own tables have no columns for cameras, so that the table belongs beside
    them. Raises InputError without pyarrow.
    """
    arrow, parquet = (extra(name, "lerobot", "a LeRobot table") for name in ("pyarrow", "pyarrow.parquet"))
    about = notes | {
        "columns": f"{MATRIX}: 4x4 by rows, optical frame (x right, y down, z forward); std: 1 sigma"
    }
    table = arrow.Table.from_pylist(list(episodes)).replace_schema_metadata({"jcr": json.dumps(about)})
    parquet.write_table(table, path)


def _row(folder: Path) -> dict[str, Any]:
    """Return the row of the table for the run of an episode; raise InputError if the run is of another capture."""
    found = RunResult(folder).calibration
    file = folder / CAPTURE / "capture.json"
    made_from = read_json(file).get("made_from") if file.is_file() else None
    if not isinstance(made_from, list) or len(made_from) < 3 or not lerobot.recognises(Path(made_from[0])):
        raise InputError(f"{folder}: is no run of an episode of a LeRobot data set, or the set was moved")
    if not isinstance(found, Calibration) or found.mount == "base" or found.intrinsics is None:
        raise InputError(f"{folder}: has no calibrated wrist camera; run the episode again")
    camera, std = found.intrinsics, found.uncertainty
    return {
        "episode_index": int(made_from[2]["episode"][0]),
        "camera": str(made_from[2]["camera_topic"] or ""),
        MATRIX: found.gripper_from_camera.ravel().tolist(),
        "translation_std_mm": list(std.translation_std_mm),
        "rotation_std_deg": list(std.rotation_std_deg),
        **{name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "distortion_model": camera.model,
        "distortion": list(camera.distortion),
        "intrinsics_std": list(camera.std or ()),
        "verdict": found.verdict,
        "dataset": str(made_from[0]),
    }
