"""Limits of the poses and shears that can be simulated."""

import numpy as np

from tactip_twin.sim.pose import before_shear, from_mm_deg, sensor_in_contact
from tactip_twin.tactip_model.bounds import require

MAX_DEPTH_M = 8e-3
"""Deepest press, m: as far as docs/stability.md has been."""

MAX_TILT_RAD = np.radians(30.0)
"""Greatest tilt of the tip to the normal, rad: beyond it the contact reaches the rim, where the mesh is coarse and held."""

MAX_SHEAR_M = 20e-3
"""Longest slide, m."""


def check_motion(pose, shear, deepest=MAX_DEPTH_M):
    """Raise TactipError where a pose and a shear (6,), m and rad, cannot be played, deeper than `deepest` (m) or so."""
    numbers = np.concatenate([pose, shear])
    require(np.isfinite(numbers).all(), "a pose or shear", numbers.tolist(), "finite in all components")
    for label, which in ((pose, "pose"), (before_shear(pose, shear), "pose before the shear")):
        _check_reach(-label[2], deepest, tilt(label), which)
    slide = float(np.linalg.norm(shear[:3]))
    require(slide <= MAX_SHEAR_M, "the shear", f"{1e3 * slide:g} mm long", f"at most {1e3 * MAX_SHEAR_M:g} mm")


def tilt(label):
    """Angle (rad) between the tip's axis and the normal in a pose (6,)."""
    return np.arccos(np.clip(-sensor_in_contact(label)[2, 2], -1, 1))


def exceeds_max_tilt(pose, shear):
    """Whether a pose and a shear (6,), m and rad, tilt the tip further than can be played, at their end or their start."""
    return max(tilt(pose), tilt(before_shear(pose, shear))) > MAX_TILT_RAD


def check_ranges(pose, shear):
    """Raise TactipError where some draw from two sampling.Ranges might be deeper or slide farther than check_motion allows,
    or no tilt about x or y as wide as its range can be played. What is too steep in the corners is drawn again
    (sim/dataset/generate.py)."""
    pose, shear = (from_mm_deg(ranges.bounds().T).T for ranges in (pose, shear))
    deepest = -pose[2, 0] + max(0.0, shear[2, 1])
    _check_reach(deepest, MAX_DEPTH_M, np.abs(pose[3:5]).max(), "deepest and steepest pose of the ranges")
    slide = float(np.linalg.norm(np.abs(shear[:3]).max(1)))
    require(
        slide <= MAX_SHEAR_M, "the longest shear of the ranges", f"{1e3 * slide:g} mm", f"at most {1e3 * MAX_SHEAR_M:g} mm"
    )


def _check_reach(depth, deepest, tilt, which):
    """depth, deepest: m. tilt: rad. which: str, whose they are."""
    require(depth <= deepest + 1e-12, f"the depth of the {which}", f"{1e3 * depth:g} mm", f"at most {1e3 * deepest:g} mm")
    degrees, most = np.degrees([tilt, MAX_TILT_RAD])
    require(tilt <= MAX_TILT_RAD + 1e-9, f"the tilt of the {which}", f"{degrees:g} degrees", f"at most {most:g} degrees")
