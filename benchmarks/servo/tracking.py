"""Tracking of a plate that moves in all axes at once: errors by fidelity, depth and rate, and with true poses.

`tactip bench tracking` writes docs/tracking.md and tracking.json. The page is written after each run, so what an
interruption leaves out can be measured later with --only.
"""

import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from typing import Any

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.benchmarks.servo.options import TrackingOptions
from tactip_twin.control.track_options import TrackOptions
from tactip_twin.control.tracking import track
from tactip_twin.tactip_model.errors import lookup

NAME = "tracking"

SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "true pose": {"model": "oracle"},
    "fast": {"fidelity": "fast"},
    "impedance ratio 30": {"impratio": 30.0},
    "3 mm deep": {"depth_mm": 3.0},
    "2 mm deep": {"depth_mm": 2.0},
    "15 steps per second": {"rate_hz": 15.0},
    "10 steps per second": {"rate_hz": 10.0},
}
"""Options of each run that differ from the default."""

_KEPT = (
    "seconds", "rms_mm", "max_mm", "rms_deg", "max_deg", "rms_mm_by_period", "rms_deg_by_period", "rms_by_axis",
    "estimate_rms_by_axis", "stopped_because",
)  # fmt: skip


def run(options: TrackingOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Make the runs, write tracking.json and tracking.md, and return the results. Raises TactipError."""
    names = [lookup("setting", name, dict.fromkeys(SETTINGS, name)) for name in options.only or SETTINGS]
    rows = read_results(options.out / f"{NAME}.json").get("rows", {})
    record: dict[str, Any] = {"rows": rows}
    for name in names:
        folder = options.runs / name.replace(" ", "-")
        shutil.rmtree(folder, ignore_errors=True)
        run_options = replace(TrackOptions(folder, seconds=options.seconds), **SETTINGS[name])
        start = time.process_time()  # of this process alone, which is single-threaded
        score = track(run_options)
        took = time.process_time() - start
        rows[name] = {key: score[key] for key in _KEPT} | {"processor_time_s": took, "asked_seconds": options.seconds}
        rows[name] |= {"machine": machine(), "version": version("tactip-twin")}
        log(f"{name}: {score['rms_mm']:.2f} mm, {score['rms_deg']:.2f}°; {score['stopped_because']}")
        record = {"rows": {key: rows[key] for key in SETTINGS if key in rows}}
        write_results(NAME, record, tables(record), options.out)
    return record


def tables(record: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/tracking.md from tracking.json."""
    rows: dict[str, dict[str, Any]] = record["rows"]
    head = ["setting", "tracked, s"]
    head += [f"{what}: {column}" for what in ("position, mm", "angle, °") for column in ("rms", "by period", "largest")]
    errors = [
        [name, f"{row['seconds']:.0f}", *_cells(row, "mm"), *_cells(row, "deg"), f"{row['processor_time_s']:.0f}"]
        for name, row in rows.items()
    ]
    notes = [f"- {name}: {row['stopped_because']}" for name, row in rows.items() if row["stopped_because"] != "completed"]
    axes = ["x, mm", "y, mm", "z, mm", "Rx, °", "Ry, °", "Rz, °"]
    by_axis = [
        [name, *(f"{e:.2f} ({s:.2f})" for e, s in zip(row["rms_by_axis"], row["estimate_rms_by_axis"], strict=True))]
        for name, row in rows.items()
    ]
    states: dict[str, list[str]] = {}
    for name, row in rows.items():
        states.setdefault(f"Version {row['version']}; {machine_text(row['machine'])}.", []).append(name)
    lines = [f"{', '.join(names)}: {state}" for state, names in states.items()]
    return {
        "errors": table([*head, "processor time, s"], errors) + ("\n\n" + "\n".join(notes) if notes else ""),
        "axes": table(["setting", *axes], by_axis),
        "machine": "\n".join(lines if len(states) > 1 else states),
    }


def _cells(row: dict[str, Any], unit: str) -> list[str]:
    """Return the root mean square error, that of each period, and the largest error as cells."""
    periods = ", ".join(f"{value:.2f}" for value in row[f"rms_{unit}_by_period"])
    return [f"{row[f'rms_{unit}']:.2f}", periods, f"{row[f'max_{unit}']:.2f}"]
