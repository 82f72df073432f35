"""Contact models of a mesh compared by error and cost: `tactip bench mesh-contact`.

Simulates the same sheared contacts with a stimulus and with a mesh of its shape in each available contact model: rigid
flexes, signed distances, and contact proxies that follow the skin. It takes some minutes. Writes docs/mesh_contact.md and
.json.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, Literal

import mujoco
import numpy as np
import trimesh

from tactip_twin.assets.meshes.rims import block
from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.physics.options import MeshContactOptions
from tactip_twin.benchmarks.report import table, write_results
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.contact.stimuli import EDGE_RADIUS_M, SPHERE_RADIUS_M, ContactAttributes, Stimulus, stimulus_named
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.soft_body import TOUCHES_FACETS, TOUCHES_VERTICES

DESIGN, FIDELITY = "tactip-127", "standard"

CONTACTS, SEED = 4, 1

SIZES_MM = (6.0, 2.0, 1.0)
"""Maximum edge lengths of the meshes, mm."""


class NativeMesh(Stimulus):
    """A mesh in one of MuJoCo's own contact models; its true shape is that of another stimulus."""

    def __init__(self, true: Stimulus, mesh: trimesh.Trimesh, kind: Literal["flex", "sdf"], collides_with: int) -> None:
        """Prepare a stimulus.

        Args:
            true: Stimulus of the true shape.
            mesh: Mesh of that shape, m.
            kind: MuJoCo's contact model.
            collides_with: Contact bits of what it collides with.
        """
        self._true, self._mesh, self._kind, self._collides_with = true, mesh, kind, collides_with

    @property
    def min_radius_m(self) -> float:
        """See Stimulus."""
        return self._true.min_radius_m

    def distance(self, points: np.ndarray) -> np.ndarray:
        """See Stimulus."""
        return self._true.distance(points)

    def height_to_clear(self, centre: np.ndarray, radius: float) -> float:
        """See Stimulus."""
        return self._true.height_to_clear(centre, radius)

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, touch: ContactAttributes) -> None:
        """See Stimulus."""
        vertices, triangles = np.asarray(self._mesh.vertices).ravel(), np.asarray(self._mesh.faces).ravel()
        bits = {"contype": 0, "conaffinity": self._collides_with}
        if self._kind == "flex":
            none = mujoco.mjtFlexSelf.mjFLEXSELF_NONE
            where = {"vertbody": [body.name], "vert": vertices, "elem": triangles}
            spec.add_flex(name="mesh", dim=2, radius=1e-6, selfcollide=none, **where, **bits, **touch)
            return
        spec.add_mesh(name="mesh", uservert=vertices, userface=triangles, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT)
        body.add_geom(name="mesh", type=mujoco.mjtGeom.mjGEOM_SDF, meshname="mesh", **bits, **touch)


def meshes() -> dict[str, trimesh.Trimesh]:
    """Return meshes, mm, of the shapes of stimuli, by the stimulus's name."""
    edge = trimesh.convex.convex_hull(block(30.0, 30.0, 1e3 * EDGE_RADIUS_M))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1e3 * SPHERE_RADIUS_M)
    flat = trimesh.creation.box((60.0, 60.0, 30.0))
    edge.apply_translation([-30, 0, 0])
    ball.apply_translation([0, 0, -1e3 * SPHERE_RADIUS_M])
    flat.apply_translation([0, 0, -15])
    return {"surface": flat, "edge": edge, "sphere": ball}


def subdivide(name: str, mesh: trimesh.Trimesh, size_mm: float) -> trimesh.Trimesh:
    """Return the mesh (mm) of a stimulus in m, with edges of at most size_mm; new vertices of a ball lie on the ball."""
    subdivided = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, size_mm, max_iter=20)
    fine = trimesh.Trimesh(*subdivided[:2])
    fine.merge_vertices()
    if name == "sphere":
        radius = 1e3 * SPHERE_RADIUS_M
        own = fine.vertices - np.array([0, 0, -radius])
        fine.vertices = own / np.linalg.norm(own, axis=1, keepdims=True) * radius - [0, 0, radius]
    fine.apply_scale(1e-3)
    return fine


def contact_models(name: str, mesh: trimesh.Trimesh) -> dict[str, Callable[[], Stimulus]]:
    """Return the contact models, by name, for the mesh (mm) of a stimulus, as functions that make the stimulus."""
    true = stimulus_named(name)
    out: dict[str, Callable[[], Stimulus]] = {}
    both = TOUCHES_VERTICES | TOUCHES_FACETS
    for size in SIZES_MM:
        fine = subdivide(name, mesh, size)
        count = f"{len(fine.faces)} triangles"
        sharpest = EDGE_RADIUS_M if name != "sphere" else SPHERE_RADIUS_M
        out[f"contact proxies, {count}"] = lambda fine=fine, r=sharpest: SolidStimulus(
            SignedDistanceMesh(fine.vertices, fine.faces), min_radius_m=r
        )
        if size != SIZES_MM[-1]:
            out[f"rigid flex, {count}"] = lambda fine=fine: NativeMesh(true, fine, "flex", both)
            out[f"rigid flex, vertices only, {count}"] = lambda fine=fine: NativeMesh(true, fine, "flex", TOUCHES_VERTICES)
            out[f"signed distance, {count}"] = lambda fine=fine: NativeMesh(true, fine, "sdf", both)
    return out


