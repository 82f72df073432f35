"""The pressed gel in other finite-element codes, element for element: `tactip bench fem-cross-check`.

The gel has the Poisson's ratio of its elements, so its volume has no row of its own. The same tetrahedra are solved by
benchmarks/physics/fem_tetrahedra.py and, if it is installed (Debian: calculix-ccx), by CalculiX. The vertices that touch the
plate are fixed at the simulator's height; compared are the positions of the rest of the surface, mm, and the force. Writes
docs/fem_cross_check.md and docs/fem_cross_check.json.
"""

import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.benchmarks.physics.fem_tetrahedra import Solid, lame
from tactip_twin.benchmarks.physics.materials import Specimen, gel
from tactip_twin.benchmarks.physics.options import FemCrossCheckOptions
from tactip_twin.benchmarks.report import table, write_results
from tactip_twin.sim.contact.fidelity import FIDELITIES
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.labels import FidelityName
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.mesh import Mesh
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.soft_body import gel_attributes

DEPTHS_MM = (1.0, 2.0, 3.0, 5.0)
PLAIN_POISSON = 0.3
"""Poisson's ratio at which St Venant-Kirchhoff's law, which MuJoCo and CalculiX share, is still stable at 2 mm of depth."""


def calculix() -> str | None:
    """Return the path of CalculiX's solver `ccx`, or None if it is not installed."""
    return shutil.which("ccx")


def solve_with_calculix(
    vertices: np.ndarray,
    tetrahedra: np.ndarray,
    law: str,
    young: float,
    poisson: float,
    fixed: np.ndarray,
    prescribed: np.ndarray,
    folder: Path,
) -> tuple[np.ndarray, np.ndarray]:
    """Solve with CalculiX's four-node tetrahedra (C3D4).

    Args:
        vertices: (n, 3), m.
        tetrahedra: (m, 4) int.
        law: `St Venant-Kirchhoff` (its *ELASTIC at large displacements) or `split neo-Hooke` (its *HYPERELASTIC, NEO HOOKE).
        young: Young's modulus, Pa.
        poisson: Poisson's ratio, -.
        fixed: (n, 3) bool, as for fem_tetrahedra.Solid.solve.
        prescribed: (n, 3), m, as for fem_tetrahedra.Solid.solve.
        folder: Empty folder for CalculiX's files.

    Returns:
        Displacements (n, 3), m, and reactions (n, 3), N.

    Raises:
        ArithmeticError: CalculiX does not finish.
    """
    lam, mu = lame(young, poisson)
    constants = {
        "St Venant-Kirchhoff": f"*ELASTIC\n{young * 1e-6:.12g}, {poisson:.12g}",
        "split neo-Hooke": f"*HYPERELASTIC, NEO HOOKE\n{mu * 1e-6 / 2:.12g}, {2 / ((lam + 2 / 3 * mu) * 1e-6):.12g}",
    }
    lines = ["*NODE, NSET=ALL"]  # in mm, N and MPa
    lines += [f"{i}, {x:.12g}, {y:.12g}, {z:.12g}" for i, (x, y, z) in enumerate(1e3 * vertices, 1)]
    lines += ["*ELEMENT, TYPE=C3D4, ELSET=GEL"]
    lines += [f"{i}, {a}, {b}, {c}, {d}" for i, (a, b, c, d) in enumerate(tetrahedra + 1, 1)]
    lines += ["*MATERIAL, NAME=GEL", constants[law], "*SOLID SECTION, ELSET=GEL, MATERIAL=GEL"]
    lines += ["*STEP, NLGEOM, INC=1000", "*STATIC", "0.1, 1, 1e-5, 0.1", "*BOUNDARY"]
    lines += [f"{i + 1}, {k + 1}, {k + 1}, {1e3 * prescribed[i, k]:.12g}" for i, k in np.argwhere(fixed)]
    lines += ["*NODE PRINT, NSET=ALL, FREQUENCY=1000", "U, RF", "*END STEP", ""]
    (folder / "gel.inp").write_text("\n".join(lines))
    command = [str(calculix()), "gel"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False)  # noqa: S603
    blocks = (folder / "gel.dat").read_text().split("\n\n") if (folder / "gel.dat").exists() else []
    tables = [np.loadtxt(block.splitlines()) for block in blocks if len(block.splitlines()) == len(vertices)]
    if done.returncode or len(tables) != 2:
        raise ArithmeticError(f"CalculiX did not finish: {done.stdout[-300:]}")
    return 1e-3 * tables[0][:, 1:], tables[1][:, 1:]


def pressed_gel(
    depth_mm: float, preset: FidelityName = "standard"
) -> tuple[Mesh, tuple[float, float], np.ndarray, np.ndarray, float]:
    """Press the tip without skin and friction in the simulator.

    Args:
        depth_mm: Depth, mm.
        preset: Fidelity.

    Returns:
        The mesh; Young's modulus (Pa) and Poisson's ratio of the flex; the fixed coordinates (n, 3) bool, which are those of
        bonded vertices and the height of vertices that touch the plate; displacements (n, 3), m; force, N.
    """
    design, fidelity = design_named("nominal-127"), FIDELITIES[preset]
    poisson = fidelity.mesh.poisson_limit
    materials = replace(design.materials, friction=0.0, skin_young_pa=1.0, gel_poisson=poisson)  # a skin of 1 Pa is none
    simulator = ContactSimulator(replace(design, materials=materials), "surface", fidelity)
    force = simulator.simulate(from_mm_deg([0, 0, -depth_mm, 0, 0, 0]), np.zeros(6)).normal_force_n
    scene = simulator.scene
    fixed = np.repeat(scene.mesh.bonded[:, None], 3, 1)
    names = [scene.model.geom(g).name for pair in scene.data.contact.geom for g in pair if g >= 0]
    touching = [int(name.split("/")[1]) for name in names if name.startswith("tip/")]
    fixed[touching, 2] = True
    flex = gel_attributes(materials, fidelity.mesh)
    return scene.mesh, (flex["young"], flex["poisson"]), fixed, scene.vertices() - scene.mesh.vertices, force


