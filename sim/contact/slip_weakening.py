"""Static and kinetic friction of each part of the skin: skin that has slid has less friction than skin that sticks.

The friction of a part of the skin falls linearly with its sliding distance, from the static to the kinetic one over
Materials.slip_weakening_m (a slip-weakening law, as used for earthquake faults), and stays there until the part leaves the
object. It depends on distances, not on speeds, so the speed of a simulated contact does not matter.
"""

import mujoco
import numpy as np

from tactip_twin.tactip_model.design import Materials

_SLIDING = int(mujoco.mjtConstraintState.mjCNSTRSTATE_CONE)


class SlipWeakening:
    """Sliding distance of each vertex and facet of the skin in its present contact."""

    def __init__(self, model: mujoco.MjModel, stimulus_body: int, materials: Materials) -> None:
        """Args:
        model: Compiled model of the scene.
        stimulus_body: Number of the stimulus's body.
        materials: Friction of the tip.
        """
        self._materials = materials
        self._is_stimulus = model.geom_bodyid == stimulus_body
        self._first_facet = model.ngeom
        self._distance = np.zeros(model.ngeom + int(model.flex_elemnum.max()))
        self._sliding = np.zeros(len(self._distance), bool)
        self._parts = np.zeros(0, int)

    def reset(self) -> None:
        """Set all sliding distances to zero."""
        self._distance[:], self._sliding[:] = 0.0, False

    def weaken(self, data: mujoco.MjData, travel: np.ndarray) -> None:
        """Lower the friction of the contacts of a step before it is solved.

        Args:
            data: State with its contacts made.
            travel: (contacts,) m, travel of each contact in a step if it slides.
        """
        contacts = data.contact
        geom = np.where(self._is_stimulus[contacts.geom[:, 0]], contacts.geom[:, 1], contacts.geom[:, 0])
        self._parts = np.where(geom >= 0, geom, self._first_facet + contacts.elem.max(1))
        distance = np.zeros_like(self._distance)
        slid = np.where(self._sliding[self._parts], travel, 0.0)
        np.maximum.at(distance, self._parts, self._distance[self._parts] + slid)
        self._distance = distance
        fraction = np.minimum(distance[self._parts] / self._materials.slip_weakening_m, 1.0)
        remaining = 1 - (1 - self._materials.kinetic_fraction) * fraction
        friction, cone = contacts.friction, contacts.mu  # views of MuJoCo's own arrays
        friction[:, :2] *= remaining[:, None]
        cone *= remaining

    def store_sliding(self, data: mujoco.MjData) -> None:
        """Store which parts slide in a step that was solved."""
        self._sliding[:] = False
        np.logical_or.at(self._sliding, self._parts, sliding(data))


def sliding(data: mujoco.MjData) -> np.ndarray:
    """Return which contacts (contacts,) bool slide in a step that was solved; those without friction do not count."""
    row = data.contact.efc_address
    return (row >= 0) & (data.efc_state[row] == _SLIDING)
