"""Servo accuracy over objects, arms and fidelities, and its robustness, with scores and run times on one page.

`tactip bench servo` follows each object with the shipped networks, with each arm and at each fidelity, under other friction,
stiffness, noise and step, and from random starts, and writes docs/servo.md, servo.json and servo.png. It takes some hours.
After an interruption it resumes: each run is a folder of RUNS.
"""

import dataclasses
import json
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.benchmarks.servo.contact_patch import RADII_MM, contact_patch_normal
from tactip_twin.benchmarks.servo.filter_table import WITHOUT, filter_table
from tactip_twin.benchmarks.servo.options import ServoBenchOptions
from tactip_twin.control.options import RouteOptions, ServoOptions, Settings
from tactip_twin.control.score import events_text
from tactip_twin.control.servo_run import SCORE, run_servo
from tactip_twin.learning.filter_settings import FilterSettings
from tactip_twin.learning.model import load_network, weights_sha256
from tactip_twin.sim.parallel.worker_pool import WorkerPool, worker_count
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.sim.view.plot import COLORS, figure_of, log_axis, save_figure
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.files import write_file

ERROR = "error.txt"
"""File that a run leaves that was refused: the error message."""

STARTS = 50
"""Random starts on each object."""

_START_STEPS = 45
"""Steps of such a run: some to find the object, 12 to reach the reference, the rest to follow."""

_MAX_START_MM = 35.0
"""Maximum distance of a random start on a surface from the middle of its region, mm."""

GROUPS = ("objects", "oracle", "arm", "fidelity", "robust", "filter", "starts")
"""Groups of runs."""


@dataclass(frozen=True)
class Case:
    """A servo run of the benchmark."""

    group: str
    """One of GROUPS."""
    name: str
    """Object, and what is different."""
    options: ServoOptions
    """Options of the run, but for its folder."""


DEPTHS_MM = (1.5, 2.0, 2.5, 3.0, 4.0)
"""Commanded depths in the group `robust`, mm."""

LIGHT_DEPTHS_MM = (1.0, 1.5)
"""Commanded depths in the group `filter`, mm."""

_FILTERED = ("rim-round", "rim-uneven")
"""Rims in the group `filter`, followed all round."""

_DEEP = "{:g} mm deep"
_ON_THE_BUST = [f"bust, {_DEEP.format(mm)}" for mm in DEPTHS_MM]
_NOWHERE = Path("-")

_LONG = {
    "bust": ServoOptions(_NOWHERE, "surface", "bust"),
    "saddle": ServoOptions(_NOWHERE, "surface", "saddle"),
    "sphere": ServoOptions(_NOWHERE, "surface", "sphere", route=RouteOptions(length_mm=40, width_mm=20)),
    "rim-round": ServoOptions(_NOWHERE, "edge", "rim-round"),
    "rim-square": ServoOptions(_NOWHERE, "edge", "rim-square"),
    "rim-uneven": ServoOptions(_NOWHERE, "edge", "rim-uneven"),
}
"""A run over each object."""

_SHORT = {
    "bust": replace(_LONG["bust"], route=RouteOptions(kind="straight", length_mm=60)),
    "rim": replace(_LONG["rim-uneven"], route=RouteOptions(max_length_mm=120)),
}
"""A pass over the face and a third of a rim, for everything else that is measured."""


