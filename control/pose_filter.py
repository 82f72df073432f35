"""Kalman filter on SE(3) of the sensor's pose on the object, over the steps of a servo run.

The state is the sensor's pose in the contact frame with a normally distributed error ξ, six exponential coordinates in the
contact frame (translation, then rotation vector):

    T_contact_sensor = exp(ξ) · T_mean,  ξ ~ N(0, P)

The sensor's measured motion D in its own frame leads to exp(ξ) · T_mean · D, so the error stays the same in the old contact
frame. The new one lies below the sensor again: moving the frame by G moves the error to Ad(G) ξ, by which an error of tilt
becomes one of depth. How the object is bent along the step is unknown and adds to P. An estimate from an image is fused
with the covariance that the network gives it. This is the filter of Lloyd & Lepora, "Pose-and-shear-based tactile servoing"
(IJRR 43(7), 2024) [R], for poses alone, with a gate: an estimate far from what is predicted does not count.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from tactip_twin.control.options import FilterSettings
from tactip_twin.sim.labels import COMPONENTS, LEARNED, Task
from tactip_twin.sim.pose import from_mm_deg, inverse, label_of, matrix, sensor_in_contact


@dataclass(frozen=True)
class FilteredPose:
    """The state of the filter after a step."""

    label: np.ndarray
    """(6,), m and rad (sim/pose.py)."""
    covariance: np.ndarray
    """(6, 6) of ξ, m and rad; zero where the task does not define a component."""
    accepted: bool
    """Whether the last estimate was fused."""

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations (6,) of ξ, m and rad."""
        return np.sqrt(np.diag(self.covariance))


_BEND_DEG_PER_MM: dict[Task, float] = {"surface": 2.0, "edge": 1.0}
"""Default of FilterSettings.bend_deg_per_mm: a radius of 29 mm on surfaces, 57 mm along edges [?]."""


