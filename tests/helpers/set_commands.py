"""Small data sets made by the command line, and their contents."""

import contextlib
import csv
import io
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES

SEED = 8
"""A seed whose first contacts with an edge pass their checks at once: to repeat one takes longer than to make four."""


def make(out, *options, task="edge", samples=4, workers=1, renderer="raster", seed=SEED):
    """Return the arguments of the command that makes a small set."""
    made = ["dataset", "make", "--task", task, "--samples", str(samples), "--out", str(out), "--workers", str(workers)]
    made += ["--fidelity", "draft", "--design", "nominal-127", "--renderer", renderer, "--seed", str(seed)]
    return [*made, *options]


def run(arguments):
    """Run a command in this process, and return its exit status and what it wrote."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = tactip.main(arguments)
    return subprocess.CompletedProcess(arguments, status, out.getvalue(), err.getvalue())


def process(arguments):
    """Return the command line of a process of its own: for kills, limits, and what users start."""
    return [str(Path(sys.executable).parent / "tactip"), *arguments]


def run_process(arguments):
    """Run a command in a process of its own, and return its exit status and what it wrote."""
    return subprocess.run(process(arguments), capture_output=True, text=True, timeout=300)


def table(folder):
    """Return the rows of targets.csv, by column."""
    return list(csv.DictReader((Path(folder) / "targets.csv").read_text().splitlines()))


def contents(folder):
    """Return the bytes of every file of a set except run.json, the only one that differs between runs."""
    files = (p for p in Path(folder).rglob("*") if p.is_file() and p.name != "run.json")
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


def wait_for(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition was not met in time"
        time.sleep(0.005)


def kill_unfinished(arguments, folder, reached, attempts=5):
    """Start a process that makes a set in folder, and kill it once reached() is true, before the set is finished.

    On a busy machine a small set may be finished before the kill: then the folder is removed and the command starts again.
    """
    for _ in range(attempts):
        started = subprocess.Popen(process(arguments), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_for(reached)
        started.kill()
        started.wait()
        if not (folder / "meta.json").exists():
            return
        shutil.rmtree(folder)
    raise AssertionError(f"{attempts} commands finished the set in {folder} before they were killed")


def samples_found(output):
    """Return how many samples a resumed command found, from "3 of 4 samples already exist" or "4 of 4 samples"."""
    return int(re.search(r"(\d+) of \d+ samples", output)[1])


def records(folder):
    return sorted(Path(folder).glob(".partial/*.npz"))


def configuration(design, **changes):
    """Return a small Configuration."""
    values = {
        "task": "surface",
        "split": "train",
        "samples": 3,
        "seed": 0,
        "renderer": "raster",
        "design": design,
        "fidelity": fidelity_named("draft"),
        "pose": POSE_RANGES["surface"],
        "shear": SHEAR_RANGES,
    }
    return Configuration(**{**values, **changes})