def differences(displacements: np.ndarray, expected: np.ndarray, free: np.ndarray, size_mm: float) -> dict[str, float]:
    """Return the rms and the maximum distance, mm, of free surface vertices between two solutions.

    Args:
        displacements: (n, 3), m.
        expected: (n, 3), m.
        free: (n,) bool, the vertices to compare.
        size_mm: Maximum displacement, mm, which the result repeats.
    """
    distance = 1e3 * np.linalg.norm(displacements - expected, axis=1)[free]
    return {"rms_mm": float(np.sqrt(np.mean(distance**2))), "greatest_mm": float(distance.max()), "of_mm": size_mm}


def compare_simulator(depth_mm: float) -> dict[str, Any]:
    """Return a row that compares the simulator's own press with fem_tetrahedra.Solid of the same law."""
    mesh, constants, fixed, moved, force = pressed_gel(depth_mm)
    solid = Solid(mesh.vertices, mesh.tetrahedra, "stable neo-Hooke", *constants)
    other = solid.solve(fixed, moved)
    surface = np.arange(len(moved)) < mesh.surface_count
    row = {"depth_mm": depth_mm, "law": "stable neo-Hooke", "codes": "simulator, `fem_tetrahedra`"}
    row |= differences(moved, other, surface & ~mesh.bonded, 1e3 * float(np.abs(moved).max()))
    touching = fixed[:, 2] & ~mesh.bonded
    return row | {"force_ratio": float(force / -solid.forces(other)[touching, 2].sum())}


def compare_codes(depth_mm: float, law: str, folder: Path) -> list[dict[str, Any]]:
    """Return rows that compare CalculiX with the other codes that have the law, for the same gel of PLAIN_POISSON."""
    mesh, _, fixed, prescribed, _ = pressed_gel(depth_mm)
    young, surface = design_named("nominal-127").materials.gel_young_pa, np.arange(len(prescribed)) < mesh.surface_count
    free, touching = surface & ~mesh.bonded, fixed[:, 2] & ~mesh.bonded
    problem = mesh.vertices, mesh.tetrahedra, law, young, PLAIN_POISSON
    expected, reaction = solve_with_calculix(*problem, fixed, prescribed, folder)
    solid = Solid(*problem)
    moved = solid.solve(fixed, prescribed)
    solutions: dict[str, tuple[np.ndarray, np.ndarray]] = {"`fem_tetrahedra`": (moved, solid.forces(moved))}
    if law == "St Venant-Kirchhoff":
        specimen = Specimen(mesh.vertices, mesh.tetrahedra, gel(PLAIN_POISSON, law, young), fixed)
        positions, force = mesh.vertices, np.zeros(mesh.vertices.shape)
        for fraction in np.linspace(0, 1, 11)[1:]:
            start = np.where(fixed, mesh.vertices + fraction * prescribed, positions)
            positions, force = specimen.rest(start, within=1e-5)
        solutions["MuJoCo's flex"] = positions - mesh.vertices, -force
    rows = []
    for name, (moved, force) in solutions.items():
        row = {"depth_mm": depth_mm, "law": law, "codes": f"{name}, CalculiX"}
        row |= differences(moved, expected, free, 1e3 * float(np.abs(expected).max()))
        rows.append(row | {"force_ratio": float(force[touching, 2].sum() / reaction[touching, 2].sum())})
    return rows


def run(options: FemCrossCheckOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure, write fem_cross_check.json and fem_cross_check.md, and return the results.

    Without CalculiX its comparison is left out, and `log` gets a line that says so.
    """
    rows = [compare_simulator(depth) for depth in DEPTHS_MM]
    if calculix() is None:
        log("CalculiX is not installed (Debian: apt install calculix-ccx): its comparison is left out")
    else:
        for depth, law in ((1.0, "St Venant-Kirchhoff"), (2.0, "St Venant-Kirchhoff"), (3.0, "split neo-Hooke")):
            with tempfile.TemporaryDirectory() as folder:
                rows += compare_codes(depth, law, Path(folder))
    result = {"rows": rows}
    write_results("fem_cross_check", result, tables(result), options.out)
    return result


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Return the table of docs/fem_cross_check.md from fem_cross_check.json."""
    rows = [
        [
            r["codes"],
            r["law"],
            f"{r['depth_mm']:g}",
            f"{r['rms_mm']:.1e}",
            f"{r['greatest_mm']:.1e}",
            f"{r['force_ratio']:.6f}",
        ]
        for r in result["rows"]
    ]
    missing = "" if any("CalculiX" in r["codes"] for r in result["rows"]) else "\n\nCalculiX was not installed."
    return {"codes": table(["codes", "law", "depth, mm", "distance, rms mm", "maximum, mm", "force ratio"], rows) + missing}
