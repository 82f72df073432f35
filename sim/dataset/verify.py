"""Verification of data sets: every property of the format is checked, and every violation is a sentence."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.dataset.configuration import samples_per_contact
from tactip_twin.sim.dataset.format import (
    COLUMNS,
    check_pins,
    checksum,
    image_name,
    read_configuration,
    read_meta,
    read_targets,
)
from tactip_twin.sim.dataset.generate import check
from tactip_twin.sim.dataset.mesh_states import parse_mesh_states
from tactip_twin.sim.dataset.sample_maker import object_places
from tactip_twin.sim.dataset.sampling import seed_text
from tactip_twin.sim.dataset.shards import shard_count, shard_name, shards_of
from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import read_arrays, read_file
from tactip_twin.tactip_model.input_images import decode_image

_ROUNDING = 1e-6
"""Distance that a cell may lie outside its range, because the table has six decimals, mm or degrees."""


def verify(folder: str | Path) -> list[str]:
    """Return the problems of a finished set, as sentences. Raises TactipError if there is no set to check."""
    problems = _verify(Path(folder))
    return problems or _object(Path(folder), read_meta(folder))


def _verify(folder: Path) -> list[str]:
    """Return the problems of a set, or of a shard."""
    try:
        meta = read_meta(folder)
    except TactipError as error:
        if not (folder / "meta.json").exists():
            raise
        return [str(error)]
    return _shards(folder, meta) if "shards" in meta else _single(folder, meta)


def _shards(folder: Path, meta: dict[str, Any]) -> list[str]:
    """Return the problems of a set of shards: those of its manifest, and those of each shard."""
    problems, counts = _files(folder, meta), {"asked": 0, "kept": 0, "failed": 0}
    try:
        whole = read_configuration(meta, folder)
        check(whole)
    except TactipError as error:
        return [*problems, str(error)]
    expected = [shard_name(k) for k in range(shard_count(whole))]
    if meta["shards"] != expected:
        problems.append(f"meta.json: shards are {meta['shards']}, expected {expected}")
    for name in sorted({path.name for path in folder.glob("shard-*")} - set(expected)):
        problems.append(f"{name}: not a shard of this set")
    for name, configuration in shards_of(whole):
        try:
            own = read_meta(folder / name)
            for key in counts:
                counts[key] += own["samples"][key]
            if own.get("configuration") != configuration.as_json():
                problems.append(f"{name}: has another configuration")
            # A problem that names its file in full needs no folder before it.
            found = _verify(folder / name)
            problems += [one if one.startswith(str(folder)) else f"{name}/{one}" for one in found]
        except (TactipError, KeyError) as error:
            problems.append(f"{name}: {error}")
    if counts != meta.get("samples"):
        problems.append(f"meta.json: samples are {meta.get('samples')}, but its shards have {counts}")
    return problems


def _single(folder: Path, meta: dict[str, Any]) -> list[str]:
    """Return the problems of a set without shards, or of a shard."""
    problems = _files(folder, meta)
    try:
        if _simulated(meta["configuration"]):
            check(read_configuration(meta, folder))
        rows = read_targets(folder)
    except TactipError as error:
        return [*problems, str(error)]
    problems += _images(folder, meta, rows) + _rows(rows, meta)
    if _simulated(meta["configuration"]):
        problems += _pins(folder, meta, rows) + _mesh(folder, meta, rows)
    return problems


def _object(folder: Path, meta: dict[str, Any]) -> list[str]:
    """Return the problem of the object of a set, if it has one."""
    if not _simulated(meta["configuration"]):
        return []
    try:
        object_places(read_configuration(meta, folder), folder)
    except TactipError as error:
        return [str(error)]
    return []


def _files(folder: Path, meta: dict[str, Any]) -> list[str]:
    problems = []
    for name, expected in meta["files"].items():
        path = folder / name
        if not path.exists():
            problems.append(f"{name}: missing")
            continue
        try:
            if checksum(read_file(path)) != expected:
                problems.append(f"{name}: altered: it does not match the checksum in meta.json")
        except TactipError as error:
            problems.append(str(error))
    return problems


def _images(folder: Path, meta: dict[str, Any], rows: list[dict[str, str]]) -> list[str]:
    named = [row["sensor_image"] for row in rows]
    problems = [f"targets.csv: the image {n} has more than one row" for n, k in sorted(Counter(named).items()) if k > 1]
    existing = {path.name for path in (folder / "images").glob("*")}
    problems += [f"images/{name}: missing" for name in sorted(set(named) - existing)]
    problems += [f"images/{name}: has no row in targets.csv" for name in sorted(existing - set(named))]
    expected = meta["images"]
    problems += [f"targets.csv: has no row for the image {name} of meta.json" for name in sorted(set(expected) - set(named))]
    configuration = meta["configuration"]
    size = configuration["design"]["image"]["size_px"] if _simulated(configuration) else None
    for name in sorted(set(named) & existing):
        try:
            data = read_file(folder / "images" / name)
        except TactipError as error:
            problems.append(str(error))
            continue
        if name not in expected:
            problems.append(f"images/{name}: has no checksum in meta.json")
        elif checksum(data) == expected[name]:
            continue
        else:
            problems.append(f"images/{name}: {_damage(data, size)}")
    return problems


def _damage(data: bytes, size: int | None) -> str:
    """Return the problem of an image that does not match its checksum. size: expected width, px, if it is known."""
    try:
        image = decode_image(data, "the image")
    except TactipError:
        return f"truncated or not an image ({len(data)} bytes)"
    if size is not None and image.shape != (size, size):
        return f"{image.shape[1]} by {image.shape[0]} px, expected {size} by {size}"
    return "altered: it does not match the checksum in meta.json"


def _rows(rows: list[dict[str, str]], meta: dict[str, Any]) -> list[str]:
    problems = []
    configuration = meta["configuration"]
    kept = meta["samples"]["kept"]
    if kept != len(rows):
        problems.append(f"targets.csv: has {len(rows)} rows, expected {kept} by meta.json")
    ranges = {}
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
        if _simulated(configuration) and not _belongs(row, configuration):
            problems.append(f"{where}: seed {row.get('seed')!r} or the image does not belong to this set")
    return problems


def _simulated(configuration: dict[str, Any]) -> bool:
    """Return whether a set with this configuration was simulated, not imported."""
    return "fidelity" in configuration


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
    if "pins.npz" not in meta["files"]:
        return ["meta.json: files has no checksum of pins.npz"]
    if not path.exists():
        return []  # reported by its checksum
    try:
        pins = check_pins(read_arrays(path), len(rows), path)
    except TactipError as error:
        return [str(error)]
    return [] if str(pins["digest"]) == meta["digest"] else ["pins.npz: belongs to a set of another configuration"]


def _mesh(folder: Path, meta: dict[str, Any], rows: list[dict[str, str]]) -> list[str]:
    """Return the problems of mesh.npz."""
    if not meta["configuration"].get("keep_mesh"):
        return []
    if "mesh.npz" not in meta["files"]:
        return ["meta.json: files has no checksum of mesh.npz"]
    try:
        states = parse_mesh_states(read_arrays(folder / "mesh.npz"), meta, folder / "mesh.npz")
    except TactipError as error:
        return [str(error)]
    each = samples_per_contact(meta["configuration"])
    missing = {int(row["index"]) // each for row in rows if row["index"].isdigit()} - set(states.numbers.tolist())
    return [f"mesh.npz: has no mesh of the contacts {sorted(missing)[:10]}"] if missing else []
