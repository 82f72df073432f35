"""Cost of each part of the data-set scene: `tactip bench scene-cost`.

Simulates the first contacts of the training sets at `standard`, and right after each the same contact without one part, to
measure the time saved and the effect on the pins. Also measures the time of a contact by MuJoCo function. Writes
docs/scene_cost.md and docs/scene_cost.json.
"""

import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, TypeVar
from unittest import mock

import mujoco
import numpy as np
from tqdm import tqdm

import tactip_twin.sim.contact.scene
from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.physics.contact_cache import DESIGN, STANDARD, UncorrectedSimulator, timed
from tactip_twin.benchmarks.physics.contact_cases import Case, training
from tactip_twin.benchmarks.physics.options import SceneCostOptions
from tactip_twin.benchmarks.report import table, write_results
from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.labels import TASKS
from tactip_twin.tactip_model import soft_body as body
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.soft_body import TOUCHES_VERTICES, skin_attributes

T = TypeVar("T")

MakeSimulator = Callable[[str], ContactSimulator]
"""Maker of a simulator for the contacts of a task."""

STRETCHING_ALONE = 2
NOTHING = 0
"""Values of MjsFlex.elastic2d."""

AWAY_MM = -15.0
"""Position along x at which the tip touches only the flat top of the edge's block, mm."""


def _with_skin(**changes: int) -> MakeSimulator:
    """Return a maker of simulators whose skin has other attributes of its flex."""

    def make(task: str) -> ContactSimulator:
        with mock.patch.object(body, "skin_attributes", lambda materials: skin_attributes(materials) | changes):
            return _simulator(task)

    return make


def _simulator(task: str, **materials: float) -> ContactSimulator:
    design = design_named(DESIGN)
    design = replace(design, materials=replace(design.materials, **materials))
    return ContactSimulator(design, task, STANDARD.fidelity)


def _without_facet_contact(task: str) -> ContactSimulator:
    """Return a simulator without contact between stimulus and the skin's facets."""
    simulator = _simulator(task)
    model = simulator.scene.model
    model.geom_conaffinity[model.geom_bodyid == model.body("stimulus").id] &= TOUCHES_VERTICES
    return simulator


def _without_volume(task: str) -> ContactSimulator:
    """Return a simulator without the row that keeps the gel's volume."""
    simulator = _simulator(task)
    simulator.scene.model.eq_active0[:] = 0
    simulator.scene._volume = None  # pyright: ignore[reportPrivateUsage]
    return simulator


def _with_plain_steps(task: str) -> ContactSimulator:
    """Return a simulator that steps by mujoco.mj_step, with contacts that begin where they touch, and without volume row."""
    simulator = _without_volume(task)
    scene = simulator.scene
    scene.model.geom_margin[:] = 0
    scene.step = lambda: mujoco.mj_step(scene.model, scene.data)
    return simulator


PARTS: dict[str, MakeSimulator] = {
    "nothing (repeated contact)": _simulator,
    "bending of the skin": _with_skin(elastic2d=STRETCHING_ALONE),
    "the skin's stretching and bending": _with_skin(elastic2d=NOTHING),
    "friction": lambda task: _simulator(task, friction=0.0),
    "contact of the skin's facets": _without_facet_contact,
    "De Saxcé correction": lambda task: UncorrectedSimulator(design_named(DESIGN), task, STANDARD.fidelity),
    "the gel's volume": _without_volume,
    "`Scene.step` and the gel's volume (`mujoco.mj_step` instead)": _with_plain_steps,
}
"""Makers of a simulator without a part, by the part. The gel cannot be left out."""


def side_by_side(
    pairs: Iterable[tuple[tuple[ContactSimulator, Case], tuple[ContactSimulator, Case]]],
) -> tuple[float, float]:
    """Return the median ratio of CPU times and the mean distance of pins, mm, over pairs of contacts."""
    ratios, apart = [], []
    for first, second in pairs:
        (a, a_s), (b, b_s) = timed(first[0], *first[1].si()), timed(second[0], *second[1].si())
        ratios.append(b_s / a_s)
        apart.append(np.linalg.norm(a.pin_tips - b.pin_tips, axis=1).mean())
    return float(np.median(ratios)), float(1e3 * np.mean(apart))


def parts(task: str, count: int, step: Callable[[], object]) -> list[dict[str, Any]]:
    """Return the savings from leaving out each of PARTS.

    Args:
        task: Task of the contacts.
        count: Number of contacts.
        step: Called after each part.
    """
    whole, rows = _simulator(task), []
    for what, make in PARTS.items():
        without = make(task)
        cost, pins = side_by_side(((whole, case), (without, case)) for case in training(task, count))
        rows.append({"task": task, "without": what, "cost": cost, "pins_mm": pins})
        step()
    return rows


