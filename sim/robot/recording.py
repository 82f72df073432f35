"""Recordings on disk: the steps of a servo run or a contact, to be replayed without simulating it again.

recording.json    settings, design and versions; once the recording is complete, also events and why the run stopped;
                  checksums of itself and of the files below
scenery.npz       the object and the skin's triangles (see RecordedScene)
steps.npz         one array per quantity, one row per control step (see ARRAYS); images are packed, eight pixels per byte
steps.log         the same while the recording is incomplete, one frame per step: after a kill, whole frames can be read
"""

import contextlib
import hashlib
import io
import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.labels import TASKS
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import is_leftover, remove_leftovers, write_file
from tactip_twin.tactip_model.input_files import (
    MAX_UNPACKED_BYTES,
    has_checksum,
    parse_arrays,
    parse_json,
    read_file,
    read_json,
    with_checksum,
)

FORMAT, VERSION = "tactip-twin recording", 6

RECORDING, SCENERY, STEPS, LOG = "recording.json", "scenery.npz", "steps.npz", "steps.log"

_LOCK = ".lock"

_FRAME = struct.Struct("<QI")
"""Header of a frame of the log: length in bytes and checksum."""

_MAX_STEPS_BYTES = MAX_UNPACKED_BYTES - 2**20
"""Maximum size of the steps of a recording, bytes, so the file with its headers can be read again."""

_MAX_FRAME_BYTES = 2**28
"""Length above which a frame's header counts as damaged, bytes."""

ARRAYS: dict[str, tuple[int | None, ...]] = {
    "T_base_tcp": (4, 4),
    "T_base_tcp_measured": (4, 4),
    "T_base_object": (4, 4),
    "angles_rad": (6,),
    "pin_tips_m": (None, 3),
    "directions": (None, 3),
    "skin_m": (None, 3),
    "force_n": (3,),
    "predicted": (6,),
    "predicted_from_image": (6,),
    "deviations": (6,),
    "true": (6,),
    "touching": (),
    "penetration_m": (),
    "phase": (),
    "part": (),
    "sim_steps": (),
    "seconds": (4,),
    "images": (None, None),
}
"""Quantities and their shapes per step:

T_base_tcp       the sensor's true pose
T_base_tcp_measured           the sensor's pose as measured by the joints
T_base_object    the object's pose
angles_rad       joint angles, rad; NaN without an arm
pin_tips_m           pin tips, sensor frame, m
directions       directions of the pins, sensor frame
skin_m           vertices of the skin, sensor frame, m
force_n          force on the tip, sensor frame, N
predicted        predicted label, m and rad; in a servo run with a filter, fused over steps
predicted_from_image  label predicted from the image of the step alone
deviations       standard deviations of the predicted label, m and rad; NaN where the estimator has none
true             true label, m and rad
touching         difference of the image from that of a tip in the air
penetration_m    penetration, m
phase            index into PHASES
part             part of the route
sim_steps        number of time steps
seconds          time for simulation, image, network and control, s
images           packed tactile image
"""

PHASES = ("search", "centre", "follow", "approach", "shear", "settle")
"""Phases of a servo run, and of a contact. A recording has their indices, so new ones are appended."""


@dataclass(frozen=True)
class RecordedScene:
    """The object, the skin and the arm of a recording."""

    object_vertices: np.ndarray
    """(n, 3) m, object's frame."""
    object_triangles: np.ndarray
    """(k, 3) int."""
    T_base_object: np.ndarray
    """(4, 4), at the start."""
    skin_triangles: np.ndarray
    """(t, 3) int, indices into the rows of skin_m."""
    tip_radius_m: float
    """Radius of the tip, m."""
    with_arm: bool
    """Whether the sensor is on an arm."""


class RecordingFullError(TactipError):
    """A recording would become larger than what is read back."""


