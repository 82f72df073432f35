"""What is learned in simulation against real sensors: the experiments of `tactip transfer` on imported sets, on one page.

`tactip bench transfer --real data/real-127 data/real-331`: makes of each set the experiments that are asked for, in
RUNS/SET, and writes docs/transfer.md, .json and a figure of each gap. Stopped, it goes on where it was. Some hours a set.
"""

import json
import shutil
from importlib.metadata import version

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.sim2real.transfer.experiments import EXPERIMENTS, Experiment
from tactip_twin.sim2real.transfer.page import page_lines, write_page
from tactip_twin.sim2real.transfer.settings import GAP
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.files import write_file

MOST_MM, MOST_DEG = 0.3, 2.0
"""What this project asks of simulation alone: depth, its zero taken out, and each tilt that varies."""

MOST_OF_REAL, SHOTS, MOST_OF_REAL_TUNED = 2.0, "50", 1.3
"""... and of its errors over those of a network trained on all real frames that may be learned from, alone and after so many
real frames."""


def run(options, say=print):
    """Make the experiments, and write the page. options: TransferOptions. Returns its record (dict). say: called with
    lines for the user.

    Raises TactipError, and Interrupted at Ctrl-C.
    """
    if not options.real:
        raise TactipError("no imported set is named: give one or more folders by --real")
    names = [lookup("experiment", name, dict(zip(EXPERIMENTS, EXPERIMENTS, strict=True))) for name in options.experiments]
    path = options.out / "transfer.json"
    whole = json.loads(path.read_text()) if path.exists() else {}
    options.out.mkdir(parents=True, exist_ok=True)
    for real in options.real:
        experiment = Experiment(real, options.runs / real.name, options.settings, options.workers, say=say)
        for name in names:
            say(f"{real.name}: {name}")
            record = experiment.keep(name, EXPERIMENTS[name](experiment))
            write_page(record, experiment.task, experiment.out)
            if name == "gap":
                shutil.copyfile(experiment.out / GAP, options.out / gap_of(real.name))
            state = {"task": experiment.task, "version": version("tactip-twin"), "machine": machine()}
            whole[real.name] = {**state, **record}
            write_file(path, (json.dumps(whole, indent=1) + "\n").encode())
            write_file(options.out / "transfer.md", page(whole).encode())
    return whole


def gap_of(name):
    """File name (str) of the figure of the gap to a set."""
    return f"transfer_gap_{name}.png"


def page(whole):
    """The Markdown (str) of transfer.json (dict)."""
    lines = [
        "# From simulation to real sensors",
        "",
        "Written by `tactip bench transfer`; do not edit. Networks that have seen no real label, and what some labels add; "
        "tested on real frames that nothing was learned from. The sets are published ones, imported as "
        "[your-own-sensor.md](your-own-sensor.md) says. The rigs' axes are those of calibrations, and the ranges of the "
        "optics `steady` were chosen with errors on these sets in view: other sets will tell what that was worth.",
        "",
        f"| set | component | error | asked | of real training | asked | after {SHOTS} frames, of real training | asked |",
        "|" + "---|" * 8,
    ]
    for name, record in whole.items():
        lines += [f"| {name} | {' | '.join(cells)} |" for cells in judged(record)]
    for name, record in whole.items():
        state = machine_text(record["machine"])
        settings = ", ".join(f"{k} {v}" for k, v in record["settings"].items() if v not in ("", None))
        its = page_lines(record, record["task"], 2, gap_of(name))
        lines += ["", *its, "", f"Version {record.get('version', '0.1.0')}. Settings: {settings}. On: {state}."]
    return "\n".join(lines) + "\n"


def judged(record):
    """A list of cells (str) for each component that varies in a set: what was asked of it and what came out."""
    if "zero-shot" not in record:
        return []
    simulation, real = record["zero-shot"]["simulation"], record["zero-shot"]["real"]
    tuned = record.get("few-shot", {}).get(SHOTS, {}).get("fine_tuned")
    out = []
    for name, varies in simulation["varies"].items():
        if varies:
            unit, asked = ("°", MOST_DEG) if "_R" in name else ("mm", MOST_MM)
            ratios = [figures["mae_zeroed"][name] / real["mae_zeroed"][name] for figures in (simulation, tuned) if figures]
            cells = [name, f"{simulation['mae_zeroed'][name]:.3f} {unit}", f"{asked:g} {unit}"]
            cells += [f"{ratios[0]:.2f}", f"{MOST_OF_REAL:g}"]
            out.append([*cells, f"{ratios[1]:.2f}" if tuned else "", f"{MOST_OF_REAL_TUNED:g}"])
    return out
