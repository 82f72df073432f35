"""Where the simulated contact converges, and where it is refused: `tactip bench stability`.

Every cell of a map over materials, friction, steps, depths, speeds and stimuli is one contact, played as data sets play
theirs: tried again with finer steps where its record is not to be trusted, and refused with a reason where that does not
help either, or where the configuration is known beforehand not to do. What is not refused is played once more with half
the step, and must come out the same. Writes docs/stability.md, .json and .png; stopped, it goes on where it was.
"""

import json
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.sim.contact.fidelity import FASTEST_M_S, FASTEST_SHEAR_M_S, Fidelity, fidelity_named, finer
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.simulator import UNPROVEN, ContactSimulator, RetryingSimulator
from tactip_twin.sim.contact.stimuli import STIMULI
from tactip_twin.sim.parallel.worker_pool import WorkerPool, worker_count
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim.view.plot import pyplot
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.presets import design_named

DESIGN = "nominal-127"

PINS_MM = 0.1
"""A converged cell's pins are this near those of half the step, mm rms."""

FORCE_SHARE = 0.05
"""And its normal force by this share of it, -, ..."""

FORCE_N = 0.01
"""... or by this much, N, where it is lighter than a fifth of a newton."""

VERDICTS = {
    "converged": "#4daf4a",
    "after refinement": "#a6d96a",
    "refused beforehand": "#bdbdbd",
    "refused": "#fdae61",
    "wrong": "#d7191c",
}
"""What a cell can be, and its colour in the figure."""

_STANDARD = fidelity_named("standard").motion


@dataclass(frozen=True)
class Cell:
    """One contact of the map."""

    panel: str
    """Part of the figure that it stands in."""
    row: str
    """Its row there ..."""
    column: str
    """... and its column."""
    stimulus: str = "surface"
    """A name of STIMULI."""
    depth_mm: float = 3.0
    """Depth of the press, mm."""
    slide_mm: float = 0.0
    """Slide along x in contact, mm."""
    tilt_deg: float = 0.0
    """Tilt about y, degrees."""
    approach: bool = True
    """False: it starts with the stimulus inside the skin."""
    materials: dict = field(default_factory=dict)
    """Changes to fields of the design's Materials ..."""
    shape: dict = field(default_factory=dict)
    """... and of its Shape ..."""
    motion: dict = field(default_factory=dict)
    """... and to those of the fidelity's Motion ..."""
    solver: dict = field(default_factory=dict)
    """... and of its Solver."""


def cells():
    """The map: a list of Cell."""
    return [*_materials(), *_numerics(), *_contacts(), *_objects(), *_beyond()]


def _materials():
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
            yield Cell("Poisson's ratio: skin | gel", f"{skin:g}", f"{gel:g}", slide_mm=2, materials=ratios)
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


def _numerics():
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
            yield Cell("iterations | tolerance", f"{iterations}", f"{tolerance:.0e}", slide_mm=2, solver=solver)


def _paced(step):
    """Changes (dict) to Motion for another time step (s): as long a rest, and the same way a step where that is allowed."""
    ratio = step / _STANDARD.step_s
    return {
        "step_s": step,
        "press_step_m": min(_STANDARD.press_step_m, FASTEST_M_S * step),
        "shear_step_m": min(_STANDARD.shear_step_m, FASTEST_SHEAR_M_S * step),
        "settle_steps": max(_STANDARD.settle_steps, round(_STANDARD.settle_steps / ratio)),
        "settle_limit": max(_STANDARD.settle_limit, round(_STANDARD.settle_limit / ratio)),
    }


def _contacts():
    for friction in (0.0, 0.1, 0.3, 0.6, 1.0, 1.5, 2.0):
        for slide in (0.0, 2.0, 5.0, 10.0, 20.0):
            changes = {"friction": friction}
            yield Cell("friction | slide, mm", f"{friction:g}", f"{slide:g}", slide_mm=slide, materials=changes)
    for tilt in (0.0, 10.0, 20.0, 30.0):
        for depth in (1.0, 3.0, 5.0, 8.0):
            yield Cell("tilt, degrees | depth, mm", f"{tilt:g}", f"{depth:g}", depth_mm=depth, slide_mm=2, tilt_deg=tilt)


def _objects():
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
            panel = "stimulus that starts inside | depth, mm"
            yield Cell(panel, name, f"{depth:g}", stimulus=name, depth_mm=depth, approach=False)
        for variant, changes in variants.items():
            yield Cell("stimulus | at 3 mm, with", name, variant, stimulus=name, slide_mm=3, **changes)


