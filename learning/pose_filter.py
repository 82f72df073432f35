"""Kalman filter on SE(3) of the sensor's pose on the object, over the steps of a servo run or the frames of a camera.

The state is the sensor's pose in the contact frame with a normally distributed error ξ, six exponential coordinates in the
contact frame (translation, then rotation vector):

    T_contact_sensor = exp(ξ) · T_mean,  ξ ~ N(0, P)

The sensor's measured motion D in its own frame leads to exp(ξ) · T_mean · D, so the error stays the same in the old contact
frame. The new one lies below the sensor again: moving the frame by G moves the error to Ad(G) ξ, by which an error of tilt
becomes one of depth. G also turns the frame, because the object is bent. Its bends are part of the state, three numbers
that change over a distance: the curvatures of a surface along x and y and its twist, or the turns of an edge's frame along
it. Without them, a filter lags behind every bend. An estimate from an image is fused with the covariance that the network
gives it.

A camera's noise makes a network err more than it knows. So the variance of its estimates is multiplied by the running ratio
of the squared innovations to what was expected of them, if that is above 1. But noise changes its sign. Innovations that
keep theirs show that the prediction is wrong, as where the tip touches a steep flank with its side; the filter then restarts
from the estimate.

This extends the filter of Lloyd & Lepora, "Pose-and-shear-based tactile servoing" (IJRR 43(7), 2024) [R], by the bends,
this ratio, a gate (an estimate far from what is predicted does not count), and the test of the innovations' mean.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import gammaincinv

from tactip_twin.learning.filter_settings import FilterSettings
from tactip_twin.sim.labels import COMPONENTS, LEARNED, Task
from tactip_twin.sim.pose import FACING, from_mm_deg, inverse, label_of, matrix, rotation_of, sensor_in_contact


@dataclass(frozen=True)
class FilteredPose:
    """The state of the filter after a step."""

    label: np.ndarray
    """(6,), m and rad (sim/pose.py)."""
    covariance: np.ndarray
    """(6, 6) of ξ, m and rad; zero where the task does not define a component."""
    bends: np.ndarray
    """(3,) rad/m. Surface: curvature along x, twist, curvature along y, convex positive. Edge: turns about x, y and z of the
    contact frame per distance along y."""
    accepted: bool
    """Whether the last estimate was fused."""

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations (6,) of ξ, m and rad."""
        return np.sqrt(np.diag(self.covariance))


_BENDS: dict[Task, tuple[float, float]] = {"surface": (4.0, 5.0), "edge": (1.0, 40.0)}
"""Defaults of FilterSettings.bend_deg_per_mm and bend_length_mm: radii of 14 mm on surfaces, 57 mm along edges [?]."""

_LEARNED = 0.1
"""Weight of a step in the running ratio of seen to expected innovations: it remembers ten steps [?]."""

_MAX_EXCESS = 30.0
"""Maximum factor on the variance of estimates [?]."""

_RECENT = 0.25
"""Weight of a step in the running mean of the innovations: it remembers four steps [?]."""

_BEND = slice(6, 9)
"""Rows of the bends in the state."""


