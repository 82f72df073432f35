"""The pressed tip against an independent finite-element code: `python -m benchmarks.mechanics`.

Centred press on the flat without friction: force over that of benchmarks/axisymmetric.py (which does not lock and whose
skin is solid), for the gel alone and the whole sensor; the ripple of the force–depth curve; the loss of volume; and what
the numerical Poisson's ratio of mesh.Resolution is for. Writes docs/mechanics.md and docs/mechanics.json.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from benchmarks.axisymmetric import Dome, Layer
from sim.contact import ContactPlayer
from sim.fidelity import FIDELITIES
from sim.pose import from_mm_deg
from tactip_model.design import design_named
from tactip_model.mesh import tetrahedron_volumes

DEPTHS_MM = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0)


@dataclass(frozen=True)
class Options:
    """Measure the mechanics."""

    out: Path = Path("docs")
    """Folder for mechanics.md and mechanics.json."""


def independent_forces(design):
    """Forces (N) at DEPTHS_MM of the independent code: dict of `gel` and `sensor` to list."""
    m, r = design.materials, design.shape.radius_m
    gel = (m.gel_young_pa, m.gel_poisson)
    layers = {
        "gel": [Layer(r, *gel, 12)],
        "sensor": [Layer(r - m.skin_thickness_m, *gel, 12), Layer(r, m.skin_young_pa, m.skin_poisson, 2)],
    }
    steps = np.arange(0.25, 5.01, 0.25)
    out = {}
    for name, build in layers.items():
        forces = [force for force, _ in Dome(build, polar_elements=40).press(steps * 1e-3)]
        out[name] = [forces[int(np.argmin(np.abs(steps - d)))] for d in DEPTHS_MM]
    return out


def press(player, depth_mm):
    """Press the centre. Returns the Contact."""
    return player.play(from_mm_deg([0, 0, -depth_mm, 0, 0, 0]), np.zeros(6))


def main(options: Options):
    """Measure, print, and write the page."""
    design = design_named("tactip-127")
    ice = replace(design, materials=replace(design.materials, friction=0.0))
    designs = {"gel": replace(ice, materials=replace(ice.materials, skin_young_pa=1.0)), "sensor": ice}
    expected = independent_forces(design)
    standard = FIDELITIES["standard"]
    plain = replace(standard.mesh, poisson_limit=0.5, locked_stiffness=1.0)
    meshes = {
        "draft": FIDELITIES["draft"],
        "standard": standard,
        "standard mesh, 0.49 as it is": replace(standard, mesh=plain),
    }
    rows = []
    for what, tip in designs.items():
        for name, fidelity in meshes.items():
            player = ContactPlayer(tip, "surface", fidelity)
            ratios = [press(player, d).normal_force_n / f for d, f in zip(DEPTHS_MM, expected[what], strict=True)]
            lost = 1 - tetrahedron_volumes(player.scene.vertices(), player.scene.mesh.tetrahedra).sum() / (
                player.scene.mesh.volumes.sum()
            )
            rows.append({"tip": what, "mesh": name, "force_ratio": ratios, "volume_lost_at_5_mm": float(lost)})
            print(json.dumps(rows[-1]), flush=True)
    player = ContactPlayer(design, "surface", standard)
    depth = np.arange(0.5, 5.01, 0.1)
    force = np.array([press(player, d).normal_force_n for d in depth])
    smooth = np.exp(np.polyval(np.polyfit(np.log(depth), np.log(force), 3), np.log(depth)))
    ripple = float(np.abs(force / smooth - 1).max())
    print(f"ripple of standard: {ripple:.4f}")
    result = {"depths_mm": DEPTHS_MM, "independent_force_n": expected, "rows": rows, "ripple": ripple}
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "mechanics.json").write_text(json.dumps(result, indent=1) + "\n")
    (options.out / "mechanics.md").write_text(page(result))


def page(result):
    """The Markdown (str) of a result."""
    depths = result["depths_mm"]
    lines = [
        "# The pressed tip against an independent code",
        "",
        "Written by `python -m benchmarks.mechanics`; do not edit. Centred press on the flat without friction. Force over "
        "that of `benchmarks/axisymmetric.py` (eight-node elements with reduced integration, a solid skin) at",
        "",
        "| tip | mesh | " + " | ".join(f"{d} mm" for d in depths) + " | volume lost at 5 mm |",
        "|---|---|" + "---|" * (len(depths) + 1),
    ]
    for name, forces in result["independent_force_n"].items():
        lines.append(f"| {name} | *independent code, N* | " + " | ".join(f"*{f:.3f}*" for f in forces) + " | |")
    for r in result["rows"]:
        ratios = " | ".join(f"{x:.2f}" for x in r["force_ratio"])
        lines.append(f"| {r['tip']} | {r['mesh']} | {ratios} | {100 * r['volume_lost_at_5_mm']:.1f} % |")
    lines += [
        "",
        f"Force every 0.1 mm from 0.5 to 5 mm with friction, `standard`: within {100 * result['ripple']:.1f} % of a smooth "
        "curve (a cubic in the logarithms).",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(tyro.cli(Options))
