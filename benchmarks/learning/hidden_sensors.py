"""Networks trained in simulation only, on sensors that nobody has tuned them to: `tactip bench hidden-sensors`.

Hidden simulated sensors, whose mechanics, lens, pins and light are drawn at random, are pressed by a rig with faults: a
tilted table, a tool centre beside the axis, shears that are not finished, a camera that warms up. Each set is imported with
`tactip import --find` and a network trained for it, as a user would. The true poses, which no laboratory has, tell the
errors. Writes docs/hidden_sensors.md and docs/hidden_sensors.json.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning.conventions import as_in_frames
from tactip_twin.benchmarks.learning.options import HiddenSensorsOptions
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.learning.data import Samples
from tactip_twin.learning.model import Estimates
from tactip_twin.sim.dataset.format import read_dataset, read_rows
from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.labels import LABELS
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.sim2real.importing.column_map import ColumnMap, Task
from tactip_twin.sim2real.importing.find_layout import FoundLayout, find_layout
from tactip_twin.sim2real.importing.import_set import import_set
from tactip_twin.sim2real.importing.layout import Layout
from tactip_twin.sim2real.importing.source import read_recording, read_source
from tactip_twin.sim2real.transfer.experiments import Experiment
from tactip_twin.sim2real.transfer.pseudo_real import FRAME_PX, HiddenSet, hidden_design, make_lab
from tactip_twin.sim2real.transfer.rig_faults import typical_rig_faults
from tactip_twin.sim2real.transfer.score import score
from tactip_twin.sim2real.transfer.settings import PseudoKind
from tactip_twin.tactip_model.design import Pins
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.pins import neutral_pins

SHOTS = 50
"""Number of labelled frames of the linear correction."""

CERTAIN = 0.9
"""Fraction of the estimates that remain where the least certain ones are left out."""

TARGETS = {
    "surface": {"pose_z": 0.1, "pose_Rx": 0.8, "pose_Ry": 0.8},
    "edge": {"pose_x": 0.3, "pose_z": 0.15, "pose_Rz": 3.5},
}
"""Target errors by task, mm and degrees."""

_EDGE = Ranges(x_mm=(-5, 5), depth_mm=(-5.5, -1.5), yaw_deg=(-45, 45))
"""Poses on edges: published sets have no tilts."""

_ALL_ROUND = Ranges(x_mm=(-5, 5), depth_mm=(-5.5, -1.5), yaw_deg=(-180, 180))
"""Poses on an edge that the sensor meets from every side."""

_SIDE = np.linspace(-12e-3, 12e-3, 7)
_SQUARE = Pins(
    "free",
    rings=4,
    pitch_m=4e-3,
    as_built_m=tuple((float(x), float(y)) for x in _SIDE for y in _SIDE),
)
"""A square array of 49 pins."""

_NARROW = Pins("circular", rings=10, pitch_m=1.64e-3)
"""Pins of 331 that are closer together than those of the preset, as the pins of a real tip (real-331 has 1.68 mm)."""

_DEEP = Ranges(depth_mm=(-5.5, -2.5), roll_deg=(-15, 15), pitch_deg=(-15, 15))
"""Poses on a surface that show no light touch."""


@dataclass(frozen=True)
class Sensor:
    """A hidden sensor."""

    task: Task
    """Its object."""
    design: PseudoKind
    """Preset that it is similar to."""
    seed: int
    """Seed of everything that is random."""
    friction: float
    """Friction of its skin on the object, -."""
    neutral_image: bool = True
    """Whether its set has a neutral image."""
    poses: Ranges | None = None
    """Ranges of its poses. Default: those of its task."""
    pins: Pins | None = None
    """Its pins. Default: those of the preset."""


SENSORS = {
    "surface-a": Sensor("surface", "nominal-127", 101, 0.3),
    "surface-b": Sensor("surface", "nominal-331", 102, 1.2),
    "surface-c": Sensor("surface", "nominal-331", 103, 0.8, neutral_image=False),
    "surface-d": Sensor("surface", "nominal-127", 104, 1.8),
    "surface-e": Sensor("surface", "nominal-331", 109, 1.0, neutral_image=False, poses=_DEEP),
    "surface-f": Sensor("surface", "nominal-127", 110, 0.8, pins=Pins("hexagonal", rings=4, pitch_m=4.4e-3)),
    "surface-g": Sensor("surface", "nominal-127", 111, 0.6, pins=_SQUARE),
    "surface-h": Sensor("surface", "nominal-331", 113, 1.3, neutral_image=False, poses=_DEEP, pins=_NARROW),
    "edge-a": Sensor("edge", "nominal-127", 105, 1.2),
    "edge-b": Sensor("edge", "nominal-331", 106, 0.5),
    "edge-c": Sensor("edge", "nominal-127", 107, 1.8),
    "edge-d": Sensor("edge", "nominal-331", 108, 0.3, neutral_image=False),
    "edge-e": Sensor("edge", "nominal-127", 112, 0.6, poses=_ALL_ROUND),
}
"""Hidden sensors by name. Frictions span 0.3 to 1.8."""


def run(options: HiddenSensorsOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure, write the page, and return the results. What an earlier run has made is not made again.

    Raises:
        TactipError: If a sensor is unknown, or a folder holds something else.
        Interrupted: On Ctrl-C.
    """
    names = options.only or tuple(SENSORS)
    sensors = {name: lookup("sensor", name, SENSORS) for name in names}
    result = read_results(options.out / "hidden_sensors.json")
    result.setdefault("sensors", {})
    for name, sensor in sensors.items():
        seconds = result["sensors"].get(name, {}).get("seconds")  # a resumed measurement has no time of its own
        measured = _measured(sensor, options.runs / name, options, log)
        result["sensors"][name] = {"seconds": seconds} | measured
        result["sensors"] = {one: result["sensors"][one] for one in SENSORS if one in result["sensors"]}
        result["machine"] = machine()
        write_results("hidden_sensors", result, tables(result), options.out)
    return result


