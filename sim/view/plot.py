"""The style of all figures, by Matplotlib without a display."""

import io
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from tactip_twin.tactip_model.files import write_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""Colours that color-blind readers can tell apart (Okabe & Ito, https://jfly.uni-koeln.de/color)."""

_DPI = 200
"""Resolution of the files, dots per inch."""

_STYLE = {
    "font.size": 10,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "0.9",
    "legend.frameon": False,
    "legend.fontsize": 9,
    "figure.constrained_layout.use": True,
}


def pyplot() -> ModuleType:
    """Return matplotlib.pyplot with the backend for files. It is imported on the first call because that takes a while."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def figure_of(
    rows: int, columns: int, size_in: tuple[float, float], heights: Sequence[float] | None = None
) -> "tuple[Figure, list[Axes]]":
    """Return a figure of the common style with rows × columns axes, row by row.

    Args:
        rows: Number of rows of axes.
        columns: Number of columns of axes.
        size_in: Width and height, inches.
        heights: Ratios of the heights of the rows; None for rows alike.
    """
    plt = pyplot()
    with plt.rc_context(_STYLE):
        figure, axes = plt.subplots(rows, columns, figsize=size_in, squeeze=False, height_ratios=heights)
    return figure, list(axes.ravel())


def log_axis(axis: "Axes", name: str) -> None:
    """Make the axis `x` or `y` logarithmic with plain numbers at 1, 2 and 5 of each decade, which do not collide."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    one = axis.xaxis if name == "x" else axis.yaxis
    axis.set(**{f"{name}scale": "log"})
    one.set_major_locator(LogLocator(subs=(1, 2, 5)))
    one.set_major_formatter(StrMethodFormatter("{x:g}"))
    one.set_minor_formatter(NullFormatter())


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure as PNG and close it; the file holds no program name, so the same data give the same bytes."""
    data = io.BytesIO()
    figure.savefig(data, dpi=_DPI, metadata={"Software": None}, format="png")
    write_file(path, data.getvalue())
    pyplot().close(figure)
