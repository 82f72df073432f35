"""Simulation of one contact: approach, shear, settle, record; retried with finer steps until the record can be trusted."""

import contextlib
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import betainc

from tactip_twin.sim.contact.fidelity import finer
from tactip_twin.sim.contact.limits import MAX_DEPTH_M, check_motion
from tactip_twin.sim.contact.mujoco_warnings import counted_warnings
from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.contact.scene import Scene
from tactip_twin.sim.pose import before_shear, inverse, path, sensor_in_contact, shear_between, turn_between
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import tetrahedron_volumes
from tactip_twin.tactip_model.pins import PinReader

_CLEARANCE_M = 0.05e-3
"""Gap from which an approach starts, m."""

LEVER_M = 10e-3
"""Distance from the apex at which a turn counts as travel of the skin, m: half the dome's radius."""

_STEPS_ACROSS = 4
"""Least steps in which the skin passes something thin: in fewer it would come out on the other side."""

EASY_FRICTION = 0.6
"""Friction up to which the fidelity's steps of a slide are kept, -."""

STICKY_FRICTION = 1.0
"""Friction above which a slid skin may catch by chance, on the flat too, -."""

LEAST_STICKINESS = 0.25
"""Least share of them that is left at high friction, -."""

HEAVIEST_KG_M3 = 1050.0
"""Density up to which the fidelity's pace is kept, kg/m^3: that of silicone."""

_LEAST_FORCE_N = 1e-2
"""Contact force below which a drift of energy is not weighed against it, N: a hundredth of a light press."""

TRIES = 3
"""Times that a contact is played, each with finer steps, before it is refused."""

UNPROVEN = "twice the step has not been seen to give the same"
"""The fault of a first good record on a stimulus that the skin may catch on."""


class Diverged(TactipError):
    """The state of the tip is no longer finite, or no longer a tip's."""


