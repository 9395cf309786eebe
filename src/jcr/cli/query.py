"""`jcr query`: queries the map at points."""

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.capture.plain_files import read_npy
from jcr.cli.output import Output
from jcr.errors import InputError
from jcr.files import write_bytes, write_text

_COLUMNS = "x,y,z,occupancy,unknown,distance,gradient_x,gradient_y,gradient_z,red,green,blue,label"


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Query the map of a run at points: occupancy, unknown, distance, its gradient, colour and label.

    Points are in metres, in the robot's base frame. Distances are NaN outside of the mapped workspace.

    examples:
      jcr query out/table points.csv
      jcr query out/table cloud.ply --write answers.npy
      jcr query out/table points.npy --unknown occupied --json
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run, with its map.safetensors."""
    points: Annotated[Path, tyro.conf.Positional]
    """.csv (three columns, header line optional), .npy of shape (n, 3), or .ply."""
    write: Path | None = None
    """File to write, .csv or .npy (a structured array); by default points.answers.csv beside the points, or none with
    --json, which prints the answers."""
    unknown: Literal["occupied", "free", "report"] = "report"
    """State of unseen space: solid, empty, or occupancy 0.5."""
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Answer for every point, in the order of the input."""
    from jcr.scene.map_file import load_map

    scene = load_map(arguments.out)
    x_in_base = read_points(arguments.points)
    sample = scene.query(x_in_base, arguments.unknown)
    # Eight-bit colours, as the points had them; outside of the workspace there is none.
    red, green, blue = np.nan_to_num(sample.color * 255).round().astype(np.uint8).T
    columns = (*x_in_base.T, sample.occupancy, sample.unknown, sample.distance, *sample.gradient.T)
    columns = (*columns, red, green, blue, sample.label)
    rows = np.rec.fromarrays(columns, names=_COLUMNS)  # pyright: ignore[reportArgumentType]
    unseen = f"{100 * float(np.mean(sample.unknown)):.0f} % of them unseen" if len(rows) else "none"
    summary = f"{len(rows)} points, {unseen}{labelled(sample.label, scene.label_names)}\n"
    answers: dict[str, object] = {"label_names": list(scene.label_names)}
    if arguments.output.json:
        answers |= {name: _finite(rows[name]) for name in _COLUMNS.split(",")}
    if arguments.write or not arguments.output.json:
        path = arguments.write or arguments.points.with_suffix(".answers.csv")
        _write(path, rows)
        summary = f"wrote {path}: {summary}"
    arguments.output.result(summary, answers)
    return 0


def labelled(label: Int[ndarray, " n"], names: tuple[str, ...]) -> str:
    """Return the number of points on each label as text; empty where the map has no labels."""
    count = np.bincount(label, minlength=len(names))
    parts = [f"{names[k]} {count[k]}" for k in range(1, len(names)) if count[k]]
    return f"; by label: {', '.join(parts)}" if parts else ""


def _write(path: Path, rows: "np.recarray[Any, Any]") -> None:
    if path.suffix == ".npy":
        buffer = io.BytesIO()
        np.save(buffer, np.asarray(rows))
        write_bytes(path, buffer.getvalue())
    elif path.suffix == ".csv":
        formats = "%.6f,%.6f,%.6f,%.4f,%d,%.5f,%.4f,%.4f,%.4f,%d,%d,%d,%d"
        lines = "\n".join(formats % tuple(row) for row in rows.tolist())
        write_text(path, f"{_COLUMNS}\n{lines}\n")
    else:
        raise InputError(f"{path}: answers are written as .csv or .npy")


def read_points(path: Path) -> Float[ndarray, "n 3"]:
    """Points (n,3) in metres from .csv, .npy or .ply; raises InputError where the file is none of these."""
    if not path.is_file():
        raise InputError(f"{path}: no such file of points (.csv, .npy or .ply)")
    try:
        if path.suffix == ".npy":
            points = read_npy(path)
        elif path.suffix == ".ply":
            import trimesh

            points = np.asarray(trimesh.load(path).vertices)  # pyright: ignore[reportAttributeAccessIssue]
        elif path.suffix == ".csv":
            points = _read_csv(path)
        else:
            raise InputError(f"{path}: points are read from .csv, .npy or .ply")
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: cannot be read as points ({error}); give x, y, z in metres") from error
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: expected points of shape (n, 3) in metres, got {points.shape} {points.dtype}"
        )
    points = points.astype(np.float64)
    if not (finite := np.isfinite(points).all(1)).all():
        raise InputError(f"{path}: point {finite.argmin() + 1} is not finite; remove it")
    return points


def _read_csv(path: Path) -> ndarray:
    lines = [
        line for line in path.read_text("utf-8").splitlines() if line.strip() and not line.startswith("#")
    ]
    if not lines:
        return np.zeros((0, 3))
    try:
        [float(word) for word in lines[0].split(",")]
    except ValueError:
        lines = lines[1:]
    return np.array([[float(word) for word in line.split(",")] for line in lines]).reshape(len(lines), -1)


def _finite(column: ndarray) -> list:
    """Return the column for JSON, with None in place of NaN."""
    if column.dtype.kind != "f":
        return column.tolist()
    return [None if np.isnan(value) else round(float(value), 6) for value in column]
