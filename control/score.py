"""Scores of a trajectory, compared with the true geometry."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import to_mm_deg
from tactip_twin.sim.robot.objects import SceneObject
from tactip_twin.sim.robot.recording import PHASES

COVERED_M = 7e-3
"""Distance from the tip's path within which a point of a surface counts as touched, m: the radius of the contact patch of a
2 mm press on a flat surface [M]."""

EDGE_COVERED_M = 3e-3
"""The same for an edge, m: a step or two, and the distance by which corners of a rim are cut."""

_FAR_M = 3.0
"""Beyond every object, m."""

_SPACING_M = 2e-3
"""Spacing of the target points on a surface, m."""


def score(
    arrays: Mapping[str, np.ndarray], record: Mapping[str, Any], reference_mm_deg: np.ndarray, targets: np.ndarray
) -> dict[str, Any]:
    """Return the scores of a recording, as JSON values.

    Args:
        arrays: Arrays of the recording (recording.read_recording).
        record: Its record.
        reference_mm_deg: (6,), the label to keep, mm and degrees.
        targets: (m, 3), target points, base frame, m.

    Mean errors are over the steps of the phase `follow`: depth and, along an edge, x, of the true label against the
    reference; angle between the sensor's axis and the true normal. The maximum force is that of all steps, at rest;
    the peak includes what was between them.
    """
    following = arrays["phase"] == PHASES.index("follow")
    true, predicted = to_mm_deg(arrays["true"][following]), to_mm_deg(arrays["predicted"][following])
    edge = record["task"] == "edge"
    places, seconds = contact_places(arrays, following), arrays["seconds"]
    # Predicted contacts have no penetration.
    whole, penetration = float(seconds.sum()), arrays["penetration_m"][np.isfinite(arrays["penetration_m"])]
    force = np.linalg.norm(arrays["force_n"], axis=1)
    angles = angles_to_normal_deg(arrays["true"][following])
    out = {
        "task": record["task"],
        "object": record["object"],
        "depth_mae_mm": mean_or_none(np.abs(true[:, 2] - reference_mm_deg[2])),
        "depth_bias_mm": mean_or_none(true[:, 2] - reference_mm_deg[2]),
        "angle_mean_deg": mean_or_none(angles),
        "angle_p95_deg": float(np.percentile(angles, 95)) if len(angles) else None,
        "lateral_mae_mm": mean_or_none(np.abs(true[:, 0] - reference_mm_deg[0])) if edge else None,
        "prediction_mae": {name: mean_or_none(np.abs(predicted - true)[:, k]) for k, name in enumerate(COMPONENTS)},
        "contact_losses": sum(e["kind"] == "contact lost" for e in record["events"]),
        "events": dict(Counter(event["kind"] for event in record["events"])),
        # The places are in the recording.
        "left_out": [{k: v for k, v in s.items() if k != "places_m"} for s in record.get("left_out", [])],
        "coverage": coverage(touched_places(arrays), targets, EDGE_COVERED_M if edge else COVERED_M),
        "path_mm": float(1e3 * np.linalg.norm(np.diff(places, axis=0), axis=1).sum()) if len(places) else 0.0,
        "closed": record["closed"],
        "force_mean_n": mean_or_none(force[following]),
        "force_max_n": float(force.max()) if len(force) else None,
        "force_peak_n": record.get("peak_force_n"),
        "penetration_max_mm": float(1e3 * penetration.max()) if len(penetration) else None,
        "penetration_within_bound": mean_or_none(penetration <= QualityLimits().while_sliding().penetration_m),
        "steps_simulated": int((arrays["sim_steps"] > 0).sum()),
        "steps": len(seconds),
        "steps_followed": int(following.sum()),
        "steps_per_s": len(seconds) / whole if whole else None,
        "ms_a_step": dict(zip(("simulation", "image", "network", "control"), _medians_ms(seconds), strict=True)),
        "stopped_because": record["stopped_because"],
        "passes": _passes(arrays, following, true, angles, reference_mm_deg) if not edge else [],
    }
    return out


def events_text(events: Mapping[str, int] | int) -> str:
    """Return the number of events by kind in words; as it is where a result of an older version has their sum only."""
    return str(events) if isinstance(events, int) else ", ".join(f"{n} × {kind}" for kind, n in events.items()) or "none"


def summary(figures: Mapping[str, Any]) -> list[str]:
    """Return the lines of a readable summary of a score."""

    def mean(values: Mapping[str, Any]) -> str:
        found = [("depth", "depth_mae_mm", " mm"), ("lateral", "lateral_mae_mm", " mm"), ("angle", "angle_mean_deg", "°")]
        found += [("95 % below", "angle_p95_deg", "°"), ("to the patch's mean normal", "angle_to_mean_normal_deg", "°")]
        texts = [f"{title} {values[key]:.2f}{unit}" for title, key, unit in found if values.get(key) is not None]
        return ", ".join(texts) or "none"

    left = sum(stretch["to_mm"] - stretch["from_mm"] for stretch in figures["left_out"])
    covered = f"path {figures['path_mm']:.0f} mm, covered {figures['coverage']:.0%}"
    if "reachable" in figures:
        covered += f" of the area and {figures['coverage_of_reachable']:.0%} of what the tip can touch"
    lines = [covered, f"errors: {mean(figures)}"]
    for name, errors in figures.get("errors", {}).items():
        if errors["steps"]:
            lines.append(f"  {name} ({errors['steps'] / figures['steps_followed']:.0%} of the steps): {mean(errors)}")
    if figures["force_max_n"] is not None:
        peak = figures.get("force_peak_n")
        within = "" if peak is None else f", {peak:.1f} N within a step"
        lines.append(f"force: at most {figures['force_max_n']:.1f} N{within}")
    if figures["penetration_within_bound"] is not None:
        lines.append(f"penetration within its bound: {figures['penetration_within_bound']:.1%} of the simulated steps")
    lines.append(f"events: {events_text(figures['events'])}")
    lines += [f"left out: {left:.0f} mm of the route"] if left else []
    lines += [f"  {s['from_mm']:.0f} to {s['to_mm']:.0f} mm: {s['kind']}" for s in figures["left_out"]]
    beyond = sum(s["to_mm"] - s["from_mm"] for s in figures["left_out"] if s["kind"] == "unreachable")
    if beyond:
        where = "where the object stands: move it or turn it (--position-mm, --rotation-deg)"
        lines.append(f"  the arm cannot reach {beyond:.0f} mm of the route {where}")
    return [*lines, f"{figures['steps']} steps, {figures['steps_per_s'] or 0:.1f} per second; {figures['stopped_because']}"]


def contact_places(arrays: Mapping[str, np.ndarray], chosen: np.ndarray) -> np.ndarray:
    """Return the places of contact (n, 3), m, base frame, at the chosen steps: the apex is below them by the depth."""
    poses = arrays["T_base_tcp"][chosen]
    return poses[:, :3, 3] + arrays["true"][chosen][:, 2:3] * poses[:, :3, 2]


def touched_places(arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the places of contact (n, 3), m, base frame, at the steps of the phase `follow` at which the apex is in the
    object: where the tip lies across a hollow, its flanks touch, and not what is below it."""
    return contact_places(arrays, (arrays["phase"] == PHASES.index("follow")) & (arrays["true"][:, 2] < 0))


