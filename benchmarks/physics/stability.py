"""Map of where the simulated contact converges and where it is refused: `tactip bench stability`.

Every cell of a map over materials, friction, steps, depths, speeds and stimuli is one contact, simulated as for data sets.
It is repeated with finer steps if its record fails the checks, and refused with a reason if that does not help or if its
configuration is out of bounds. A contact that is not refused is simulated once more with half the step, and must give the
same result. An interrupted measurement resumes. Writes docs/stability.md, .json and .png.
"""

import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.physics.options import StabilityOptions
from tactip_twin.benchmarks.physics.stability_map import Cell, cells
from tactip_twin.benchmarks.report import table, write_results
from tactip_twin.sim.contact.fidelity import Fidelity, fidelity_named, finer
from tactip_twin.sim.contact.record import Contact, QualityLimits
from tactip_twin.sim.contact.retries import UNCONFIRMED, RetryingSimulator
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.parallel.worker_pool import WorkerPool, worker_count
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim.view.plot import figure_of, save_figure
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.presets import design_named

DESIGN = "nominal-127"

PINS_MM = 0.1
"""Maximum distance of a converged cell's pins from those with half the step, mm rms."""

FORCE_FRACTION = 0.05
"""Maximum difference of its normal force from that with half the step, relative to the latter, -, ..."""

FORCE_N = 0.01
"""... or in N, if the force is below a fifth of a newton."""

VERDICTS = {
    "converged": "#4daf4a",
    "after refinement": "#a6d96a",
    "refused beforehand": "#bdbdbd",
    "refused": "#fdae61",
    "wrong": "#d7191c",
}
"""Colours of the verdicts in the figure."""


def judge(cell: Cell, fidelity: Fidelity) -> dict[str, Any]:
    """Simulate a cell; return its verdict, the reasons (list[str]) and the measurements."""
    result: dict[str, Any] = {"verdict": "refused beforehand", "reasons": [], "tries": 0}
    pose = from_mm_deg([0, 0, -cell.depth_mm, 0, cell.tilt_deg, 0])
    shear = from_mm_deg([cell.slide_mm, 0, 0, 0, 0, 0])
    try:
        design, fidelity = _changed(cell, fidelity)
        simulator = RetryingSimulator(design, cell.stimulus, fidelity, QualityLimits())
        contact, violations = simulator.simulate(pose, shear, cell.approach)
    except TactipError as error:
        return result | {"reasons": [str(error)]}
    result["tries"] = min(len(violations) + 1, simulator.tries)
    result["first_try"] = violations[0] if violations else []
    result |= {name: _rounded(getattr(contact, name)) for name in _MEASURES}
    if len(violations) == simulator.tries:
        return result | {"verdict": "refused", "reasons": violations[-1]}
    half = ContactSimulator(design, cell.stimulus, finer(simulator.last.scene.fidelity)).simulate(pose, shear, cell.approach)
    result |= {"half_step_" + key: value for key, value in _difference(contact, half).items()}
    differs = half.violations(QualityLimits()) + _disagreement(contact, half)
    if differs:
        return result | {"verdict": "wrong", "reasons": ["with half the step: " + text for text in differs]}
    refined = any(found != [UNCONFIRMED] for found in violations)
    return result | {"verdict": "after refinement" if refined else "converged"}


_MEASURES = (
    "normal_force_n",
    "tangential_force_n",
    "penetration_m",
    "overlap_m",
    "volume_ratio",
    "speed_m_s",
    "imbalance",
    "energy_drift_m_s",
    "area_ratio",
    "fold_rad",
    "unconverged_fraction",
    "warnings",
    "steps",
)


def _rounded(number: float) -> float | None:
    """Return a number with six significant digits, or None if it is not finite, because JSON cannot hold that."""
    return float(f"{number:.6g}") if np.isfinite(number) else None


def _changed(cell: Cell, fidelity: Fidelity) -> tuple[Design, Fidelity]:
    """Return the design and the fidelity of a cell. Raises TactipError if they are out of bounds."""
    design = design_named(DESIGN)
    # Pins and skin scale with a smaller dome, so only the radius can be out of bounds.
    scale = cell.shape.get("radius_m", design.shape.radius_m) / design.shape.radius_m
    pins = design.pins
    small = {name: getattr(pins, name) * min(scale, 1.0) for name in ("pitch_m", "length_m", "diameter_m", "rim_diameter_m")}
    design = replace(
        design,
        materials=replace(design.materials, **cell.materials),
        shape=replace(design.shape, **cell.shape),
        pins=replace(pins, **small),
    )
    motion, solver = replace(fidelity.motion, **cell.motion), replace(fidelity.solver, **cell.solver)
    return design, replace(fidelity, motion=motion, solver=solver)


