"""The servo law: proportional and integral control in SE(3), in the sensor's frame [P].

    e(t) = the reference pose relative to the estimated sensor pose: a translation and a rotation vector
    s(t) = Kp e(t) + Ki Σ e(t')

An error is a product of poses and not a difference of numbers. [P] is Lepora & Lloyd, "Optimal Deep Learning for Robot
Touch" (2020); [L] the authors' later tactile_servo_control.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from tactip_twin.control.options import GainsName
from tactip_twin.sim.labels import Task
from tactip_twin.sim.pose import from_mm_deg, inverse, matrix, rotation_of, sensor_in_contact
from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import lookup


@dataclass(frozen=True)
class Gains:
    """Gains of the servo for each component in the sensor's frame: x, y, z, and rotations about these axes."""

    kp: tuple[float, float, float, float, float, float] = within(0, 2, default=(0.5, 0.5, 0.5, 0.5, 0.5, 0.5))
    """Proportional, - [P]."""
    ki: tuple[float, float, float, float, float, float] = within(0, 2, default=(0.3, 0.3, 0.3, 0.1, 0.1, 0.1))
    """Integral, per step [P]."""
    integral_limit_mm: float = within(0, 100, default=5.0)
    """Limit of the summed error, translations, mm [L]."""
    integral_limit_deg: float = within(0, 180, default=45.0)
    """Limit of the summed error, rotations, degrees [L]."""

    def __post_init__(self) -> None:
        check(self)


GAINS: dict[GainsName, dict[Task, Gains]] = {
    "paper": {"surface": Gains(), "edge": Gains()},
    "tactile-servo-control": {
        "surface": Gains(kp=(1, 1, 0.5, 0.5, 0.5, 1), ki=(0, 0, 0.3, 0.1, 0.1, 0)),
        "edge": Gains(kp=(0.5, 1, 0.5, 0.5, 0.5, 0.5), ki=(0.3, 0, 0.3, 0.1, 0.1, 0.1)),
    },
}
"""Gains by name and task: those of the paper [P], and those of the authors' later work [L]."""

DEPTHS_MM: dict[Task, float] = {"surface": 2.0, "edge": 3.0}
"""Default depth by task, mm. The networks predict the mean normal of the contact patch, which on a curved surface differs
from the normal at its middle; a shallower press has a smaller patch (docs/servo.md). Along an edge it is the middle of the
trained depths."""

_ROUNDING = 1e-6
"""Fraction by which a motion may be shorter because of rounding, -."""

FREE_AXES: dict[Task, tuple[int, ...]] = {"surface": (0, 1), "edge": (1,)}
"""Axes of the contact frame along which the task defines no position."""


@runtime_checkable
class Controller(Protocol):
    """Anything that turns estimated labels into motions. Subclasses without state need only `move`."""

    def move(self, label: np.ndarray, along: ArrayLike = (0.0, 0.0, 0.0), max_press_m: float = np.inf) -> np.ndarray:
        """Return the next motion (4, 4) of the sensor, in its own frame.

        Args:
            label: (6,), the estimated label, m and rad.
            along: (3,), the tangential step to add, m, in the sensor's frame.
            max_press_m: Largest motion along the sensor's axis that the force on the tip allows (press.py), m; the follower
                shortens a longer one.
        """
        ...

    def reset(self) -> None:
        """Forget the errors so far, because contact was lost and the next label belongs to another place."""

    def limited_to(self, motion: np.ndarray) -> None:
        """Take the motion (4, 4), in the sensor's frame, to which the last one that `move` returned was limited, because it
        was too long or would have turned the housing into an obstacle."""


def reference_mm_deg(depth_mm: float) -> np.ndarray:
    """Return the label (6,), mm and degrees, that the servo keeps at a depth: along the normal and on the edge."""
    return np.array([0.0, 0.0, -depth_mm, 0.0, 0.0, 0.0])


def pose_error(label: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the pose of a reference label relative to a sensor at `label`: a translation (m) and a rotation vector (rad).

    Args:
        label: (6,), m and rad.
        reference: (6,), m and rad.
    """
    return _twist(inverse(sensor_in_contact(label)) @ sensor_in_contact(reference))


def gains_named(name: GainsName, task: Task) -> Gains:
    """Return the gains of a name and a task. Raises TactipError that lists the names."""
    return lookup("task", task, lookup("gains", name, GAINS))


class Servo:
    """The paper's controller: proportional and integral, with a limited integral."""

    def __init__(self, gains: Gains, depth_mm: float, free_axes: tuple[int, ...] = ()) -> None:
        """Set the gains, the depth to keep, mm, and the axes of the contact frame along which no position is kept."""
        self._free = list(free_axes)
        self._kp, self._ki = np.array(gains.kp), np.array(gains.ki)
        self._limit = from_mm_deg([gains.integral_limit_mm] * 3 + [gains.integral_limit_deg] * 3)
        self._reference = from_mm_deg(reference_mm_deg(depth_mm))
        self.reset()

    def reset(self) -> None:
        """Set the integral to zero."""
        self._sum, self._grown, self._wanted = np.zeros(6), np.zeros(6), np.zeros(6)

    def limited_to(self, motion: np.ndarray) -> None:
        """Undo the last growth of the integral in each component whose motion was shortened (anti-windup); see Controller.
        Otherwise it would grow for as long as the sensor cannot turn, and turn it too far afterwards."""
        cut = (self._grown * self._wanted > 0) & (np.abs(_twist(motion)) < (1 - _ROUNDING) * np.abs(self._wanted))
        self._sum = np.where(cut, self._sum - self._grown, self._sum)

    def error(self, label: np.ndarray) -> np.ndarray:
        """Return the error (6,), m and rad, of a label (6,): the reference relative to the sensor, in the sensor's frame."""
        return pose_error(label, self._reference)

    def move(self, label: np.ndarray, along: ArrayLike = (0.0, 0.0, 0.0), max_press_m: float = np.inf) -> np.ndarray:
        """Return the motion (4, 4) for a label; see Controller. The sum is held where the force limits the motion, so the
        tip does not plunge when the force falls."""
        error, before = self.error(label), self._sum
        error[2] = min(error[2], max_press_m)
        self._sum = np.clip(self._sum + error, -self._limit, self._limit)
        # Where the task defines no position, nothing would ever reduce the sum. It gets there as the sensor turns: summed in
        # the sensor's frame, errors across an edge end up along it, and can hold the tip for good [M].
        free = sensor_in_contact(label)[self._free, :3]
        self._sum[:3] -= free.T @ (free @ self._sum[:3])
        motion = self._kp * error + self._ki * self._sum
        if motion[2] > max_press_m:
            excess, limit = motion[2] - max_press_m, self._limit[2]
            motion[2] = max_press_m
            if self._ki[2] > 0:
                self._sum[2] = np.clip(self._sum[2] - excess / self._ki[2], -limit, limit)
        self._grown, self._wanted = self._sum - before, np.concatenate([motion[:3] + np.asarray(along), motion[3:]])
        return matrix(self._wanted[:3], Rotation.from_rotvec(self._wanted[3:]))


def _twist(motion: np.ndarray) -> np.ndarray:
    """Return translation (m) and rotation vector (rad) of a motion (4, 4)."""
    return np.concatenate([motion[:3, 3], rotation_of(motion).as_rotvec()])
