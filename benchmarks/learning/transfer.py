"""Transfer of simulation-trained networks to real sensors: the experiments of `tactip transfer`, on one page.

`tactip bench transfer --real data/real-127 data/real-331` runs the chosen experiments on each set, in RUNS/SET, and writes
docs/transfer.md, transfer.json and a figure of each gap. It takes some hours per set. After an interruption it resumes.
"""

import shutil
from collections.abc import Callable, Mapping
from importlib.metadata import version
from typing import Any

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning.options import TransferOptions
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.sim2real.transfer.experiments import EXPERIMENTS, Experiment
from tactip_twin.sim2real.transfer.page import sections, write_page
from tactip_twin.sim2real.transfer.settings import GAP
from tactip_twin.tactip_model.errors import TactipError, lookup

MAX_MM, MAX_DEG = 0.3, 2.0
"""Target errors of simulation-trained networks: of depth without its offset, and of each tilt that varies."""

MAX_RATIO, SHOTS, MAX_CORRECTED_RATIO = 2.0, "50", 1.3
"""Target ratios of these errors to those of a network trained on all real training frames: without real frames, and when
corrected linearly by SHOTS of them."""


def run(options: TransferOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Run the experiments, write transfer.json, transfer.md and the figures, and return the results of all sets.

    Progress goes to `log`. Raises TactipError, and Interrupted on Ctrl-C.
    """
    if not options.real:
        raise TactipError("--real must name one or more folders of imported sets")
    names = [lookup("experiment", name, dict(zip(EXPERIMENTS, EXPERIMENTS, strict=True))) for name in options.experiments]
    whole = read_results(options.out / "transfer.json")
    options.out.mkdir(parents=True, exist_ok=True)
    for real in options.real:
        experiment = Experiment(real, options.runs / real.name, options.settings, options.workers, log=log)
        for name in names:
            log(f"{real.name}: {name}")
            record = experiment.keep(name, EXPERIMENTS[name](experiment))
            write_page(record, experiment.task, experiment.out)
            if name == "gap":
                shutil.copyfile(experiment.out / GAP, options.out / gap_figure(real.name))
            state = {"task": experiment.task, "version": version("tactip-twin"), "machine": machine()}
            whole[real.name] = {**state, **record}
            write_results("transfer", whole, tables(whole), options.out)
    return whole


def gap_figure(name: str) -> str:
    """Return the file name of the figure of the gap to a set."""
    return f"transfer_gap_{name}.png"


def tables(whole: Mapping[str, Any]) -> dict[str, str]:
    """Return the tables of docs/transfer.md from transfer.json."""
    head = ["set", "component", "error", "target", "ratio to real training", "target"]
    targets = [[name, *cells] for name, record in whole.items() for cells in target_rows(record)]
    parts = []
    for name, record in whole.items():
        chosen = ", ".join(f"{k} {v}" for k, v in record["settings"].items() if v not in ("", None))
        state = f"Machine: {machine_text(record['machine'])}. Version {record['version']}. Settings: {chosen}."
        parts += [f"### {name}", *sections(record, record["task"], gap_figure(name)), state]
    return {
        "targets": table([*head, f"ratio when corrected by {SHOTS} frames", "target"], targets),
        "sets": "\n\n".join(parts),
    }


def target_rows(record: Mapping[str, Any]) -> list[list[str]]:
    """Return the cells of a row for each component that varies in a set: errors beside their targets."""
    if "zero-shot" not in record:
        return []
    simulation, real = record["zero-shot"]["simulation"], record["zero-shot"]["real"]
    corrected = record.get("few-shot", {}).get(SHOTS, {}).get("corrected")
    out = []
    for name, varies in simulation["varies"].items():
        if varies:
            unit, target = ("°", MAX_DEG) if "_R" in name else ("mm", MAX_MM)
            ratios = [
                figures["mae_zeroed"][name] / real["mae_zeroed"][name] for figures in (simulation, corrected) if figures
            ]
            cells = [name, f"{simulation['mae_zeroed'][name]:.3f} {unit}", f"{target:g} {unit}"]
            cells += [f"{ratios[0]:.2f}", f"{MAX_RATIO:g}"]
            out.append([*cells, f"{ratios[1]:.2f}" if corrected else "", f"{MAX_CORRECTED_RATIO:g}"])
    return out