def _measured(sensor: Sensor, folder: Path, options: HiddenSensorsOptions, log: Callable[[str], None]) -> dict[str, Any]:
    """Return what the page says of a sensor: how its conventions were found, errors, and time without making its set."""
    faults = typical_rig_faults(np.random.default_rng((sensor.seed, 80)))
    what = HiddenSet(
        sensor.task,
        options.frames,
        sensor.seed,
        FRAME_PX[sensor.design],
        sensor.poses or (_EDGE if sensor.task == "edge" else None),
        faults,
        sensor.neutral_image,
    )
    design = hidden_design(sensor.design, sensor.seed, sensor.friction, sensor.pins)
    lab = make_lab(folder, design, what, worker_count(options.workers), log)
    start, resumed = time.perf_counter(), (folder / "transfer").exists()
    given = Layout(ColumnMap(task=sensor.task))
    recording = read_recording(lab, given.column_map)
    outcome = {
        "task": sensor.task,
        "pins": len(neutral_pins(design)[0]),
        "friction": sensor.friction,
        "gel_poisson": design.materials.gel_poisson,
        "neutral_image": sensor.neutral_image,
    }
    try:
        found = find_layout(recording, given, log=lambda line: None)
    except TactipError as error:
        return outcome | {"refused": str(error)}
    import_set(read_source(lab, found.layout.column_map), found.layout, folder / "set", log)
    experiment = Experiment(folder / "set", folder / "transfer", options.settings, options.workers, log=log)
    network = experiment.network()
    test = experiment.split.test
    truth = _with_truth(test, folder / "contacts", found)
    if not resumed:
        outcome["seconds"] = round(time.perf_counter() - start)
    estimates = network.estimate(test.images)
    return outcome | {
        "options": found.options(),
        "zero_shot": _figures(estimates.means, truth),
        "certain": _certain(estimates, truth),
        "labels": _figures(test.targets, truth),
        "coverage": {k: v for k, v in score(network, truth).items() if k.startswith("coverage")},
        "corrected": _figures(experiment.corrected(SHOTS).estimate(test.images).means, test),
    }


