"""The pressed tip against an independent finite-element code: `tactip bench mechanics`.

A centred press on the flat without friction. It compares the force with that of benchmarks/physics/fem_axisymmetric.py,
which does not lock and whose skin is solid, for the gel alone and for the whole sensor; force and shape by Poisson's ratio
and mesh, with elements of the gel's own Poisson's ratio and with a gel that keeps its volume (sim/contact/gel_volume.py);
tilted and sheared contacts on two meshes; the effect of the skin's bending; the ripple of the force–depth curve; the loss of
volume. Writes docs/mechanics.md and docs/mechanics.json.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tactip_twin.benchmarks.physics.fem_axisymmetric import Dome, Layer
from tactip_twin.benchmarks.physics.options import MechanicsOptions
from tactip_twin.benchmarks.report import table, write_results
from tactip_twin.sim.contact.fidelity import FIDELITIES, Fidelity
from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.contact.scene import Scene
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.mesh import CONTACT_RADIUS_M, tetrahedron_volumes
from tactip_twin.tactip_model.presets import design_named

DEPTHS_MM = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0)
LOCKING_DEPTHS_MM = (1.0, 3.0, 5.0)
SHAPE_DEPTH_MM = 3.0
POISSONS = (0.45, 0.47, 0.49, 0.499)

SHEARED_CASES = 8
"""Number of tilted and sheared contacts."""

TIMED_REPEATS = 3
"""Number of times that each of them is timed."""


class Expected:
    """Forces and shapes of one tip by the independent code."""

    def __init__(self, design: Design, what: str, poisson: float, log: Callable[[str], None] = print) -> None:
        """Solve at DEPTHS_MM.

        Args:
            design: The tip.
            what: `gel` or `sensor`.
            poisson: Poisson's ratio of the gel, -.
            log: Called with a line for each step size that does not converge.

        Raises:
            ArithmeticError: No step size converges.
        """
        m, r = design.materials, design.shape.radius_m
        gel, t = (m.gel_young_pa, poisson), m.skin_thickness_m
        layers = {
            "gel": [Layer(r - 2 * CONTACT_RADIUS_M, *gel, 12), Layer(r, *gel, 1)],
            "sensor": [Layer(r - t, *gel, 12), Layer(r, m.skin_young_pa, m.skin_poisson, round(t / 2 / CONTACT_RADIUS_M))],
        }
        dome, steps = Dome(layers[what], polar_elements=40), _pressed(layers[what], log)
        # Nodes at the simulator's surface vertices; not all points of the grid are nodes of elements.
        used = np.unique(dome.elements)
        nodes = used[np.isclose(np.linalg.norm(dome.nodes[used], axis=1), r - CONTACT_RADIUS_M, rtol=1e-6)]
        polar = np.arctan2(*dome.nodes[nodes].T)
        order = np.argsort(polar)
        self._polar = polar[order]
        self._force = {depth: force for depth, (force, _) in steps.items()}
        self._moved = {depth: u[nodes[order]] for depth, (_, u) in steps.items()}

    def force(self, depth_mm: float) -> float:
        """Return the force, N, at one of DEPTHS_MM."""
        return self._force[depth_mm]

    def shape_error(self, scene: Scene, depth_mm: float) -> list[float]:
        """Return the rms and the maximum distance, mm, of the scene's skin vertices from their expected positions."""
        count = scene.mesh.surface_count
        rest = scene.mesh.vertices[:count] - scene.mesh.centre
        moved = scene.vertices()[:count] - scene.mesh.vertices[:count]
        radius = np.hypot(rest[:, 0], rest[:, 1])
        outward = rest[:, :2] / np.maximum(radius, 1e-9)[:, None]
        u_r, u_z = (np.interp(np.arctan2(radius, rest[:, 2]), self._polar, u) for u in self._moved[depth_mm].T)
        error = 1e3 * np.linalg.norm(moved - np.column_stack([outward * u_r[:, None], u_z]), axis=1)
        return [float(np.sqrt(np.mean(error**2))), float(error.max())]


def _pressed(layers: Sequence[Layer], log: Callable[[str], None]) -> dict[float, tuple[float, np.ndarray]]:
    """Return force (N) and displacements (n, 2) m at DEPTHS_MM, by the largest step size that converges."""
    for step in (0.25, 0.125, 0.0625):
        depths = np.arange(step, max(DEPTHS_MM) + step / 2, step)
        try:
            steps = list(Dome(layers, polar_elements=40).press(depths * 1e-3))
        except ArithmeticError as error:
            log(f"steps of {step} mm: {error}")
            continue
        return {depth: state for depth, state in zip(depths.tolist(), steps, strict=True) if depth in DEPTHS_MM}
    raise ArithmeticError("the reference solution needs smaller steps than tried")


def press(simulator: ContactSimulator, depth_mm: float) -> Contact:
    """Press the centre."""
    return simulator.simulate(from_mm_deg([0, 0, -depth_mm, 0, 0, 0]), np.zeros(6))


