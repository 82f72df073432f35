"""What an image tells of pose, shear and force, and how well networks know it: `tactip bench uncertainty`.

Evaluates the shipped networks on test contacts, light ones among them, by band of normal force, beside what pins at
known positions would tell. Writes uncertainty.md, uncertainty.json and uncertainty.png.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning.learning_sets import DESIGN, jobs
from tactip_twin.benchmarks.learning.options import LearningOptions, UncertaintyOptions
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.learning.data import Samples, read_samples
from tactip_twin.learning.evaluate import Evaluation, evaluate
from tactip_twin.learning.image_check import ImageCheck, image_check
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.model import Model, load_network
from tactip_twin.learning.pin_projection import PinProjection
from tactip_twin.learning.pose_from_pins import Misfit, PinModel, most_likely
from tactip_twin.learning.quantities import QUANTITIES
from tactip_twin.learning.uncertainty import FORCE_BANDS_N, band_text, uncertainty
from tactip_twin.sim.dataset.format import read_pins
from tactip_twin.sim.dataset.generate import make
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.fast_tip.fast_tip import PinDecoder, read_fast_tip, shipped_fast_tip
from tactip_twin.sim.labels import COMPONENTS, TASKS, Task
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.sim.view.plot import COLORS, figure_of, log_axis, save_figure
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.pin_detection import find_blobs
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named, load_design
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

SIZES_PX = (128, 256)
"""Widths of images in which pins are detected."""

_MAX_PIN_ERROR_MM = 0.5
"""Distance, mm in plan view, beyond which a detected blob is not the nearest pin."""

_TIP_ERROR_MM: dict[Task, float] = {"surface": 0.02, "edge": 0.04}
"""Standard deviation of each coordinate of a pin by what the learned tip has wrong, mm (docs/fast_tip.md) [M]."""

_ODD_IMAGES = 200
"""Number of images of each kind that no network has seen."""


def run(options: UncertaintyOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Evaluate the networks, write page and figure, and return the results. Raises TactipError."""
    measured = read_results(options.out / "uncertainty.json").get("tasks", {})
    for task in options.only or TASKS:
        sets = jobs(
            LearningOptions(
                task=task,
                data=options.data,
                test_contacts=options.test_contacts,
                other_test_contacts=options.light_test_contacts,
            ),
            (),
        )
        needed = [job for job in sets if job.folder.parts[-3] in ("plain", "light")]
        make(needed, worker_count(options.workers), log)
        usual, light = (read_samples(job.folder) for job in needed)
        log(f"{task}: {len(usual)} test contacts, {len(light)} with light ones")
        measured[task] = _task(load_network(f"{task}-{DESIGN}"), usual, light)
    result = {"tasks": {task: measured[task] for task in TASKS if task in measured}, "machine": machine()}
    write_results("uncertainty", result, tables(result), options.out)
    plot(result, options.out / "uncertainty.png")
    return result


def _task(model: Model, usual: Samples, light: Samples) -> dict[str, Any]:
    """Return the results of a task: the figures of its test sets, estimates from pins by force, and odd images."""
    evaluated = {name: evaluate(model, samples) for name, samples in (("usual", usual), ("light", light))}
    out: dict[str, Any] = {name: evaluation.figures for name, evaluation in evaluated.items()}
    out["pins"] = {str(size): pin_noise(usual, size) for size in SIZES_PX}
    out["from_pins"] = from_pins_by_force(usual, {size: pins["noise_mm"] for size, pins in out["pins"].items()})
    out["odd_images"] = _odd_images(model, usual, evaluated["usual"])
    return out


