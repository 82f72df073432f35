"""The paper's figure 1: an object, and on it the way of the sensor and the normals that it felt."""

import cv2
import numpy as np

from tactip_twin.sim.dataset.format import encode_image
from tactip_twin.sim.view.geometry import object_mesh, way
from tactip_twin.sim.view.offscreen import SceneRenderer
from tactip_twin.tactip_model.files import write_file

_WIDTH, _HEIGHT = 1200, 900
_FIELD_DEG = 20.0
"""Field of view of the picture: a narrow one, which hardly distorts."""


def write_figure(path, scenery, arrays, task, towards=(0.55, -0.6, 0.75)):
    """Draw a recording over its object. path: Path, .png. scenery, arrays: of tactip_twin.sim.robot.recording. task: str.

    towards: (3,), from the object to the eye, base frame. Raises TactipError where OpenGL cannot be used.
    """
    placed = object_mesh(scenery)
    low, high = placed.vertices.min(0), placed.vertices.max(0)
    middle, radius = (low + high) / 2, np.linalg.norm(placed.vertices - (low + high) / 2, axis=1).max()
    eye = np.asarray(towards, float) / np.linalg.norm(towards)
    studio = SceneRenderer(_WIDTH, _HEIGHT, [placed])
    away = 0.95 * radius / np.sin(np.radians(_FIELD_DEG / 2))
    picture = studio.picture(way(arrays, task), middle + away * eye, middle, _FIELD_DEG)
    small = cv2.resize(picture, (_WIDTH * 3 // 4, _HEIGHT * 3 // 4), interpolation=cv2.INTER_AREA)
    write_file(path, encode_image(small[..., ::-1]))  # PNGs are encoded from blue, green and red
