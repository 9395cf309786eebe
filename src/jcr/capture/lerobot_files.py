"""Where a LeRobot data set keeps an episode: v2.1 in files of its own, v3.0 among others in one file."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from string import Formatter
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from jcr.capture.plain_files import contained, first_fault, read_json
from jcr.errors import InputError
from jcr.extras import extra

INFO = "meta/info.json"


FIELDS = ("video_key", "episode_chunk", "episode_index", "chunk_index", "file_index")
"""What the templates of paths may name."""


def _template(text: str) -> str:
    """A path with fields of plain names and digits at most two wide: format() takes attributes, and any width."""
    for _, field, form, conversion in Formatter().parse(text):
        if field is None:
            continue
        if field not in FIELDS or conversion or not re.fullmatch(r"(0?\d?\d?d)?", form or ""):
            raise ValueError(f"no path of the fields {', '.join(FIELDS)}")
    return text


Template = Annotated[str, Field(max_length=1000), AfterValidator(_template)]


class Feature(BaseModel):
    """One kind of number or image that the set records."""

    dtype: str = ""
    names: Any = None
    """A list of texts, or one below {"motors": …} or {"axes": …}."""

    def numbers(self) -> list[str]:
        """The names of its numbers, in lower case; empty where it has none."""
        names = self.names
        while isinstance(names, dict):
            names = next(iter(names.values()), None)
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            return []
        return [name.removesuffix(".pos").lower() for name in names]


class Info(BaseModel):
    """What is asked of meta/info.json."""

    model_config = ConfigDict(allow_inf_nan=False)
    features: dict[str, Feature]
    fps: Annotated[float, Field(gt=0, le=1e6)]
    codebase_version: str = ""
    total_episodes: Annotated[int, Field(ge=0)] | None = None
    chunks_size: Annotated[int, Field(ge=1)] = 1000
    data_path: Template
    video_path: Template | None = None


def read_info(path: Path) -> Info:
    """meta/info.json of the set in the folder `path`; InputError where it is none."""
    file = path / INFO
    content = read_json(file)
    if not isinstance(content, dict) or not {"features", "fps"} <= content.keys():
        raise InputError(f"{file}: no LeRobot data set; it has no features or fps")
    try:
        return Info.model_validate(content, strict=True)
    except ValidationError as error:
        raise InputError(f"{file}: {first_fault(error)}; correct it there or download it again") from None


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One recording of the set: its rows, and where its images are."""

    index: int
    time_s: Float[ndarray, " n"]
    state: Float[ndarray, "n k"]
    table: Path
    video: Path | None
    """None where the images are in the table."""
    video_start_s: float


def read_episode(path: Path, info: Info, camera: str, key: str, index: int) -> Episode:
    """Episode `index` with the state and the camera of those keys; InputError when it is not there or damaged."""
    is_v3 = info.codebase_version.startswith("v3")
    table, video, start_s = (_files_v3 if is_v3 else _files_v2)(path, info, camera, index)
    time_s, state = _rows(table, key, index if is_v3 else None)
    return Episode(index=index, time_s=time_s, state=state, table=table, video=video, video_start_s=start_s)


def _files_v2(path: Path, info: Info, camera: str, index: int) -> tuple[Path, Path | None, float]:
    """v2.1: a table and a video per episode; with the time (s) at which it begins in the video."""
    total = index + 1 if info.total_episodes is None else info.total_episodes
    if not 0 <= index < total:
        raise InputError(f"{path}: no episode {index}; there are {total}, counted from 0")
    chunk = index // info.chunks_size
    fields = {"episode_chunk": chunk, "episode_index": index, "video_key": camera}
    video = _file(path, info.video_path, fields) if _is_video(info, camera) else None
    return _file(path, info.data_path, fields), video, 0.0


