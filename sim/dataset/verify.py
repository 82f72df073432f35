"""Verification of data sets: every property of the format is checked, and every violation is a sentence."""

import zipfile
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tactip_twin.sim.dataset.configuration import digest_of, samples_per_contact
from tactip_twin.sim.dataset.format import COLUMNS, checksum, image_name, read_configuration, read_meta, read_targets
from tactip_twin.sim.dataset.sampling import seed_text
from tactip_twin.sim.dataset.shards import shards_of
from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.tactip_model.errors import TactipError

_ROUNDING = 1e-6
"""Distance that a cell may lie outside its range, because the table has six decimals, mm or degrees."""


def verify(folder: str | Path) -> list[str]:
    """Return what is wrong with a finished set, as sentences. Raises TactipError where there is no set to check."""
    folder = Path(folder)
    meta = read_meta(folder)
    return _shards(folder, meta) if "shards" in meta else _single(folder, meta)


def _shards(folder: Path, meta: dict[str, Any]) -> list[str]:
    """Return the problems of a set of shards: those of its manifest, and those of each shard."""
    problems, counts = _files(folder, meta) + _altered(meta), {"asked": 0, "kept": 0, "failed": 0}
    try:
        expected = shards_of(read_configuration(meta, folder))
    except TactipError as error:
        return [*problems, str(error)]
    if meta["shards"] != list(expected):
        problems.append(f"meta.json: shards are {meta['shards']}, expected {list(expected)}")
    for name in sorted({path.name for path in folder.glob("shard-*")} - set(expected)):
        problems.append(f"{name}: not a shard of this set")
    for name, configuration in expected.items():
        try:
            own = read_meta(folder / name)
            for key in counts:
                counts[key] += own["samples"][key]
            if own.get("configuration") != configuration.as_json():
                problems.append(f"{name}: has another configuration")
            problems += [f"{name}/{problem}" for problem in verify(folder / name)]
        except (TactipError, KeyError) as error:
            problems.append(f"{name}: {error}")
    if counts != meta.get("samples"):
        problems.append(f"meta.json: samples are {meta.get('samples')}, but its shards have {counts}")
    return problems


def _altered(meta: dict[str, Any]) -> list[str]:
    configuration = meta.get("configuration")
    if configuration is not None and digest_of(configuration) != meta.get("digest"):
        return ["meta.json: configuration altered: it does not match the digest"]
    return []


def _single(folder: Path, meta: dict[str, Any]) -> list[str]:
    """Return the problems of a set without shards, or of a shard."""
    configuration = meta.get("configuration")
    problems = _altered(meta)
    try:
        rows = read_targets(folder)
    except TactipError as error:
        return [*problems, str(error)]
    problems += _files(folder, meta) + _images(folder, meta, rows) + _rows(rows, meta)
    if _simulated(configuration):
        problems += _pins(folder, meta, rows)
    return problems


def _files(folder: Path, meta: dict[str, Any]) -> list[str]:
    problems = []
    for name, expected in meta.get("files", {}).items():
        path = folder / name
        if not path.exists():
            problems.append(f"{name}: missing")
        elif checksum(path.read_bytes()) != expected:
            problems.append(f"{name}: altered: it does not match the checksum in meta.json")
    return problems


