"""The MuJoCo scene of one contact: a tip fixed in the world, a stimulus that moves, and nothing else.

The world frame is the sensor frame. There is no arm, because steps of a tip on an arm cost two to six times more.
"""

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.contact_patch import ContactPatch, PatchReader, slip_fraction
from tactip_twin.sim.contact.deepest_point import deepest_m
from tactip_twin.sim.contact.facets import held_weights, skin_flex, touched_facets
from tactip_twin.sim.contact.fidelity import Fidelity
from tactip_twin.sim.contact.gel_volume import GelVolume
from tactip_twin.sim.contact.slip_weakening import SlipWeakening
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus, SurfaceContactProxies
from tactip_twin.sim.contact.stimuli import Stimulus, add_stimulus, stimulus_named
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import CONTACT_RADIUS_M, build_mesh
from tactip_twin.tactip_model.soft_body import (
    MAX_STIFFENING,
    RESTING_STEP_S,
    add_soft_tip,
    missing_bulk_modulus,
    relative_stiffness,
)

_STIMULUS_QPOS = 7
_STIMULUS_QVEL = 6

_NO_SOLVE = 1e30
"""Tolerance that every initial guess satisfies, so the solver does nothing, -."""

_HELD, _HELD_N_M = 0.8, 2000.0
"""Weight of clamped corners at a touched point of a facet above which they hold it, -, and stiffness of a contact at the
clamp itself, N/m: about that of the tip where a facet is pressed [?]."""

_LOST_M = 1.0
"""Distance of a vertex from which the state has diverged, m."""

OVERLAP_ERROR_M = 5e-6
"""Maximum error of a sampled overlap, m: a tenth of the default limit."""