class Recorder:
    """A recording that is being written."""

    def __init__(
        self,
        folder: str | PathLike[str],
        description: dict[str, Any],
        scenery: RecordedScene,
        beside: tuple[str, ...] = (),
    ) -> None:
        """Start a recording.

        Args:
            folder: Folder to write into. An unfinished recording of the same run in it is replaced.
            description: Settings of the run, as JSON values.
            scenery: The scene.
            beside: Names of files that the caller makes of a recording before it completes it: those of an unfinished
                recording are removed.

        Raises:
            TactipError: If the folder holds anything but an unfinished recording of the same run, or another command records
                into it.
        """
        self.folder = Path(folder)
        if self.folder.exists() and not _unfinished(self.folder, beside):
            raise TactipError(f"the folder {folder} is not empty: choose another folder, or remove this one")
        self.folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            stack.enter_context(locked(self.folder / _LOCK, f"recording into {folder}"))
            remove_leftovers(self.folder)
            _check_same_run(self.folder, description)
            for name in beside:
                (self.folder / name).unlink(missing_ok=True)
            self._description = description
            self._rows: list[dict[str, np.ndarray]] = []
            self._bytes = self._log_bytes = 0
            self._checksums: dict[str, str] = {}
            self._events: list[dict[str, Any]] = []
            self.size_px = 0
            """Width of the images, px; 0 without."""
            self._log = stack.enter_context(open(self.folder / LOG, "wb"))
            dtypes = {"object_vertices": np.float32, "object_triangles": np.int32, "skin_triangles": np.int32}
            fields = {name: np.asarray(value, dtypes.get(name)) for name, value in asdict(scenery).items()}
            self._write(SCENERY, fields)
            self._write_record(complete=False)
            self._open_files = stack.pop_all()

    def add(self, row: Mapping[str, Any]) -> None:
        """Add a step: a value for each name in ARRAYS, with `phase` as a name, and `images` (size, size) uint8 or None.

        Raises RecordingFullError where the recording would become larger than what is read back.
        """
        image = row["images"]
        if image is not None:
            self.size_px = len(image)
        packed = np.packbits(image > 127, axis=-1) if image is not None else np.zeros((0, 0), np.uint8)
        values = {**row, "images": packed, "phase": PHASES.index(row["phase"])}
        arrays = {name: np.asarray(values[name], _dtype(name)) for name in ARRAYS}
        self._bytes += sum(array.nbytes for array in arrays.values())
        if self._bytes > _MAX_STEPS_BYTES:
            raise self._full(_MAX_STEPS_BYTES)
        self._rows.append(arrays)
        self._append(arrays)

    def note(self, event: dict[str, Any]) -> None:
        """Add an event, of JSON values: step, kind and what."""
        self._events.append(event)
        self._append({"event": np.frombuffer(json.dumps(event).encode(), np.uint8)})

    def results(self, outcome: dict[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Return record and arrays as read_recording will, once the recording is complete; the record lacks its checksums.

        What is made of them can be written first, so a kill meanwhile leaves a recording that counts as unfinished, and the
        same command makes all of it again.

        Args:
            outcome: Outcome of the run, as JSON values.
        """
        self._description = {**self._description, **outcome}
        return self._record(complete=True), _unpacked(_stacked(self._rows), self.size_px)

    def finish(self, outcome: dict[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Complete the recording with its outcome, of JSON values. Return record and arrays, as read_recording does."""
        _, arrays = self.results(outcome)
        self._write(STEPS, _stacked(self._rows))
        record = self._write_record(complete=True)
        self._open_files.close()
        (self.folder / LOG).unlink()
        return record, arrays

    def _write(self, name: str, arrays: Mapping[str, Any]) -> None:
        """Write arrays to a file of the recording, and keep its checksum."""
        data = _bytes(arrays, compressed=True)
        write_file(self.folder / name, data)
        self._checksums[name] = hashlib.sha256(data).hexdigest()

    def _append(self, arrays: Mapping[str, np.ndarray]) -> None:
        data = _bytes(arrays, compressed=False)
        self._log_bytes += _FRAME.size + len(data)
        if self._log_bytes > _MAX_LOG_BYTES:
            raise self._full(_MAX_LOG_BYTES)
        try:
            self._log.write(_FRAME.pack(len(data), zlib.crc32(data)) + data)
            self._log.flush()
        except OSError as error:
            error.filename = str(self.folder / LOG)
            raise

    def _full(self, max_bytes: int) -> RecordingFullError:
        """Return the error of a recording that has `max_bytes`. Its steps so far can be read, and completed by `finish`."""
        return RecordingFullError(
            f"the recording in {self.folder} must have at most {max_bytes / 2**20:.0f} MiB, which it has after "
            f"{len(self._rows)} steps: record fewer steps, or use a coarser fidelity"
        )

    def _record(self, complete: bool) -> dict[str, Any]:
        head = {
            "format": FORMAT,
            "version": VERSION,
            "complete": complete,
            "size_px": self.size_px,
            "steps": len(self._rows),
        }
        return {**head, **self._description, "events": self._events}

    def _write_record(self, complete: bool) -> dict[str, Any]:
        """Write the record with the checksums of the files so far and of itself, and return it."""
        record = with_checksum({**self._record(complete), "files": self._checksums})
        write_file(self.folder / RECORDING, (json.dumps(record, indent=1) + "\n").encode())
        return record


def read_recording(folder: str | PathLike[str]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read a recording. An incomplete one is read up to its last whole step, and its record has `complete` False.

    Returns:
        The record (the content of recording.json), and the arrays (see ARRAYS), with images (n, size, size) uint8, 0 and
        255.

    Raises:
        TactipError: If there is no recording, or it is damaged or of another version.
    """
    folder = Path(folder)
    record = _read_record(folder)
    if not record["complete"]:
        rows, record["events"] = _read_log(folder / LOG)
        packed = [row["images"] for row in rows]
        record["size_px"], record["steps"] = (packed[0].shape[0] if packed else 0), len(rows)
        return record, _unpacked(_stacked(rows), record["size_px"])
    arrays = _checked(_read_unaltered(folder, STEPS, record), f"{folder / STEPS}", (record["steps"],))
    size = record["size_px"]
    if len(arrays["images"]) and arrays["images"].shape[1:] != (size, -(-size // 8)):
        raise TactipError(f"the recording in {folder} is damaged: its images are not {size} px wide")
    return record, _unpacked(arrays, record["size_px"])


def read_recorded_scene(folder: str | PathLike[str]) -> RecordedScene:
    """Read the scene of a recording. Raises TactipError where it cannot be read."""
    path = Path(folder) / SCENERY
    values = _read_unaltered(Path(folder), SCENERY, _read_record(Path(folder)))
    shapes = {"object_vertices": (None, 3), "object_triangles": (None, 3), "skin_triangles": (None, 3)}
    shapes |= {"T_base_object": (4, 4), "tip_radius_m": (), "with_arm": ()}
    for name, shape in shapes.items():
        kinds = {"object_triangles": "i", "skin_triangles": "i", "with_arm": "b"}
        if not _fits(values.get(name), shape) or values[name].dtype.kind not in kinds.get(name, "f"):
            raise TactipError(f"{path} is damaged: {name} is missing, or has another type or shape")
        if not np.isfinite(values[name]).all():
            raise TactipError(f"{path} is damaged: {name} must be finite")
    # Libraries that draw triangles do not check their indices.
    if _exceeds(values["object_triangles"], len(values["object_vertices"])):
        raise TactipError(f"{path} is damaged: object_triangles must be indices of object_vertices")
    if (values["skin_triangles"] < 0).any():
        raise TactipError(f"{path} is damaged: skin_triangles must not be negative")
    radius = float(values["tip_radius_m"])
    require(0 < radius < _MAX_RADIUS_M, f"tip_radius_m in {path}", radius, f"above 0 and below {_MAX_RADIUS_M:g}")
    return RecordedScene(
        values["object_vertices"],
        values["object_triangles"],
        values["T_base_object"],
        values["skin_triangles"],
        radius,
        bool(values["with_arm"]),
    )


_MAX_RADIUS_M = 1.0
"""Radius from which a recorded tip counts as damaged, m: far above that of any fingertip."""


def _fits(array: np.ndarray | None, shape: tuple[int | None, ...]) -> bool:
    """Return whether an array has a shape, in which None is any length."""
    if array is None or array.ndim != len(shape):
        return False
    return all(wanted in (None, length) for wanted, length in zip(shape, array.shape, strict=True))


def _exceeds(indices: np.ndarray, count: int) -> bool:
    return bool(((indices < 0) | (indices >= count)).any())


def _checked(arrays: dict[str, np.ndarray], name: str, rows: tuple[int, ...] = ()) -> dict[str, np.ndarray]:
    """Return the arrays of ARRAYS.

    Args:
        arrays: Arrays by name.
        name: Name of their file, for messages.
        rows: Number of steps, as the first dimension of every array; empty for the arrays of one step.

    Raises:
        TactipError: One is missing, has another type or shape, or a value that is not allowed.
    """
    for key, shape in ARRAYS.items():
        array = arrays.get(key)
        if array is None or array.dtype != _dtype(key) or not _fits(array, (*rows, *shape)):
            raise TactipError(f"{name} is damaged: {key} is missing, or has another type or shape")
    if (arrays["phase"] >= len(PHASES)).any():
        raise TactipError(f"{name} is damaged: phase must be an index of {', '.join(PHASES)}")
    for key in ("T_base_tcp", "T_base_tcp_measured", "T_base_object", "pin_tips_m", "directions", "skin_m", "force_n"):
        if not np.isfinite(arrays[key]).all():
            raise TactipError(f"{name} is damaged: {key} must be finite")
    return {key: arrays[key] for key in ARRAYS}


def check_skin(scenery: RecordedScene, arrays: dict[str, np.ndarray]) -> None:
    """Raise TactipError where the triangles of the skin are no indices of its vertices: what draws them does not check."""
    vertices = arrays["skin_m"].shape[1]
    if len(arrays["skin_m"]) and _exceeds(scenery.skin_triangles, vertices):
        raise TactipError(f"the recording is damaged: skin_triangles must be indices of its {vertices} vertices")


def _read_record(folder: Path) -> dict[str, Any]:
    path = folder / RECORDING
    if not path.exists():
        raise TactipError(f"there is no recording in {folder}: {RECORDING} is missing")
    record = read_json(path)
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise TactipError(f"{path} is not a recording of this project")
    if record.get("version") != VERSION:
        raise TactipError(
            f"{path} has version {record.get('version')}, but this program reads version {VERSION}: record it again"
        )
    if not has_checksum(record):
        raise TactipError(f"{path} was altered: it does not match its own checksum; copy it or record it again")
    kinds = {"complete": bool, "size_px": int, "steps": int, "events": list, "files": dict, "task": str, "object": str}
    for name, kind in kinds.items():
        if type(record.get(name)) is not kind:
            raise TactipError(f"{path} is damaged: {name} must be of the type {kind.__name__}, got {record.get(name)!r:.60}")
    if record["task"] not in TASKS or not 0 <= record["size_px"] <= _MAX_SIZE_PX or record["steps"] < 0:
        raise TactipError(f"{path} is damaged: the task, size_px or the number of steps is not allowed")
    for event in record["events"]:
        _check_event(event, str(path))
    return record


def _read_unaltered(folder: Path, name: str, record: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the arrays in a file of a recording. Raises TactipError where it does not match its checksum in the record."""
    # Numbers that cannot be compressed are a little larger when packed.
    data = read_file(folder / name, MAX_UNPACKED_BYTES + 2**20)
    if hashlib.sha256(data).hexdigest() != record["files"].get(name):
        raise TactipError(f"{folder / name} was altered: it does not match its checksum in {RECORDING}; copy it again")
    return parse_arrays(data, str(folder / name))


_MAX_SIZE_PX = 4096
"""Width above which recorded images count as damaged, px."""


def _check_event(event: Any, name: str) -> None:
    """Raise TactipError unless a JSON value is an event: step, kind and what. name: name of the file, for the message."""
    good = isinstance(event, dict) and type(event.get("step")) is int and event["step"] >= 0
    if not good or not isinstance(event.get("kind"), str) or not isinstance(event.get("what"), str):
        raise TactipError(f"{name} is damaged: an event must have a step, a kind and what happened, got {event!r:.60}")


def _read_log(path: Path) -> tuple[list[dict[str, np.ndarray]], list[dict[str, Any]]]:
    """Return rows and events of a log, up to its last whole frame."""
    rows, events = [], []
    file = io.BytesIO(read_file(path, _MAX_LOG_BYTES))
    while len(head := file.read(_FRAME.size)) == _FRAME.size:
        length, checksum = _FRAME.unpack(head)
        data = file.read(length) if length < _MAX_FRAME_BYTES else b""
        if len(data) < length or zlib.crc32(data) != checksum:
            break
        frame = parse_arrays(data, str(path))
        if "event" in frame:
            events.append(parse_json(frame["event"].tobytes(), str(path)))
            _check_event(events[-1], str(path))
        else:
            rows.append(_checked(frame, str(path)))
    if len({tuple(array.shape for array in row.values()) for row in rows}) > 1:
        raise TactipError(f"{path} is damaged: its steps have arrays of different shapes")
    return rows, events


_MAX_LOG_BYTES = 2**30
"""Maximum size of the log of an incomplete recording, bytes."""


def _unfinished(folder: Path, beside: tuple[str, ...]) -> bool:
    """Return whether a folder is empty, or holds an unfinished recording and nothing else.

    Args:
        folder: The folder.
        beside: Names of files that its caller makes of a recording before it completes it.
    """
    names = {p.name for p in folder.iterdir() if not is_leftover(p)}
    if not names <= {RECORDING, SCENERY, STEPS, LOG, _LOCK, *beside}:
        return False
    # The log is removed last.
    return RECORDING not in names or LOG in names or not _read_record(folder)["complete"]


def _check_same_run(folder: Path, description: Mapping[str, Any]) -> None:
    """Raise TactipError if a folder holds steps of an unfinished run with another description, whatever its versions."""
    if not (folder / RECORDING).exists() or not (folder / LOG).exists() or not (folder / LOG).stat().st_size:
        return
    before, now = _read_record(folder), json.loads(json.dumps(description))
    if any(before.get(name) != value for name, value in now.items() if name != "versions"):
        raise TactipError(
            f"the folder {folder} holds the steps of another run, which was interrupted: choose another folder, or remove "
            "this one"
        )


def _stacked(rows: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return one array per quantity, with the rows stacked."""
    if not rows:
        return {name: np.zeros((0, *(n or 0 for n in shape)), _dtype(name)) for name, shape in ARRAYS.items()}
    return {name: np.stack([row[name] for row in rows]) for name in ARRAYS}


def _unpacked(arrays: dict[str, np.ndarray], size_px: int) -> dict[str, np.ndarray]:
    """Return the arrays with unpacked images (n, size, size) uint8, 0 and 255."""
    packed = arrays["images"]
    return arrays | {"images": 255 * np.unpackbits(packed, axis=-1)[..., :size_px] if size_px else packed}


def _dtype(name: str) -> type[np.generic]:
    dtypes = {"phase": np.uint8, "part": np.int32, "sim_steps": np.int32, "images": np.uint8}
    large = name in ("pin_tips_m", "directions", "skin_m")
    return dtypes.get(name, np.float32 if large else np.float64)


def _bytes(arrays: Mapping[str, Any], compressed: bool) -> bytes:
    """Return arrays as an .npz file. Their type is Any because numpy mixes them with keyword arguments of its own."""
    data = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(data, **arrays)
    return data.getvalue()