def contacts(name: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return poses and shears (6,), m and rad, for a stimulus; the same for all contact models."""
    rng = np.random.default_rng(SEED)
    low, high = np.array([-2, 0, -4, -10, -10, -30.0]), np.array([2, 0, -2, 10, 10, 30.0])
    if name == "sphere":
        low[:2], high[:2] = -1, 1
    far = np.array([3, 3, 0, 4, 4, 4.0])
    return [(from_mm_deg(rng.uniform(low, high)), from_mm_deg(rng.uniform(-far, far))) for _ in range(CONTACTS)]


def measure(log: Callable[[str], None]) -> dict[str, Any]:
    """Return all results, for docs/mesh_contact.json: a row for each stimulus and contact model."""
    design, fidelity = load_design(DESIGN), fidelity_named(FIDELITY)
    out = {"machine": machine(), "contacts": CONTACTS, "design": DESIGN, "fidelity": FIDELITY, "stimuli": {}}
    for name, mesh in meshes().items():
        rows: list[dict[str, Any]] = []
        true: list[Contact] = []
        own: dict[str, Callable[[], Stimulus]] = {"stimulus": lambda name=name: stimulus_named(name)}
        for model, stimulus in (own | contact_models(name, mesh)).items():
            try:
                simulator = ContactSimulator(design, stimulus(), fidelity)
            except TactipError as error:
                rows.append({"contact_model": model, "refused": str(error).splitlines()[0]})
                log(f"{name}: {model}: refused")
                continue
            found, seconds = [], []
            for pose, shear in contacts(name):
                start = time.perf_counter()
                found.append(simulator.simulate(pose, shear))
                seconds.append(time.perf_counter() - start)
            true = true or found
            rows.append({"contact_model": model, **_figures(found, true, seconds)})
            if model.startswith("rigid flex"):
                rows[-1]["force"] = None  # Scene.contact_force distinguishes the sides by geoms, and a flex has none
            log(f"{name}: {model}: {rows[-1]['pins_mm']} mm, {rows[-1]['seconds']:.2f} s")
        out["stimuli"][name] = rows
    return out


def _figures(found: Sequence[Contact], true: Sequence[Contact], seconds: Sequence[float]) -> dict[str, Any]:
    """Return the errors of contacts against those with stimulus, and their costs."""
    apart = [1e3 * float(np.sqrt(((p.pin_tips - t.pin_tips) ** 2).sum(1).mean())) for p, t in zip(found, true, strict=True)]
    force = [abs(abs(p.normal_force_n / t.normal_force_n) - 1) for p, t in zip(found, true, strict=True)]
    return {
        "pins_mm": [float(np.median(apart)), max(apart)],
        "force": float(np.median(force)),
        "overlap_mm": 1e3 * max(p.overlap_m for p in found),
        "seconds": float(np.median(seconds)),
    }


def tables(record: dict[str, Any]) -> dict[str, str]:
    """Return the table of docs/mesh_contact.md from mesh_contact.json."""
    cells = []
    for name, (stimulus, *rows) in record["stimuli"].items():
        cells.append([name, "stimulus", "", "", "", "", f"{stimulus['overlap_mm']:.3f}", "1.0"])
        for row in rows:
            model, _, triangles = row["contact_model"].removesuffix(" triangles").rpartition(", ")
            if "refused" in row:
                cells.append([name, model, triangles, f"refused: {row['refused']}", "", "", "", ""])
                continue
            force = "not available" if row["force"] is None else f"{100 * row['force']:.1f} %"
            median, maximum, overlap = (f"{e:.3f}" for e in (*row["pins_mm"], row["overlap_mm"]))
            cost = f"{row['seconds'] / stimulus['seconds']:.1f}"
            cells.append([name, model, triangles, median, maximum, force, overlap, cost])
    errors = ["pin error, mm: median", "maximum", "force error", "overlap, mm", "cost"]
    state = (
        f"Machine: {machine_text(record['machine'])}. Settings: {record['contacts']} contacts per stimulus, design "
        f"`{record['design']}`, fidelity `{record['fidelity']}`."
    )
    return {"models": f"{table(['stimulus', 'contact model', 'triangles', *errors], cells)}\n\n{state}"}


def run(options: MeshContactOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure, write mesh_contact.json and mesh_contact.md, and return the results. Progress goes to `log`."""
    record = measure(log)
    write_results("mesh_contact", record, tables(record), options.out)
    return record