def _beyond():
    """Values that are known beforehand not to do."""
    panel = "beyond bounds"
    for name, low, high in (
        ("gel_young_pa", 999.0, 1.1e6),
        ("skin_young_pa", -1.0, 1.1e8),
        ("gel_poisson", -0.01, 0.5),
        ("skin_poisson", -0.01, 0.5),
        ("friction", -0.1, 2.1),
        ("density_kg_m3", 100.0, 11000.0),
        ("damping_s", 0.0, float("inf")),
    ):
        for column, value in (("below", low), ("above", high)):
            yield Cell(panel, name, column, materials={name: value})
    yield Cell(panel, "step_s", "below", motion={"step_s": 1e-5})
    yield Cell(panel, "step_s", "above", motion={"step_s": 21e-3})
    yield Cell(panel, "press_step_m", "above", motion={"press_step_m": 0.6 * _STANDARD.step_s})
    yield Cell(panel, "shear_step_m", "above", motion={"shear_step_m": 0.16 * _STANDARD.step_s})
    yield Cell(panel, "iterations", "below", solver={"iterations": 30})
    yield Cell(panel, "tolerance", "above", solver={"tolerance": 1e-4})
    yield Cell(panel, "depth", "above", depth_mm=8.1)
    yield Cell(panel, "slide", "above", slide_mm=20.1)
    yield Cell(panel, "tilt", "above", tilt_deg=31)
    yield Cell(panel, "radius_m", "below", shape={"radius_m": 9e-3})
    yield Cell(panel, "radius_m", "above", shape={"radius_m": 41e-3})


def judge(cell, fidelity):
    """Play a Cell at a Fidelity. Returns a dict: verdict, reasons (list of str), and what was measured."""
    result = {"verdict": "refused beforehand", "reasons": [], "tries": 0}
    pose = from_mm_deg([0, 0, -cell.depth_mm, 0, cell.tilt_deg, 0])
    shear = from_mm_deg([cell.slide_mm, 0, 0, 0, 0, 0])
    try:
        design, fidelity = _changed(cell, fidelity)
        player = RetryingSimulator(design, cell.stimulus, fidelity, QualityLimits())
        contact, faults = player.play(pose, shear, cell.approach)
    except TactipError as error:
        return result | {"reasons": [str(error)]}
    result["tries"] = min(len(faults) + 1, player.tries)
    result["first_try"] = faults[0] if faults else []
    result |= {name: _rounded(getattr(contact, name)) for name in _MEASURES}
    if len(faults) == player.tries:
        return result | {"verdict": "refused", "reasons": faults[-1]}
    for _ in faults:
        fidelity = finer(fidelity)
    half = ContactSimulator(design, cell.stimulus, finer(fidelity)).play(pose, shear, cell.approach)
    result |= {"half_step_" + key: value for key, value in _difference(contact, half).items()}
    differs = half.faults(QualityLimits()) + _disagreement(contact, half)
    if differs:
        return result | {"verdict": "wrong", "reasons": ["with half the step: " + text for text in differs]}
    refined = any(found != [UNPROVEN] for found in faults)
    return result | {"verdict": "after refinement" if refined else "converged"}


_MEASURES = (
    "normal_force_n",
    "tangential_force_n",
    "penetration_m",
    "overlap_m",
    "volume_ratio",
    "speed_m_s",
    "imbalance",
    "creep_m_s",
    "area_ratio",
    "fold_rad",
    "unsolved",
    "warnings",
    "steps",
)


def _rounded(number):
    """Six significant digits, and no number where it is not finite: JSON has none."""
    return float(f"{number:.6g}") if np.isfinite(number) else None


def _changed(cell, fidelity):
    """The Design and the Fidelity of a Cell. Raises TactipError where they do not do."""
    design = design_named(DESIGN)
    # Pins and skin go with the size of the dome, so that the radius alone is in question.
    share = cell.shape.get("radius_m", design.shape.radius_m) / design.shape.radius_m
    pins = design.pins
    small = {name: getattr(pins, name) * min(share, 1.0) for name in ("pitch_m", "length_m", "diameter_m", "rim_diameter_m")}
    design = replace(
        design,
        materials=replace(design.materials, **cell.materials),
        shape=replace(design.shape, **cell.shape),
        pins=replace(pins, **small),
    )
    motion, solver = replace(fidelity.motion, **cell.motion), replace(fidelity.solver, **cell.solver)
    return design, replace(fidelity, motion=motion, solver=solver)


def _difference(contact, half):
    """How far two Contacts are apart (dict)."""
    apart = 1e3 * np.linalg.norm(contact.tips - half.tips, axis=1)
    return {
        "force_n": _rounded(half.normal_force_n),
        "pins_rms_mm": _rounded(np.sqrt(np.mean(apart**2))),
        "pins_greatest_mm": _rounded(apart.max()),
    }


