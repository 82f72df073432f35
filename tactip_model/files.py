"""Atomic writing of files, and what kills leave of it."""

import contextlib
import os
import re
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
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if error.filename in (None, str(temporary)):  # a full disk's error names no file, and nobody knows that name
            error.filename = str(path)
        raise


_LEFTOVER = re.compile(r"\..+\.(?:(?P<writer>\d+)\.tmp|part)")
"""Names of the files in which content waits for its name: of write_file, and of videos."""


def is_leftover(path: Path) -> bool:
    """Return whether a file is one that a kill leaves of another file's writing."""
    return _LEFTOVER.fullmatch(path.name) is not None


def remove_leftovers(folder: Path, name: str = "*") -> None:
    """Remove what kills have left in a folder, unless the process that writes it is alive.

    Args:
        folder: The folder, which need not exist.
        name: Name of the file whose leftovers are removed; all if not given, for folders that hold a command's files only.
    """
    for path in folder.glob(f".{name}.*"):
        found = _LEFTOVER.fullmatch(path.name)
        if found and not (found["writer"] and _is_alive(int(found["writer"]))):
            path.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    """Return whether another process of this number runs on this machine."""
    if process == os.getpid():
        return False
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _sync_folder(folder: Path) -> None:
    """Sync the names of a folder's files to the disk, if the system can open folders."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_all() -> None:
    """Sync everything written so far to the disk, if the system can."""
    if os.name == "posix":
        os.sync()
