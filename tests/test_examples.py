"""Every script in examples/ does what its first line says."""

import contextlib
import io
import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.learning_sets import write_fake_splits
from tactip_twin.commands import main as tactip

EXAMPLES = Path(__file__).parents[1] / "examples"


def run_process(script, *options):
    """Return what a script prints in a process of its own."""
    command = [sys.executable, str(script), *map(str, options)]
    variables = {**os.environ, "MPLBACKEND": "Agg", "PYTHONPATH": str(EXAMPLES.parent)}
    done = subprocess.run(command, capture_output=True, text=True, env=variables, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def run(script, *options, **variables):
    """Return what a script prints in this process, which has loaded its libraries."""
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        patch.setattr(sys, "argv", [str(script), *map(str, options)])
        for name, value in {"MPLBACKEND": "Agg", **variables}.items():
            patch.setenv(name, value)
        runpy.run_path(str(script), run_name="__main__")
    return printed.getvalue()


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    """A folder of a run with an estimator that learned from 30 contacts and their copies, and what was printed."""
    folder = tmp_path_factory.mktemp("run")
    made = [
        "dataset",
        "make",
        "--fidelity",
        "draft",
        "--renderer",
        "raster",
        "--samples",
        "240",
        "--augment-symmetry",
        "--out",
        str(folder / "set"),
    ]
    assert tactip.main(made) == 0
    output = run(EXAMPLES / "own_estimator.py", "--data", folder / "set", "--out", folder / "run", "--length-mm", "4")
    return folder / "run", output


def test_single_contact_example(tmp_path):
    output = run_process(EXAMPLES / "one_contact.py", "--out", tmp_path / "contact.png", "--renderer", "raster")
    image = cv2.imread(str(tmp_path / "contact.png"), cv2.IMREAD_GRAYSCALE)
    assert image.shape == (128, 128) and set(np.unique(image)) == {0, 255}
    force_N, depth_mm = map(float, re.findall(r"([\d.]+) (?:N|mm deep)", output))
    assert 0.5 < force_N < 5 and abs(depth_mm - 3) < 0.2


def test_custom_stimulus_example(tmp_path):
    output = run(EXAMPLES / "own_stimulus.py", "--fidelity", "draft", "--radii-mm", "8", "20")
    narrow, wide = (float(x) for x in re.findall(r"mm: ([\d.]+) N", output))
    assert 0.3 < narrow < wide
    overlaps = re.findall(r"overlap by (\d+) µm", output)
    assert len(overlaps) == 2 and all(int(x) < 50 for x in overlaps)


def test_training_example(tmp_path):
    data = write_fake_splits(tmp_path / "data", samples=16, size=128)
    output = run(
        EXAMPLES / "train_on_a_folder.py", "--data", data, "--out", tmp_path / "run", "--epochs", "1", "--filters", "2"
    )
    assert (tmp_path / "run" / "model.json").exists()
    assert len(re.findall(r"pose_\w+: [\d.]+ (mm|°)", output)) == 3


def test_custom_estimator_example(followed):
    folder, output = followed
    score = json.loads((folder / "score.json").read_text())
    assert "route completed" in output
    assert score["contact_losses"] == 0 and score["depth_mae_mm"] < 1 and score["angle_mean_deg"] < 8


def test_own_controller_follows_a_sphere(tmp_path):
    printed = run(EXAMPLES / "own_controller.py", "--out", tmp_path / "run", "--length-mm", "4")
    score = json.loads((tmp_path / "run" / "score.json").read_text())
    assert "route completed" in printed
    assert score["contact_losses"] == 0 and score["depth_mae_mm"] < 0.6 and score["angle_mean_deg"] < 8
    assert json.loads((tmp_path / "run" / "recording.json").read_text())["controller"] == "Proportional"


def test_notebook_example(followed, tmp_path):
    """Return its cells, one after another, as a script."""
    folder, _ = followed
    cells = json.loads((EXAMPLES / "replay.ipynb").read_text())["cells"]
    script = tmp_path / "cells.py"
    script.write_text("\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"))
    output = run(script, RUN=str(folder))
    assert "steps on sphere: route completed" in output
    assert (folder / "pass.gif").read_bytes()[:3] == b"GIF"
