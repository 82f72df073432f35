"""The results of transfer experiments as a page."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tactip_twin.learning.labels import LEARNED
from tactip_twin.sim2real.transfer.linear_errors import advice, table_of
from tactip_twin.sim2real.transfer.real_shear import MAX_MOVE_MM
from tactip_twin.sim2real.transfer.score import INTERVALS
from tactip_twin.sim2real.transfer.settings import GAP
from tactip_twin.tactip_model.files import write_file

PAGE = "results.md"

_DESCRIPTION = (
    "Mean absolute errors on {test} real test frames that were not used for training. Depth errors are given without the "
    "median error of the set, its offset, and in brackets with it. Components that do not vary in the set are left out."
)

_COVERAGE = "Percentage of labels inside of the networks' intervals of 68 and 95 %, offset of the depth included:"

_NAMES = {
    "simulation": "trained in simulation",
    "real": "trained on all real training frames",
    "corrected": "trained in simulation and corrected linearly by {} real frames",
    "alone": "trained on {} real frames only",
}


def write_page(record: Mapping[str, Any], task: str, folder: Path) -> None:
    """Write results.md of a task into a folder, from the record in results.json."""
    write_file(folder / PAGE, page(record, task).encode())


def page(record: Mapping[str, Any], task: str) -> str:
    """Return the record in results.json as Markdown."""
    title = f"# Transfer from simulation to {record['real']['set']}"
    return "\n\n".join([title, _DESCRIPTION.format(test=record["real"]["test"]), *sections(record, task)]) + "\n"


def sections(record: Mapping[str, Any], task: str, figure: str = GAP) -> list[str]:
    """Return the tables of a record, and the figure of the gap, as Markdown.

    Args:
        record: Content of results.json.
        task: surface or edge.
        figure: File name of the figure of the gap.
    """
    rows = [row for name in ("zero-shot", "ablate", "few-shot") if name in record for row in _rows(name, record[name])]
    out = []
    if rows:
        names = [n for n in (f"pose_{c}" for c in LEARNED[task]) if rows[0][1]["varies"][n]]
        lines = ["| network | " + " | ".join(f"{n}, {'°' if '_R' in n else 'mm'}" for n in names) + " |"]
        lines += ["|" + "---|" * (1 + len(names))]
        lines += [f"| {what} | {' | '.join(_cell(figures, n) for n in names)} |" for what, figures in rows]
        out.append("\n".join(lines))
        out += _coverage(rows, names)
    linear = record.get("zero-shot", {}).get("simulation", {}).get("linear")
    if linear:
        out += ["Linear part of the errors of the network trained in simulation:", table_of(linear)]
    shear = record.get("zero-shot", {}).get("simulation", {}).get("shear")
    if shear:
        out.append(_shear(shear))
    if "gap" in record:
        out += _gap(record["gap"], figure)
    if linear:
        out.append("What this says:\n\n" + "\n".join(f"- {remark}" for remark in advice(linear)))
    return out


def _coverage(rows: list[tuple[str, dict[str, Any]]], names: list[str]) -> list[str]:
    """Return a sentence and a table of how often labels lie inside of the networks' intervals; nothing without intervals."""
    kinds = [(key, name) for name in names for key in (f"coverage_{100 * level:.0f}" for level in INTERVALS)]
    lines = ["| network | " + " | ".join(f"{name}, {key[-2:]} %" for key, name in kinds) + " |"]
    lines += ["|" + "---|" * (1 + len(kinds))]
    known = [(what, figures) for what, figures in rows if kinds[0][0] in figures]
    lines += [f"| {what} | {' | '.join(f'{100 * r[key][name]:.0f}' for key, name in kinds)} |" for what, r in known]
    return [_COVERAGE, "\n".join(lines)] if known else []


def _shear(figures: Mapping[str, Any]) -> str:
    """Return a sentence on the shear that the network reads."""
    parts = [
        f"{name}: mean error {part['mae_mm']:.2f} mm, correlation {part['correlation']:.2f}, slope {part['slope']:.2f}"
        for name, part in figures.items()
        if isinstance(part, Mapping)
    ]
    shown = f"{figures['shown_fraction']:.0%} in the median of {figures['frames']} frames"
    return (
        f"Effective shear that the network trained in simulation reads in moves up to {MAX_MOVE_MM:g} mm, against the part "
        f"of the move that the pins of each frame show through a learned tip ({shown}): {'; '.join(parts)}."
    )


def _gap(figures: Mapping[str, Any], figure: str) -> list[str]:
    """Return a table, a sentence and a figure on the distance between real and simulated pins."""
    rows = {
        "with the labels of the set": figures["labelled"],
        "at the best fraction of the motion": figures["best_fraction"],
    }
    lines = [f"| pin distance, {figures['unit']} | rms | median frame | 90 % of frames |", "|---|---|---|---|"]
    lines += [f"| {what} | {r['rms']:.2f} | {r['median']:.2f} | {r['p90']:.2f} |" for what, r in rows.items()]
    images = figures["images"]
    text = (
        f"{figures['frames']} frames, whose pins move by {figures['pins_move']:.1f} px rms; {figures['unmatched_frames']} "
        f"were left out because pins could not be matched, and {figures['mismatched_frames']} because pins were matched to "
        "their neighbours. White pixels within a pixel of a white pixel of the other image: "
        f"{images['white_within_a_pixel']:.0%}."
    )
    return ["\n".join(lines), text, f"![Distance of simulated from real pins]({figure})"]


def _rows(experiment: str, results: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield descriptions of networks and their figures."""
    for name, figures in results.items():
        if experiment == "few-shot":
            for part, inner in figures.items():
                if part in _NAMES:  # results of an earlier version have more
                    yield _NAMES[part].format(name), inner
        elif experiment == "zero-shot" or name.startswith("without"):
            yield _NAMES.get(name, f"trained in simulation {name}"), figures


def _cell(figures: Mapping[str, Any], name: str) -> str:
    if name != "pose_z":
        return f"{figures['mae'][name]:.2f}"
    return f"{figures['mae_zeroed'][name]:.3f} ({figures['mae'][name]:.3f})"
