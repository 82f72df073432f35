"""The machine that a figure was taken on."""

import os
import platform
from pathlib import Path


def machine():
    """Description (dict of str) of processor, cores, memory and system."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    return {
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "memory": f"{memory:.0f} GiB",
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
    }


def machine_text(described):
    """What `machine` told (dict of str), as text (str)."""
    return "; ".join(f"{k} {v}" for k, v in described.items())


def _processor():
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.machine()
