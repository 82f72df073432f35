"""Simulation of one contact: approach, shear, settle, record."""

import contextlib
from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import betainc

from tactip_twin.sim.contact.fidelity import Fidelity, Motion
from tactip_twin.sim.contact.limits import MAX_DEPTH_M, check_motion
from tactip_twin.sim.contact.mujoco_warnings import counted_warnings
from tactip_twin.sim.contact.record import Contact, QualityLimits
from tactip_twin.sim.contact.scene import Scene
from tactip_twin.sim.contact.stimuli import Stimulus
from tactip_twin.sim.pose import before_shear, inverse, path, sensor_in_contact, shear_between, turn_between
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import tetrahedron_volumes
from tactip_twin.tactip_model.pins import PinReader

_CLEARANCE_M = 0.05e-3
"""Gap at the start of an approach, m."""

LEVER_M = 10e-3
"""Lever arm that converts a rotation into travel of the skin, m: half the dome's radius."""

_MIN_STEPS_ACROSS = 4
"""Minimum number of steps in which the skin crosses a thin stimulus; with fewer it would tunnel through."""

EASY_FRICTION = 0.6
"""Friction up to which a slide has the fidelity's step size, -."""

MIN_STEP_FRACTION = 0.25
"""Minimum fraction of that step size, at high friction, -."""

SILICONE_KG_M3 = 1050.0
"""Density up to which a motion has the fidelity's step size, kg/m^3."""

_MIN_FORCE_N = 1e-2
"""Minimum force by which the rate of the elastic energy is divided, N: a hundredth of a light press."""

_SLIP_STEPS = 3
"""Number of steps at the end of a motion over which Contact.slip_fraction is averaged: a tip at rest does not slide."""

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


def motion_fractions(steps: float, motion: Motion) -> np.ndarray:
    """Return the fractions (n + 1,) of a motion's path at its time steps, from 0 to 1: the integral of its speed
    (Motion.ease_in, ease_out).

    Args:
        steps: Number of time steps at the mean speed; n is at least Motion.min_steps.
        motion: Speed profile.
    """
    n = max(motion.min_steps, int(np.ceil(steps)))
    return betainc(motion.ease_in + 1, motion.ease_out + 1, np.arange(n + 1) / n)
