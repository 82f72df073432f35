"""Named points on the curve of error against run time.

Their errors and costs are measured by `tactip bench error` and stand in docs/fidelity.md, with the machine
they were taken on.
"""

from dataclasses import dataclass, field, replace

from tactip_twin.tactip_model.bounds import check, require, within
from tactip_twin.tactip_model.errors import lookup
from tactip_twin.tactip_model.mesh import Resolution
from tactip_twin.tactip_model.soft_body import ContactModel

SHORTEST_STEP_S = 0.05e-3
"""Shortest time step, s: 0.2 ms is the shortest that docs/stability.md holds to account, and it is refined twice."""

TIGHTEST = 1e-14
"""Tightest relative tolerance of the solver, -: below it is rounding."""

FASTEST_M_S = 0.5
"""Fastest mean approach of the stimulus, m/s."""

FASTEST_SHEAR_M_S = 0.15
"""Fastest mean shear, m/s: faster, damping holds the skin back, and what is left of a slide is a matter of the speed."""


@dataclass(frozen=True)
class Motion:
    """How a contact is played: steps, pace, and when the tip counts as at rest."""

    step_s: float = within(SHORTEST_STEP_S, 20e-3, default=0.007)
    """Time step, s. Implicit; stable from 0.2 ms to 20 ms."""
    press_step_m: float = within(1e-7, 10e-3, default=1.2e-3)
    """Approach per step, m (mean)."""
    shear_step_m: float = within(1e-7, 10e-3, default=0.4e-3)
    """Travel of the skin per step of the shear, m (mean)."""
    least_steps: int = within(1, 100000, default=4)
    """Fewest steps of a motion."""
    ease_in: float = within(0, 5, default=0.5)
    """Power with which a motion's pace grows from its start, -: pace ~ t^ease_in (1 - t)^ease_out, t from 0 to 1. 0 is a
    jerk, which throws the tip off the surface."""
    ease_out: float = within(0, 5, default=1.5)
    """Power with which the pace falls to the motion's end, -. After a jerk there the skin swings on and friction lets go. A
    steady pace has up to twice the error of these two at the same cost (docs/fidelity.md)."""
    settle_steps: int = within(1, 100000, default=4)
    """Fewest steps at rest before recording."""
    settle_speed_m_s: float = within(1e-6, 20e-3, default=2e-3)
    """Settling goes on until no vertex moves faster, m/s ..."""
    settle_limit: int = within(1, 100000, default=20)
    """... or for so many steps in all."""

    def __post_init__(self):
        check(self)
        for name, fastest in (("press_step_m", FASTEST_M_S), ("shear_step_m", FASTEST_SHEAR_M_S)):
            step, most = getattr(self, name), fastest * self.step_s
            require(step <= most * (1 + 1e-9), f"Motion.{name}", step, f"at most {fastest} m/s times step_s, {most:g} m")
        require(self.settle_limit >= self.settle_steps, "settle_limit", self.settle_limit, "at least settle_steps")

    @property
    def pause_steps(self):
        """Steps (int) at rest where the tip goes on from touch to touch: half of `settle_steps`. All of them take a fifth
        more time in a servo, at the same errors over the bust and a tenth less along a rim [M] (docs/servo.md)."""
        return -(-self.settle_steps // 2)


@dataclass(frozen=True)
class Solver:
    """MuJoCo's conjugate gradients."""

    iterations: int = within(100, 1000000, default=1000)
    """Most iterations a step."""
    tolerance: float = within(TIGHTEST, 1e-5, default=1e-7)
    """Relative tolerance, -, while the stimulus moves; scaled by the vertices' mass alone (sim/contact/scene.py)."""
    settle_tolerance: float = within(TIGHTEST, 1e-5, default=1e-9)
    """The same at rest. Looser, the tip trembles without end and its force with it (3 % at 0.5 mm of depth at 1e-7, 0.3 %
    at 1e-9); few iterations are needed there, so that it costs next to nothing."""
    impratio: float = within(0.1, 1000, default=3.0)
    """Ratio of frictional to normal impedance, -; more lets less creep."""

    def __post_init__(self):
        check(self)


@dataclass(frozen=True)
class Fidelity:
    """Everything that trades error for time."""

    name: str
    """Of a preset, or of one that was changed."""
    mesh: Resolution = field(default_factory=Resolution)
    """How finely the tip is meshed."""
    contact: ContactModel = field(default_factory=ContactModel)
    """How contact is enforced."""
    motion: Motion = field(default_factory=Motion)
    """Steps and pace."""
    solver: Solver = field(default_factory=Solver)
    """Iterations and tolerances."""


FIDELITIES = {
    "draft": Fidelity(
        "draft",
        mesh=Resolution(surface_m=3.2e-3, rim_m=5e-3, fine_angle_deg=40.0, growth=1.35, locked_stiffness=0.87),
        contact=ContactModel(vertex_mass_kg=5e-5),
        motion=Motion(press_step_m=1.6e-3, shear_step_m=1e-3, settle_steps=3),
        solver=Solver(tolerance=1e-6, settle_tolerance=1e-8),
    ),
    "standard": Fidelity("standard"),
    "reference": Fidelity(
        "reference",
        mesh=Resolution(surface_m=1.2e-3, rim_m=3e-3, fine_angle_deg=40.0, growth=1.35, locked_stiffness=1.0),
        contact=ContactModel(moving=(1e7, 4e3)),
        motion=Motion(
            step_s=4e-3,
            press_step_m=0.3e-3,
            shear_step_m=0.12e-3,
            settle_steps=10,
            settle_limit=40,
            settle_speed_m_s=3e-4,
        ),
        solver=Solver(tolerance=1e-9, settle_tolerance=1e-11, iterations=3000),
    ),
}


def fidelity_named(name):
    """Return the preset Fidelity called `name`; raise TactipError that lists the presets where there is none."""
    return lookup("fidelity", name, FIDELITIES)


def finer(fidelity):
    """The Fidelity with which a contact that went wrong is tried again: half the steps' length, twice as many."""
    motion, solver = fidelity.motion, fidelity.solver
    return replace(
        fidelity,
        motion=replace(
            motion,
            step_s=max(motion.step_s / 2, SHORTEST_STEP_S),
            press_step_m=motion.press_step_m / 2,
            shear_step_m=motion.shear_step_m / 2,
            least_steps=2 * motion.least_steps,
            settle_steps=2 * motion.settle_steps,
            settle_limit=4 * motion.settle_limit,
        ),
        solver=replace(solver, tolerance=max(solver.tolerance / 10, TIGHTEST), iterations=3 * solver.iterations),
    )
