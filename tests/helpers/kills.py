"""Commands that are killed at a moment of their run, and what they leave, without times."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tactip_twin.commands import main as tactip

_TIMES = re.compile(rb'"(?:seconds\w*|finished|peak_memory\w*|samples_made\w*)": [^,}\n]+')
"""Entries of JSON files that hold times, or facts of one run of a command."""

_OF_A_RUN = ("run.json", "tensorboard", "checkpoint.pt")
"""Files and folders that hold facts of one run of a command. A checkpoint has the times of its epochs; a search keeps those
of pruned trials."""


def end_at_rename(name: str, arguments: Sequence[str]) -> None:
    """Run a command in this process, which ends without a word when a file of this name would get it: the main function of a
    process."""
    rename = os.replace

    def replace(old: Path, new: Path) -> None:
        if str(new).endswith(name):
            os._exit(9)
        rename(old, new)

    os.replace = replace
    sys.exit(tactip.main(arguments))


class Killed(BaseException):
    """Raised by a test instead of a kill: no handler of the program catches it."""


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file below a folder, by name, without times."""
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and not set(p.parts) & set(_OF_A_RUN))
    return {str(p.relative_to(folder)): _TIMES.sub(b"", p.read_bytes()) for p in files}


def start(command: Sequence[str]) -> subprocess.Popen[str]:
    """Start a command in a process group of its own."""
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True)


def stop(process: subprocess.Popen[str], after_s: float, how: str) -> str:
    """Stop a command after some seconds, and return its standard error.

    Args:
        process: The command.
        after_s: Seconds after its start.
        how: group (kill -9 of all its processes), parent (kill -9 of the first alone), or interrupt (Ctrl-C in a terminal).
    """
    time.sleep(after_s)
    if how == "parent":
        process.kill()
        process.wait()
        if process.stderr:
            process.stderr.close()
        return ""  # what its orphans write may come at any time
    os.killpg(process.pid, signal.SIGKILL if how == "group" else signal.SIGINT)
    return process.communicate(timeout=120)[1]
