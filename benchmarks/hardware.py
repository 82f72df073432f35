"""Description of the machine that a figure was measured on."""

import os
import platform
from collections.abc import Mapping
from pathlib import Path


def machine() -> dict[str, str]:
    """Return the description of this machine: processor, cores, memory and system."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    return {
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "memory": f"{memory:.0f} GiB",
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
    }


def machine_text(described: Mapping[str, str]) -> str:
    """Return a description by `machine` as text."""
    return "; ".join(f"{k} {v}" for k, v in described.items())


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.machine()
