"""Files that are there whole or not at all."""

import os


def write_file(path, data):
    """Write bytes so that a kill at any moment leaves the old file or the new one. path: Path. Raises OSError."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
