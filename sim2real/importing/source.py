"""A laboratory's set as it was published: table, labels and paths of the frames."""

import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from tactip_twin.sim.dataset.format import checksum
from tactip_twin.sim2real.importing.base_pose import with_tool_columns
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.convert_labels import convert_labels, image_column
from tactip_twin.sim2real.importing.table_columns import with_lists_split
from tactip_twin.sim2real.sensor.preprocess import IMAGES, FrameReader, check_frame, load
from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.sim2real.sensor.video_frames import VIDEOS
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import parse_table, read_file
from tactip_twin.tactip_model.mask import detect_pins

FOLDERS = ("images", "frames", "frames_bw", "sensor_images", "processed_images", "videos", "")
"""Subfolders of the set in which frames are searched."""

MAX_FRAMES = 150_000
"""Maximum number of frames: meta.json, which has a checksum of each, stays below its size limit."""

MAX_TAP_MM = 100.0
"""Maximum motion of a tap that makes contact, mm along each axis."""

_TABLES = ("targets.csv", "targets_images.csv", "targets_video.csv")
"""Names of the table, in order, where a folder has several."""

_NEUTRALS = ("init*", "neutral*", "image_0.*")
"""Names of neutral images."""

PIN_DETECTION_FRAMES = 40
"""Frames used to locate the pins, if there is no neutral image, and to measure how the camera has changed since it."""


@dataclass(frozen=True)
class Recording:
    """A laboratory's folder before anything is known of its conventions. (n frames)"""

    folder: Path
    """The folder."""
    names: tuple[str, ...]
    """(n) names of the frames, from the table."""
    paths: tuple[Path | None, ...]
    """(n) their files; None if one is missing."""
    table: Mapping[str, Sequence[str]]
    """Cells (n) of each column of the table."""
    neutral: Path | None
    """Image of the undeformed tip, if there is one."""
    digest: str
    """Checksum of the table."""
    video_frame: int
    """Frame used from each video (ColumnMap.video_frame)."""

    def load(self, i: int) -> np.ndarray:
        """Return frame i, (h, w, 3) uint8. Raises TactipError if it is missing or cannot be read."""
        path = self.paths[i]
        if path is None:
            raise TactipError("the file does not exist")
        return load(path, self.video_frame)


@dataclass(frozen=True)
class Source(Recording):
    """A laboratory's folder with its labels. (n frames)"""

    poses: np.ndarray
    """(n, 6) mm and degrees, in our conventions; NaN where a cell is not a number."""
    shears: np.ndarray
    """(n, 6) the same."""


def read_source(
    folder: str | Path, column_map: ColumnMap, targets: str | Path | None = None, neutral: str | Path | None = None
) -> Source:
    """Return the Source in a folder: its Recording with labels (`read_recording` and `with_labels`)."""
    return with_labels(read_recording(folder, column_map, targets, neutral), column_map)


def with_labels(recording: Recording, column_map: ColumnMap) -> Source:
    """Return a Recording with the labels that a ColumnMap gives. Raises TactipError if the table does not fit."""
    poses, shears = convert_labels(column_map, recording.table)
    return Source(**{f.name: getattr(recording, f.name) for f in fields(Recording)}, poses=poses, shears=shears)


