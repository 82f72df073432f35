"""Simulation of one contact: approach, shear, settle, record; retried with finer steps until it passes its checks."""

import contextlib
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import betainc

from tactip_twin.sim.contact.fidelity import Fidelity, Motion, fidelity_named, finer, is_coarse
from tactip_twin.sim.contact.limits import MAX_DEPTH_M, check_motion
from tactip_twin.sim.contact.mujoco_warnings import counted_warnings
from tactip_twin.sim.contact.record import Contact, QualityLimits
from tactip_twin.sim.contact.scene import Scene
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.contact.stimuli import Stimulus
from tactip_twin.sim.pose import before_shear, inverse, path, sensor_in_contact, shear_between, turn_between
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import Mesh, tetrahedron_volumes
from tactip_twin.tactip_model.pins import PinReader

_CLEARANCE_M = 0.05e-3
"""Gap at the start of an approach, m."""

LEVER_M = 10e-3
"""Lever arm that converts a rotation into travel of the skin, m: half the dome's radius."""

_MIN_STEPS_ACROSS = 4
"""Minimum number of steps in which the skin crosses a thin stimulus; with fewer it would tunnel through."""

EASY_FRICTION = 0.6
"""Friction up to which a slide has the fidelity's step size, -."""

STICKY_FRICTION = 1.0
"""Friction above which sliding skin may snag by chance, even on a flat surface, -."""

ROUND_STICKY_FRICTION = 0.9
"""The same on a round stimulus, where a tip that slides off a flank sticks and slips in turn: at a friction of 1 on a ball,
it stops 0.2 mm apart at different step sizes [M]."""

MAX_SETTLING = 4.0
"""Time of settling, relative to the fidelity's shortest, above which skin that may snag has not stopped by itself, -.
Contacts of docs/stability.md that converge need at most 3.9; of those that need more, some end 0.7 mm apart at other steps
[M]."""

MIN_STEP_FRACTION = 0.25
"""Minimum fraction of that step size, at high friction, -."""

SILICONE_KG_M3 = 1050.0
"""Density up to which a motion has the fidelity's step size, kg/m^3."""

_MIN_FORCE_N = 1e-2
"""Minimum force by which the rate of the elastic energy is divided, N: a hundredth of a light press."""

TRIES = 3
"""Maximum number of simulations of a contact, each with finer steps, before it is rejected."""

_SLIP_STEPS = 3
"""Number of steps at the end of a motion over which Contact.slip_fraction is averaged: a tip at rest does not slide."""

UNCONFIRMED = "not yet confirmed by a simulation with half the step"
"""Failed check of the first good record on a stimulus that the skin may snag on."""


MAX_COARSE_TRAVEL = 0.24
"""Maximum travel of the skin on an edge, relative to the dome's radius, up to which a mesh coarser than that of `standard`
is good enough [M] (docs/stability.md)."""


Watch = Callable[[str, np.ndarray], None]
"""Observer of time steps: takes the phase and the label (6,), m and rad, that the step led to."""


class Diverged(TactipError):
    """The state of the simulated tip has diverged."""


