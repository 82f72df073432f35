"""Data-set format, the same for simulated and real sets: a folder.

    images/image_00000.png …   binary tactile images
    targets.csv                one row per image: labels and shears in mm and degrees, and measures of the simulation
    pins.npz                   simulated sets: tip and direction of every pin (m, sensor frame), rows as in targets.csv
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
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.dataset.configuration import REQUIRED_KEYS, Configuration
from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim.pose import to_mm_deg
from tactip_twin.tactip_model.design_file import from_dict
from tactip_twin.tactip_model.errors import TactipError

FORMAT = "tactip-twin data set"
VERSION = 2

MEASURES = (
    "normal_force_N",
    "tangential_force_N",
    "penetration_mm",
    "volume_ratio",
    "speed_mm_s",
    "solver_warnings",
    "steps",
    "tries",
)
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
    """Return a uint8 image as PNG. Raises TactipError where it has no such format."""
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
    ends: tuple[int, ...]
    """Row after the last of each shard; a set without shards counts as one."""

    @property
    def simulated(self) -> bool:
        """Whether the set was simulated, so the positions of its pins are known."""
        return all((part / "pins.npz").exists() for part in shard_dirs(self.folder, self.meta))

    def image(self, i: int) -> np.ndarray:
        """Return image i, (size, size) uint8. Raises TactipError where it cannot be read."""
        part = shard_dirs(self.folder, self.meta)[bisect.bisect_right(self.ends, i)]
        path = part / "images" / self.images[i]
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.exists() else None
        if image is None:
            raise TactipError(f"the image {path} cannot be read: the set is damaged, see `tactip dataset verify`")
        return image


def read_meta(folder: str | Path) -> dict[str, Any]:
    """Return the meta.json of a finished set. Raises TactipError where there is none, or one of something else."""
    path = Path(folder) / "meta.json"
    if not path.exists():
        if (Path(folder) / PARTIAL).exists():
            raise TactipError(f"the set in {folder} is unfinished: run the command that makes it again to resume it")
        raise TactipError(f"there is no data set in {folder}: it has no meta.json")
    try:
        meta = json.loads(path.read_text())
    except (ValueError, OSError) as error:
        raise TactipError(f"{path} cannot be read as JSON: {error}") from error
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        raise TactipError(f"{path} does not describe a data set of this project: its format is not {FORMAT!r}")
    if meta.get("version") != VERSION:
        raise TactipError(
            f"{path} has version {meta.get('version')!r}, but this program reads version {VERSION}: make the set again by "
            "`tactip dataset make`, or a real one by `tactip import`"
        )
    return meta


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
    """Return the rows of targets.csv, by column. Raises TactipError where it is missing or lacks a needed column."""
    path = Path(folder) / "targets.csv"
    try:
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
            columns = reader.fieldnames or []
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise TactipError(f"{path} cannot be read: {error}") from error
    missing = [c for c in COLUMNS[:13] if c not in columns]
    if missing:
        raise TactipError(f"{path} lacks the columns {', '.join(missing)}")
    return rows


def shard_dirs(folder: str | Path, meta: dict[str, Any]) -> list[Path]:
    """Return the folders that hold a set's images and tables: its shards, or its own. meta: its meta.json."""
    return [Path(folder) / name for name in meta["shards"]] if "shards" in meta else [Path(folder)]


def read_rows(folder: str | Path, meta: dict[str, Any]) -> list[dict[str, str]]:
    """Return the rows of a finished set, those of all its shards. Raises TactipError as `read_targets` does."""
    return [row for part in shard_dirs(folder, meta) for row in read_targets(part)]


def read_dataset(folder: str | Path) -> Dataset:
    """Read the labels and image names of a finished set. Raises TactipError where it cannot be read."""
    folder = Path(folder)
    meta = read_meta(folder)
    names, poses, shears, ends = [], [], [], []
    for part in shard_dirs(folder, meta):
        rows = read_targets(part)
        try:
            poses.append(np.array([[float(row[c]) for c in LABELS] for row in rows]).reshape(-1, 6))
            shears.append(np.array([[float(row[c]) for c in SHEARS] for row in rows]).reshape(-1, 6))
        except (TypeError, ValueError) as error:
            raise TactipError(f"{part / 'targets.csv'} has a cell that is not a number: {error}") from error
        names += [row["sensor_image"] for row in rows]
        ends.append(len(names))
    return Dataset(folder, meta, tuple(names), np.concatenate(poses), np.concatenate(shears), tuple(ends))


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
    for part in shard_dirs(folder, meta):
        path = part / "pins.npz"
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as pins:
                pin_tips.append(pins["pin_tips"])
                directions.append(pins["directions"])
        except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise TactipError(f"{path} cannot be read ({error}): only simulated sets have pins") from error
    return np.concatenate(pin_tips), np.concatenate(directions)


def labels_sha256(meta: dict[str, Any]) -> str | None:
    """Return a checksum, in hex, of the labels of a set; None where meta.json has none.

    For a set of shards it is a checksum of their meta.json files, which cover everything.
    """
    files = meta.get("files", {})
    return checksum(json.dumps(files, sort_keys=True).encode()) if "shards" in meta else files.get("targets.csv")
