"""A tip that is pressed by hand: it goes on from where it is to whatever pose is asked for, and remembers its shear."""

import numpy as np

from tactip_twin.sim.contact.limits import MAX_DEPTH_M, check_motion
from tactip_twin.sim.contact.mujoco_warnings import counted_warnings
from tactip_twin.sim.contact.simulator import LEVER_M, ContactSimulator
from tactip_twin.sim.contact.tip_state import read_tip_state
from tactip_twin.sim.pose import path, turn_between

_ABOVE_M = 1e-3
"""Room between the tip and what it is about to be pressed on, m."""


class InteractiveContact:
    """A tip and a stimulus. What is asked for is gone to by the fidelity's pace, some time steps at a time."""

    def __init__(self, design, stimulus, fidelity, label):
        """design: Design. stimulus: a name in stimulus.STIMULI, or a Stimulus. fidelity: Fidelity. label: (6,), m and rad.

        The tip begins clear above `label`. Raises TactipError on what cannot be built, and where `aim` does.
        """
        self._player = ContactSimulator(design, stimulus, fidelity)
        self.scene = self._player.scene
        """The Scene as it is now."""
        self._rested = 0
        self.aim(label)
        self.lift()

    def aim(self, label):
        """Ask for a pose (6,), m and rad. Raises TactipError where it is out of the tip's reach: the last one stays."""
        check_motion(np.asarray(label, float), np.zeros(6), min(MAX_DEPTH_M, self.scene.stimulus.deepest_m))
        self._target, self._rested = np.array(label, float), 0

    def lift(self):
        """Take the tip off, undeformed, and put it clear above where it is to be: it comes down without shear."""
        self.scene.reset()
        rise = max(0.0, self._player.lift(self._target)) + _ABOVE_M
        self._here, self._rested = self._target + np.array([0, 0, rise, 0, 0, 0]), 0
        self._player.hold(self._here)

    @property
    def at_rest(self):
        """Whether the tip is where it is to be, and its skin has come to rest."""
        return self._rested >= self.scene.fidelity.motion.settle_limit

    def advance(self, steps):
        """Go on by at most `steps` (int) time steps. Returns the touch.TipState of this moment.

        Raises contact.Diverged, after which `lift` is the way on.
        """
        motion = self.scene.fidelity.motion
        way = self._target - self._here
        travel = np.linalg.norm(way[:3]) + LEVER_M * turn_between(self._here, self._target)
        pace = self._player.shear_step_m if self.scene.data.ncon else self._player.press_step_m
        whole = int(np.ceil(travel / pace))
        with counted_warnings():
            if whole:
                gone = min(steps, whole)
                labels = path(self._here, self._target, np.arange(gone + 1) / whole)
                self._player.move(labels)
                self._here, steps = (self._target if gone == whole else labels[-1]), steps - gone
            for _ in range(steps if not self.at_rest else 0):
                self._player.hold(self._here)
                still = self.scene.max_vertex_speed() < motion.settle_speed_m_s and self._rested >= motion.settle_steps
                self._rested = motion.settle_limit if still else self._rested + 1
                if self.at_rest:
                    break
        return self.touch()

    @property
    def label(self):
        """Where the tip is (6,), m and rad (sim/pose.py)."""
        return self._here.copy()

    def touch(self):
        """The touch.TipState of this moment."""
        return read_tip_state(self.scene, self._player.reader)
