"""The tutorial's commands, run one after the other, and the results that it promises."""

import csv
import json
import os
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TUTORIAL = ROOT / "docs" / "tutorial.md"


def commands():
    """Return the commands of the tutorial, each as a list of words."""
    blocks = re.findall(r"^```sh\n(.*?)^```", TUTORIAL.read_text().replace("\\\n", " "), re.DOTALL | re.MULTILINE)
    return [shlex.split(line) for block in blocks for line in block.splitlines()]


def test_tutorial_uses_only_project_commands():
    assert len(commands()) >= 10
    assert {words[0] for words in commands()} == {"make", "tactip"}


@pytest.mark.slow
def test_tutorial_reaches_its_results(tmp_path):
    home = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    begun = time.monotonic()
    for words in commands():
        # make writes its sets here instead of into the checkout.
        there = [*words, "-C", str(ROOT), f"OUT={tmp_path / 'data'}"] if words[0] == "make" else words
        ended = subprocess.run(there, cwd=tmp_path, env=home, capture_output=True, text=True)
        assert ended.returncode == 0, f"{shlex.join(words)}\n{ended.stdout[-2000:]}\n{ended.stderr[-4000:]}"
        print(f"{time.monotonic() - begun:6.0f} s  {shlex.join(words)}")
    # Machines differ and share their cores, so the time is printed, not tested.
    runs = tmp_path / "runs" / "tutorial"
    assert (runs / "sheet.png").exists() and (runs / "sphere.gif").exists()
    for name in ("sphere", "rim"):
        score = json.loads((runs / name / "score.json").read_text())
        assert score["contact_losses"] == 0, score
    results = json.loads((runs / "other" / "results.json").read_text())
    corrected = results["few-shot"]["50"]["corrected"]["mae"]
    with (runs / "other" / "hidden" / "set" / "targets.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 300
    assert corrected["pose_z"] < 0.3 and corrected["pose_Rx"] < 3