def _files_v3(path: Path, info: Info, camera: str, index: int) -> tuple[Path, Path | None, float]:
    """v3.0: likewise, where one table and one video have many episodes; meta/episodes lists them."""
    parquet = extra("pyarrow.parquet", "lerobot", "a LeRobot data set")
    columns = ["episode_index", "data/chunk_index", "data/file_index"]
    if _is_video(info, camera):
        columns += [f"videos/{camera}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
    found = 0
    for file in sorted((path / "meta" / "episodes").rglob("*.parquet")):
        listed = _table(parquet, file, columns)
        found += len(listed["episode_index"])
        if index not in listed["episode_index"]:
            continue
        row = listed["episode_index"].index(index)
        chunk, number, *of_video = (listed[name][row] for name in columns[1:])
        table = _file(path, info.data_path, {"chunk_index": chunk, "file_index": number})
        if not of_video:
            return table, None, 0.0
        fields = {"video_key": camera, "chunk_index": of_video[0], "file_index": of_video[1]}
        return table, _file(path, info.video_path, fields), float(of_video[2])
    raise InputError(f"{path}: no episode {index}; meta/episodes knows {found}, counted from 0")


def images_in_table(episode: Episode, camera: str, rows: Int[ndarray, " k"]) -> Iterator[bytes]:
    """The image files of ascending rows of an episode that has them in its table, read a few rows at a time.

    Raises InputError where one cannot be read or is not in the table.
    """
    parquet = extra("pyarrow.parquet", "lerobot", "a LeRobot data set")
    wanted, row = set(rows.tolist()), 0
    try:
        with parquet.ParquetFile(episode.table) as file:
            for batch in file.iter_batches(32, columns=["episode_index", camera]):
                for index, image in zip(batch["episode_index"].to_pylist(), batch[camera], strict=True):
                    if index != episode.index:
                        continue
                    if row in wanted:
                        file_of_row = image["bytes"].as_py()
                        if not file_of_row:
                            raise InputError(
                                f"{episode.table}: holds no {camera} of frame {row}; write the data set again with "
                                "its images embedded"
                            )
                        yield file_of_row
                    row += 1
    except InputError:
        raise
    except Exception as error:  # Arrow's own errors have no common base
        raise InputError(f"{episode.table}: {camera} cannot be read ({error}); download it again") from None


def _is_video(info: Info, camera: str) -> bool:
    return info.features[camera].dtype == "video"


def _rows(
    file: Path, key: str, episode: int | None = None
) -> tuple[Float[ndarray, " n"], Float[ndarray, "n k"]]:
    """Times (s, from the episode's start) and states of one episode."""
    parquet = extra("pyarrow.parquet", "lerobot", "a LeRobot data set")
    table = _table(parquet, file, ["timestamp", "episode_index", key])
    mine = np.array([episode is None or value == episode for value in table["episode_index"]], dtype=bool)
    time_s, state = np.array(table["timestamp"], np.float64)[mine], np.array(table[key], np.float64)[mine]
    if len(time_s) == 0 or state.ndim != 2 or not np.isfinite(state).all():
        raise InputError(f"{file}: {key} of the episode is empty or not finite; choose another episode")
    return time_s, state


def _table(parquet: Any, file: Path, columns: list[str]) -> dict[str, list[Any]]:
    try:
        return parquet.read_table(file, columns=columns, partitioning=None).to_pydict()
    except Exception as error:  # Arrow's own errors have no common base
        raise InputError(
            f"{file}: not a readable table of the data set ({error}); download it again"
        ) from None


def _file(path: Path, template: str | None, fields: dict[str, Any]) -> Path:
    if template is None:
        raise InputError(f"{path / INFO}: has videos and no video_path; which version is it?")
    try:
        name = template.format(**fields)
    except (KeyError, ValueError) as error:
        raise InputError(
            f"{path / INFO}: {template} cannot be filled in ({error}); which version is it?"
        ) from None
    return contained(path, name, str(path / INFO))
