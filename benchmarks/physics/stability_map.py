"""Cells of the stability map: contacts over materials, friction, steps, depths, speeds and stimuli."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from tactip_twin.sim.contact.fidelity import MAX_APPROACH_SPEED_M_S, MAX_SHEAR_SPEED_M_S, fidelity_named
from tactip_twin.sim.contact.stimuli import STIMULI

_STANDARD = fidelity_named("standard").motion


@dataclass(frozen=True)
class Cell:
    """One contact of the map."""

    panel: str
    """Name of its panel of the figure."""
    row: str
    """Name of its row in the panel."""
    column: str
    """Name of its column."""
    stimulus: str = "surface"
    """Name in stimuli.STIMULI."""
    depth_mm: float = 3.0
    """Depth of the press, mm."""
    slide_mm: float = 0.0
    """Slide along x in contact, mm."""
    tilt_deg: float = 0.0
    """Tilt about y, degrees."""
    approach: bool = True
    """Whether to press from above; otherwise the contact starts with the stimulus inside the skin."""
    materials: dict[str, float] = field(default_factory=dict)
    """Changes to fields of the design's Materials."""
    shape: dict[str, float] = field(default_factory=dict)
    """Changes to fields of its TipGeometry."""
    motion: dict[str, float] = field(default_factory=dict)
    """Changes to fields of the fidelity's Motion."""
    solver: dict[str, float] = field(default_factory=dict)
    """Changes to fields of its Solver."""


def cells() -> list[Cell]:
    """Return the map."""
    return [*_materials(), *_numerics(), *_contacts(), *_objects()]


def _materials() -> Iterator[Cell]:
    for skin in (1.0, 1e3, 1e4, 1e5, 0.6e6, 1e7, 1e8):
        for gel in (1e3, 1e4, 2e4, 1e5, 1e6):
            moduli = {"skin_young_pa": skin, "gel_young_pa": gel}
            yield Cell("skin modulus, Pa | gel modulus, Pa", f"{skin:.0e}", f"{gel:.0e}", slide_mm=2, materials=moduli)
    for ratio in (30.0, 100.0, 300.0, 500.0, 501.0):
        for depth in (1.0, 3.0, 4.0, 5.0, 6.0, 8.0):
            changes = {"skin_young_pa": ratio * 2e4}
            panel = "skin modulus over gel modulus | depth, mm"
            yield Cell(panel, f"{ratio:g}", f"{depth:g}", depth_mm=depth, slide_mm=1, materials=changes)
    for skin in (0.0, 0.2, 0.45, 0.499):
        for gel in (0.0, 0.2, 0.4, 0.45, 0.47, 0.48, 0.49, 0.499):
            ratios = {"skin_poisson": skin, "gel_poisson": gel}
            yield Cell("skin Poisson's ratio | gel Poisson's ratio", f"{skin:g}", f"{gel:g}", slide_mm=2, materials=ratios)
    for density in (105.0, 350.0, 1050.0, 3500.0, 10500.0):
        for damping in (0.5e-3, 2e-3, 5e-3, 20e-3, 50e-3):
            changes = {"density_kg_m3": density, "damping_s": damping}
            yield Cell("density, kg/m³ | damping, ms", f"{density:g}", f"{1e3 * damping:g}", slide_mm=2, materials=changes)
    for radius in (10e-3, 15e-3, 20e-3, 30e-3, 40e-3):
        for thickness in (0.2e-3, 0.5e-3, 1e-3, 1.5e-3, 3e-3):
            yield Cell(
                "dome radius, mm | skin thickness, mm",
                f"{1e3 * radius:g}",
                f"{1e3 * thickness:g}",
                slide_mm=2,
                shape={"radius_m": radius},
                materials={"skin_thickness_m": thickness},
            )


