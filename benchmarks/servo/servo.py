"""What the servo reaches: objects, arms, fidelities, and what it withstands; scores beside run times, on one page.

`tactip bench servo`: follows each object with the shipped networks, with each arm and at each fidelity, under other
friction, stiffness, noise and step, and from random starts, and writes docs/servo.md, .json and .png. Stopped, it goes on
where it was: each run is a folder of RUNS. Some hours.
"""

import dataclasses
import json
import shutil
from collections import Counter
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.servo.contact_patch import RADII_MM, contact_patch_normal
from tactip_twin.control.options import Options as ServoOptions
from tactip_twin.control.options import RouteOptions, Settings
from tactip_twin.control.servo_run import SCORE
from tactip_twin.control.servo_run import run as follow
from tactip_twin.learning.model import load_network, weights_sha256
from tactip_twin.sim.parallel.worker_pool import WorkerPool, worker_count
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.sim.view.plot import pyplot
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.files import write_file

ERROR = "error.txt"
"""What a run that could not be made leaves: a sentence."""

STARTS = 50
"""Random starts on each object."""

_START_STEPS = 45
"""Steps of such a run: some to find the object, 12 to come to the reference, the rest to follow."""

_ASTRAY_MM = 35.0
"""How far from the middle of its region a random start on a surface is, mm, at most."""

GROUPS = {
    "objects": "Every object, with the dynamic arm",
    "oracle": "The same from the truth in the place of the network: what is left is the servo's own error",
    "arm": "What carries the tip",
    "fidelity": "Error against run time: meshes, time steps and renderers",
    "robust": "What is withstood",
    "starts": f"{STARTS} random starts on each object",
}
"""Groups of runs, and their titles."""


@dataclass(frozen=True)
class Case:
    """A run."""

    group: str
    """One of GROUPS."""
    name: str
    """What is run, and what is different."""
    options: ServoOptions
    """But for its folder."""


DEPTHS_MM = (1.5, 2.0, 2.5, 3.0, 4.0)
"""Depths that are kept in the group `robust`, mm."""

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
    "rim": replace(_LONG["rim-uneven"], route=RouteOptions(most_mm=120)),
}
"""A pass over the face, and a third of a rim: what everything else is measured on."""


def cases(options):
    """The runs (list of Case) there are. options: benchmarks.options.FollowedOptions."""
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
            changed = replace(run, settle_steps=settle, pace=pace)
            out.append(Case("fidelity", f"{name}, standard, {settle} at rest, pace {pace:g}", changed))
        changes = {"as it is": {}}
        changes |= {f"friction {mu:g}": {"friction": mu} for mu in (0.2, 0.4, 1.2)}
        changes |= {f"stiffness times {k:g}": {"stiffness": k} for k in (0.5, 1.5)}
        changes |= {f"noise of {grey:g} grey levels": {"noise_grey": grey} for grey in (5.0, 15.0, 30.0)}
        changes |= {f"steps of {mm:g} mm": {"settings": Settings(step_mm=mm)} for mm in (3.0, 5.0)}
        changes |= {_DEEP.format(mm): {"depth_mm": mm} for mm in DEPTHS_MM}
        changes |= {"gains of the later work": {"gains": "later"}}
        changes |= {f"slow at {deg:g} degrees": {"settings": Settings(slow_deg=deg)} for deg in (0.0, 3.0, 6.0, 12.0)}
        if others[name]:
            changes |= {"a network of another seed": {"model": others[name]}}
        out += [Case("robust", f"{name}, {what}", replace(run, **change)) for what, change in changes.items()]
    for name, run in _LONG.items():
        middle = load_object(name).middle_m
        for seed in range(STARTS):
            out.append(Case("starts", f"{name}, {seed}", _from_anywhere(run, seed, middle)))
    return out


def _from_anywhere(run, seed, middle_m):
    """A short run from a random place, off the mark, in a random direction."""
    draw = np.random.default_rng((seed, 5))
    settings = Settings(most_steps=_START_STEPS)
    if run.task == "edge":
        route = RouteOptions(start_share=float(draw.uniform()), backward=bool(draw.uniform() < 0.5))
        return replace(run, seed=seed, route=route, settings=settings)
    reach, turn = _ASTRAY_MM * np.sqrt(draw.uniform()), draw.uniform(0, 2 * np.pi)
    x, y = 1e3 * middle_m[:2] + reach * np.array([np.cos(turn), np.sin(turn)])
    route = RouteOptions("straight", (float(x), float(y)), 60.0, heading_deg=float(draw.uniform(-180, 180)))
    return replace(run, seed=seed, route=route, settings=settings)