def read_recording(
    folder: str | Path, column_map: ColumnMap, targets: str | Path | None = None, neutral: str | Path | None = None
) -> Recording:
    """Return the Recording in a folder.

    Args:
        folder: The folder.
        column_map: Conventions of its table, of which only those of the frames and of a pose in the frame of a robot's base
            are used.
        targets: The table; if None, targets.csv, targets_images.csv or targets_video.csv in the folder, or its only table.
        neutral: The neutral image; if None, what `find_neutral_image` finds.

    Raises:
        TactipError: If table, neutral image or all frames are missing, the table has no rows, or two of its rows name
            different frames of which only one is there.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise TactipError(f"{folder} is not a folder: it must hold a table targets.csv and frames")
    path = Path(targets) if targets else _table_in(folder)
    if not path.exists():
        raise TactipError(f"the table {path} does not exist: name the table with --targets")
    data = read_file(path)
    _, rows = parse_table(data, f"the table {path}")
    if not rows:
        raise TactipError(f"the table {path} has no rows")
    allowed = f"at most {MAX_FRAMES} (divide a larger set)"
    require(len(rows) <= MAX_FRAMES, f"the number of rows of {path}", len(rows), allowed)
    table = {name.strip(): [(row[name] or "").strip() for row in rows] for name in rows[0] if name and name.strip()}
    table = with_lists_split(table)
    if column_map.base_pose:
        table = with_tool_columns(table, column_map)
    names = tuple(name or "" for name in table[image_column(column_map, list(table))])
    if neutral is not None and not Path(neutral).is_file():
        raise TactipError(f"the neutral image {neutral} does not exist")
    paths = tuple(_frame_path(folder, name) for name in names)
    if not any(paths):
        places = ", ".join(str(folder / f) for f in FOLDERS)
        raise TactipError(f"none of the table's frames exists: {names[0]!r} was searched in {places}")
    _check_distinct(names, paths)
    neutral = Path(neutral) if neutral else find_neutral_image(folder, paths)
    return Recording(folder, names, paths, table, neutral, checksum(data), column_map.video_frame)


def find_neutral_image(folder: Path, frames: Iterable[Path | None]) -> Path | None:
    """Return the image whose name begins with init or neutral, in a set's folder or beside its frames, or None.

    A frame of the table is never taken for it.

    Args:
        folder: The set's folder.
        frames: Files of the frames; None where one is missing.
    """
    used = {path for path in frames if path is not None}
    places = dict.fromkeys((folder, *sorted({path.parent for path in used})))
    found = (p for place in places for pattern in _NEUTRALS for p in sorted(place.glob(pattern)))
    return next((p for p in found if p.suffix.lower() in IMAGES and p not in used), None)


def _table_in(folder: Path) -> Path:
    """Return the table in a folder: one of _TABLES, or its only table. Raises TactipError if there is none, or several."""
    tables = sorted(path for path in folder.glob("*.csv") if not path.name.startswith("."))
    path = next((folder / name for name in _TABLES if folder / name in tables), None)
    if path is not None:
        return path
    if len(tables) == 1:
        return tables[0]
    further = sorted(path for path in folder.glob("*/*.csv") if not path.name.startswith("."))[:_MAX_NAMED]
    several = f"name the table with --targets, {' or '.join(map(str, tables[:_MAX_NAMED]))}"
    if tables:
        raise TactipError(f"{folder} has no targets.csv: {several}")
    hint = f", {' or '.join(map(str, further))}, or import its folder" if further else ""
    raise TactipError(f"the table {folder / _TABLES[0]} does not exist: name the table with --targets{hint}")


_MAX_NAMED = 5
"""Maximum number of tables that a message names."""


def _frame_path(folder: Path, name: str) -> Path | None:
    """Return the file of a frame named in the table; None if there is none inside the set's folder.

    The longest end of the name that leads to a file counts, so `run2/frame_1` is not taken for another run's `frame_1`.
    """
    parts = name.replace("\\", "/")
    if not parts or ".." in Path(parts).parts:
        return None
    parts = parts.removeprefix(f"{folder.resolve()}/")  # of an absolute path, where the set was recorded
    tails = [one for one in Path(parts).parts if one != "/"]
    for first in range(len(tails)):
        tail = "/".join(tails[first:])
        for place, suffix in itertools.product(FOLDERS, ("", *IMAGES, *VIDEOS)):
            whole = Path(tail).with_suffix("") if Path(tail).suffix.lower() == suffix else tail
            for end in dict.fromkeys((suffix, suffix.upper())):
                path = folder / place / f"{whole}{end}"
                with suppress(OSError):  # a name that is too long for a file
                    if path.is_file():
                        return path
    return None


def _check_distinct(names: Sequence[str], paths: Sequence[Path | None]) -> None:
    """Raise TactipError if two rows name different frames, but the same file is there for both."""
    first: dict[Path, str] = {}
    for name, path in zip(names, paths, strict=True):
        if path is not None and first.setdefault(path, name) != name:
            raise TactipError(
                f"the table must name frames that can be told apart: {first[path]!r} and {name!r} are different names, but "
                f"only {path} is there"
            )


def pin_detection_frames(recording: Recording) -> list[np.ndarray]:
    """Return up to PIN_DETECTION_FRAMES frames, evenly spread over a Recording, that can be read and have the most common
    size. Raises TactipError if none can be read."""
    frames, problem = [], ""
    for i in spread([i for i, path in enumerate(recording.paths) if path]):
        try:
            frames.append(recording.load(i))
        except TactipError as error:  # the import leaves it out later, and reports it
            problem = problem or f"{recording.names[i]}: {error}"
    if not frames:
        raise TactipError(f"none of the frames can be read, for example {problem}")
    usual = Counter(frame.shape for frame in frames).most_common(1)[0][0]
    return [frame for frame in frames if frame.shape == usual]


def frame_reader(recording: Recording, options: ImagePreprocessing, neutral: np.ndarray | None) -> FrameReader:
    """Return the FrameReader of a Recording, after trying it on one frame. Raises TactipError if the options do not fit."""
    others = [] if neutral is not None else pin_detection_frames(recording)
    first = neutral if neutral is not None else others[0]
    try:
        check_frame(first, options)
        reader = FrameReader(options, neutral, others)
        reader.read(first)
    except TactipError as error:
        what = "frames" if neutral is None else "neutral image"
        raise TactipError(f"the {what} cannot be used: {error}{_hint(first, options)}") from error
    return reader


def _hint(frame: np.ndarray, options: ImagePreprocessing) -> str:
    """Return what may be wrong with a frame (h, w, 3) uint8 in which no pins are detected; empty if nothing is known."""
    if frame.max() < _DARK:
        return f"; its pixels have values up to {frame.max()} only, of 255"
    thresholds = [(options.threshold, "")]
    if options.threshold is None:
        block = min(frame.shape[:2]) // _BLOCKS | 1
        thresholds.append(((block, _CONSTANT), f"if it is grey, give --threshold {block} {_CONSTANT:g}"))
    for threshold, grey in thresholds:
        for dark in (options.dark_pins, not options.dark_pins):
            darker = "if its pins are darker than what is around them, give --dark-pins" if dark > options.dark_pins else ""
            said = " and ".join(text for text in (grey, darker) if text)
            with suppress(TactipError):  # no pins this way either
                detect_pins(FrameReader(replace(options, dark_pins=dark, threshold=threshold, mask="none")).binary(frame))
                return f"; {said}" if said else ""
    return ""


_BLOCKS = 6
"""Height of a frame in blocks of the threshold that is suggested: a block of 61 px of 360, as the presets have."""

_CONSTANT = -5.0
"""Constant of that threshold, grey levels, as of the presets."""

_DARK = 32
"""Value of the brightest pixel below which a frame is called dark."""


def spread(items: Sequence[int], count: int = PIN_DETECTION_FRAMES) -> list[int]:
    """Return `count` of the items, evenly spread, or all if they are fewer."""
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, count).astype(int))]
