"""One contact: approach, shear, settle, record. And the judgement whether the record can be trusted."""

import contextlib
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import betainc

from sim.fidelity import finer
from sim.pose import before_shear, inverse, path, sensor_in_contact, turn_between
from sim.scene import Scene
from sim.stimulus import height_to_clear
from tactip_model.mesh import tetrahedron_volumes
from tactip_model.pins import PinReader

_CLEARANCE_M = 0.05e-3
"""Gap from which an approach starts, m."""

_LEVER_M = 10e-3
"""Distance from the apex at which a turn counts as travel of the skin, m: half the dome's radius."""


@dataclass(frozen=True)
class Bounds:
    """What a trustworthy record must keep."""

    penetration_m: float = 0.05e-3
    """Greatest penetration, m."""
    volume_ratio: float = 0.1
    """Smallest ratio of an element's volume to its undeformed one, -. Below 0 it is inside out."""
    speed_m_s: float = 20e-3
    """Greatest residual speed of a vertex, m/s."""


@dataclass(frozen=True)
class Contact:
    """The record of one contact, at rest, in the sensor frame. (p pins)"""

    pose: np.ndarray
    """(6,) label, m and rad (sim/pose.py)."""
    shear: np.ndarray
    """(6,) motion in contact that led to the pose, m and rad."""
    tips: np.ndarray
    """(p, 3) float, m."""
    directions: np.ndarray
    """(p, 3) float, unit, root to tip."""
    normal_force_n: float
    """Force of the object on the tip along the outward normal, N."""
    tangential_force_n: float
    """Size of the rest of that force, N."""
    penetration_m: float
    """Greatest penetration, m."""
    volume_ratio: float
    """Smallest ratio of an element's volume to its undeformed one, -."""
    speed_m_s: float
    """Speed of the fastest vertex, m/s."""
    warnings: int
    """MuJoCo's warnings on the way."""
    steps: int
    """Time steps taken."""

    def faults(self, bounds):
        """What is wrong with the record: a list of sentences, empty if it can be trusted. bounds: Bounds."""
        numbers = np.concatenate([self.tips.ravel(), self.directions.ravel(), [self.normal_force_n, self.speed_m_s]])
        if not np.isfinite(numbers).all() or not np.isfinite(self.volume_ratio):
            return ["the state is not finite"]
        faults = []
        if self.volume_ratio < bounds.volume_ratio:
            faults.append(f"an element shrank to {self.volume_ratio:.3f} of its volume (allowed: {bounds.volume_ratio})")
        if self.penetration_m > bounds.penetration_m:
            faults.append(
                f"the object is {1e3 * self.penetration_m:.4f} mm inside the skin (allowed: {1e3 * bounds.penetration_m} mm)"
            )
        if self.speed_m_s > bounds.speed_m_s:
            faults.append(
                f"the skin still moves at {1e3 * self.speed_m_s:.1f} mm/s (allowed: {1e3 * bounds.speed_m_s} mm/s)"
            )
        return faults


class _Diverged(Exception):
    """The state of a contact is no longer finite."""


@contextlib.contextmanager
def _counted_warnings():
    """MuJoCo's warnings counted in a list instead of shown: they are part of the record."""
    messages = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(messages.append)
    try:
        yield messages
    finally:
        mujoco.set_mju_user_warning(before)


