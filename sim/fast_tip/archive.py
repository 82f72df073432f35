"""Files of learned tips: an NPZ archive of arrays with a description as JSON, both with checksums."""

import hashlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import has_checksum, parse_arrays, parse_json, read_file, with_checksum

_MAX_FILE_BYTES = 2**25
"""Maximum size of a file, bytes."""


def pack(kind: str, version: int, description: dict[str, Any], arrays: dict[str, np.ndarray]) -> bytes:
    """Return the content of a file.

    Args:
        kind: Name of its format.
        version: Version of its format.
        description: What else it holds, as JSON values.
        arrays: Its arrays.
    """
    sums = {name: _checksum(array) for name, array in arrays.items()}
    text = json.dumps(with_checksum({"format": kind, "version": version} | description | {"arrays": sums}))
    data = io.BytesIO()
    np.savez(data, allow_pickle=False, **arrays, description=np.array(text))
    return data.getvalue()


def unpack(path: str | Path, kind: str, version: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the description and the arrays of a file.

    Raises:
        TactipError: It is not of this format and version, or was altered.
    """
    arrays = parse_arrays(read_file(path, _MAX_FILE_BYTES), str(path))
    text = arrays.pop("description", None)
    about = parse_json(str(text), str(path)) if text is not None else None
    if not isinstance(about, dict) or about.get("format") != kind or about.get("version") != version:
        raise TactipError(f"{path} must be a file of the format {kind!r}, version {version}: teach the tip again")
    if not has_checksum(about) or {name: _checksum(array) for name, array in arrays.items()} != about.get("arrays"):
        raise TactipError(f"{path} was altered: it does not match its own checksums; teach the tip again, or copy it again")
    return about, arrays


def _checksum(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def check_numbers(arrays: dict[str, np.ndarray], shapes: dict[str, tuple[int, ...]]) -> None:
    """Raise ValueError unless each named array consists of finite floats and has its shape, and all *scale are positive."""
    for name, shape in shapes.items():
        array = arrays[name]
        if array.shape != shape or array.dtype.kind != "f" or not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite numbers of shape {shape}, got {array.dtype} of shape {array.shape}")
        if name.endswith("scale") and not (array > 0).all():
            raise ValueError(f"{name} must be positive")
