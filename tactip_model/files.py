"""Atomic writing of files."""

import os
from pathlib import Path


def write_file(path: Path, data: bytes) -> None:
    """Write a file atomically: an interruption leaves either the old file or the new one.

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