class ContactPlayer:
    """Plays contacts in one scene. Each is independent of those before it."""

    def __init__(self, design, task, fidelity):
        """design: Design. task: `surface` or `edge`. fidelity: Fidelity. Raises TactipError on what cannot be built."""
        self.scene = Scene(design, task, fidelity)
        """The scene, at the end of the last contact."""
        self.reader = PinReader(design, self.scene.mesh)
        """The design's pins on this scene's skin."""
        self._steps = 0

    def play(self, pose, shear):
        """Press at `pose` minus `shear`, move to `pose`, settle. pose, shear: (6,), m and rad. Returns a Contact."""
        pose, shear = np.asarray(pose, float), np.asarray(shear, float)
        self.scene.reset()
        self._steps = 0
        # A state that is lost stays lost: the record shows it, and steps from it would only take long.
        with _counted_warnings() as messages, contextlib.suppress(_Diverged):
            for labels in self._motions(pose, shear):
                self._move(labels)
            self._settle(pose)
        return self._record(pose, shear, len(messages))

    def _motions(self, pose, shear):
        """The labels (n, 6) of each motion, first to last."""
        motion, radius = self.scene.fidelity.motion, self.scene.design.shape.radius_m
        start = before_shear(pose, shear)
        dome_centre = sensor_in_contact(start) @ [0, 0, -radius, 1]
        lift = height_to_clear(self.scene.task, dome_centre[:3], radius) + _CLEARANCE_M
        if lift > 0:
            above = start + np.array([0, 0, lift, 0, 0, 0])
            yield path(above, start, _shares(lift / motion.press_step_m, motion))
        travel = np.linalg.norm(shear[:3]) + _LEVER_M * turn_between(start, pose)
        if travel > 0:
            yield path(start, pose, _shares(travel / motion.shear_step_m, motion))

    def _move(self, labels):
        """Carry the stimulus along labels (n, 6), one a step."""
        h = self.scene.fidelity.motion.step_s
        self.scene.stiffen(resting=False)
        poses = [inverse(sensor_in_contact(label)) for label in labels]
        for T, T_next in pairwise(poses):
            turn = Rotation.from_matrix(T[:3, :3].T @ T_next[:3, :3]).as_rotvec()
            self._place(T, (T_next[:3, 3] - T[:3, 3]) / h, turn / h)
            self._step()

    def _settle(self, pose):
        """Hold the stimulus at `pose` (6,) until the tip is at rest."""
        motion = self.scene.fidelity.motion
        T = inverse(sensor_in_contact(pose))
        self.scene.stiffen(resting=True)
        for step in range(1, motion.settle_limit + 1):
            self._place(T)
            self._step()
            if step >= motion.settle_steps and self.scene.greatest_speed() < motion.settle_speed_m_s:
                break

    def _step(self):
        """One time step. Raises _Diverged where the state is no longer finite."""
        mujoco.mj_step(self.scene.model, self.scene.data)
        self._steps += 1
        if not np.isfinite(self.scene.greatest_speed()):
            raise _Diverged

    def _place(self, T, linear=(0, 0, 0), angular=(0, 0, 0)):
        quaternion = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
        self.scene.place(T[:3, 3], quaternion, linear, angular)

    def _record(self, pose, shear, warnings):
        scene = self.scene
        vertices = scene.vertices()
        tips, directions = self.reader.read(vertices[: scene.mesh.surface_count])
        force = sensor_in_contact(pose)[:3, :3] @ scene.contact_force()
        ratio = tetrahedron_volumes(vertices, scene.mesh.tetrahedra) / scene.mesh.volumes
        return Contact(
            pose=pose,
            shear=shear,
            tips=tips,
            directions=directions,
            normal_force_n=float(force[2]),
            tangential_force_n=float(np.hypot(force[0], force[1])),
            penetration_m=scene.penetration(),
            volume_ratio=float(ratio.min()),
            speed_m_s=scene.greatest_speed(),
            warnings=warnings,
            steps=self._steps,
        )


class CarefulPlayer:
    """Plays contacts, and plays one that went wrong again with finer steps, once."""

    def __init__(self, design, task, fidelity, bounds):
        """design: Design. task: `surface` or `edge`. fidelity: Fidelity. bounds: Bounds."""
        self._first = ContactPlayer(design, task, fidelity)
        self._again = None
        self._design, self._task, self._fidelity, self._bounds = design, task, fidelity, bounds

    def play(self, pose, shear):
        """As ContactPlayer.play. Returns the last Contact tried and the faults (a list of str) of each try but a good one.

        One fault list means that the contact was played again and is good; two, that it failed.
        """
        contact = self._first.play(pose, shear)
        tries = [contact.faults(self._bounds)]
        if tries[0]:
            if self._again is None:
                self._again = ContactPlayer(self._design, self._task, finer(self._fidelity))
            contact = self._again.play(pose, shear)
            tries.append(contact.faults(self._bounds))
        return contact, [faults for faults in tries if faults]


def _shares(steps, motion):
    """Shares (n + 1,) of a motion's way at its steps: its pace (Motion.ease_in, ease_out) summed up."""
    n = max(motion.least_steps, int(np.ceil(steps)))
    return betainc(motion.ease_in + 1, motion.ease_out + 1, np.arange(n + 1) / n)
