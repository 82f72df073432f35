"""Data-set format, the same for simulated and real sets: a folder.

    images/image_00000.png …   binary tactile images
    targets.csv                one row per image: labels and shears in mm and degrees, and measures of the simulation
    pins.npz                   simulated sets: tip and direction of every pin (m, sensor frame), rows as in targets.csv
    mesh.npz                   sets made with --keep-mesh: deformed meshes of the contacts (sim/dataset/mesh_states.py)
    meta.json                  configuration, versions, seed, failures, and a checksum of every file above
    run.json                   simulated sets: when, where and how fast it was made; the only file that differs between runs

meta.json is written last, so a folder with one is complete. Large sets are folders of such folders (sim/dataset/shards.py),
which readers take as one.
"""

import bisect
import csv
import hashlib
import io
import json
import platform
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.dataset.configuration import REQUIRED_KEYS, Configuration
from tactip_twin.sim.dataset.meta_check import check_meta
from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim.pose import to_mm_deg
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.design_file import from_dict
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import MAX_BYTES, MAX_JSON_BYTES, parse_arrays, parse_json, parse_table, read_file
from tactip_twin.tactip_model.input_images import decode_image
from tactip_twin.tactip_model.pins import neutral_pins

FORMAT = "tactip-twin data set"
VERSION = 4

FORCES = ("force_x_N", "force_y_N", "force_z_N")
"""Columns of the force of the object on the tip, in the sensor frame."""

EFFECTIVE_SHEARS = ("effective_shear_x_mm", "effective_shear_y_mm", "effective_shear_Rz_deg")
"""Columns of the motion of the rim relative to the patch of skin in contact (sim/contact/contact_patch.py)."""

MEASURES = (
    "normal_force_N",
    "tangential_force_N",
    *FORCES,
    *EFFECTIVE_SHEARS,
    "slip_fraction",
    "contact_area_mm2",
    "penetration_mm",
    "volume_ratio",
    "speed_mm_s",
    "solver_warnings",
    "steps",
    "tries",
)
READ_MEASURES = ("normal_force_N", *FORCES, *EFFECTIVE_SHEARS, "slip_fraction", "contact_area_mm2")
"""Measures of the contact, as far as readers use them; the others describe the simulation."""

COLUMNS = ("sensor_image", *LABELS, *SHEARS, *MEASURES, "index", "seed")
"""Columns of targets.csv of a simulated set; every set has the first thirteen."""

PARTIAL = ".partial"
"""Folder inside an unfinished set with the results so far."""


def checksum(data: bytes) -> str:
    """Return the SHA-256 of bytes, in hex."""
    return hashlib.sha256(data).hexdigest()


def versions() -> dict[str, str]:
    """Return the versions of the software that decides a set's bytes."""
    packages = ("mujoco", "numpy", "scipy", "opencv-contrib-python-headless", "scikit-robot-pyrender")
    return {
        "python": platform.python_version(),
        "tactip-twin": version("tactip-twin"),
        **{name: version(name) for name in packages},
    }


def image_name(index: int) -> str:
    """Return the file name of the image of sample `index`."""
    return f"image_{index:05d}.png"


def encode_image(image: np.ndarray) -> bytes:
    """Return a uint8 image as PNG. Raises TactipError if it has no such format."""
    ok, data = cv2.imencode(".png", image)
    if not ok:
        raise TactipError(f"an image of {image.dtype} {image.shape} cannot be written as PNG")
    return data.tobytes()


def row_of(contact: Contact, index: int, tries: int, seed: str) -> dict[str, Any]:
    """Return a row of targets.csv, by COLUMNS.

    Args:
        contact: Record of the contact.
        index: Index of the sample.
        tries: Number of tries that the contact took.
        seed: Seed of the contact.
    """
    values: dict[str, Any] = {"sensor_image": image_name(index)}
    values.update(zip(LABELS, to_mm_deg(contact.pose).tolist(), strict=True))
    values.update(zip(SHEARS, to_mm_deg(contact.shear).tolist(), strict=True))
    measures = (
        contact.normal_force_n,
        contact.tangential_force_n,
        *contact.force_n.tolist(),
        *to_mm_deg(contact.effective_shear)[[0, 1, 5]].tolist(),
        contact.slip_fraction,
        1e6 * contact.contact_area_m2,
        1e3 * contact.penetration_m,
        contact.volume_ratio,
        1e3 * contact.speed_m_s,
        contact.warnings,
        contact.steps,
        tries,
    )
    values.update(zip(MEASURES, measures, strict=True))
    return {**values, "index": index, "seed": seed}


