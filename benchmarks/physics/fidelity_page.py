"""Page and figure of error against run time, from the results of benchmarks/physics/fidelity.py."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.figure

from tactip_twin.benchmarks.hardware import machine_text
from tactip_twin.benchmarks.physics.pose_sensitivity import STEP

PIN_BOUND_MM = 0.05
"""Allowed mean pin error of `standard` against the reference, mm."""

_NAMED = {
    "spacing on the surface, mm": "C0",
    "travel of the skin a step of the shear, mm": "C1",
    "approach a step, mm": "C2",
    "solver's tolerance in motion": "C4",
    "contact in motion, stiffness": "C5",
}
"""Colours of the sweeps that the figure names; the others are grey."""

_UNITS = {c: "mm" if c in "xyz" else "°" for c in STEP}
_WORDS = {"z": "depth", "Rx": "roll", "Ry": "pitch", "Rz": "yaw"}


def triple(errors: Sequence[float]) -> str:
    """Return a mean, a 95th percentile and a maximum as text."""
    return " / ".join(f"{e:.3f}" for e in errors)


def label(worth: Mapping[str, float]) -> str:
    """Return what an error is worth in the label (mm or degrees by component, and `contacts`) as text."""
    parts = [
        f"{_WORDS.get(c, c)} {worth[c]:.{3 if unit == 'mm' else 2}f} {unit}" for c, unit in _UNITS.items() if c in worth
    ]
    return ", ".join(parts) or "–"


def markdown(result: dict[str, Any]) -> str:
    """Return the page of a result."""
    lines = [
        "# Error against run time",
        "",
        "Written by `tactip bench fidelity`; do not edit. 127-pin tip, one core of: "
        + machine_text(result["machine"])
        + ".",
        "",
        "Pins: distance of their tips in mm, mean / 95th percentile / greatest. Force: its error over the force, summed "
        "over contacts. Label: the change of pose that moves the pins in the tactile image as the error does (least squares "
        "about each contact, median over contacts); contacts that hardly touch, and so do not tell their pose, are left "
        "out. Cost: CPU time of a contact over that of the same contact at `standard` just before, median. Memory: MuJoCo's "
        "model and data.",
        "",
        "![error against cost](fidelity.png)",
        "",
        *_presets(result),
        *_cases(result),
        *_reference(result),
        *_sweeps(result),
        *_renderers(result),
    ]
    return "\n".join(lines) + "\n"


def _presets(result: dict[str, Any]) -> Iterator[str]:
    yield "## Presets"
    yield ""
    yield (
        f"The first {result['contacts_a_task']} contacts of each training set of seed 0. *Steps and solver*: against the "
        "same mesh played as the reference is, at half its steps. *In all*: against the preset `reference`."
    )
    yield ""
    yield (
        "| contacts | preset | degrees of freedom | steps | memory, MB | steps and solver, mm | in all, mm | force | "
        "label | cost | CPU, s |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|---|"
    for r in result["presets"]:
        yield (
            f"| {r['task']} | {r['preset']} | {r['degrees_of_freedom']} | {r['steps']:g} | {r['megabytes']:.1f} | "
            f"{triple(r['steps_mm'])} | {triple(r['pins_mm'])} | {r['force_percent']:.1f} % | {label(r['label'])} | "
            f"{r['cost']:.2f} | {r['seconds']:.3f} |"
        )
    means = {r["task"]: r["pins_mm"][0] for r in result["presets"] if r["preset"] == "standard"}
    verdict = "kept" if max(means.values()) <= PIN_BOUND_MM else "NOT kept"
    yield ""
    yield (
        f"`standard` is held to a mean pin error of {PIN_BOUND_MM} mm: {verdict} ("
        + ", ".join(f"{task} {mean:.3f} mm" for task, mean in means.items())
        + ")."
    )
    yield ""


def _cases(result: dict[str, Any]) -> Iterator[str]:
    yield "## Cases"
    yield ""
    yield (
        "Against the reference. Pose and shear in mm and degrees, axes of `sim/pose.py`; the sphere has a radius of 5 mm, "
        "the peg a round end of 1 mm."
    )
    yield ""
    yield "| case | pose; shear | preset | pins, mm | force | of, N | label | cost |"
    yield "|---|---|---|---|---|---|---|---|"
    for r in result["cases"]:
        if r["preset"] == "reference":
            continue
        motion = "; ".join(" ".join(f"{v:g}" for v in r[k]) for k in ("pose_mm_deg", "shear_mm_deg") if any(r[k]))
        yield (
            f"| {r['case']} | {motion} | {r['preset']} | {triple(r['pins_mm'])} | {r['force_percent']:.1f} % | "
            f"{r['force_n']:.2f} | {label(r['label'])} | {r['cost']:.2f} |"
        )
    yield ""


def _reference(result: dict[str, Any]) -> Iterator[str]:
    reference = result["reference"]
    spacings = " → ".join(f"{s:.2f}" for s in reference["spacings_mm"])
    fractions = " → ".join(f"{s:g}" for s in reference["shares_of_steps"])
    yield "## The reference itself"
    yield ""
    yield (
        f"Its mesh refined in proportion (surface {spacings} mm; 1.20 is the reference) and, on the mesh of `standard`, "
        f"its steps ({fractions} of their length in time and way, tolerance and settling with them; 1 is the reference). "
        "Differences of pins between neighbours in the sequence, mean mm. The observed order is that of the last two; from "
        "it Richardson's estimate of the error that remains at the reference. Below an order of one half differences do not "
        "fall as they should, and no estimate is given. Meshes are not nested: where the skin's vertices lie is chance, and "
        "so is a part of the difference."
    )
    yield ""
    yield "| case | mesh: differences, mm | order | remains | steps: differences, mm | order | remains | half the steps |"
    yield "|---|---|---|---|---|---|---|---|"
    for row in reference["rows"]:
        cells = [row["case"]]
        # Of the meshes the reference is the last but one; of the steps the last but two: one difference more remains.
        for kind, more in (("mesh", 0), ("steps", 1)):
            s = row[kind]
            remains = None if s["remains_mm"] is None else s["remains_mm"][0] + (s["differences_mm"][1] if more else 0.0)
            cells += [
                ", ".join(f"{d:.4f}" for d in s["differences_mm"]),
                f"{s['order']:.1f}",
                "does not behave" if remains is None else f"{remains:.3f} mm",
            ]
        half = row["half_the_steps"]
        cells.append(f"{triple(half['pins_mm'])} mm, force {half['force_percent']:.2f} %")
        yield "| " + " | ".join(cells) + " |"
    yield ""
    rows = reference["rows"]
    last = [row["mesh"]["differences_mm"][-1] for row in rows]
    remains = [row["mesh"]["remains_mm"][0] for row in rows if row["mesh"]["remains_mm"]]
    half = max(row["half_the_steps"]["pins_mm"][0] for row in rows)
    forces = "; ".join(f"{row['case']}: {', '.join(f'{f:.3f}' for f in row['mesh']['forces_n'])} N" for row in rows)
    yield (
        f"In steps and solver the reference has converged: half of them (*half the steps*, on its own mesh) move pins by "
        f"{half:.3f} mm at most in the mean. In its mesh, the next refinement moves them by {min(last):.3f} to "
        f"{max(last):.3f} mm"
        + (f", and Richardson's estimate is that {max(remains):.3f} mm remain at most" if remains else "")
        + ". A preset's error *in all* says how near it is to the reference, and not nearer to the truth than that. Forces "
        f"over the meshes: {forces}."
    )
    yield ""


def _sweeps(result: dict[str, Any]) -> Iterator[str]:
    yield "## One number at a time"
    yield ""
    yield (
        f"`standard` with one number changed, on the first {result['swept_contacts_a_task']} contacts of each training set. "
        "*Steps and solver* as above, where the mesh is not what is changed. *Not trusted*: contacts whose record does not "
        "keep the bounds of `sim/contact/simulator.py`."
    )
    for task in dict.fromkeys(r["task"] for r in result["sweeps"]):
        rows = [r for r in result["sweeps"] if r["task"] == task]
        yield ""
        yield f"### {task}"
        yield ""
        yield (
            "| what | value | steps and solver, mm | in all, mm | force | label | penetration, mm | speed, mm/s | "
            "not trusted | steps | cost |"
        )
        yield "|---|---|---|---|---|---|---|---|---|---|---|"
        for r in rows:
            steps = triple(r["steps_mm"]) if "steps_mm" in r else "–"
            yield (
                f"| {r['what']} | {r['value']} | {steps} | {triple(r['pins_mm'])} | {r['force_percent']:.1f} % | "
                f"{label(r['label'])} | {r['penetration_mm']:.3f} | {r['speed_mm_s']:.2f} | {r['untrusted']} | "
                f"{r['steps']:g} | {r['cost']:.2f} |"
            )
    yield ""


def _renderers(result: dict[str, Any]) -> Iterator[str]:
    yield "## Raster against pyrender"
    yield ""
    yield (
        "The same pins drawn by both. Grey levels: difference of frames, mean / 99.9th percentile / greatest. Binary: "
        "pixels of the tactile image that differ, mean (most). Blobs: how far a pin's blob is apart in the two images, mean "
        "(greatest), px of the tactile image. Label: what that is worth. ms: CPU time of a frame."
    )
    yield ""
    yield "| contacts | images | grey levels | binary | blobs, px | found | label | raster, ms | pyrender, ms | ratio |"
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for r in result["drawing"]:
        grey, binary, blobs, ms = r["grey_levels"], r["binary_percent"], r["blobs_px"], r["milliseconds"]
        yield (
            f"| {r['task']} | {r['images']} | {grey[0]:.2f} / {grey[1]:.0f} / {grey[2]:.0f} | {binary[0]:.2f} % "
            f"({binary[1]:.2f} %) | {blobs[0]:.3f} ({blobs[1]:.2f}) | {100 * r['blobs_seen']:.1f} % | {label(r['label'])} | "
            f"{ms['raster']:.1f} | {ms['pyrender']:.1f} | {ms['raster'] / ms['pyrender']:.2f} |"
        )


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot mean pin error against cost, one panel per task, into a PNG file."""
    tasks = list(dict.fromkeys(r["task"] for r in result["sweeps"]))
    figure = matplotlib.figure.Figure(figsize=(5.5 * len(tasks), 5.2), layout="constrained")
    panels = figure.subplots(1, len(tasks), sharey=True, squeeze=False)[0]
    for axis, task in zip(panels, tasks, strict=True):
        rows = [r for r in result["sweeps"] if r["task"] == task]
        presets = {r["value"]: r for r in rows if r["what"] == "preset"}
        standard = presets["standard"]
        for what in dict.fromkeys(r["what"] for r in rows if r["what"] != "preset"):
            points = sorted((r["cost"], r["pins_mm"][0]) for r in [*(r for r in rows if r["what"] == what), standard])
            named = what in _NAMED
            style = {"color": _NAMED.get(what, "0.6"), "alpha": 0.8 if named else 0.35, "zorder": 2 if named else 1}
            axis.plot(*zip(*points, strict=True), ".-", lw=1, ms=4, label=what if named else None, **style)
        for name in ("draft", "standard"):
            cost, error = presets[name]["cost"], presets[name]["pins_mm"][0]
            axis.plot(cost, error, "o", ms=9, color="k", zorder=3)
            axis.annotate(name, (cost, error), (8, 7), textcoords="offset points", fontsize=10, weight="bold", zorder=3)
        own = [r for r in result["reference"]["rows"] if r["case"].startswith("edge" if task == "edge" else "flat")]
        cost, next_mesh = presets["reference"]["cost"], max(r["mesh"]["differences_mm"][-1] for r in own)
        axis.plot(cost, next_mesh, "o", ms=9, mfc="w", mec="k", zorder=3)
        words = f"reference\n(against {result['reference']['spacings_mm'][-1]:.2f} mm)"
        where = {"xy": (cost, next_mesh), "xytext": (-8, 9), "textcoords": "offset points", "ha": "right"}
        axis.annotate(words, fontsize=10, weight="bold", **where)
        axis.axhline(PIN_BOUND_MM, color="C3", lw=0.8, ls="--")
        axis.set(xscale="log", yscale="log", xlabel="CPU time of a contact, over that of standard", title=task)
        axis.grid(True, which="both", alpha=0.2)
    panels[0].set_ylabel("mean pin error against the reference, mm")
    title = f"one number of standard changed\n(grey: others); dashed: {PIN_BOUND_MM} mm"
    panels[-1].legend(fontsize=8, loc="upper right", title=title, title_fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None})
