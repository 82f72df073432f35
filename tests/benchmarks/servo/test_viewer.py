"""What a replay costs is measured on the replay that is there, and a browser is left out where there is none."""

import numpy as np
import pytest

from helpers.recordings import RECORD, STEPS, arrays_of, scenery
from tactip_twin.benchmarks.options import ViewerOptions
from tactip_twin.benchmarks.servo import viewer as viewed
from tactip_twin.sim.robot.recording import ARRAYS, PHASES, Recorder

REPEATS = 8


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A recording of a tip that goes to and fro, where the benchmark looks for one."""
    folder = tmp_path_factory.mktemp("runs")
    recorder = Recorder(folder / "recording", {"task": RECORD["task"], "object": RECORD["object"]}, scenery())
    arrays = arrays_of()
    missing = {"T_base_tcp_measured": np.eye(4), "touching": 1.0, "sim_steps": 1}
    for k in list(range(STEPS)) * REPEATS:
        row = {name: arrays[name][k] if name in arrays else missing[name] for name in ARRAYS}
        recorder.add(row | {"phase": PHASES[arrays["phase"][k]]})
    recorder.finish({"stopped_because": "the loop is closed"})
    return folder


def test_a_replay_without_a_browser(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(viewed, "PROGRAM", None)
    said = []
    result = viewed.run(ViewerOptions(seconds=1.0, runs=runs, out=tmp_path), said.append)
    assert result["steps"] == STEPS * REPEATS and result["seen"] is None
    # 40 steps a second are played, and a picture is sent 30 times.
    assert 5 < result["alone"]["pictures_per_s"] < 45
    assert 0 < result["alone"]["processor"] < 2
    page = (tmp_path / "viewer.md").read_text()
    assert f"A recording of {STEPS * REPEATS} steps" in page
    assert f"| of a core, for the host | {result['alone']['processor']:.0%} |  |" in page
    assert any("no Chromium" in line for line in said)
