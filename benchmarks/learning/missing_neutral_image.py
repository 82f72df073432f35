"""Error of the pins of a design that is fitted without a neutral image: `tactip bench missing-neutral-image`.

A set that has a neutral image is imported without it, and the pins of the design fitted to it are compared with those of the
design fitted to the neutral image.
"""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from tactip_twin.benchmarks.learning.options import MissingNeutralImageOptions
from tactip_twin.sim.dataset.format import read_meta
from tactip_twin.sim2real.importing.import_set import import_set, read_report
from tactip_twin.sim2real.importing.layout import Layout
from tactip_twin.sim2real.importing.source import Source, read_source
from tactip_twin.sim2real.transfer.neutral_calibration import fit_design_to_neutral_image, nearest_nominal_design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import neutral_px


def run(options: MissingNeutralImageOptions, log: Callable[[str], None] = print) -> dict[str, float]:
    """Return the rms distances of pins from those of the design fitted to the neutral image, px of a 256 px image.

    They are those of the design fitted to frames alone, and of the nominal design; they also go to `log`. Raises TactipError
    where a set cannot be used.
    """
    layout = Layout.from_dict(read_meta(options.real)["configuration"]["layout"])
    report = read_report(options.real)
    if report is None:
        raise TactipError(f"{options.real} is no set that tactip import made")
    size, pins = layout.preprocessing.size_px, report["pins"]["median"]
    with tempfile.TemporaryDirectory() as folder:
        out = options.keep or Path(folder) / "set"
        import_set(_deep(read_source(options.lab, layout.column_map), options.min_depth_mm), layout, out)
        from_frames, _ = fit_design_to_neutral_image(out, size)
    reference = cKDTree(neutral_px(fit_design_to_neutral_image(options.real, size)[0]))
    designs = {"of frames alone": from_frames, "fitted to nothing": nearest_nominal_design(pins, size)}
    result = {name: float(np.sqrt((reference.query(neutral_px(d))[0] ** 2).mean())) for name, d in designs.items()}
    for name, distance_px in result.items():
        log(f"{name}: {distance_px:.3f} px")
    return result


def _deep(source: Source, min_depth_mm: float) -> Source:
    """Return a source without its neutral image and its frames at a smaller depth."""
    rows = [i for i, depth in enumerate(source.poses[:, 2]) if not min_depth_mm or depth <= -min_depth_mm]
    return replace(
        source,
        names=tuple(source.names[i] for i in rows),
        paths=tuple(source.paths[i] for i in rows),
        table={name: [cells[i] for i in rows] for name, cells in source.table.items()},
        poses=source.poses[rows],
        shears=source.shears[rows],
        neutral=None,
    )
