"""Display of a run: meshes are placed at arm and sensor, images show what is in front, videos contain every frame."""

from dataclasses import replace

import av
import numpy as np
import pytest
import trimesh
from PIL import Image

from helpers.recordings import scenery, tip_mesh
from tactip_twin.sim.robot.irb120 import READY_RAD, Arm
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.sim.view.geometry import ColoredMesh, SceneGeometry, nearest_to_ray, object_mesh, tube
from tactip_twin.sim.view.offscreen import BACKGROUND, SceneRenderer, look_at, shade
from tactip_twin.sim.view.video import write_video
from tactip_twin.tactip_model.errors import TactipError


def _ball(centre, radius, color):
    mesh = trimesh.creation.icosphere(3, radius)
    return ColoredMesh(mesh.vertices + centre, mesh.faces, mesh.vertices / radius, color)


@pytest.fixture(scope="module")
def geometry():
    return SceneGeometry(scenery())


def _skin():
    mesh = tip_mesh()
    return mesh.vertices[: mesh.surface_count]


def test_sensor_is_at_the_end_of_the_arm(geometry):
    """The housing, placed by the tip's pose, meets the flange of the arm, placed by its joint angles."""
    arm, skin = Arm(), _skin()
    for turn in (0.0, 0.4, -0.7):
        angles = READY_RAD + turn * np.array([1, 0.2, -0.3, 0.5, 0.4, 1])
        T = arm.forward(angles)
        meshes = geometry.moving_meshes(angles, T, skin)
        assert np.allclose(meshes[0].vertices, skin @ T[:3, :3].T + T[:3, 3])
        flange = T[:3, 3] - 89.1e-3 * T[:3, 2]
        mount = min(meshes[1:3], key=lambda p: np.linalg.norm(p.vertices - flange, axis=1).min())
        assert np.isclose(((mount.vertices - flange) @ T[:3, 2]).min(), 0, atol=1e-9)
        link = min(meshes[3:], key=lambda p: np.linalg.norm(p.vertices.mean(0) - flange))
        assert np.isclose(((link.vertices - flange) @ T[:3, 2]).max(), 0, atol=1e-6)


def test_without_an_arm_there_is_none(geometry):
    without = SceneGeometry(scenery(with_arm=False))
    T, skin = Arm().forward(READY_RAD), _skin()
    assert len(without.moving_meshes(np.full(6, np.nan), T, skin)) == 3 < len(geometry.moving_meshes(READY_RAD, T, skin))
    assert len(geometry.moving_meshes(np.full(6, np.nan), T, skin)) == 3


def test_object_that_is_held_has_no_pedestal():
    T = scenery().T_base_object.copy()
    T[2, 3] += 0.1
    lifted = replace(scenery(), T_base_object=T)
    heights = [SceneGeometry(lifted, held).table.vertices[:, 2].max() for held in (False, True)]
    assert heights[0] == pytest.approx(0.1, abs=1e-3) and heights[1] < 0


def test_meshes_are_moved_whole(geometry):
    T = Arm().forward(READY_RAD)
    for mesh in [geometry.object, geometry.table] + geometry.moving_meshes(READY_RAD, T, _skin()):
        assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
        corners = mesh.vertices[mesh.triangles]
        faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = (faces[:, None] * mesh.normals[mesh.triangles]).sum(-1)
        assert (facing > 0).mean() > 0.99


def test_tube_is_round():
    points = np.column_stack([np.linspace(0, 1, 20), np.zeros(20), np.zeros(20)])
    one = tube(points, 0.05, np.column_stack([np.arange(20.0), np.zeros((20, 2))]))
    assert np.allclose(np.hypot(*one.vertices[:, 1:].T), 0.05)
    assert one.triangles.max() == len(one.vertices) - 1
    assert np.allclose(one.vertex_colors[:, 0], 19 * one.vertices[:, 0])


