"""Skin that has slid holds less than skin that sticks: static and kinetic friction, part by part.

Friction falls in a straight line with the way that a part of the skin has slid, from the static one to the kinetic one over
Materials.kinetic_after_m (a slip-weakening law, as of faults), and stays there until the part leaves the object. It depends
on ways, not on speeds: how fast a contact is played does not matter.
"""

import mujoco
import numpy as np

_SLIDES = int(mujoco.mjtConstraintState.mjCNSTRSTATE_CONE)


class SlipWeakening:
    """How far each vertex and facet of the skin has slid in the contact that it is in."""

    def __init__(self, model, stimulus_body, materials):
        """model: mujoco.MjModel. stimulus_body: int, its body. materials: design.Materials."""
        self._materials = materials
        self._is_stimulus = model.geom_bodyid == stimulus_body
        self._facets_from = model.ngeom
        self._slid = np.zeros(model.ngeom + int(model.flex_elemnum.max()))
        self._slides = np.zeros(len(self._slid), bool)
        self._parts = np.zeros(0, int)

    def reset(self):
        """Forget all slides."""
        self._slid[:], self._slides[:] = 0.0, False

    def weaken(self, data, way):
        """Lower the friction of the contacts of a step, before they are solved.

        data: mujoco.MjData, with contacts made. way: (contacts,) m, that each goes in a step if it slides.
        """
        contacts = data.contact
        geom = np.where(self._is_stimulus[contacts.geom[:, 0]], contacts.geom[:, 1], contacts.geom[:, 0])
        self._parts = np.where(geom >= 0, geom, self._facets_from + contacts.elem.max(1))
        slid = np.zeros_like(self._slid)
        np.maximum.at(slid, self._parts, self._slid[self._parts] + np.where(self._slides[self._parts], way, 0.0))
        self._slid = slid
        slid_share = np.minimum(slid[self._parts] / self._materials.kinetic_after_m, 1.0)
        left = 1 - (1 - self._materials.kinetic_share) * slid_share
        friction, cone = contacts.friction, contacts.mu  # views of MuJoCo's own
        friction[:, :2] *= left[:, None]
        cone *= left

    def remember(self, data):
        """Note which parts slide in the step that was solved."""
        self._slides[:] = False
        np.logical_or.at(self._slides, self._parts, self.slides(data))

    def slides(self, data):
        """Which contacts (contacts,) bool of the step that was solved slide. data: mujoco.MjData."""
        row = data.contact.efc_address
        return (row >= 0) & (data.efc_state[row] == _SLIDES)
