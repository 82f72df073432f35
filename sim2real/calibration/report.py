"""Report of a calibration: errors on test frames, as tables and figures."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.view.plot import COLORS, figure_of, save_figure
from tactip_twin.sim2real.calibration.fit import Result
from tactip_twin.sim2real.calibration.moves import LOAD_CELL_N, best_fraction, distances
from tactip_twin.sim2real.calibration.rig import RigMotion
from tactip_twin.sim2real.calibration.settings import Settings
from tactip_twin.tactip_model.design_file import write_fitted_design
from tactip_twin.tactip_model.files import remove_leftovers, write_file

RINGS = 8
"""Number of rings with equal numbers of pins, by their distance from the middle of the neutral image."""

UPRIGHT_RAD = np.radians(8)
"""Maximum commanded tilt of a frame that counts as upright, rad."""

_DISPLAY = {"m": (1e3, "mm"), "Pa": (1e-3, "kPa"), "deg": (1.0, "°"), "-": (1.0, ""), "widths": (256.0, "px of 256")}


def figures_of(result: Result) -> dict[str, Any]:
    """Return figures (JSON) of a calibration on its test frames. Distances in px of a 256 px image."""
    along, seen = result.pins_along_moves, result.test_frames.pins_px
    _, pins, _ = best_fraction(along, seen)
    commanded, before = distances(along[:, -1], seen), distances(along[:, 0], seen)
    fitted = distances(pins, seen)
    depths, slides, tilts, directions = _commands(result)
    parameters = {}
    for p, deviation in zip(result.chosen, result.deviations, strict=True):
        value = p.read(result.twin)
        spread = deviation * p.step * (value if p.logarithmic else 1.0)
        at_bound = bool(value in (p.low, p.high))
        parameters[p.name] = {"value": value, "deviation": float(spread), "unit": p.unit, "at_bound": at_bound}
    return {
        "parameters": parameters,
        "rig": asdict(result.twin.rig),
        "neutral_px": {
            "initial": result.neutral.before_px,
            "lens_and_camera": result.neutral.lattice_px,
            "pin_positions": result.neutral.after_px,
        },
        "rounds": result.rounds,
        "test_frames": len(seen),
        "frames_px": {
            "fitted_fraction": _summary(fitted),
            "before_or_after_motion": _summary(np.minimum(commanded, before)),
            "as_commanded": _summary(commanded),
        },
        "depth": _depth_table(depths, tilts, seen, pins, result.neutral.pins_px),
        "shear": _shear_table(depths, slides, directions, seen, pins, along, result.neutral.pins_px),
        "force_n": {
            f"{1e3 * d:g} mm": [float(f), r] for f, (d, r) in zip(result.forces_n, LOAD_CELL_N.items(), strict=True)
        },
    }


def _summary(distance: np.ndarray) -> dict[str, float]:
    """Return root mean square, median and 90th percentile over frames of their rms distances."""
    return {
        "rms": float(np.sqrt((distance**2).mean())),
        "median": float(np.median(distance)),
        "p90": float(np.quantile(distance, 0.9)),
    }


def _commands(result: Result) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return depths (n,) m, lateral moves (n,) m, tilts (n,) rad and directions in the image (n, 2), as commanded."""
    motion = RigMotion(result.twin.rig)
    contacts = [motion.contact(pose, move, result.test_frames.tap) for pose, move in result.test_frames.commands]
    poses, shears = (np.array(c) for c in zip(*contacts, strict=True))
    lateral = shears[:, :2] * [1, -1]
    slide = np.linalg.norm(lateral, axis=1)
    return -poses[:, 2], slide, np.linalg.norm(poses[:, 3:5], axis=1), lateral / np.maximum(slide, 1e-9)[:, None]


