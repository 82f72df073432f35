"""The linear part of a network's errors: known offsets, gains and leaks are found, and named in the advice."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tactip_twin.learning.labels import Labels
from tactip_twin.sim2real.transfer.linear_errors import advice, linear_errors, table_of
from tactip_twin.sim2real.transfer.rig_faults import RigFaults


def samples(count=300, sheared=True, seed=0) -> Any:
    """Return labels and shears of a surface set."""
    rng = np.random.default_rng(seed)
    targets = np.column_stack([rng.uniform(-5, -1, count), *rng.uniform(-15, 15, (2, count))])
    shears = np.zeros((count, 6))
    if sheared:
        shears[:, :2] = rng.uniform(-5, 5, (count, 2))
    labels = Labels("surface", (-5.0, -15.0, -15.0), (-1.0, 15.0, 15.0))
    return cast(Any, SimpleNamespace(targets=targets, shears=shears, labels=labels))


def test_known_offsets_gains_and_leaks_are_found():
    real = samples()
    noise = np.random.default_rng(1).normal(0, 0.01, real.targets.shape)
    predictions = real.targets * [0.8, 1.0, 1.0] + [0.3, 0.0, 0.0] + noise
    predictions[:, 1] += 0.35 * real.shears[:, 1]
    found = linear_errors(predictions, real)
    assert found is not None
    depth, roll = found["pose_z"], found["pose_Rx"]
    assert depth["gain"] == pytest.approx(0.8, abs=0.01) and roll["gain"] == pytest.approx(1.0, abs=0.01)
    middle = real.targets[:, 0].mean()
    assert depth["offset"] == pytest.approx(0.8 * middle + 0.3 - middle, abs=0.01)
    assert roll["leak"] == pytest.approx({"shear_x": 0.0, "shear_y": 0.35}, abs=0.01)
    assert max(part["rest"] for part in found.values()) < 0.012
    text = "\n".join(advice(found))
    assert "pose_z at 80% of the labels" in text
    assert "pose_Rx by +0.35 ° per mm of shear_y" in text
    assert f"Depth is off by {depth['offset']:+.2f} mm" in text and "Constant offsets" not in text
    assert f"| pose_z | {depth['offset']:+.2f} mm | 0.80 |" in table_of(found)


def test_labels_ahead_of_the_tip_are_named_as_errors_of_the_labels():
    """A network that reads the true pose of frames that are taken before the shear is finished."""
    truth, rng = samples(), np.random.default_rng(2)
    poses, shears = np.zeros((2, len(truth.targets), 6))
    poses[:, 2:5], shears[:, 3:5] = truth.targets, rng.uniform(-5, 5, (len(poses), 2))
    ends, moves = RigFaults(max_unfinished=0.6).commanded(poses, shears, rng)
    rig = cast(Any, SimpleNamespace(targets=ends[:, 2:5], shears=moves, labels=truth.labels))
    found = linear_errors(truth.targets, rig)
    assert found is not None
    # The mean of a fraction that is uniform from 0 to 0.6, weighted by the square of the commanded shear.
    left = rng.uniform(0, 0.6, 10**6)
    expected = -np.average(left, weights=(1 - left) ** -2)
    for name in ("Rx", "Ry"):
        assert found[f"pose_{name}"]["leak"][f"shear_{name}"] == pytest.approx(expected, abs=0.05)
    (remark,) = advice(found)
    assert "ahead of the tip: pose_Rx by" in remark and "wait until the robot stands still" in remark


def test_tool_centre_beside_the_axis_is_named():
    real = samples()
    predictions = real.targets.copy()
    predictions[:, 0] += 0.6 * np.sin(np.radians(real.targets[:, 2]))
    found = linear_errors(predictions, real)
    assert found is not None
    assert found["pose_z"]["cross"] == pytest.approx({"pose_Rx": 0.0, "pose_Ry": np.radians(0.6)}, abs=5e-4)
    assert "a tool centre 0.6 mm beside the axis" in "\n".join(advice(found))


def test_a_good_network_gets_no_remark_but_that():
    real = samples(sheared=False)
    found = linear_errors(real.targets + np.random.default_rng(1).normal(0, 0.05, real.targets.shape), real)
    assert found is not None and all(part["leak"] == {} for part in found.values())
    assert [remark.startswith("No offset") for remark in advice(found)] == [True]
    assert "no shear" in table_of(found)


def test_components_that_do_not_vary_are_left_out_and_small_sets_give_nothing():
    real = samples(200)
    real.targets[:, 2] = 3.0
    found = linear_errors(real.targets, real)
    assert found is not None and list(found) == ["pose_z", "pose_Rx"]
    assert linear_errors(samples(20).targets, samples(20)) is None
