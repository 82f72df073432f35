"""Measurements of learned tips: their sets, tables and figure."""

from pathlib import Path

import pytest

from tactip_twin.benchmarks.learning import fast_tip, sliding_tip
from tactip_twin.benchmarks.learning.options import FastTipOptions, SlidingTipOptions
from tactip_twin.sim.dataset.generate import check
from tactip_twin.tactip_model.errors import TactipError


def test_sets_of_a_sliding_tip_are_valid_and_apart():
    for task, kinds in sliding_tip.KINDS.items():
        found = sliding_tip.jobs(SlidingTipOptions(task=task, paths=16, test_paths=3, validation_paths=3, data=Path("d")))
        assert {str(job.folder) for job in found} == {f"d/{k}/{s}" for k in kinds for s in ("train", "val", "test")}
        for job in found:
            check(job.configuration)
        train = [job.configuration.samples for job in found if job.configuration.split == "train"]
        assert sum(train) == 16 * 20
        assert {job.configuration.samples for job in found if job.configuration.split != "train"} == {60}


@pytest.mark.slow
def test_ways_to_make_a_contact_are_compared_with_the_finest(tmp_path):
    """Of the shipped tip, without sets and training."""
    options = FastTipOptions(times_only=True, test_contacts=200, compared_contacts=1, data=tmp_path / "none", out=tmp_path)
    measured = fast_tip.run(options, log=lambda text: None)["surface"]
    found = {row["way"]: row for row in measured["ways"]}
    assert list(found) == ["fast", "corrected", "draft", "standard", "reference", "fast, batch"]
    assert found["standard"]["standard"]["pins_mm"] == 0 == found["reference"]["reference"]["pins_mm"]
    assert found["standard"]["cost"] == 1
    assert found["fast, batch"]["cost"] < found["fast"]["cost"] < found["corrected"]["cost"] < 1
    assert 0 < found["corrected"]["standard"]["pins_mm"] < found["draft"]["standard"]["pins_mm"]
    assert all(rate > 0 for rate in measured["rates"].values()) and not (tmp_path / "none").exists()
    assert (tmp_path / "fast_tip.png").stat().st_size > 5000
    assert (tmp_path / "fast_tip.md").read_text().count("| surface | corrected |") == 1


def test_times_alone_release_no_tip(tmp_path):
    options = FastTipOptions(times_only=True, release=tmp_path / "tips", out=tmp_path)
    with pytest.raises(TactipError, match="--times-only trains no tip"):
        fast_tip.run(options, log=lambda text: None)
    assert not list(tmp_path.iterdir())
