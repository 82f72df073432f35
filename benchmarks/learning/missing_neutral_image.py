"""How far the pins of a twin are off that was fitted without a neutral image: `tactip bench
missing-neutral-image`.

A set that has one is imported without it, and the pins of its twin are held against those of the twin that had it.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from scipy.spatial import cKDTree

from tactip_twin.sim.dataset.format import read_meta
from tactip_twin.sim2real.importing.import_set import import_set, read_report, read_source
from tactip_twin.sim2real.importing.layout import Layout
from tactip_twin.sim2real.transfer.neutral_calibration import fit_design_to_neutral_image, nearest_nominal_design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import neutral_px


@dataclass(frozen=True)
class Options:
    """Fit a tip to frames alone, and hold it against the one that was fitted to its neutral image."""

    lab: Path
    """Folder of the laboratory's set."""
    real: Path
    """Folder that it was imported into (tactip import)."""
    keep: Path | None = None
    """Folder to keep the set in that is imported without its neutral image: for tactip transfer."""


def distance(options):
    """Distances, rms px of a 256 px image, of pins from those of the twin that saw the neutral image.

    options: Options. Returns a dict: of the twin that saw frames alone, and of the preset, fitted to nothing. Raises
    TactipError where a set cannot be used.
    """
    told = read_meta(options.real)["configuration"]["layout"]
    layout = Layout.from_dict(told)
    report = read_report(options.real)
    if report is None:
        raise TactipError(f"{options.real} is no set that tactip import made")
    size, pins = layout.preprocessing.size_px, report["pins"]["median"]
    with tempfile.TemporaryDirectory() as folder:
        out = options.keep or Path(folder) / "set"
        import_set(replace(read_source(options.lab, layout.column_map), neutral=None), layout, out)
        blind, _ = fit_design_to_neutral_image(out, size)
    seeing = cKDTree(neutral_px(fit_design_to_neutral_image(options.real, size)[0]))
    designs = {"of frames alone": blind, "fitted to nothing": nearest_nominal_design(pins, size)}
    return {name: float(np.sqrt((seeing.query(neutral_px(d))[0] ** 2).mean())) for name, d in designs.items()}


if __name__ == "__main__":
    print(distance(tyro.cli(Options, description=__doc__)))
