"""LeRobot's data-set format, version 3.0, with images as images.

    data/chunk-000/file-000.parquet           a row per frame: its features, and its indices and time
    meta/episodes/chunk-000/file-000.parquet  a row per episode: its frames, its task and its statistics
    meta/tasks.parquet                        the tasks in words
    meta/stats.json                           statistics of all frames, for normalization
    meta/info.json                            features, counts and paths

The format is read from the package lerobot 0.6.1 [R], which a slow test loads what is written with. Needs the extra
`lerobot`, pyarrow, and not that package.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_images import decode_image

if TYPE_CHECKING:
    import pyarrow

VERSION = "v3.0"

DATA, EPISODES = "data/chunk-{0:03d}/file-{1:03d}.parquet", "meta/episodes/chunk-{0:03d}/file-{1:03d}.parquet"

INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"

_FILES_PER_CHUNK, _MB_PER_FILE = 1000, 100

_MAX_FILE_BYTES = 90 * 2**20
"""Size of the frames at which a file ends, bytes: below the limit that the format states."""

_SAMPLE, _SAMPLE_IMAGES = 2000, 200
"""Numbers of evenly spread frames and images from which statistics are computed, of all and of each episode."""

_EPISODES_PER_GROUP = 100
"""Number of episodes that are written at once; the statistics of each are some tens of kilobytes."""

_QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)


@dataclass(frozen=True)
class Feature:
    """A quantity of a frame."""

    dtype: str
    """`image`, or a type of numbers."""
    shape: tuple[int, ...]
    """(length,), or of an image, (height, width, channels)."""
    names: tuple[str, ...] | None = None
    """Names of its components, with units."""


INDICES = {name: Feature("int64", (1,)) for name in ("frame_index", "episode_index", "index", "task_index")}
"""Features of every data set, beside its time."""


def pyarrow_modules() -> tuple[Any, Any]:
    """Return pyarrow and pyarrow.parquet. Raises TactipError if they are not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise TactipError(
            f"LeRobot sets need pyarrow ({error}): in the clone, .venv/bin/pip install -e '.[lerobot]'"
        ) from error
    return pyarrow, pyarrow.parquet


