"""Cost of each part of the data-set scene, and an inventory of the scene: `tactip bench scene-cost`.

Simulates the first contacts of the training sets at `standard`, and right after each the same contact without one part: the
time that this saves, and its effect on the pins. Also measures the time of a contact by MuJoCo's functions, and the cost of
a sample besides its contact, and lists what the compiled scene contains. Writes docs/scene_cost.md and docs/scene_cost.json.
"""

import json
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
from tactip_twin.benchmarks.options import SceneCostOptions
from tactip_twin.benchmarks.physics.contact_cache import DESIGN, STANDARD, UncorrectedSimulator, timed
from tactip_twin.benchmarks.physics.contact_cases import Case, training
from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.contact.scene import Scene
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.format import encode_image
from tactip_twin.sim.labels import TASKS
from tactip_twin.tactip_model import soft_body as body
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.pyrender_renderer import PinCamera
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.soft_body import TOUCHES_VERTICES, skin_attributes
from tactip_twin.tactip_model.tactile_image import tactile_image

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


def _with_plain_steps(task: str) -> ContactSimulator:
    """Return a simulator that steps by mujoco.mj_step, with contacts that begin where they touch."""
    simulator = _simulator(task)
    scene = simulator.scene
    scene.model.geom_margin[:] = 0
    scene.step = lambda: mujoco.mj_step(scene.model, scene.data)
    return simulator


