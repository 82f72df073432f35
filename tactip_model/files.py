"""Atomic writing of files."""

import os
from pathlib import Path


def write_file(path: Path, data: bytes) -> None:
    """Write bytes so that an interruption at any moment leaves the old file or the new one.

    Raises:
        OSError: The file cannot be written; the old one is unchanged.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
