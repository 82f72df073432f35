"""The data-set scene: a tip fixed in the world, a stimulus that moves, and nothing else.

The world frame is the sensor frame. The arm, object meshes and MuJoCo's renderer are left out: a tip that hangs on an
arm costs two to six times as much a step.
"""

import mujoco
import numpy as np

from sim.stimulus import TASKS, add_stimulus
from tactip_model.body import add_body
from tactip_model.errors import TactipError, choose
from tactip_model.mesh import build_mesh

_STIMULUS_QPOS = 7
_STIMULUS_QVEL = 6


class Scene:
    """A compiled contact scene: the MuJoCo model, the mesh, and where things are in the state."""

    def __init__(self, design, task, fidelity):
        """design: Design. task: `surface` or `edge`. fidelity: Fidelity. Raises TactipError on what cannot be built."""
        choose("task", task, dict.fromkeys(TASKS))
        self.design, self.task, self.fidelity = design, task, fidelity
        try:
            self.mesh = build_mesh(design.shape, fidelity.mesh)
            self.model = self._compile()
        except ValueError as error:
            raise TactipError(f"the tip {design.name!r} cannot be built: {error}") from error
        self.data = mujoco.MjData(self.model)
        self._free = ~self.mesh.bonded
        self._stimulus = self.model.body("stimulus").id

    def _compile(self):
        motion, solver = self.fidelity.motion, self.fidelity.solver
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        spec.memory = 256 << 20
        spec.option.gravity = [0, 0, 0]
        spec.option.timestep = motion.step_s
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
        spec.option.solver = mujoco.mjtSolver.mjSOL_CG
        spec.option.iterations = solver.iterations
        spec.option.tolerance = solver.tolerance
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = solver.impratio
        # Contact springs are stiffer than the step resolves; clamping them would let the stimulus sink in.
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_REFSAFE
        # A diverged state must stay to be seen: MuJoCo would start again from the undeformed tip, and say nothing.
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        friction = self.design.materials.friction
        add_stimulus(spec, self.task, friction, self.fidelity.contact)
        tip = spec.worldbody.add_body(name="tip")
        add_body(spec, tip, self.design, self.mesh, self.fidelity.mesh, self.fidelity.contact)
        model = spec.compile()
        # The solver's tolerance is relative to the mean inertia: the stimulus's 1000 kg must not loosen it.
        model.stat.meaninertia = model.body_mass[model.body_mass < 1].mean()
        return model

    def reset(self):
        """Undeformed tip, nothing remembered: a contact depends on nothing that was played before."""
        mujoco.mj_resetData(self.model, self.data)

    def stiffen(self, resting):
        """Set contact and solver to those for a tip that comes to rest (True), or that is moved (False)."""
        contact, solver = self.fidelity.contact, self.fidelity.solver
        solref = -np.array(contact.resting if resting else contact.moving)
        self.model.geom_solref[:], self.model.flex_solref[:] = solref, solref
        self.model.opt.tolerance = solver.settle_tolerance if resting else solver.tolerance

    def place(self, position, quaternion, linear=(0, 0, 0), angular=(0, 0, 0)):
        """Set the stimulus: position (3,) m and quaternion (4,) in the sensor frame, velocity m/s, and rad/s in its own."""
        self.data.qpos[:3], self.data.qpos[3:_STIMULUS_QPOS] = position, quaternion
        self.data.qvel[:3], self.data.qvel[3:_STIMULUS_QVEL] = linear, angular

    def vertices(self):
        """Vertices (n, 3) of the mesh as deformed now, m, sensor frame."""
        vertices = self.mesh.vertices.copy()
        vertices[self._free] += self.data.qpos[_STIMULUS_QPOS:].reshape(-1, 3)
        return vertices

    def greatest_speed(self):
        """Speed (m/s) of the fastest vertex."""
        return float(np.sqrt((self.data.qvel[_STIMULUS_QVEL:].reshape(-1, 3) ** 2).sum(1).max()))

    def contact_force(self):
        """Force (3,) N of the stimulus on the tip in the sensor frame, at the last step."""
        total, wrench = np.zeros(3), np.zeros(6)
        contacts = self.data.contact
        for i in range(self.data.ncon):
            mujoco.mj_contactForce(self.model, self.data, i, wrench)
            # The frame points from the first to the second in contact.
            first = contacts.geom[i, 0]
            sign = 1.0 if first >= 0 and self.model.geom_bodyid[first] == self._stimulus else -1.0
            total += sign * wrench[:3] @ contacts.frame[i].reshape(3, 3)
        return total

    def penetration(self):
        """Greatest depth (m) of a contact point inside the stimulus, at the last step; 0 without contact."""
        return max(0.0, -float(self.data.contact.dist.min())) if self.data.ncon else 0.0
