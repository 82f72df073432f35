"""Commands that are killed at random moments: the same command again ends in the same files, apart from times.

Times are recorded in metrics.jsonl, results.jsonl and trial.json of trainings and searches, in run.json of sets, and in the
steps and the score of a servo run.
"""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from helpers.kills import contents, start, stop
from helpers.learning_sets import write_fake_splits
from helpers.rig_sets import hidden_twin, write_set
from tactip_twin.sim.robot.recording import RECORDING, read_recorded_scene, read_recording
from tactip_twin.sim2real.transfer.pseudo_real import make_pseudo_real

TACTIP = str(Path(sys.executable).parent / "tactip")

CALIBRATE = """
import sys
from tactip_twin.sim2real.calibration.fit import calibrate
from tactip_twin.sim2real.calibration.report import write_report
from tactip_twin.sim2real.calibration.settings import Settings
from tactip_twin.tactip_model.presets import load_design
from pathlib import Path
from tactip_twin.tactip_model.errors import Interrupted

real, out = Path(sys.argv[1]), Path(sys.argv[2])
settings = Settings(fit_frames=10, test_frames=10, rounds=("draft", "draft"), test_fidelity="draft")
try:
    result = calibrate(real, load_design("nominal-127"), settings, out / "report" / "state.json")
except Interrupted:
    sys.exit(130)
write_report(result, real.name, settings, out / "design.json", out / "report")
"""
"""`tactip calibrate` with two rounds in draft: its command takes minutes."""

TRANSFER = """
import sys
from tactip_twin.commands import main as tactip
from tactip_twin.learning.configuration import RECIPES, PoseNetConfig, Recipe, TrainSettings

network = PoseNetConfig(conv_layers=2, filters=8, dense_units=32, batch_size=16, downsample=2)
recipe = Recipe(network, TrainSettings(epochs=3, learning_rate=3e-3, augmented_fraction=0.5))
RECIPES["laptop"] = {"surface": recipe, "edge": recipe}
if __name__ == "__main__":
    sys.exit(tactip.main(sys.argv[1:]))
"""
"""`tactip` with a recipe that trains for seconds."""

SERVO = ["servo", "--fidelity", "draft", "--renderer", "raster", "--object", "plate", "--arm", "none"]
SERVO += ["--route.kind", "straight", "--route.length-mm", "15"]

HOW = ("group", "parent", "interrupt")
"""Ways in which commands are stopped, in turn."""

KILLS = 3
"""Number of times that each command is stopped."""


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Return the folder of a pseudo-real sensor: `lab` as published, `set` as imported."""
    folder = tmp_path_factory.mktemp("pseudo") / "hidden"
    make_pseudo_real(folder, "surface", "nominal-127", 60, 0, 1)
    return folder


def command_of(name, lab, folder, out):
    """Return a command that writes into `out`. folder: for what it needs."""
    script = folder / "command.py"
    if name == "tune":
        sizes = [
            "--space.max-conv-layers",
            "2",
            "--space.max-dense-units",
            "8",
            "--max-filters",
            "4",
            "--training.epochs",
            "4",
        ]
        trials = ["--trials", "3", "--random-trials", "2", "--prune", "--min-epochs", "1"]
        return [TACTIP, "tune", "--data", str(folder / "data"), "--out", str(out), *sizes, *trials]
    if name == "import":
        columns = ["pose_z=-depth", "pose_Rx=roll", "pose_Ry=pitch"]
        return [TACTIP, "import", str(lab / "lab"), "--out", str(out), "--columns", *columns]
    if name == "calibrate":
        script.write_text(CALIBRATE)
        return [sys.executable, str(script), str(folder / "real"), str(out)]
    if name == "transfer":
        script.write_text(TRANSFER)
        sizes = ["--contacts", "12", "--val-contacts", "10", "--fidelity", "draft", "--steps", "10", "--workers", "1"]
        tuning = ["--real-train-frames", "30", "--shots", "10"]
        real = ["--real", str(lab / "set"), "--out", str(out)]
        return [sys.executable, str(script), "transfer", "few-shot", *real, *sizes, *tuning]
    return [TACTIP, *SERVO, "--out", str(out)]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tune", "import", "calibrate", "transfer"])
def test_command_killed_at_random_moments_resumes_to_the_same_files(lab, tmp_path, name):
    if name == "tune":
        write_fake_splits(tmp_path / "data")
    if name == "calibrate":
        write_set(tmp_path / "real", hidden_twin(), 48)
    begin = time.monotonic()
    subprocess.run(command_of(name, lab, tmp_path, tmp_path / "whole"), check=True, capture_output=True)
    duration = time.monotonic() - begin
    wanted = contents(tmp_path / "whole")
    for k, fraction in enumerate(np.random.default_rng(0).uniform(0.1, 1, KILLS)):
        out, how = tmp_path / f"killed-{k}", HOW[k % len(HOW)]
        error = stop(start(command_of(name, lab, tmp_path, out)), fraction * duration, how)
        assert "Traceback" not in error, (how, fraction, error)
        again = subprocess.run(command_of(name, lab, tmp_path, out), capture_output=True, text=True)
        assert again.returncode == 0, (how, fraction, again.stderr)
        found = contents(out)
        assert set(found) == set(wanted), (how, fraction)
        assert [file for file in wanted if found[file] != wanted[file]] == [], (how, fraction)


@pytest.mark.slow
def test_servo_killed_at_random_moments_is_read_to_its_last_step_and_runs_again(tmp_path):
    def run(out):
        return subprocess.run(command_of("servo", None, tmp_path, out), capture_output=True, text=True)

    begin = time.monotonic()
    assert run(tmp_path / "whole").returncode == 0
    duration = time.monotonic() - begin
    _, wanted = read_recording(tmp_path / "whole")
    read = 0
    for k, fraction in enumerate(np.random.default_rng(0).uniform(0.2, 1, KILLS)):
        out, how = tmp_path / f"killed-{k}", HOW[k % len(HOW)]
        error = stop(start(command_of("servo", None, tmp_path, out)), fraction * duration, how)
        assert "Traceback" not in error, (how, fraction, error)
        complete = False
        if (out / RECORDING).exists():
            record, arrays = read_recording(out)
            read_recorded_scene(out)
            complete, steps = record["complete"], record["steps"]
            assert all(np.array_equal(arrays[key], wanted[key][:steps]) for key in ("true", "pin_tips_m", "images") if steps)
            read += steps > 0
        again = run(out)
        if complete:  # Ctrl-C completes a recording, and a command may have ended before it was stopped
            assert again.returncode == 1 and "is not empty" in again.stderr, (how, fraction, again.stderr)
            continue
        assert again.returncode == 0, (how, fraction, again.stderr)
        assert np.array_equal(read_recording(out)[1]["true"], wanted["true"]), (how, fraction)
        assert {p.name for p in out.iterdir()} == {p.name for p in (tmp_path / "whole").iterdir()}, (how, fraction)
    assert read  # of the moments, some are after the first step