def coverage(places: np.ndarray, targets: np.ndarray, reach_m: float) -> float:
    """Return the fraction of targets (m, 3) that lie within `reach_m` of places (n, 3)."""
    from scipy.spatial import cKDTree

    if not len(places) or not len(targets):
        return 0.0
    return float((cKDTree(places).query(targets)[0] < reach_m).mean())


def surface_targets(scene_object: SceneObject, corners: np.ndarray, up: ArrayLike) -> np.ndarray:
    """Return points (m, 3), m, base frame, on an object below the bounding rectangle of a route.

    Args:
        scene_object: The object.
        corners: (n, 3), corners of the route, m.
        up: (3,), unit, direction from which the route is projected.
    """
    up = np.asarray(up, float)
    across = np.cross(up, [1.0, 0, 0]) if abs(up[0]) < 0.9 else np.cross(up, [0, 1.0, 0])
    across /= np.linalg.norm(across)
    along = np.cross(across, up)
    flat = np.stack([corners @ along, corners @ across], 1)
    low, high = flat.min(0), flat.max(0)
    grids = [np.arange(a, b + _SPACING_M / 2, _SPACING_M) for a, b in zip(low, high, strict=True)]
    T = np.linalg.inv(scene_object.T_base_object)
    u, v = (grid.reshape(-1, 1) for grid in np.meshgrid(*grids, indexing="ij"))
    places = u * along + v * across + _FAR_M * up
    hits = scene_object.solid.first_hits(places @ T[:3, :3].T + T[:3, 3], -(T[:3, :3] @ up))
    on = np.isfinite(hits)
    return places[on] - hits[on, None] * up


def angles_to_normal_deg(labels: np.ndarray) -> np.ndarray:
    """Return the angles (n,), degrees, between the sensor's axis and the normal, of labels (n, 6), m and rad."""
    from scipy.spatial.transform import Rotation

    if not len(labels):
        return np.zeros(0)
    leaning = Rotation.from_rotvec(labels[:, 3:]).apply([0, 0, 1.0])[:, 2]
    return np.degrees(np.arccos(np.clip(leaning, -1, 1)))


def _passes(
    arrays: Mapping[str, np.ndarray],
    following: np.ndarray,
    true: np.ndarray,
    angles: np.ndarray,
    reference_mm_deg: np.ndarray,
) -> list[dict[str, Any]]:
    """Return the scores of each pass, the even parts of a route."""
    parts, out = arrays["part"][following], []
    for part in sorted(set(parts[parts % 2 == 0].tolist())):
        mine = parts == part
        out.append(
            {
                "pass": part // 2,
                "steps": int(mine.sum()),
                "depth_mae_mm": mean_or_none(np.abs(true[mine, 2] - reference_mm_deg[2])),
                "angle_mean_deg": mean_or_none(angles[mine]),
                "angle_p95_deg": float(np.percentile(angles[mine], 95)),
            }
        )
    return out


def mean_or_none(values: np.ndarray) -> float | None:
    """Return the mean of values (n,); None if there are none."""
    return float(np.mean(values)) if len(values) else None


def _medians_ms(seconds: np.ndarray) -> list[float]:
    return [float(1e3 * x) for x in np.median(seconds, axis=0)] if len(seconds) else [0.0] * 4
