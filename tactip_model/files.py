"""Atomic writing of files."""

import os
from pathlib import Path


def write_file(path: Path, data: bytes, sync: bool = True) -> None:
    """Write a file atomically: an interruption leaves either the old file or the new one.

    Args:
        path: The file.
        data: Its content.
        sync: Whether the file reaches the disk before it gets its name. Otherwise a power cut may leave a damaged file,
            which is acceptable only where readers check it.

    Raises:
        OSError: The file cannot be written; the old one is unchanged.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            if sync:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
        if sync:
            _sync_folder(path.parent)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def _sync_folder(folder: Path) -> None:
    """Bring the names of a folder's files to the disk, where the system can open folders."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_all() -> None:
    """Bring everything that was written before to the disk, where the system can."""
    if os.name == "posix":
        os.sync()
