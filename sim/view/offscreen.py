"""Off-screen images of colored meshes, by pyrender."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.view.geometry import ColoredMesh
from tactip_twin.tactip_model.pyrender_renderer import renderer

BACKGROUND = (252, 252, 252)

_LIGHTS = (((0.3, -0.5, 0.8), 0.58), ((-0.7, 0.5, 0.4), 0.26))
"""Directions and strengths of the lights."""

_AMBIENT = 0.34

_NEAR_M, _FAR_M = 0.02, 6.0


class SceneRenderer:
    """A camera in a scene of meshes, slow to build and fast to use."""

    def __init__(self, width: int, height: int, static: Sequence[ColoredMesh]) -> None:
        """Build the scene.

        Args:
            width: Width of the images, px.
            height: Height of the images, px.
            static: Meshes that are in every image.

        Raises:
            TactipError: If OpenGL cannot be used.
        """
        self._pyrender, self._renderer = renderer()
        self._size = width, height
        background = [c / 255 for c in BACKGROUND]
        self._scene = self._pyrender.Scene(bg_color=[*background, 1.0], ambient_light=[1.0, 1.0, 1.0])
        self._camera = self._scene.add(self._pyrender.PerspectiveCamera(0.6, _NEAR_M, _FAR_M))
        if static:
            self._scene.add(self._mesh(static))

    def render(
        self, moving: Sequence[ColoredMesh], eye: ArrayLike, target: ArrayLike, field_deg: float = 35.0
    ) -> np.ndarray:
        """Render the static meshes together with others.

        Args:
            moving: Meshes of this image only.
            eye: (3,) m, position of the camera.
            target: (3,) m, point in the middle of the image.
            field_deg: Vertical field of view, degrees.

        Returns:
            Image (h, w, 3) uint8.
        """
        self._camera.camera.yfov = np.radians(field_deg)
        self._scene.set_pose(self._camera, look_at(eye, target))
        node = self._scene.add(self._mesh(moving)) if moving else None
        self._renderer.viewport_width, self._renderer.viewport_height = self._size
        flags = self._pyrender.RenderFlags.FLAT | self._pyrender.RenderFlags.SKIP_CULL_FACES
        image = self._renderer.render(self._scene, flags=flags)[0][..., :3]
        if node is not None:
            self._scene.remove_node(node)
        return image

    def _mesh(self, meshes: Sequence[ColoredMesh]) -> Any:  # pyrender has no types
        """Return meshes as one pyrender mesh, with the light in its colors."""
        counts = np.cumsum([0] + [len(m.vertices) for m in meshes])
        color = np.concatenate([_light(m) * (m.color if m.vertex_colors is None else m.vertex_colors) / 255 for m in meshes])
        primitive = self._pyrender.Primitive(
            positions=np.concatenate([m.vertices for m in meshes]).astype(np.float32),
            indices=np.concatenate([m.triangles + n for m, n in zip(meshes, counts[:-1], strict=True)]),
            color_0=np.column_stack([color, np.ones(len(color))]).astype(np.float32),
            material=self._pyrender.MetallicRoughnessMaterial(doubleSided=True, baseColorFactor=[1.0, 1.0, 1.0, 1.0]),
        )
        return self._pyrender.Mesh([primitive])


def look_at(eye: ArrayLike, target: ArrayLike) -> np.ndarray:
    """Return the pose (4, 4) of an upright camera at `eye` (3,) that looks at `target` (3,): x right, y up, z back."""
    T, back = np.eye(4), np.asarray(eye, float) - np.asarray(target, float)
    back /= np.linalg.norm(back)
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    T[:3, :3] = np.stack([right, np.cross(back, right), back], 1)
    T[:3, 3] = eye
    return T


def _light(mesh: ColoredMesh) -> np.ndarray:
    """Return the light (n, 1), 0 to 1, on the vertices of a mesh."""
    return shade(mesh.normals) if mesh.lit else np.ones((len(mesh.vertices), 1))


def shade(normals: np.ndarray) -> np.ndarray:
    """Return the light (n, 1), 0 to 1, on surfaces with normals (n, 3)."""
    light = _AMBIENT + sum(
        strength * np.maximum(normals @ (np.array(direction) / np.linalg.norm(direction)), 0)
        for direction, strength in _LIGHTS
    )
    return np.clip(light, 0.02, 1)[:, None]
