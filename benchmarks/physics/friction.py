"""Force along a slide, and the dependence of friction on the path: `tactip bench friction`.

The 127-pin tip on the flat at `standard`. Slides: the force at each step, and the force of contacts at rest. Paths: one pose
reached in different orders, loading and unloading, and work over closed cycles, with friction and without. Writes
docs/friction.md, docs/friction.json and docs/friction.png.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.benchmarks.physics.options import FrictionOptions
from tactip_twin.benchmarks.report import table, write_results
from tactip_twin.sim.contact.fidelity import FIDELITIES, Fidelity
from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.contact.simulator import ContactSimulator, motion_fractions
from tactip_twin.sim.pose import from_mm_deg, path
from tactip_twin.sim.view.plot import COLORS, figure_of, save_figure
from tactip_twin.tactip_model.presets import design_named

DEPTHS_MM = (2.0, 3.0, 4.0)
FRICTIONS = (0.3, 0.6)
SLIDE_MM = 10.0
SMALL_STEP_MM = 0.1

Position = tuple[float, float, float]
"""Position of the tip relative to the surface, mm."""

Slide = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Travel (n,), mm, and normal and tangential force (n,), N."""


class PathSimulator(ContactSimulator):
    """Simulator of a contact along waypoints, which records the force at every step."""

    def __init__(self, friction: float, fidelity: Fidelity = FIDELITIES["standard"]) -> None:
        """Build the scene of the 127-pin tip on the flat with a friction coefficient."""
        design = design_named("nominal-127")
        super().__init__(replace(design, materials=replace(design.materials, friction=friction)), "surface", fidelity)
        self.steps: list[tuple[np.ndarray, np.ndarray]] = []
        """Force (3,) N on the tip and position (3,) m of the stimulus, in the sensor frame, at each step since `begin`."""
        self._label = np.zeros(6)
        self.watch = self._append_state

    def _append_state(self, phase: str, label: np.ndarray) -> None:
        self.steps.append((self.scene.contact_force(), self.scene.data.qpos[:3].copy()))

    def begin(self, position_mm: Position = (0.0, 0.0, 0.0)) -> None:
        """Start with a tip at rest at a position, in the air or just touching."""
        self.scene.reset()
        self.steps, self._label = [], from_mm_deg([*position_mm, 0, 0, 0])

    def move_to(self, position_mm: Position) -> None:
        """Move to a position at the fidelity's speed, without settling there."""
        goal, motion = from_mm_deg([*position_mm, 0, 0, 0]), self.scene.fidelity.motion
        motion_m = goal - self._label
        step = motion.press_step_m if np.hypot(*motion_m[:2]) < abs(motion_m[2]) else motion.shear_step_m
        self.move(path(self._label, goal, motion_fractions(float(np.linalg.norm(motion_m)) / step, motion)))
        self._label = goal

    def rest(self) -> Contact:
        """Settle here, and return the contact."""
        self._settle(self._label)
        return self._record(self._label, np.zeros(6), 0)

    def rest_at(self, position_mm: Position) -> Contact:
        """Move to a position, settle, and return the contact."""
        self.move_to(position_mm)
        return self.rest()

    def visit(self, positions_mm: Iterable[Position]) -> tuple[np.ndarray, np.ndarray]:
        """Move to each position in turn, and settle at each.

        Returns:
            Forces (n, 3), N, on the tip and positions (n, 3), m, of the stimulus at rest, including the start.
        """
        states = [self.steps[-1]] if self.steps else [(np.zeros(3), self._stimulus_position(self._label))]
        for position_mm in positions_mm:
            self.rest_at(position_mm)
            states.append(self.steps[-1])
        return np.array([s[0] for s in states]), np.array([s[1] for s in states])

    @staticmethod
    def _stimulus_position(label: np.ndarray) -> np.ndarray:
        return label[:3] * [-1, 1, 1]


def work(forces: np.ndarray, positions: np.ndarray) -> float:
    """Return the work (J) of the stimulus on the tip along states at rest, by trapezoids.

    Args:
        forces: (n, 3), N.
        positions: (n, 3), m.
    """
    return float(((forces[1:] + forces[:-1]) / 2 * np.diff(positions, axis=0)).sum())


def small_steps() -> Fidelity:
    """Return `standard` with slides of SMALL_STEP_MM per step."""
    standard = FIDELITIES["standard"]
    return replace(standard, motion=replace(standard.motion, shear_step_m=SMALL_STEP_MM * 1e-3))


def slide(friction: float, depth_mm: float, fidelity: Fidelity = FIDELITIES["standard"]) -> Slide:
    """Slide by SLIDE_MM in one motion; return the state at each of its steps."""
    simulator = PathSimulator(friction, fidelity)
    simulator.begin()
    simulator.rest_at((0, 0, -depth_mm))
    simulator.steps.clear()
    simulator.move_to((SLIDE_MM, 0, -depth_mm))
    force, position = (np.array(x) for x in zip(*simulator.steps, strict=True))
    return 1e3 * np.abs(position[:, 0]), -force[:, 2], np.hypot(force[:, 0], force[:, 1])