class _Follower:
    """Makes runs, in a worker."""

    def __init__(self, runs, options):
        self._runs, self._cases = Path(runs), {(c.group, c.name): c for c in cases(options)}

    def __call__(self, key):
        """Make the run of a (group, name); what it could not do is a sentence in its folder."""
        import torch

        torch.set_num_threads(1)
        folder = open_builder(self._runs, *key)
        shutil.rmtree(folder, ignore_errors=True)
        folder.parent.mkdir(parents=True, exist_ok=True)
        case = self._cases[key]
        try:
            follow(replace(case.options, out=folder), say=lambda line: None)
        except TactipError as error:
            folder.mkdir(parents=True, exist_ok=True)
            write_file(folder / ERROR, f"{error}\n".encode())
        write_file(folder / "case.json", identity(case).encode())


def open_builder(runs, group, name):
    """Folder (Path) of a run."""
    return Path(runs) / group / name.replace(", ", "_").replace(" ", "-")


def identity(case):
    """What a Case is, as text: its options, the checksum of its network's weights, and the version that follows."""
    run = case.options
    asked = json.loads(json.dumps(dataclasses.asdict(run), default=str))
    return json.dumps([asked, weights_sha256(run.network), version("tactip-twin")])


def run(options, say=print):
    """Make the runs that are not there yet, and write the page. Returns its record (dict). say: called with lines for the
    user.

    Raises TactipError, and Interrupted at Ctrl-C.
    """
    groups = [lookup("group", name, dict(zip(GROUPS, GROUPS, strict=True))) for name in options.groups or GROUPS]
    chosen = [case for case in cases(options) if case.group in groups]
    todo = [(c.group, c.name) for c in chosen if not _is_there(options.runs, c)]
    workers = worker_count(options.workers)
    if todo:
        crew = WorkerPool(
            _Follower, (str(options.runs), options), todo, "run", say, lambda run: f"run {run[1]!r} of {run[0]}"
        )
        crew.work(workers, lambda *done: None)
    path = options.out / "servo.json"
    before = _before(path)
    rows = before["groups"] | {c.group: [_row(options.runs, one) for one in chosen if one.group == c.group] for c in chosen}
    rows = {g: rows[g] for g in GROUPS if g in rows}
    # A group of which every run was there already is as it was made then.
    anew, now = {group for group, _ in todo}, _made(machine(), workers)
    made = {g: now if g in anew else before["made"].get(g, now) for g in rows}
    record = {"groups": rows, "made": made}
    deep = [case for case in chosen if case.name in _ON_THE_BUST and case.group == "robust"]
    # What could not be made, or followed for no step, felt no normal.
    deep = [_patch(options.runs, case) for case in deep if _row(options.runs, case).get("steps_followed")]
    patches = deep if "robust" in groups else before.get("patches")
    record |= {"patches": patches} if patches else {}
    given = {"surface": options.other_surface, "edge": options.other_edge}
    others = {task: _learned(name) for task, name in given.items() if name} if "robust" in groups else before.get("others")
    record |= {"others": others} if others else {}
    options.out.mkdir(parents=True, exist_ok=True)
    write_file(path, (json.dumps(record, indent=1) + "\n").encode())
    write_file(options.out / "servo.md", page(record).encode())
    if "fidelity" in record["groups"]:
        draw(record["groups"]["fidelity"], options.out / "servo.png")
    return record


def _before(path):
    """The record (dict) that was measured before; without groups if there is none."""
    return _by_groups(json.loads(path.read_text()) if path.exists() else {"groups": {}, "made": {}})


def _by_groups(record):
    """A record (dict) that says how each group was made; one of before says it of all at once, of two runs at a time."""
    if "made" in record:
        return record
    return record | {"made": dict.fromkeys(record["groups"], _made(record["machine"], 2))}