def _difference(contact: Contact, half: Contact) -> dict[str, float | None]:
    """Return the force of a contact with half the step, and the pins' distance from the contact with the whole step."""
    apart = 1e3 * np.linalg.norm(contact.pin_tips - half.pin_tips, axis=1)
    return {
        "force_n": _rounded(half.normal_force_n),
        "pins_rms_mm": _rounded(np.sqrt(np.mean(apart**2))),
        "pins_greatest_mm": _rounded(apart.max()),
    }


def _disagreement(contact: Contact, half: Contact) -> list[str]:
    """Return sentences on where two contacts are too far apart."""
    out, far = [], _difference(contact, half)
    apart = far["pins_rms_mm"] or 0.0
    if apart > PINS_MM:
        out.append(f"pins {apart:.3f} mm away (rms)")
    if abs(contact.normal_force_n - half.normal_force_n) > max(FORCE_FRACTION * abs(half.normal_force_n), FORCE_N):
        out.append(f"a force of {half.normal_force_n:.4f} N instead of {contact.normal_force_n:.4f} N")
    return out


class _Judge:
    """Worker task: judges cells of the map, and writes each result to a file."""

    def __init__(self, folder: str, fidelity: Fidelity, quick: bool) -> None:
        """Prepare to judge.

        Args:
            folder: Of the results.
            fidelity: Mesh, steps and solver.
            quick: As in StabilityOptions.
        """
        self._folder, self._fidelity = Path(folder), fidelity
        self._cells = _chosen(quick)

    def __call__(self, index: int) -> None:
        cell = self._cells[index]
        record = asdict(cell) | judge(cell, self._fidelity)
        write_file(_result_path(self._folder, index), json.dumps(record).encode())


def _chosen(quick: bool) -> list[Cell]:
    """Return the cells of a whole run, or every seventh for a quick one."""
    return cells()[::7] if quick else cells()


def _result_path(folder: Path, index: int) -> Path:
    return folder / f"{index:04d}.json"


def _done(folder: Path, index: int, cell: Cell) -> dict[str, Any] | None:
    """Return the result of a cell from an earlier run, or None."""
    path = _result_path(folder, index)
    if not path.exists():
        return None
    record = json.loads(path.read_text())
    expected = json.loads(json.dumps(asdict(cell)))
    return record if {key: record.get(key) for key in expected} == expected else None


