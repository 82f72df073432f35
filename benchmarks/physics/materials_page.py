"""Page of the comparison of the materials with closed-form solutions (benchmarks/physics/materials.py)."""

from typing import Any


def markdown(result: dict[str, Any]) -> str:
    """Return the page of a result."""
    patches = list(next(iter(result["patch"].values())))
    lines = [
        "# The materials against closed forms",
        "",
        "Written by `tactip bench materials`; do not edit. Small bodies of their own, "
        "with the settings of "
        "`tactip_model/soft_body.py`. The sources of the closed forms stand in `benchmarks/physics/materials.py`.",
        "",
        "## Gel: linear tetrahedra",
        "",
        "*Patch test*: the surface of an irregular block of 384 tetrahedra is moved affinely; inner vertices must follow. "
        "Their greatest error over the block's size, Poisson's ratio 0.45:",
        "",
        "| law | " + " | ".join(patches) + " |",
        "|---|" + "---|" * len(patches),
    ]
    for law, errors in result["patch"].items():
        lines.append(f"| {law} | " + " | ".join(f"{e:.0e}" for e in errors.values()) + " |")
    lines += [
        "",
        "*Bar* with free sides, pulled and pressed: greatest error of force and of its sides' stretch against the law's "
        "closed form (St Venant-Kirchhoff's force falls again below a stretch of 0.577: it is no law for a pressed gel):",
        "",
        "| law | Poisson's ratio | stretch | force | sides |",
        "|---|---|---|---|---|",
    ]
    for row in result["bar"]:
        ratios = {float(k): v for k, v in row["force_ratio"].items()}
        worst = max(abs(r - 1) for r in ratios.values())
        lines.append(
            f"| {row['law']} | {row['poisson']} | {min(ratios)} to {max(ratios)} | {worst:.0e} | "
            f"{row['worst_side_error']:.0e} |"
        )
    worst = max(abs(r - 1) for r in result["strip"].values())
    sizes = list(result["cantilever"])
    lines += [
        "",
        "## Skin: stretching and bending triangles",
        "",
        f"*Stretching*: a strip pulled and pressed by up to a quarter, kept flat, is within {worst:.0e} of plane-stress St "
        "Venant-Kirchhoff in force.",
        "",
        "*Bending*, measured over the closed form. `spiral`: points as on the tip's skin. Spacing, mm:",
        "",
        "| what | over | mesh | " + " | ".join(sizes) + " |",
        "|---|---|---|" + "---|" * len(sizes),
    ]
    for lattice, by_size in result["curving"].items():
        for shape in ("cylinder", "sphere", "saddle"):
            cells = " | ".join(f"{by_size[size][shape]:.2f}" for size in sizes)
            lines.append(f"| moment, bent to a {shape} | Kirchhoff's plate | {lattice} | {cells} |")
    for lattice, by_size in result["clamped_plate"].items():
        cells = " | ".join(f"{by_size[size]:.2f}" for size in sizes)
        lines.append(f"| deflection of a clamped disc of 15 mm | q a⁴ / 64 D | {lattice} | {cells} |")
    cells = " | ".join(f"{result['cantilever'][size]:.2f}" for size in sizes)
    lines += [
        f"| deflection of a strip, 20 by 6 mm | F L³ / 3 E I | jittered squares | {cells} |",
        "",
        f"A triangle mesh bends at its edges, which knows no Poisson's ratio. Moments over the plate's: {_curved(result)}. "
        "No factor on thickness or modulus mends all. On the tip's own dome stretching and bending share the load: the skin "
        "alone under a point load at its apex, deflection over Reissner's for a spherical shell,",
        "",
        "| mesh | deflection | moves without a load, mm |",
        "|---|---|---|",
    ]
    for name, row in result["dome"].items():
        lines.append(f"| {name} | {row['deflection_ratio']:.2f} | {row['unloaded_mm']:.4f} |")
    lines += [
        "",
        "The last column: the bending of a curved skin is not quite at rest as built.",
    ]
    return "\n".join(lines) + "\n"


def _curved(result: dict[str, Any]) -> str:
    """Return the ranges of the moments of curving_ratios over spacings, by shape and mesh, as text."""
    texts = []
    for shape, kind in (("cylinder", "cylinders"), ("sphere", "domes"), ("saddle", "saddles")):
        ranges = []
        for lattice, by_size in result["curving"].items():
            found = [row[shape] for row in by_size.values()]
            ranges.append(f"{min(found):.2f} to {max(found):.2f} ({lattice})")
        texts.append(f"{kind} {' and '.join(ranges)}")
    return ", ".join(texts)