def _with_truth(samples: Samples, contacts: Path, found: FoundLayout) -> Samples:
    """Return samples with the true poses in place of the labels that the rig gave."""
    frames = [row["source_image"] for row in read_rows(samples.folder, samples.dataset.meta)]
    rows = np.array([int(name.removeprefix("frame_").removesuffix(".png")) for name in frames])
    poses, task = read_dataset(contacts).poses[rows[samples.rows]], found.layout.column_map.task
    if task == "edge":  # frames that are rotated by quarter turns
        poses = as_in_frames(poses, task, round(found.layout.preprocessing.rotate_image_deg / 90), False)
    chosen = [LABELS.index(name) for name in samples.labels.names]
    return replace(samples, targets=poses[:, chosen])


def _figures(values: np.ndarray, samples: Samples) -> dict[str, dict[str, float]]:
    """Return mean absolute errors of values (n, k or more) on samples, with and without their median, and that median, by
    component."""
    found = samples.labels.unwrapped(values[:, : samples.targets.shape[1]], samples.targets)
    errors = found - samples.targets
    offsets = np.median(errors, 0)
    columns = {"mae": np.abs(errors).mean(0), "mae_zeroed": np.abs(errors - offsets).mean(0), "offset": offsets}
    return {
        kind: {name: float(x) for name, x in zip(samples.labels.names, column, strict=True)}
        for kind, column in columns.items()
    }


def _certain(estimates: Estimates, samples: Samples) -> dict[str, float]:
    """Return mean absolute errors of estimates of samples, by component, without the least certain ones of each."""
    count = samples.targets.shape[1]
    assert estimates.deviations is not None  # noqa: S101
    errors = np.abs(samples.labels.unwrapped(estimates.means[:, :count], samples.targets) - samples.targets)
    kept = np.argsort(estimates.deviations[:, :count], 0)[: round(CERTAIN * len(samples))]
    return dict(zip(samples.labels.names, np.take_along_axis(errors, kept, 0).mean(0).tolist(), strict=True))


_EARLIER_GEL = 0.49
"""Poisson's ratio of the gel of sensors that an earlier state of this benchmark measured."""

_SHOWN = {
    "surface": {"pose_z": "depth, mm", "pose_Rx": "roll, °", "pose_Ry": "pitch, °"},
    "edge": {"pose_x": "beside, mm", "pose_z": "depth, mm", "pose_Rz": "yaw, °"},
}
"""Components on the page, and their heads, by task."""


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Return the tables of the page."""
    out = {}
    for task, shown in _SHOWN.items():
        head = ["sensor", "pins", "friction", "gel", "neutral image", "time, min", *shown.values()]
        head += [f"{what} after {SHOTS} frames" for what in shown.values()]
        rows, inside, certain = [], [], []
        for name, one in result["sensors"].items():
            if one["task"] != task:
                continue
            gel = one.get("gel_poisson", _EARLIER_GEL)
            what = [name, one["pins"], f"{one['friction']:g}", f"{gel:.2f}", "yes" if one["neutral_image"] else "no"]
            if "refused" in one:
                rows.append([*what, "refused", *[""] * (2 * len(shown))])
                continue
            cells = [f"{one['zero_shot']['mae'][c]:.2f} ({one['zero_shot']['mae_zeroed'][c]:.2f})" for c in shown]
            cells += [f"{one['corrected']['mae'][c]:.2f}" for c in shown]
            rows.append([*what, "" if one["seconds"] is None else f"{one['seconds'] / 60:.0f}", *cells])
            inside.append([name, *(100 * one["coverage"][f"coverage_{p}"][c] for c in shown for p in (68, 95))])
            if "certain" in one:  # results of an earlier state of this benchmark have none
                certain.append([name, *(f"{one['certain'][c]:.2f}" for c in shown)])
        target = ["target", *[""] * 5, *(f"{TARGETS[task][c]:g}" for c in shown), *[""] * len(shown)]
        out[task] = table(head, [*rows, target])
        covered = [f"{what.partition(',')[0]}, {p} %" for what in shown.values() for p in (68, 95)]
        if inside:
            inside.append(["mean", *np.mean([numbers for _, *numbers in inside], 0).tolist()])
        texts = [[name, *(f"{number:.0f}" for number in numbers)] for name, *numbers in inside]
        out[f"{task}-coverage"] = table(["sensor", *covered], texts)
        if task == "edge":  # light touches of edges are the uncertain ones
            out["certain"] = table(["sensor", *shown.values()], certain)
    return out | {"machine": machine_text(result["machine"])}