class LeRobotWriter:
    """A data set that is written, episode by episode. Only the frames of one file are in memory."""

    def __init__(self, folder: Path, features: Mapping[str, Feature], fps: int, frames: int) -> None:
        """Begin in an empty folder.

        Args:
            folder: Folder to write.
            features: Features of a frame, by name.
            fps: Frames per second.
            frames: Number of frames that will be added.

        Raises:
            TactipError: If the extra `lerobot` is not installed.
        """
        self._arrow, self._parquet = pyarrow_modules()
        self._folder, self._fps = folder, fps
        self._features = {**features, "timestamp": Feature("float32", (1,)), **INDICES}
        self._every, self._every_image = max(1, frames // _SAMPLE), max(1, frames // _SAMPLE_IMAGES)
        self._sampled: dict[str, list[np.ndarray]] = {name: [] for name in self._features}
        self._pending: dict[str, list[Any]] = {name: [] for name in self._features}
        self._bytes = self._files = self._frames = self._episodes = 0
        self._tasks: list[str] = []
        self._pending_episodes: list[dict[str, Any]] = []
        self._episode_writer: Any = None

    def add_episode(self, frames: Mapping[str, Sequence[Any] | np.ndarray], task: str) -> None:
        """Add an episode.

        Args:
            frames: For each feature, PNG files (n) as bytes, or numbers (n, length) or (n,).
            task: What is done in it, in words.
        """
        n, episode = len(next(iter(frames.values()))), self._episodes
        if task not in self._tasks:
            self._tasks.append(task)
        columns: dict[str, Any] = {
            **frames,
            "timestamp": np.arange(n) / self._fps,
            "frame_index": np.arange(n),
            "episode_index": np.full(n, episode),
            "index": self._frames + np.arange(n),
            "task_index": np.full(n, self._tasks.index(task)),
        }
        size = n * 64 + sum(sum(map(len, v)) if self._is_image(k) else v.nbytes for k, v in columns.items())
        if self._bytes and self._bytes + size > _MAX_FILE_BYTES:
            self._flush()
        statistics = {}
        for name, values in columns.items():
            self._pending[name] += list(values)
            image = self._is_image(name)
            some = np.arange(0, n, max(1, n // (_SAMPLE_IMAGES if image else _SAMPLE)))
            numbers = self._numbers(name, values, some)
            statistics |= {f"stats/{name}/{key}": value for key, value in _statistics(numbers, ()).items()}
            every = self._every_image if image else self._every
            self._sampled[name].append(self._numbers(name, values, np.flatnonzero(columns["index"] % every == 0)))
        self._pending_episodes.append(
            {
                "episode_index": episode,
                "tasks": [task],
                "length": n,
                "data/chunk_index": self._files // _FILES_PER_CHUNK,
                "data/file_index": self._files % _FILES_PER_CHUNK,
                "dataset_from_index": self._frames,
                "dataset_to_index": self._frames + n,
                **statistics,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        self._bytes, self._frames, self._episodes = self._bytes + size, self._frames + n, episode + 1
        if len(self._pending_episodes) >= _EPISODES_PER_GROUP:
            self._flush_episodes()

    def finish(self) -> None:
        """Write what is left, and the tables of episodes, tasks, statistics and features."""
        self._flush()
        self._flush_episodes()
        self._episode_writer.close()
        self._write(TASKS, self._task_table())
        samples = {name: np.concatenate(values) for name, values in self._sampled.items()}
        statistics = {
            name: {key: np.asarray(value).tolist() for key, value in _statistics(numbers).items()}
            for name, numbers in samples.items()
        }
        features = {
            name: {"dtype": f.dtype, "shape": list(f.shape), "names": None if f.names is None else list(f.names)}
            for name, f in self._features.items()
        }
        info = {
            "codebase_version": VERSION,
            "fps": self._fps,
            "features": features,
            "total_episodes": self._episodes,
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": _FILES_PER_CHUNK,
            "data_files_size_in_mb": _MB_PER_FILE,
            "video_files_size_in_mb": 2 * _MB_PER_FILE,
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": None,
            "robot_type": "tactip",
            "splits": {"train": f"0:{self._episodes}"},
        }
        for name, content in ((STATS, statistics), (INFO, info)):
            (self._folder / name).write_text(json.dumps(content, indent=4))

    def _is_image(self, name: str) -> bool:
        return self._features[name].dtype == "image"

    def _numbers(self, name: str, values: Any, chosen: np.ndarray) -> np.ndarray:
        """Return some values of a feature as statistics take them: images (m, channels, height, width) from 0 to 1."""
        if not self._is_image(name):
            return np.asarray(values, float)[chosen]
        images = [decode_image(values[i], name, color=True) for i in chosen]
        if not images:
            return np.zeros((0, *np.roll(self._features[name].shape, 1)))
        return np.stack(images).transpose(0, 3, 1, 2) / 255

    def _flush(self) -> None:
        """Write the pending frames as a file."""
        path = DATA.format(self._files // _FILES_PER_CHUNK, self._files % _FILES_PER_CHUNK)
        columns = [self._column(feature, self._pending[name]) for name, feature in self._features.items()]
        # The package datasets takes the types of images from here.
        kinds = json.dumps({"info": {"features": {name: _kind(feature) for name, feature in self._features.items()}}})
        table = self._arrow.table(dict(zip(self._features, columns, strict=True)))
        self._write(path, table.replace_schema_metadata({"huggingface": kinds}))
        self._pending = {name: [] for name in self._features}
        self._bytes, self._files = 0, self._files + 1

    def _flush_episodes(self) -> None:
        """Write the pending rows of the table of episodes."""
        if not self._pending_episodes:
            return
        table = self._arrow.Table.from_pylist(self._pending_episodes)
        if self._episode_writer is None:
            path = self._folder / EPISODES.format(0, 0)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._episode_writer = self._parquet.ParquetWriter(path, table.schema, compression="zstd")
        self._episode_writer.write_table(table)
        self._pending_episodes = []

    def _column(self, feature: Feature, values: list[Any]) -> "pyarrow.Array":
        """Return a column of a file of frames."""
        arrow = self._arrow
        if feature.dtype == "image":
            paths = arrow.nulls(len(values), arrow.string())
            return arrow.StructArray.from_arrays([arrow.array(values, arrow.binary()), paths], names=["bytes", "path"])
        numbers = np.asarray(values, feature.dtype)
        column = arrow.array(numbers.ravel())
        if feature.shape == (1,):
            return column
        return arrow.FixedSizeListArray.from_arrays(column, feature.shape[0])

    def _task_table(self) -> "pyarrow.Table":
        """Return the table of tasks, which are the index that pandas reads."""
        table = self._arrow.table({"task_index": np.arange(len(self._tasks)), "task": self._tasks})
        kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
        columns = [
            {"name": name, "field_name": name, "pandas_type": one, "numpy_type": other, "metadata": None}
            for name, (one, other) in kinds.items()
        ]
        pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
        return table.replace_schema_metadata({"pandas": json.dumps(pandas)})

    def _write(self, name: str, table: "pyarrow.Table") -> None:
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self._parquet.write_table(table, path, compression="snappy")


def _statistics(numbers: np.ndarray, quantiles: Sequence[float] = _QUANTILES) -> dict[str, Any]:
    """Return statistics over frames.

    Args:
        numbers: Numbers (n,) or (n, length), or images (n, channels, height, width), whose channels are summed up.
        quantiles: Quantiles beside extremes, mean and standard deviation. Episodes have none, which would be most of a set.
    """
    count = [len(numbers)]
    channels = numbers.ndim == 4
    flat = numbers.transpose(0, 2, 3, 1) if channels else numbers[:, None] if numbers.ndim == 1 else numbers
    flat = flat.reshape(-1, flat.shape[-1])
    found = {"min": flat.min(0), "max": flat.max(0), "mean": flat.mean(0), "std": flat.std(0)}
    found |= {f"q{round(100 * q):02d}": np.quantile(flat, q, 0) for q in quantiles}
    shape = (-1, 1, 1) if channels else (-1,)
    return {**{key: value.reshape(shape).tolist() for key, value in found.items()}, "count": count}


def _kind(feature: Feature) -> dict[str, Any]:
    """Return a feature as the package datasets describes it."""
    value = {"dtype": feature.dtype, "_type": "Value"}
    if feature.dtype == "image":
        return {"_type": "Image"}
    if feature.shape == (1,):
        return value
    return {"feature": value, "length": feature.shape[0], "_type": "List"}
