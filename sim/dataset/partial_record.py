"""Records of the contacts of an unfinished data set, and how a finished set becomes records again."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.dataset.configuration import Configuration, samples_per_contact
from tactip_twin.sim.dataset.format import COLUMNS, PARTIAL, checksum, read_meta, read_pins, read_rows
from tactip_twin.sim.dataset.mesh_states import read_mesh_states
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.input_files import parse_json, read_arrays, read_file


def contact_numbers(configuration: Configuration) -> range:
    """Return the numbers of the contacts of a set."""
    each = configuration.samples_per_contact
    return range(configuration.first // each, -(-(configuration.first + configuration.samples) // each))


def sample_indices(configuration: Configuration, number: int) -> range:
    """Return the indices of the samples that contact `number` makes."""
    return _indices(number, configuration.samples_per_contact, configuration.first + configuration.samples)


def _indices(number: int, each: int, end: int) -> range:
    return range(number * each, min((number + 1) * each, end))


def record_path(folder: Path, number: int) -> Path:
    """Return the path of the record of contact `number` in a set's folder."""
    return folder / PARTIAL / f"{number:06d}.npz"


def pack_record(
    record: dict[str, Any], pin_tips: ArrayLike, directions: ArrayLike, states: ArrayLike | None = None
) -> bytes:
    """Return the bytes of a record.

    Args:
        record: A JSON object with `rows`; `images`, checksums by name; `failed`, whether the contact has no samples;
            `violations` of each try of the contact; `missed`, the failures (index, seed, tries) of single samples.
        pin_tips: (rows, pins, 3), m, sensor frame.
        directions: (rows, pins, 3), unit, sensor frame.
        states: (1 + images per contact, vertices, 3), m, sensor frame (mesh_states.py); None where the set keeps no mesh, or
            the contact failed.
    """
    data = io.BytesIO()
    arrays = {"pin_tips": np.asarray(pin_tips, np.float32), "directions": np.asarray(directions, np.float32)}
    if states is not None:
        arrays["states"] = np.asarray(states, np.float32)
    np.savez(data, allow_pickle=False, record=np.array(json.dumps(record)), **arrays)
    return data.getvalue()


def read_record(path: Path, keep_mesh: bool = False) -> dict[str, Any] | None:
    """Return the JSON object in a record, without its arrays; None if the record is missing or damaged.

    Args:
        path: Its file.
        keep_mesh: Whether the set keeps the meshes of its contacts.
    """
    try:
        data = read_arrays(path)
        record = parse_json(str(data["record"]), str(path))
        if not {"pin_tips", "directions"} <= set(data):
            return None
    except (TactipError, KeyError):
        return None
    if not isinstance(record, dict) or not isinstance(record.get("images"), dict):
        return None
    if keep_mesh and not record.get("failed") and "states" not in data:
        return None
    # An earlier version wrote fewer columns: its contacts are simulated again.
    rows = [] if record.get("failed") else record.get("rows", [])
    return record if all(isinstance(row, dict) and set(COLUMNS) <= set(row) for row in rows) else None


def check_unaltered(folder: Path, meta: dict[str, Any]) -> None:
    """Raise TactipError if a table or an image does not match its checksum in meta.json; missing images are made again."""
    images = {f"images/{name}": value for name, value in meta.get("images", {}).items()}  # a set of shards has none
    expected = meta["files"] | images
    for name, value in expected.items():
        path = folder / name
        if name.startswith("images/") and not path.exists():
            continue
        if not path.exists() or checksum(read_file(path)) != value:
            problem = "does not match its checksum in meta.json" if path.exists() else "is missing"
            raise TactipError(
                f"the set in {folder} cannot grow because {name} {problem}: restore the file, or make another set"
            )


def unpack_finished_set(folder: Path) -> None:
    """Turn a finished set into records, so it can grow. The caller holds the folder's lock.

    A contact that lacks some of its samples is left out and will be made again. meta.json is removed once every record is
    written, and before the other files of a finished set: a kill before that leaves the finished set, a later one the
    records.

    Raises:
        TactipError: A table or an image does not match its checksum in meta.json.
        OSError: A file cannot be written.
    """
    meta = read_meta(folder)
    check_unaltered(folder, meta)
    rows = read_rows(folder, meta)
    configuration = meta["configuration"]
    each = samples_per_contact(configuration)
    pin_tips, directions = read_pins(folder, meta)
    states = read_mesh_states(folder, meta).by_contact() if configuration["keep_mesh"] else {}
    try:
        row_by_index = {int(row["index"]): k for k, row in enumerate(rows)}
        failures = {f["index"]: f for f in meta["failures"]}
        first = configuration.get("first", 0)
        end = first + configuration["samples"]
        for number in range(first // each, end // each):
            indices = _indices(number, each, end)
            missed = [failures[i] for i in indices if i in failures]
            record = {"rows": [], "violations": [], "failed": False, "images": {}, "missed": []}
            if len(missed) == len(indices):
                failure = missed[0]
                record |= {"rows": [{"seed": failure["seed"]}], "violations": failure["tries"], "failed": True}
                part = slice(0, 0)
            else:
                part = [row_by_index[i] for i in indices if i not in failures]
                kept = [rows[k] for k in part]
                names = [row["sensor_image"] for row in kept]
                record |= {"rows": kept, "images": {name: meta["images"][name] for name in names}, "missed": missed}
            packed = pack_record(record, pin_tips[part], directions[part], states.get(number))
            write_file(record_path(folder, number), packed)
    except (ValueError, KeyError, TypeError) as error:
        raise TactipError(f"the set in {folder} cannot grow because it is damaged: {error}") from error
    for name in ("meta.json", "run.json", "targets.csv", "pins.npz", "mesh.npz"):
        (folder / name).unlink(missing_ok=True)