def targets_csv(rows: Sequence[dict[str, Any]]) -> bytes:
    """Return targets.csv from rows by COLUMNS. Numbers have six decimals: nanometres and microdegrees."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow([f"{row[c]:.6f}" if isinstance(row[c], float) else row[c] for c in COLUMNS])
    return text.getvalue().encode()


def meta_json(
    configuration: Configuration, samples: dict[str, int], checksums: dict[str, str], more: dict[str, Any]
) -> bytes:
    """Return meta.json.

    Args:
        configuration: Configuration of the set.
        samples: Numbers of samples asked, kept and failed.
        checksums: Checksums by file name.
        more: Further keys of this set.
    """
    meta = {
        "format": FORMAT,
        "version": VERSION,
        "digest": configuration.digest(),
        "samples": samples,
        "configuration": configuration.as_json(),
        "versions": versions(),
        "timings": "run.json",
        "files": checksums,
        **more,
    }
    return (json.dumps(meta, indent=1) + "\n").encode()


@dataclass(frozen=True)
class Dataset:
    """A finished set of n images, real or simulated, as read from its folder."""

    folder: Path
    """Folder of the set."""
    meta: dict[str, Any]
    """Its meta.json."""
    images: tuple[str, ...]
    """(n) file names in `images/` of the folder or of its shards."""
    poses: np.ndarray
    """(n, 6) labels, mm and degrees."""
    shears: np.ndarray
    """(n, 6), mm and degrees."""
    measures: dict[str, np.ndarray]
    """(n,) each of READ_MEASURES, by column; NaN where the set does not have it."""
    ends: tuple[int, ...]
    """Row after the last of each shard; a set without shards counts as one."""
    checksums: tuple[str, ...]
    """(n) SHA-256 of the images, in hex."""

    @property
    def simulated(self) -> bool:
        """Whether the set was simulated, so the positions of its pins are known."""
        return all((part / "pins.npz").exists() for part in shard_dirs(self.folder, self.meta))

    def image(self, i: int) -> np.ndarray:
        """Return image i, (size, size) uint8. Raises TactipError if it cannot be read or does not match its checksum."""
        part = shard_dirs(self.folder, self.meta)[bisect.bisect_right(self.ends, i)]
        path = part / "images" / self.images[i]
        return decode_image(read_unaltered(path, self.checksums[i]), str(path))


MAX_PINS_BYTES = MAX_BYTES - 2**20
"""Maximum size of the pins of a set without shards, or of a shard, bytes, so pins.npz can be read again."""


def pins_bytes(design: Design) -> int:
    """Return the size of the pins of one sample in pins.npz, bytes."""
    return 2 * neutral_pins(design)[0].size * np.dtype(np.float32).itemsize


def read_meta(folder: str | Path) -> dict[str, Any]:
    """Return the meta.json of a finished set. Raises TactipError if there is none, or one of something else."""
    path = Path(folder) / "meta.json"
    if not path.exists():
        if (Path(folder) / PARTIAL).exists():
            raise TactipError(f"the set in {folder} is unfinished: run the command that makes it again to resume it")
        inside = sorted(one.parent.name for one in Path(folder).glob("*/meta.json"))
        sets = f", but it has the sets {', '.join(inside[:5])}: name one of these" if inside else ""
        raise TactipError(f"there is no data set in {folder}: it has no meta.json{sets}")
    return parse_meta(read_file(path, MAX_JSON_BYTES), path)


def parse_meta(data: bytes, path: Path) -> dict[str, Any]:
    """Return the meta.json of a finished set from its bytes. path: the file, for messages. Raises as `read_meta` does."""
    meta = parse_json(data, str(path))
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        raise TactipError(f"{path} does not describe a data set of this project: its format is not {FORMAT!r}")
    if meta.get("version") != VERSION:
        raise TactipError(
            f"{path} has version {meta.get('version')!r}, but this program reads version {VERSION}: make the set again by "
            "`tactip dataset make`, or a real one by `tactip import`"
        )
    check_meta(meta, path)
    return meta


def read_unaltered(path: Path, expected: str) -> bytes:
    """Return the content of a file of a set. Raises TactipError if it is missing or does not match its checksum."""
    data = read_file(path)
    if checksum(data) != expected:
        raise TactipError(f"{path} was altered: it does not match its checksum in meta.json; see `tactip dataset verify`")
    return data


def read_configuration(meta: dict[str, Any], folder: str | Path) -> Configuration:
    """Return the configuration of a simulated set.

    Args:
        meta: Its meta.json.
        folder: Its folder, for messages.

    Raises:
        TactipError: It has no configuration, or one of another version of the project.
    """
    if not isinstance(meta.get("configuration"), dict) or "fidelity" not in meta["configuration"]:
        raise TactipError(f"the set in {folder} was not simulated: it has no configuration to simulate its contacts from")
    for key in REQUIRED_KEYS:
        if key not in meta["configuration"]:
            raise TactipError(f"{folder}: configuration lacks the field {key!r}")
    return from_dict(Configuration, meta["configuration"], f"{folder}: configuration")


def read_targets(folder: str | Path) -> list[dict[str, str]]:
    """Return the rows of targets.csv, by column. Raises TactipError if it is missing or lacks a needed column."""
    path = Path(folder) / "targets.csv"
    return _parse_targets(read_file(path), path)


def _parse_targets(data: bytes, path: Path) -> list[dict[str, str]]:
    columns, rows = parse_table(data, str(path))
    missing = [c for c in COLUMNS[:13] if c not in columns]
    if missing:
        raise TactipError(f"{path} lacks the columns {', '.join(missing)}")
    return rows


def shard_dirs(folder: str | Path, meta: dict[str, Any]) -> list[Path]:
    """Return the folders that hold a set's images and tables: its shards, or its own. meta: its meta.json."""
    return [Path(folder) / name for name in meta["shards"]] if "shards" in meta else [Path(folder)]


