"""The stability map: it can find wrong cells, is resumed, and is written."""

import json

import pytest

from tactip_twin.benchmarks.physics import stability
from tactip_twin.benchmarks.physics.options import StabilityOptions
from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.fidelity import fidelity_named


def test_cell_that_half_the_step_contradicts_is_wrong(monkeypatch):
    """The map must show that half the step gives another result."""
    monkeypatch.setattr(stability, "PINS_MM", 1e-6)
    result = stability.judge(stability.Cell("", "", "", depth_mm=1.0), fidelity_named("draft"))
    assert result["verdict"] == "wrong"
    assert "half the step" in result["reasons"][0]


def test_stability_map_is_resumed_and_written(tmp_path, monkeypatch):
    """All cells are known from an earlier run."""
    stiff = [cell for cell in stability.cells() if cell.row == "501"]
    monkeypatch.setattr(stability, "_chosen", lambda quick: stability.cells()[:1] + stiff[:3])
    chosen = stability._chosen(True)
    folder = tmp_path / ".stability-quick"
    folder.mkdir()
    for i, cell in enumerate(chosen):
        record = stability.asdict(cell) | stability.judge(cell, fidelity_named("draft"))
        (folder / f"{i:04d}.json").write_text(json.dumps(record))
    result = stability.run(StabilityOptions(tmp_path, quick=True, workers="1"), log=lambda line: None)
    assert result["counts"]["refused beforehand"] == 3
    assert result["map"][-1]["reasons"][0].startswith("skin_young_pa must be at most 500 times gel_young_pa")
    assert "| 4 |" in (tmp_path / "stability.md").read_text()
    assert (tmp_path / "stability.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "stability.json").read_text())["map"][0]["panel"].startswith("skin modulus")
    assert not folder.exists()


def test_stability_cells_have_distinct_positions():
    places = [(c.panel, c.row, c.column) for c in stability.cells()]
    assert len(set(places)) == len(places)
    assert len(places) > 300


@pytest.mark.slow
def test_quick_stability_map_has_no_wrong_cell(tmp_path):
    assert tactip.main(["bench", "stability", "--quick", "--out", str(tmp_path)]) == 0