class ContactSimulator:
    """Plays contacts in one scene. Each is independent of those before it."""

    def __init__(self, design, stimulus, fidelity):
        """design: Design. stimulus: a name in stimulus.STIMULI, or a Stimulus. fidelity: Fidelity.

        Raises TactipError on what cannot be built.
        """
        self.scene = Scene(design, stimulus, fidelity)
        """The scene, at the end of the last contact."""
        self.reader = PinReader(design, self.scene.mesh)
        """The design's pins on this scene's skin."""
        self.watch = None
        """Called after each time step, if it is set, with the phase (str) and the label (6,) that it led to."""
        self._phase = ""
        self._steps = self._unsolved = 0
        self.press_step_m, self.shear_step_m = self._paces()
        """Approach, and travel of the skin in contact, per step, m (mean)."""

    def play(self, pose, shear, approach=True):
        """Press at `pose` minus `shear`, move to `pose`, settle. pose, shear: (6,), m and rad. Returns a Contact.

        approach: False begins where the press would end, with the stimulus inside the skin as it may be.
        Raises TactipError on a pose or shear out of reach (check_motion), and on a start inside of what has an edge: to
        which side of it the skin gives way would be chance.
        """
        pose, shear = np.asarray(pose, float), np.asarray(shear, float)
        check_motion(pose, shear, min(MAX_DEPTH_M, self.scene.stimulus.deepest_m))
        flat = np.isinf(self.scene.stimulus.sharpest_m)
        require(approach or flat, "approach", approach, "True with a stimulus that is not flat")
        self.scene.reset()
        self._start, self._here = before_shear(pose, shear), pose
        self._steps = self._unsolved = 0
        # A state that is lost stays lost: the record shows it, and steps from it would only take long.
        with counted_warnings() as messages, contextlib.suppress(Diverged):
            for phase, labels in self._motions(pose, shear, approach):
                self._phase = phase
                self.move(labels)
            self._settle(pose)
        return self._record(pose, shear, len(messages))

    def slide(self, pose, label):
        """Go on from where the last contact ended: slide to `pose`, and rest as a servo does (Motion.pause_steps). Returns a
        Contact.

        pose: (6,), m and rad, in the stimulus' frame; how deep and how steep is not looked at. label: (6,), what the pose is
        to the surface where it is touched. The Contact's shear is the whole motion since the first touch, its steps are
        those of the slide.
        """
        here, self._here = self._here, np.asarray(pose, float)
        self._steps = self._unsolved = 0
        with counted_warnings() as messages, contextlib.suppress(Diverged):
            for phase, labels in self._motions(self._here, shear_between(here, self._here), approach=False):
                self._phase = phase
                self.move(labels)
            self._phase = "settle"
            for _ in range(self.scene.fidelity.motion.pause_steps):
                self.hold(self._here)
        return self._record(self._here, shear_between(self._start, self._here), len(messages), label)

    def stages(self, pose, shear, motion_fractions):
        """One contact looked at on its way: at rest at each of `shares` (increasing, 0 to 1) of the shear.

        pose, shear: as for `play`. Yields a Contact for each share, with the shear that it has had so far; the scene is then
        in that state.
        """
        pose, shear = np.asarray(pose, float), np.asarray(shear, float)
        check_motion(pose, shear, min(MAX_DEPTH_M, self.scene.stimulus.deepest_m))
        self.scene.reset()
        self._steps = self._unsolved = warnings = 0
        start = before_shear(pose, shear)
        here, approach = start, True
        for label in path(start, pose, motion_fractions):
            with counted_warnings() as messages, contextlib.suppress(Diverged):
                for phase, labels in self._motions(label, shear_between(here, label), approach):
                    self._phase = phase
                    self.move(labels)
                self._settle(label)
            warnings += len(messages)
            yield self._record(label, shear_between(start, label), warnings)
            here, approach = label, False

    def _paces(self):
        motion, materials = self.scene.fidelity.motion, self.scene.design.materials
        # A heavy tip's waves are slow: the stimulus is to stay slow against them.
        slowness = min(1.0, float(np.sqrt(HEAVIEST_KG_M3 / materials.density_kg_m3)))
        # What is left of a slide is friction's work: the higher it is, the finer the steps of the slide must be.
        stickiness = float(np.clip(EASY_FRICTION / max(materials.friction, EASY_FRICTION), LEAST_STICKINESS, 1.0))
        longest = self.scene.stimulus.width_m / _STEPS_ACROSS
        steps = motion.press_step_m * slowness, motion.shear_step_m * slowness * stickiness
        return min(steps[0], longest), min(steps[1], longest)

    def lift(self, label):
        """How far (m) a tip with a label (6,) must rise along z to be clear; negative if it is clear by more."""
        radius = self.scene.design.shape.radius_m
        dome_centre = sensor_in_contact(label) @ [0, 0, -radius, 1]
        return self.scene.stimulus.height_to_clear(dome_centre[:3], radius) + _CLEARANCE_M

    def _motions(self, pose, shear, approach):
        """Name and labels (n, 6) of each motion, first to last."""
        motion, start = self.scene.fidelity.motion, before_shear(pose, shear)
        lift = self.lift(start)
        if approach and lift > 0:
            above = start + np.array([0, 0, lift, 0, 0, 0])
            yield "approach", path(above, start, motion_fractions(lift / self.press_step_m, motion))
        travel = np.linalg.norm(shear[:3]) + LEVER_M * turn_between(start, pose)
        if travel > 0:
            yield "shear", path(start, pose, motion_fractions(travel / self.shear_step_m, motion))

    def move(self, labels):
        """Carry the stimulus along labels (n, 6), one a step. Raises Diverged."""
        h = self.scene.fidelity.motion.step_s
        self.scene.stiffen(resting=False)
        poses = [inverse(sensor_in_contact(label)) for label in labels]
        for (T, T_next), label in zip(pairwise(poses), labels[1:], strict=True):
            turn = Rotation.from_matrix(T[:3, :3].T @ T_next[:3, :3]).as_rotvec()
            self._place(T, (T_next[:3, 3] - T[:3, 3]) / h, turn / h)
            self._step(label)

    def hold(self, pose):
        """One time step with the stimulus at rest at `pose` (6,). Raises Diverged."""
        self.scene.stiffen(resting=True)
        self._place(inverse(sensor_in_contact(pose)))
        self._step(pose)

    def _settle(self, pose):
        """Hold the stimulus at `pose` (6,) until the tip is at rest."""
        motion, self._phase = self.scene.fidelity.motion, "settle"
        for step in range(1, motion.settle_limit + 1):
            self.hold(pose)
            if step >= motion.settle_steps and self.scene.max_vertex_speed() < motion.settle_speed_m_s:
                break

    def _step(self, label):
        """One time step, which leads to a label (6,). Raises Diverged where the state is no longer finite."""
        self.scene.step()
        self._steps += 1
        self._unsolved += self.scene.hit_iteration_limit()
        if not np.isfinite(self.scene.max_vertex_speed()):
            raise Diverged("the simulated tip is lost: its state is not finite any more")
        if self.watch:
            self.watch(self._phase, label)

    def _place(self, T, linear=(0, 0, 0), angular=(0, 0, 0)):
        quaternion = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
        self.scene.place(T[:3, 3], quaternion, linear, angular)

    def _record(self, pose, shear, warnings, label=None):
        """The Contact of this moment, at `pose` (6,) in the stimulus' frame and with a `label` (6,), the pose if None."""
        scene, label = self.scene, pose if label is None else label
        vertices = scene.vertices()
        tips, directions = self.reader.read(vertices[: scene.mesh.surface_count])
        force = sensor_in_contact(label)[:3, :3] @ scene.contact_force()
        area_ratio, fold = scene.skin_shape(vertices)
        ratio = tetrahedron_volumes(vertices, scene.mesh.tetrahedra) / scene.mesh.volumes
        return Contact(
            pose=label,
            shear=shear,
            tips=tips,
            directions=directions,
            normal_force_n=float(force[2]),
            tangential_force_n=float(np.hypot(force[0], force[1])),
            penetration_m=scene.penetration(),
            volume_ratio=float(ratio.min()),
            speed_m_s=scene.max_vertex_speed(),
            overlap_m=scene.overlap(sensor_in_contact(pose)),
            imbalance=scene.imbalance(),
            creep_m_s=scene.elastic_energy_rate() / max(float(np.linalg.norm(force)), _LEAST_FORCE_N),
            area_ratio=area_ratio,
            fold_rad=fold,
            unsolved=self._unsolved / self._steps,
            warnings=warnings,
            steps=self._steps,
        )