class Scene:
    """A compiled contact scene: the MuJoCo model, its state and the tip's mesh."""

    def __init__(self, design: Design, stimulus: str | Stimulus, fidelity: Fidelity) -> None:
        """Build the scene.

        Args:
            design: The tip.
            stimulus: Name in stimuli.STIMULI, or a stimulus.
            fidelity: Mesh, steps and solver.

        Raises:
            TactipError: The stimulus is unknown, or the tip cannot be built.
        """
        self.stimulus = stimulus if isinstance(stimulus, Stimulus) else stimulus_named(stimulus)
        self.design, self.fidelity = design, fidelity
        try:
            self.mesh = build_mesh(design.shape, fidelity.mesh)
            self.model = self._compile()
        except ValueError as error:
            raise TactipError(f"the tip {design.name!r} cannot be built: {error}") from error
        self.data = mujoco.MjData(self.model)
        self._free = ~self.mesh.bonded
        count = 3 * np.count_nonzero(self._free)
        self._tip_qpos = slice(_STIMULUS_QPOS, _STIMULUS_QPOS + count)
        self._tip_qvel = slice(_STIMULUS_QVEL, _STIMULUS_QVEL + count)
        self._neighbours = _neighbours(self.mesh.triangles)
        self._areas = np.linalg.norm(_area_normals(self.mesh.vertices, self.mesh.triangles), axis=1)
        self._skin = skin_flex(self.model)
        self._held = np.zeros(0, int)
        """Numbers of the contacts of the last step that lie beside the clamped rim."""
        self._patch_reader = PatchReader(self.model, self.mesh)
        self._stimulus_body = self.model.body("stimulus").id
        needs_volume = missing_bulk_modulus(design.materials, fidelity.mesh) > 0
        self._volume = GelVolume(self.model, self.mesh, design.materials, fidelity.mesh) if needs_volume else None
        weakens = self._has_friction() and design.materials.kinetic_fraction < 1
        self._slip = SlipWeakening(self.model, self._stimulus_body, design.materials) if weakens else None

    def _compile(self) -> mujoco.MjModel:
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
        # One tip is one island, so islands gain nothing, and with them MuJoCo leaves efc_state as it was before the solve
        # (measured with 4.0.0). sim/contact/slip_weakening.py reads there which contacts slide.
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
        # A diverged state must stay visible: MuJoCo would silently reset the tip to its undeformed state.
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        friction = self.design.materials.friction
        add_stimulus(spec, self.stimulus, friction, self.fidelity.contact)
        tip = spec.worldbody.add_body(name="tip")
        add_soft_tip(spec, tip, self.design, self.mesh, self.fidelity.mesh, self.fidelity.contact)
        self._proxies = None
        if isinstance(self.stimulus, SolidStimulus):
            self._proxies = SurfaceContactProxies(spec, self.stimulus, self.mesh, friction, self.fidelity.contact)
        self._add_bodies(spec)
        model = spec.compile()
        if self._proxies:
            self._proxies.bind(model)
        # The solver's tolerance is relative to the mean inertia: the stimulus's 1000 kg must not loosen it.
        model.stat.meaninertia = model.body_mass[model.body_mass < 1].mean()
        return model

    def _add_bodies(self, spec: mujoco.MjSpec) -> None:
        """Add what a subclass has beside stimulus and tip."""

    def reset(self) -> None:
        """Reset to the undeformed tip without history, so a contact does not depend on earlier ones."""
        mujoco.mj_resetData(self.model, self.data)
        self._held = np.zeros(0, int)
        if self._proxies:
            self._proxies.reset()
        if self._slip:
            self._slip.reset()

    def deform(self, vertices: np.ndarray) -> None:
        """Move the tip's free vertices to those of a deformed mesh (n, 3), m, in the sensor frame, at rest."""
        self.data.qpos[self._tip_qpos] = (vertices - self.mesh.vertices)[self._free].ravel()
        self.data.qvel[self._tip_qvel] = 0.0

    def stiffen(self, resting: bool) -> None:
        """Set contact stiffness and solver tolerance to those of a tip at rest (True) or in motion (False).

        A stimulus that could pierce the skin presses on few points, so its contact is always as stiff as the step allows.
        """
        contact, solver = self.fidelity.contact, self.fidelity.solver
        solref = -np.array(contact.resting if resting else contact.moving)
        if np.isfinite(self.stimulus.width_m):
            ratio = np.clip(RESTING_STEP_S / self.fidelity.motion.step_s, 1.0, MAX_STIFFENING)
            solref = -np.array(contact.resting) * [ratio**2, ratio]
        for attribute in (self.model.geom_solref, self.model.flex_solref, self.model.pair_solref):
            attribute[:] = solref
        self.model.opt.tolerance = solver.settle_tolerance if resting else solver.tolerance

    def step(self) -> None:
        """Advance by one time step, as mujoco.mj_step does, with these differences.

        - The volume of the whole gel is kept by a row of its own (sim/contact/gel_volume.py).
        - The contact proxies on a solid's surface follow the skin (sim/contact/solid_stimulus.py).
        - Contacts become active before they touch (ContactModel.margin_m), but their force still begins at the surface: the
          margin is removed from their rows.
        - MuJoCo's friction cone is convex, which lifts skin that slides at v by friction * v * (step + damping / stiffness).
          The surface is lowered by the same amount (De Saxcé's correction, with the speed of the last step), so sliding skin
          stays at the height it has at rest.
        - Beside the clamped rim the skin cannot give way, and a rigid contact there takes thousands of newtons: contacts are
          springs there, as soft as the tip is elsewhere.
        - Friction falls where the skin has slid, if the materials have it (sim/contact/slip_weakening.py).
        - The motion without contacts, which MuJoCo solves first, is only one of two initial guesses if there are contacts.
          It is left unsolved, which saves a third of the time; the result is the same to the solver's tolerance.
        """
        model, data = self.model, self.data
        if self._proxies:
            self._proxies.update(model, self.skin_in_stimulus())
        if self._volume:
            self._volume.linearize(model, self.vertices())
        tolerance, before = model.opt.tolerance, data.qacc_warmstart.copy()
        mujoco.mj_fwdPosition(model, data)
        if self._volume:
            self._volume.set_length(data)
        touching = data.nefc > data.ne
        self._held = np.zeros(0, int)
        if touching:
            data.efc_margin[data.ne :] = 0.0
            if self._has_friction():
                self._correct_sliding_friction()
            model.opt.tolerance = _NO_SOLVE
        mujoco.mj_forwardSkip(model, data, mujoco.mjtStage.mjSTAGE_POS, 1)
        if touching:
            model.opt.tolerance = tolerance
            data.qacc_warmstart[:] = before
            self._soften_held_contacts()
            mujoco.mj_fwdConstraint(model, data)
            if self._slip:
                self._slip.store_sliding(data)
        elif self._slip:
            self._slip.reset()  # the whole skin has left the object
        data.qacc_warmstart[:] = data.qacc
        data.qvel[:] += model.opt.timestep * data.qacc
        mujoco.mj_integratePos(model, data.qpos, data.qvel, model.opt.timestep)
        data.time += model.opt.timestep

    def _has_friction(self) -> bool:
        return self.design.materials.friction > 0

    def _correct_sliding_friction(self) -> None:
        """Weaken the friction of sliding contacts, and lower their surface: see `step`."""
        data, contacts, step = self.data, self.data.contact, self.model.opt.timestep
        active = contacts.efc_address >= 0
        row = contacts.efc_address[active]
        rates = np.zeros(data.nefc)
        mujoco.mj_mulJacVec(self.model, data, rates, data.qvel)
        speed = np.zeros(data.ncon)
        speed[active] = np.hypot(rates[row + 1], rates[row + 2])
        if self._slip:
            self._slip.weaken(data, speed * step)
        data.efc_margin[row] = -self._lift(speed)[active]

    def _soften_held_contacts(self) -> None:
        """Soften the contacts on facets beside the clamped rim: see `step`."""
        data, contacts = self.data, self.data.contact
        facets = touched_facets(contacts, self._skin)
        on_facet = np.flatnonzero((facets >= 0) & (contacts.efc_address >= 0))
        held = held_weights(self.mesh, self.vertices(), facets[on_facet], contacts.pos[on_facet])
        which = held > _HELD
        self._held = on_facet[which]
        if not which.any():
            return
        row, h = contacts.efc_address[self._held], self.model.opt.timestep
        stiffness, damping, impedance, _ = data.efc_KBIP[row].T
        # The row's spring, integrated implicitly, is a reference acceleration of this much per depth; the regularization
        # divides it (MuJoCo's manual, "Computation").
        per_depth = impedance * stiffness / (1 + h * (damping + h * stiffness))
        softness = (held[which] - _HELD) / (1 - _HELD) / (_HELD_N_M * relative_stiffness(self.design.materials))
        factor = 1 + softness * per_depth / data.efc_R[row]
        rows = row[:, None] + np.arange(contacts.dim[self._held][0])
        data.efc_R[rows] *= factor[:, None]
        data.efc_D[rows] /= factor[:, None]

    def _lift(self, speed: np.ndarray) -> np.ndarray:
        """Return the height (contacts,) m by which MuJoCo lifts contacts that slide at a speed (contacts,) m/s."""
        contacts = self.data.contact
        stiffness, damping = -contacts.solref[0]
        return contacts.friction[:, 0] * speed * (self.model.opt.timestep + damping / stiffness)

    def place(
        self,
        position: ArrayLike,
        quaternion: ArrayLike,
        linear: ArrayLike = (0, 0, 0),
        angular: ArrayLike = (0, 0, 0),
    ) -> None:
        """Set pose and velocity of the stimulus.

        Args:
            position: (3,) m, in the sensor frame.
            quaternion: (4,), scalar first, in the sensor frame.
            linear: (3,) velocity, m/s, in the sensor frame.
            angular: (3,) angular velocity, rad/s, in the stimulus's own frame.
        """
        self.data.qpos[:3], self.data.qpos[3:_STIMULUS_QPOS] = position, quaternion
        self.data.qvel[:3], self.data.qvel[3:_STIMULUS_QVEL] = linear, angular

    def vertices(self) -> np.ndarray:
        """Return the vertices (n, 3) m of the deformed mesh, in the sensor frame."""
        vertices = self.mesh.vertices.copy()
        vertices[self._free] += self.data.qpos[self._tip_qpos].reshape(-1, 3)
        return vertices

    def skin_in_stimulus(self) -> np.ndarray:
        """Return the vertices (s, 3) m of the deformed skin, in the stimulus's frame."""
        position, quaternion = self.data.qpos[:3], self.data.qpos[3:_STIMULUS_QPOS]
        rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        return (self.vertices()[: self.mesh.surface_count] - position) @ rotation

    def max_vertex_speed(self) -> float:
        """Return the speed of the fastest vertex, m/s."""
        return float(np.sqrt((self.data.qvel[self._tip_qvel].reshape(-1, 3) ** 2).sum(1).max()))

    def contact_force(self) -> np.ndarray:
        """Return the force (3,) N of the stimulus on the tip at the last step, in the sensor frame."""
        forces, _ = self._contact_forces()
        return np.add.accumulate(forces)[-1] if len(forces) else np.zeros(3)

    def contact_patch(self, vertices: np.ndarray, contact_axes: np.ndarray) -> ContactPatch:
        """Return the patch of skin in contact at the last step.

        Args:
            vertices: (n, 3) m, as of `vertices`.
            contact_axes: (3, 3) rotation from the sensor frame to the contact frame.
        """
        return self._patch_reader.read(self.data, vertices, contact_axes)

    def slip_fraction(self) -> float:
        """Return the fraction of the normal force whose contacts slid at the last step, -; 1 without friction."""
        return slip_fraction(self.data)

    def contact_wrench(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the force (3,) N and the torque (3,) N m about the apex of the stimulus on the tip at the last step, in the
        sensor frame."""
        forces, points = self._contact_forces()
        return forces.sum(0), np.cross(points, forces).sum(0)

    def _contact_forces(self) -> tuple[np.ndarray, np.ndarray]:
        """Return forces (c, 3) N on the tip and positions (c, 3) m of the active contacts, in the sensor frame."""
        contacts, forces = self.data.contact, self.data.efc_force
        active = self._on_tip()
        if not active.any():
            return np.zeros((0, 3)), np.zeros((0, 3))
        # With elliptic cones there is a row per axis of the contact's frame; without friction, only for the first.
        rows = contacts.efc_address[active, None] + np.arange(contacts.dim[active][0])
        # The frame points from the first geom to the second.
        first = contacts.geom[active, 0]
        sign = np.where((first >= 0) & (self.model.geom_bodyid[first] == self._stimulus_body), 1.0, -1.0)
        axes = contacts.frame[active].reshape(-1, 3, 3)[:, : rows.shape[1]]
        return np.matmul((sign[:, None] * forces[rows])[:, None], axes)[:, 0], contacts.pos[active]

    def _on_tip(self) -> np.ndarray:
        """Return which contacts (c,) bool press on the tip."""
        return self.data.contact.efc_address >= 0

    def penetration(self) -> float:
        """Return the maximum depth (m) of a contact point inside the stimulus at the last step; 0 without contact. Contacts
        beside the clamped rim, where the housing would touch, do not count."""
        distances = np.delete(self.data.contact.dist, self._held)
        return max(0.0, -float(distances.min(initial=0.0)))

    def hit_iteration_limit(self) -> bool:
        """Return whether the solver reached its iteration limit at the last step."""
        return bool(self.data.solver_niter.max() >= self.model.opt.iterations)

    def overlap(self, T_contact_sensor: np.ndarray) -> float:
        """Return the maximum depth (m) of the skin's facets, with their contact thickness, in the stimulus's true shape.

        The error is at most OVERLAP_ERROR_M. A diverged state overlaps infinitely.

        Args:
            T_contact_sensor: (4, 4) pose of the sensor.
        """
        skin = self.vertices()[: self.mesh.surface_count] @ T_contact_sensor[:3, :3].T + T_contact_sensor[:3, 3]
        if not (np.abs(skin) < _LOST_M).all():  # also for NaN
            return np.inf
        # Between samples at this spacing, a surface of the least radius is closer by OVERLAP_ERROR_M at most.
        spacing = np.sqrt(6 * OVERLAP_ERROR_M * (self.stimulus.min_radius_m + CONTACT_RADIUS_M))
        return deepest_m(self._depth, skin, self.mesh.triangles, spacing, OVERLAP_ERROR_M, self.stimulus.is_convex)

    def _depth(self, points: np.ndarray) -> np.ndarray:
        """Return the depths (n,), m, in the stimulus of points (n, 3) m of the skin with its contact thickness."""
        return CONTACT_RADIUS_M - self.stimulus.distance(points)

    def imbalance(self) -> float:
        """Return the ratio of the unbalanced force on the free vertices at the last step to the contact force on them
        (norms), -; 0 without contact."""
        if self.data.nefc == self.data.ne:
            return 0.0
        constraint = self.data.qfrc_constraint[self._tip_qvel]
        size = float(np.linalg.norm(constraint - self._volume_forces()))
        return float(np.linalg.norm(self.data.qfrc_smooth[self._tip_qvel] + constraint)) / size if size else 0.0

    def elastic_energy_rate(self) -> float:
        """Return the magnitude of the rate of change of the elastic energy of gel and skin, W."""
        elastic = self.data.qfrc_spring[self._tip_qvel] + self._volume_forces()
        return abs(float(elastic @ self.data.qvel[self._tip_qvel]))

    def _volume_forces(self) -> np.ndarray | float:
        """Return the forces that keep the gel's volume on the free vertices (3 per vertex), N; 0 without them."""
        return self._volume.forces(self.data).ravel() if self._volume and self.data.ne else 0.0

    def skin_shape(self, vertices: np.ndarray) -> tuple[float, float]:
        """Return the minimum ratio of a facet's area to its undeformed one (-), and the maximum angle (rad) between the
        normals of neighbouring facets, for vertices (n, 3) m."""
        normals = _area_normals(vertices, self.mesh.triangles)
        area = np.linalg.norm(normals, axis=1)
        normals /= np.maximum(area, 1e-300)[:, None]
        a, b = normals[self._neighbours].transpose(1, 0, 2)
        return float((area / self._areas).min()), float(np.arccos(np.clip((a * b).sum(1).min(), -1, 1)))


def _area_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return outward normals (k, 3) of triangles (k, 3) over vertices (n, 3) m; their length is twice the area, m^2."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def _neighbours(triangles: np.ndarray) -> np.ndarray:
    """Return pairs (e, 2) of triangles (k, 3) that share an edge."""
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(triangles)), 3)
    order = np.lexsort(edges.T)
    edges, owner = edges[order], owner[order]
    same = (edges[1:] == edges[:-1]).all(1)
    return np.stack([owner[:-1][same], owner[1:][same]], 1)
