"""Scores of a trajectory over a surface by what the tip can touch and by the local curvature."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from tactip_twin.control.reach import fits, touchable
from tactip_twin.control.score import COVERED_M, angles_to_normal_deg, coverage, mean_or_none, touched_places
from tactip_twin.sim.contact.patch_normals import mean_normals, tangents
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.ground_truth import SurfaceGroundTruth
from tactip_twin.sim.robot.objects import SceneObject
from tactip_twin.sim.robot.recording import PHASES

_CURVATURE_SPAN_M = 2e-3
"""Distance over which the curvature of a surface is measured, m."""

CURVATURE_BINS = {
    "hollow, radius below 20 mm": (-np.inf, -1 / 20e-3),
    "hollow, radius 20 to 40 mm": (-1 / 20e-3, -1 / 40e-3),
    "radius above 40 mm": (-1 / 40e-3, 1 / 40e-3),
    "ridge, radius 12.5 to 40 mm": (1 / 40e-3, 1 / 12.5e-3),
    "ridge, radius below 12.5 mm": (1 / 12.5e-3, np.inf),
}
"""Ranges of the curvature, 1/m, convex positive: the tip's radius is 20 mm, and 12.5 mm is the smallest in the training."""


def surface_score(
    arrays: Mapping[str, np.ndarray],
    scene_object: SceneObject,
    targets: np.ndarray,
    depth_mm: float,
    radius_m: float,
) -> dict[str, Any]:
    """Return the scores, as JSON values.

    Args:
        arrays: Arrays of the recording (recording.read_recording).
        scene_object: The object.
        targets: (m, 3), target points, base frame, m.
        depth_mm: Commanded depth, mm.
        radius_m: Radius of the dome, m.
    """
    following, solid = arrays["phase"] == PHASES.index("follow"), scene_object.solid
    true = arrays["true"][following]
    T = np.linalg.inv(scene_object.T_base_object)
    reached = touchable(solid, targets @ T[:3, :3].T + T[:3, 3], radius_m, depth_mm / 1e3)
    truth = SurfaceGroundTruth(solid)
    poses = T @ arrays["T_base_tcp"][following]
    nearest = np.array([truth.frame(pose)[:3, 3] for pose in poses]).reshape(-1, 3)
    depth_errors, angles = np.abs(1e3 * true[:, 2] + depth_mm), angles_to_normal_deg(true)
    cosines = -(poses[:, :3, 2] * mean_normals(solid, nearest)).sum(1)
    to_mean = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    groups = {"where the tip fits": fits(solid, nearest, radius_m, depth_mm / 1e3)}
    curvature = extreme_curvature(solid, nearest)
    groups |= {name: (curvature >= low) & (curvature < high) for name, (low, high) in CURVATURE_BINS.items()}
    return {
        "reachable": mean_or_none(reached),
        "coverage_of_reachable": coverage(touched_places(arrays), targets[reached], COVERED_M),
        "errors": {name: _errors(depth_errors[chosen], angles[chosen], to_mean[chosen]) for name, chosen in groups.items()},
    }


def extreme_curvature(solid: SignedDistanceMesh, places: np.ndarray) -> np.ndarray:
    """Return the normal curvature (n,), 1/m, convex positive, of largest magnitude at places (n, 3), m, on a solid."""
    if not len(places):
        return np.zeros(0)
    h, found = _CURVATURE_SPAN_M, []
    for along in tangents(solid.smooth_normal(places), np.pi):
        change = solid.smooth_normal(places + h * along) - solid.smooth_normal(places - h * along)
        found.append((change * along).sum(1) / (2 * h))
    curvatures = np.array(found)
    return np.take_along_axis(curvatures, np.abs(curvatures).argmax(0)[None], 0)[0]


def _errors(depth_errors_mm: np.ndarray, angles: np.ndarray, to_mean: np.ndarray) -> dict[str, Any]:
    return {
        "steps": len(angles),
        "depth_mae_mm": mean_or_none(depth_errors_mm),
        "angle_mean_deg": mean_or_none(angles),
        "angle_p95_deg": float(np.percentile(angles, 95)) if len(angles) else None,
        "angle_to_mean_normal_deg": mean_or_none(to_mean),
    }
