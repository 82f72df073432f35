"""Forces and the like of predicted contacts, as a network outputs them."""

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.pose import FACING

MEASURES = (
    "log_normal_force",
    "tangential_ratio_x",
    "tangential_ratio_y",
    "effective_shear_x_mm",
    "effective_shear_y_mm",
    "effective_shear_Rz_deg",
    "slip_fraction",
    "contact_area_mm2",
)
"""Outputs of a network, in the axes of the contact frame: natural logarithm of the normal force in N; tangential force over
normal force; and as in targets.csv."""

MEASURE_PAIRS = [1, 3]
"""Positions in MEASURES of the first component of each pair (x, y)."""

MEASURE_MIRROR = np.array([1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, 1.0])
"""Factors of a mirror in the plane of x and z on MEASURES."""

MIN_FORCE_N = 0.01
"""Normal force below which its logarithm is not learned, N."""


def measures_of(poses: np.ndarray, forces_n: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return MEASURES (k, 8) of contacts.

    Args:
        poses: (k, 6) m and rad.
        forces_n: (k, 3) N, force of the object on the tip in the sensor frame.
        others: (k, 5), the columns of targets.csv that the last five of MEASURES name.
    """
    force = Rotation.from_rotvec(poses[:, 3:]).apply(forces_n @ FACING)
    normal = np.maximum(force[:, 2:], MIN_FORCE_N)
    return np.concatenate([np.log(normal), force[:, :2] / normal, others], 1)


def forces_and_patch(measures: np.ndarray, poses: np.ndarray) -> dict[str, np.ndarray]:
    """Return what MEASURES (k, 8) of contacts at poses (k, 6), m and rad, mean.

    Returns:
        normal_forces_n (k,), tangential_forces_n (k,), forces_n (k, 3) in the sensor frame, effective_shears (k, 6) m and
        rad, slip_fractions (k,), contact_areas_m2 (k,), as in sim/contact/record.py.
    """
    normal = np.exp(measures[:, :1])
    in_contact = normal * np.concatenate([measures[:, 1:3], np.ones((len(poses), 1))], 1)
    shear = np.zeros((len(poses), 6))
    shear[:, :2] = 1e-3 * measures[:, 3:5]
    shear[:, 5] = np.radians(measures[:, 5])
    return {
        "normal_forces_n": normal[:, 0],
        "tangential_forces_n": np.hypot(in_contact[:, 0], in_contact[:, 1]),
        "forces_n": Rotation.from_rotvec(poses[:, 3:]).inv().apply(in_contact) @ FACING,
        "effective_shears": shear,
        "slip_fractions": np.clip(measures[:, 6], 0, 1),
        "contact_areas_m2": 1e-6 * np.maximum(measures[:, 7], 0),
    }
