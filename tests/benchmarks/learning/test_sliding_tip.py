"""Measurements of learned tips: their sets, tables and figure."""

from pathlib import Path

import numpy as np
import pytest

from tactip_twin.benchmarks.learning import fast_tip, sliding_tip
from tactip_twin.benchmarks.learning.options import SlidingTipOptions
from tactip_twin.learning.fast_tip_training import TipContacts
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.generate import check
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.fast_tip.fast_tip import read_fast_tip, shipped_fast_tip
from tactip_twin.tactip_model.presets import design_named


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
    design, task = design_named("tactip-127"), "surface"
    rng = np.random.default_rng(1)
    poses = np.array([POSE_RANGES[task].sample(rng) for _ in range(4)])
    shears = np.array([SHEAR_RANGES.sample(rng) for _ in range(4)])
    configuration = Configuration(
        task=task, split="test", design=design, pose=POSE_RANGES[task], fidelity=fidelity_named("standard")
    )
    none = np.zeros(0)
    test = TipContacts(configuration, poses, shears, none, none, none, none)
    rows = fast_tip._ways(read_fast_tip(shipped_fast_tip(task, design.name)), test, 1, lambda text: None)
    found = {row["way"]: row for row in rows}
    assert list(found) == ["fast", "corrected", "draft", "standard", "reference", "fast, batch"]
    assert found["standard"]["standard"]["pins_mm"] == 0 == found["reference"]["reference"]["pins_mm"]
    assert found["standard"]["cost"] == 1
    assert found["fast, batch"]["cost"] < found["fast"]["cost"] < found["corrected"]["cost"] < 1
    assert 0 < found["corrected"]["standard"]["pins_mm"] < found["draft"]["standard"]["pins_mm"]
    errors = {name: 0.1 for name in ("pins_mm", "pins_p95_mm", "worst_contact_mm", "force", "effective_shear_mm", "trusted")}
    row = {"contacts": 5, "pins_trusted_mm": 0.1, **errors}
    machine = {"processor": "p", "cores": "2", "memory": "m", "system": "s"}
    rates = {"batch": 1.0, "single": 1.0, "images": 1.0}
    result = {task: {"rows": [row], "rates": rates, "ways": rows, "machine": machine}}
    assert fast_tip.tables(result)["ways"].count("\n") == 7
    fast_tip.plot(result, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 5000