class RetryingSimulator:
    """Plays contacts, and plays one that went wrong again with finer steps.

    Where a skin may catch on the stimulus by chance (Stimulus.catches, or friction above STICKY_FRICTION), no record tells
    that it did. There, two records that keep their bounds must agree, the second with half the step of the first.
    """

    def __init__(self, design, stimulus, fidelity, bounds):
        """design: Design. stimulus: a name in stimulus.STIMULI, or a Stimulus. fidelity: Fidelity. bounds: QualityLimits."""
        self._players = [ContactSimulator(design, stimulus, fidelity)]
        self.stimulus = self._players[0].scene.stimulus
        """Stimulus of all tries."""
        self._last = self._slider = self._players[0]
        self._design, self._bounds = design, bounds
        self.watch = None
        """Called as ContactSimulator.watch at the steps of every try."""
        self._catches = self.stimulus.catches or design.materials.friction > STICKY_FRICTION
        self.tries = TRIES + self._catches
        """Times that a contact is played before it is refused, int."""

    def play(self, pose, shear, approach=True):
        """As ContactSimulator.play. Returns the last Contact tried and the faults (a list of str) of each try but a good
        one.

        Fewer fault lists than `tries` mean that the last Contact is good; `tries`, that it failed.
        """
        faults, good = [], None
        for attempt in range(self.tries):
            self._last = self._player(attempt)
            self._last.watch = self.watch
            contact = self._last.play(pose, shear, approach)
            found = contact.faults(self._bounds)
            if self._catches:
                found, good = (found, None) if found else (self._unproven(contact, good), contact)
            # Of two that agree, the coarser has a good record too, and slides on in half the steps.
            self._slider = self._players[attempt - 1] if self._catches and not found else self._last
            if not found:
                break
            faults.append(found)
        return contact, faults

    def slide(self, pose, label):
        """Go on from where the last contact ended, as ContactSimulator.slide: once, with the coarsest steps that served
        it."""
        self._last = self._slider
        return self._last.slide(pose, label)

    @property
    def last(self):
        """The ContactSimulator of the last try."""
        return self._last

    def skin(self):
        """Vertices (s, 3) m of the skin at the end of the last contact, sensor frame; and the mesh.Mesh that they are of."""
        scene = self._last.scene
        return scene.vertices()[: scene.mesh.surface_count], scene.mesh

    def _unproven(self, contact, coarser):
        """Faults (list of str) of a good Contact beside the one before, or None where that was not good."""
        if coarser is None:
            return [UNPROVEN]
        apart = float(np.sqrt(np.mean(((contact.tips - coarser.tips) ** 2).sum(1))))
        most = self._bounds.disagreement_m
        if apart <= most:
            return []
        return [f"the pins are {1e3 * apart:.3f} mm (rms) from where twice the step has them (allowed: {1e3 * most} mm)"]

    def _player(self, attempt):
        """The ContactSimulator of a try, built when first it is needed."""
        if attempt == len(self._players):
            fidelity = finer(self._players[-1].scene.fidelity)
            self._players.append(ContactSimulator(self._design, self.stimulus, fidelity))
        return self._players[attempt]


def motion_fractions(steps, motion):
    """Shares (n + 1,) of a motion's way at its steps: its pace (Motion.ease_in, ease_out) summed up."""
    n = max(motion.least_steps, int(np.ceil(steps)))
    return betainc(motion.ease_in + 1, motion.ease_out + 1, np.arange(n + 1) / n)
