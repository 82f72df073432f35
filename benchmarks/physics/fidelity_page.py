"""Tables and figure of error against run time, from the results of benchmarks/physics/fidelity.py."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tactip_twin.benchmarks.hardware import machine_text
from tactip_twin.benchmarks.physics.pose_sensitivity import STEP
from tactip_twin.benchmarks.report import table
from tactip_twin.sim.view.plot import COLORS, figure_of, log_axis, save_figure

_HIGHLIGHTED = (
    "mesh spacing at the surface, mm",
    "shear per step, mm",
    "approach per step, mm",
    "solver tolerance in motion",
    "contact stiffness in motion",
)
"""Settings that the figure shows in colour; the others are grey."""

_SMALL_CHANGE = 0.25
"""Relative change of error and cost below which the table only names a setting."""

_NAMES = {"x": "x, mm", "y": "y, mm", "z": "depth, mm", "Rx": "roll, °", "Ry": "pitch, °", "Rz": "yaw, °"}


def _triple(errors: Sequence[float]) -> str:
    return " / ".join(f"{e:.3f}" for e in errors)


def _label(label: Mapping[str, float], components: Iterable[str]) -> list[str]:
    """Return cells of label errors."""
    return [f"{label[c]:.{3 if c in 'xyz' else 2}f}" if c in label else "–" for c in components]


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/fidelity.md from fidelity.json."""
    return {
        "presets": _presets(result),
        "labels": _labels(result),
        "cases": _cases(result),
        "reference": _reference(result["reference"]),
        "sweeps": _sweeps(result),
        "renderers": _renderers(result),
    }


def _presets(result: dict[str, Any]) -> str:
    head = ["task", "preset", "degrees of freedom", "steps", "pin error, mm", "of it steps and solver, mm", "force error"]
    rows = [
        [
            *(r["task"], r["preset"], str(r["degrees_of_freedom"]), f"{r['steps']:g}", _triple(r["pins_mm"])),
            *(f"{r['steps_mm'][0]:.3f}", f"{r['force_percent']:.1f} %", f"{r['megabytes']:.1f}"),
            *(f"{r['cost']:.2f}", f"{r['seconds']:.3f}"),
        ]
        for r in result["presets"]
    ]
    machine = (
        f"Machine: {machine_text(result['machine'])}. Settings: first {result['contacts_per_task']} contacts of a task."
    )
    return table([*head, "memory, MB", "cost", "CPU time, s"], rows) + "\n\n" + machine


def _labels(result: dict[str, Any]) -> str:
    rows = [r for r in result["presets"] if r["preset"] != "reference"]
    components = [c for c in STEP if any(c in r["label"] for r in rows)]
    cells = ([r["task"], r["preset"], *_label(r["label"], components)] for r in rows)
    return table(["task", "preset", *(_NAMES[c] for c in components)], cells)


def _cases(result: dict[str, Any]) -> str:
    found = {(r["case"], r["preset"]): r for r in result["cases"]}
    rows = []
    for case in dict.fromkeys(r["case"] for r in result["cases"]):
        pair = [found[case, preset] for preset in ("draft", "standard")]
        motions = (pair[0][key] for key in ("pose_mm_deg", "shear_mm_deg"))
        cells = [case, "; ".join(" ".join(f"{v:g}" for v in motion) for motion in motions if any(motion))]
        cells += [f"{found[case, 'reference']['force_n']:.2f}", *(_triple(r["pins_mm"]) for r in pair)]
        rows.append([*cells, *(f"{r['force_percent']:.1f} %" for r in pair)])
    head = ["case", "pose; shear", "force, N", "pins at draft, mm", "pins at standard, mm"]
    return table([*head, "force at draft", "force at standard"], rows)


def _reference(reference: dict[str, Any]) -> str:
    rows = []
    for row in reference["rows"]:
        mesh, half = row["mesh"], row["half_the_steps"]
        remains = "–" if mesh["remains_mm"] is None else f"{mesh['remains_mm'][0]:.3f}"
        cells = [row["case"], " → ".join(f"{d:.3f}" for d in mesh["differences_mm"]), f"{mesh['order']:.1f}", remains]
        cells += [" → ".join(f"{f:.2f}" for f in mesh["forces_n"])]
        rows.append([*cells, f"{half['pins_mm'][0]:.3f}", f"{half['force_percent']:.2f} %"])
    head = ["case", "refined mesh: change of pins, mm", "order", "estimated remaining error, mm", "force, N"]
    spacings = " → ".join(f"{s:.2f}" for s in reference["spacings_mm"])
    note = f"Mesh spacings at the surface: {spacings} mm; the preset has 1.20 mm."
    return table([*head, "half the steps: change of pins, mm", "of force"], rows) + "\n\n" + note