def _images(folder: Path, meta: dict[str, Any], rows: list[dict[str, str]]) -> list[str]:
    named = [row["sensor_image"] for row in rows]
    problems = [f"targets.csv: the image {n} has more than one row" for n, k in sorted(Counter(named).items()) if k > 1]
    existing = {path.name for path in (folder / "images").glob("*")}
    problems += [f"images/{name}: missing" for name in sorted(set(named) - existing)]
    problems += [f"images/{name}: has no row in targets.csv" for name in sorted(existing - set(named))]
    expected = meta.get("images", {})
    size = (meta.get("configuration") or {}).get("design", {}).get("image", {}).get("size_px")
    for name in sorted(set(named) & existing):
        data = (folder / "images" / name).read_bytes()
        if name in expected and checksum(data) == expected[name]:
            continue
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if data else None
        if image is None:
            problems.append(f"images/{name}: truncated or not an image ({len(data)} bytes)")
        elif size is not None and image.shape != (size, size):
            problems.append(f"images/{name}: {image.shape[1]} by {image.shape[0]} px, expected {size} by {size}")
        elif name in expected:
            problems.append(f"images/{name}: altered: it does not match the checksum in meta.json")
        elif not np.isin(image, (0, 255)).all():
            problems.append(f"images/{name}: has values other than 0 and 255")
    return problems


def _rows(rows: list[dict[str, str]], meta: dict[str, Any]) -> list[str]:
    problems = []
    configuration = meta.get("configuration")
    kept = meta.get("samples", {}).get("kept")
    if kept is not None and kept != len(rows):
        problems.append(f"targets.csv: has {len(rows)} rows, expected {kept} by meta.json")
    ranges = {}
    if configuration is not None:
        # On a sliding path the shear is the whole motion since the first contact, which no range limits.
        slides = configuration.get("snapshots_per_contact", 1) > 1
        for columns, key in ((LABELS, "pose"), *(() if slides else ((SHEARS, "shear"),))):
            ranges.update(zip(columns, configuration[key].values(), strict=True))
    for number, row in enumerate(rows, start=2):
        where = f"targets.csv, line {number}"
        if None in row or None in row.values():
            problems.append(f"{where}: has more or fewer cells than the header")
            continue
        for column in (*LABELS, *SHEARS):
            try:
                value = float(row[column])
            except ValueError:
                problems.append(f"{where}: {column} is {row[column]!r}, not a number")
                continue
            if not np.isfinite(value):
                problems.append(f"{where}: {column} is {row[column]}, not a finite number")
            elif column in ranges and not ranges[column][0] - _ROUNDING <= value <= ranges[column][1] + _ROUNDING:
                problems.append(
                    f"{where}: {column} is {row[column]}, outside the set's range {ranges[column]}: "
                    "the row belongs to another configuration"
                )
        if configuration is not None and _simulated(configuration) and not _belongs(row, configuration):
            problems.append(f"{where}: seed {row.get('seed')!r} or the image does not belong to this set")
    return problems


def _simulated(configuration: dict[str, Any] | None) -> bool:
    """Return whether a set with this configuration was simulated, not imported."""
    return configuration is not None and "fidelity" in configuration


def _belongs(row: dict[str, str], configuration: dict[str, Any]) -> bool:
    """Return whether the index, seed and image of a row match each other and the set."""
    if any(row.get(c) is None for c in COLUMNS) or not row["index"].isdigit():
        return False
    index = int(row["index"])
    number = index // samples_per_contact(configuration)
    seed = seed_text(configuration["seed"], configuration["task"], configuration["split"], number)
    inside = 0 <= index - configuration.get("first", 0) < configuration["samples"]
    return inside and row["seed"] == seed and row["sensor_image"] == image_name(index)


def _pins(folder: Path, meta: dict[str, Any], rows: list[dict[str, str]]) -> list[str]:
    path = folder / "pins.npz"
    if not path.exists():
        return []  # reported by its checksum
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as pins:
            digest, tips = str(pins["digest"]), pins["pin_tips"]
            finite = all(np.isfinite(pins[k]).all() for k in ("pin_tips", "directions"))
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        return [f"pins.npz: cannot be read: {error}"]
    problems = []
    if digest != meta["digest"]:
        problems.append("pins.npz: belongs to a set of another configuration")
    if len(tips) != len(rows):
        problems.append(f"pins.npz: has {len(tips)} records, targets.csv {len(rows)} rows")
    if not finite:
        problems.append("pins.npz: has numbers that are not finite")
    return problems
