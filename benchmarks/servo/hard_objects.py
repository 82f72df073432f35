"""Servo runs over objects with features that are smaller, deeper or steeper than the fingertip.

`tactip bench hard-objects` makes the meshes, follows each object with the defaults of `tactip servo`, and writes
docs/hard_objects.md and hard_objects.json. The bust comes at three scales. After an interruption it resumes: each run is a
folder of RUNS.
"""

import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.assets.meshes.hard_rims import HARD_RIMS
from tactip_twin.assets.meshes.hard_solids import HARD_SOLIDS
from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.benchmarks.servo.options import HardObjectsOptions
from tactip_twin.benchmarks.servo.servo import ERROR, Case, is_done, make, random_start, run_folder
from tactip_twin.control.options import RouteOptions, ServoOptions, Settings
from tactip_twin.control.score import events_text
from tactip_twin.control.servo_run import SCORE
from tactip_twin.control.surface_score import CURVATURE_BINS
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.tactip_model.errors import lookup

_RIMS_FOOT_MM = (400.0, 0.0, 100.0)
_FACE_UP_DEG = (0.0, -90.0, 0.0)


@dataclass(frozen=True)
class HardObject:
    """An object to follow."""

    solid: str
    """Its name in HARD_SOLIDS."""
    scale: float = 1.0
    """Scale of the solid."""
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector, degrees."""
    position_mm: tuple[float, float, float] = (380.0, 0.0, 60.0)
    """Position of the centre of its underside, base frame, mm."""
    middle_mm: tuple[float, float, float] | None = None
    """Middle of the route, in the frame of the unscaled solid, mm; None: the middle of the object."""


_FACE_MM, _HEADS_FACE_MM = (80.0, 0.0, 55.0), (85.0, 0.0, 5.0)

OBJECTS = {
    "bust, 370 mm tall": HardObject("bust-sharp", 1.0, _FACE_UP_DEG, (400.0, 0.0, 70.0), _FACE_MM),
    "bust, 300 mm tall": HardObject("bust-sharp", 0.81, _FACE_UP_DEG, (400.0, 0.0, 70.0), _FACE_MM),
    "bust, 200 mm tall": HardObject("bust-sharp", 0.54, _FACE_UP_DEG, (400.0, 0.0, 100.0), _FACE_MM),
    "head, 300 mm tall": HardObject("head", 1.11, _FACE_UP_DEG, (350.0, 0.0, 10.0), _HEADS_FACE_MM),
    "head, 270 mm tall": HardObject("head", 1.0, _FACE_UP_DEG, (350.0, 0.0, 20.0), _HEADS_FACE_MM),
    "head, 200 mm tall": HardObject("head", 0.74, _FACE_UP_DEG, (350.0, 0.0, 60.0), _HEADS_FACE_MM),
    "relief": HardObject("relief", position_mm=(400.0, 0.0, 160.0)),
    "vase": HardObject("vase", 1.0, _FACE_UP_DEG),
}
"""Objects by name: busts and heads lie face up, the vase on its side with the handle up, all of them along the x axis of the
base, because the wrist can point far to the sides, but not back. Heads lie near the arm, whose wrist then reaches their far
sides. Flat objects lie high, because low down the wrist is almost straight, and so singular."""

RIMS = {"rim with a gap of 25 mm": "rim-gap", "rim with corners of 5 mm": "rim-corners"}
"""Rims, which are followed all round: their names in HARD_RIMS, by the names of the objects."""

MAX_STARTS = 50

_START_STEPS = 100
"""Steps of a run from a random start: with the learned tip, some to find the object and to get past obstacles."""

_START_LENGTH_MM = 15.0
"""Length of their line, mm: enough for these steps, and short enough to begin above every object."""

_MIN_FOLLOWED = 10
"""Steps on the route from which a random start counts as followed."""


def mesh_file(folder: Path, solid: str) -> Path:
    """Return the file of a mesh, mm, which is made if it is missing. It needs scikit-image, from the extra `dev`."""
    path = folder / f"{solid}.ply"
    if not path.exists():
        from tactip_twin.assets.meshes.make import cut

        distance, low, high, spacing_mm = HARD_SOLIDS[solid]
        folder.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial.ply")
        cut(distance, np.asarray(low, float), np.asarray(high, float), spacing_mm).export(partial)
        partial.replace(path)
    return path


def rim_file(folder: Path, name: str) -> Path:
    """Return the file of the mesh of a rim, m, which is made if it is missing, with its edge."""
    path = folder / f"{name}.ply"
    if not path.exists():
        from tactip_twin.assets.meshes.make import write_rim

        folder.mkdir(parents=True, exist_ok=True)
        write_rim(name, HARD_RIMS[name], folder)
    return path


def cases(options: HardObjectsOptions) -> list[Case]:
    """Return the runs over the chosen objects: one over each, then those from random starts."""
    out = []
    known = dict.fromkeys((*OBJECTS, *RIMS))
    for name in options.only or known:
        lookup("object", name, known)
        if name in RIMS:
            if not options.whole:
                continue
            path = str(rim_file(options.meshes, RIMS[name]))
            run = ServoOptions(Path("-"), "edge", path, "m", position_mm=_RIMS_FOOT_MM, fidelity=options.fidelity)
            out.append(Case("rims", name, run))
            continue
        one = OBJECTS[name]
        path = str(mesh_file(options.meshes, one.solid))
        placed = load_object(path, None, one.scale, one.position_mm, one.rotation_deg)
        middle = placed.middle_m
        if one.middle_mm is not None:
            middle = (placed.T_base_object @ [*(one.scale * np.array(one.middle_mm) / 1e3), 1])[:3]
        run = ServoOptions(
            Path("-"), "surface", path, None, one.scale, one.position_mm, one.rotation_deg, fidelity=options.fidelity
        )
        x, y = 1e3 * middle[:2]
        if options.whole:
            out.append(Case("whole", name, replace(run, route=RouteOptions(middle_mm=(float(x), float(y))))))
        for seed in range(min(options.starts, MAX_STARTS)):
            start = random_start(run, seed, middle)
            line = replace(start.route, length_mm=_START_LENGTH_MM)
            # The raster renderer needs no OpenGL, and writes no figure, which takes a fifth of so short a run.
            quick = replace(start, fidelity="fast", renderer="raster", settings=Settings(max_steps=_START_STEPS), route=line)
            out.append(Case("starts", f"{name}, {seed}", quick))
    return out


def run(options: HardObjectsOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Make the runs that are missing, write hard_objects.json and hard_objects.md, and return the results.

    Progress goes to `log`. Raises TactipError, and Interrupted on Ctrl-C.
    """
    chosen = cases(options)
    workers = worker_count(options.workers)
    make(options.runs, [case for case in chosen if not is_done(options.runs, case)], workers, log)
    before = read_results(options.out / "hard_objects.json") or {"rows": {}}
    rows = before["rows"]
    for case in chosen:
        rows[case.name] = {"group": case.group, "fidelity": case.options.fidelity, **_row(options.runs, case)}
    record = {"rows": rows, "machine": machine(), "workers": workers, "version": version("tactip-twin")}
    write_results("hard_objects", record, tables(record), options.out)
    return record


