"""Defects of scans: a repair restores the surface, and other defects are refused or noted."""

import numpy as np
import pytest
import trimesh

from tactip_twin.sim.robot.objects import load_object
from tactip_twin.tactip_model.errors import TactipError


def ball(radius_mm, z_mm=0.0, subdivisions=3):
    mesh = trimesh.creation.icosphere(subdivisions, radius_mm)
    return mesh.apply_translation([0, 0, z_mm])


def loaded(mesh):
    return load_object(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), unit="mm")


def heights_mm(scene_object, *z_mm):
    """Return the signed distances, mm, of points on the z axis."""
    return 1e3 * scene_object.solid.distance(np.array([[0, 0, z / 1e3] for z in z_mm]))


def test_parts_are_turned_outward_each_by_itself():
    """The smaller one is inside out, which the volume of both does not show."""
    small = ball(30, 140)
    small.invert()
    found = loaded(trimesh.util.concatenate([ball(100), small]))
    assert found.notes == ("triangles faced inward and were flipped",)
    assert np.allclose(heights_mm(found, 140, 190, 90, 105), [-30, 20, -10, 5], atol=1.5)


def test_surfaces_inside_of_others_are_removed():
    """The inner side of a hollow scan, whichever way it faces: nothing touches it, but a deep point is nearest to it."""
    for inverted in (False, True):
        inner = ball(38)
        if inverted:
            inner.invert()
        found = loaded(trimesh.util.concatenate([ball(40), inner]))
        assert found.notes == ("1 closed surface(s) inside of it were removed",)
        assert heights_mm(found, 36) == pytest.approx(-4, abs=0.3)


def test_overlapping_parts_are_united():
    """An eyeball in a head. What is 3 mm inside of it is so deep, though the head's own surface is nearer."""
    found = loaded(trimesh.util.concatenate([ball(90, subdivisions=5), ball(14, 84, 5)]))
    assert found.notes == ("2 overlapping parts were united",)
    angles = np.radians([0, 20, 35])
    points = 1e-3 * np.column_stack([11 * np.sin(angles), 0 * angles, 84 + 11 * np.cos(angles)])
    assert np.allclose(1e3 * found.solid.distance(points), -3, atol=0.1)
    assert np.allclose(heights_mm(found, 100, 98, 0), [2, 0, -90], atol=0.5)


def test_surface_through_itself_is_noted_and_noise_is_not():
    twisted = trimesh.creation.torus(40, 10)
    twisted.vertices[:, 0] = np.where(twisted.vertices[:, 0] > 0, twisted.vertices[:, 0] - 45, twisted.vertices[:, 0])
    assert any("it intersects itself" in note for note in loaded(twisted).notes)
    rng = np.random.default_rng(0)
    rough = ball(90, subdivisions=5)
    rough.vertices += rng.normal(0, 0.1, rough.vertices.shape)
    assert loaded(rough).notes == ()


def test_noise_of_a_scan_is_noted():
    fine = ball(40, subdivisions=6)
    fine.vertices += np.random.default_rng(0).normal(0, 0.2, fine.vertices.shape)
    (note,) = loaded(fine).notes
    assert "its normals scatter by" in note


def test_loose_fragments_are_removed():
    """Single triangles above the surface, and closed specks; not a part of the size of an object."""
    rng = np.random.default_rng(0)
    corners = ball(43).vertices[rng.choice(600, 50)][:, None] + rng.normal(0, 0.2, (50, 3, 3))
    loose = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(150).reshape(-1, 3), process=False)
    found = loaded(trimesh.util.concatenate([ball(40), loose, ball(0.5, 44), ball(6, 60)]))
    assert found.notes == ("51 loose fragment(s) were removed",)
    assert np.allclose(heights_mm(found, 44, 66), [4, 0], atol=0.1)


