"""Reading files that may be damaged or malicious: type, size and depth are checked before the content is used.

Every function raises TactipError, with one sentence that names the file, and uses bounded memory whatever the file holds.
"""

import codecs
import csv
import hashlib
import io
import json
import math
import re
import stat
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from tactip_twin.tactip_model.errors import TactipError

MAX_BYTES = 2**28
"""Maximum size of a file, bytes. The tables of a shard of 10,000 samples of 331 pins have 80 MB."""

MAX_JSON_BYTES = 2**24
"""Maximum size of a JSON file, bytes: its values may take 20 times as much memory. meta.json has 95 bytes per image."""

_MAX_TABLE_BYTES, _MAX_COLUMNS, _MAX_CELLS = 2**25, 1000, 4_000_000
"""Maximum size of a table: bytes, columns and cells. A shard's table has at most 2 million cells."""

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


def read_json_lines(path: str | Path) -> list[dict[str, Any]]:
    """Return the JSON objects in a file that has one per line."""
    lines = read_file(path, MAX_JSON_BYTES).split(b"\n")
    if lines.pop():
        raise TactipError(f"{path} is damaged: its last line has no end")
    values = [parse_json(line, f"{path}, line {number}") for number, line in enumerate(lines, 1)]
    for number, value in enumerate(values, 1):
        if not isinstance(value, dict):
            raise TactipError(f"{path}, line {number} must be an object, got {value!r:.60}")
    return values


def with_checksum(value: "dict[str, Any]") -> dict[str, Any]:
    """Return a JSON object with a checksum of itself under the key `sha256`, in place of an earlier one."""
    rest = {key: item for key, item in value.items() if key != "sha256"}
    return rest | {"sha256": hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()}


def has_checksum(value: "dict[str, Any]") -> bool:
    """Return whether a JSON object matches the checksum of itself that it has under the key `sha256`."""
    return value.get("sha256") == with_checksum(value)["sha256"]


def _named(path: str | Path, name: str) -> bytes:
    """Return the content of a JSON file; errors state its name instead of its path."""
    try:
        return read_file(path, MAX_JSON_BYTES)
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


def parse_table(data: bytes, name: str) -> tuple[list[str], list[dict[str, Any]]]:
    """Return columns and rows of a table in UTF-8 or UTF-16 with a byte-order mark, of at most 4 million cells.

    Values are separated by commas or, if there is none in the first line, by semicolons or tabs. Decimal commas become
    points, in a table that is separated by commas only where the number is quoted. Lines before the header that begin with #
    are skipped, and so is the line with which spreadsheets name their separator (sep=;).

    Args:
        data: Content of the file.
        name: Its name, for messages.

    Returns:
        The columns, and the cells of each row by column: None where a row ends before a column.

    Raises:
        TactipError: If the file is no such table, a column's name is there twice, or a row has more cells than the header.
    """
    if len(data) > _MAX_TABLE_BYTES:
        raise TactipError(f"{name} must have at most {_MAX_TABLE_BYTES / 2**20:.0f} MiB, got {len(data) / 2**20:.0f} MiB")
    rows, cells = [], 0
    text = _NOTES.sub("", _decoded(data, name))
    head = text.partition("\n")[0]
    separator = "," if "," in head else max(";\t", key=head.count)
    separator = separator if separator in head else ","
    try:
        reader = csv.DictReader(io.StringIO(text, newline=""), delimiter=separator)
        columns = list(reader.fieldnames or [])
        if len(columns) > _MAX_COLUMNS:
            raise TactipError(f"{name} must have at most {_MAX_COLUMNS} columns, got {len(columns)}")
        twice = next((one for one in columns if one.strip() and columns.count(one) > 1), None)
        if twice is not None:
            raise TactipError(f"{name} must name each column once, got {twice!r} {columns.count(twice)} times")
        for row in reader:
            further = row.pop(None, [])
            if any(cell.strip() for cell in further):
                comma = ": separate them by semicolons, or quote numbers with a decimal comma" if separator == "," else ""
                raise TactipError(
                    f"{name} must have at most {len(columns)} cells in a row, as many as columns, got "
                    f"{len(columns) + len(further)} in line {reader.line_num}{comma}"
                )
            rows.append({column: _with_point(cell) for column, cell in row.items()})
            cells += len(columns)
            if cells > _MAX_CELLS:
                raise TactipError(f"{name} must have at most {_MAX_CELLS} cells")
    except csv.Error as error:
        raise TactipError(f"{name} cannot be read: {error}") from error
    return columns, rows


def _decoded(data: bytes, name: str) -> str:
    """Return the text of a table. Raises TactipError if it is not text in UTF-8, or in UTF-16 with a byte-order mark."""
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        return data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise TactipError(f"{name} must be text in UTF-8 (CSV): {error.reason} at byte {error.start}") from error


def _with_point(cell: Any) -> Any:
    """Return the cell of a table with a point in place of a decimal comma, if it is a number with one."""
    return cell.replace(",", ".") if isinstance(cell, str) and _DECIMAL_COMMA.fullmatch(cell.strip()) else cell


_NOTES = re.compile(r"\A(?:(?:#[^\n]*|sep=.\r?)\n)+")
"""Lines before a table's header."""

_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
"""A number with a decimal comma."""


_NPZ_ERRORS = (
    ValueError,
    TypeError,
    SyntaxError,
    EOFError,
    OSError,
    NotImplementedError,
    zipfile.BadZipFile,
    zlib.error,
    tokenize.TokenError,
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
            return {member.filename.removesuffix(".npy"): _read_array(archive, member) for member in members}
    except _NPZ_ERRORS as error:
        raise TactipError(f"{name} cannot be read as arrays: {error}") from error


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Return the array in a member of an archive, unpacked in place. Raises ValueError if its header and its size differ."""
    with archive.open(member) as file:
        version = npy.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"version {version} of the array format is unknown")
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, in_fortran_order, dtype = header(file)
        if dtype.kind not in "biufU" or any(n < 0 for n in shape):
            raise ValueError(f"an array has the type {dtype} and the shape {shape}: numbers and texts are allowed")
        size = math.prod(shape) * dtype.itemsize
        if size != member.file_size - file.tell():
            raise ValueError(f"an array of shape {shape} has {member.file_size - file.tell()} bytes")
        data, filled = np.empty(size, np.uint8), 0  # writable, as compiled libraries want it
        while chunk := file.read(_CHUNK_BYTES):  # the last read compares the checksum
            data[filled : filled + len(chunk)] = np.frombuffer(chunk, np.uint8)
            filled += len(chunk)
    if filled < size:
        raise EOFError("an array ends too soon")
    return data.view(dtype).reshape(shape, order="F" if in_fortran_order else "C") if size else np.zeros(shape, dtype)


_CHUNK_BYTES = 2**20


def read_arrays(path: str | Path, max_bytes: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """Return the arrays in an .npz file of at most `max_bytes`, by name."""
    return parse_arrays(read_file(path, max_bytes), str(path))
