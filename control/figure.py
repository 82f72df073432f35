"""The paper's figure 1: an object, and on it the way of the sensor and the normals that it felt."""

import cv2
import numpy as np

from sim.dataset import write_file
from sim.pose import sensor_in_contact
from sim.recording import PHASES
from tactip_model.camera import Canvas

COLOURS = {"surface": (200.0, 30, 30), "edge": (30.0, 70, 210)}
"""Of the way and its normals, red, green and blue."""

_WIDTH, _HEIGHT = 1200, 900
_NORMAL_M = 6e-3
_EVERY_M = 2.5e-3
"""Length of the normals that are drawn, and their distance along the way, m."""

_LIGHTS = (((0.3, -0.5, 0.8), 0.75), ((-0.7, 0.4, 0.35), 0.25))
"""Directions of light, and how much of it."""

_AMBIENT = 0.12


def write_figure(path, thing, arrays, task, towards=(0.55, -0.6, 0.75)):
    """Draw a recording over its object. path: Path, .png. thing: objects.Thing. arrays: of sim.recording. task: str.

    towards: (3,), from the object to the eye, base frame. Raises TactipError where OpenGL cannot be used.
    """
    eye = np.asarray(towards, float) / np.linalg.norm(towards)
    right = np.cross([0, 0, 1.0], eye)
    right /= np.linalg.norm(right)
    view = np.stack([right, -np.cross(eye, right), -eye])  # right, down, away
    T = thing.T_base_object
    vertices = thing.solid.vertices @ T[:3, :3].T + T[:3, 3]
    seen = vertices @ view.T
    low, high = seen.min(0), seen.max(0)
    scale = 0.9 * min(_WIDTH / (high - low)[0], _HEIGHT / (high - low)[1])
    middle = (low + high) / 2

    def project(points):
        own = (points @ view.T - middle) * scale
        return own * [1, 1, 1 / (2 * scale)] + [_WIDTH / 2, _HEIGHT / 2, 2.0]

    canvas = Canvas(_WIDTH, _HEIGHT)
    corners = vertices[thing.solid.triangles]
    normals = thing.solid.corner_normals @ T[:3, :3].T
    shade = _shade(normals.reshape(-1, 3))
    canvas.add(canvas.mesh(project(corners.reshape(-1, 3)), np.arange(3 * len(corners)).reshape(-1, 3), 235 * shade))
    following = arrays["phase"] == PHASES.index("follow")
    poses, felt = arrays["T_base_tcp"][following], arrays["felt"][following]
    if len(poses) > 1:
        frames = np.array([P @ np.linalg.inv(sensor_in_contact(label)) for P, label in zip(poses, felt, strict=True)])
        # Where the surface is felt to be, under the sensor.
        places = frames[:, :3, 3] + 0.6e-3 * frames[:, :3, 2]
        _tube(canvas, project, places, 0.7e-3, COLOURS[task])
        gone = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
        for k in np.unique(np.searchsorted(gone, np.arange(0, gone[-1], _EVERY_M))):
            ends = np.stack([places[k], places[k] + _NORMAL_M * frames[k, :3, 2]])
            _tube(canvas, project, ends, 0.3e-3, COLOURS[task])
    picture = canvas.picture().copy()
    picture[(picture == 0).all(-1)] = 255
    small = cv2.resize(picture, (_WIDTH * 3 // 4, _HEIGHT * 3 // 4), interpolation=cv2.INTER_AREA)
    ok, data = cv2.imencode(".png", small[..., ::-1])
    if not ok:
        raise ValueError("a picture could not be written as PNG")
    write_file(path, data.tobytes())


def _shade(normals):
    """Light (n, 1), 0 to 1, on normals (n, 3)."""
    light = _AMBIENT + sum(much * np.maximum(normals @ (np.array(way) / np.linalg.norm(way)), 0) for way, much in _LIGHTS)
    return np.clip(light, 0.02, 1)[:, None] * np.ones(3)


def _tube(canvas, project, points, radius, colour, sides=8):
    """Add a tube along points (n, 3), m."""
    ways = np.gradient(points, axis=0)
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
    across = np.cross(ways, [0.3, 0.5, 0.81])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    other = np.cross(ways, across)
    turn = 2 * np.pi * np.arange(sides) / sides
    normals = np.cos(turn)[:, None] * across[:, None] + np.sin(turn)[:, None] * other[:, None]
    rings = points[:, None] + radius * normals
    k, j = np.meshgrid(np.arange(len(points) - 1), np.arange(sides), indexing="ij")
    a, b = (k * sides + j).ravel(), (k * sides + (j + 1) % sides).ravel()
    triangles = np.concatenate([np.stack([a, b, a + sides], 1), np.stack([b, b + sides, a + sides], 1)])
    colours = np.asarray(colour) * (0.35 + 0.65 * _shade(normals.reshape(-1, 3)))
    canvas.add(canvas.mesh(project(rings.reshape(-1, 3)), triangles, colours))