def run(options: StabilityOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure the map, write stability.json, .md and .png, and return the results. Progress goes to `log`.

    Raises Interrupted on Ctrl-C, which keeps the finished cells, and OSError.
    """
    fidelity: Fidelity = fidelity_named("standard")
    out, quick, workers = options.out, options.quick, worker_count(options.workers)
    chosen = _chosen(quick)
    folder = out / (".stability-quick" if quick else ".stability")
    folder.mkdir(parents=True, exist_ok=True)
    todo = [i for i, cell in enumerate(chosen) if _done(folder, i, cell) is None]
    start = time.perf_counter()

    if todo:
        WorkerPool(_Judge, (str(folder), fidelity, quick), todo, "cell", log).work(
            min(workers, len(todo)), lambda *done: None
        )
    records = [r for i, cell in enumerate(chosen) if (r := _done(folder, i, cell))]
    result = _result(records, len(chosen), fidelity)
    write_results("stability", result, tables(result), out)
    plot(result, out / "stability.png")
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    log(f"{len(todo)} cells in {time.perf_counter() - start:.0f} s: {_counts_text(records)}")
    return result


def _result(records: list[dict[str, Any]], count: int, fidelity: Fidelity) -> dict[str, Any]:
    """Return the content of stability.json."""
    return {
        "design": DESIGN,
        "fidelity": fidelity.name,
        "cells": count,
        "machine": machine(),
        "agreement": {"pins_rms_mm": PINS_MM, "force_share": FORCE_FRACTION, "force_n": FORCE_N},
        "counts": _counts(records),
        "map": records,
    }


def _counts(records: Iterable[dict[str, Any]]) -> dict[str, int]:
    return {verdict: sum(r["verdict"] == verdict for r in records) for verdict in VERDICTS}


def _counts_text(records: Iterable[dict[str, Any]]) -> str:
    return ", ".join(f"{n} {verdict}" for verdict, n in _counts(records).items())


Panel = tuple[list[str], list[str], dict[tuple[str, str], dict[str, Any]]]
"""Rows, columns, and records by row and column of a panel."""


def _panels(records: Iterable[dict[str, Any]]) -> dict[str, Panel]:
    """Return the records by the name of their panel."""
    panels: dict[str, Panel] = {}
    for r in records:
        rows, columns, grid = panels.setdefault(r["panel"], ([], [], {}))
        rows += [r["row"]] if r["row"] not in rows else []
        columns += [r["column"]] if r["column"] not in columns else []
        grid[r["row"], r["column"]] = r
    return panels


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot the map of a result into a PNG file."""
    from matplotlib.patches import Patch, Rectangle

    panels = _panels(result["map"])
    across = 3
    down = -(-len(panels) // across)
    figure, axes = figure_of(down, across, (4.2 * across, 3.0 * down))
    for axis in axes[len(panels) :]:
        axis.axis("off")
    for axis, (name, (rows, columns, grid)) in zip(axes, panels.items(), strict=False):
        for i, row in enumerate(rows):
            for j, column in enumerate(columns):
                record = grid.get((row, column))
                color = VERDICTS[record["verdict"]] if record else "white"
                axis.add_patch(Rectangle((j, i), 1, 1, facecolor=color, edgecolor="white"))
        axis.set(xlim=(0, len(columns)), ylim=(len(rows), 0))
        axis.grid(visible=False)
        tilted = {"rotation": 30, "ha": "right"} if max(map(len, columns)) > 6 else {}
        axis.set_xticks(np.arange(len(columns)) + 0.5, columns, **tilted)
        axis.set_yticks(np.arange(len(rows)) + 0.5, rows)
        axis.tick_params(length=0, labelsize=8)
        down_name, _, across_name = name.partition(" | ")
        axis.set(xlabel=across_name or "side of the bound", ylabel=down_name if across_name else "field")
        axis.set_title("" if across_name else name)
    handles = [Patch(color=color, label=f"{v} ({result['counts'][v]})") for v, color in VERDICTS.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    save_figure(figure, path)


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/stability.md from stability.json."""
    counts, records = result["counts"], result["map"]
    state = f"Machine: {machine_text(result['machine'])}. Design `{result['design']}`, fidelity `{result['fidelity']}`."
    counted = table([*counts, "in total"], [[*map(str, counts.values()), str(len(records))]])
    refused = [
        [r["panel"].replace(" | ", " / "), f"{r['row']} / {r['column']}", "; ".join(r["reasons"])]
        for r in records
        if r["verdict"] in ("refused", "wrong")
    ]
    return {
        "counts": f"{counted}\n\n{state}",
        "differences": _differences([r for r in records if r["verdict"] in ("converged", "after refinement")]),
        "refused": table(["panel", "cell", "reason"], refused) if refused else "None.",
    }


def _differences(good: Sequence[Mapping[str, Any]]) -> str:
    """Return a table of the accepted cells: differences between a step and half of it, and extremes of the records."""
    if not good:
        return "No cell was accepted."
    pins = [r["half_step_pins_rms_mm"] for r in good]
    scale = FORCE_N / FORCE_FRACTION
    force = max(abs(r["half_step_force_n"] - r["normal_force_n"]) / max(abs(r["half_step_force_n"]), scale) for r in good)
    rows = [
        ["change of pins at half the step, median", f"{np.median(pins):.3f} mm rms"],
        ["change of pins at half the step, maximum", f"{max(pins):.3f} mm rms"],
        ["change of force at half the step, maximum", f"{100 * force:.1f} %"],
        ["penetration, maximum", f"{1e3 * max(r['penetration_m'] for r in good):.3f} mm"],
        ["overlap of the shapes, maximum", f"{1e3 * max(r['overlap_m'] for r in good):.3f} mm"],
        ["volume of an element relative to its undeformed volume, minimum", f"{min(r['volume_ratio'] for r in good):.2f}"],
    ]
    return table(["accepted cells", "value"], rows)
