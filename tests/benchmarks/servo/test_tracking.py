"""The page of tracking: rows that are not measured again stay, and the page is complete after each run."""

import json
from dataclasses import replace

from tactip_twin.benchmarks.servo import tracking
from tactip_twin.benchmarks.servo.options import TrackingOptions


def test_page_has_a_row_for_each_setting_measured_so_far(tmp_path, monkeypatch):
    asked = []

    def track(options):
        asked.append(options)
        options.out.mkdir(parents=True)
        errors = {"rms_mm": 0.5, "max_mm": 1.25, "rms_deg": 0.75, "max_deg": 1.5}
        errors |= {"rms_mm_by_period": [0.25, 0.75], "rms_deg_by_period": [0.75, 0.75]}
        errors |= {"rms_by_axis": [0.1] * 6, "estimate_rms_by_axis": [0.2] * 6}
        return errors | {"seconds": 7.0, "stopped_because": "completed" if options.depth_mm == 4 else "contact lost"}

    monkeypatch.setattr(tracking, "track", track)
    options = TrackingOptions(("2 mm deep",), 7.0, tmp_path / "runs", tmp_path)
    tracking.run(options)
    assert list(json.loads((tmp_path / "tracking.json").read_text())["rows"]) == ["2 mm deep"]
    record = tracking.run(replace(options, only=("default", "2 mm deep")))
    assert list(record["rows"]) == ["default", "2 mm deep"]
    assert [(one.depth_mm, one.seconds) for one in asked] == [(2, 7), (4, 7), (2, 7)]
    page = (tmp_path / "tracking.md").read_text()
    assert "| default | 7 | 0.50 | 0.25, 0.75 | 1.25 | 0.75 | 0.75, 0.75 | 1.50 | 0 |" in page
    assert "\n- 2 mm deep: contact lost\n" in page
    assert "| default | 0.10 (0.20) |" in page
