"""Pictures of coloured surfaces, off screen, by pyrender."""

import numpy as np

from tactip_twin.tactip_model.pyrender_renderer import renderer

BACKGROUND = (252, 252, 252)

_LIGHTS = (((0.3, -0.5, 0.8), 0.66), ((-0.7, 0.5, 0.4), 0.3))
"""Directions of light, and how much of it."""

_AMBIENT = 0.2

_NEAR_M, _FAR_M = 0.02, 6.0


class SceneRenderer:
    """A camera among surfaces; cheap to use, dear to make."""

    def __init__(self, width, height, still):
        """width, height: int, px. still: list of stage.Prop that stay. Raises TactipError where OpenGL cannot be used."""
        self._pyrender, self._renderer = renderer()
        self._size = width, height
        background = [c / 255 for c in BACKGROUND]
        self._scene = self._pyrender.Scene(bg_color=[*background, 1.0], ambient_light=[1.0, 1.0, 1.0])
        self._camera = self._scene.add(self._pyrender.PerspectiveCamera(0.6, _NEAR_M, _FAR_M))
        if still:
            self._scene.add(self._mesh(still))

    def picture(self, moving, eye, target, field_deg=35.0):
        """Image (h, w, 3) uint8 of what stays and `moving`, a list of Prop.

        eye, target: (3,) m, where the camera is and what is in its middle. field_deg: float, from its lower to its upper
        border.
        """
        self._camera.camera.yfov = np.radians(field_deg)
        self._scene.set_pose(self._camera, looking(eye, target))
        node = self._scene.add(self._mesh(moving)) if moving else None
        self._renderer.viewport_width, self._renderer.viewport_height = self._size
        flags = self._pyrender.RenderFlags.FLAT | self._pyrender.RenderFlags.SKIP_CULL_FACES
        image = self._renderer.render(self._scene, flags=flags)[0][..., :3]
        if node is not None:
            self._scene.remove_node(node)
        return image

    def _mesh(self, props):
        """One pyrender mesh of props, with the light in its colours."""
        counts = np.cumsum([0] + [len(p.vertices) for p in props])
        colour = np.concatenate([shade(p.normals) * (np.array(p.colour) / 255) for p in props])
        primitive = self._pyrender.Primitive(
            positions=np.concatenate([p.vertices for p in props]).astype(np.float32),
            indices=np.concatenate([p.triangles + n for p, n in zip(props, counts[:-1], strict=True)]),
            color_0=np.column_stack([colour, np.ones(len(colour))]).astype(np.float32),
            material=self._pyrender.MetallicRoughnessMaterial(doubleSided=True, baseColorFactor=[1.0, 1.0, 1.0, 1.0]),
        )
        return self._pyrender.Mesh([primitive])


def looking(eye, target):
    """Pose (4, 4) of a camera at `eye` (3,) that looks at `target` (3,), upright: x right, y up, z back."""
    T, back = np.eye(4), np.asarray(eye, float) - np.asarray(target, float)
    back /= np.linalg.norm(back)
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    T[:3, :3] = np.stack([right, np.cross(back, right), back], 1)
    T[:3, 3] = eye
    return T


def shade(normals):
    """Light (n, 1), 0 to 1, on normals (n, 3)."""
    light = _AMBIENT + sum(much * np.maximum(normals @ (np.array(way) / np.linalg.norm(way)), 0) for way, much in _LIGHTS)
    return np.clip(light, 0.02, 1)[:, None]