def read_parts(folder: str | Path, meta: dict[str, Any]) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the folder and the meta.json of each shard of a set, or its own. Raises TactipError if one was altered."""
    if "shards" not in meta:
        yield Path(folder), meta
        return
    for part in shard_dirs(folder, meta):
        path = part / "meta.json"
        own = parse_meta(read_unaltered(path, meta["files"][f"{part.name}/meta.json"]), path)
        if "shards" in own:
            raise TactipError(f"{part} must be a shard, but it has shards itself")
        yield part, own


def read_rows(folder: str | Path, meta: dict[str, Any]) -> list[dict[str, str]]:
    """Return the rows of a finished set, those of all its shards.

    Raises:
        TactipError: A table was altered, does not have a row for each image, or has short rows.
    """
    return [row for part, own in read_parts(folder, meta) for row in _rows_of(part, own)]


def _rows_of(part: Path, meta: dict[str, Any]) -> list[dict[str, str]]:
    path = part / "targets.csv"
    rows = _parse_targets(read_unaltered(path, meta["files"]["targets.csv"]), path)
    if any(None in row or None in row.values() for row in rows):
        raise TactipError(f"{path} has a row with more or fewer cells than the header")
    names = [row["sensor_image"] for row in rows]
    if len(set(names)) < len(names) or set(names) != set(meta["images"]):
        raise TactipError(f"{path} must have one row for each image in meta.json")
    if "fidelity" in meta["configuration"] and not all(re.fullmatch(r"[0-9]{1,18}", row.get("index", "")) for row in rows):
        raise TactipError(f"{path} must have the index of a sample in every row")
    return rows


def read_dataset(folder: str | Path) -> Dataset:
    """Read the labels and image names of a finished set. Raises TactipError if it cannot be read or was altered."""
    folder = Path(folder)
    meta = read_meta(folder)
    names, poses, shears, measures, ends, checksums = [], [], [], [], [], []
    for part, own in read_parts(folder, meta):
        rows = _rows_of(part, own)
        try:
            poses.append(np.array([[float(row[c]) for c in LABELS] for row in rows]).reshape(-1, 6))
            shears.append(np.array([[float(row[c]) for c in SHEARS] for row in rows]).reshape(-1, 6))
            values = [[float(row.get(c, "nan")) for c in READ_MEASURES] for row in rows]
            measures.append(np.array(values).reshape(-1, len(READ_MEASURES)))
        except (TypeError, ValueError) as error:
            raise TactipError(f"{part / 'targets.csv'} has a cell that is not a number: {error}") from error
        names += [row["sensor_image"] for row in rows]
        checksums += [own["images"][row["sensor_image"]] for row in rows]
        ends.append(len(names))
    by_column: dict[str, np.ndarray] = dict(zip(READ_MEASURES, np.concatenate(measures).T, strict=True))
    return Dataset(
        folder, meta, tuple(names), np.concatenate(poses), np.concatenate(shears), by_column, tuple(ends), tuple(checksums)
    )


def pack_pins(configuration: Configuration, pin_tips: Sequence[np.ndarray], directions: Sequence[np.ndarray]) -> bytes:
    """Return pins.npz.

    Args:
        configuration: Configuration of the set.
        pin_tips: Pin tips (p, 3), m, of each sample, sensor frame.
        directions: Unit directions (p, 3) of the pins.
    """
    neutral_tips, neutral_directions = neutral_pins(configuration.design)
    pins, shape = io.BytesIO(), (-1, len(neutral_tips), 3)
    np.savez(
        pins,
        pin_tips=np.array(pin_tips, np.float32).reshape(shape),
        directions=np.array(directions, np.float32).reshape(shape),
        neutral_tips=neutral_tips.astype(np.float32),
        neutral_directions=neutral_directions.astype(np.float32),
        digest=np.array(configuration.digest()),
    )
    return pins.getvalue()


def read_pins(folder: str | Path, meta: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return the pin tips and directions of a simulated set; rows as of `read_dataset`.

    Args:
        folder: Folder of the set.
        meta: Its meta.json.

    Returns:
        Pin tips (n, p, 3), m, and unit directions (n, p, 3), float32, sensor frame.

    Raises:
        TactipError: The set has no pins, or they cannot be read.
    """
    pin_tips, directions = [], []
    for part, own in read_parts(folder, meta):
        path = part / "pins.npz"
        if "pins.npz" not in own["files"]:
            raise TactipError(f"the set in {folder} has no pins.npz: only simulated sets have pins")
        pins = check_pins(parse_arrays(read_unaltered(path, own["files"]["pins.npz"]), str(path)), len(own["images"]), path)
        pin_tips.append(pins["pin_tips"])
        directions.append(pins["directions"])
    try:
        return np.concatenate(pin_tips), np.concatenate(directions)
    except ValueError:
        raise TactipError(f"the shards of the set in {folder} must have the same number of pins") from None