def _sweeps(result: dict[str, Any]) -> str:
    tasks = list(dict.fromkeys(r["task"] for r in result["sweeps"]))
    found = {(r["task"], r["what"], r["value"]): r for r in result["sweeps"]}
    standard = {task: found[task, "preset", "standard"] for task in tasks}
    rows, small = [["standard", "", *(f"{standard[t]['pins_mm'][0]:.3f}" for t in tasks), *(["1.00"] * len(tasks)), "0"]], []
    for what in dict.fromkeys(r["what"] for r in result["sweeps"] if r["what"] != "preset"):
        values = list(dict.fromkeys(r["value"] for r in result["sweeps"] if r["what"] == what))
        columns = {task: [found[task, what, value] for value in values] for task in tasks}
        changes = [abs(r["cost"] - 1) for task in tasks for r in columns[task]]
        changes += [abs(r["pins_mm"][0] / standard[t]["pins_mm"][0] - 1) for t in tasks for r in columns[t]]
        failed = [sum(columns[task][k]["untrusted"] for task in tasks) for k in range(len(values))]
        if max(changes) < _SMALL_CHANGE and not any(failed):
            small.append(what)
            continue
        errors = (" / ".join(f"{r['pins_mm'][0]:.3f}" for r in columns[task]) for task in tasks)
        costs = (" / ".join(f"{r['cost']:.2f}" for r in columns[task]) for task in tasks)
        rows.append([what, " / ".join(values), *errors, *costs, " / ".join(map(str, failed))])
    head = ["setting", "values", *(f"{t}: pin error, mm" for t in tasks), *(f"{t}: cost" for t in tasks), "contacts refused"]
    note = f"First {result['sweep_contacts_per_task']} contacts of each task."
    if small:
        note += f" Settings that change error and cost by less than {_SMALL_CHANGE:.0%}: {'; '.join(small)}."
    return table(head, rows) + "\n\n" + note


def _renderers(result: dict[str, Any]) -> str:
    rows = []
    for r in result["renderers"]:
        binary, blobs, ms = r["binary_percent"], r["blobs_px"], r["milliseconds"]
        grey = " / ".join(f"{g:.{n}f}" for g, n in zip(r["grey_levels"], (2, 0, 0), strict=True))
        cells = [r["task"], str(r["images"]), grey, f"{binary[0]:.2f} % ({binary[1]:.2f} %)"]
        cells += [f"{blobs[0]:.3f} ({blobs[1]:.2f})", f"{r['label']['z']:.3f}", f"{ms['raster']:.1f}"]
        rows.append([*cells, f"{ms['pyrender']:.1f}"])
    head = ["task", "images", "grey levels: mean / 99.9 % / max", "binary pixels that differ: mean (max)"]
    return table([*head, "pin distance, px: mean (max)", "depth error, mm", "raster, ms", "pyrender, ms"], rows)


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot mean pin error against cost, one panel per task, into a PNG file."""
    tasks = list(dict.fromkeys(r["task"] for r in result["sweeps"]))
    figure, panels = figure_of(1, len(tasks), (4.6 * len(tasks), 5.0))
    for axis, task in zip(panels, tasks, strict=True):
        rows = [r for r in result["sweeps"] if r["task"] == task]
        presets = {r["value"]: r for r in rows if r["what"] == "preset"}
        for what in dict.fromkeys(r["what"] for r in rows if r["what"] != "preset"):
            chosen = [*(r for r in rows if r["what"] == what), presets["standard"]]
            points = sorted((r["cost"], r["pins_mm"][0]) for r in chosen)
            color = COLORS[_HIGHLIGHTED.index(what)] if what in _HIGHLIGHTED else "0.8"
            label = what if what in _HIGHLIGHTED and axis is panels[0] else None
            axis.plot(*zip(*points, strict=True), ".-", lw=1, ms=4, label=label, color=color, zorder=1 + (color != "0.8"))
        for name, offset in (("draft", (8, 6)), ("standard", (8, -16))):
            cost, error = presets[name]["cost"], presets[name]["pins_mm"][0]
            axis.plot(cost, error, "o", ms=8, color="k", zorder=3)
            axis.annotate(name, (cost, error), offset, textcoords="offset points", weight="bold", zorder=3)
        own = [r for r in result["reference"]["rows"] if r["case"].startswith("edge" if task == "edge" else "flat")]
        cost, next_mesh = presets["reference"]["cost"], max(r["mesh"]["differences_mm"][-1] for r in own)
        axis.plot(cost, next_mesh, "o", ms=8, mfc="w", mec="k", zorder=3)
        place = {"xytext": (-8, 8), "textcoords": "offset points", "ha": "right"}
        axis.annotate("reference*", (cost, next_mesh), weight="bold", **place)
        log_axis(axis, "x")
        log_axis(axis, "y")
        axis.set(xlabel="CPU time per contact relative to standard", title=f"{task} contacts")
    panels[0].set_ylabel("mean pin error, mm")
    low, high = min(a.get_ylim()[0] for a in panels), max(a.get_ylim()[1] for a in panels)
    for axis in panels:
        axis.set_ylim(low, high)
    panels[0].plot([], [], color="0.8", label="other settings")
    finest = f"* change of pins on a finer mesh ({result['reference']['spacings_mm'][-1]:.2f} mm)"
    figure.legend(loc="outside lower center", ncols=3, title=f"one setting of standard changed; {finest}")
    save_figure(figure, path)
