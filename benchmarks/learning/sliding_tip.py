"""The learned tip that slides, against the simulation: `tactip bench sliding-tip`.

Teaches a tip on sliding paths, measures its errors on test paths that it has not seen, and follows objects with it as with
the simulated tip. Writes docs/sliding_tip.md and docs/sliding_tip.json.
"""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning.learning_sets import CURVATURES_PER_M, DESIGN
from tactip_twin.benchmarks.learning.options import SlidingTipOptions
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.control.options import RouteOptions, ServoOptions
from tactip_twin.control.servo_run import SCORE, run_servo
from tactip_twin.learning.sliding_paths import read_paths
from tactip_twin.learning.sliding_tip_settings import SlidingTipSettings
from tactip_twin.learning.sliding_tip_training import SLIDING_TIP, sliding_tip_errors, train_sliding_tip
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.options import DatasetOptions
from tactip_twin.sim.dataset.sampling import SHEAR_RANGES, Ranges
from tactip_twin.sim.labels import Task
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.tactip_model.input_files import read_json
from tactip_twin.tactip_model.presets import load_design

_STATES = 20
"""Number of states of a path."""

_SHARD_SAMPLES = 4000
"""Samples of a shard of the training sets: meshes of more would not fit into a file."""

_FLAT_FRACTION = 0.375
"""Fraction of the surfaces' training paths that lie on flat ones [?]."""

_VARYING_FRACTION = 0.3
"""Fraction of the curved surfaces whose curvature varies [?]."""

_DEPTH_MM, _TILT_DEG = (-5.5, -0.3), (-18.0, 18.0)
"""Ranges of the paths: wider than those of the networks, because a servo starts with a light touch and overshoots."""

_RANGES: dict[Task, Ranges] = {
    "surface": Ranges(depth_mm=_DEPTH_MM, roll_deg=_TILT_DEG, pitch_deg=_TILT_DEG),
    "edge": Ranges(x_mm=(-6.0, 6.0), depth_mm=_DEPTH_MM, roll_deg=_TILT_DEG, pitch_deg=_TILT_DEG, yaw_deg=(-45.0, 45.0)),
}

KINDS: dict[Task, tuple[str, ...]] = {"surface": ("flat", "curved"), "edge": ("edge",)}
"""Kinds of paths by task."""

_RUNS: dict[Task, dict[str, ServoOptions]] = {
    "surface": {"bust": ServoOptions(Path("-"), "surface", "bust")},
    "edge": {
        "rim-round": ServoOptions(Path("-"), "edge", "rim-round"),
        "rim-uneven, 200 mm": ServoOptions(Path("-"), "edge", "rim-uneven", route=RouteOptions(max_length_mm=200)),
    },
}
"""Servo runs by task."""

_FIDELITIES = ("standard", "fast")


def jobs(options: SlidingTipOptions) -> list[Job]:
    """Return the sets of a task."""
    out = []
    for kind in KINDS[options.task]:
        fraction = {"flat": _FLAT_FRACTION, "curved": 1 - _FLAT_FRACTION, "edge": 1.0}[kind]
        for split in ("train", "val", "test"):
            own = {"train": round(fraction * options.paths), "val": options.validation_paths, "test": options.test_paths}
            configuration = Configuration(
                task=options.task,
                split=split,
                samples=_STATES * own[split],
                renderer="raster",
                design=load_design(DESIGN),
                fidelity=fidelity_named("standard"),
                pose=_RANGES[options.task],
                shear=SHEAR_RANGES,
                snapshots_per_contact=_STATES,
                keep_mesh=True,
                curvature_per_m=CURVATURES_PER_M if kind == "curved" else (0.0, 0.0),
                varying_curvature_fraction=_VARYING_FRACTION if kind == "curved" else 0.0,
                shard_samples=_SHARD_SAMPLES if split == "train" else DatasetOptions().shard_samples,
            )
            out.append(Job(configuration, options.data / kind / split))
    return out


