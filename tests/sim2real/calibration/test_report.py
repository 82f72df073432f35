"""The report of a calibration."""

import json
from pathlib import Path

import pytest

from tactip_twin.sim2real.calibration.report import page, plot_curves

FIGURES = Path(__file__).parents[3] / "docs" / "calibration" / "tactip-127" / "calibration.json"


@pytest.mark.parametrize("missing", ["depth", "shear"])
def test_set_without_upright_or_shared_shears_has_a_report(tmp_path, missing):
    figures = json.loads(FIGURES.read_text())
    complete = page(figures)
    assert "no such frames" not in complete
    figures[missing] = {"rows": [], "rms_px": None, "as_commanded_rms_px": None}
    assert page(figures).count("no such frames") == {"depth": 1, "shear": 2}[missing]
    plot_curves(figures, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1000
