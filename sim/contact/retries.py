"""A contact that is repeated with finer steps until its record passes the checks."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.contact.fidelity import Fidelity, fidelity_named, finer, is_coarse
from tactip_twin.sim.contact.record import Contact, QualityLimits
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.contact.simulator import ContactSimulator, Watch
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.contact.stimuli import Stimulus
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.mesh import Mesh

TRIES = 3
"""Maximum number of simulations of a contact, each with finer steps, before it is rejected."""

STICKY_FRICTION = 1.0
"""Friction above which sliding skin may snag by chance, even on a flat surface, -."""

ROUND_STICKY_FRICTION = 0.9
"""The same on a round stimulus, where a tip that slides off a flank sticks and slips in turn: at a friction of 1 on a ball,
it stops 0.2 mm apart at different step sizes [M]."""

MAX_SETTLING = 4.0
"""Time of settling, relative to the fidelity's shortest, above which skin that may snag has not stopped by itself, -.
Contacts of docs/stability.md that converge need at most 3.9; of those that need more, some end 0.7 mm apart at other steps
[M]."""

UNCONFIRMED = "not yet confirmed by a simulation with half the step"
"""Failed check of the first good record on a stimulus that the skin may snag on."""

MAX_COARSE_TRAVEL = 0.24
"""Maximum travel of the skin on an edge, relative to the dome's radius, up to which a mesh coarser than that of `standard`
is good enough [M] (docs/stability.md)."""


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
