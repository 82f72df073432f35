"""Training of policies: an interrupted training gives the policy of one that was not, and other settings are refused."""

from dataclasses import replace

import numpy as np
import pytest

from tactip_twin.tactip_model.errors import TactipError

pytest.importorskip("gymnasium")
pytest.importorskip("stable_baselines3")

OPTIONS = {"observation_mode": "oracle", "objects": ["rim-round"], "movement_mode": "TxRz", "length_mm": 10.0}


class Interruption(Exception):
    """Ctrl-C in the middle of a training."""


@pytest.mark.slow
def test_interrupted_training_gives_the_same_policy(tmp_path):
    import tactip_twin.control.environments  # noqa: F401  (registers them)
    from tactip_twin.benchmarks.servo.policy_training import TrainingSettings, train

    settings = TrainingSettings(steps=200, chunk_steps=100, width=16, updates=1, batch=32, random_steps=60)

    def run(folder, interrupt_after=None, settings=settings):
        def score(policy):
            count.append(policy)
            if len(count) == interrupt_after:
                raise Interruption
            return {"return": float(np.abs(policy.weights[0]).sum())}

        count = []
        return train("tactip_twin/EdgeFollow-v0", OPTIONS, settings, tmp_path / folder, score, lambda line: None)

    whole, curve = run("whole")
    assert [point["steps"] for point in curve] == [100, 200]
    with pytest.raises(Interruption):
        run("interrupted", interrupt_after=2)
    resumed, curve_resumed = run("interrupted")
    assert curve_resumed == curve
    assert all(np.array_equal(a, b) for a, b in zip(whole.weights, resumed.weights, strict=True))
    with pytest.raises(TactipError, match="has a training with other settings"):
        run("whole", settings=replace(settings, seed=1))