class PoseFilter:
    """The filter of one run."""

    def __init__(self, task: Task, settings: FilterSettings) -> None:
        """Prepare the filter; it knows nothing before the first estimate."""
        self._rows = [COMPONENTS.index(c) for c in LEARNED[task]]
        self._task, self._settings = task, settings
        self._limit = float(chi2.ppf(settings.gate_probability, len(self._rows)))
        per_mm = _BEND_DEG_PER_MM[task] if settings.bend_deg_per_mm is None else settings.bend_deg_per_mm
        self._bend_rad_per_m = np.radians(per_mm) * 1e3
        self._rest = from_mm_deg([settings.rest_mm] * 3 + [settings.rest_deg] * 3)
        self.reset()

    def reset(self) -> None:
        """Forget the state, because contact was lost and the next estimate belongs to another place."""
        self._started, self._T, self._T_base_tcp = False, np.eye(4), np.eye(4)
        self._P = np.zeros((6, 6))
        self._rejected = 0

    def step(self, T_base_tcp: np.ndarray, label: np.ndarray, deviations: np.ndarray) -> FilteredPose:
        """Take the next estimate, and return the state after it.

        Args:
            T_base_tcp: (4, 4), the sensor's pose as measured by the joints.
            label: (6,), the estimated label, m and rad.
            deviations: (6,), its standard deviations, m and rad; those of components that the task lacks do not count.
        """
        R = self._error_covariance(label, deviations)
        if not self._started:
            return self._start(T_base_tcp, label, R)
        self._move(inverse(self._T_base_tcp) @ T_base_tcp)
        self._T_base_tcp = np.array(T_base_tcp)
        k = self._rows
        innovation = _log(sensor_in_contact(label) @ inverse(self._T))[k]
        S = self._P[np.ix_(k, k)] + R[np.ix_(k, k)]
        weighted = np.linalg.solve(S, innovation)
        if float(innovation @ weighted) > self._limit:
            self._rejected += 1
            if self._rejected > self._settings.max_rejected:
                return self._start(T_base_tcp, label, R)
            return FilteredPose(label_of(self._T), self._P.copy(), accepted=False)
        self._rejected = 0
        gain = self._P[:, k] @ np.linalg.inv(S)
        self._T = _exp(gain @ innovation) @ self._T
        kept = np.eye(6)
        kept[:, k] -= gain
        self._P = _symmetric(kept @ self._P)
        self._place_frame()
        return FilteredPose(label_of(self._T), self._P.copy(), accepted=True)

    def _start(self, T_base_tcp: np.ndarray, label: np.ndarray, R: np.ndarray) -> FilteredPose:
        """Start from an estimate with the covariance R (6, 6)."""
        self._T, self._T_base_tcp, self._P, self._rejected = sensor_in_contact(label), np.array(T_base_tcp), R, 0
        self._started = True
        return FilteredPose(label_of(self._T), R.copy(), accepted=True)

    def _error_covariance(self, label: np.ndarray, deviations: np.ndarray) -> np.ndarray:
        """Return the covariance (6, 6) of ξ for an estimate: a label (6,) with standard deviations (6,)."""
        known = np.zeros(6)
        known[self._rows] = 1.0
        # An error of the rotation vector turns the sensor by the left Jacobian of SO(3) times it, about the apex; ξ turns it
        # about the contact frame's origin.
        turn = _left_jacobian(label[3:])
        M = np.eye(6)
        M[3:, 3:] = turn
        M[:3, 3:] = _cross(label[:3]) @ turn
        factor = self._settings.correlated_estimates
        return self._cleared(M @ np.diag(factor * (known * deviations) ** 2) @ M.T)

    def _move(self, D: np.ndarray) -> None:
        """Predict the state after a motion (4, 4) of the sensor in its own frame."""
        self._T = self._T @ D
        travelled = self._place_frame()
        added = self._rest**2
        # A bend by an unknown angle over the distance travelled, and what it changes beside.
        bend = self._bend_rad_per_m * travelled
        added = added + np.array([*[(0.5 * bend * travelled) ** 2] * 3, *[bend**2] * 3])
        self._P = self._cleared(self._P + np.diag(added))

    def _place_frame(self) -> float:
        """Move the contact frame below the sensor, so the label has the task's components only. Return how far, m."""
        label = label_of(self._T)
        shift = np.zeros(3)
        shift[[i for i in range(2) if i not in self._rows]] = [label[i] for i in range(2) if i not in self._rows]
        turn = Rotation.identity()
        if 5 not in self._rows:
            w, _, _, z = Rotation.from_rotvec(label[3:]).as_quat(scalar_first=True)
            turn = Rotation.from_rotvec([0, 0, -2 * np.arctan2(z, w)])
        G = matrix(turn.apply(-shift), turn)
        self._T = G @ self._T
        A = _adjoint(G)
        self._P = self._cleared(A @ self._P @ A.T)
        return float(np.linalg.norm(shift))

    def _cleared(self, P: np.ndarray) -> np.ndarray:
        """Return a covariance (6, 6) without the components that the task does not define."""
        out, k = np.zeros((6, 6)), np.ix_(self._rows, self._rows)
        out[k] = P[k]
        return _symmetric(out)


def _symmetric(P: np.ndarray) -> np.ndarray:
    return 0.5 * (P + P.T)


def _cross(v: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) of the cross product with a vector (3,)."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def _left_jacobian(rotation_vector: np.ndarray) -> np.ndarray:
    """Return the left Jacobian (3, 3) of SO(3): a change δ of the rotation vector turns by it times δ, to first order."""
    angle, K = float(np.linalg.norm(rotation_vector)), _cross(rotation_vector)
    if angle < 1e-6:
        return np.eye(3) + 0.5 * K
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * K + (angle - np.sin(angle)) / angle**3 * K @ K


def _adjoint(T: np.ndarray) -> np.ndarray:
    """Return the adjoint (6, 6) of a pose (4, 4) for translation and rotation vector."""
    R, out = T[:3, :3], np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[:3, 3:] = _cross(T[:3, 3]) @ R
    return out


def _log(T: np.ndarray) -> np.ndarray:
    """Return the exponential coordinates (6,), translation first, of a pose (4, 4)."""
    return np.roll(RigidTransform.from_matrix(T).as_exp_coords(), 3)


def _exp(coordinates: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of exponential coordinates (6,), translation first."""
    return RigidTransform.from_exp_coords(np.roll(coordinates, 3)).as_matrix()
