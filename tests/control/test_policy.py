"""Files of policies: a policy is read back unchanged, and refuses observations of another kind."""

import numpy as np
import pytest

from tactip_twin.control.policy import Policy, read_policy, write_policy
from tactip_twin.tactip_model.errors import TactipError


def policy(outputs=2):
    rng = np.random.default_rng(0)
    sizes = ((8, 3), (8,), (8, 8), (8,), (outputs, 8), (outputs,))
    weights = tuple(rng.normal(size=size).astype(np.float32) for size in sizes)
    return Policy(
        "tactip_twin/EdgeFollow-v0", {"objects": ["rim-round"]}, np.array([1, 2, 5], np.float32), weights, {"a": 1}
    )


def test_policy_is_read_as_it_was_written(tmp_path):
    write_policy(policy(), tmp_path / "policy.npz")
    read = read_policy(tmp_path / "policy.npz")
    observation = {"oracle": np.array([0.1, -0.2, 3.0], np.float32)}
    assert np.array_equal(read(observation), policy()(observation))
    assert (read.environment, read.options, read.provenance) == (policy().environment, policy().options, {"a": 1})
    assert (np.abs(read(observation)) <= 1).all()


def test_policy_computes_its_layers():
    p = policy()
    x = np.array([0.1, -0.2, 3.0], np.float32)
    hidden = x / [1, 2, 5]
    for k in (0, 2):
        hidden = np.maximum(p.weights[k] @ hidden + p.weights[k + 1], 0)
    assert np.allclose(p({"pose": x}), np.tanh(p.weights[4] @ hidden + p.weights[5]), atol=1e-6)


@pytest.mark.parametrize("wrong", [{"oracle": np.ones(4)}, {"tactile": np.ones((8, 8, 1)), "extended_feature": np.ones(3)}])
def test_policy_another_observation_is_refused(wrong):
    with pytest.raises(TactipError, match="the observation must be one vector of 3 numbers"):
        policy()(wrong)


def test_policy_whose_layers_do_not_fit_is_refused(tmp_path):
    broken = Policy("x", {}, np.ones(4, np.float32), policy().weights, {})
    write_policy(broken, tmp_path / "policy.npz")
    with pytest.raises(TactipError, match="holds no policy: layer0 must be finite numbers of shape"):
        read_policy(tmp_path / "policy.npz")
