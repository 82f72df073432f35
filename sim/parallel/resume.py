"""Whether a command may continue the work in an output folder: it must be the same work, with the same settings."""

import json
from pathlib import Path
from typing import Any

from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import is_leftover


def check_resumable(folder: Path, kind: str, recorded: Any, requested: Any, own: tuple[str, ...] = ()) -> bool:
    """Return whether `folder` holds the requested work, unfinished or finished; False if it is empty or missing.

    Args:
        folder: Output folder, which need not exist.
        kind: What the folder holds, as a noun: "data set", "training".
        recorded: Settings (a JSON value) written there by the first command; None if there are none.
        requested: Settings (a JSON value) of this command.
        own: Names of files that every command of this kind leaves, lock files for example: they do not count, nor do the
            leftovers of kills.

    Raises:
        TactipError: If the folder holds something else, or the same with other settings; the first difference is named.
    """
    if recorded is None:
        if folder.exists() and any(path.name not in own and not is_leftover(path) for path in folder.iterdir()):
            raise TactipError(f"the folder {folder} is not empty and holds no {kind}: choose another folder")
        return False
    difference = first_difference(recorded, requested)
    if difference:
        name, old, new = difference
        raise TactipError(
            f"the folder {folder} holds a {kind} with other settings ({name} is {old} there, {new} here): "
            "choose another folder, or remove this one"
        )
    return True


def first_difference(recorded: Any, requested: Any, name: str = "") -> tuple[str, str, str] | None:
    """Return the first difference of two JSON values: name (keys joined by dots), and both values as JSON; None if equal."""
    if isinstance(recorded, dict) and isinstance(requested, dict):
        for key in sorted(set(recorded) | set(requested)):
            difference = first_difference(recorded.get(key), requested.get(key), f"{name}.{key}" if name else key)
            if difference:
                return difference
        return None
    return None if recorded == requested else (name, json.dumps(recorded), json.dumps(requested))
