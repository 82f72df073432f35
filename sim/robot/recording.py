"""A trajectory on disk: what a servo did, step by step, and all that is needed to look at it without playing it again.

recording.json    what was asked for and with what; once it is complete, also events and why it stopped
scenery.npz       what stands there: the object, the skin's triangles (see RecordedScene)
steps.npz         an array a quantity, a row a control step (see ARRAYS); images are packed, eight pixels a byte
steps.log         the same while it is not complete, a frame a step: what a kill leaves can be read to its last whole frame
"""

import contextlib
import io
import json
import struct
import zipfile
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file

FORMAT, VERSION = "tactip-twin recording", 2

RECORDING, SCENERY, STEPS, LOG = "recording.json", "scenery.npz", "steps.npz", "steps.log"

_LOCK = ".lock"

_FRAME = struct.Struct("<QI")
"""Before each frame of the log: its length and its checksum."""

_LONGEST = 2**28
"""Bytes above which a frame's length is none."""

ARRAYS = {
    "T_base_tcp": (4, 4),
    "T_told": (4, 4),
    "angles_rad": (6,),
    "tips_m": (None, 3),
    "directions": (None, 3),
    "skin_m": (None, 3),
    "force_n": (3,),
    "felt": (6,),
    "true": (6,),
    "touching": (),
    "penetration_m": (),
    "phase": (),
    "part": (),
    "sim_steps": (),
    "seconds": (4,),
    "images": (None, None),
}
"""Quantities and their shapes: the sensor's true pose and where its joints say it is, joint angles, pins and skin in the
sensor's frame, force on the tip in the sensor's frame, labels as they are felt and as they are (m, rad), how far the image
is from that of a tip in the air, penetration, phase (of PHASES), part of the route, time steps, time for simulation,
image, network and control, and packed images."""

PHASES = ("search", "centre", "follow", "approach", "shear", "settle")
"""Phases of a servo run, and of a contact. New ones go to the end: a recording has their numbers."""


@dataclass(frozen=True)
class RecordedScene:
    """What stands where a recording is made."""

    object_vertices: np.ndarray
    """(n, 3) m, the object's own frame."""
    object_triangles: np.ndarray
    """(k, 3) int."""
    T_base_object: np.ndarray
    """(4, 4)."""
    skin_triangles: np.ndarray
    """(t, 3) int, of the rows of skin_m."""
    tip_radius_m: float
    """Radius of the tip, m."""
    with_arm: bool
    """Whether an arm carries it."""


class Recorder:
    """Writes a recording as it grows."""

    def __init__(self, folder, description, scenery):
        """folder: path. description: dict, JSON: what was asked for. scenery: RecordedScene.

        Raises TactipError where the folder holds something else than an unfinished recording, and where another command
        records into it.
        """
        self.folder = Path(folder)
        if self.folder.exists() and not _unfinished(self.folder):
            raise TactipError(f"the folder {folder} is not empty: name another one, or remove this one")
        self.folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as held:
            held.enter_context(locked(self.folder / _LOCK, f"recording into {folder}"))
            self._description, self._rows, self._events = description, [], []
            self.size_px = 0
            """Width of the images, px; 0 without."""
            self._log = held.enter_context(open(self.folder / LOG, "wb"))
            places = {"object_vertices": np.float32, "object_triangles": np.int32, "skin_triangles": np.int32}
            kept = {name: np.asarray(value, places.get(name)) for name, value in asdict(scenery).items()}
            write_file(self.folder / SCENERY, _bytes(kept, compressed=True))
            self._write_record(complete=False)
            self._held = held.pop_all()

    def add(self, row):
        """Keep a step: a dict of ARRAYS; `images` an image (size, size) uint8 or None."""
        row = dict(row)
        image = row.pop("images")
        if image is not None:
            self.size_px = len(image)
        row["images"] = np.packbits(image > 127, axis=-1) if image is not None else np.zeros((0, 0), np.uint8)
        row["phase"] = PHASES.index(row["phase"])
        row = {name: _array(name, row[name]) for name in ARRAYS}
        self._rows.append(row)
        self._append(row)

    def note(self, event):
        """Keep an event: a dict, JSON."""
        self._events.append(event)
        self._append({"event": np.frombuffer(json.dumps(event).encode(), np.uint8)})

    def finish(self, outcome):
        """Complete the recording. outcome: dict, JSON. Returns record and arrays, as read_recording does."""
        arrays = _stacked(self._rows)
        write_file(self.folder / STEPS, _bytes(arrays, compressed=True))
        self._description = {**self._description, **outcome}
        record = self._write_record(complete=True)
        self._held.close()
        (self.folder / LOG).unlink()
        return record, _unpacked(arrays, self.size_px)

    def _append(self, arrays):
        data = _bytes(arrays, compressed=False)
        self._log.write(_FRAME.pack(len(data), zlib.crc32(data)) + data)
        self._log.flush()

    def _write_record(self, complete):
        head = {
            "format": FORMAT,
            "version": VERSION,
            "complete": complete,
            "size_px": self.size_px,
            "steps": len(self._rows),
        }
        record = {**head, **self._description, "events": self._events}
        write_file(self.folder / RECORDING, (json.dumps(record, indent=1) + "\n").encode())
        return record