PARTS: dict[str, MakeSimulator] = {
    "nothing (the same twice)": _simulator,
    "the skin's bending": _with_skin(elastic2d=STRETCHING_ALONE),
    "the skin, stretching and bending": _with_skin(elastic2d=NOTHING),
    "friction": lambda task: _simulator(task, friction=0.0),
    "contact of the skin's facets": _without_facet_contact,
    "the correction for sliding skin": lambda task: UncorrectedSimulator(design_named(DESIGN), task, STANDARD.fidelity),
    "Scene.step (mujoco.mj_step in its place)": _with_plain_steps,
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
    """Return what leaving out each of PARTS saves.

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
    "mj_fwdPosition": "stiffness for the implicit step, collisions, contact rows",
    "mj_forwardSkip": "forces of gel and skin",
    "mj_fwdConstraint": "solver",
    "mj_mulJacVec": "correction for sliding skin",
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
    return fractions | {"the rest (path, pace, Python)": 1 - sum(fractions.values())}


def position_stage(task: str) -> dict[str, float]:
    """Return the parts of mj_fwdPosition, CPU ms per call, in the state of the task's first contact.

    With explicit steps MuJoCo leaves out only the matrix of the implicit step, so the difference is the matrix's.
    """
    simulator = _simulator(task)
    simulator.simulate(*training(task, 1)[0].si())
    model, data = simulator.scene.model, simulator.scene.data

    def milliseconds(function: Callable[[mujoco.MjModel, mujoco.MjData], object]) -> float:
        took = []
        for _ in range(20):
            start = time.process_time()
            function(model, data)
            took.append(1e3 * (time.process_time() - start))
        return float(np.median(took))

    whole = milliseconds(mujoco.mj_fwdPosition)
    collisions, rows = milliseconds(mujoco.mj_collision), milliseconds(mujoco.mj_makeConstraint)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    explicit = milliseconds(mujoco.mj_fwdPosition)
    return {
        "stiffness of gel and skin for the implicit step": whole - explicit,
        "collisions": collisions,
        "contact rows": rows,
        "vertices, and the rest": explicit - collisions - rows,
    }


def sample_costs(task: str, count: int) -> dict[str, float]:
    """Return the median CPU times of a sample, ms: of its contact, and of everything besides it."""
    design, simulator = design_named(DESIGN), _simulator(task)
    renderers = {"image by pyrender": PinCamera(design), "image by raster": Raster(design)}
    out: dict[str, list[float]] = {"contact": []}

    def measured(what: str, function: Callable[[], T]) -> T:
        start = time.process_time()
        result = function()
        out.setdefault(what, []).append(1e3 * (time.process_time() - start))
        return result

    for case in training(task, count):
        contact = measured("contact", lambda case=case: simulator.simulate(*case.si()))
        frames = [measured(what, lambda r=r, c=contact: r.render(c.pin_tips, c.directions)) for what, r in renderers.items()]
        image = measured("threshold", lambda f=frames[-1]: tactile_image(f, design.image))
        measured("PNG", lambda i=image: encode_image(i))
    return {what: float(np.median(ms[1:])) for what, ms in out.items()}  # the first of each warms up


def inventory(scene: Scene) -> list[tuple[str, int, int, str]]:
    """Return what a compiled scene contains: rows of a name, the number, the number that is needed, and its purpose."""
    model, mesh = scene.model, scene.mesh
    free = int((~mesh.bonded).sum())
    skin = int((~mesh.bonded[: mesh.surface_count]).sum())
    hulls = len(set(model.geom_dataid[model.geom_type == mujoco.mjtGeom.mjGEOM_MESH].tolist()))
    of_stimulus = int((model.geom_bodyid == model.body("stimulus").id).sum())
    needed = {
        "nbody": (3 + free, "world, stimulus, tip, and one for each free vertex"),
        "njnt": (1 + 3 * free, "the stimulus's free joint, three slides a free vertex"),
        "nv": (6 + 3 * free, "their degrees of freedom"),
        "ngeom": (1 + skin, "the stimulus, and a sphere for each free skin vertex"),
        "nflex": (2, "gel and skin"),
        "nmesh": (hulls, "the stimulus's shape, where that is a hull"),
    }
    rows = [(name, int(getattr(model, name)), *what) for name, what in needed.items()]
    rows.append(("geoms of the stimulus", of_stimulus, 1, "one shape"))
    nothing = "nu nsensor ncam nlight ntex nmat neq ntendon nmocap nsite nskin nhfield nplugin npair nexclude nkey nuserdata"
    rows += [(name, int(getattr(model, name)), 0, "none") for name in nothing.split() if hasattr(model, name)]
    touching = (model.geom_contype | model.geom_conaffinity) == 0
    rows.append(("geoms that touch nothing", int(touching.sum()), 0, "none"))
    rows.append(("flexes that touch", int((model.flex_contype | model.flex_conaffinity > 0).sum()), 1, "the skin"))
    return rows


def run(options: SceneCostOptions) -> dict[str, Any]:
    """Measure, write scene_cost.json and scene_cost.md, and return the results. Raises TactipError and OSError."""
    with tqdm(total=len(TASKS) * (len(PARTS) + 2) + 1, unit="part", file=sys.stderr) as bar:
        result = {
            "contacts_a_task": options.contacts,
            "machine": machine(),
            "parts": [],
            "split": {},
            "stage": {},
            "beside": {},
        }
        for task in TASKS:
            result["parts"] += parts(task, options.contacts, bar.update)
            result["split"][task] = time_fractions(task, options.contacts)
            result["stage"][task] = position_stage(task)
            result["beside"][task] = sample_costs(task, options.contacts)
            bar.update(2)
        result["edge"] = edge_against_plane(options.contacts)
        bar.update()
    result["inventory"] = {task: [list(row) for row in inventory(_simulator(task).scene)] for task in TASKS}
    options.out.mkdir(parents=True, exist_ok=True)
    write_file(options.out / "scene_cost.json", (json.dumps(result, indent=1) + "\n").encode())
    write_file(options.out / "scene_cost.md", markdown(result).encode())
    return result


def markdown(result: dict[str, Any]) -> str:
    """Return the page of a result."""
    lines = [
        "# What a scene does not need",
        "",
        "Written by `tactip bench scene-cost`; do not edit. The first "
        f"{result['contacts_a_task']} contacts of each training set of seed 0 at `standard`, 127-pin tip, one core of: "
        + machine_text(result["machine"])
        + ".",
        "",
        "## What it saves to leave a part out",
        "",
        "CPU time of a contact without the part over that of the same contact with it, played one right after the other "
        "(median), and how far the pins are apart then (mean). More than 1: without it the solver has a harder time.",
        "",
        "| without | surface: cost | pins, mm | edge: cost | pins, mm |",
        "|---|---|---|---|---|",
    ]
    by = {(r["task"], r["without"]): r for r in result["parts"]}
    for what in PARTS:
        cells = [f"{by[t, what]['cost']:.2f} | {by[t, what]['pins_mm']:.3f}" for t in TASKS]
        lines.append(f"| {what} | {' | '.join(cells)} |")
    edge = result["edge"]
    lines += [
        "",
        f"The edge's block in place of the flat surface: the same contacts on its top, away from the edge, cost "
        f"{edge['on_top']:.2f} times as much (pins {edge['on_top_pins_mm']:.4f} mm apart); across its edge, "
        f"{edge['at_its_edge']:.2f} times. Hence the flat surface is a plate of its own that the skin's facets do not meet.",
        "",
        "## Where the time of a contact goes",
        "",
        "| | " + " | ".join(TASKS) + " |",
        "|---|" + "---|" * len(TASKS),
    ]
    for what in sorted(result["split"]["surface"], key=result["split"]["surface"].get, reverse=True):
        lines.append(f"| {what} | " + " | ".join(f"{100 * result['split'][t].get(what, 0):.1f} %" for t in TASKS) + " |")
    lines += ["", "Of the first of them, CPU ms a step:", "", "| | " + " | ".join(TASKS) + " |", "|---|---|---|"]
    for what in result["stage"]["surface"]:
        lines.append(f"| {what} | " + " | ".join(f"{result['stage'][t][what]:.2f}" for t in TASKS) + " |")
    lines += ["", "## What a sample costs beside it", "", "| CPU, ms | " + " | ".join(TASKS) + " |", "|---|---|---|"]
    for what in result["beside"]["surface"]:
        lines.append(f"| {what} | " + " | ".join(f"{result['beside'][t][what]:.2f}" for t in TASKS) + " |")
    lines += [
        "",
        "## What the scene holds",
        "",
        "Counted in the compiled model; tests/benchmarks/physics/test_fidelity.py holds the scenes to it. Arm, "
        "mounting and object meshes come "
        "with the scenes that use them.",
        "",
        "| | " + " | ".join(TASKS) + " | needed | for |",
        "|---|" + "---|" * (len(TASKS) + 2),
    ]
    for rows in zip(*(result["inventory"][t] for t in TASKS), strict=True):
        needed = " / ".join(dict.fromkeys(str(r[2]) for r in rows))
        lines.append(f"| {rows[0][0]} | " + " | ".join(str(r[1]) for r in rows) + f" | {needed} | {rows[0][3]} |")
    return "\n".join(lines) + "\n"
