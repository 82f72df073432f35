"""Curved surfaces as formulas: the same solids as their meshes, and paraboloids in closed form."""

import numpy as np
import pytest

from tactip_twin.sim.contact.curved_surface import Curvatures, sample_curvatures
from tactip_twin.sim.contact.smooth_surface import SmoothSurface


@pytest.mark.parametrize("varying_fraction", [0.0, 1.0])
def test_formula_agrees_with_mesh(varying_fraction):
    """Up to the mesh's facets, from as deep as a press to well above the surface."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        curvatures = sample_curvatures(rng, -28.0, 80.0, varying_fraction)
        mesh, surface = curvatures.solid(), SmoothSurface(curvatures)
        on = surface.nearest(np.column_stack([rng.uniform(-0.012, 0.012, (500, 2)), np.zeros(500)]))
        points = on.place + rng.uniform(-0.005, 0.008, 500)[:, None] * on.normal
        assert np.abs(surface.distance(on.place)).max() < 1e-9
        assert np.abs(surface.distance(points) - mesh.distance(points)).max() < 40e-6
        between = np.degrees(np.arccos(np.clip((surface.smooth_normal(points) * mesh.smooth_normal(points)).sum(1), -1, 1)))
        assert np.quantile(between, 0.95) < 1.5
        places = surface.nearest(points).place
        assert np.abs(np.linalg.norm(points - places, axis=1) - np.abs(surface.distance(points))).max() < 1e-6


def test_nearest_point_of_a_cylinder_lies_on_its_normal():
    """z = -k u^2 / 2, turned: a point off the top along the normal at u has the distance that it was moved."""
    k, turn = 60.0, 0.7
    surface = SmoothSurface(Curvatures(k, 0.0, turn))
    u, v, away = np.random.default_rng(0).uniform([[-0.01], [-0.01], [-0.005]], [[0.01], [0.01], [0.02]], (3, 200))
    axes = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    place = np.column_stack([u, v, -k * u**2 / 2]) @ axes
    normal = np.column_stack([k * u, 0 * u, np.ones(200)]) / np.hypot(k * u, 1)[:, None] @ axes
    found = surface.nearest(place + away[:, None] * normal)
    np.testing.assert_allclose(found.distance, away, atol=1e-9)
    np.testing.assert_allclose(found.place, place, atol=1e-8)
    np.testing.assert_allclose(found.normal, normal, atol=1e-6)
    assert surface.distance(np.zeros((2, 3, 3))).shape == (2, 3)
