"""Motions and inputs of a sliding tip."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.sim.fast_tip.features import COUNT, mirrored, pairs
from tactip_twin.sim.fast_tip.network import Network, network_of
from tactip_twin.sim.fast_tip.sliding_tip import Inputs, motion_between, read_sliding_tip, shipped_sliding_tip
from tactip_twin.sim.pose import before_shear, from_mm_deg, sensor_in_contact
from tactip_twin.tactip_model.errors import TactipError


def test_motion_in_a_contact_frame_is_the_shear():
    pose, shear = from_mm_deg([0, 0, -3, 5, -8, 20]), from_mm_deg([2, 1, -0.5, 1, 2, 3])
    before, after = sensor_in_contact(before_shear(pose, shear)), sensor_in_contact(pose)
    assert np.allclose(motion_between(before, after, np.eye(4)), shear, atol=1e-12)
    # The same motion on an object that lies elsewhere.
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix(), [0.1, 0.2, 0.3]
    assert np.allclose(motion_between(T @ before, T @ after, T), shear, atol=1e-12)


@pytest.mark.parametrize("task", ["surface", "edge"])
def test_learned_range_does_not_change_with_turns_and_mirrors(task):
    rng, inputs = np.random.default_rng(0), Inputs(task, 5, 4)
    values = rng.normal(size=(20, COUNT[task]))
    overlap, state = (rng.normal(size=(20, n)) + 1j * rng.normal(size=(20, n)) for n in (5, 6))
    touched = np.ones(20)
    extents = inputs.extents(inputs.pack(values, overlap, state, touched))
    mirror = inputs.extents(inputs.pack(values * mirrored(task), overlap.conj(), state.conj(), touched))
    assert np.allclose(extents, mirror)
    if task == "surface":
        turned, angle = values.copy(), 0.9
        for k in pairs(task):
            both = (values[:, k] + 1j * values[:, k + 1]) * np.exp(1j * angle)
            turned[:, k], turned[:, k + 1] = both.real, both.imag
        found = inputs.extents(inputs.pack(turned, overlap * np.exp(-2j * angle), state, touched))
        assert np.allclose(extents, found, atol=1e-6)
    assert inputs.pack(values, overlap, state, touched).shape == (20, inputs.count)


@pytest.mark.parametrize("task", ["surface", "edge"])
def test_shipped_tip_trusts_a_motion_without_a_tilt_or_a_turn(task):
    """Training paths always have a little of each, so exact zeros lie below all of them."""
    tip = read_sliding_tip(shipped_sliding_tip(task, "tactip-127"))
    inputs = tip.inputs
    values = np.zeros((1, COUNT[task]))
    sizes = inputs.extents(inputs.pack(values, np.zeros((1, inputs.overlap_modes)), np.zeros((1, 200)), np.ones(1)))[0]
    assert (sizes[inputs.can_vanish] == 0).all() and (tip.extents[inputs.can_vanish, 0] >= 0).all()
    assert (tip.extents[~inputs.can_vanish, 0][: {"surface": 2, "edge": 3}[task]] < 0).all()
    for k in range(COUNT[task]):  # only scalars show the sign of a feature
        values[0] = 0
        values[0, k] = -1
        found = inputs.extents(inputs.pack(values, np.zeros((1, inputs.overlap_modes)), np.zeros((1, 200)), np.ones(1)))[0]
        assert (found[inputs.can_vanish] >= 0).all()


def test_network_with_a_linear_map_adds_it():
    rng = np.random.default_rng(0)
    sizes = ((6, 3), (6, 6), (2, 6))
    weights = tuple(
        array.astype(np.float32) for size in sizes for array in (rng.normal(size=size), rng.normal(size=size[0]))
    )
    skip = rng.normal(size=(2, 3)).astype(np.float32)
    x = rng.normal(size=(4, 3)).astype(np.float32)
    network = Network(weights, skip)
    assert np.allclose(network(x), Network(weights)(x) + x @ skip.T, atol=1e-6)
    read = network_of(network.arrays("a"), "a", 3, 2)
    assert np.array_equal(read(x), network(x))
    with pytest.raises(ValueError, match="mismatch"):
        network_of(network.arrays("a"), "a", 4, 2)


def test_unknown_sliding_tip_is_refused():
    with pytest.raises(TactipError, match="no shipped sliding tip for surface and mine"):
        shipped_sliding_tip("surface", "mine")
