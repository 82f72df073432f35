"""Reading files that may be damaged or malicious: type, size and depth are checked before the content is used.

Every function raises TactipError, with one sentence that names the file, and uses bounded memory whatever the file holds.
"""

import io
import json
import math
import stat
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from tactip_twin.tactip_model.errors import TactipError

MAX_BYTES = 2**28
"""Maximum size of a file, bytes. The tables of a shard of 10,000 samples of 331 pins have 80 MB."""

MAX_UNPACKED_BYTES = 2**29
"""Maximum size of the content of a compressed file, bytes."""

_MAX_DEPTH = 32
"""Maximum nesting of JSON; the files of this project have up to 6 levels."""

_MAX_INTEGER = 2**63
"""Magnitude at which an integer in a JSON file is refused, because no field needs it."""


def read_file(path: str | Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Return the content of a regular file of at most `max_bytes`."""
    path = Path(path)
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise TactipError(f"{path} must be a regular file, not a folder, pipe or device")
        if status.st_size > max_bytes:
            raise TactipError(f"{path} must have at most {max_bytes / 2**20:.0f} MiB, got {status.st_size / 2**20:.0f} MiB")
        with path.open("rb") as file:
            data = file.read(status.st_size + 1)  # the reported size may be wrong: files in /proc have none
    except FileNotFoundError:
        raise TactipError(f"{path} does not exist") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise TactipError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > status.st_size:
        raise TactipError(f"{path} must be a regular file, but its size changes while it is read")
    return data


def read_json(path: str | Path, name: str = "") -> Any:
    """Return the JSON value in a file.

    Args:
        path: The file.
        name: Its name in messages: "the design file a.json"; the path if empty.
    """
    return parse_json(_named(path, name), name or str(path))


def _named(path: str | Path, name: str) -> bytes:
    """Return the content of a file; errors state its name instead of its path."""
    try:
        return read_file(path)
    except TactipError as error:
        raise TactipError(str(error).replace(str(path), name or str(path), 1)) from error


def parse_json(data: bytes | str, name: str) -> Any:
    """Return the JSON value in a text: finite numbers, integers of 64 bits, at most 32 levels. name: for messages."""
    try:
        value = json.loads(data)
    except RecursionError:
        raise TactipError(f"{name} is not valid JSON: it has more than {_MAX_DEPTH} levels") from None
    except ValueError as error:
        raise TactipError(f"{name} is not JSON: {error}") from error
    level = [value]
    for _ in range(_MAX_DEPTH):
        for item in level:
            # NaN and 1e999 are read as numbers that JSON does not have.
            if isinstance(item, float) and not math.isfinite(item):
                raise TactipError(f"{name} is not valid JSON: it has the number {item}, but numbers must be finite")
            if isinstance(item, int) and abs(item) >= _MAX_INTEGER:
                raise TactipError(f"{name} has an integer of {item.bit_length()} bits: at most 63 are allowed")
        level = [i for item in level if isinstance(item, dict | list) for i in _items(item)]
        if not level:
            return value
    raise TactipError(f"{name} is not valid JSON: it has more than {_MAX_DEPTH} levels")


def _items(value: "dict[str, Any] | list[Any]") -> Any:
    return value.values() if isinstance(value, dict) else value


_NPZ_ERRORS = (
    ValueError,
    TypeError,
    SyntaxError,
    EOFError,
    OSError,
    NotImplementedError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What zipfile and numpy raise for damaged files."""


def parse_arrays(data: bytes, name: str) -> dict[str, np.ndarray]:
    """Return the arrays in the bytes of an .npz file, by name. name: name of the file, for messages."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > MAX_UNPACKED_BYTES:
                raise TactipError(f"{name} must unpack to at most {MAX_UNPACKED_BYTES / 2**20:.0f} MiB")
            for member in members:
                if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or member.flag_bits & 1:
                    raise ValueError(f"{member.filename!r} uses a compression method that numpy does not use")
            return {member.filename.removesuffix(".npy"): _array(archive.read(member)) for member in members}
    except _NPZ_ERRORS as error:
        raise TactipError(f"{name} cannot be read as arrays: {error}") from error


def _array(data: bytes) -> np.ndarray:
    """Return the array in the bytes of an .npy file. Raises ValueError if its header and its size differ."""
    file = io.BytesIO(data)
    version = npy.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version} of the array format is unknown")
    header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, in_fortran_order, dtype = header(file)
    if dtype.kind not in "biufU" or any(n < 0 for n in shape):
        raise ValueError(f"an array has the type {dtype} and the shape {shape}: numbers and texts are allowed")
    if math.prod(shape) * dtype.itemsize != len(data) - file.tell():
        raise ValueError(f"an array of shape {shape} has {len(data) - file.tell()} bytes")
    if not math.prod(shape):
        return np.zeros(shape, dtype)
    values = np.frombuffer(data, dtype, offset=file.tell()).copy()  # writable, because compiled libraries require it
    return values.reshape(shape, order="F" if in_fortran_order else "C")


def read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """Return the arrays in an .npz file, by name."""
    return parse_arrays(read_file(path), str(path))
