"""LeRobot's dataset format v3.0: Parquet files of frames and episodes, and JSON metadata. Requires pyarrow.

Each variant is a task. Floats are float32. The export loses the final observation of each episode, and its
tier; ``next.done`` and ``next.truncated`` state how it ended.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import missing_dependency
from imujoco_minari.loading import Arrays
from imujoco_minari.variants import known_robots, specification

VERSION = "v3.0"

_PATH = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
# Frames of a file. At 200 bytes each, a file stays below the 100 MB that LeRobot recommends.
_FILE_FRAMES = 500_000
_FILES_A_CHUNK = 1000
# Frames a second of data that names no robot.
_UNKNOWN_RATE = 100
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

ColumnArrays = dict[str, NDArray[Any]]


def write(data: Arrays, target: Path, *, states_only: bool) -> None:
    """Write ``data`` to the folder ``target``.

    Raises:
        DependencyError: when pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        raise missing_dependency("pyarrow", "lerobot", "the format lerobot") from None
    robot = data.table[0].robot
    rate = specification(robot).steps_per_second if robot in known_robots() else _UNKNOWN_RATE
    # LeRobot looks a task up by its name, so two tiers of a variant are one task.
    tasks = list(dict.fromkeys(origin.variant for origin in data.table))
    places = {task: place for place, task in enumerate(tasks)}
    task_index = np.array([places[origin.variant] for origin in data.table])[data.variant_index]
    columns = _columns(data, rate, task_index, states_only)
    # The number of the file for each episode.
    files = data.episode_starts // _FILE_FRAMES
    for number in np.unique(files):
        first, last = np.flatnonzero(files == number)[[0, -1]]
        rows = slice(int(data.episode_starts[first]), int(data.episode_ends[last]))
        chunk = {name: column[rows] for name, column in columns.items()}
        _parquet(target / "data" / _file_name(int(number)), chunk)
    _parquet(target / "meta" / "tasks.parquet", {"task_index": np.arange(len(tasks))}, index=("task", tasks))
    _parquet(target / "meta" / "episodes" / _file_name(0), _episodes(data, files))
    statistics = {name: _statistics(column) for name, column in columns.items()}
    for name, content in (("stats", statistics), ("info", _info(data, columns, rate, len(tasks)))):
        path = target / "meta" / f"{name}.json"
        path.write_text(json.dumps(content, indent=4) + "\n", "utf-8")


def _columns(data: Arrays, rate: float, task_index: NDArray[Any], states_only: bool) -> ColumnArrays:
    frame = np.arange(len(data)) - np.repeat(data.episode_starts, data.episode_lengths)
    columns: ColumnArrays = {"observation.state": data.observations.astype(np.float32)}
    if not states_only:
        columns["action"] = data.actions.astype(np.float32)
        columns["next.reward"] = data.rewards.astype(np.float32)
    return columns | {
        "next.done": data.dones,
        "next.truncated": data.truncations,
        "timestamp": (frame / rate).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.repeat(np.arange(data.episodes), data.episode_lengths),
        "index": np.arange(len(data)),
        "task_index": task_index,
    }


def _file_name(number: int) -> str:
    return _PATH.format(chunk_index=number // _FILES_A_CHUNK, file_index=number % _FILES_A_CHUNK)


def _episodes(data: Arrays, files: NDArray[Any]) -> dict[str, Any]:
    nothing = np.zeros(data.episodes, np.int64)
    return {
        "episode_index": np.arange(data.episodes),
        "tasks": [[origin.variant] for origin in data.origins],
        "length": data.episode_lengths,
        "data/chunk_index": files // _FILES_A_CHUNK,
        "data/file_index": files % _FILES_A_CHUNK,
        "dataset_from_index": data.episode_starts,
        "dataset_to_index": data.episode_ends,
        "meta/episodes/chunk_index": nothing,
        "meta/episodes/file_index": nothing,
    }


def _statistics(column: NDArray[Any]) -> dict[str, list[float]]:
    rows = column.reshape(len(column), -1)
    numbers = {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0, dtype=np.float64),
        "std": rows.std(axis=0, dtype=np.float64),
        "count": np.array([len(rows)]),
    }
    rows = rows.astype(np.float64)
    numbers |= {name: np.quantile(rows, share, axis=0) for name, share in _QUANTILES.items()}
    return {name: value.tolist() for name, value in numbers.items()}


def _info(data: Arrays, columns: ColumnArrays, rate: float, tasks: int) -> dict[str, Any]:
    features = {
        name: {"dtype": str(column.dtype), "shape": list(column.shape[1:]) or [1], "names": None}
        for name, column in columns.items()
    }
    return {
        "codebase_version": VERSION,
        "robot_type": data.table[0].robot or None,
        "total_episodes": data.episodes,
        "total_frames": len(data),
        "total_tasks": tasks,
        "chunks_size": _FILES_A_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": rate,
        "splits": {"train": f"0:{data.episodes}"},
        "data_path": f"data/{_PATH}",
        "video_path": None,
        "features": features,
    }


def _parquet(path: Path, columns: dict[str, Any], index: tuple[str, list[str]] | None = None) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    def arrow(column: Any) -> Any:
        if isinstance(column, np.ndarray) and column.ndim == 2:
            return pa.FixedSizeListArray.from_arrays(pa.array(column.ravel()), column.shape[1])
        return pa.array(column)

    table = pa.table({name: arrow(column) for name, column in columns.items()})
    if index is not None:
        name, labels = index
        table = table.append_column(name, pa.array(labels))
        # LeRobot looks tasks up in the index of a pandas frame. This metadata makes pandas set that index.
        labelled = {"name": name, "field_name": name, "pandas_type": "unicode", "numpy_type": "object"}
        described = {"index_columns": [name], "columns": [labelled], "column_indexes": []}
        table = table.replace_schema_metadata({"pandas": json.dumps(described)})
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(table, path)
