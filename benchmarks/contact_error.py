"""Error against run time of the fidelity presets on the paper's contacts: `python -m benchmarks.contact_error`.

Each preset plays the first contacts of the surface and edge training sets of seed 0. Two references: the same mesh
played with small steps and tight tolerances (what steps and solver cost in error), and the `reference` preset (the mesh
too). Errors are distances of pin tips; costs, seconds a contact on one core. Then `standard` again with one of its choices
undone at a time. Writes docs/fidelity.md and docs/fidelity.json.
"""

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from benchmarks.machine import machine
from sim.contact import ContactPlayer
from sim.fidelity import FIDELITIES, Fidelity
from sim.sampling import POSE_RANGES, SHEAR_RANGES, generator
from sim.stimulus import TASKS
from tactip_model.presets import design_named


@dataclass(frozen=True)
class Options:
    """Measure the presets."""

    contacts: int = 10
    """Contacts of each task; the reference takes some 10 s for each."""
    out: Path = Path("docs")
    """Folder for fidelity.md and fidelity.json."""


def undone():
    """`standard` with one choice undone: dict of what it is to Fidelity."""
    standard = FIDELITIES["standard"]
    contact, motion, solver = standard.contact, standard.motion, standard.solver
    return {
        "as it is": standard,
        "steady pace": replace(standard, motion=replace(motion, ease_in=0.0, ease_out=0.0)),
        "contact stiff all along": replace(standard, contact=replace(contact, moving=contact.resting)),
        "contact soft all along": replace(standard, contact=replace(contact, resting=contact.moving)),
        "tolerance at rest as in motion": replace(standard, solver=replace(solver, settle_tolerance=solver.tolerance)),
    }


def converged(fidelity):
    """The Fidelity with the same mesh and its steps and tolerances taken so fine that halving them does not matter."""
    fine = FIDELITIES["reference"]
    motion = replace(fine.motion, press_step_m=0.06e-3, shear_step_m=0.06e-3)
    return replace(fidelity, name=f"{fidelity.name}, small steps", motion=motion, solver=fine.solver)


def played(fidelity: Fidelity, task: str, contacts: int):
    """Play the contacts. Returns tips (n, p, 3) m, median seconds a contact, the records, and the degrees of freedom."""
    player = ContactPlayer(design_named("tactip-127"), task, fidelity)
    records, took = [], []
    for index in range(contacts):
        draw = generator(0, task, "train", index)
        start = time.perf_counter()
        records.append(player.play(POSE_RANGES[task].draw(draw), SHEAR_RANGES.draw(draw)))
        took.append(time.perf_counter() - start)
    return np.array([r.tips for r in records]), float(np.median(took)), records, player.scene.model.nv


def errors(tips, expected):
    """Distances of tips (n, p, 3) to the expected: mean, 95th percentile and maximum, mm."""
    distance = 1e3 * np.linalg.norm(tips - expected, axis=2)
    return [float(f(distance)) for f in (np.mean, lambda d: np.quantile(d, 0.95), np.max)]


def main(options: Options):
    """Measure, print, and write the page."""
    rows, choices = [], []
    for task in TASKS:
        best, *_ = played(FIDELITIES["reference"], task, options.contacts)
        for name, fidelity in FIDELITIES.items():
            tips, seconds, _, freedom = played(fidelity, task, options.contacts)
            slow, *_ = played(converged(fidelity), task, options.contacts)
            row = {"task": task, "preset": name, "degrees_of_freedom": freedom, "seconds": round(seconds, 4)}
            row |= {"steps_mm": errors(tips, slow), "all_mm": errors(tips, best)}
            rows.append(row)
            print(json.dumps(row), flush=True)
            if name == "standard":
                choices += [undoing(task, what, other, slow, options) for what, other in undone().items()]
    result = {"contacts_a_task": options.contacts, "machine": machine(), "rows": rows, "choices": choices}
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "fidelity.json").write_text(json.dumps(result, indent=1) + "\n")
    (options.out / "fidelity.md").write_text(page(result))


def undoing(task, what, fidelity, slow, options):
    """What it costs to undo a choice: a dict. slow: tips (n, p, 3) m of the converged motion."""
    tips, seconds, records, _ = played(fidelity, task, options.contacts)
    row = {"task": task, "standard": what, "seconds": round(seconds, 4), "steps_mm": errors(tips, slow)}
    row["penetration_mm"] = 1e3 * max(r.penetration_m for r in records)
    row["speed_mm_s"] = 1e3 * float(np.median([r.speed_m_s for r in records]))
    print(json.dumps(row), flush=True)
    return row


def page(result):
    """The Markdown (str) of a result."""
    standard = {r["task"]: r["seconds"] for r in result["rows"] if r["preset"] == "standard"}
    lines = [
        "# Error against run time",
        "",
        "Written by `python -m benchmarks.contact_error`; do not edit. The first "
        f"{result['contacts_a_task']} contacts of each training set of seed 0, 127-pin tip, one core of: "
        + "; ".join(f"{k} {v}" for k, v in result["machine"].items())
        + ".",
        "",
        "Errors are distances of pin tips in mm: mean / 95th percentile / greatest. *Steps and solver*: against the same "
        "mesh played with small steps and tight tolerances. *In all*: against the preset `reference`. Cost is relative to "
        "`standard` in the same run, then in seconds a contact (median).",
        "",
        "| task | preset | degrees of freedom | steps and solver, mm | in all, mm | cost | s |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in result["rows"]:
        texts = [" / ".join(f"{e:.3f}" for e in r[k]) for k in ("steps_mm", "all_mm")]
        cost = r["seconds"] / standard[r["task"]]
        lines.append(
            f"| {r['task']} | {r['preset']} | {r['degrees_of_freedom']} | {texts[0]} | {texts[1]} | {cost:.2f} | "
            f"{r['seconds']:.3f} |"
        )
    lines += [
        "",
        "`standard` with one of its choices undone, against the same mesh played with small steps:",
        "",
        "| task | standard, but | steps and solver, mm | greatest penetration, mm | residual speed, mm/s (median) | cost |",
        "|---|---|---|---|---|---|",
    ]
    for r in result["choices"]:
        text = " / ".join(f"{e:.3f}" for e in r["steps_mm"])
        lines.append(
            f"| {r['task']} | {r['standard']} | {text} | {r['penetration_mm']:.3f} | {r['speed_mm_s']:.2f} | "
            f"{r['seconds'] / standard[r['task']]:.2f} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(tyro.cli(Options))
