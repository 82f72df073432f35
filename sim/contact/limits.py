"""Limits of the poses and shears that can be simulated."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from tactip_twin.sim.pose import before_shear, from_mm_deg
from tactip_twin.tactip_model.bounds import require

if TYPE_CHECKING:
    from tactip_twin.sim.dataset.sampling import Ranges

MAX_DEPTH_M = 8e-3
"""Maximum depth of a press, m: the deepest in docs/stability.md."""

MAX_TILT_RAD = np.radians(30.0)
"""Maximum angle between tip and normal, rad. Beyond it the contact reaches the rim, where the mesh is coarse and bonded."""

MAX_SHEAR_M = 20e-3
"""Maximum length of a shear, m."""


def check_motion(pose: np.ndarray, shear: np.ndarray, max_depth_m: float = MAX_DEPTH_M) -> None:
    """Check that a contact can be simulated.

    Args:
        pose: (6,), m and rad.
        shear: (6,), m and rad.
        max_depth_m: Maximum depth at the pose and before the shear.

    Raises:
        TactipError: Pose or shear are not finite, too deep, too steep or too long.
    """
    numbers = np.concatenate([pose, shear])
    require(np.isfinite(numbers).all(), "pose and shear", numbers.tolist(), "finite in all components")
    for label, which in ((pose, "pose"), (before_shear(pose, shear), "pose before the shear")):
        _check_reach(-label[2], max_depth_m, float(tilt(label)), which)
    slide = float(np.linalg.norm(shear[:3]))
    require(slide <= MAX_SHEAR_M, "the shear", f"{1e3 * slide:g} mm long", f"at most {1e3 * MAX_SHEAR_M:g} mm")


def tilt(label: ArrayLike) -> np.ndarray:
    """Return the angles (...), rad, between the tip's axis and the normal at poses (..., 6), m and rad."""
    turned = Rotation.from_rotvec(np.asarray(label, float)[..., 3:]).as_matrix()
    return np.arccos(np.clip(turned[..., 2, 2], -1, 1))


def exceeds_max_tilt(pose: ArrayLike, shear: ArrayLike) -> np.ndarray:
    """Return whether poses and shears (..., 6), m and rad, exceed the maximum tilt, at the pose or before the shear."""
    return np.maximum(tilt(pose), tilt(before_shear(pose, shear))) > MAX_TILT_RAD


def check_ranges(pose: "Ranges", shear: "Ranges") -> None:
    """Check that contacts sampled from two ranges can be simulated.

    Samples that are too steep only because tilts about x and y combine are allowed: sim/dataset/generate.py rejects them.

    Args:
        pose: Ranges of labelled poses.
        shear: Ranges of shears.

    Raises:
        TactipError: Some sample would be too deep or too long, or the range of one tilt is too wide.
    """
    poses, shears = (from_mm_deg(ranges.bounds().T).T for ranges in (pose, shear))
    deepest = -poses[2, 0] + max(0.0, shears[2, 1])
    _check_reach(deepest, MAX_DEPTH_M, np.abs(poses[3:5]).max(), "deepest and steepest pose of the ranges")
    slide = float(np.linalg.norm(np.abs(shears[:3]).max(1)))
    require(
        slide <= MAX_SHEAR_M, "the longest shear of the ranges", f"{1e3 * slide:g} mm", f"at most {1e3 * MAX_SHEAR_M:g} mm"
    )


def _check_reach(depth: float, max_depth: float, tilt: float, name: str) -> None:
    """Check a depth (m) and a tilt (rad) of the pose that messages call `name`."""
    require(depth <= max_depth + 1e-12, f"the depth of the {name}", f"{1e3 * depth:g} mm", f"at most {1e3 * max_depth:g} mm")
    degrees, limit = np.degrees([tilt, MAX_TILT_RAD])
    require(tilt <= MAX_TILT_RAD + 1e-9, f"the tilt of the {name}", f"{degrees:g} degrees", f"at most {limit:g} degrees")
