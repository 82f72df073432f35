"""Memory of this process: a limit that allocations cannot pass, and the peak within a block (Linux)."""

import contextlib
import resource
from pathlib import Path

MIB = 2**20


@contextlib.contextmanager
def memory_limit(more_bytes):
    """Let this process take up to so many bytes more in a `with` block; more raises MemoryError."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + more_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


class Peak:
    """The peak of the memory of this process within a `with` block, in MiB above that at its start."""

    mib = 0.0

    def __enter__(self):
        Path("/proc/self/clear_refs").write_text("5")  # the peak so far becomes the memory of now
        self._start = _status("VmRSS")
        return self

    def __exit__(self, *_):
        self.mib = max(0.0, _status("VmHWM") - self._start)


def _status(name):
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(f"{name}:"))
    return int(line.split()[1]) / 1024
