"""The page of costs: each group is measured and kept, and rates are computed as described."""

import json
from dataclasses import replace

import pytest

from tactip_twin.benchmarks import report
from tactip_twin.benchmarks.scale import performance as speed
from tactip_twin.benchmarks.scale.options import PerformanceOptions
from tactip_twin.tactip_model.errors import TactipError


def test_page_keeps_results_of_other_groups(tmp_path, monkeypatch):
    measured = {
        "images": ("Images", lambda o: [{"triangles": 20, "ms": 1.234}]),
        "servo": ("Servo", lambda o: [{"s": None}]),
    }
    monkeypatch.setattr(speed, "GROUPS", measured)
    monkeypatch.setattr(report, "fill", lambda page, tables: page)
    options = PerformanceOptions(("images",), out=tmp_path)
    speed.run(options, log=lambda line: None)
    speed.run(replace(options, groups=("servo",)), log=lambda line: None)
    page = speed.tables(json.loads((tmp_path / "performance.json").read_text()))["images"]
    assert "| triangles | ms |" in page and "| 20 | 1.23 |" in page
    assert list(json.loads((tmp_path / "performance.json").read_text())["groups"]) == ["images", "servo"]
    with pytest.raises(TactipError, match="unknown group 'mesh': choose one of images, servo"):
        speed.run(replace(options, groups=("mesh",)))


def test_set_rate_is_marginal(monkeypatch):
    """A set takes 3 s and half a second per contact and worker, so the fixed cost is 3 s."""
    monkeypatch.setattr(speed, "set_seconds", lambda n, workers, **case: (3.0 + n / (2.0 * workers), 500))
    for row in speed._samples(PerformanceOptions(contacts=10)):
        assert row["contacts/s"] == pytest.approx(2.0 * row["workers"])
        assert row["fixed cost, s"] == pytest.approx(3.0)
        each = 8 if row["what"].endswith("with symmetries") and "surface" in row["what"] else 1
        each = 2 if row["what"].endswith("with symmetries") and "edge" in row["what"] else each
        each = 20 if row["what"].endswith("20 snapshots per contact") else each
        assert row["samples/s"] == pytest.approx(each * row["contacts/s"])


def _scripted(monkeypatch, seconds):
    """Let sets take these times, s, one after the other; return the list of times not used yet."""
    left = list(seconds)
    monkeypatch.setattr(speed, "set_seconds", lambda n, workers, **case: (left.pop(0), 500))
    return left


def test_impossible_rate_is_measured_again(monkeypatch):
    """First the larger set takes no longer, then so much longer that the fixed cost is negative, then a possible time."""
    left = _scripted(monkeypatch, [5, 5, 5, 60, 5, 25])
    assert speed._rate(4, 40, 1) == (2.0, 3.0, 500)
    assert not left


def test_busy_machine_is_reported(monkeypatch):
    left = _scripted(monkeypatch, [5, 4] * speed._TRIES)
    with pytest.raises(TactipError, match=r"too busy to measure: sets of 4 and of 44 contacts took 5\.0 and 4\.0 s"):
        speed._rate(4, 40, 1)
    assert not left


@pytest.mark.parametrize(
    ("options", "words"),
    [({"steps": 3}, "--steps must be at least 4, got 3"), ({"contacts": 0}, "--contacts must be at least 1, got 0")],
)
def test_too_few_are_refused(tmp_path, options, words):
    with pytest.raises(TactipError, match=words):
        speed.run(PerformanceOptions(("images",), out=tmp_path, **options))


def test_median_excludes_first_call():
    calls = []
    speed._median(lambda: calls.append(None), 3)
    assert len(calls) == 4