def slide_at_rest(friction: float, depth_mm: float) -> Slide:
    """Slide by SLIDE_MM in moves of 0.5 mm, and settle after each; return the states at rest."""
    simulator = PathSimulator(friction)
    simulator.begin()
    simulator.rest_at((0, 0, -depth_mm))
    travel = np.arange(0.5, SLIDE_MM + 0.01, 0.5)
    contacts = [simulator.rest_at((x, 0, -depth_mm)) for x in travel]
    return travel, np.array([c.normal_force_n for c in contacts]), np.array([c.tangential_force_n for c in contacts])


def chatter(travel: np.ndarray, normal: np.ndarray, tangential: np.ndarray) -> dict[str, float]:
    """Return the fluctuation of the force over the second half of a slide.

    Args:
        travel: (n,), mm.
        normal: (n,), N.
        tangential: (n,), N.

    Returns:
        `deviation`, the standard deviation of the normal force over its mean; `tangential_over_normal` and `greatest`, the
        mean and the maximum of tangential over normal force where the latter is not zero.
    """
    steady = (travel > SLIDE_MM / 2) & (normal > 1e-6)
    ratio = tangential[steady] / normal[steady]
    half = normal[travel > SLIDE_MM / 2]
    return {
        "deviation": float(half.std() / half.mean()),
        "tangential_over_normal": float(ratio.mean()),
        "greatest": float(ratio.max()),
    }


def pins_apart(contact: Contact, other: Contact) -> list[float]:
    """Return the mean and the maximum distance, mm, between the pins of two contacts."""
    distance = 1e3 * np.linalg.norm(contact.pin_tips - other.pin_tips, axis=1)
    return [float(distance.mean()), float(distance.max())]


def orders(friction: float) -> dict[str, dict[str, Any]]:
    """Return the pins' distance (mean, maximum, mm) and the force ratio of one pose, 3 mm deep, reached in three orders.

    `press, then shear` shears by 3 mm, and `both at once` moves along the straight line; both are compared with `shear, then
    press`, whose shear is in the air.
    """
    simulator, goal, contacts = PathSimulator(friction), (0.0, 0.0, -3.0), {}
    for name, start, waypoints in (
        ("press, then shear", (-3.0, 0.0, 0.0), [(-3.0, 0.0, -3.0), goal]),
        ("both at once", (-3.0, 0.0, 0.0), [goal]),
        ("shear, then press", (0.0, 0.0, 0.0), [goal]),
    ):
        simulator.begin(start)
        for position_mm in waypoints:
            contacts[name] = simulator.rest_at(position_mm)
    last = contacts.pop("shear, then press")
    return {
        name: {"pins_mm": pins_apart(c, last), "force_ratio": c.normal_force_n / last.normal_force_n}
        for name, c in contacts.items()
    }


def unloading(friction: float, step_mm: float = 0.25) -> dict[str, Any]:
    """Return a press to 4 mm and back to 2 mm against one to 2 mm, and the work over the whole press and back, in steps."""
    simulator = PathSimulator(friction)
    simulator.begin()
    plain = simulator.rest_at((0, 0, -2.0))
    simulator.begin()
    simulator.rest_at((0, 0, -4.0))
    back = simulator.rest_at((0, 0, -2.0))
    simulator.begin()
    down = np.arange(step_mm, 4.01, step_mm)
    put_in = work(*simulator.visit([(0, 0, -z) for z in down]))
    given_back = -work(*simulator.visit([(0, 0, -z) for z in [*down[-2::-1], 0.0]]))
    return {
        "pins_mm": pins_apart(back, plain),
        "force_ratio": back.normal_force_n / plain.normal_force_n,
        "work_mj": 1e3 * put_in,
        "lost": 1 - given_back / put_in,
    }


def shear_cycle(friction: float, depth_mm: float = 3.0, reach_mm: float = 3.0) -> dict[str, Any]:
    """Press, then shear to one side, to the other and back to the middle, twice.

    Returns:
        `residual_mm`, the pins' distance (mean, maximum) from the plain press after the first return to the middle;
        `work_mj` of each cycle; `greatest`, the maximum of tangential over normal force at rest; `loop`, the second cycle.
    """
    simulator = PathSimulator(friction)
    simulator.begin()
    plain = simulator.rest_at((0, 0, -depth_mm))
    out = np.arange(0.5, reach_mm + 0.01, 0.5)
    there = [(x, 0, -depth_mm) for x in out]
    back = [(x, 0, -depth_mm) for x in [*out[-2::-1], 0.0]]
    first = simulator.visit(there + back)
    residual = pins_apart(simulator.rest(), plain)
    mirrored = [(-x, y, z) for x, y, z in there + back]
    second = simulator.visit(mirrored)
    third = simulator.visit(there + back + mirrored)
    forces = np.concatenate([first[0], second[0], third[0]])
    return {
        "residual_mm": residual,
        "work_mj": [1e3 * (work(*first) + work(*second)), 1e3 * work(*third)],
        "greatest": float((np.hypot(forces[:, 0], forces[:, 1]) / -forces[:, 2]).max()),
        "loop": {"x_mm": (-1e3 * third[1][:, 0]).tolist(), "force_n": (-third[0][:, 0]).tolist()},
    }


