"""The mesh: complete, of good quality, on the sphere; and the pins on it."""

import numpy as np
import pytest

from tactip_twin.tactip_model.design import TipGeometry
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import CONTACT_RADIUS_M, Resolution, build_mesh, sorted_elements, tetrahedron_quality
from tactip_twin.tactip_model.pins import PinReader, neutral_pins
from tactip_twin.tactip_model.presets import design_named

FINE = Resolution(surface_m=1.5e-3, rim_m=3e-3)


@pytest.fixture(params=[Resolution(), Resolution(surface_m=3.2e-3, rim_m=5e-3), FINE], ids=["standard", "draft", "fine"])
def mesh(request):
    return build_mesh(TipGeometry(), request.param)


def test_mesh_volume_is_that_of_dome(mesh):
    radius = TipGeometry().radius_m - CONTACT_RADIUS_M
    assert (mesh.volumes > 0).all()
    assert mesh.volumes.sum() == pytest.approx(2 / 3 * np.pi * radius**3, rel=0.025)


def test_mesh_elements_have_good_quality(mesh):
    quality = tetrahedron_quality(mesh.vertices, mesh.tetrahedra)
    assert quality.min() > 0.05
    assert np.quantile(quality, 0.01) > 0.3
    assert quality.mean() > 0.75


def test_tetrahedron_quality_of_known_shapes():
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    flat = regular * [1, 1, 1e-9]
    assert tetrahedron_quality(regular, np.array([[0, 1, 2, 3]]))[0] == pytest.approx(1)
    assert tetrahedron_quality(flat, np.array([[0, 1, 2, 3]]))[0] < 1e-3


def test_skin_is_closed_cap_facing_outward(mesh):
    corners = mesh.vertices[mesh.triangles] - mesh.centre
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normal * corners.mean(1)).sum(1) > 0).all()
    edges = np.sort(np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]], mesh.triangles[:, [2, 0]]]), 1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert set(count) == {1, 2}
    assert mesh.bonded[unique[count == 1]].all()  # its only border is the rim
    # Euler's number of a disc
    assert mesh.surface_count - len(unique) + len(mesh.triangles) == 1
    distance = np.linalg.norm(mesh.vertices[: mesh.surface_count] - mesh.centre, axis=1)
    assert np.allclose(distance, TipGeometry().radius_m - CONTACT_RADIUS_M)


@pytest.mark.parametrize("corners", [3, 4])
def test_sorted_elements_keep_corners_and_orientation(corners):
    points = np.random.default_rng(0).normal(size=(40, 3))
    elements = np.array([np.random.default_rng(seed).permutation(40)[:corners] for seed in range(200)])
    ordered = sorted_elements(elements)
    assert np.array_equal(np.unique(np.sort(ordered), axis=0), np.unique(np.sort(elements), axis=0))
    assert (np.diff(ordered[:, : corners - 1]) > 0).all() and (ordered[:, -1] > ordered[:, -3]).all()
    assert np.array_equal(np.sort(ordered), np.array(sorted(np.sort(elements).tolist())))

    def orientations(elements):
        """Return the sign of each element's orientation, by its corners."""
        a, *edges = (points[elements[:, i]] for i in range(corners))
        edges = np.stack([edge - a for edge in edges], 1)
        sides = np.linalg.det(edges) if corners == 4 else np.cross(edges[:, 0], edges[:, 1])[:, 2]
        return {tuple(sorted(e)): side for e, side in zip(elements.tolist(), np.sign(sides), strict=True)}

    assert orientations(ordered) == orientations(elements)


def test_mesh_elements_are_sorted(mesh):
    for elements in (mesh.tetrahedra, mesh.triangles):
        assert np.array_equal(sorted_elements(elements), elements)


def test_surface_points_near_apex_differ_in_height(mesh):
    """So the force does not rise in steps."""
    z = np.sort(mesh.vertices[: mesh.surface_count, 2])[::-1][:40]
    assert (np.diff(z) < -1e-6).all()


def test_cylinder_behind_rim_is_bonded_all_round():
    mesh = build_mesh(TipGeometry(cylinder_m=5e-3), Resolution())
    local = mesh.vertices - mesh.centre
    wall = np.hypot(local[:, 0], local[:, 1]) > (TipGeometry().radius_m - CONTACT_RADIUS_M) * (1 - 1e-6)
    behind = local[:, 2] < 1e-9
    assert mesh.bonded[wall & behind].all()
    assert mesh.bonded[local[:, 2] < -5e-3 + 1e-9].all()
    assert not mesh.bonded[behind & ~wall & (local[:, 2] > -1e-9)].any()


@pytest.mark.parametrize("spacing", [0.0, -1e-3, 15e-3, float("nan")])
def test_resolution_with_invalid_spacing_raises_error(spacing):
    with pytest.raises(TactipError, match="surface_m"):
        build_mesh(TipGeometry(), Resolution(surface_m=spacing))


def test_build_mesh_with_spacing_too_wide_raises_error():
    with pytest.raises(ValueError, match="rim_m"):
        build_mesh(TipGeometry(radius_m=10e-3), Resolution(rim_m=6e-3))


@pytest.fixture(params=["tactip-127", "tactip-331"])
def reader(request):
    design = design_named(request.param)
    mesh = build_mesh(design.shape, Resolution())
    return PinReader(design, mesh), mesh.vertices[: mesh.surface_count], mesh


def test_pin_reader_on_undeformed_skin_returns_neutral_pins(reader):
    pins, skin, _ = reader
    tips, directions = pins.read(skin)
    assert np.allclose(tips, pins.pin_tips, atol=1e-15)
    assert np.allclose(directions, pins.directions)


def test_pin_reader_on_rigidly_moved_skin_moves_pins(reader):
    """Pins follow a skin that is rotated by 4 degrees and shifted."""
    pins, skin, mesh = reader
    a = np.radians(4)
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    shift = np.array([1e-3, -2e-3, 0.5e-3])
    tips, directions = pins.read((skin - mesh.centre) @ turn.T + mesh.centre + shift)
    expected = (pins.pin_tips - mesh.centre) @ turn.T + mesh.centre + shift
    assert np.abs(tips - expected).max() < 40e-6  # facets lie up to 40 µm inside the sphere
    assert np.degrees(np.arccos(np.clip((directions * (pins.directions @ turn.T)).sum(1), -1, 1))).max() < 0.5


def test_pin_reader_reads_batches(reader):
    pins, skin, _ = reader
    many = np.stack([skin, skin * 1.01, skin + 1e-3])
    tips, directions = pins.read(many)
    assert np.allclose(tips[1], pins.read(skin * 1.01)[0])
    assert np.allclose(directions[2], pins.directions)


def test_neutral_pins_have_the_designs_count():
    assert len(neutral_pins(design_named("tactip-127"))[0]) == 127
    assert len(neutral_pins(design_named("tactip-331"))[0]) == 331
