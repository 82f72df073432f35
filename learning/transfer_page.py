"""The results of transfer experiments as a page and figures."""

from learning.labels import LEARNED
from sim.dataset import write_file

PAGE = "results.md"

_TITLES = {
    "zero-shot": "Simulation alone, tested on real frames",
    "few-shot": "Some real frames",
}


def write_page(record, task, folder):
    """Write results.md of results.json (record, dict) of a task (str) into a folder (Path)."""
    write_file(folder / PAGE, page(record, task).encode())


def page(record, task):
    """The Markdown (str)."""
    names = [f"pose_{c}" for c in LEARNED[task]]
    lines = [
        f"# From simulation to {record['real']['set']}",
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
        lines += ["", f"## {title}", "", "| | " + " | ".join(f"{n}, {u}" for n, u in zip(kept, units, strict=True)) + " |"]
        lines.append("|" + "---|" * (1 + len(kept)))
        for what, figures in rows:
            cells = [_cell(figures, n) for n in kept]
            lines.append(f"| {what} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _rows(results):
    """Titles and figures (dict) of an experiment's results: those that are scores, or have scores in them."""
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


def _cell(figures, name):
    if name != "pose_z":
        return f"{figures['mae'][name]:.2f}"
    return f"{figures['mae_zeroed'][name]:.3f} ({figures['mae'][name]:.3f})"