def edge_against_plane(count: int) -> dict[str, float]:
    """Return the cost of the edge's block relative to the flat surface, for the same contacts on its top and at its edge."""
    flat, block = _simulator("surface"), _simulator("edge")
    cases = [(case, Case(case.name, "edge", (AWAY_MM, *case.pose_mm_deg[1:]), case.shear_mm_deg)) for case in _level(count)]
    cost, pins = side_by_side(((flat, a), (block, b)) for a, b in cases)
    at_edge, _ = side_by_side(((flat, a), (block, a)) for a, _ in cases)
    return {"on_top": cost, "on_top_pins_mm": pins, "at_its_edge": at_edge}


def _level(count: int) -> list[Case]:
    """Return contacts of the surface's training set without shear along x, so they stay on the block's top."""
    return [replace(case, shear_mm_deg=(0.0, *case.shear_mm_deg[1:])) for case in training("surface", count)]


class _TimedCalls:
    """MuJoCo's module, with the total CPU time of each function."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    def __getattr__(self, name: str) -> Any:
        value = getattr(mujoco, name)
        if not name.startswith("mj_"):
            return value

        def timed_call(*arguments: object) -> object:
            start = time.process_time()
            try:
                return value(*arguments)
            finally:
                self.seconds[name] += time.process_time() - start

        return timed_call


class _TimedSimulator(ContactSimulator):
    """Simulator that adds up the CPU time of its records."""

    recording = 0.0

    def _record(self, pose: np.ndarray, shear: np.ndarray, warnings: int, label: np.ndarray | None = None) -> Contact:
        start = time.process_time()
        try:
            return super()._record(pose, shear, warnings, label)
        finally:
            self.recording += time.process_time() - start


CALLS = {
    "mj_fwdPosition": "stiffness matrices, collisions, contact rows",
    "mj_forwardSkip": "forces of gel and skin",
    "mj_fwdConstraint": "solver",
    "mj_mulJacVec": "De Saxcé correction",
    "mj_integratePos": "new positions",
    "mj_step": "mj_step",
    "mj_resetData": "reset",
}
"""Purposes of the MuJoCo functions that Scene calls."""


def time_fractions(task: str, count: int) -> dict[str, float]:
    """Return the fractions of the CPU time of `count` contacts by purpose."""
    calls = _TimedCalls()
    simulator = _TimedSimulator(design_named(DESIGN), task, STANDARD.fidelity)
    with mock.patch.object(tactip_twin.sim.contact.scene, "mujoco", calls):
        total = sum(timed(simulator, *case.si())[1] for case in training(task, count))
    fractions = {CALLS.get(name, name): s / total for name, s in calls.seconds.items()}
    fractions["recording"] = simulator.recording / total
    return fractions | {"other (path, step control, Python)": 1 - sum(fractions.values())}


def run(options: SceneCostOptions) -> dict[str, Any]:
    """Measure, write scene_cost.json and scene_cost.md, and return the results. Raises TactipError and OSError."""
    with tqdm(total=len(TASKS) * (len(PARTS) + 1) + 1, unit="part", file=sys.stderr) as bar:
        result = {
            "contacts_per_task": options.contacts,
            "machine": machine(),
            "parts": [],
            "split": {},
        }
        for task in TASKS:
            result["parts"] += parts(task, options.contacts, bar.update)
            result["split"][task] = time_fractions(task, options.contacts)
            bar.update()
        result["edge"] = edge_against_plane(options.contacts)
        bar.update()
    write_results("scene_cost", result, tables(result), options.out)
    return result


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/scene_cost.md from scene_cost.json."""
    by, edge = {(r["task"], r["without"]): r for r in result["parts"]}, result["edge"]
    rows = [
        [what, *(f"{by[t, what]['cost']:.2f}" for t in TASKS), *(f"{by[t, what]['pins_mm']:.3f}" for t in TASKS)]
        for what in PARTS
    ]
    head = ["without", *(f"{t}: cost" for t in TASKS), *(f"{t}: change of pins, mm" for t in TASKS)]
    state = (
        f"Machine: {machine_text(result['machine'])}. Settings: first {result['contacts_per_task']} contacts of each task."
    )
    split = result["split"]
    largest_first = sorted(split["surface"], key=lambda part: split["surface"][part], reverse=True)
    times = [[part, *(f"{100 * split[t].get(part, 0.0):.1f} %" for t in TASKS)] for part in largest_first]
    block = [
        ["away from the edge", f"{edge['on_top']:.2f}", f"{edge['on_top_pins_mm']:.4f}"],
        ["at the edge", f"{edge['at_its_edge']:.2f}", ""],
    ]
    return {
        "parts": table(head, rows) + "\n\n" + state,
        "block": table(["contacts on the edge's block", "cost relative to the flat surface", "change of pins, mm"], block),
        "time": table(["part of a contact", *TASKS], times),
    }