def _disagreement(contact, half):
    """Sentences (list) on where two Contacts are too far apart."""
    out, far = [], _difference(contact, half)
    if not (far["pins_rms_mm"] or 0.0) <= PINS_MM:
        out.append(f"pins {far['pins_rms_mm']:.3f} mm away (rms)")
    if abs(contact.normal_force_n - half.normal_force_n) > max(FORCE_SHARE * abs(half.normal_force_n), FORCE_N):
        out.append(f"a force of {half.normal_force_n:.4f} N instead of {contact.normal_force_n:.4f} N")
    return out


class _Judge:
    """Judges cells of the map in a worker, each result a file."""

    def __init__(self, folder, fidelity, quick):
        """folder: str, of the results. fidelity: Fidelity. quick: bool."""
        self._folder, self._fidelity = Path(folder), fidelity
        self._cells = _chosen(quick)

    def __call__(self, index):
        cell = self._cells[index]
        record = asdict(cell) | judge(cell, self._fidelity)
        write_file(_result_path(self._folder, index), json.dumps(record).encode())


def _chosen(quick):
    """The cells (list) of a whole run, or every seventh of a quick one."""
    return cells()[::7] if quick else cells()


def _result_path(folder, index):
    return folder / f"{index:04d}.json"


def _done(folder, index, cell):
    """The result (dict) of a Cell from an earlier run, or None."""
    path = _result_path(folder, index)
    if not path.exists():
        return None
    record = json.loads(path.read_text())
    expected = json.loads(json.dumps(asdict(cell)))
    return record if {key: record.get(key) for key in expected} == expected else None


def run(options, log=print):
    """Measure the map and write stability.json, .md and .png. options: StabilityOptions. log: called with lines for the
    user.

    Returns the result (dict). Raises Interrupted at Ctrl-C (what is done is kept) and OSError.
    """
    fidelity: Fidelity = fidelity_named("standard")
    out, quick, workers = options.out, options.quick, worker_count(options.workers)
    chosen = _chosen(quick)
    folder = out / (".stability-quick" if quick else ".stability")
    folder.mkdir(parents=True, exist_ok=True)
    todo = [i for i, cell in enumerate(chosen) if _done(folder, i, cell) is None]
    start = time.perf_counter()

    def report(*_):
        """Write the JSON so far, now and then."""
        records = [r for i, cell in enumerate(chosen) if (r := _done(folder, i, cell))]
        if len(records) % 50 == 0:
            _write_json(out, records, len(chosen), fidelity)

    if todo:
        WorkerPool(_Judge, (str(folder), fidelity, quick), todo, "cell", log).work(min(workers, len(todo)), report)
    records = [_done(folder, i, cell) for i, cell in enumerate(chosen)]
    result = _write_json(out, records, len(chosen), fidelity)
    write_file(out / "stability.md", page(result).encode())
    draw(result, out / "stability.png")
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    log(f"{len(todo)} cells in {time.perf_counter() - start:.0f} s: {_counts_text(records)}")
    return result


def _write_json(out, records, count, fidelity):
    """Write stability.json. Returns what it holds (dict)."""
    result = {
        "design": DESIGN,
        "fidelity": fidelity.name,
        "cells": count,
        "machine": machine(),
        "agreement": {"pins_rms_mm": PINS_MM, "force_share": FORCE_SHARE, "force_n": FORCE_N},
        "counts": _counts(records),
        "map": records,
    }
    write_file(out / "stability.json", (json.dumps(result, indent=1) + "\n").encode())
    return result


def _counts(records):
    return {verdict: sum(r["verdict"] == verdict for r in records) for verdict in VERDICTS}


def _counts_text(records):
    return ", ".join(f"{n} {verdict}" for verdict, n in _counts(records).items())


def _panels(records):
    """Records by panel: dict of name to (rows, columns, dict of (row, column) to record)."""
    panels = {}
    for r in records:
        rows, columns, grid = panels.setdefault(r["panel"], ([], [], {}))
        rows += [r["row"]] if r["row"] not in rows else []
        columns += [r["column"]] if r["column"] not in columns else []
        grid[r["row"], r["column"]] = r
    return panels