def check_pins(pins: dict[str, np.ndarray], rows: int, path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of pins.npz.

    Args:
        pins: Its arrays.
        rows: Number of rows of targets.csv.
        path: The file, for messages.

    Raises:
        TactipError: An array is missing, of another shape or type, or not finite.
    """
    count = len(pins["neutral_tips"]) if np.ndim(pins.get("neutral_tips", 0)) else 0
    shapes = {
        "pin_tips": (rows, count, 3),
        "directions": (rows, count, 3),
        "neutral_tips": (count, 3),
        "neutral_directions": (count, 3),
    }
    for name, shape in shapes.items():
        array = pins.get(name)
        if array is None or array.dtype != np.float32 or array.shape != shape or not np.isfinite(array).all():
            got = "none" if array is None else f"{array.dtype} of shape {array.shape}"
            raise TactipError(f"{path}: {name} must be finite float32 of shape {shape}, got {got}")
    if np.shape(pins.get("digest", 0)) != () or pins["digest"].dtype.kind != "U":
        raise TactipError(f"{path}: digest must be a string")
    return pins


def labels_sha256(meta: dict[str, Any]) -> str | None:
    """Return a checksum, in hex, of the labels of a set; None where meta.json has none.

    For a set of shards it is a checksum of their meta.json files, which cover everything.
    """
    files = meta.get("files", {})
    return checksum(json.dumps(files, sort_keys=True).encode()) if "shards" in meta else files.get("targets.csv")
