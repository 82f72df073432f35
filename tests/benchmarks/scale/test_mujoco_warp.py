"""MuJoCo's GPU engine with the soft tip, and the message if it is missing."""

import pytest

from tactip_twin.benchmarks.options import PerformanceOptions
from tactip_twin.benchmarks.scale import mujoco_warp as gpu_engine
from tactip_twin.benchmarks.scale import performance as speed
from tactip_twin.tactip_model.errors import TactipError


def test_without_it_a_sentence(monkeypatch, tmp_path):
    monkeypatch.setattr(gpu_engine, "find_spec", lambda name: None)
    with pytest.raises(TactipError, match=r"not installed: pip install 'tactip-twin\[gpu\]'"):
        speed.run(PerformanceOptions(groups=("gpu-engine",), out=tmp_path), lambda line: None)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_mujoco_warp_agrees_with_mujoco():
    """Single precision and a looser tolerance change vertices by a hundredth of a millimetre."""
    pytest.importorskip("mujoco_warp", reason="the extra gpu is not installed")
    rows = gpu_engine.rows()
    assert rows[0]["deviation, µm max"] == 0
    assert all(0 < row["deviation, µm max"] < 30 for row in rows[1:])
    assert any("Warp" in row["what"] for row in rows)