def _numerics() -> Iterator[Cell]:
    for step in (0.2e-3, 0.5e-3, 1e-3, 2e-3, 5e-3, 7e-3, 10e-3, 20e-3):
        for depth in (1.0, 3.0, 5.0, 8.0):
            yield Cell(
                "time step, ms | depth, mm", f"{1e3 * step:g}", f"{depth:g}", depth_mm=depth, slide_mm=2, motion=_paced(step)
            )
    for speed in (0.01, 0.05, 0.1, 0.2, 0.5):
        for depth in (1.0, 3.0, 5.0, 8.0):
            motion = {"press_step_m": speed * _STANDARD.step_s}
            yield Cell("approach, m/s | depth, mm", f"{speed:g}", f"{depth:g}", depth_mm=depth, motion=motion)
    for iterations in (100, 200, 500, 1000):
        for tolerance in (1e-5, 1e-6, 1e-7, 1e-8):
            solver = {"iterations": iterations, "tolerance": tolerance, "settle_tolerance": tolerance / 100}
            yield Cell(
                "solver iterations | solver tolerance", f"{iterations}", f"{tolerance:.0e}", slide_mm=2, solver=solver
            )


def _paced(step: float) -> dict[str, float]:
    """Return changes to Motion for another time step, s.

    The rest takes as long, and steps have the same length if that is allowed.
    """
    ratio = step / _STANDARD.step_s
    return {
        "step_s": step,
        "press_step_m": min(_STANDARD.press_step_m, MAX_APPROACH_SPEED_M_S * step),
        "shear_step_m": min(_STANDARD.shear_step_m, MAX_SHEAR_SPEED_M_S * step),
        "settle_steps": max(_STANDARD.settle_steps, round(_STANDARD.settle_steps / ratio)),
        "settle_limit": max(_STANDARD.settle_limit, round(_STANDARD.settle_limit / ratio)),
    }


def _contacts() -> Iterator[Cell]:
    for friction in (0.0, 0.1, 0.3, 0.6, 1.0, 1.5, 2.0):
        for slide in (0.0, 2.0, 5.0, 10.0, 20.0):
            changes = {"friction": friction}
            yield Cell("friction | slide, mm", f"{friction:g}", f"{slide:g}", slide_mm=slide, materials=changes)
    for tilt in (0.0, 10.0, 20.0, 30.0):
        for depth in (1.0, 3.0, 5.0, 8.0):
            yield Cell("tilt, degrees | depth, mm", f"{tilt:g}", f"{depth:g}", depth_mm=depth, slide_mm=2, tilt_deg=tilt)


def _objects() -> Iterator[Cell]:
    soft, stiff = {"skin_young_pa": 1e4, "gel_young_pa": 1e3}, {"skin_young_pa": 1e8, "gel_young_pa": 1e6}
    variants = {
        "soft tip": {"materials": soft},
        "stiff tip": {"materials": stiff},
        "friction 0.6": {"materials": {"friction": 0.6}},
        "friction 1": {"materials": {"friction": 1.0}},
        "no friction": {"materials": {"friction": 0.0}},
        "step 1 ms": {"motion": _paced(1e-3)},
        "step 20 ms": {"motion": _paced(20e-3)},
        "0.5 m/s": {"motion": {"press_step_m": 0.5 * _STANDARD.step_s}},
    }
    for name in STIMULI:
        for depth in (1.0, 3.0, 5.0, 8.0):
            yield Cell("stimulus | depth, mm", name, f"{depth:g}", stimulus=name, depth_mm=depth)
        for depth in (1.0, 3.0, 5.0, 8.0):
            panel = "stimulus, slid 3 mm | depth, mm"
            yield Cell(panel, name, f"{depth:g}", stimulus=name, depth_mm=depth, slide_mm=3)
        for depth in (0.5, 1.0, 3.0, 5.0):
            panel = "stimulus, starts inside | depth, mm"
            yield Cell(panel, name, f"{depth:g}", stimulus=name, depth_mm=depth, approach=False)
        for variant, changes in variants.items():
            yield replace(
                Cell("stimulus, 3 mm deep and slid 3 mm | variation", name, variant, stimulus=name, slide_mm=3), **changes
            )
