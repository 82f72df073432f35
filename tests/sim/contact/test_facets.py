"""Points on the facets of the skin, and contacts beside its clamped rim."""

import numpy as np
import pytest

from tactip_twin.sim.contact import scene
from tactip_twin.sim.contact.facets import barycentric, held_weights, touched_facets
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.mesh import build_mesh
from tactip_twin.tactip_model.presets import design_named


def test_barycentric_coordinates_give_the_point_back():
    rng = np.random.default_rng(0)
    corners, weights = rng.normal(size=(20, 3, 3)), rng.dirichlet(np.ones(3), 20)
    points = np.einsum("kc,kcx->kx", weights, corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.allclose(barycentric(points + 0.1 * normals, corners), weights)


def test_held_weight_is_that_of_the_clamped_corners():
    mesh = build_mesh(design_named("tactip-127").shape, fidelity_named("draft").mesh)
    clamped = mesh.bonded[mesh.triangles].sum(1)
    facets = np.array([int(np.flatnonzero(clamped == count)[0]) for count in (0, 1, 2)])
    corners = mesh.vertices[mesh.triangles[facets]]
    assert np.allclose(held_weights(mesh, mesh.vertices, facets, corners.mean(1)), [0, 1 / 3, 2 / 3])
    at_clamp = np.array([x[mesh.bonded[t]].mean(0) for x, t in zip(corners[1:], mesh.triangles[facets[1:]], strict=True)])
    assert np.allclose(held_weights(mesh, mesh.vertices, facets[1:], at_clamp), 1)


@pytest.mark.parametrize(("weight", "highest_n_m"), [(0.0, np.inf), (1.0, 2200.0)])
def test_contact_at_the_clamp_is_a_spring(weight, highest_n_m, monkeypatch):
    """All points of the facets are taken for points at the clamp. Rigid contacts have up to 7000 N/m here, and far more
    where the skin cannot give way."""
    monkeypatch.setattr(scene, "held_weights", lambda mesh, vertices, facets, points: np.full(len(facets), weight))
    simulator = ContactSimulator(design_named("nominal-127"), "edge", fidelity_named("draft"))
    simulator.simulate(from_mm_deg([0, 0, -3, 0, 0, 0]), np.zeros(6))
    data = simulator.scene.data
    force, on_facet = data.efc_force[data.contact.efc_address], touched_facets(data.contact, simulator.scene._skin) >= 0
    pressed = on_facet & (force > 1e-3)
    stiffness = force[pressed] / -data.contact.dist[pressed]
    assert pressed.sum() > 5
    assert 500 < np.median(stiffness) < highest_n_m
    assert (stiffness.max() < highest_n_m) and (weight or stiffness.max() > 4000)