class PoseFilter:
    """The filter of one run."""

    def __init__(self, task: Task, settings: FilterSettings) -> None:
        """Prepare the filter; it knows nothing before the first estimate."""
        self._rows = [COMPONENTS.index(c) for c in LEARNED[task]]
        self._learned, self._defined = np.ix_(self._rows, self._rows), np.ix_([*self._rows, 6, 7, 8], [*self._rows, 6, 7, 8])
        self._task, self._settings = task, settings
        # The quantile of chi squared; scipy.stats takes a third of a second to load.
        self._limit = float(2 * gammaincinv(len(self._rows) / 2, settings.gate_probability))
        per_mm, length_mm = _BENDS[task]
        per_mm = per_mm if settings.bend_deg_per_mm is None else settings.bend_deg_per_mm
        self._bend_rad_per_m = float(np.radians(per_mm)) * 1e3
        self._bend_length_m = (length_mm if settings.bend_length_mm is None else settings.bend_length_mm) / 1e3
        self._rest = from_mm_deg([settings.rest_mm] * 3 + [settings.rest_deg] * 3)
        self.reset()

    def reset(self) -> None:
        """Forget the state, because contact was lost and the next estimate belongs to another place."""
        self._started, self._T, self._T_base_tcp = False, np.eye(4), np.eye(4)
        self._bends, self._P, self._rejected, self._excess = np.zeros(3), np.zeros((9, 9)), 0, 1.0
        self._bias, self._bias_variance = np.zeros(len(self._rows)), 0.0

    def step(self, T_base_tcp: np.ndarray, label: np.ndarray, deviations: np.ndarray) -> FilteredPose:
        """Take the next estimate, and return the state after it.

        Args:
            T_base_tcp: (4, 4), the sensor's pose as measured by the joints.
            label: (6,), the estimated label, m and rad.
            deviations: (6,), its standard deviations, m and rad; those of components that the task lacks do not count.
        """
        R = self._excess * self._error_covariance(label, deviations)
        if not self._started:
            return self._start(T_base_tcp, label, R)
        self._move(inverse(self._T_base_tcp) @ T_base_tcp)
        self._T_base_tcp = np.array(T_base_tcp)
        k = self._rows
        innovation = _log(sensor_in_contact(label) @ inverse(self._T))[k]
        S = self._P[self._learned] + R[self._learned]
        squared = float(innovation @ np.linalg.solve(S, innovation))
        # The ratio of what is seen to what is expected, for the estimates' variance that is assumed at present.
        seen = self._excess * min(squared, self._limit) / len(k)
        self._excess = float(np.clip(self._excess + _LEARNED * (seen - self._excess), 1.0, _MAX_EXCESS))
        if self._is_biased(innovation, S):
            self._excess = 1.0
            return self._start(T_base_tcp, label, self._error_covariance(label, deviations))
        if squared > self._limit:
            self._rejected += 1
            if self._rejected > self._settings.max_rejected:
                return self._start(T_base_tcp, label, R)
            return self._state(accepted=False)
        self._rejected = 0
        gain = self._P[:, k] @ np.linalg.inv(S)
        correction = gain @ innovation
        self._T = _exp(correction[:6]) @ self._T
        self._bends = self._bends + correction[_BEND]
        kept = np.eye(9)
        kept[:, k] -= gain
        self._P = kept @ self._P
        self._place_frame(self._shift())
        return self._state(accepted=True)

    def _is_biased(self, innovation: np.ndarray, S: np.ndarray) -> bool:
        """Return whether the running mean of the innovations (k,), in units of their covariance (k, k), is larger than that
        of noise."""
        scaled = np.linalg.solve(np.linalg.cholesky(S), innovation)
        # Two outliers in a row are no bias yet.
        scaled *= min(1.0, np.sqrt(self._limit / 2) / max(float(np.linalg.norm(scaled)), 1e-12))
        self._bias += _RECENT * (scaled - self._bias)
        self._bias_variance = _RECENT**2 + (1 - _RECENT) ** 2 * self._bias_variance
        return float(self._bias @ self._bias) > self._limit * self._bias_variance

    def _state(self, accepted: bool) -> FilteredPose:
        return FilteredPose(label_of(self._T), self._P[:6, :6].copy(), self._bends.copy(), accepted)

    def _start(self, T_base_tcp: np.ndarray, label: np.ndarray, R: np.ndarray) -> FilteredPose:
        """Start from an estimate with the covariance R (6, 6)."""
        self._T, self._T_base_tcp, self._rejected, self._started = sensor_in_contact(label), np.array(T_base_tcp), 0, True
        self._bends, self._P = np.zeros(3), np.zeros((9, 9))
        self._bias, self._bias_variance = np.zeros(len(self._rows)), 0.0
        self._P[:6, :6] = R
        self._P[_BEND, _BEND] = self._bend_rad_per_m**2 * np.eye(3)
        return self._state(accepted=True)

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
        R, out = M @ np.diag(factor * (known * deviations) ** 2) @ M.T, np.zeros((6, 6))
        out[self._learned] = R[self._learned]
        return out

    def _move(self, D: np.ndarray) -> None:
        """Predict the state after a motion (4, 4) of the sensor in its own frame."""
        moved = self._T[:3, :3] @ D[:3, 3]
        self._T = self._T @ D
        shift = self._shift()
        travelled = float(np.linalg.norm(shift))
        kept = np.exp(-travelled / self._bend_length_m)
        B = self._turn_by_bends(shift)
        F = np.eye(9)
        F[3:6, _BEND] = -B
        F[_BEND, _BEND] = kept * np.eye(3)
        G = matrix(np.zeros(3), Rotation.from_rotvec(-B @ self._bends)) @ matrix(-shift, Rotation.identity())
        F[:6, :6] = _adjoint(G)
        self._T, self._bends = G @ self._T, kept * self._bends
        defined = np.array([0 in self._rows, 1 in self._rows, True])
        uncertain = np.append(self._settings.motion_fraction * moved * defined, np.zeros(3))
        added = np.concatenate([self._rest**2 + uncertain**2, np.full(3, self._bend_rad_per_m**2 * (1 - kept**2))])
        self._P = F @ self._P @ F.T + np.diag(added)
        self._place_frame(self._shift())

    def _shift(self) -> np.ndarray:
        """Return the position (3,), m, of the sensor in the contact frame along what the task does not define."""
        free = np.array([0 not in self._rows, 1 not in self._rows, False])
        return np.where(free, self._T[:3, 3], 0.0)

    def _turn_by_bends(self, shift: np.ndarray) -> np.ndarray:
        """Return the matrix (3, 3) from the bends to the turn of the contact frame over a shift (3,), m."""
        x, y, _ = shift
        if self._task == "edge":
            return y * np.eye(3)
        # The normal of a convex surface leans towards the shift.
        return np.array([[0, -x, -y], [x, y, 0], [0, 0, 0]])

    def _place_frame(self, shift: np.ndarray) -> None:
        """Move the contact frame by a shift (3,), m, and turn it, so the label has the task's components only."""
        turn, spin = Rotation.identity(), np.eye(3)
        if 5 not in self._rows:
            w, _, _, z = rotation_of(self._T[:3, :3] @ FACING).as_quat(scalar_first=True)
            angle = -2 * np.arctan2(z, w)
            turn, spin = Rotation.from_rotvec([0, 0, angle]), _spun_curvatures(angle)
        G = matrix(turn.apply(-shift), turn)
        F = np.zeros((9, 9))
        F[:6, :6], F[_BEND, _BEND] = _adjoint(G), spin
        self._T, self._bends = G @ self._T, spin @ self._bends
        P = F @ self._P @ F.T
        self._P = np.zeros((9, 9))
        self._P[self._defined] = 0.5 * (P + P.T)[self._defined]


def _spun_curvatures(angle: float) -> np.ndarray:
    """Return the matrix (3, 3) by which curvatures along x and y and their twist change when vectors turn about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c * c, -2 * c * s, s * s], [c * s, c * c - s * s, -c * s], [s * s, 2 * c * s, c * c]])


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
