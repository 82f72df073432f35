"""Records: what is kept of each contact while its set is unfinished, and how a finished set becomes records again."""

import io
import json
import zipfile

import numpy as np

from tactip_twin.sim.dataset.format import PARTIAL, read_meta, read_targets, samples_each
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file


def numbers_of(configuration):
    """Numbers (range) of the contacts that the samples of a set's Configuration take."""
    each = configuration.each
    return range(configuration.first // each, -(-(configuration.first + configuration.samples) // each))


def samples_of(configuration, number):
    """Indices (range) of the samples that contact `number` of a Configuration makes."""
    return _samples(number, configuration.each, configuration.first + configuration.samples)


def _samples(number, each, end):
    return range(number * each, min((number + 1) * each, end))


def record_path(folder, number):
    """Path of the record of contact `number` in a set's folder (Path)."""
    return folder / PARTIAL / f"{number:06d}.npz"


def pack_record(record, tips, directions):
    """The bytes of a record with its pins, each (rows, pins, 3).

    record: dict of rows; images, their checksums by name; failed, whether the contact has none; faults, of each try of the
    contact; missed, a list of the failures (dict: index, seed, tries) of single samples.
    """
    data = io.BytesIO()
    np.savez(
        data,
        record=np.array(json.dumps(record)),
        tips=np.asarray(tips, np.float32),
        directions=np.asarray(directions, np.float32),
    )
    return data.getvalue()


def read_record(path):
    """What pack_record put beside the pins: a dict."""
    with np.load(path, allow_pickle=False) as data:
        return json.loads(str(data["record"]))


def unpack_finished_set(folder):
    """Turn the finished set in a folder (Path) into records, so that it can grow; the caller holds the folder's lock.

    A contact whose samples are not all there is left out, to be made again. meta.json goes when every record is there, and
    before the rest of what a finished set has: a kill before that leaves the finished set, and one after it the records.
    Raises TactipError where a table is damaged, and OSError.
    """
    meta, rows = read_meta(folder), read_targets(folder)
    configuration = meta["configuration"]
    each = samples_each(configuration)
    try:
        with np.load(folder / "pins.npz", allow_pickle=False) as pins:
            tips, directions = pins["tips"], pins["directions"]
        where = {int(row["index"]): k for k, row in enumerate(rows)}
        failures = {f["index"]: f for f in meta["failures"]}
        if len(tips) != len(rows):
            raise ValueError(f"{len(tips)} records of pins for {len(rows)} rows")
        first = configuration.get("first", 0)
        end = first + configuration["samples"]
        for number in range(first // each, end // each):
            indices = _samples(number, each, end)
            missed = [failures[i] for i in indices if i in failures]
            record = {"rows": [], "faults": [], "failed": False, "images": {}, "missed": []}
            if len(missed) == len(indices):
                failure = missed[0]
                record |= {"rows": [{"seed": failure["seed"]}], "faults": failure["tries"], "failed": True}
                part = slice(0, 0)
            else:
                part = [where[i] for i in indices if i not in failures]
                kept = [rows[k] for k in part]
                names = [row["sensor_image"] for row in kept]
                record |= {"rows": kept, "images": {name: meta["images"][name] for name in names}, "missed": missed}
            write_file(record_path(folder, number), pack_record(record, tips[part], directions[part]))
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise TactipError(f"the set in {folder} cannot grow, since it is damaged: {error}") from error
    for name in ("meta.json", "run.json", "targets.csv", "pins.npz"):
        (folder / name).unlink(missing_ok=True)