def _made(machine, workers):
    """How a group was made (dict). machine: dict of str. workers: int, runs at a time."""
    return {"machine": machine, "workers": workers}


def _learned(name):
    """What a network (str, its name or folder) has learned from, in words."""
    told = load_network(name).provenance
    made, count, looks = (
        told["train"]["configuration"],
        told["train"]["samples"],
        told["train"]["configuration"].get("looks", 1),
    )
    walked = f", {looks} looks a contact" if looks > 1 else ""
    begun = ", begun with another network's weights" if "begun_from" in told else ""
    return f"{count} images of a set of seed {made['seed']}{walked}; training of seed {told['settings']['seed']}{begun}"


def _patch(runs, case):
    """What contact_patch_normal (dict) tells of a Case that keeps a depth of its own."""
    folder = open_builder(runs, case.group, case.name)
    return {"depth_mm": case.options.depth_mm, **contact_patch_normal(folder, load_object(case.options.object))}


def _is_there(runs, case):
    path = open_builder(runs, case.group, case.name) / "case.json"
    return path.exists() and path.read_text() == identity(case)


_KEPT = (
    "depth_mae_mm", "lateral_mae_mm", "angle_mean_deg", "angle_p95_deg", "contact_losses", "events", "coverage", "closed",
    "force_max_n", "steps", "steps_followed", "steps_per_s", "ms_a_step", "stopped_because", "passes",
)  # fmt: skip


def _row(runs, case):
    """What the page keeps (dict) of a run."""
    folder = open_builder(runs, case.group, case.name)
    if (folder / ERROR).exists():
        return {"name": case.name, "version": version("tactip-twin"), "error": (folder / ERROR).read_text().strip()}
    score = json.loads((folder / SCORE).read_text())
    kept = {name: score[name] for name in _KEPT}
    return {"name": case.name, "version": version("tactip-twin"), "task": case.options.task, **kept}


COLUMNS = (
    ("depth, mm", "depth_mae_mm", "{:.2f}"),
    ("beside, mm", "lateral_mae_mm", "{:.2f}"),
    ("angle, °", "angle_mean_deg", "{:.2f}"),
    ("95 % below, °", "angle_p95_deg", "{:.1f}"),
    ("losses", "contact_losses", "{}"),
    ("events", "events", "{}"),
    ("covered", "coverage", "{:.0%}"),
    ("most N", "force_max_n", "{:.1f}"),
    ("steps", "steps", "{}"),
    ("steps/s", "steps_per_s", "{:.1f}"),
    ("ended", "stopped_because", "{}"),
)
"""Title, figure of the score, and how it is written."""


def page(record):
    """The Markdown (str) of servo.json."""
    record = _by_groups(record)
    lines = [
        "# What the servo reaches",
        "",
        "Written by `tactip bench servo`; do not edit. Mean errors over the steps of a route, against the true geometry: "
        "depth and place beside the edge against the reference, angle between the sensor's axis and the true normal. The "
        "networks are the shipped ones.",
    ]
    for group, rows in record["groups"].items():
        versions = sorted({row.get("version", "0.1.0") for row in rows})
        made = record["made"][group]
        runs = "one run at a time" if made["workers"] == 1 else f"{made['workers']} runs at a time"
        told = f"version {' and '.join(versions)}, {runs}, one core each, on: {machine_text(made['machine'])}"
        lines += ["", f"## {GROUPS[group]}", "", f"Measured with {told}.", ""]
        if group == "fidelity":
            lines += ["![error against run time](servo.png)", ""]
        if group == "starts":
            lines += _starts(rows)
            continue
        lines += ["| run | " + " | ".join(title for title, _, _ in COLUMNS) + " |", "|" + "---|" * (1 + len(COLUMNS))]
        for row in rows:
            cells = [f"could not be made: {row['error']}"] if "error" in row else [_cell(row, *c[1:]) for c in COLUMNS]
            lines.append(f"| {row['name']} | " + " | ".join(cells) + " |")
        passes = [(row["name"], p) for row in rows for p in row.get("passes", []) if group == "objects"]
        if passes:
            lines += [
                "",
                "Passes:",
                "",
                "| object | pass | steps | depth, mm | angle, ° | 95 % below, ° |",
                "|" + "---|" * 6,
            ]
            lines += [
                f"| {name} | {p['pass']} | {p['steps']} | {p['depth_mae_mm']:.2f} | {p['angle_mean_deg']:.2f} | "
                f"{p['angle_p95_deg']:.1f} |"
                for name, p in passes
            ]
        if group == "robust":
            others = record.get("others", {}).items()
            lines += [line for task, told in others for line in ("", f"The other network of the {task}: {told}.")]
        if group == "robust" and "patches" in record:
            lines += _patches(record["patches"])
    return "\n".join(lines) + "\n"


