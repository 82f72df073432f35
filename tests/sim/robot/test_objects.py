"""Meshes from files: repaired if that is safe, otherwise refused with the reason."""

import numpy as np
import pytest
import trimesh

from helpers.rims import write_coarse_rim
from tactip_twin.assets.meshes.hard_rims import HARD_RIMS
from tactip_twin.assets.meshes.make import write_rim
from tactip_twin.assets.meshes.rims import RIMS
from tactip_twin.sim.robot.objects import MAX_TRIANGLES, load_object
from tactip_twin.tactip_model.errors import TactipError


def written(path, mesh):
    mesh.export(path)
    return path


@pytest.fixture
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=40.0)


@pytest.mark.parametrize("ending", ["stl", "ply", "obj", "glb"])
def test_every_format_gives_the_same_solid(tmp_path, ball, ending):
    scene_object = load_object(written(tmp_path / f"ball.{ending}", ball))
    assert scene_object.notes == ()
    assert scene_object.solid.distance(np.array([0.05, 0, 0])) == pytest.approx(0.01, abs=1e-4)
    assert np.allclose(scene_object.T_base_object[:3, 3], [0.38, 0, 0.04], atol=1e-5)


def test_unit_scale_and_place(tmp_path, ball):
    path = written(tmp_path / "ball.stl", ball)
    scene_object = load_object(path, unit="cm", scale=0.2, position_mm=(300, -50, 10), rotation_deg=(0, 90, 0))
    assert scene_object.solid.distance(np.zeros(3)) == pytest.approx(-0.08, abs=5e-4)
    assert np.allclose(scene_object.T_base_object[:3, 3], [0.3, -0.05, 0.09], atol=1e-4)
    assert np.allclose(scene_object.T_base_object[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-9)


def test_safe_defects_are_repaired_and_reported(tmp_path, ball):
    inverted = ball.copy()
    inverted.invert()
    mixed = ball.copy()
    mixed.faces[::3] = mixed.faces[::3, ::-1]
    cut = trimesh.creation.cylinder(40.0, 80.0)
    cut.update_faces(cut.face_normals[:, 2] > -0.5)
    doubled = trimesh.Trimesh(ball.vertices, np.concatenate([ball.faces, ball.faces[:5], [[0, 0, 1]]]), process=False)
    for name, mesh, words in (
        ("inverted", inverted, "faced inward"),
        ("mixed", mixed, "inconsistent winding"),
        ("cut", cut, "filled"),
        ("doubled", doubled, "removed"),
    ):
        scene_object = load_object(written(tmp_path / f"{name}.ply", mesh))
        assert any(words in note for note in scene_object.notes), name
        assert scene_object.solid.distance(np.array([0, 0, 0.045])) == pytest.approx(0.005, abs=1e-4), name
        assert scene_object.solid.distance(np.array([0, 0, 0.035])) == pytest.approx(-0.005, abs=1e-3), name


def test_unsafe_defects_are_refused_with_a_reason(tmp_path, ball):
    bowl = ball.copy()
    x, _, z = bowl.triangles_center.T
    bowl.update_faces(~((z > 5) & (x > -10)))  # a hole across a corner
    fin = trimesh.Trimesh(
        np.concatenate([ball.vertices, [[0, 0, 90]]]),
        np.concatenate([ball.faces, [[*ball.faces[0, :2], len(ball.vertices)]]]),
    )
    sheet = trimesh.Trimesh([[0, 0, 0], [90, 0, 0], [0, 90, 0]], [[0, 1, 2]])
    for name, mesh, words in (
        ("bowl", bowl, r"is open: 1 of its 1 hole\(s\), up to 79 mm wide, cannot be filled"),
        ("fin", fin, "more than two triangles"),
        ("sheet", sheet, "does not enclose a volume"),
    ):
        with pytest.raises(TactipError, match=words):
            load_object(written(tmp_path / f"{name}.ply", mesh))


def test_wrong_input_is_one_sentence(tmp_path, ball):
    path = written(tmp_path / "ball.stl", ball)
    damaged, text = tmp_path / "damaged.ply", tmp_path / "text.stl"
    damaged.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9999\nproperty float x\nend_header\n")
    text.write_text("no mesh at all")
    gaps = ball.copy()
    gaps.vertices[0] = np.nan
    for name, words, options in (
        (path, "check its unit", {"unit": "m"}),
        (path, r"rotation_deg must be finite, got \(nan, 0, 0\)", {"rotation_deg": (np.nan, 0, 0)}),
        (path, "position_mm must be finite", {"position_mm": (np.inf, 0, 0)}),
        (path, "unit", {"unit": "inch"}),
        ("bust", "'bust' is a built-in object: leave --unit out", {"unit": "mm"}),
        (path, "above 0", {"scale": 0.0}),
        (tmp_path / "none.stl", "there is no mesh file", {}),
        ("busts", "choose one of bust", {}),
        (damaged, "damaged.ply", {}),
        (text, "text.stl", {}),
        (written(tmp_path / "ball.off", ball), "must end in one of stl", {}),
        (written(tmp_path / "gaps.ply", gaps), "not finite", {}),
    ):
        with pytest.raises(TactipError, match=words):
            load_object(name, **options)


def test_too_fine_a_mesh_is_refused_before_anything_is_built(monkeypatch, ball, tmp_path):
    monkeypatch.setattr("tactip_twin.sim.robot.objects.MAX_TRIANGLES", 100)
    with pytest.raises(TactipError, match="simplify"):
        load_object(written(tmp_path / "ball.stl", ball))
    assert MAX_TRIANGLES > 1e6


def test_mesh_in_memory_is_in_metres_and_unchanged(ball):
    mesh = ball.copy().apply_scale(1e-3)
    before = mesh.vertices.copy()
    scene_object = load_object(mesh, scale=2.0)
    assert scene_object.name == "mesh"
    assert scene_object.solid.distance(np.zeros(3)) == pytest.approx(-0.08, abs=5e-4)
    assert np.array_equal(mesh.vertices, before)
    assert load_object(ball, unit="mm").solid.distance(np.zeros(3)) == pytest.approx(-0.04, abs=5e-4)


@pytest.mark.parametrize("name", HARD_RIMS)
def test_rim_file_comes_with_its_edge(tmp_path, name):
    """The edge lies on the top of the mesh, also scaled, except over the gap."""
    write_rim(name, HARD_RIMS[name], tmp_path)
    scene_object = load_object(tmp_path / f"{name}.ply", unit="m", scale=0.5)
    edge = scene_object.edge
    assert edge is not None
    assert edge.closed
    assert np.allclose(edge.normals, [0, 0, 1], atol=1e-4)
    on = np.abs(scene_object.solid.distance(edge.points)) < 0.3e-3
    assert on.mean() == pytest.approx(1 - (29 / (2 * np.pi * 60) if name == "rim-gap" else 0), abs=0.01)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[::-1], "must run anticlockwise as seen from above"),
        (lambda rows: rows + [0, 0, 30, 0, 0, 0], "must be on the mesh beside it, got .* mm from it"),
        (lambda rows: rows * [1e-3, 1e-3, 1e-3, 1, 1, 1], "must be on the mesh beside it"),
    ],
)
def test_edge_that_does_not_fit_its_mesh_is_refused(tmp_path, change, message):
    name = next(iter(RIMS))
    write_coarse_rim(name, RIMS[name], tmp_path)
    path = tmp_path / f"{name}.edge.csv"
    head = path.read_text().splitlines()[0]
    np.savetxt(path, change(np.loadtxt(path, delimiter=",", skiprows=1)), delimiter=",", header=head, comments="")
    with pytest.raises(TactipError, match=message):
        load_object(tmp_path / f"{name}.ply", unit="m")


def test_object_in_inches(tmp_path, ball):
    ball.copy().apply_scale(1 / 25.4).export(tmp_path / "ball.stl")
    assert load_object(tmp_path / "ball.stl", unit="in").solid.distance(np.zeros(3)) == pytest.approx(-0.04, abs=5e-4)


def test_object_of_flat_triangles_is_refused(tmp_path):
    """Three points on a line: nothing is left after triangles without area are removed."""
    mesh = trimesh.Trimesh([[0, 0, 0], [10, 0, 0], [20, 0, 0]], [[0, 1, 2]], process=False)
    mesh.export(tmp_path / "line.ply")
    with pytest.raises(TactipError, match="has no triangles of an area above 0"):
        load_object(tmp_path / "line.ply")


def test_object_with_triangles_of_missing_vertices_is_refused(tmp_path):
    text = trimesh.creation.box((20, 20, 20)).export(file_type="ply", encoding="ascii").decode()
    (tmp_path / "box.ply").write_text(text.replace("3 1 3 0", "3 1 3 99999"))
    with pytest.raises(TactipError, match=r"is damaged|cannot be read as a mesh"):
        load_object(tmp_path / "box.ply")
