"""The paper's figure 1: an object, and on it the way of the sensor and the normals that it felt."""

import cv2
import numpy as np

from sim.dataset import write_file
from sim.picture import Studio
from sim.pose import sensor_in_contact
from sim.recording import PHASES
from sim.stage import PORCELAIN, solid_prop, tube

COLOURS = {"surface": (200.0, 30, 30), "edge": (30.0, 70, 210)}
"""Of the way and its normals, red, green and blue."""

_WIDTH, _HEIGHT = 1200, 900
_NORMAL_M = 6e-3
_EVERY_M = 2.5e-3
"""Length of the normals that are drawn, and their distance along the way, m."""

_FIELD_DEG = 20.0
"""Field of view of the picture: a narrow one, which hardly distorts."""


def way(arrays, task, end=None):
    """Props (list) of the way of a recording and the normals that were felt on it, up to step `end`.

    arrays: of sim.recording. task: surface or edge.
    """
    following = (arrays["phase"] == PHASES.index("follow"))[:end]
    poses, felt = arrays["T_base_tcp"][:end][following], arrays["felt"][:end][following]
    if len(poses) < 2:
        return []
    frames = np.array([P @ np.linalg.inv(sensor_in_contact(label)) for P, label in zip(poses, felt, strict=True)])
    # Where the surface is felt to be, under the sensor.
    places = frames[:, :3, 3] + 0.6e-3 * frames[:, :3, 2]
    out = [tube(places, 0.7e-3, COLOURS[task])]
    gone = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    for k in np.unique(np.searchsorted(gone, np.arange(0, gone[-1], _EVERY_M))):
        ends = np.stack([places[k], places[k] + _NORMAL_M * frames[k, :3, 2]])
        out.append(tube(ends, 0.3e-3, COLOURS[task]))
    return out


def write_figure(path, thing, arrays, task, towards=(0.55, -0.6, 0.75)):
    """Draw a recording over its object. path: Path, .png. thing: objects.Thing. arrays: of sim.recording. task: str.

    towards: (3,), from the object to the eye, base frame. Raises TactipError where OpenGL cannot be used.
    """
    placed = solid_prop(thing.solid, PORCELAIN).moved(thing.T_base_object)
    low, high = placed.vertices.min(0), placed.vertices.max(0)
    middle, radius = (low + high) / 2, np.linalg.norm(placed.vertices - (low + high) / 2, axis=1).max()
    eye = np.asarray(towards, float) / np.linalg.norm(towards)
    studio = Studio(_WIDTH, _HEIGHT, [placed])
    away = 0.95 * radius / np.sin(np.radians(_FIELD_DEG / 2))
    picture = studio.picture(way(arrays, task), middle + away * eye, middle, _FIELD_DEG)
    small = cv2.resize(picture, (_WIDTH * 3 // 4, _HEIGHT * 3 // 4), interpolation=cv2.INTER_AREA)
    ok, data = cv2.imencode(".png", small[..., ::-1])
    if not ok:
        raise ValueError("a picture could not be written as PNG")
    write_file(path, data.tobytes())