def _patches(rows):
    """Lines on which normal is felt. rows: list of dict, of contact_patch_normal."""
    lines = [
        "",
        "Which normal is felt, on the bust: mean angle, °, from the felt normal to the surface's, averaged over discs about "
        "where it is nearest; in brackets how far those are from the normal where it is nearest itself, which the angles of "
        "all tables are held against.",
        "",
        "| pressed, mm | " + " | ".join(f"{r:g} mm about" if r else "the place itself" for r in RADII_MM) + " |",
        "|" + "---|" * (1 + len(RADII_MM)),
    ]
    for row in rows:
        pairs = zip(row["felt_deg"], row["apart_deg"], strict=True)
        lines.append(f"| {row['depth_mm']:g} | " + " | ".join(f"{a:.2f} ({b:.2f})" for a, b in pairs) + " |")
    return lines


def _cell(row, name, form):
    return "" if row[name] is None else form.format(row[name])


def followed(row):
    """Whether a run from a random start came to its reference and followed: ten steps and more, within a millimetre."""
    return "error" not in row and row["steps_followed"] >= 10 and row["depth_mae_mm"] < 1.0


def _starts(rows):
    """Lines on the random starts: how many followed, and why the others ended."""
    lines = ["| object | followed | depth, mm | angle, ° | the others |", "|---|---|---|---|---|"]
    for name in _LONG:
        mine = [row for row in rows if row["name"].startswith(f"{name}, ")]
        good = [row for row in mine if followed(row)]
        why = Counter(row.get("error") or row["stopped_because"] for row in mine if not followed(row))
        told = "; ".join(f"{n}: {reason}" for reason, n in why.most_common())
        depth, angle = (np.mean([row[k] for row in good]) if good else np.nan for k in ("depth_mae_mm", "angle_mean_deg"))
        lines.append(f"| {name} | {len(good)} of {len(mine)} | {depth:.2f} | {angle:.2f} | {told} |")
    return lines


_MARKERS = {
    "draft": "^",
    "standard": "o",
    "reference": "s",
    "4 at rest, pace 1": "+",
    "2 at rest, pace 1": "D",
    "1 at rest, pace 1": "x",
}
_MARKERS |= {"2 at rest, pace 2": "1", "1 at rest, pace 2": "2"}
"""Markers in the figure, by what differs."""


def draw(rows, path):
    """Error against time a step. rows: list of dict, of the group `fidelity`. path: Path, .png."""
    plt = pyplot()
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.8))
    for axis, (name, label) in zip(axes, (("depth_mae_mm", "depth, mm"), ("angle_mean_deg", "angle, °")), strict=True):
        for row in rows:
            if "error" in row or row[name] is None or not row["steps_per_s"]:
                continue
            thing, what = row["name"].split(", ", 1)
            kind = what.split(", ")[0] if "at rest" not in what else what.removeprefix("standard, ")
            axis.plot(
                1e3 / row["steps_per_s"], row[name], _MARKERS.get(kind, "o"), label=kind if thing == "bust" else None,
                color={"bust": "C3", "rim": "C0"}[thing], mfc="none" if "raster" in what else None,
            )  # fmt: skip
        axis.set(xscale="log", xlabel="ms a step", ylabel=f"mean error: {label}")
        axis.set_ylim(bottom=0)
    axes[0].set_title("red: a pass over the bust; blue: a rim; hollow: raster", fontsize=9)
    entries = dict(zip(*axes[1].get_legend_handles_labels()[::-1], strict=True))
    axes[1].legend(entries.values(), entries.keys(), fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=90, metadata={"Software": None})
    plt.close(figure)
