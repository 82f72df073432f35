"""tactip evaluate: the errors of a network on a set."""

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactip_twin.commands._parsing import Command
from tactip_twin.commands._progress import DelayedStatus
from tactip_twin.learning.configuration import DeviceName

if TYPE_CHECKING:
    import numpy as np

    from tactip_twin.learning.data import Samples
    from tactip_twin.learning.model import Model


@dataclass(frozen=True)
class Evaluate(Command):
    """Evaluate a network on unseen data: errors by component, label and shear, worst cases, latency."""

    example = "tactip evaluate --model surface-tactip-127 --data data/surface/test --out runs/evaluation"

    model: Path
    """Shipped network, or folder of a training."""
    data: Path
    """Folder of a set."""
    out: Path | None = None
    """Folder for evaluation.json, evaluation.md and figures. Default: print only."""
    json: bool = False
    """Print one JSON object and nothing else."""
    device: DeviceName = "cpu"
    """Device of the network; auto: the GPU if there is one."""
    threads: int | None = None
    """Number of threads of the network, at most one per core. Default: one per core."""
    any_sensor: bool = False
    """Also evaluate if the set's sensor has a different number of pins than the training's."""

    def run(self) -> int:
        from json import dumps

        with DelayedStatus("reading the set and the network"):
            from tactip_twin.learning.data import read_samples
            from tactip_twin.learning.device import device_named, set_threads
            from tactip_twin.learning.evaluate import MAX_OUTSIDE_FRACTION, check_same_pins, evaluate
            from tactip_twin.learning.evaluation_page import write_evaluation
            from tactip_twin.learning.image_check import MAX_UNLIKE_FRACTION
            from tactip_twin.learning.model import load_network
            from tactip_twin.sim2real.importing.import_set import pins_at_rest

            set_threads(self.threads)
            model, samples = load_network(self.model, device_named(self.device)), read_samples(self.data)
            at_rest = pins_at_rest(samples.folder)
            if not self.any_sensor:
                check_same_pins(model, samples, 0 if at_rest is None else len(at_rest))
            evaluation = evaluate(model, samples)
        if self.out:
            write_evaluation(evaluation, samples, model, self.out)
        figures = evaluation.figures
        for line in _doubts(figures, model, samples, at_rest):
            print(line, file=sys.stderr)
        if figures["outside_fraction"] > MAX_OUTSIDE_FRACTION:
            print(
                f"{figures['outside_fraction']:.0%} of the predictions are far outside the range that the network learned: "
                "it does not suit these images",
                file=sys.stderr,
            )
        if (figures["unlike_image_fraction"] or 0) > MAX_UNLIKE_FRACTION:
            print(
                f"{figures['unlike_image_fraction']:.0%} of the images are unlike those that the network learned, most "
                f"of them in {figures['unlike_in']}: check sensor, light, threshold and crop",
                file=sys.stderr,
            )
        if self.json:
            print(dumps(figures))
            return 0
        for name, unit in zip(model.labels.names, model.labels.units, strict=True):
            mae, rmse, bias = (figures[key][name] for key in ("mae", "rmse", "bias"))
            print(f"{name}: mean error {mae:.3f} {unit}, rms {rmse:.3f} {unit}, bias {bias:+.3f} {unit}")
        for line in _beside_the_pose(figures):
            print(line)
        print(f"{figures['samples']} samples; {figures['parameters']} parameters; {figures['latency_ms']:.1f} ms per image")
        if self.out:
            print(f"{self.out / 'evaluation.md'} written")
        return 0


_MIN_COVERAGE = 0.7
"""Fraction of the labels inside of the 95 % intervals below which these are called wrong. An estimate [?]."""


def _doubts(figures: Mapping[str, Any], model: "Model", samples: "Samples", at_rest: "np.ndarray | None") -> Iterator[str]:
    """Yield lines on why the figures may mean little: another sensor, or intervals that do not hold. at_rest: (n, 2) px of
    256, the pins in the neutral image of a real set."""
    from tactip_twin.learning.image_check import MAX_APART_PX, design_of, pins_apart_px, recorded_design
    from tactip_twin.tactip_model.neutral_image import neutral_px

    shown, learned = recorded_design(samples.dataset.meta["configuration"]), design_of(model)
    pins = at_rest if shown is None else neutral_px(shown)
    apart = 0.0 if pins is None or learned is None else pins_apart_px(learned, pins)
    if apart > MAX_APART_PX:
        yield (
            f"the pins at rest are {apart:.1f} px of 256 from those that the network learned (at most {MAX_APART_PX:g}): "
            "it was trained for another sensor or camera; tactip transfer trains one for this sensor"
        )
    names = [name for name, varies in figures["varies"].items() if varies]  # others show a rig's zero only
    for row in figures.get("reliability", []) if names else []:
        worst = min(names, key=lambda name: row["coverage"][name])
        if row["level"] == 0.95 and row["coverage"][worst] < _MIN_COVERAGE:
            yield (
                f"only {row['coverage'][worst]:.0%} of the labels of {worst} are inside of the network's 95 % intervals: "
                "do not rely on its deviations for these images"
            )


def _beside_the_pose(figures: Mapping[str, Any]) -> Iterator[str]:
    """Yield lines on what a network estimates beside the pose, and on its standard deviations, if it has any."""
    from tactip_twin.learning.quantities import QUANTITIES

    units = {q.name: q.unit for q in QUANTITIES}
    for name, error in figures.get("quantities", {}).items():
        yield f"{name}: mean error {error:.3f} {units[name]}".rstrip()
    if "contact" in figures:
        c = figures["contact"]
        line = f"contact: {100 * c['missed_fraction']:.1f} % of {c['samples_in_contact']} contacts missed"
        if c["samples_without"]:
            line += f", {100 * c['false_fraction']:.1f} % of {c['samples_without']} images without contact taken for one"
        yield line
    for row in figures.get("reliability", []):
        if row["level"] in (0.68, 0.95):
            inside = ", ".join(f"{name} {100 * row['coverage'][name]:.0f} %" for name in figures["mae"])
            yield f"labels inside of the {row['level']:.0%} intervals: {inside}"