def from_pins_by_force(samples: Samples, noises_mm: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return mean absolute errors of estimates from pins instead of images, by component and band of normal force, as JSON.

    bound: the Cramér-Rao bound for pins whose coordinates in plan view are known with a noise; the shear is unknown within
    its range, as the labels are within theirs. likelihood: poses of maximum likelihood through the learned tip, from
    simulated pins with that noise, found from the true pose on. What the learned tip has wrong adds to the noise. searched:
    the same, found without knowing the pose. predicted: the same, from pins that the learned tip predicts, so it has nothing
    wrong.

    Args:
        samples: Test contacts.
        noises_mm: Noise of a coordinate, mm, by width of the image, px.
    """
    labels, task = samples.labels, _task_of(samples.labels)
    tip = read_fast_tip(shipped_fast_tip(task, DESIGN))
    model = PinModel(tip, PinDecoder(load_design(DESIGN), tip.modes), POSE_RANGES[task], SHEAR_RANGES)
    truth = np.concatenate([samples.dataset.poses, samples.shears], 1)
    rows = [COMPONENTS.index(c) for c in labels.components]
    jacobians = model.jacobians(truth[:, model.free])
    tips, _ = read_pins(samples.folder, samples.dataset.meta)
    pins = 1e3 * tips[samples.rows][..., :2].astype(float)
    predicted = model.positions(truth[:, model.free]).reshape(pins.shape)
    columns = {}
    for size, noise in noises_mm.items():
        bound = np.zeros(truth.shape)
        information = model.information(jacobians, noise)
        bound[:, model.free] = np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2))
        noisy = pins + np.random.default_rng(0).normal(0, noise, pins.shape)
        found = most_likely(model, noisy, truth, float(np.hypot(noise, _TIP_ERROR_MM[task])))
        columns[f"bound_{size}"] = np.sqrt(2 / np.pi) * bound[:, rows]
        columns[f"likelihood_{size}"] = np.abs(found.poses - samples.dataset.poses)[:, rows]
        poses = searched_poses(model, noisy, float(np.hypot(noise, _TIP_ERROR_MM[task])))
        columns[f"searched_{size}"] = np.abs(poses - samples.dataset.poses)[:, rows]
        poses = searched_poses(model, noisy - pins + predicted, noise)
        columns[f"predicted_{size}"] = np.abs(poses - samples.dataset.poses)[:, rows]
    forces, out = samples.dataset.measures["normal_force_N"][samples.rows], []
    for low, high in pairwise(FORCE_BANDS_N):
        chosen = (forces >= low) & (forces < high)
        if chosen.any():
            means = {key: values[chosen].mean(0) for key, values in columns.items()}
            out.append(
                {"from_N": low} | {key: dict(zip(labels.names, map(float, x), strict=True)) for key, x in means.items()}
            )
    return out


def searched_poses(model: PinModel, pins: np.ndarray, noise: float) -> np.ndarray:
    """Return the most likely poses (n, 6), mm and degrees, of pins (n, p, 2), mm, whose coordinates have some noise: the
    best of searches that start from random contacts in several ranges of the first component."""
    rng, misfit = np.random.default_rng(0), Misfit(model, pins, noise)
    first = int(np.flatnonzero(model.free)[0])
    best, costs = np.zeros((len(pins), 6)), np.full(len(pins), np.inf)
    for ends in pairwise(np.linspace(model.low[0], model.high[0], _SEARCHES + 1)):
        start = model.nearest_of(pins, _RANDOM_CONTACTS, rng, {first: (float(ends[0]), float(ends[1]))})
        found = most_likely(model, pins, start, noise)
        values = np.concatenate([found.poses, found.shears], 1)[:, model.free]
        cost = misfit.cost(values, model.positions(values))
        better = cost < costs
        best[better], costs[better] = found.poses[better], cost[better]
    return best


_SEARCHES, _RANDOM_CONTACTS = 6, 4000
"""Number of searches, and of random contacts of which the nearest is the start of one [?]."""


def pin_noise(samples: Samples, size_px: int) -> dict[str, float]:
    """Return how well the pins of the first samples are found in images of a width, as JSON.

    noise_mm: standard deviation of a coordinate of a detected pin, mm in plan view; found_fraction: detected pins over all,
    -; pins that touch in the image are detected as one.
    """
    design = load_design(DESIGN)
    design = replace(design, image=replace(design.image, size_px=size_px))
    raster, neutral = Raster(design), neutral_pins(design)
    tips, directions = (part[samples.rows][:_ODD_IMAGES] for part in read_pins(samples.folder, samples.dataset.meta))
    projection = PinProjection(design)
    centres = projection.discs(tips, directions, size_px)[0].numpy()
    of_neutral = projection.discs(neutral[0][None], neutral[1][None], size_px)[0].numpy()
    mm_per_px = 1e3 * np.ptp(neutral[0][:, :2], axis=0).mean() / np.ptp(of_neutral[0], axis=0).mean()
    errors, found = [], 0
    for k in range(len(tips)):
        image = tactile_image(raster.render(tips[k].astype(float), directions[k].astype(float)), design.image)
        blobs = find_blobs(image).centres
        distances, nearest = cKDTree(centres[k]).query(blobs)
        near = distances * mm_per_px < _MAX_PIN_ERROR_MM
        errors.append((blobs - centres[k][nearest])[near])
        found += int(near.sum())
    return {
        "noise_mm": float(np.concatenate(errors).std() * mm_per_px),
        "found_fraction": found / (len(tips) * tips.shape[1]),
    }


def _task_of(labels: Labels) -> Task:
    return "edge" if labels.task == "edge" else "surface"


def _odd_images(model: Model, samples: Samples, evaluation: Evaluation) -> list[dict[str, Any]]:
    """Return how many images of each kind are flagged, by the check of images and by their deviations, as JSON.

    The deviations flag an image if they are larger than for 99 % of the usual ones.
    """
    check = image_check(model)
    images = samples.images[:_ODD_IMAGES]
    kinds = {"as learned": images, **_altered(samples, load_design(DESIGN))}
    limit = None
    if evaluation.deviations is not None:
        limit = float(np.quantile(uncertainty(evaluation.deviations, model.labels.scale), 0.99))
    return [{"images": name, **_flagged(model, check, some, limit)} for name, some in kinds.items()]


def _flagged(model: Model, check: ImageCheck | None, images: np.ndarray, limit: float | None) -> dict[str, float]:
    """Return the fractions of images (n, size, size) that are flagged by check, by deviations, and by either, as JSON."""
    by_check = np.array([bool(check.problem(image)) if check else False for image in images])
    deviations = model.estimate(images).deviations
    by_deviation = np.zeros(len(images), bool)
    if deviations is not None and limit is not None:
        k = len(model.labels.names)
        by_deviation = uncertainty(deviations[:, :k], model.labels.scale) > limit
    both = {"check": by_check, "deviation": by_deviation, "either": by_check | by_deviation}
    return {name: float(flags.mean()) for name, flags in both.items()}


def _altered(samples: Samples, design: Design) -> dict[str, np.ndarray]:
    """Return images that no network has seen, by kind: another layout of pins, a covered lens, missing pins."""
    tips, directions = (part[samples.rows][:_ODD_IMAGES] for part in read_pins(samples.folder, samples.dataset.meta))
    rng, size = np.random.default_rng(0), design.image.size_px
    images = samples.images[:_ODD_IMAGES]
    covered = images.copy()
    covered[:, :, : size // 2] = 0
    # A missing pin is drawn on top of one that is there.
    pins = tips.shape[1]
    half = []
    for _ in tips:
        order = rng.permutation(pins)
        kept = np.arange(pins)
        kept[order[: pins // 2]] = order[-1]
        half.append(kept)
    raster = Raster(design)

    def rendered(of: Design, some: np.ndarray, their: np.ndarray, by: Raster) -> np.ndarray:
        """Return the image (size, size) of pins (p, 3), (p, 3) under the optics of a design."""
        return tactile_image(by.render(some.astype(float), their.astype(float)), of.image)

    missing = [rendered(design, t[k], d[k], raster) for t, d, k in zip(tips, directions, half, strict=True)]
    other = replace(design_named("tactip-331"), image=replace(design_named("tactip-331").image, size_px=size))
    moves = tips - neutral_pins(design)[0]
    their_tips, their_directions = neutral_pins(other)
    nearest = np.linalg.norm(their_tips[:, None, :2] - neutral_pins(design)[0][None, :, :2], axis=2).argmin(1)
    other_raster = Raster(other)
    pressed = [rendered(other, their_tips + move[nearest], their_directions, other_raster) for move in moves]
    return {
        "331 pins": np.stack(pressed),
        "half of the lens covered": covered,
        "half of the pins missing": np.stack(missing),
        "mirrored": np.ascontiguousarray(images[:, :, ::-1]),
    }


_FROM_PINS = {
    "bound": "bound above 0.5 N",
    "likelihood": "maximum likelihood, from the true pose on",
    "searched": "searched",
    "predicted": "searched, pins that the learned tip predicts",
}
"""Kinds of estimates from pins (from_pins_by_force), and their titles."""


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Return the tables of docs/uncertainty.md from uncertainty.json."""
    out = {}
    for task, values in result["tasks"].items():
        names, figures = list(values["usual"]["mae"]), values["usual"]
        head = ["normal force, N", "contacts", *names]
        rows = []
        for row, pins in zip(figures["by_force"], values["from_pins"], strict=True):
            cells = [" / ".join(f"{of[n]:.3f}" for of in (row["mae"], pins["bound_128"], pins["bound_256"])) for n in names]
            rows.append([band_text(row), row["samples"], *cells])
        rows.append(["all", figures["samples"], *(f"{figures['mae'][n]:.3f}" for n in names)])
        out[f"{task}-errors"] = table(head, rows)
        covered = [
            [
                band_text(row),
                row["samples"],
                *(
                    f"{row['mae'][n]:.2f} ({100 * row['coverage_68'][n]:.0f} %, {100 * row['coverage_95'][n]:.0f} %)"
                    for n in names
                ),
            ]
            for row in values["light"]["by_force"]
        ]
        out[f"{task}-coverage"] = table(["normal force, N", "contacts", *names], covered)
        left = [[f"{row['left_out']:.0%}", *(f"{row['mae'][n]:.3f}" for n in names)] for row in figures["rejection"]]
        out[f"{task}-rejection"] = table(["left out", *names], left)
    tasks = list(result["tasks"])
    seen = [
        [
            task,
            size,
            f"{pins['noise_mm']:.3f}",
            f"{100 * pins['found_fraction']:.0f} %",
            *(_range(result["tasks"][task], f"{kind}_{size}") for kind in _FROM_PINS),
        ]
        for task in tasks
        for size, pins in result["tasks"][task]["pins"].items()
    ]
    head = ["task", "image, px", "noise of a pin, mm", "pins found", *_FROM_PINS.values()]
    out["pins"] = table(head, seen)
    units = {q.name: q.unit for q in QUANTITIES}
    quantities = [
        [f"{name}, {unit}" if unit else name, *(f"{result['tasks'][t]['usual']['quantities'][name]:.3f}" for t in tasks)]
        for name, unit in units.items()
    ]
    for key, text in (("missed_fraction", "contacts missed"), ("false_fraction", "images without contact taken for one")):
        cells = []
        for task in tasks:
            contact = result["tasks"][task]["light"]["contact"]
            count = contact["samples_in_contact" if key == "missed_fraction" else "samples_without"]
            cells.append(f"{100 * contact[key]:.1f} % of {count}" if count else "–")
        quantities.append([text, *cells])
    out["quantities"] = table(["quantity", *tasks], quantities)
    odd = [
        [task, row["images"], *(f"{100 * row[key]:.0f} %" for key in ("check", "deviation", "either"))]
        for task in tasks
        for row in result["tasks"][task]["odd_images"]
    ]
    note = f"\n\nMachine: {machine_text(result['machine'])}."
    out["odd"] = table(["task", "images", "flagged by the check", "by deviations", "by either"], odd) + note
    return out


def _range(values: Mapping[str, Any], key: str) -> str:
    """Return the mean errors of the components above 0.5 N, in their order, as text. values: results of a task."""
    weights = {row["from_N"]: row["samples"] for row in values["usual"]["by_force"] if row["from_N"] >= _FIRM_N}
    rows = [row for row in values["from_pins"] if row["from_N"] in weights]
    names = list(values["usual"]["mae"])
    means = [np.average([row[key][n] for row in rows], weights=[weights[row["from_N"]] for row in rows]) for n in names]
    return ", ".join(f"{mean:.3f}" for mean in means)


_FIRM_N = 0.5
"""Normal force, N, from which on a contact is firm [?]."""


def plot(result: Mapping[str, Any], path: Path) -> None:
    """Plot error over normal force, with what the network expects and the bound, one panel per task, into a PNG file."""
    figure, axes = figure_of(1, len(result["tasks"]), (6.2 * len(result["tasks"]), 4.6))
    for axis, (task, values) in zip(axes, result["tasks"].items(), strict=True):
        bands = values["usual"]["by_force"]
        at = range(len(bands))
        for name, color in zip(values["usual"]["mae"], COLORS, strict=False):
            unit = "°" if "_R" in name else "mm"
            axis.plot(at, [row["mae"][name] for row in bands], "o-", color=color, ms=4, label=f"{name}, {unit}")
            expected = [np.sqrt(2 / np.pi) * row["deviation"][name] for row in bands]
            axis.plot(at, expected, "--", color=color, lw=0.9)
            axis.plot(at, [row["bound_128"][name] for row in values["from_pins"]], ":", color=color, lw=1.4)
        axis.set_xticks(list(at))
        axis.set_xticklabels([f"{r['from_N']:g}–{r['to_N']:g}" if r["to_N"] else f"> {r['from_N']:g}" for r in bands])
        log_axis(axis, "y")
        axis.set(xlabel="normal force, N", ylabel="mean absolute error, mm or °", title=task)
        axis.legend(fontsize=8, title="dashed: expected; dotted: bound, 128 px", title_fontsize=8)
    save_figure(figure, path)
