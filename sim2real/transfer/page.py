"""The results of transfer experiments as a page and figures."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tactip_twin.learning.labels import LEARNED
from tactip_twin.sim2real.transfer.settings import GAP
from tactip_twin.tactip_model.files import write_file

PAGE = "results.md"

_TITLES = {
    "zero-shot": "Simulation alone, tested on real frames",
    "ablate": "What each part of the simulation is worth",
    "few-shot": "Some real frames",
}


def write_page(record: Mapping[str, Any], task: str, folder: Path) -> None:
    """Write results.md of a task into a folder, from the record in results.json."""
    write_file(folder / PAGE, page(record, task).encode())


def page(record: Mapping[str, Any], task: str) -> str:
    """Return the record in results.json as Markdown."""
    return "\n".join(page_lines(record, task)) + "\n"


def page_lines(record: Mapping[str, Any], task: str, level: int = 1, figure: str = GAP) -> list[str]:
    """Return the lines of a page, or of a part of one.

    Args:
        record: Content of results.json.
        task: surface or edge.
        level: Level of its title.
        figure: File name of the figure of the gap.
    """
    mark = "#" * level
    names = [f"pose_{c}" for c in LEARNED[task]]
    lines = [
        f"{mark} From simulation to {record['real']['set']}",
        "",
        "Written by `tactip transfer`; do not edit. Mean absolute errors on "
        f"{record['real']['test']} real frames that nothing was learned from; of the depth with its zero, the median error, "
        "taken out, and in brackets as it is. Components that do not vary in the set are left out.",
    ]
    for name, title in _TITLES.items():
        if name not in record:
            continue
        rows = list(_rows(record[name]))
        kept = [n for n in names if rows[0][1]["varies"][n]]
        units = ["°" if "_R" in n else "mm" for n in kept]
        lines += [
            "",
            f"{mark}# {title}",
            "",
            "| | " + " | ".join(f"{n}, {u}" for n, u in zip(kept, units, strict=True)) + " |",
        ]
        lines.append("|" + "---|" * (1 + len(kept)))
        for what, figures in rows:
            cells = [_cell(figures, n) for n in kept]
            lines.append(f"| {what} | {' | '.join(cells)} |")
    if "gap" in record:
        lines += _gap(record["gap"], mark, figure)
    return lines


def _gap(figures: Mapping[str, Any], mark: str, figure: str) -> list[str]:
    """Return the lines on the gap."""
    labelled, best = figures["as_told"], figures["at_the_best_share_of_the_move"]
    beside = f"Pins of {figures['frames']} real frames beside simulated ones, {figures['unit']}"
    lines = ["", f"{mark}# The gap itself", "", f"{beside}; they move by {figures['pins_move']:.1f} (rms)."]
    hidden, slipped = (figures[f"frames_whose_pins_were_{how}"] for how in ("not_told_apart", "taken_for_others"))
    lines[-1] += f" {hidden} frames are left out since their pins were not told apart, {slipped} since they were taken for"
    lines[-1] += " their neighbours."
    lines += ["", "| | rms | median frame | 90 % of frames |", "|---|---|---|---|"]
    for what, one in (("as the rows have it", labelled), ("at the share of the move that fits best", best)):
        lines.append(f"| {what} | {one['rms']:.2f} | {one['median']:.2f} | {one['p90']:.2f} |")
    images = figures["images"]
    lines += ["", f"White pixels with white of the other within a pixel: {images['white_within_a_pixel']:.0%}; "]
    lines[-1] += f"white: real {images['white_real']:.2%}, simulated {images['white_simulated']:.2%}."
    lines += ["", "| median distance by | from | to | px |", "|---|---|---|---|"]
    parts = figures["against"] | {"distance from the middle, px": figures["by_distance_from_the_middle"]}
    for name, bins in parts.items():
        lines += [f"| {name} | {b['from']:.2f} | {b['to']:.2f} | {b['median']:.2f} |" for b in bins]
    return [*lines, "", f"![where]({figure})"]


def _rows(results: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield titles and figures of an experiment's results: scores, and scores one level below."""
    for name, figures in results.items():
        if "mae" in figures:
            yield _WORDS.get(name, name), figures
        else:
            for part, inner in figures.items():
                yield f"{name} real frames, {_WORDS.get(part, part)}", inner


_WORDS = {
    "simulation": "trained on simulation",
    "real": "trained on real frames",
    "fine_tuned": "after simulation",
    "alone": "alone",
}


def _cell(figures: Mapping[str, Any], name: str) -> str:
    if name != "pose_z":
        return f"{figures['mae'][name]:.2f}"
    return f"{figures['mae_zeroed'][name]:.3f} ({figures['mae'][name]:.3f})"