def read_recording(folder):
    """The record (dict) and arrays (dict, see ARRAYS) of a recording; images (n, size, size) uint8, 0 and 255.

    One that was not completed (`complete` in its record) has what was done to its last whole step. Raises TactipError where
    there is none, one of another version, or a damaged one.
    """
    folder = Path(folder)
    record = _read_record(folder)
    if not record["complete"]:
        rows, record["events"] = _read_log(folder / LOG)
        packed = [row["images"] for row in rows]
        record["size_px"], record["steps"] = (packed[0].shape[0] if packed else 0), len(rows)
        return record, _unpacked(_stacked(rows), record["size_px"])
    try:
        with np.load(folder / STEPS, allow_pickle=False) as file:
            arrays = {name: file[name] for name in ARRAYS}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise TactipError(f"the recording in {folder} cannot be read: {error!r}") from error
    if len({len(a) for a in arrays.values()}) > 1 or len(arrays["phase"]) != record["steps"]:
        raise TactipError(f"the recording in {folder} is damaged: its arrays have different lengths")
    return record, _unpacked(arrays, record["size_px"])


def read_recorded_scene(folder):
    """The RecordedScene of a recording. Raises TactipError where it cannot be read."""
    path = Path(folder) / SCENERY
    try:
        with np.load(path, allow_pickle=False) as file:
            kept = {name: file[name] for name in RecordedScene.__dataclass_fields__}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise TactipError(f"{path} cannot be read: {error!r}") from error
    return RecordedScene(**kept | {"tip_radius_m": float(kept["tip_radius_m"]), "with_arm": bool(kept["with_arm"])})


def _read_record(folder):
    path = folder / RECORDING
    if not path.exists():
        raise TactipError(f"there is no recording in {folder}: it has no {RECORDING}")
    try:
        record = json.loads(path.read_text())
        known = record.get("format") == FORMAT
    except (OSError, ValueError, AttributeError) as error:
        raise TactipError(f"{path} cannot be read: {error!r}") from error
    if not known:
        raise TactipError(f"{path} is no recording of this project")
    if record.get("version") != VERSION:
        raise TactipError(f"{path} has version {record.get('version')}, and version {VERSION} is read: record it anew")
    if not all(name in record for name in ("complete", "size_px", "steps", "events")):
        raise TactipError(f"{path} is damaged: it lacks what every recording has")
    return record


def _read_log(path):
    """Rows (list of dict) and events (list of dict) of a log, to its last whole frame."""
    rows, events = [], []
    try:
        with open(path, "rb") as file:
            while len(head := file.read(_FRAME.size)) == _FRAME.size:
                length, checksum = _FRAME.unpack(head)
                data = file.read(length) if length < _LONGEST else b""
                if len(data) < length or zlib.crc32(data) != checksum:
                    break
                with np.load(io.BytesIO(data), allow_pickle=False) as frame:
                    if "event" in frame:
                        events.append(json.loads(frame["event"].tobytes()))
                    else:
                        rows.append({name: frame[name] for name in ARRAYS})
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise TactipError(f"{path} cannot be read: {error!r}") from error
    return rows, events


def _unfinished(folder):
    """Whether a folder holds nothing, or a recording that was not completed and nothing else."""
    names = {p.name for p in folder.iterdir()}
    if not names <= {RECORDING, SCENERY, STEPS, LOG, _LOCK}:
        return False
    return RECORDING not in names or not _read_record(folder)["complete"]


def _stacked(rows):
    """Arrays (dict) of rows."""
    if not rows:
        return {name: np.zeros((0, *(n or 0 for n in shape)), _kind(name)) for name, shape in ARRAYS.items()}
    return {name: np.stack([row[name] for row in rows]) for name in ARRAYS}


def _unpacked(arrays, size_px):
    """Arrays with images (n, size, size) uint8, 0 and 255."""
    packed = arrays["images"]
    return arrays | {"images": 255 * np.unpackbits(packed, axis=-1)[..., :size_px] if size_px else packed}


def _kind(name):
    kinds = {"phase": np.uint8, "part": np.int32, "sim_steps": np.int32, "images": np.uint8}
    small = name in ("tips_m", "directions", "skin_m")
    return kinds.get(name, np.float32 if small else np.float64)


def _array(name, value):
    return np.asarray(value, _kind(name))


def _bytes(arrays, compressed):
    data = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(data, **arrays)
    return data.getvalue()