def cases(options: ServoBenchOptions) -> list[Case]:
    """Return all runs."""
    out = [Case("objects", name, run) for name, run in _LONG.items()]
    out += [Case("oracle", name, replace(run, model="oracle")) for name, run in _LONG.items()]
    others = {"bust": options.other_surface, "rim": options.other_edge}
    for name, run in _SHORT.items():
        out += [Case("arm", f"{name}, {arm}", replace(run, arm=arm)) for arm in ("none", "kinematic", "dynamic")]
        for fidelity in ("draft", "standard", "reference"):
            for renderer in ("pyrender", "raster"):
                changed = replace(run, fidelity=fidelity, renderer=renderer)
                out.append(Case("fidelity", f"{name}, {fidelity}, {renderer}", changed))
        for settle, pace in ((4, 1.0), (2, 1.0), (1, 1.0), (2, 2.0), (1, 2.0)):
            changed = replace(run, settle_steps=settle, speed_scale=pace)
            out.append(Case("fidelity", f"{name}, standard, {settle} at rest, pace {pace:g}", changed))
        changes: dict[str, dict[str, Any]] = {"baseline": {}}
        changes |= {f"friction {mu:g}": {"friction": mu} for mu in (0.2, 0.4, 1.2)}
        changes |= {f"stiffness times {k:g}": {"stiffness": k} for k in (0.5, 1.5)}
        changes |= {f"noise of {grey:g} grey levels": {"noise_grey": grey} for grey in (5.0, 15.0, 30.0)}
        changes |= {f"steps of {mm:g} mm": {"settings": Settings(step_mm=mm)} for mm in (3.0, 5.0)}
        changes |= {_DEEP.format(mm): {"depth_mm": mm} for mm in DEPTHS_MM}
        changes |= {"gains tactile-servo-control": {"gains": "tactile-servo-control"}}
        changes |= {
            f"slowdown at {deg:g} degrees": {"settings": Settings(slowdown_angle_deg=deg)} for deg in (0.0, 3.0, 6.0, 12.0)
        }
        if others[name]:
            changes |= {"other network": {"model": others[name]}}
        out += [Case("robust", f"{name}, {what}", replace(run, **change)) for what, change in changes.items()]
    changes = {_DEEP.format(mm): {"depth_mm": mm} for mm in LIGHT_DEPTHS_MM}
    changes |= {f"noise of {grey:g} grey levels": {"noise_grey": grey} for grey in (30.0,)}
    runs = {f"{name}, {what}": replace(_LONG[name], **change) for name in _FILTERED for what, change in changes.items()}
    for name, run in runs.items():
        # The learned tip is fast enough for so many runs.
        fast = replace(run, fidelity="fast")
        out.append(Case("filter", name, fast))
        out.append(Case("filter", f"{name}, {WITHOUT}", replace(fast, filter=FilterSettings(enabled=False))))
    for name, run in _LONG.items():
        middle = load_object(name).middle_m
        for seed in range(STARTS):
            out.append(Case("starts", f"{name}, {seed}", random_start(run, seed, middle)))
    return out


def random_start(run: ServoOptions, seed: int, middle_m: np.ndarray) -> ServoOptions:
    """Return a short run from a random place, with a random initial pose error, in a random direction."""
    rng = np.random.default_rng((seed, 5))
    settings = Settings(max_steps=_START_STEPS)
    if run.task == "edge":
        route = RouteOptions(start_fraction=float(rng.uniform()), reverse=bool(rng.uniform() < 0.5))
        return replace(run, seed=seed, route=route, settings=settings)
    reach, turn = _MAX_START_MM * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
    x, y = 1e3 * middle_m[:2] + reach * np.array([np.cos(turn), np.sin(turn)])
    route = RouteOptions("straight", (float(x), float(y)), 60.0, heading_deg=float(rng.uniform(-180, 180)))
    return replace(run, seed=seed, route=route, settings=settings)


class Runner:
    """Worker task that makes runs."""

    def __init__(self, runs: str, cases: Sequence[Case]) -> None:
        self._runs, self._cases = Path(runs), {(c.group, c.name): c for c in cases}

    def __call__(self, key: tuple[str, str]) -> None:
        """Make the run of a (group, name); an error message goes into its folder."""
        import torch

        torch.set_num_threads(1)
        folder = run_folder(self._runs, *key)
        shutil.rmtree(folder, ignore_errors=True)
        folder.parent.mkdir(parents=True, exist_ok=True)
        case = self._cases[key]
        try:
            run_servo(replace(case.options, out=folder), log=lambda line: None)
        except TactipError as error:
            folder.mkdir(parents=True, exist_ok=True)
            write_file(folder / ERROR, f"{error}\n".encode())
        write_file(folder / "case.json", identity(case).encode())


def run_folder(runs: str | PathLike[str], group: str, name: str) -> Path:
    """Return the folder of a run."""
    return Path(runs) / group / name.replace(", ", "_").replace(" ", "-")


def identity(case: Case) -> str:
    """Return options, checksum of the network's weights, and version as JSON: a run is made again if they change."""
    run = case.options
    options = json.loads(json.dumps(dataclasses.asdict(run), default=str))
    return json.dumps([options, weights_sha256(run.network), version("tactip-twin")])