class ContactSimulator:
    """Simulator of contacts in one scene. Each contact is independent of those before it."""

    def __init__(self, design: Design, stimulus: str | Stimulus, fidelity: Fidelity) -> None:
        """Build the scene.

        Args:
            design: The tip.
            stimulus: Name in stimuli.STIMULI, or a stimulus.
            fidelity: Mesh, steps and solver.

        Raises:
            TactipError: The stimulus is unknown, or the tip cannot be built.
        """
        self.scene = Scene(design, stimulus, fidelity)
        """The scene, at the end of the last contact."""
        self.reader = PinReader(design, self.scene.mesh)
        """Reader of the design's pins on this scene's skin."""
        self.watch: Watch | None = None
        """Called after each time step, if set, with the phase and the label (6,) that the step led to."""
        self._phase = ""
        self._steps, self._unsolved, self._slip_fraction = 0, 0, 0.0
        self.settled_steps = 0
        """Number of steps in which the last contact settled."""
        self.press_step_m, self.shear_step_m = self._step_sizes()
        """Mean approach, and mean travel of the skin in contact, per step, m."""

    def simulate(self, pose: ArrayLike, shear: ArrayLike, approach: bool = True) -> Contact:
        """Simulate one contact: press at `pose` minus `shear`, move to `pose`, settle.

        Args:
            pose: (6,), m and rad.
            shear: (6,), m and rad.
            approach: Whether to press from above. False starts where the press would end, with the stimulus inside the skin.

        Raises:
            TactipError: Pose or shear are out of reach (check_motion), or the contact would start inside a stimulus that is
                not flat, where the side to which the skin is pushed would depend on chance.
        """
        pose, shear = np.asarray(pose, float), np.asarray(shear, float)
        check_motion(pose, shear, min(MAX_DEPTH_M, self.scene.stimulus.max_depth_m))
        flat = np.isinf(self.scene.stimulus.min_radius_m)
        require(approach or flat, "approach", approach, "True with a stimulus that is not flat")
        self.scene.reset()
        self._start, self._pose = before_shear(pose, shear), pose
        self._steps, self._unsolved, self._slip_fraction = 0, 0, 0.0
        # A diverged state does not recover; the record shows it, and more steps would only cost time.
        with counted_warnings() as messages, contextlib.suppress(Diverged):
            for phase, labels in self._motions(pose, shear, approach):
                self._phase = phase
                self.move(labels)
            self._settle(pose)
        return self._record(pose, shear, len(messages))

    def slide(self, pose: ArrayLike, label: np.ndarray) -> Contact:
        """Continue the last contact: slide to `pose`, then pause as in servoing (Motion.pause_steps).

        Args:
            pose: (6,), m and rad, in the stimulus's frame. Depth and tilt are not checked.
            label: (6,), m and rad: the same pose relative to the surface where the tip touches it.

        Returns:
            The contact. Its shear is the whole motion since the tip touched down; its steps are those of the slide.
        """
        start, self._pose = self._pose, np.asarray(pose, float)
        self._steps, self._unsolved, self._slip_fraction = 0, 0, 0.0
        with counted_warnings() as messages, contextlib.suppress(Diverged):
            for phase, labels in self._motions(self._pose, shear_between(start, self._pose), approach=False):
                self._phase = phase
                self.move(labels)
            self._phase = "settle"
            for _ in range(self.scene.fidelity.motion.pause_steps):
                self.hold(self._pose)
        return self._record(self._pose, shear_between(self._start, self._pose), len(messages), label)

    def start_from(self, vertices: np.ndarray, pose: ArrayLike, shear: ArrayLike = (0, 0, 0, 0, 0, 0)) -> None:
        """Start in contact, from a deformed mesh at rest.

        Args:
            vertices: (n, 3) m, in the sensor frame.
            pose: (6,), m and rad, in the stimulus's frame. Depth and tilt are not checked.
            shear: (6,), m and rad, motion in contact until then.
        """
        pose, shear = np.asarray(pose, float), np.asarray(shear, float)
        self.scene.reset()
        self.scene.deform(vertices)
        self._start, self._pose = before_shear(pose, shear), pose

    def settle(
        self, pose: ArrayLike, limits: QualityLimits, min_steps: int, max_steps: int, label: np.ndarray | None = None
    ) -> Contact | None:
        """Let a deformed tip settle at a pose, after start_from, until its record passes the checks.

        Args:
            pose: (6,), m and rad, in the stimulus's frame.
            limits: Limits of the checks.
            min_steps: Minimum number of time steps.
            max_steps: Maximum number of time steps.
            label: (6,), m and rad: the same pose relative to the surface where the tip touches it. Default: the pose.

        Returns:
            The contact, whose slip fraction is 0, because nothing moves; None if it fails the checks after all steps.
        """
        pose, warnings = np.asarray(pose, float), 0
        self._steps, self._unsolved, self._slip_fraction, self._phase = 0, 0, 0.0, "settle"
        for step in range(1, max_steps + 1):
            with counted_warnings() as messages, contextlib.suppress(Diverged):
                self.hold(pose, settled=step >= min_steps)
            warnings += len(messages)
            # This is the check that fails last, and a record takes a third of the time of a step.
            if step < min_steps or self.scene.penetration() > limits.penetration_m:
                continue
            contact = self._record(pose, shear_between(self._start, pose), warnings, label)
            if not contact.violations(limits):
                return contact
        return None

    def simulate_partial_shears(self, pose: ArrayLike, shear: ArrayLike, fractions: ArrayLike) -> Iterator[Contact]:
        """Simulate one contact and let it settle at several fractions of its shear.

        Args:
            pose: (6,), m and rad.
            shear: (6,), m and rad.
            fractions: (n,) of the shear, increasing, 0 to 1.

        Yields:
            The contact at each fraction, with the shear up to there; the scene is in that state meanwhile.

        Raises:
            TactipError: Pose or shear are out of reach (check_motion).
        """
        pose, shear = np.asarray(pose, float), np.asarray(shear, float)
        check_motion(pose, shear, min(MAX_DEPTH_M, self.scene.stimulus.max_depth_m))
        self.scene.reset()
        self._steps, self._unsolved, self._slip_fraction, warnings = 0, 0, 0.0, 0
        start = before_shear(pose, shear)
        current, approach = start, True
        for label in path(start, pose, fractions):
            with counted_warnings() as messages, contextlib.suppress(Diverged):
                for phase, labels in self._motions(label, shear_between(current, label), approach):
                    self._phase = phase
                    self.move(labels)
                self._settle(label)
            warnings += len(messages)
            yield self._record(label, shear_between(start, label), warnings)
            current, approach = label, False

    def _step_sizes(self) -> tuple[float, float]:
        """Return the mean approach and the mean travel of the skin per step, m."""
        motion, materials = self.scene.fidelity.motion, self.scene.design.materials
        # Waves are slow in a heavy tip, and the stimulus must stay slow compared with them.
        density_factor = min(1.0, float(np.sqrt(SILICONE_KG_M3 / materials.density_kg_m3)))
        # The higher the friction, the more the result depends on the path of a slide and the finer its steps must be.
        friction_factor = float(np.clip(EASY_FRICTION / max(materials.friction, EASY_FRICTION), MIN_STEP_FRACTION, 1.0))
        max_step = self.scene.stimulus.width_m / _MIN_STEPS_ACROSS
        steps = motion.press_step_m * density_factor, motion.shear_step_m * density_factor * friction_factor
        return min(steps[0], max_step), min(steps[1], max_step)

    def lift(self, label: np.ndarray) -> float:
        """Return the height (m) by which a tip at a label (6,) must rise along z to be clear; negative if it is clear."""
        radius = self.scene.design.shape.radius_m
        dome_centre = sensor_in_contact(label) @ [0, 0, -radius, 1]
        return self.scene.stimulus.height_to_clear(dome_centre[:3], radius) + _CLEARANCE_M

    def _motions(self, pose: np.ndarray, shear: np.ndarray, approach: bool) -> Iterator[tuple[str, np.ndarray]]:
        """Yield the name and the labels (n, 6) of each motion in turn."""
        motion, start = self.scene.fidelity.motion, before_shear(pose, shear)
        lift = self.lift(start)
        if approach and lift > 0:
            above = start + np.array([0, 0, lift, 0, 0, 0])
            yield "approach", path(above, start, motion_fractions(lift / self.press_step_m, motion))
        travel = float(np.linalg.norm(shear[:3])) + LEVER_M * turn_between(start, pose)
        if travel > 0:
            yield "shear", path(start, pose, motion_fractions(travel / self.shear_step_m, motion))

    def move(self, labels: np.ndarray) -> None:
        """Move the stimulus along labels (n, 6), one per step. Raises Diverged."""
        h = self.scene.fidelity.motion.step_s
        self.scene.stiffen(resting=False)
        poses = [inverse(sensor_in_contact(label)) for label in labels]
        self._slip_fraction = 0.0
        for k, ((T, T_next), label) in enumerate(zip(pairwise(poses), labels[1:], strict=True)):
            turn = Rotation.from_matrix(T[:3, :3].T @ T_next[:3, :3]).as_rotvec()
            self._place(T, (T_next[:3, 3] - T[:3, 3]) / h, turn / h)
            self._step(label)
            if k >= len(poses) - 1 - _SLIP_STEPS:
                self._slip_fraction += self.scene.slip_fraction() / min(_SLIP_STEPS, len(poses) - 1)

    def hold(self, pose: np.ndarray, settled: bool = True) -> None:
        """Simulate one time step with the stimulus at rest at `pose` (6,). Raises Diverged.

        Args:
            pose: (6,), m and rad.
            settled: Whether the tip may be at rest after it. If not, the step is solved to the tolerance of a motion.
        """
        self.scene.stiffen(resting=True)
        if not settled:
            self.scene.model.opt.tolerance = self.scene.fidelity.solver.tolerance
        self._place(inverse(sensor_in_contact(pose)))
        self._step(pose)

    def _settle(self, pose: np.ndarray) -> None:
        """Hold the stimulus at `pose` (6,) until the tip is at rest."""
        motion, self._phase = self.scene.fidelity.motion, "settle"
        for step in range(1, motion.settle_limit + 1):
            self.hold(pose)
            self.settled_steps = step
            if step >= motion.settle_steps and self.scene.max_vertex_speed() < motion.settle_speed_m_s:
                break

    def _step(self, label: np.ndarray) -> None:
        """Simulate one time step, which leads to a label (6,). Raises Diverged if the state is no longer finite."""
        self.scene.step()
        self._steps += 1
        self._unsolved += self.scene.hit_iteration_limit()
        if not np.isfinite(self.scene.max_vertex_speed()):
            raise Diverged("the simulation diverged: the state of the tip is no longer finite")
        if self.watch:
            self.watch(self._phase, label)

    def skin_travel_m(self) -> float:
        """Return how far the skin's farthest vertex is from its place in the undeformed tip, m."""
        count = self.scene.mesh.surface_count
        moved = self.scene.vertices()[:count] - self.scene.mesh.vertices[:count]
        return float(np.linalg.norm(moved, axis=1).max())

    def _place(self, T: np.ndarray, linear: ArrayLike = (0, 0, 0), angular: ArrayLike = (0, 0, 0)) -> None:
        quaternion = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
        self.scene.place(T[:3, 3], quaternion, linear, angular)

    def _record(self, pose: np.ndarray, shear: np.ndarray, warnings: int, label: np.ndarray | None = None) -> Contact:
        """Return the record of the current state, at `pose` (6,) in the stimulus's frame; the label defaults to the pose."""
        scene, label = self.scene, pose if label is None else label
        vertices = scene.vertices()
        tips, directions = self.reader.read(vertices[: scene.mesh.surface_count])
        force_in_sensor, axes = scene.contact_force(), sensor_in_contact(label)[:3, :3]
        force, patch = axes @ force_in_sensor, scene.contact_patch(vertices, axes)
        area_ratio, fold = scene.skin_shape(vertices)
        ratio = tetrahedron_volumes(vertices, scene.mesh.tetrahedra) / scene.mesh.volumes
        return Contact(
            pose=label,
            shear=shear,
            pin_tips=tips,
            directions=directions,
            normal_force_n=float(force[2]),
            tangential_force_n=float(np.hypot(force[0], force[1])),
            force_n=force_in_sensor,
            effective_shear=patch.shear,
            slip_fraction=self._slip_fraction,
            contact_area_m2=patch.area_m2,
            penetration_m=scene.penetration(),
            volume_ratio=float(ratio.min()),
            speed_m_s=scene.max_vertex_speed(),
            overlap_m=scene.overlap(sensor_in_contact(pose)),
            imbalance=scene.imbalance(),
            energy_drift_m_s=scene.elastic_energy_rate() / max(float(np.linalg.norm(force)), _MIN_FORCE_N),
            area_ratio=area_ratio,
            fold_rad=fold,
            unconverged_fraction=self._unsolved / self._steps,
            warnings=warnings,
            steps=self._steps,
        )


