"""A trajectory on disk: what a servo did, step by step, and all that is needed to look at it without playing it again.

recording.json    what was asked for, versions, events, why it stopped; written last: a folder that has one is complete
steps.npz         an array a quantity, a row a control step (see Step); images are packed, eight pixels a byte
parts/            the same in pieces, while it is not complete: what a kill leaves
"""

import contextlib
import io
import json
import zipfile
from pathlib import Path

import numpy as np

from sim.dataset import write_file
from sim.lock import locked
from tactip_model.errors import TactipError

FORMAT, VERSION = "tactip-twin recording", 1

RECORDING, STEPS, PARTS = "recording.json", "steps.npz", "parts"

_LOCK = ".lock"

_PART = 50
"""Steps of a part."""

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

PHASES = ("search", "centre", "follow")


class Recorder:
    """Writes a recording as it grows."""

    def __init__(self, folder):
        """folder: path. Raises TactipError where it holds something else than an unfinished recording, and where another
        command records into it."""
        self.folder = Path(folder)
        if self.folder.exists() and any(p.name not in (PARTS, _LOCK) for p in self.folder.iterdir()):
            raise TactipError(f"the folder {folder} is not empty: name another one, or remove this one")
        (self.folder / PARTS).mkdir(parents=True, exist_ok=True)
        self._held = contextlib.ExitStack()
        self._held.enter_context(locked(self.folder / _LOCK, f"recording into {folder}"))
        for path in (self.folder / PARTS).iterdir():
            path.unlink()
        self._rows, self._parts = [], []
        self.size_px = 0
        """Width of the images, px; 0 without."""

    def add(self, row):
        """Keep a step: a dict of ARRAYS; `images` an image (size, size) uint8 or None."""
        row = dict(row)
        image = row.pop("images")
        if image is not None:
            self.size_px = len(image)
        row["images"] = np.packbits(image > 127, axis=-1) if image is not None else np.zeros((0, 0), np.uint8)
        row["phase"] = PHASES.index(row["phase"])
        self._rows.append(row)
        if len(self._rows) == _PART:
            self._flush()

    def _flush(self):
        if not self._rows:
            return
        part = {name: _array(name, [row[name] for row in self._rows]) for name in ARRAYS}
        write_file(self.folder / PARTS / f"{len(self._parts):05d}.npz", _bytes(part))
        self._parts.append(part)
        self._rows = []

    def finish(self, record):
        """Complete the recording. record: dict, JSON. Returns the arrays (dict), as read_recording does."""
        self._flush()
        parts = self._parts or [{name: np.zeros((0, *(n or 0 for n in shape))) for name, shape in ARRAYS.items()}]
        arrays = {name: np.concatenate([part[name] for part in parts]) for name in ARRAYS}
        write_file(self.folder / STEPS, _bytes(arrays))
        record = {"format": FORMAT, "version": VERSION, "size_px": self.size_px, "steps": len(arrays["phase"]), **record}
        write_file(self.folder / RECORDING, (json.dumps(record, indent=1) + "\n").encode())
        for path in (self.folder / PARTS).iterdir():
            path.unlink()
        (self.folder / PARTS).rmdir()
        self._held.close()
        return _unpacked(arrays, self.size_px)


def read_recording(folder):
    """The record (dict) and arrays (dict, see ARRAYS) of a complete recording; images (n, size, size) uint8, 0 and 255.

    Raises TactipError where there is none, or a damaged one.
    """
    folder = Path(folder)
    if not (folder / RECORDING).exists():
        raise TactipError(f"there is no complete recording in {folder}: it has no {RECORDING}")
    try:
        record = json.loads((folder / RECORDING).read_text())
        with np.load(folder / STEPS, allow_pickle=False) as file:
            arrays = {name: file[name] for name in ARRAYS}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise TactipError(f"the recording in {folder} cannot be read: {error!r}") from error
    if record.get("format") != FORMAT or record.get("version") != VERSION:
        raise TactipError(f"{folder / RECORDING} is no recording of this version of the project")
    if len({len(a) for a in arrays.values()}) > 1 or len(arrays["phase"]) != record.get("steps"):
        raise TactipError(f"the recording in {folder} is damaged: its arrays have different lengths")
    return record, _unpacked(arrays, record["size_px"])


def _unpacked(arrays, size_px):
    """Arrays with images (n, size, size) uint8, 0 and 255."""
    packed = arrays["images"]
    return arrays | {"images": 255 * np.unpackbits(packed, axis=-1)[..., :size_px] if size_px else packed}


def _array(name, values):
    kinds = {"phase": np.uint8, "part": np.int32, "sim_steps": np.int32, "images": np.uint8}
    small = name in ("tips_m", "directions", "skin_m")
    return np.array(values, kinds.get(name, np.float32 if small else np.float64))


def _bytes(arrays):
    data = io.BytesIO()
    np.savez_compressed(data, **arrays)
    return data.getvalue()
