"""Validation of meta.json, before anything in it is used."""

import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from tactip_twin.sim.dataset.configuration import digest_of
from tactip_twin.sim.dataset.sampling import MAX_LABEL, Ranges
from tactip_twin.sim.labels import TASKS
from tactip_twin.tactip_model.errors import TactipError

FILES = (
    "targets.csv",
    "pins.npz",
    "mesh.npz",
    "import.json",
    "import.png",
    "neutral.png",
    "neutral_tactile.png",
    "blobs.npz",
)
"""Files that meta.json may give checksums of: the tables, and the files of an imported set (sim2real/importing)."""

_SHA256 = re.compile("[0-9a-f]{64}")

_IMAGE_NAME = re.compile(r"[\w-][\w.-]*", re.ASCII)

_SHARD_NAME = re.compile(r"shard-\d{5,}", re.ASCII)

_RANGES = tuple(field.name for field in fields(Ranges))


def check_meta(meta: dict[str, Any], path: Path) -> None:
    """Check the keys of a meta.json that readers use.

    Args:
        meta: Its content, of this project's format and version.
        path: The file, for the message.

    Raises:
        TactipError: A key is missing, is not of its type, or names a file outside of the set.
    """

    def need(condition: object, key: str, allowed: str) -> None:
        if not condition:
            raise TactipError(f"{path} is damaged: {key} must be {allowed}")

    configuration, files = meta.get("configuration"), meta.get("files")
    need(isinstance(configuration, dict) and configuration.get("task") in TASKS, "configuration", "an object with a task")
    for key in ("pose", "shear"):
        need(_are_ranges(meta["configuration"].get(key)), f"configuration.{key}", "a low and a high of each component")
    altered = meta.get("digest") != digest_of(meta["configuration"])
    need(not altered, "digest", "the checksum of configuration, which was altered")
    need(
        _are_counts(meta.get("samples")), "samples", "the numbers of samples asked, kept and failed, the first being the sum"
    )
    if "shards" in meta:
        names = meta["shards"]
        good = isinstance(names, list) and all(isinstance(name, str) and _SHARD_NAME.fullmatch(name) for name in names)
        need(good and names, "shards", "a list of the folders of the shards")
        good = _are_checksums(files, str.isprintable) and list(meta["files"]) == [f"{name}/meta.json" for name in names]
        need(good, "files", "a checksum of the meta.json of each shard")
        return
    good = _are_checksums(files, FILES.__contains__) and "targets.csv" in meta["files"]
    need(good, "files", f"checksums of targets.csv and of no other files than {', '.join(FILES)}")
    need(_are_checksums(meta.get("images"), _IMAGE_NAME.fullmatch), "images", "checksums of the images by name")
    failures = meta.get("failures")
    need(isinstance(failures, list) and all(map(_is_failure, failures)), "failures", "a list of objects, each of a failure")


def _are_ranges(value: object) -> bool:
    if not isinstance(value, dict) or tuple(value) != _RANGES:
        return False
    for ends in value.values():
        if not isinstance(ends, list) or [type(end) in (int, float) for end in ends] != [True, True]:
            return False
        if not -MAX_LABEL <= ends[0] <= ends[1] <= MAX_LABEL:
            return False
    return True


def _are_checksums(value: object, allows: Callable[[str], object]) -> bool:
    if not isinstance(value, dict):
        return False
    return all(allows(name) and isinstance(one, str) and _SHA256.fullmatch(one) for name, one in value.items())


def _are_counts(value: object) -> bool:
    if not isinstance(value, dict) or any(
        type(value.get(key)) is not int or value[key] < 0 for key in ("asked", "kept", "failed")
    ):
        return False
    return value["asked"] == value["kept"] + value["failed"]


def _is_failure(value: object) -> bool:
    """Return whether a value is a sample that failed (index, seed, tries) or a frame that was left out (row, frame, why)."""
    if not isinstance(value, dict):
        return False
    return {"row", "frame", "why"} <= set(value) or ({"seed", "tries"} <= set(value) and type(value.get("index")) is int)