def _depth_table(
    depths: np.ndarray, tilts: np.ndarray, seen: np.ndarray, pins: np.ndarray, neutral: np.ndarray
) -> dict[str, Any]:
    """Return the outward motion of rings of pins, detected and simulated, for bins of depth, over upright frames."""
    middle = neutral.mean(0)
    radius = np.linalg.norm(neutral - middle, axis=1)
    outward = (neutral - middle) / np.maximum(radius, 1e-9)[:, None]
    ring = np.minimum((np.argsort(np.argsort(radius)) * RINGS) // len(radius), RINGS - 1)
    rows = []
    for low in np.arange(0.5e-3, 6e-3, 0.5e-3):
        chosen = (depths >= low) & (depths < low + 0.5e-3) & (tilts < UPRIGHT_RAD)
        if chosen.sum() < 2:
            continue
        real, simulated = (np.nanmean(((p[chosen] - neutral) * outward).sum(-1), 0) for p in (seen, pins))
        means = [[float(np.nanmean(m[ring == k])) for k in range(RINGS)] for m in (real, simulated)]
        rows.append({"depth_mm": float(1e3 * depths[chosen].mean()), "frames": int(chosen.sum()), "real_px": means[0]})
        rows[-1]["simulated_px"] = means[1]
    return {"rows": rows, "rms_px": _table_rms(rows, "simulated_px")}


def _shear_table(
    depths: np.ndarray,
    slides: np.ndarray,
    directions: np.ndarray,
    seen: np.ndarray,
    pins: np.ndarray,
    along: np.ndarray,
    neutral: np.ndarray,
) -> dict[str, Any]:
    """Return the mean motion of all pins against the move, detected and simulated, for bins of depth and of shear."""

    def shift(p: np.ndarray) -> np.ndarray:
        return -np.nanmean(((p - neutral) * directions[:, None]).sum(-1), 1)

    shifts = [shift(seen), shift(pins), shift(along[:, -1])]
    rows = []
    for low in np.arange(1e-3, 5e-3, 1e-3):
        row = {"depth_mm": [1e3 * low, 1e3 * low + 1], "shear_mm": [], "frames": [], "real_px": []}
        row |= {"simulated_px": [], "as_commanded_px": []}
        for slide in np.arange(0, 6e-3, 1e-3):
            chosen = (depths >= low) & (depths < low + 1e-3) & (slides >= slide) & (slides < slide + 1e-3)
            if chosen.sum() < 2:
                continue
            row["shear_mm"].append(float(1e3 * slides[chosen].mean()))
            row["frames"].append(int(chosen.sum()))
            for key, s in zip(("real_px", "simulated_px", "as_commanded_px"), shifts, strict=True):
                row[key].append(float(s[chosen].mean()))
        rows.append(row)
    return {
        "rows": rows,
        "rms_px": _table_rms(rows, "simulated_px"),
        "as_commanded_rms_px": _table_rms(rows, "as_commanded_px"),
    }


def _table_rms(rows: list[dict[str, Any]], key: str) -> float | None:
    differences = np.concatenate([np.subtract(r[key], r["real_px"]) for r in rows]) if rows else np.zeros(0)
    return float(np.sqrt((differences**2).mean())) if differences.size else None


def write_report(result: Result, real_name: str, settings: Settings, out: str | Path, folder: str | Path) -> dict[str, Any]:
    """Write the fitted design and the report, and return the report's figures.

    Args:
        result: Result of the calibration.
        real_name: Name of the real set.
        settings: Settings of the calibration.
        out: Design file to write.
        folder: Folder for calibration.json, calibration.md, pins.png and curves.png.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    remove_leftovers(Path(out).parent, Path(out).name)
    figures = figures_of(result)
    figures = {"real": real_name, "design": result.twin.design.name, "settings": asdict(settings)} | figures
    write_file(folder / "calibration.json", (json.dumps(figures, indent=1) + "\n").encode())
    write_file(folder / "calibration.md", page(figures).encode())
    _plot_pins(result, folder / "pins.png")
    plot_curves(figures, folder / "curves.png")
    kept = ("real", "settings", "parameters", "rig", "neutral_px", "test_frames", "frames_px", "force_n")
    write_fitted_design(out, result.twin.design, {"by": "tactip calibrate"} | {k: figures[k] for k in kept})
    return figures


def page(figures: dict[str, Any]) -> str:
    """Return a report as Markdown."""
    n, f, depth, shear = (figures[name] for name in ("neutral_px", "frames_px", "depth", "shear"))
    names = {
        "fitted_fraction": "frames, fraction of the motion fitted to each",
        "before_or_after_motion": "frames, taken either before or after the motion",
        "as_commanded": "frames, taken after the motion as commanded",
    }
    lines = [
        f"# Calibration of {figures['design']} to {figures['real']}",
        "",
        f"Fitted to {figures['settings']['fit_frames']} frames of one half of the set, and tested on "
        f"{figures['test_frames']} frames of the other half.",
        "",
        "| pin distance, px of a 256 px image | rms | median frame | 90 % of frames |",
        "|---|---|---|---|",
        f"| neutral image, initial | {n['initial']:.2f} | | |",
        f"| neutral image, lens and camera fitted | {n['lens_and_camera']:.2f} | | |",
        *(f"| {text} | {f[k]['rms']:.2f} | {f[k]['median']:.2f} | {f[k]['p90']:.2f} |" for k, text in names.items()),
        f"| outward motion of {RINGS} rings of pins by depth, upright frames | {_rms_text(depth['rms_px'])} | | |",
        f"| mean shift of pins by depth and shear | {_rms_text(shear['rms_px'])} | | |",
        f"| the same, as commanded | {_rms_text(shear['as_commanded_rms_px'])} | | |",
        "",
        "| depth on a flat surface | simulated force, N | load cell, N |",
        "|---|---|---|",
        *(f"| {depth} | {a:.2f} | {b:.2f} |" for depth, (a, b) in figures["force_n"].items()),
        "",
        "| parameter | value | standard deviation |",
        "|---|---|---|",
    ]
    for name, p in figures["parameters"].items():
        scale, unit = _DISPLAY[p["unit"]]
        note = " (at its bound)" if p["at_bound"] else ""
        lines.append(f"| {name} | {scale * p['value']:.4g} {unit}{note} | {scale * p['deviation']:.2g} |")
    lines += [
        "",
        "![Real and simulated pins of six test frames](pins.png)",
        "",
        "![Response to depth and shear](curves.png)",
    ]
    return "\n".join(lines) + "\n"


def _rms_text(rms_px: float | None) -> str:
    """Return a cell with a deviation that no frame may show."""
    return "no such frames" if rms_px is None else f"{rms_px:.2f}"


def _plot_pins(result: Result, path: Path) -> None:
    """Plot detected (rings) and simulated pins (dots) of six test frames, residuals as arrows three times their length."""
    seen = result.test_frames.pins_px
    fraction, pins, _ = best_fraction(result.pins_along_moves, seen)
    rms = distances(pins, seen)
    shown = np.argsort(rms)[(np.linspace(0.05, 0.95, 6) * len(rms)).astype(int)]
    depths, slides, tilts, _ = _commands(result)
    figure, axes = figure_of(2, 3, (12, 8.6))
    for axis, i in zip(axes, shown, strict=True):
        left = seen[i] - pins[i]
        axis.plot(*seen[i].T, "o", mfc="none", color="0.4", ms=6, label="real")
        axis.plot(*pins[i].T, ".", color=COLORS[1], ms=5, label="simulated")
        axis.quiver(*pins[i].T, *left.T, angles="xy", scale_units="xy", scale=1 / 3, color=COLORS[0], width=0.003)
        axis.set(xlim=(0, 256), ylim=(256, 0), aspect="equal", xlabel="x, px of 256", ylabel="y, px of 256")
        axis.set_title(
            f"{1e3 * depths[i]:.1f} mm deep, tilt {np.degrees(tilts[i]):.0f}°, motion {1e3 * slides[i]:.1f} mm\n"
            f"{100 * fraction[i]:.0f} % of the motion: {rms[i]:.2f} px",
            fontsize=9,
        )
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    save_figure(figure, path)


def plot_curves(figures: dict[str, Any], path: Path) -> None:
    """Plot depth and shear response, real (dots) and simulated (lines, crosses), from the figures of a report."""
    from matplotlib import colormaps

    figure, axes = figure_of(1, 2, (11, 5.2))
    depths, shears = figures["depth"]["rows"], figures["shear"]["rows"]
    for axis, rows in zip(axes, (depths, shears), strict=True):
        colors = colormaps["viridis"](np.linspace(0, 0.9, len(rows)))
        for color, row in zip(colors, rows, strict=True):
            if axis is axes[0]:
                x, text = np.arange(1, RINGS + 1), f"{row['depth_mm']:.1f} mm deep"
            else:
                x, text = row["shear_mm"], "{:.0f}–{:.0f} mm deep".format(*row["depth_mm"])
            axis.plot(x, row["real_px"], "o", color=color, ms=4)
            axis.plot(x, row["simulated_px"], "-" if axis is axes[0] else "x", color=color, label=text)
        if rows:
            axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3)
    axes[0].set(xlabel="ring of pins, inner to outer", ylabel="outward motion, px of 256", title="Upright presses")
    axes[1].set(xlabel="commanded motion, mm", ylabel="mean shift of the pins, px of 256", title="Motions in contact")
    figure.suptitle("dots: real; lines and crosses: simulated", fontsize=9)
    save_figure(figure, path)
