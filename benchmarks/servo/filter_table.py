"""Table of servo runs with and without the filter of poses over steps."""

from collections.abc import Sequence
from typing import Any

from tactip_twin.benchmarks.report import table

WITHOUT = "no filter"
"""Last part of the names of runs without the filter."""

_COLUMNS = (("depth_mae_mm", "{:.2f}"), ("lateral_mae_mm", "{:.2f}"), ("angle_mean_deg", "{:.2f}"))


def filter_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of runs (rows of servo.json), one row per object and setting, without and with the filter."""
    runs = {row["name"]: row for row in rows}
    best: dict[str, float] = {}
    for row in rows:
        name = row["name"].partition(",")[0]
        best[name] = max(best.get(name, 0.0), row.get("coverage") or 0.0)
    cells = []
    for name, row in runs.items():
        if name.endswith(f", {WITHOUT}"):
            continue
        which, _, what = name.partition(", ")
        both = [runs.get(f"{name}, {WITHOUT}"), row]
        line = [which, what]
        for one in both:
            line.append("–" if one is None or "error" in one else f"{100 * one['coverage'] / (best[which] or 1):.0f} %")
        for key, form in _COLUMNS:
            values = ["–" if one is None or one.get(key) is None else form.format(one[key]) for one in both]
            line.append(" → ".join(values))
        cells.append(line)
    head = ["object", "setting", "followed without", "followed with", "depth, mm", "lateral, mm", "angle, °"]
    return table(head, cells)
