"""Presets of accuracy against run time.

docs/fidelity.md has their errors and costs, measured by `tactip bench fidelity`, and the machine they were measured on.
"""

from dataclasses import dataclass, field, replace

from tactip_twin.sim.labels import FidelityName
from tactip_twin.tactip_model.bounds import check, require, within
from tactip_twin.tactip_model.errors import lookup
from tactip_twin.tactip_model.mesh import Resolution
from tactip_twin.tactip_model.soft_body import ContactModel

MIN_STEP_S = 0.05e-3
"""Shortest time step, s. The shortest in docs/stability.md is 0.2 ms, and a retry halves it twice."""

MIN_TOLERANCE = 1e-14
"""Smallest relative tolerance of the solver, -; below it is rounding error."""

MAX_APPROACH_SPEED_M_S = 0.5
"""Highest mean speed of an approach, m/s."""

MAX_SHEAR_SPEED_M_S = 0.15
"""Highest mean speed of a shear, m/s. Above it, damping holds the skin back and the result depends on the speed."""


@dataclass(frozen=True)
class Motion:
    """Time steps, speeds, and the criterion for a tip at rest."""

    step_s: float = within(MIN_STEP_S, 20e-3, default=0.007)
    """Time step, s. The integrator is implicit and stable from 0.2 ms to 20 ms."""
    press_step_m: float = within(1e-7, 10e-3, default=1.2e-3)
    """Mean approach per step, m."""
    shear_step_m: float = within(1e-7, 10e-3, default=0.4e-3)
    """Mean travel of the skin per step of the shear, m."""
    min_steps: int = within(1, 100000, default=4)
    """Minimum number of steps of a motion."""
    ease_in: float = within(0, 5, default=0.5)
    """Exponent of the speed at the start of a motion, -: speed ~ t^ease_in (1 - t)^ease_out, t from 0 to 1. At 0 the motion
    starts with a jerk, which throws the tip off the surface."""
    ease_out: float = within(0, 5, default=1.5)
    """Exponent of the speed at the end of a motion, -. After a jerk the skin oscillates and friction lets go."""
    settle_steps: int = within(1, 100000, default=4)
    """Minimum number of steps at rest before recording."""
    settle_speed_m_s: float = within(1e-6, 20e-3, default=2e-3)
    """Maximum vertex speed of a tip at rest, m/s; settling continues until it is reached ..."""
    settle_limit: int = within(1, 100000, default=20)
    """... or for this number of steps."""

    def __post_init__(self) -> None:
        check(self)
        for name, speed in (("press_step_m", MAX_APPROACH_SPEED_M_S), ("shear_step_m", MAX_SHEAR_SPEED_M_S)):
            step, max_step = getattr(self, name), speed * self.step_s
            require(step <= max_step * (1 + 1e-9), name, step, f"at most {speed} m/s times step_s, {max_step:g} m")
        require(self.settle_limit >= self.settle_steps, "settle_limit", self.settle_limit, "at least settle_steps")

    @property
    def pause_steps(self) -> int:
        """Steps at rest between the motions of a tip that stays in contact: half of `settle_steps`. All of them cost a fifth
        more time in a servo, with the same errors on the bust and a tenth less along a rim [M] (docs/servo.md)."""
        return -(-self.settle_steps // 2)


@dataclass(frozen=True)
class Solver:
    """Settings of MuJoCo's conjugate-gradient solver."""

    iterations: int = within(100, 1000000, default=1000)
    """Maximum number of iterations per step."""
    tolerance: float = within(MIN_TOLERANCE, 1e-5, default=1e-7)
    """Relative tolerance while the stimulus moves, -; relative to the vertices' mass alone (sim/contact/scene.py)."""
    settle_tolerance: float = within(MIN_TOLERANCE, 1e-5, default=1e-9)
    """Relative tolerance at rest, -. At a looser one the tip keeps trembling (its force by 3 % at 1e-7 and 0.3 % at 1e-9, at
    0.5 mm depth). It costs little because a tip at rest needs few iterations."""
    impratio: float = within(0.1, 1000, default=3.0)
    """Ratio of frictional to normal impedance, -; a higher one reduces creep."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Fidelity:
    """All settings that trade accuracy for run time."""

    name: str
    """Name of the preset, also after changes to it."""
    mesh: Resolution = field(default_factory=Resolution)
    """Resolution of the tip's mesh."""
    contact: ContactModel = field(default_factory=ContactModel)
    """Contact model."""
    motion: Motion = field(default_factory=Motion)
    """Time steps and speeds."""
    solver: Solver = field(default_factory=Solver)
    """Solver iterations and tolerances."""


FIDELITIES: dict[FidelityName, Fidelity] = {
    "draft": Fidelity(
        "draft",
        mesh=Resolution(surface_m=3.2e-3, rim_m=5e-3, fine_angle_deg=40.0, growth=1.35, poisson_limit=0.40),
        contact=ContactModel(vertex_mass_kg=5e-5),
        motion=Motion(press_step_m=1.6e-3, shear_step_m=1e-3, settle_steps=3),
        solver=Solver(tolerance=1e-6, settle_tolerance=1e-8),
    ),
    "standard": Fidelity("standard"),
    "reference": Fidelity(
        "reference",
        mesh=Resolution(surface_m=1.2e-3, rim_m=3e-3, fine_angle_deg=40.0, growth=1.35, poisson_limit=0.45),
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
"""Presets by name."""


def fidelity_named(name: str) -> Fidelity:
    """Return the preset with a name; raise TactipError, which lists the presets, on an unknown one."""
    return lookup("fidelity", name, FIDELITIES)


def is_coarse(fidelity: Fidelity) -> bool:
    """Return whether the mesh of a fidelity is coarser than that of `standard`."""
    return fidelity.mesh.surface_m > FIDELITIES["standard"].mesh.surface_m


def finer(fidelity: Fidelity) -> Fidelity:
    """Return the fidelity of the next try of a contact that failed its checks: twice as many steps of half the length."""
    motion, solver = fidelity.motion, fidelity.solver
    return replace(
        fidelity,
        motion=replace(
            motion,
            step_s=max(motion.step_s / 2, MIN_STEP_S),
            press_step_m=motion.press_step_m / 2,
            shear_step_m=motion.shear_step_m / 2,
            min_steps=2 * motion.min_steps,
            settle_steps=2 * motion.settle_steps,
            settle_limit=4 * motion.settle_limit,
        ),
        solver=replace(solver, tolerance=max(solver.tolerance / 10, MIN_TOLERANCE), iterations=3 * solver.iterations),
    )