def run(options: SlidingTipOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure a task, write sliding_tip.json and sliding_tip.md, and return the results of all tasks. Raises TactipError."""
    task, out = options.task, options.runs / options.task
    make(jobs(options), worker_count(options.workers), log)
    folders = {split: [options.data / kind / split for kind in KINDS[task]] for split in ("train", "val", "test")}
    tip = train_sliding_tip(folders["train"], folders["val"], SlidingTipSettings(), out / "tip", log)
    rows = [{"kind": f.parent.name, **sliding_tip_errors(tip, read_paths([f]))} for f in folders["test"]]
    if options.release:
        options.release.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(out / "tip" / SLIDING_TIP, options.release / f"{task}-{DESIGN}-sliding.npz")
    runs = [_servo(task, name, fidelity, out, log) for name in _RUNS[task] for fidelity in _FIDELITIES]
    result = read_results(options.out / "sliding_tip.json") | {
        task: {"states": tip.provenance["states"], "rows": rows, "runs": runs, "machine": machine()}
    }
    write_results("sliding_tip", result, tables(result), options.out)
    return result


def _servo(task: Task, name: str, fidelity: str, out: Path, log: Callable[[str], None]) -> dict[str, Any]:
    """Return name, fidelity and score of a servo run, which is not repeated if it is complete."""
    run = _RUNS[task][name]
    folder = out / f"{name}-{fidelity}".replace(", ", "-").replace(" ", "-")
    tip = out / "tip" / SLIDING_TIP
    options = ServoOptions(
        **vars(run) | {"out": folder, "fidelity": fidelity, "sliding_tip": None if fidelity == "standard" else tip}
    )
    score = read_json(folder / SCORE) if (folder / SCORE).exists() else run_servo(options, log=log)
    log(f"{name}, {fidelity}: {score['stopped_because']}")
    return {"name": name, "fidelity": fidelity, "score": score}


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/sliding_tip.md from sliding_tip.json."""
    head = ["paths", "states learned from", "after touching down, mm", "after one step, mm", "whole path, mm"]
    head += ["last quarter, mm", "95 %, mm", "normal force", "trusted", "trusted steps of the whole path, mm"]
    lengths = ("touch_mm", "step_mm", "slide_mm", "last_mm", "slide_p95_mm")
    errors = [
        [
            row["kind"],
            found["states"],
            *(f"{row[name]:.3f}" for name in lengths),
            f"{100 * row['force']:.1f} %",
            f"{100 * row['trusted']:.1f} %",
            f"{row['trusted_slide_mm']:.3f}",
        ]
        for found in result.values()
        for row in found["rows"]
    ]
    run_head = ["object", "fidelity", "steps", "of these simulated", "coverage", "depth error, mm", "lateral error, mm"]
    run_head += ["angle, °", "95 %, °", "mean force, N", "contact losses", "tip, ms per step", "steps/s"]
    runs = []
    for found in result.values():
        for run in found["runs"]:
            s = run["score"]
            lateral = "–" if s["lateral_mae_mm"] is None else f"{s['lateral_mae_mm']:.2f}"
            cells = [run["name"], run["fidelity"], s["steps"], s["steps_simulated"], f"{s['coverage']:.1%}"]
            cells += [f"{s['depth_mae_mm']:.3f}", lateral, f"{s['angle_mean_deg']:.2f}", f"{s['angle_p95_deg']:.1f}"]
            cells += [f"{s['force_mean_n']:.2f}", s["contact_losses"], f"{s['ms_a_step']['simulation']:.1f}"]
            runs.append([*cells, f"{s['steps_per_s']:.0f}"])
    machines = sorted({machine_text(found["machine"]) for found in result.values()})
    note = "".join(f"\n\nMachine: {one}." for one in machines)
    return {"errors": table(head, errors), "runs": table(run_head, runs) + note}
