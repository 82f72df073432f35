"""The paper's figure 1: the sensor's path on an object, with the estimated normals."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from tactip_twin.sim.dataset.format import encode_image
from tactip_twin.sim.labels import Task
from tactip_twin.sim.robot.recording import RecordedScene
from tactip_twin.sim.view.geometry import object_mesh, path_meshes
from tactip_twin.sim.view.offscreen import SceneRenderer
from tactip_twin.tactip_model.files import write_file

_WIDTH, _HEIGHT = 1200, 900
_FIELD_DEG = 20.0
"""Field of view of the figure, degrees: narrow, for little distortion."""


def write_figure(
    path: Path,
    scenery: RecordedScene,
    arrays: Mapping[str, np.ndarray],
    task: Task,
    towards: tuple[float, float, float] = (0.55, -0.6, 0.75),
) -> None:
    """Render a recorded path on its object to a file.

    Args:
        path: File to write, .png.
        scenery: Scene of the recording.
        arrays: Arrays of the recording.
        task: Task of the run.
        towards: (3,), direction from the object to the eye, base frame.

    Raises:
        TactipError: OpenGL cannot be used.
    """
    placed = object_mesh(scenery)
    low, high = placed.vertices.min(0), placed.vertices.max(0)
    middle, radius = (low + high) / 2, np.linalg.norm(placed.vertices - (low + high) / 2, axis=1).max()
    eye = np.asarray(towards, float) / np.linalg.norm(towards)
    renderer = SceneRenderer(_WIDTH, _HEIGHT, [placed])
    away = 0.95 * radius / np.sin(np.radians(_FIELD_DEG / 2))
    picture = renderer.render(path_meshes(arrays, task), middle + away * eye, middle, _FIELD_DEG)
    small = cv2.resize(picture, (_WIDTH * 3 // 4, _HEIGHT * 3 // 4), interpolation=cv2.INTER_AREA)
    write_file(path, encode_image(small[..., ::-1]))  # PNGs are encoded from blue, green and red