def measure() -> dict[str, Any]:
    """Return all results, for docs/friction.json."""
    slides = []
    for friction in (0.0, *FRICTIONS):
        for depth in DEPTHS_MM:
            moving, resting = slide(friction, depth), slide_at_rest(friction, depth)
            slow = slide(friction, depth, small_steps())
            row = {"friction": friction, "depth_mm": depth, "force_n": float(resting[1].mean())}
            row |= {"moving": chatter(*moving), "small_steps": chatter(*slow), "at_rest": chatter(*resting)}
            row |= {"trace": {"moving": np.array(moving).tolist(), "at_rest": np.array(resting).tolist()}}
            slides.append(row)
    both = {"without friction": 0.0, "friction 0.3": 0.3}
    return {
        "slides": slides,
        "orders": {name: orders(mu) for name, mu in both.items()},
        "unloading": {name: unloading(mu) for name, mu in both.items()},
        "shear_cycle": {name: shear_cycle(mu) for name, mu in both.items()},
    }


def run(options: FrictionOptions) -> dict[str, Any]:
    """Measure, write friction.json, friction.md and friction.png, and return the results."""
    result = measure()
    options.out.mkdir(parents=True, exist_ok=True)
    plot(result, options.out / "friction.png")
    for row in result["slides"]:
        del row["trace"]
    write_results("friction", result, tables(result), options.out)
    return result


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot the normal force along the slides, and the shear loop, into a PNG file."""
    figure, (left, right) = figure_of(1, 2, (10, 4))
    for color, row in zip(COLORS, (r for r in result["slides"] if r["friction"] == FRICTIONS[0]), strict=False):
        travel, normal, _ = row["trace"]["moving"]
        left.plot(travel, normal, "-", lw=0.8, color=color, label=f"{row['depth_mm']:g} mm deep")
        travel, normal, _ = row["trace"]["at_rest"]
        left.plot(travel, normal, "o", ms=3, color=color)
    left.set(xlabel="slide, mm", ylabel="normal force, N", title=f"Friction {FRICTIONS[0]}: moving (line), at rest (dots)")
    for color, (name, cycle) in zip(COLORS, result["shear_cycle"].items(), strict=False):
        right.plot(cycle["loop"]["x_mm"], cycle["loop"]["force_n"], ".-", color=color, label=name)
    right.set(xlabel="shear, mm", ylabel="tangential force, N", title="Second shear cycle, 3 mm deep")
    for axis in (left, right):
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=3)
    save_figure(figure, path)


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/friction.md from friction.json."""
    slides = []
    for r in result["slides"]:
        deviations = [100 * r[k]["deviation"] for k in ("moving", "small_steps", "at_rest")]
        ratios = (f"{r[k]['tangential_over_normal']:.3f} ({r[k]['greatest']:.3f})" for k in ("moving", "at_rest"))
        cells = [f"{r['friction']}", f"{r['depth_mm']:g}", f"{r['force_n']:.2f}"]
        slides.append([*cells, *(f"{d:.{n}f} %" for d, n in zip(deviations, (1, 1, 2), strict=True)), *ratios])
    head = ["friction", "depth, mm", "force, N", "moving", f"moving {SMALL_STEP_MM} mm per step", "at rest"]
    head += ["tangential / normal force, moving", "at rest"]
    orders, unloads, cycles = (list(result[name].values()) for name in ("orders", "unloading", "shear_cycle"))
    rows = [[name, *(_change(o[name]["pins_mm"], o[name]["force_ratio"]) for o in orders)] for name in orders[0]]
    rows += [
        ["press to 4 mm, back to 2 mm", *(_change(r["pins_mm"], r["force_ratio"]) for r in unloads)],
        ["work lost in press and return", *(f"{100 * r['lost']:.2f} % of {r['work_mj']:.2f} mJ" for r in unloads)],
        ["shear by 3 mm and back", *(_change(r["residual_mm"]) for r in cycles)],
        ["work of a shear cycle, first / second", *(" / ".join(f"{w:.3f}" for w in r["work_mj"]) + " mJ" for r in cycles)],
        ["tangential over normal force, maximum", *(f"{r['greatest']:.4f}" for r in cycles)],
    ]
    return {"slides": table(head, slides), "paths": table(["", *result["orders"]], rows)}


def _change(pins_mm: Sequence[float], force_ratio: float | None = None) -> str:
    """Return mean and maximum distance of pins, and a ratio of forces, as text."""
    text = f"{pins_mm[0]:.4f} / {pins_mm[1]:.4f} mm"
    return text if force_ratio is None else f"{text}, force × {force_ratio:.4f}"
