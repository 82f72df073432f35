"""Error against run time of the fidelity presets on the paper's contacts: `python -m benchmarks.contact_error`.

Each preset plays the first contacts of the surface and edge training sets of seed 0. Two references: the same mesh
played with small steps and tight tolerances (what steps and solver cost in error), and the `reference` preset (the mesh
too). Errors are distances of pin tips; costs, seconds a contact on one core. Writes docs/fidelity.md and
docs/fidelity.json.
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
from tactip_model.design import design_named


@dataclass(frozen=True)
class Options:
    """Measure the presets."""

    contacts: int = 10
    """Contacts of each task; the reference takes some 10 s for each."""
    out: Path = Path("docs")
    """Folder for fidelity.md and fidelity.json."""


def converged(fidelity):
    """The Fidelity with the same mesh and its steps and tolerances taken so fine that halving them does not matter."""
    fine = FIDELITIES["reference"]
    motion = replace(fine.motion, press_step_m=0.06e-3, shear_step_m=0.06e-3)
    return replace(fidelity, name=f"{fidelity.name}, small steps", motion=motion, solver=fine.solver)


def played(fidelity: Fidelity, task: str, contacts: int):
    """Play the contacts. Returns tips (n, p, 3) m, seconds a contact, and the model's degrees of freedom."""
    player = ContactPlayer(design_named("tactip-127"), task, fidelity)
    tips, start = [], time.perf_counter()
    for index in range(contacts):
        draw = generator(0, task, "train", index)
        tips.append(player.play(POSE_RANGES[task].draw(draw), SHEAR_RANGES.draw(draw)).tips)
    return np.array(tips), (time.perf_counter() - start) / contacts, player.scene.model.nv


def errors(tips, expected):
    """Distances of tips (n, p, 3) to the expected: mean, 95th percentile and maximum, mm."""
    distance = 1e3 * np.linalg.norm(tips - expected, axis=2)
    return [float(f(distance)) for f in (np.mean, lambda d: np.quantile(d, 0.95), np.max)]


def main(options: Options):
    """Measure, print, and write the page."""
    rows = []
    for task in TASKS:
        best, _, _ = played(FIDELITIES["reference"], task, options.contacts)
        for name, fidelity in FIDELITIES.items():
            tips, seconds, freedom = played(fidelity, task, options.contacts)
            slow, _, _ = played(converged(fidelity), task, options.contacts)
            row = {"task": task, "preset": name, "degrees_of_freedom": freedom, "seconds": round(seconds, 4)}
            row |= {"steps_mm": errors(tips, slow), "all_mm": errors(tips, best)}
            rows.append(row)
            print(json.dumps(row), flush=True)
    result = {"contacts_a_task": options.contacts, "machine": machine(), "rows": rows}
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "fidelity.json").write_text(json.dumps(result, indent=1) + "\n")
    (options.out / "fidelity.md").write_text(page(result))


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
        "`standard` in the same run, then in seconds a contact.",
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
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(tyro.cli(Options))
