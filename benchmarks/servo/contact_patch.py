"""Comparison of predicted normals with the surface's normal at the nearest point and with its mean over a patch."""

from os import PathLike

import numpy as np

from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.pose import inverse
from tactip_twin.sim.robot.objects import SceneObject
from tactip_twin.sim.robot.recording import read_recording
from tactip_twin.sim.view.geometry import predicted_frames

RADII_MM = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
"""Radii of the discs over which normals are averaged, mm; 0 is the nearest point itself."""

_ACROSS = 15
"""Points across a disc."""


def contact_patch_normal(folder: str | PathLike[str], scene_object: SceneObject) -> dict[str, list[float]]:
    """Return angles between predicted normals and the surface's normals, averaged over discs about the nearest points.

    Args:
        folder: Folder of a recording.
        scene_object: The object that was followed.

    Returns:
        `predicted_deg` and `apart_deg`, lists by RADII_MM: mean angle in degrees from predicted to disc's normal, and
        from the nearest point's to the disc's.
    """
    arrays = read_recording(folder)[1]
    frames, steps = predicted_frames(arrays)
    T_object_base = inverse(scene_object.T_base_object)
    predicted = frames[:, :3, 2] @ T_object_base[:3, :3].T
    apexes = arrays["T_base_tcp"][steps][:, :3, 3] @ T_object_base[:3, :3].T + T_object_base[:3, 3]
    points = scene_object.solid.nearest(apexes).place
    nearest = scene_object.solid.smooth_normal(points)
    means = [_mean_normals(scene_object.solid, points, nearest, 1e-3 * radius) for radius in RADII_MM]
    return {
        "predicted_deg": [float(_angles(predicted, mean).mean()) for mean in means],
        "apart_deg": [float(_angles(nearest, mean).mean()) for mean in means],
    }


def _mean_normals(solid: SignedDistanceMesh, centres: np.ndarray, normals: np.ndarray, radius: float) -> np.ndarray:
    """Return mean unit normals (n, 3) of a solid over discs.

    Args:
        solid: The solid.
        centres: (n, 3) m, of the discs.
        normals: (n, 3), unit, of the discs.
        radius: Radius of the discs, m.
    """
    line = np.linspace(-1, 1, _ACROSS)
    u, v = (a.ravel() for a in np.meshgrid(line, line))
    disc = radius * np.stack([u, v], 1)[u**2 + v**2 <= 1]
    across = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.stack([across, np.cross(normals, across)], 1)
    points = centres[:, None] + np.einsum("dk,nkx->ndx", disc, axes)
    sums = solid.smooth_normal(points.reshape(-1, 3)).reshape(points.shape).sum(1)
    return sums / np.linalg.norm(sums, axis=1, keepdims=True)


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return angles (n,) in degrees between unit vectors (n, 3)."""
    return np.degrees(np.arccos(np.clip((a * b).sum(1), -1, 1)))