def test_slivers_leave_the_surface_closed():
    """A vertex in the middle of a side, with a triangle without area beside it, as decimation and CAD leave them."""
    mesh = ball(40)
    vertices, faces = [*mesh.vertices], mesh.faces.tolist()
    for k in (3, 4, 500):
        a, b, c = faces[k]
        m = len(vertices)
        vertices.append((vertices[a] + vertices[b]) / 2)
        faces[k] = [a, m, c]
        faces += [[m, b, c], [a, b, m]]
    sharp = trimesh.Trimesh(vertices, faces, process=False)
    assert sharp.is_watertight
    found = loaded(sharp)
    assert found.notes == ()
    assert len(found.solid.triangles) == len(faces)
    points = 1.2e-3 * mesh.triangles_center
    expected = loaded(mesh).solid.nearest(points)
    nearest = found.solid.nearest(points)
    assert np.allclose(nearest.distance, expected.distance, atol=1e-9)
    assert np.allclose(nearest.normal, expected.normal, atol=1e-6)


@pytest.mark.parametrize("flipped", [0, 7])
def test_holes_of_scans_are_filled(flipped):
    """Small and uneven ones, ones that touch each other at a vertex, and next to triangles that face the wrong way."""
    mesh = ball(90, subdivisions=5)
    mesh.vertices += np.random.default_rng(0).normal(0, 0.1, mesh.vertices.shape)
    at = mesh.vertices.argmax(0)[2]
    around = np.flatnonzero((mesh.faces == at).any(1))
    gone = [*around[:1], *around[3:4], *np.flatnonzero(mesh.triangles_center[:, 0] > 89.5)]
    kept = np.setdiff1d(np.arange(len(mesh.faces)), gone)
    faces = mesh.faces[kept]
    faces[:flipped] = faces[:flipped, ::-1]
    found = loaded(trimesh.Trimesh(mesh.vertices, faces, process=False))
    assert "hole(s) were filled" in found.notes[-1]
    assert len(found.notes) == 1 + bool(flipped)
    assert np.allclose(heights_mm(found, 95, 85, 0), [5, -5, -90], atol=1.5)


def test_unwelded_seam_is_closed():
    mesh = ball(40)
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    corners[::50] += 1e-4
    found = loaded(trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False))
    assert heights_mm(found, 45, 35) == pytest.approx([5, -5], abs=0.2)


def test_hole_across_a_corner_is_refused_with_its_size():
    box = trimesh.creation.box((60, 60, 60)).subdivide().subdivide().subdivide()
    box.update_faces(~(box.triangles_center > 10).all(1))
    with pytest.raises(TactipError, match=r"1 of its 2 hole\(s\), up to \d\d mm wide, cannot be filled"):
        loaded(box)


def test_file_in_metres_is_noticed(tmp_path):
    """glTF files are in metres; as millimetres, such a file would be smaller than the tip's skin."""
    ball(0.04).export(tmp_path / "ball.glb")
    found = load_object(tmp_path / "ball.glb")
    assert "taken as metres" in found.notes[0]
    assert heights_mm(found, 45) == pytest.approx(5, abs=0.1)
    assert found.summary == "80 × 80 × 80 mm, 1280 triangles"
    with pytest.raises(TactipError, match=r"got 0.08 mm: check its unit"):
        load_object(tmp_path / "ball.glb", unit="mm")


def test_middle_of_a_turned_object_is_that_of_its_box():
    cone = trimesh.creation.cone(60, 300)
    found = load_object(trimesh.Trimesh(cone.vertices, cone.faces), unit="mm", rotation_deg=(0, 60, 0))
    placed = found.solid.vertices @ found.T_base_object[:3, :3].T + found.T_base_object[:3, 3]
    assert np.allclose(found.middle_m, (placed.min(0) + placed.max(0)) / 2)


def test_surface_with_one_side_is_refused():
    """A Möbius strip has a closed border, but neither it nor its lid has an inside."""
    turns, across = np.linspace(0, 2 * np.pi, 60, endpoint=False), np.array([-8.0, 8.0])
    radius = 40 + across * np.cos(turns[:, None] / 2)
    rows = np.stack(
        [radius * np.cos(turns[:, None]), radius * np.sin(turns[:, None]), across * np.sin(turns[:, None] / 2)], -1
    )
    faces = []
    for k in range(60):
        a, b = 2 * k, 2 * k + 1
        c, d = (2 * k + 2, 2 * k + 3) if k < 59 else (1, 0)
        faces += [[a, c, b], [b, c, d]]
    with pytest.raises(TactipError, match="is open"):
        loaded(trimesh.Trimesh(rows.reshape(-1, 3), faces, process=False))