def draw(result, path):
    """Draw the map of a result (dict) to `path` (Path, .png)."""
    from matplotlib.patches import Patch, Rectangle

    plt = pyplot()
    panels = _panels(result["map"])
    across = 4
    down = -(-len(panels) // across)
    figure, axes = plt.subplots(down, across, figsize=(4.6 * across, 3.5 * down), squeeze=False)
    for axis in axes.ravel()[len(panels) :]:
        axis.axis("off")
    for axis, (name, (rows, columns, grid)) in zip(axes.ravel(), panels.items(), strict=False):
        for i, row in enumerate(rows):
            for j, column in enumerate(columns):
                record = grid.get((row, column))
                colour = VERDICTS[record["verdict"]] if record else "white"
                axis.add_patch(Rectangle((j, i), 1, 1, facecolor=colour, edgecolor="white"))
        axis.set(xlim=(0, len(columns)), ylim=(len(rows), 0))
        axis.set_xticks(np.arange(len(columns)) + 0.5, columns, rotation=35 if max(map(len, columns)) > 6 else 0, fontsize=8)
        axis.set_yticks(np.arange(len(rows)) + 0.5, rows, fontsize=8)
        axis.tick_params(length=0)
        down_name, _, across_name = name.partition(" | ")
        axis.set_title(name if not across_name else "", fontsize=9)
        axis.set_xlabel(across_name, fontsize=9)
        axis.set_ylabel(down_name if across_name else "", fontsize=9)
    handles = [Patch(color=colour, label=f"{v} ({result['counts'][v]})") for v, colour in VERDICTS.items()]
    figure.legend(handles=handles, loc="upper center", ncols=len(handles), fontsize=11, frameon=False)
    figure.tight_layout(rect=(0, 0, 1, 0.97))
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def page(result):
    """The Markdown (str) of a result."""
    counts, records = result["counts"], result["map"]
    good = [r for r in records if r["verdict"] in ("converged", "after refinement")]
    lines = [
        "# Where a contact converges, and where it is refused",
        "",
        f"Written by `tactip bench stability`; do not edit. {result['design']}, fidelity `{result['fidelity']}`, on: "
        + machine_text(result["machine"])
        + ".",
        "",
        "Each cell is one contact, on the surface 3 mm deep unless the cell says otherwise. *Converged*: its record keeps "
        "all bounds (`sim/contact/simulator.py`), and half the step gives the same: pins within "
        f"{result['agreement']['pins_rms_mm']} mm rms, force within {100 * result['agreement']['force_share']:.0f} % or "
        f"{1e3 * result['agreement']['force_n']:.0f} mN. *After refinement*: the same, at the second or third try, each "
        "with half the step of the one before. *Refused*: three tries, none to be trusted; four where skin may catch by "
        "chance, and two records must agree. *Refused beforehand*: by "
        "the bounds beside each field of the configuration, or of the pose. *Wrong*: a record that keeps all bounds, but "
        "not its promise.",
        "",
        "![map](stability.png)",
        "",
        "| " + " | ".join(counts) + " | in all |",
        "|" + "---|" * (len(counts) + 1),
        "| " + " | ".join(str(n) for n in counts.values()) + f" | {len(records)} |",
        "",
    ]
    if good:
        force = max(
            abs(r["half_step_force_n"] - r["normal_force_n"]) / max(abs(r["half_step_force_n"]), FORCE_N / FORCE_SHARE)
            for r in good
        )
        pins = sorted(r["half_step_pins_rms_mm"] for r in good)
        lines += [
            f"Between a converged cell and half its step: pins {pins[len(pins) // 2]:.3f} mm rms in the median, "
            f"{pins[-1]:.3f} mm at most; force {100 * force:.1f} % at most. Greatest penetration "
            f"{1e3 * max(r['penetration_m'] for r in good):.3f} mm, overlap by shape "
            f"{1e3 * max(r['overlap_m'] for r in good):.3f} mm, smallest element "
            f"{min(r['volume_ratio'] for r in good):.2f} of its volume.",
            "",
        ]
    lines += [
        "## By panel",
        "",
        "| panel (rows, columns) | " + " | ".join(VERDICTS) + " |",
        "|" + "---|" * (len(VERDICTS) + 1),
    ]
    for name, (_, _, grid) in _panels(records).items():
        by = _counts(grid.values())
        lines.append(f"| {name.replace(' | ', ', ')} | " + " | ".join(str(by[v]) for v in VERDICTS) + " |")
    for verdict, title in (
        ("wrong", "Wrong"),
        ("refused", "Refused after all tries"),
        ("refused beforehand", "Refused beforehand"),
    ):
        chosen = [r for r in records if r["verdict"] == verdict]
        if chosen:
            lines += ["", f"## {title}", "", "| cell | why |", "|---|---|"]
            for r in chosen:
                down_name, _, across_name = r["panel"].partition(" | ")
                where = f"{down_name}: {r['row']}, {across_name}: {r['column']}".replace(", :", ",")
                lines.append(f"| {where} | {'; '.join(r['reasons'])} |")
    return "\n".join(lines) + "\n"