class RetriedContact(NamedTuple):
    """Result of RetryingSimulator: the last contact, and why the tries before it were repeated."""

    contact: Contact
    """Record of the last try."""
    violations: list[list[str]]
    """Failed checks of each try that failed; one list per try of RetryingSimulator.tries if the last one failed, too."""


class RetryingSimulator:
    """Simulator of contacts that repeats a contact with finer steps until its record passes the checks.

    Where skin may snag on the stimulus by chance (Stimulus.can_snag, or friction above STICKY_FRICTION), a single record
    does not show it. There, two records that pass must agree, the second with half the step of the first, and skin that
    slides on for long after the stimulus has stopped does not pass: where it stops depends on chance.

    Where an edge moves the skin far, finer steps do not help a mesh that is coarser than that of `standard`: the contact is
    repeated at `standard`.
    """

    def __init__(self, design: Design, stimulus: str | Stimulus, fidelity: Fidelity, limits: QualityLimits) -> None:
        """Build the scene of the first try.

        Args:
            design: The tip.
            stimulus: Name in stimuli.STIMULI, or a stimulus.
            fidelity: Mesh, steps and solver of the first try.
            limits: Limits of the checks.

        Raises:
            TactipError: The stimulus is unknown, or the tip cannot be built.
        """
        self._simulators = [ContactSimulator(design, stimulus, fidelity)]
        self._standard_simulators: list[ContactSimulator] = []
        """Simulators for contacts that the first mesh does not resolve."""
        self.stimulus = self._simulators[0].scene.stimulus
        """Stimulus of all tries."""
        self._last = self._slider = self._simulators[0]
        self._design, self._limits = design, limits
        self.watch: Watch | None = None
        """ContactSimulator.watch for the steps of every try."""
        is_round = np.isfinite(self.stimulus.min_radius_m) and not self.stimulus.has_edge
        sticky = ROUND_STICKY_FRICTION if is_round else STICKY_FRICTION
        self._must_agree = self.stimulus.can_snag or design.materials.friction > sticky
        self._may_be_too_coarse = self.stimulus.has_edge and is_coarse(fidelity)
        self._max_level = TRIES + self._must_agree - 1
        self.tries = TRIES + self._must_agree + self._may_be_too_coarse
        """Maximum number of tries before a contact is rejected."""

    def replace_solid(self, solid: SignedDistanceMesh) -> None:
        """Replace the solid of the stimulus for the next contacts. Raises TypeError if it is not a SolidStimulus."""
        if not isinstance(self.stimulus, SolidStimulus):
            raise TypeError(f"the stimulus must be a SolidStimulus, got {type(self.stimulus).__name__}")
        self.stimulus.solid = solid

    def simulate(self, pose: ArrayLike, shear: ArrayLike, approach: bool = True) -> RetriedContact:
        """Simulate one contact, as ContactSimulator.simulate does, until its record passes the checks.

        Returns:
            The last contact, and the failed checks of each failed try. Fewer than `tries` of them mean that the contact
            passed; `tries`, that it failed.
        """
        violations: list[list[str]] = []
        good: Contact | None = None
        level, at_standard = 0, False
        while True:
            before, self._last = self._last, self._simulator(level, at_standard)
            self._last.watch = self.watch
            contact = self._last.simulate(pose, shear, approach)
            failed = contact.violations(self._limits)
            too_coarse = [] if failed or at_standard else self._mesh_violations()
            if too_coarse:
                failed, good = too_coarse, None
            elif self._must_agree:
                failed = failed or self._sliding_on()
                failed, good = (failed, None) if failed else (self._disagreement(contact, good), contact)
            # Of two records that agree, the coarser is good as well, and its simulator needs half the steps for a slide.
            self._slider = before if self._must_agree and not failed else self._last
            if failed:
                violations.append(failed)
            if not failed or len(violations) == self.tries:
                return RetriedContact(contact, violations)
            last = len(violations) == self.tries - 1
            if self._may_be_too_coarse and not at_standard and (too_coarse or last):
                at_standard = True  # with as many halvings
            else:
                level = min(level + 1, self._max_level)

    def slide(self, pose: ArrayLike, label: np.ndarray) -> Contact:
        """Continue the last contact as ContactSimulator.slide does: once, with the coarsest steps that passed for it."""
        self._last = self._slider
        return self._last.slide(pose, label)

    @property
    def last(self) -> ContactSimulator:
        """Simulator of the last try."""
        return self._last

    def skin(self) -> tuple[np.ndarray, Mesh]:
        """Return the vertices (s, 3) m of the skin at the end of the last contact, in the sensor frame, and their mesh."""
        scene = self._last.scene
        return scene.vertices()[: scene.mesh.surface_count], scene.mesh

    def _sliding_on(self) -> list[str]:
        """Return the failed check of the last try's settling."""
        motion, steps = self._last.scene.fidelity.motion, self._last.settled_steps
        if steps <= MAX_SETTLING * motion.settle_steps:
            return []
        ms, allowed = (1e3 * motion.step_s * n for n in (steps, MAX_SETTLING * motion.settle_steps))
        return [f"the skin slid on for {ms:.0f} ms after the object had stopped (allowed: {allowed:.0f} ms)"]

    def _disagreement(self, contact: Contact, coarser: Contact | None) -> list[str]:
        """Compare a good contact with the one before (None if that was not good), and return the failed checks."""
        if coarser is None:
            return [UNCONFIRMED]
        apart = float(np.sqrt(np.mean(((contact.pin_tips - coarser.pin_tips) ** 2).sum(1))))
        allowed = self._limits.disagreement_m
        if apart <= allowed:
            return []
        return [f"halving the step moves the pins by {1e3 * apart:.3f} mm rms (allowed: {1e3 * allowed} mm)"]

    def _mesh_violations(self) -> list[str]:
        """Return the failed check of the last record's mesh, if that is coarse."""
        if not self._may_be_too_coarse:
            return []
        travel, radius = self._last.skin_travel_m(), self._design.shape.radius_m
        if travel <= MAX_COARSE_TRAVEL * radius:
            return []
        allowed = f"allowed on this mesh: {1e3 * MAX_COARSE_TRAVEL * radius:.1f} mm"
        return [f"the edge moves the skin by {1e3 * travel:.1f} mm ({allowed})"]

    def _simulator(self, level: int, at_standard: bool = False) -> ContactSimulator:
        """Return the simulator whose step has been halved `level` times; it is built when it is first needed.

        Args:
            level: Number of halvings.
            at_standard: Whether the first step, and the mesh, are those of `standard`, instead of the first try's.
        """
        there = self._standard_simulators if at_standard else self._simulators
        while level >= len(there):
            fidelity = finer(there[-1].scene.fidelity) if there else fidelity_named("standard")
            there.append(ContactSimulator(self._design, self.stimulus, fidelity))
        return there[level]


def motion_fractions(steps: float, motion: Motion) -> np.ndarray:
    """Return the fractions (n + 1,) of a motion's path at its time steps, from 0 to 1: the integral of its speed
    (Motion.ease_in, ease_out).

    Args:
        steps: Number of time steps at the mean speed; n is at least Motion.min_steps.
        motion: Speed profile.
    """
    n = max(motion.min_steps, int(np.ceil(steps)))
    return betainc(motion.ease_in + 1, motion.ease_out + 1, np.arange(n + 1) / n)
