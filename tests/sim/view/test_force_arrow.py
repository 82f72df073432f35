"""The arrow of a force: as long as the force, beside the tip, and a closed mesh from its start to its end."""

import numpy as np
import pytest
import trimesh

from tactip_twin.sim.view.force_arrow import HEAD_M, arrow_meshes, force_arrow, skin_radius_m

SKIN = trimesh.creation.icosphere(3, 0.02).vertices - [0, 0, 0.02]


@pytest.mark.parametrize(("force", "side"), [((0.1, 0, -1), 1), ((-0.5, 0, -1), -1), ((0, 0.3, -0.2), 1)])
def test_arrow_stands_beside_the_tip_and_leans_away_from_it(force, side):
    radius = skin_radius_m(SKIN)
    arrow = force_arrow(SKIN, np.array(force), radius)
    assert arrow is not None
    assert arrow[1] - arrow[0] == pytest.approx(0.02 * np.array(force))
    assert side * arrow[0, 0] > radius
    assert side * (arrow[1, 0] - arrow[0, 0]) >= -0.1 * np.linalg.norm(arrow[1] - arrow[0])


def test_no_arrow_without_force():
    assert force_arrow(SKIN, np.array([0, 0, -0.04]), 0.02) is None


@pytest.mark.parametrize("end", [[0, 0, 0.03], [0, 0, -0.03], [0.01, -0.02, 0.005], [0.002, 0, 0]])
def test_arrow_reaches_from_start_to_end(end):
    ends = np.array([[0.01, 0.02, 0.03], np.array([0.01, 0.02, 0.03]) + end])
    points = np.concatenate([mesh.vertices for mesh in arrow_meshes(ends)])
    along = (points - ends[0]) @ end / np.linalg.norm(end)
    assert along.min() == pytest.approx(0, abs=1e-6)
    assert along.max() == pytest.approx(np.linalg.norm(end))
    beside = points - ends[0] - along[:, None] * np.array(end) / np.linalg.norm(end)
    assert np.linalg.norm(beside, axis=1).max() == pytest.approx(HEAD_M, rel=0.05)
