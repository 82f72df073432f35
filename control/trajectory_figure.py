"""The paper's figure 1: the sensor's path on an object, with the estimated normals."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import trimesh

from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.dataset.format import encode_image
from tactip_twin.sim.labels import Task
from tactip_twin.sim.robot.recording import RecordedScene
from tactip_twin.sim.view.geometry import Color, ColoredMesh, object_mesh, path_meshes
from tactip_twin.sim.view.offscreen import SceneRenderer
from tactip_twin.tactip_model.files import write_file

_WIDTH, _HEIGHT = 1200, 900
_MARK_M = 1e-3
"""Radius of a mark of what was left out, m."""

LEFT_OUT_COLOR: Color = (245.0, 150.0, 20.0)

_FIELD_DEG = 20.0
"""Field of view of the figure, degrees: narrow, for little distortion."""


def write_figure(
    path: Path,
    scenery: RecordedScene,
    arrays: Mapping[str, np.ndarray],
    task: Task,
    towards: tuple[float, float, float] = (0.55, -0.6, 0.75),
    left_out: Sequence[np.ndarray] = (),
) -> None:
    """Render a recorded path on its object to a file.

    Args:
        path: File to write, .png.
        scenery: Scene of the recording.
        arrays: Arrays of the recording.
        task: Task of the run.
        towards: (3,), direction from the object to the eye, base frame.
        left_out: Places (n, 3), m, base frame, of each stretch that was left out, which is marked.

    Raises:
        TactipError: OpenGL cannot be used.
    """
    placed = object_mesh(scenery)
    low, high = placed.vertices.min(0), placed.vertices.max(0)
    middle, radius = (low + high) / 2, np.linalg.norm(placed.vertices - (low + high) / 2, axis=1).max()
    eye = np.asarray(towards, float) / np.linalg.norm(towards)
    renderer = SceneRenderer(_WIDTH, _HEIGHT, [placed])
    away = 0.95 * radius / np.sin(np.radians(_FIELD_DEG / 2))
    meshes = [*path_meshes(arrays, task), *_left_out_meshes(left_out, placed)]
    picture = renderer.render(meshes, middle + away * eye, middle, _FIELD_DEG)
    small = cv2.resize(picture, (_WIDTH * 3 // 4, _HEIGHT * 3 // 4), interpolation=cv2.INTER_AREA)
    write_file(path, encode_image(small[..., ::-1]))  # PNGs are encoded from blue, green and red


def _left_out_meshes(left_out: Sequence[np.ndarray], placed: ColoredMesh) -> list[ColoredMesh]:
    """Return a mark on the object for each stretch (n, 3), m, that was left out."""
    solid = SignedDistanceMesh(placed.vertices, placed.triangles)
    places = [place for stretch in left_out for place in solid.nearest(stretch).place]
    dot = trimesh.creation.icosphere(2, _MARK_M)
    return [ColoredMesh(dot.vertices + p, dot.faces, np.asarray(dot.vertex_normals), LEFT_OUT_COLOR) for p in places]