_KEPT = {
    "whole": (
        "reachable", "coverage", "coverage_of_reachable", "depth_mae_mm", "angle_mean_deg", "angle_p95_deg", "errors",
        "events", "left_out", "force_max_n", "force_peak_n", "penetration_max_mm", "penetration_within_bound", "steps",
        "steps_followed",
        "path_mm", "steps_per_s", "stopped_because",
    ),
    "rims": (
        "coverage", "depth_mae_mm", "lateral_mae_mm", "angle_mean_deg", "angle_p95_deg", "closed", "events", "left_out",
        "force_max_n", "force_peak_n", "steps", "steps_followed", "path_mm", "stopped_because",
    ),
    "starts": ("depth_mae_mm", "angle_mean_deg", "events", "force_max_n", "steps", "steps_followed", "stopped_because"),
}  # fmt: skip
"""Figures of a score that are kept, by group of runs."""


def _row(runs: Path, case: Case) -> dict[str, Any]:
    folder = run_folder(runs, case.group, case.name)
    if (folder / ERROR).exists():
        return {"error": (folder / ERROR).read_text().strip()}
    score = json.loads((folder / SCORE).read_text())
    return {name: score[name] for name in _KEPT[case.group]}


def tables(record: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/hard_objects.md from hard_objects.json."""
    whole = {name: row for name, row in record["rows"].items() if row["group"] == "whole" and "error" not in row}
    starts = {name: row for name, row in record["rows"].items() if row["group"] == "starts"}
    rims = {name: row for name, row in record["rows"].items() if row["group"] == "rims" and "error" not in row}
    made = f"Version {record['version']}; {record['workers']} at a time; {machine_text(record['machine'])}."
    return {
        "runs": _runs(whole),
        "curvature": _by_curvature(whole),
        "rims": _rims(rims),
        "starts": _starts(starts),
        "machine": made,
    }


def _runs(rows: dict[str, dict[str, Any]]) -> str:
    """Return the table of the runs over whole objects, with what was left out below it."""
    head = ["object", "fidelity", "touchable", "covered of it", "tip fits: steps", "depth, mm", "angle, °", "95 %, °"]
    head += [
        "to the mean normal, °",
        "all steps: depth, mm",
        "angle, °",
        "95 %, °",
        "force, N",
        "peak within a step, N",
        "penetration in bound",
        "left out, mm",
    ]
    cells, lines = [], []
    for name, row in rows.items():
        fitting = row["errors"]["where the tip fits"]
        left = sum(s["to_mm"] - s["from_mm"] for s in row["left_out"])
        shares = [row["reachable"], row["coverage_of_reachable"], fitting["steps"] / max(1, row["steps_followed"])]
        limits = [f"{row['force_max_n']:.1f}", _peak(row), f"{row['penetration_within_bound'] or 1:.1%}", f"{left:.0f}"]
        to_mean = f"{fitting['angle_to_mean_normal_deg']:.1f}"
        errors = [*_errors(fitting), to_mean, *_errors(row)]
        cells.append([name, row["fidelity"], *map("{:.0%}".format, shares), *errors, *limits])
        kinds = Counter(s["kind"] for s in row["left_out"])
        lines.append(
            f"- {name}: {row['stopped_because']}; events: {events_text(row['events'])}; left out: {events_text(kinds)}"
        )
    return table(head, cells) + "\n\n" + "\n".join(lines)


def _rims(rows: dict[str, dict[str, Any]]) -> str:
    """Return the table of the rims."""
    head = ["rim", "fidelity", "covered", "depth, mm", "lateral, mm", "angle, °", "95 %, °"]
    head += ["force, N", "peak within a step, N", "left out, mm"]
    cells = []
    for name, row in rows.items():
        left = sum(s["to_mm"] - s["from_mm"] for s in row["left_out"])
        errors = [f"{row['depth_mae_mm']:.2f}", f"{row['lateral_mae_mm']:.2f}"]
        errors += [f"{row['angle_mean_deg']:.1f}", f"{row['angle_p95_deg']:.1f}", f"{row['force_max_n']:.1f}", _peak(row)]
        cells.append([name, row["fidelity"], f"{row['coverage']:.0%}", *errors, f"{left:.0f}"])
    notes = [f"- {name}: {row['stopped_because']}; events: {events_text(row['events'])}" for name, row in rows.items()]
    return table(head, cells) + "\n\n" + "\n".join(notes)


def _peak(row: Mapping[str, Any]) -> str:
    """Return the largest force within a step; empty where it is not known."""
    return "" if row.get("force_peak_n") is None else f"{row['force_peak_n']:.1f}"


def _by_curvature(rows: dict[str, dict[str, Any]]) -> str:
    """Return the table of errors by local curvature."""
    cells = []
    for bin_name in CURVATURE_BINS:
        found = {name: row["errors"][bin_name] for name, row in rows.items()}
        texts = [f"{' / '.join(_errors(e)[:2])} ({e['steps']})" if e["steps"] else "" for e in found.values()]
        cells.append([bin_name, *texts])
    return table(["surface below the apex", *rows], cells)


def _starts(rows: dict[str, dict[str, Any]]) -> str:
    """Return the table of the random starts."""
    cells = []
    for name in OBJECTS:
        mine = [row for key, row in rows.items() if key.startswith(f"{name}, ") and key.count(",") > name.count(",")]
        if mine:
            good = [row for row in mine if "error" not in row and row["steps_followed"] >= _MIN_FOLLOWED]
            others = Counter(_reason(row) for row in mine if row not in good)
            cells.append([name, f"{len(good)} of {len(mine)}", "; ".join(f"{n}: {reason}" for reason, n in others.items())])
    return table(["object", "followed", "reasons of the others"], cells)


def _reason(row: dict[str, Any]) -> str:
    """Return why a run from a random start did not follow."""
    if row.get("error"):
        return row["error"]
    events = f" ({events_text(row['events'])})" if row["events"] else ""
    return f"{row['stopped_because']}, {row['steps_followed']} steps on it{events}"


def _errors(errors: dict[str, Any]) -> list[str]:
    """Return mean depth, mean angle and its 95th percentile as cells."""
    forms = {"depth_mae_mm": "{:.2f}", "angle_mean_deg": "{:.1f}", "angle_p95_deg": "{:.1f}"}
    return ["" if errors[name] is None else form.format(errors[name]) for name, form in forms.items()]