def test_image_shows_the_nearest_object():
    red, blue = _ball([0, 0, 0], 0.1, (255.0, 0, 0)), _ball([0.5, 0, 0], 0.1, (0.0, 0, 255))
    renderer = SceneRenderer(120, 90, [blue])
    for eye, channel in (([-1, 0, 0], 0), ([1.5, 0, 0], 2)):
        image = renderer.render([red], eye, [0.2, 0, 0])
        assert image.shape == (90, 120, 3)
        middle = image[45, 60].astype(int)
        assert middle[channel] > 20 and middle[[c for c in range(3) if c != channel]].max() == 0
        assert tuple(image[0, 0]) == BACKGROUND
    # Moving meshes are absent from the next image.
    assert renderer.render([], [-1, 0, 0], [0.2, 0, 0])[45, 60, 0] == 0


def test_camera_is_upright_and_points_at_its_target():
    eye, target = np.array([1.0, 2, 3]), np.array([0.2, 0.1, 0.4])
    T = look_at(eye, target)
    assert np.allclose(T[:3, :3].T @ T[:3, :3], np.eye(3))
    assert np.allclose(np.cross(T[:3, 2], eye - target), 0)
    assert T[2, 1] > 0 and np.isclose(T[2, 0], 0)


def test_light_comes_from_above():
    assert shade(np.array([[0.0, 0, 1]])) > shade(np.array([[0.0, 0, -1]]))


def test_object_is_drawn_at_its_pose():
    scene_object, mesh = load_object("sphere"), object_mesh(scenery())
    solid, T = scene_object.solid, scene_object.T_base_object
    assert np.allclose(mesh.vertices[mesh.triangles], solid.vertices[solid.triangles] @ T[:3, :3].T + T[:3, 3])


def test_video_contains_every_frame(tmp_path):
    levels = [20, 90, 160, 230]
    path = tmp_path / "film.mp4"
    assert write_video(path, (np.full((64, 96, 3), level, np.uint8) for level in levels)) == 4
    with av.open(str(path)) as film:
        frames = [f.to_ndarray(format="rgb24") for f in film.decode(video=0)]
    assert [f.shape for f in frames] == [(64, 96, 3)] * 4
    assert np.allclose([f.mean() for f in frames], levels, atol=6)
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]


def test_failed_video_leaves_no_file(tmp_path):
    def broken():
        yield np.zeros((64, 64, 3), np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "film.mp4", broken())
    assert not list(tmp_path.iterdir())
    still = [np.zeros((64, 64, 3), np.uint8)]
    for name in ("film.mp4", "film.gif"):
        with pytest.raises(TactipError, match=r"cannot write .*there is no folder"):
            write_video(tmp_path / "none" / name, still)
    with pytest.raises(TactipError, match=r"must end in one of \.mp4, \.gif"):
        write_video(tmp_path / "film.avi", still)
    with pytest.raises(TactipError, match="the recording has no steps"):
        write_video(tmp_path / "film.mp4", [])


def test_gif_contains_every_frame(tmp_path):
    path = tmp_path / "film.gif"
    pictures = [np.full((64, 96, 3), level, np.uint8) for level in (20, 90, 160)]
    for k, picture in enumerate(pictures):
        picture[:, : 10 * (k + 1)] = 255
    assert write_video(path, pictures, rate=20) == 3
    with Image.open(path) as gif:
        assert (gif.n_frames, gif.info["duration"], gif.size) == (3, 50, (96, 64))
        for k, picture in enumerate(pictures):
            gif.seek(k)
            assert np.abs(np.asarray(gif.convert("RGB")).astype(int) - picture).mean() < 2


def test_nearest_place_to_a_ray_is_chosen_by_angle():
    """Seen from the eye, so of two places at the same distance from the ray, the farther one; and none behind."""
    places = np.array([[0.01, 0, 1.0], [0.01, 0, 2.0], [0, 0, -1.0]])
    assert nearest_to_ray(places, np.zeros(3), [0, 0, 1.0], np.radians(1)) == 1
    assert nearest_to_ray(places[:1], np.zeros(3), [0, 0, 1.0], np.arctan(0.01) + 1e-9) == 0
    assert nearest_to_ray(places[:1], np.zeros(3), [0, 0, 1.0], np.arctan(0.01) - 1e-9) is None
    assert nearest_to_ray(places[2:], np.zeros(3), [0, 0, 1.0], np.radians(80)) is None
    assert nearest_to_ray(places[:0], np.zeros(3), [0, 0, 1.0], 1.0) is None