def frictionless(what: str, poisson: float | None = None) -> Design:
    """Return the 127-pin tip without friction.

    Args:
        what: `gel` for the gel alone, or `sensor`.
        poisson: Poisson's ratio of the gel, -; the design's by default.
    """
    design = design_named("nominal-127")
    m = replace(design.materials, friction=0.0)
    if what == "gel":
        m = replace(m, skin_young_pa=1.0)  # a skin of 1 Pa is none
    return replace(design, materials=replace(m, gel_poisson=m.gel_poisson if poisson is None else poisson))


def meshes() -> dict[str, Fidelity]:
    """Return the meshes of the presets by name, all with the steps of `standard`."""
    standard = FIDELITIES["standard"]
    return {name: replace(standard, mesh=FIDELITIES[name].mesh) for name in ("draft", "standard", "reference")}


def locking_elements(fidelity: Fidelity) -> Fidelity:
    """Return the fidelity whose elements have the gel's own Poisson's ratio."""
    return replace(fidelity, mesh=replace(fidelity.mesh, poisson_limit=0.5))


def against_depth(expected: Mapping[str, Expected], log: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return the force ratios at DEPTHS_MM on the meshes of the presets, and with elements that lock.

    Args:
        expected: Solutions for `gel` and `sensor`.
        log: Called with each row.
    """
    standard, rows = FIDELITIES["standard"], []
    cases = {"standard, elements of 0.49": locking_elements(standard)} | meshes()
    for what in expected:
        for name, fidelity in cases.items():
            simulator = ContactSimulator(frictionless(what), "surface", fidelity)
            ratios = [press(simulator, d).normal_force_n / expected[what].force(d) for d in DEPTHS_MM]
            lost = 1 - tetrahedron_volumes(simulator.scene.vertices(), simulator.scene.mesh.tetrahedra).sum() / (
                simulator.scene.mesh.volumes.sum()
            )
            rows.append({"tip": what, "mesh": name, "force_ratio": ratios, "volume_lost_at_5_mm": float(lost)})
            log(json.dumps(rows[-1]))
    return rows


def locking(known: Mapping[str, Expected], log: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return force and shape over POISSONS for the sensor at `standard`, and over meshes for both tips at the design's own.

    Args:
        known: Solutions for `gel` and `sensor` at the design's own Poisson's ratio.
        log: Called with each row.
    """
    rows, own = [], design_named("nominal-127").materials.gel_poisson
    for what in ("gel", "sensor"):
        for poisson in POISSONS if what == "sensor" else (own,):
            expected = known[what] if poisson == own else Expected(design_named("nominal-127"), what, poisson, log)
            for name, fidelity in meshes().items():
                if poisson != own and name != "standard":
                    continue
                variants = {"the gel's": locking_elements(fidelity), f"{fidelity.mesh.poisson_limit:.2f}": fidelity}
                for elements, changed in variants.items():
                    simulator = ContactSimulator(frictionless(what, poisson), "surface", changed)
                    row = {"tip": what, "poisson": poisson, "mesh": name, "elements": elements, "force_ratio": []}
                    for depth in LOCKING_DEPTHS_MM:
                        row["force_ratio"].append(press(simulator, depth).normal_force_n / expected.force(depth))
                        if depth == SHAPE_DEPTH_MM:
                            row["shape_mm"] = expected.shape_error(simulator.scene, depth)
                    rows.append(row)
                    log(json.dumps(row))
    return rows


def sheared(log: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return, for each task, how far tilted and sheared contacts at `standard` are from those at `reference`, and what
    keeping the gel's volume costs; `log` gets each row.

    Both meshes have the steps of their own preset. The cost is the median ratio of the process times of the same contacts,
    taken in turn, with a gel of 0.49 and with one of its elements' Poisson's ratio, whose volume has no row.
    """
    design, rows = design_named("nominal-127"), []
    poisson = FIDELITIES["standard"].mesh.poisson_limit
    plain = replace(design, materials=replace(design.materials, gel_poisson=poisson))
    for task, wide in (("surface", 0.0), ("edge", 1.0)):
        rng = np.random.default_rng(0)
        cases = []
        for _ in range(SHEARED_CASES):
            depth, (roll, pitch), x, yaw = (
                -rng.uniform(1, 5),
                rng.uniform(-10, 10, 2),
                rng.uniform(-4, 4),
                rng.uniform(-45, 45),
            )
            shear = [*rng.uniform(-5, 5, 2), 0, *rng.uniform(-5, 5, 3)]
            cases.append((from_mm_deg([wide * x, 0, depth, roll, pitch, wide * yaw]), from_mm_deg(shear)))
        coarse, fine = (ContactSimulator(design, task, FIDELITIES[mesh]) for mesh in ("standard", "reference"))
        without = ContactSimulator(plain, task, FIDELITIES["standard"])
        pins, forces = [], []
        for case in cases:
            ours, finer = coarse.simulate(*case), fine.simulate(*case)
            pins.append(1e3 * np.linalg.norm(ours.pin_tips - finer.pin_tips, axis=1))
            forces.append(abs(ours.normal_force_n / finer.normal_force_n - 1))
        ratios = [_process_s(coarse, case) / _process_s(without, case) for _ in range(TIMED_REPEATS) for case in cases]
        row = {"task": task, "pins_mm": float(np.mean(pins)), "time_ratio": float(np.median(ratios))}
        row |= {"worst_contact_mm": float(np.mean(pins, axis=1).max()), "force": float(np.median(forces))}
        rows.append(row)
        log(json.dumps(row))
    return rows


def _process_s(simulator: ContactSimulator, case: tuple[np.ndarray, np.ndarray]) -> float:
    """Return the process time of a contact, s."""
    start = time.process_time()
    simulator.simulate(*case)
    return time.process_time() - start


def bending(expected: Expected, log: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return force and shape of the sensor at `standard` with the skin's bending scaled; `log` gets each row."""
    rows = []
    for factor in (0.0, 1.0, 2.0):
        simulator = ContactSimulator(frictionless("sensor"), "surface", FIDELITIES["standard"])
        simulator.scene.model.flex_bending[:] *= factor
        row = {"bending": factor, "force_ratio": []}
        for depth in DEPTHS_MM:
            row["force_ratio"].append(press(simulator, depth).normal_force_n / expected.force(depth))
            if depth == SHAPE_DEPTH_MM:
                row["shape_mm"] = expected.shape_error(simulator.scene, depth)
        rows.append(row)
        log(json.dumps(row))
    return rows


def ripple() -> float:
    """Return the maximum relative distance of forces every 0.1 mm from a smooth curve, at `standard` with friction."""
    simulator = ContactSimulator(design_named("nominal-127"), "surface", FIDELITIES["standard"])
    depth = np.arange(0.5, 5.01, 0.1)
    force = np.array([press(simulator, d).normal_force_n for d in depth])
    smooth = np.exp(np.polyval(np.polyfit(np.log(depth), np.log(force), 3), np.log(depth)))
    return float(np.abs(force / smooth - 1).max())


def run(options: MechanicsOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure, write mechanics.json and mechanics.md, and return the results. Progress goes to `log`."""
    design = design_named("nominal-127")
    expected = {what: Expected(design, what, design.materials.gel_poisson, log) for what in ("gel", "sensor")}
    result = {
        "depths_mm": DEPTHS_MM,
        "independent_force_n": {what: [e.force(d) for d in DEPTHS_MM] for what, e in expected.items()},
        "rows": against_depth(expected, log),
        "locking": locking(expected, log),
        "sheared": sheared(log),
        "bending": bending(expected["sensor"], log),
        "ripple": ripple(),
    }
    write_results("mechanics", result, tables(result), options.out)
    return result


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/mechanics.md from mechanics.json."""
    head = [f"{d:g} mm" for d in result["depths_mm"]]
    forces = [
        [name, "*reference code, N*", *(f"*{f:.3f}*" for f in values), ""]
        for name, values in result["independent_force_n"].items()
    ]
    ratios = [
        [r["tip"], r["mesh"], *(f"{x:.2f}" for x in r["force_ratio"]), f"{100 * r['volume_lost_at_5_mm']:.1f} %"]
        for r in result["rows"]
    ]
    shape = f"shape at {SHAPE_DEPTH_MM:g} mm: rms / maximum, mm"
    locked = [
        [r["tip"], r["poisson"], r["mesh"], r["elements"], *(f"{x:.2f}" for x in r["force_ratio"]), _shape(r["shape_mm"])]
        for r in result["locking"]
    ]
    moved = [
        [
            r["task"],
            f"{r['pins_mm']:.3f}",
            f"{r['worst_contact_mm']:.3f}",
            f"{100 * r['force']:.1f} %",
            f"{r['time_ratio']:.2f}",
        ]
        for r in result["sheared"]
    ]
    moved_head = ["task", "pins, mean mm", "worst contact, mean mm", "force, median", "time ratio"]
    bent = [[f"{r['bending']:g}", *(f"{x:.2f}" for x in r["force_ratio"]), _shape(r["shape_mm"])] for r in result["bending"]]
    depths = [f"{d:g} mm" for d in LOCKING_DEPTHS_MM]
    return {
        "forces": table(["tip", "mesh", *head, "volume lost at 5 mm"], [*forces, *ratios]),
        "ripple": f"Maximum distance of the force from a smooth curve: {100 * result['ripple']:.1f} %.",
        "locking": table(["tip", "Poisson's ratio", "mesh", "that of elements", *depths, shape], locked),
        "sheared": table(moved_head, moved),
        "bending": table(["factor", *head, shape], bent),
    }


def _shape(errors_mm: Sequence[float]) -> str:
    return " / ".join(f"{x:.3f}" for x in errors_mm)
