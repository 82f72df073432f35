"""Variants to measure: `standard` with one number changed at a time, and sequences that refine the reference."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from tactip_twin.benchmarks.physics.contact_cache import STANDARD, Variant
from tactip_twin.sim.contact.fidelity import FIDELITIES, Fidelity, finer

REFINED_MM = tuple(1.2 * 2 ** (k / 2) for k in (2, 1, 0, -1))
"""Spacings on the surface of a sequence that ends one refinement beyond the reference, mm; other spacings in proportion."""


def changed(part: str, **changes: Any) -> Variant:
    """Return `standard` with numbers of one of its parts (a field of Fidelity) changed."""
    fidelity = STANDARD.fidelity
    return Variant(replace(fidelity, **{part: replace(getattr(fidelity, part), **changes)}))


def small_steps(fidelity: Fidelity) -> Fidelity:
    """Return a fidelity with the given one's mesh and half the steps of the reference."""
    fine = finer(FIDELITIES["reference"])
    return replace(fine, name=f"mesh of {fidelity.name}, small steps", mesh=fidelity.mesh)


def refined_meshes() -> dict[float, Variant]:
    """Return the reference with meshes of REFINED_MM, by the spacing on the surface, mm."""
    reference = FIDELITIES["reference"]
    mesh, out = reference.mesh, {}
    for spacing in REFINED_MM:
        ratio = spacing * 1e-3 / mesh.surface_m
        lengths = {name: getattr(mesh, name) * ratio for name in ("surface_m", "rim_m", "coarsest_m")}
        out[spacing] = Variant(replace(reference, name=f"reference, {spacing:.2f} mm", mesh=replace(mesh, **lengths)))
    return out


def refined_steps() -> dict[float, Variant]:
    """Return the mesh of `standard` with the reference's steps refined, by the ratio of the steps to the reference's."""
    mesh, reference = STANDARD.fidelity.mesh, FIDELITIES["reference"]
    half = finer(reference)
    motion = reference.motion
    twice = replace(
        motion,
        step_s=2 * motion.step_s,
        press_step_m=2 * motion.press_step_m,
        shear_step_m=2 * motion.shear_step_m,
        settle_steps=motion.settle_steps // 2,
    )
    fidelities = {2.0: replace(reference, motion=twice), 1.0: reference, 0.5: half, 0.25: finer(half)}
    return {s: Variant(replace(f, name=f"mesh of standard, {s:g} steps", mesh=mesh)) for s, f in fidelities.items()}


def _row(part: str, name: str, values: Sequence[float], scale: float = 1.0) -> dict[str, Variant]:
    """Return variants of one number by the text of its value.

    Args:
        part: Field of Fidelity.
        name: Field of that part.
        values: In the page's unit.
        scale: The page's unit in SI units.
    """
    return {f"{v:g}": changed(part, **{name: type(v)(v * scale) if isinstance(v, int) else v * scale}) for v in values}


def sweeps() -> dict[str, tuple[bool, dict[str, Variant]]]:
    """Return the sweeps by their name on the page, with its unit: whether it changes the mesh, and variants by the value."""
    contact, motion = STANDARD.fidelity.contact, STANDARD.fidelity.motion
    (k_moving, d_moving), (k_resting, d_resting) = contact.moving, contact.resting
    easing = {
        (0.0, 0.0): "constant speed",
        (0.0, 1.5): "0, 1.5",
        (1.5, 0.5): "1.5, 0.5",
        (1.5, 1.5): "1.5, 1.5",
        (0.5, 3.0): "0.5, 3",
    }
    mesh = {
        "mesh spacing at the surface, mm": _row("mesh", "surface_m", (1.2, 1.5, 1.7, 2.2, 2.6, 3.2), 1e-3),
        "mesh spacing at the rim, mm": _row("mesh", "rim_m", (2.5, 3.5, 4.5, 6.0), 1e-3),
        "polar angle of the fine mesh, degrees": _row("mesh", "fine_angle_deg", (15.0, 40.0, 55.0)),
        "growth of layers inward": _row("mesh", "growth", (1.1, 1.2, 1.35, 1.6, 2.0)),
        "largest layer spacing, mm": _row("mesh", "coarsest_m", (5.0, 10.0), 1e-3),
    }
    rest = {
        "time step, ms": _row("motion", "step_s", (3.0, 4.0, 10.0, 14.0), 1e-3),
        "approach per step, mm": _row("motion", "press_step_m", (0.3, 0.6, 2.4), 1e-3),
        "shear per step, mm": _row("motion", "shear_step_m", (0.1, 0.2, 0.6, 1.0), 1e-3),
        "minimum steps per motion": _row("motion", "min_steps", (2, 8, 16)),
        "minimum settling steps": _row("motion", "settle_steps", (1, 2, 8, 16)),
        "settled speed, mm/s": _row("motion", "settle_speed_m_s", (0.2, 0.7, 6.0, 20.0), 1e-3),
        "maximum settling steps": _row("motion", "settle_limit", (4, 10, 40, 100)),
        "easing exponents (in, out)": {t: changed("motion", ease_in=i, ease_out=o) for (i, o), t in easing.items()},
        "solver tolerance in motion": _row("solver", "tolerance", (1e-9, 1e-8, 1e-6, 1e-5)),
        "solver tolerance at rest": _row("solver", "settle_tolerance", (1e-11, 1e-10, 1e-7, 1e-6)),
        "solver iterations": _row("solver", "iterations", (100, 300, 3000)),
        "ratio of frictional to normal impedance": _row("solver", "impratio", (1.0, 3.0, 30.0, 100.0)),
        "contact stiffness in motion": {
            f"× {s:g}": changed("contact", moving=(s * k_moving, d_moving)) for s in (0.1, 0.3, 3, 10)
        },
        "contact damping in motion": {
            f"× {s:g}": changed("contact", moving=(k_moving, s * d_moving)) for s in (0.1, 0.3, 3, 10)
        },
        "contact stiffness at rest": {
            f"× {s:g}": changed("contact", resting=(s * k_resting, d_resting)) for s in (0.1, 0.3, 3, 10)
        },
        "same contact in motion and at rest": {
            "stiff": changed("contact", moving=contact.resting),
            "soft": changed("contact", resting=contact.moving),
        },
        "contact margin, mm": _row("contact", "margin_m", (0.0, 0.1, 0.2, 0.8), 1e-3),
        "contact impedance": _row("contact", "impedance", (0.8, 0.9, 0.99)),
        "skin vertex mass, mg": _row("contact", "vertex_mass_kg", (3.0, 10.0, 100.0, 300.0), 1e-6),
        "De Saxcé correction": {"off": replace(STANDARD, lowered=False)},
    }
    min_steps = min(motion.settle_steps, 4)
    rest["maximum settling steps"]["4"] = changed("motion", settle_limit=min_steps, settle_steps=min_steps)
    found = {name: (True, v) for name, v in mesh.items()} | {name: (False, v) for name, v in rest.items()}
    # Values above that are those of `standard` are left out, because `standard` is measured itself.
    return {name: (m, {t: v for t, v in variants.items() if v != STANDARD}) for name, (m, variants) in found.items()}