def run(options: ServoBenchOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Make the runs that are missing, write servo.json, servo.md and servo.png, and return the results.

    Progress goes to `log`. Raises TactipError, and Interrupted on Ctrl-C.
    """
    groups = [lookup("group", name, dict.fromkeys(GROUPS, name)) for name in options.groups or GROUPS]
    chosen = [case for case in cases(options) if case.group in groups]
    todo = [(c.group, c.name) for c in chosen if not is_done(options.runs, c)]
    workers = worker_count(options.workers)
    make(options.runs, [c for c in chosen if (c.group, c.name) in todo], workers, log)
    before = read_results(options.out / "servo.json") or {"groups": {}, "made": {}}
    rows = before["groups"] | {c.group: [_row(options.runs, one) for one in chosen if one.group == c.group] for c in chosen}
    rows = {g: rows[g] for g in GROUPS if g in rows}
    # A group whose runs all existed already keeps the description of how they were made.
    new, now = {group for group, _ in todo}, {"machine": machine(), "workers": workers}
    made = {g: now if g in new else before["made"].get(g, now) for g in rows}
    record = {"groups": rows, "made": made}
    deep = [case for case in chosen if case.name in _ON_THE_BUST and case.group == "robust"]
    # A run that was refused, or never followed, has no predicted normals.
    deep = [_patch(options.runs, case) for case in deep if _row(options.runs, case).get("steps_followed")]
    patches = deep if "robust" in groups else before.get("patches")
    record |= {"patches": patches} if patches else {}
    names = {"surface": options.other_surface, "edge": options.other_edge}
    others = (
        {task: _training_of(name) for task, name in names.items() if name} if "robust" in groups else before.get("others")
    )
    record |= {"others": others} if others else {}
    write_results("servo", record, tables(record), options.out)
    if "fidelity" in record["groups"]:
        plot(record["groups"]["fidelity"], options.out / "servo.png")
    return record


def make(runs: Path, missing: Sequence[Case], workers: int, log: Callable[[str], None]) -> None:
    """Make runs. Raises TactipError, and Interrupted on Ctrl-C."""
    if missing:
        todo = [(c.group, c.name) for c in missing]
        pool = WorkerPool(Runner, (str(runs), missing), todo, "run", log, lambda run: f"run {run[1]!r} of {run[0]}")
        pool.work(workers, lambda *done: None)


def _training_of(name: str) -> str:
    """Return what a network (name or folder) was trained on, in words."""
    provenance = load_network(name).provenance
    made, count = provenance["train"]["configuration"], provenance["train"]["samples"]
    snapshots = made.get("snapshots_per_contact", 1)
    frames = f", {snapshots} snapshots per contact" if snapshots > 1 else ""
    begun = ", with initial weights of another network" if "initial_weights" in provenance else ""
    seed = provenance["settings"]["seed"]
    return f"{count} images of a set of seed {made['seed']}{frames}; training of seed {seed}{begun}"


def _patch(runs: Path, case: Case) -> dict[str, Any]:
    """Return the depth of a run and the result of contact_patch_normal."""
    folder = run_folder(runs, case.group, case.name)
    return {"depth_mm": case.options.depth_mm, **contact_patch_normal(folder, load_object(case.options.object))}


def is_done(runs: Path, case: Case) -> bool:
    """Return whether a run exists."""
    path = run_folder(runs, case.group, case.name) / "case.json"
    return path.exists() and path.read_text() == identity(case)


_KEPT = (
    "depth_mae_mm", "lateral_mae_mm", "angle_mean_deg", "angle_p95_deg", "contact_losses", "events", "coverage", "closed",
    "force_max_n", "steps", "steps_followed", "steps_per_s", "ms_a_step", "stopped_because",
)  # fmt: skip


def _row(runs: Path, case: Case) -> dict[str, Any]:
    """Return the row of servo.json for a run."""
    folder = run_folder(runs, case.group, case.name)
    if (folder / ERROR).exists():
        return {"name": case.name, "version": version("tactip-twin"), "error": (folder / ERROR).read_text().strip()}
    score = json.loads((folder / SCORE).read_text())
    kept = {name: score[name] for name in _KEPT}
    return {"name": case.name, "version": version("tactip-twin"), "task": case.options.task, **kept}


_COMPLETED = ("route completed", "loop closed", "stopped at the path limit")
"""Beginnings of the reasons for which a run ends that did what was asked; notes below tables name other reasons only."""

_ERRORS = {
    "bust": {"depth, mm": "depth_mae_mm", "angle, °": "angle_mean_deg"},
    "rim": {"depth, mm": "depth_mae_mm", "lateral, mm": "lateral_mae_mm", "angle, °": "angle_mean_deg"},
}
"""Errors in the tables of short runs: title and name in the score, by object."""


def tables(record: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/servo.md from servo.json."""
    groups = record["groups"]
    out: dict[str, str] = dict.fromkeys(
        ("objects", "arm", "fidelity", "robust", "filter", "patches", "starts"), "Not measured."
    )
    for group in {"arm", "fidelity", "robust"} & set(groups):
        out[group] = _short_runs(groups[group], speed=group == "fidelity")
    if "objects" in groups:
        out["objects"] = _objects(groups["objects"], groups.get("oracle", []))
    if "filter" in groups:
        out["filter"] = filter_table(groups["filter"])
    if "starts" in groups:
        out["starts"] = _starts(groups["starts"])
    if "patches" in record:
        out["patches"] = _patches(record["patches"])
    for task, training in record.get("others", {}).items():
        out["robust"] += f"\n\nTraining of the other network of the {task}: {training}."
    states: dict[str, list[str]] = {}
    for group, rows in groups.items():
        made = record["made"][group]
        runs = "one run" if made["workers"] == 1 else f"{made['workers']} runs"
        versions = " and ".join(sorted({row["version"] for row in rows}))
        state = f"Version {versions}; {runs} at a time, one core each; {machine_text(made['machine'])}."
        states.setdefault(state, []).append(group)
    lines = [f"{', '.join(names)}: {state}" for state, names in states.items()]
    return out | {"machines": "\n".join(lines if len(states) > 1 else states)}


def _objects(rows: Sequence[dict[str, Any]], oracles: Sequence[dict[str, Any]]) -> str:
    """Return the table of the long runs, with the errors of the same runs with the true pose."""
    true_pose = {row["name"]: row for row in oracles}
    with_true_pose = [("depth_mae_mm", "{:.2f}"), ("lateral_mae_mm", "{:.2f}"), ("angle_mean_deg", "{:.2f}")]
    columns = [*with_true_pose, ("angle_p95_deg", "{:.1f}")]
    columns += [("force_max_n", "{:.1f}"), ("steps", "{}"), ("steps_per_s", "{:.1f}")]
    errors = ["depth, mm", "lateral, mm", "angle, °"]
    head = ["object", *errors, "angle, 95th percentile, °", "max force, N", "steps", "steps/s"]
    head += [f"true pose: {name}" for name in errors]
    cells = [
        [row["name"], *(_cell(row, *c) for c in columns), *(_cell(true_pose.get(row["name"]), *c) for c in with_true_pose)]
        for row in rows
    ]
    return table(head, cells) + _notes(rows) + _notes(oracles, "true pose, ")


def _short_runs(rows: Sequence[dict[str, Any]], speed: bool) -> str:
    """Return the table of runs over bust and rim, a row per setting, with or without their speed."""
    runs = {row["name"]: row for row in rows}
    columns = [(name, title, key) for name, errors in _ERRORS.items() for title, key in errors.items()]
    columns += [(name, "steps/s", "steps_per_s") for name in _ERRORS if speed]
    forms = ["{:.1f}" if key == "steps_per_s" else "{:.2f}" for _, _, key in columns]
    cells = [
        [what, *(_cell(runs.get(f"{c[0]}, {what}"), c[2], form) for c, form in zip(columns, forms, strict=True))]
        for what in dict.fromkeys(row["name"].partition(", ")[2] for row in rows)
    ]
    return table(["setting", *(f"{name}: {title}" for name, title, _ in columns)], cells) + _notes(rows)


def _notes(rows: Sequence[dict[str, Any]], prefix: str = "") -> str:
    """Return a list, below their table, of runs that were refused, ended early, recovered or lost part of the path."""
    best: dict[str, float] = {}
    for row in rows:
        if "error" not in row:
            name = row["name"].partition(",")[0]
            best[name] = max(best.get(name, 0.0), row["coverage"])
    lines = []
    for row in rows:
        if "error" in row:
            lines.append(f"- {prefix}{row['name']}: not run: {row['error']}")
            continue
        notes = [] if row["stopped_because"].startswith(_COMPLETED) else [row["stopped_because"]]
        notes += [f"events: {events_text(row['events'])}"] if row["events"] else []
        fraction = row["coverage"] / (best[row["name"].partition(",")[0]] or 1)
        notes += [f"followed {fraction:.0%} of the path"] if fraction < 0.9 else []
        lines += [f"- {prefix}{row['name']}: {'; '.join(notes)}"] if notes else []
    return "\n\n" + "\n".join(lines) if lines else ""


def _patches(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of predicted normals and those of discs; a row is a result of `_patch`."""
    cells = [
        [
            f"{row['depth_mm']:g}",
            *(f"{a:.2f} ({b:.2f})" for a, b in zip(row["predicted_deg"], row["apart_deg"], strict=True)),
        ]
        for row in rows
    ]
    return table(["depth, mm", *(f"radius {r:g} mm" if r else "nearest point" for r in RADII_MM)], cells)


def _cell(row: dict[str, Any] | None, name: str, form: str) -> str:
    return "" if row is None or row.get(name) is None else form.format(row[name])


def followed(row: dict[str, Any]) -> bool:
    """Return whether a run from a random start succeeded: at least ten steps of following, within a millimetre of depth."""
    return "error" not in row and row["steps_followed"] >= 10 and row["depth_mae_mm"] < 1.0


def _starts(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of the random starts: how many followed, and why the others ended."""
    cells = []
    for name in _LONG:
        mine = [row for row in rows if row["name"].startswith(f"{name}, ")]
        good = [row for row in mine if followed(row)]
        reasons = Counter(row.get("error") or row["stopped_because"] for row in mine if not followed(row))
        others = "; ".join(f"{n}: {reason}" for reason, n in reasons.most_common())
        depth, angle = (np.mean([row[k] for row in good]) if good else np.nan for k in ("depth_mae_mm", "angle_mean_deg"))
        cells.append([name, f"{len(good)} of {len(mine)}", f"{depth:.2f}", f"{angle:.2f}", others])
    return table(["object", "successful", "depth, mm", "angle, °", "reasons of the others"], cells)


_MARKERS = {"draft": "^", "standard": "o", "reference": "s"}
_MARKERS |= {"4 at rest, pace 1": "P", "2 at rest, pace 1": "D", "1 at rest, pace 1": "X", "2 at rest, pace 2": "<"}
_MARKERS |= {"1 at rest, pace 2": ">"}
"""Markers in the figure, by what differs."""


def plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Plot error against time per step, for rows of the group `fidelity`, into a PNG file."""
    from matplotlib.lines import Line2D

    figure, axes = figure_of(1, 2, (10, 3.8))
    colors = dict(zip(("bust", "rim"), COLORS, strict=False))
    for axis, (name, label) in zip(
        axes, (("depth_mae_mm", "depth error, mm"), ("angle_mean_deg", "angle error, °")), strict=True
    ):
        for row in rows:
            if "error" in row or row[name] is None or not row["steps_per_s"]:
                continue
            scene, what = row["name"].split(", ", 1)
            kind = what.split(", ")[0] if "at rest" not in what else what.removeprefix("standard, ")
            color = colors[scene]
            axis.plot(
                1e3 / row["steps_per_s"], row[name], _MARKERS.get(kind, "o"), color=color,
                mfc="none" if "raster" in what else color,
            )  # fmt: skip
        log_axis(axis, "x")
        axis.set(xlabel="time per step, ms", ylabel=f"mean {label}")
        axis.set_ylim(bottom=0)
    entries = [Line2D([], [], ls="", marker="o", color=color, label=scene) for scene, color in colors.items()]
    entries += [Line2D([], [], ls="", marker="o", color="0.4", mfc="none", label="raster (hollow)")]
    entries += [Line2D([], [], ls="", marker=marker, color="0.4", label=kind) for kind, marker in _MARKERS.items()]
    figure.legend(handles=entries, loc="outside right center")
    save_figure(figure, path)
