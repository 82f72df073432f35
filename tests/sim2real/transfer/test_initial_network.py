"""The shipped network that a transfer starts from."""

from dataclasses import replace

import pytest

from helpers.learning_sets import write_fake_set
from tactip_twin.learning.data import read_samples
from tactip_twin.learning.model import load_network, net_sha256
from tactip_twin.learning.recipes import recipe_named
from tactip_twin.sim.dataset.sampling import POSE_RANGES
from tactip_twin.sim2real.transfer.initial_network import shipped_network_for


@pytest.mark.parametrize(
    ("pins", "yaw_deg", "name"),
    [
        (127, (-45.0, 45.0), "edge-any-tactip-127"),
        (125, (-45.0, 45.0), "edge-any-tactip-127"),
        (127, (-180.0, 180.0), "edge-any-yaw-tactip-127"),
        (331, (-45.0, 45.0), "edge-tactip-331"),
        (331, (-180.0, 180.0), "edge-tactip-331"),
        (61, (-45.0, 45.0), None),
    ],
)
def test_edges_start_from_the_network_for_their_pins_and_yaws(tmp_path, pins, yaw_deg, name):
    """Where none knows all yaws, one that knows some is better than none."""
    pose = replace(POSE_RANGES["edge"], yaw_deg=yaw_deg)
    samples = read_samples(write_fake_set(tmp_path / "set", "edge", samples=2, size=128, pose=pose))
    found = shipped_network_for(samples, pins, recipe_named("laptop", "edge", 128).network)
    assert (found and net_sha256(found.net)) == (name and net_sha256(load_network(name).net))
