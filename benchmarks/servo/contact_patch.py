"""Comparison of predicted normals with the surface's normal at the nearest point and with its mean over a patch."""

from os import PathLike

import numpy as np

from tactip_twin.sim.pose import inverse
from tactip_twin.sim.robot.recording import read_recording
from tactip_twin.sim.view.geometry import felt_frames

RADII_MM = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
"""Radii of the discs over which normals are averaged, mm; 0 is the nearest point itself."""

_ACROSS = 15
"""Points across a disc."""


def contact_patch_normal(folder, thing):
    """Angles between the normals that a recording felt and those of the surface, averaged over discs about where it is
    nearest. folder: path of the recording. thing: objects.Thing that was followed.

    Returns a dict: `felt_deg` and `apart_deg`, lists by RADII_MM: mean angle (degrees) from the felt normal to the disc's,
    and from the nearest place's to the disc's.
    """
    arrays = read_recording(folder)[1]
    frames, steps = felt_frames(arrays)
    T_object_base = inverse(thing.T_base_object)
    felt = frames[:, :3, 2] @ T_object_base[:3, :3].T
    apexes = arrays["T_base_tcp"][steps][:, :3, 3] @ T_object_base[:3, :3].T + T_object_base[:3, 3]
    places = thing.solid.nearest(apexes).place
    nearest = thing.solid.smooth_normal(places)
    means = [_mean_normals(thing.solid, places, nearest, 1e-3 * radius) for radius in RADII_MM]
    return {
        "felt_deg": [float(_angles(felt, mean).mean()) for mean in means],
        "apart_deg": [float(_angles(nearest, mean).mean()) for mean in means],
    }


def _mean_normals(solid, places, normals, radius):
    """Mean normals (n, 3), unit, of a Solid over discs about places (n, 3) m, square to normals (n, 3). radius: m."""
    line = np.linspace(-1, 1, _ACROSS)
    u, v = (a.ravel() for a in np.meshgrid(line, line))
    disc = radius * np.stack([u, v], 1)[u**2 + v**2 <= 1]
    across = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.stack([across, np.cross(normals, across)], 1)
    points = places[:, None] + np.einsum("dk,nkx->ndx", disc, axes)
    sums = solid.smooth_normal(points.reshape(-1, 3)).reshape(points.shape).sum(1)
    return sums / np.linalg.norm(sums, axis=1, keepdims=True)


def _angles(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(1), -1, 1)))
