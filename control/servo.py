"""The servo law: proportional and integral, in SE(3) and in the sensor's frame [P].

    e(t) = the reference pose as seen from the sensor where it is felt to be, a translation and a rotation vector
    s(t) = Kp e(t) + Ki Σ e(t')

An error is a product of poses and not a difference of numbers. [P] is Lepora & Lloyd, "Optimal Deep Learning for Robot
TipState" (2020); [L] the authors' later tactile_servo_control.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.pose import from_mm_deg, inverse, matrix, sensor_in_contact
from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import lookup


@dataclass(frozen=True)
class Gains:
    """Gains of the servo, by component of the sensor's frame: x, y, z, and turns about them."""

    kp: tuple[float, float, float, float, float, float] = within(0, 2, default=(0.5, 0.5, 0.5, 0.5, 0.5, 0.5))
    """Proportional, - [P]."""
    ki: tuple[float, float, float, float, float, float] = within(0, 2, default=(0.3, 0.3, 0.3, 0.1, 0.1, 0.1))
    """Integral, a step [P]."""
    most_mm: float = within(0, 100, default=5.0)
    """The summed error is kept within so much, mm [L] ..."""
    most_deg: float = within(0, 180, default=45.0)
    """... and so many degrees [L]."""

    def __post_init__(self):
        check(self)


GAINS = {
    "paper": {"surface": Gains(), "edge": Gains()},
    "later": {
        "surface": Gains(kp=(1, 1, 0.5, 0.5, 0.5, 1), ki=(0, 0, 0.3, 0.1, 0.1, 0)),
        "edge": Gains(kp=(0.5, 1, 0.5, 0.5, 0.5, 0.5), ki=(0.3, 0, 0.3, 0.1, 0.1, 0.1)),
    },
}
"""By name and task: the paper's, and those of the authors' later work [L]."""

DEPTHS_MM = {"surface": 2.0, "edge": 3.0}
"""Depth that is kept by task, mm. What is felt is the mean normal of the patch that is touched: pressed 3 mm deep it is that
of 4 mm about, which over the nose of the bust is 1.8 degrees off the normal where it is nearest; a shallower patch is a
smaller one [M] (docs/servo.md). Along an edge it is the middle of the depths that were learned."""


def reference_mm_deg(depth_mm):
    """The label (6,), mm and degrees, that the servo keeps at a depth (float): on the normal, and on the edge."""
    return np.array([0.0, 0.0, -depth_mm, 0.0, 0.0, 0.0])


def gains_named(name, task):
    """The Gains of a name and a task. Raises TactipError that lists the names."""
    return lookup("task", task, lookup("gains", name, GAINS))


class Servo:
    """The law and its memory."""

    def __init__(self, gains, depth_mm):
        """gains: Gains. depth_mm: float, the depth to keep."""
        self._kp, self._ki = np.array(gains.kp), np.array(gains.ki)
        self._most = from_mm_deg([gains.most_mm] * 3 + [gains.most_deg] * 3)
        self._reference = sensor_in_contact(from_mm_deg(reference_mm_deg(depth_mm)))
        self.forget()

    def forget(self):
        """Let the summed error go: after contact was lost, it is of another place."""
        self._sum = np.zeros(6)

    def error(self, label):
        """The reference (6,), m and rad, as seen from a sensor at `label` (6,): what is left to do, in the sensor's
        frame."""
        T = inverse(sensor_in_contact(label)) @ self._reference
        return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()])

    def move(self, label, along=(0.0, 0.0, 0.0)):
        """The motion (4, 4) of the sensor in its own frame that a felt `label` (6,), m and rad, asks for.

        along: (3,) m in the sensor's frame, the tangential step that comes on top.
        """
        error = self.error(label)
        self._sum = np.clip(self._sum + error, -self._most, self._most)
        motion = self._kp * error + self._ki * self._sum
        return matrix(motion[:3] + along, Rotation.from_rotvec(motion[3:]))
