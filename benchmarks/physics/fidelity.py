"""Error against run time of simulated contacts: `tactip bench fidelity`.

It measures the fidelity presets on named cases and on the first contacts of the training sets, `standard` with one number
changed at a time, the refined reference, and the raster renderer against pyrender. Errors are those of pins and force, and
the equivalent change of the label; costs are CPU times relative to `standard`, measured side by side. An interrupted
measurement resumes. Writes docs/fidelity.json, .md and .png.
"""

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from tqdm import tqdm

from tactip_twin.benchmarks.hardware import machine
from tactip_twin.benchmarks.physics.contact_cache import DESIGN, STANDARD, CachedContact, ContactCache, Variant
from tactip_twin.benchmarks.physics.contact_cases import CASES, CONVERGING, Case, training
from tactip_twin.benchmarks.physics.fidelity_page import plot, tables
from tactip_twin.benchmarks.physics.options import FidelityOptions
from tactip_twin.benchmarks.physics.parameter_sweeps import refined_meshes, refined_steps, small_steps, sweeps
from tactip_twin.benchmarks.physics.pose_sensitivity import ImagePins, PoseSensitivity, moved_about
from tactip_twin.benchmarks.report import write_results
from tactip_twin.sim.contact.fidelity import FIDELITIES, finer
from tactip_twin.sim.labels import TASKS, FidelityName
from tactip_twin.tactip_model.design import TactileImage
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pin_detection import find_blobs
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.pyrender_renderer import PinCamera
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

PRESETS: dict[FidelityName, Variant] = {name: Variant(fidelity) for name, fidelity in FIDELITIES.items()}
REFERENCE = PRESETS["reference"]

MIN_ORDER = 0.5
"""Minimum observed order of convergence for Richardson's estimate, -; below it, differences do not fall."""

NEAR_PX = 1.5
"""Maximum distance between a blob and its pin, px of the tactile image: a fifth of the pins' spacing."""


def jobs(options: FidelityOptions) -> list[tuple[Case, Variant]]:
    """Return all contacts that a measurement needs; those of one variant and stimulus are in a row."""
    trained = {task: training(task, options.contacts) for task in TASKS}
    swept = {task: training(task, options.sweep_contacts) for task in TASKS}
    all_cases = [*CASES, *(case for cases in trained.values() for case in cases)]
    wanted = []
    for variant in PRESETS.values():
        wanted += [(case, variant) for case in all_cases]
        wanted += [(case, Variant(small_steps(variant.fidelity))) for task in TASKS for case in trained[task]]
    wanted += [(other, STANDARD) for case in all_cases for other in moved_about(case)]
    refined = [*refined_meshes().values(), *refined_steps().values(), Variant(finer(REFERENCE.fidelity))]
    wanted += [(case, v) for v in refined for case in CASES if case.name in CONVERGING]
    for _, variants in sweeps().values():
        wanted += [(case, v) for v in variants.values() for task in TASKS for case in swept[task]]
    return list(dict.fromkeys(wanted))


def spread(tips: ArrayLike, expected: ArrayLike) -> list[float]:
    """Return the mean, the 95th percentile and the maximum of the pins' errors, mm.

    Args:
        tips: (n, p, 3) pin tips, m.
        expected: (n, p, 3), m.
    """
    distance = 1e3 * np.linalg.norm(np.asarray(tips) - np.asarray(expected), axis=-1)
    return [float(np.mean(distance)), float(np.quantile(distance, 0.95)), float(distance.max())]


class Measurement:
    """Errors and costs of cached contacts."""

    def __init__(self, options: FidelityOptions, cache: ContactCache) -> None:
        """Prepare a measurement."""
        self._options, self._cache = options, cache
        self._pins = ImagePins(design_named(DESIGN))
        self._sensitivities: dict[Case, PoseSensitivity] = {}

    def result(self) -> dict[str, Any]:
        """Return all results, for docs/fidelity.json."""
        o = self._options
        trained = {task: training(task, o.contacts) for task in TASKS}
        return {
            "design": DESIGN,
            "contacts_per_task": o.contacts,
            "sweep_contacts_per_task": o.sweep_contacts,
            "machine": machine(),
            "presets": [self._preset(task, name, cases) for task, cases in trained.items() for name in PRESETS],
            "cases": [self._case(case, name) for case in CASES for name in PRESETS],
            "reference": self._reference(),
            "sweeps": [row for task in TASKS for row in self._swept(task)],
            "renderers": [compare_renderers(self._standard(task), self._pins) for task in TASKS],
        }

    def row(self, cases: Sequence[Case], variant: Variant) -> dict[str, Any]:
        """Return the errors against the reference, and the costs, of a variant on cases."""
        contacts = [self._cache(case, variant) for case in cases]
        best = [self._cache(case, REFERENCE) for case in cases]
        force, expected = (np.array([p.force_n for p in ps]) for ps in (contacts, best))
        return {
            "pins_mm": spread([p.pin_tips for p in contacts], [p.pin_tips for p in best]),
            "force_percent": float(100 * np.abs(force - expected).sum() / np.abs(expected).sum()),
            "label": self._label(cases, contacts, best),
            "penetration_mm": 1e3 * max(p.penetration_m for p in contacts),
            "speed_mm_s": 1e3 * float(np.median([p.speed_m_s for p in contacts])),
            "untrusted": sum(p.violations > 0 for p in contacts),
            "steps": float(np.median([p.steps for p in contacts])),
            "degrees_of_freedom": contacts[0].freedom,
            "megabytes": max(p.model_bytes for p in contacts) / 1e6,
            "cost": float(np.median([p.seconds / p.standard_seconds for p in contacts])),
            "seconds": float(np.median([p.seconds for p in contacts])),
        }

    def _sensitivity(self, case: Case) -> PoseSensitivity:
        if case not in self._sensitivities:
            self._sensitivities[case] = PoseSensitivity.about(case, self._cache, self._pins)
        return self._sensitivities[case]

    def _label(
        self, cases: Sequence[Case], contacts: Sequence[CachedContact], best: Sequence[CachedContact]
    ) -> dict[str, float]:
        """Return the label errors equivalent to the pins' errors, over contacts that determine their pose."""
        worths = []
        for case, p, b in zip(cases, contacts, best, strict=True):
            sensitivity = self._sensitivity(case)
            if sensitivity.is_determined:
                worths.append(sensitivity(self._pins(p.pin_tips) - self._pins(b.pin_tips)))
        return median_by_component(worths)

    def _against_small_steps(self, cases: Sequence[Case], variant: Variant) -> list[float]:
        slow = Variant(small_steps(variant.fidelity))
        return spread(*([self._cache(case, v).pin_tips for case in cases] for v in (variant, slow)))

    def _preset(self, task: str, name: FidelityName, cases: Sequence[Case]) -> dict[str, Any]:
        variant = PRESETS[name]
        steps = self._against_small_steps(cases, variant)
        return {"task": task, "preset": name, "steps_mm": steps} | self.row(cases, variant)

    def _case(self, case: Case, name: FidelityName) -> dict[str, Any]:
        contact = self._cache(case, PRESETS[name])
        row = {"case": case.name, "pose_mm_deg": case.pose_mm_deg, "shear_mm_deg": case.shear_mm_deg, "preset": name}
        return row | {"force_n": contact.force_n} | self.row([case], PRESETS[name])

    def _swept(self, task: str) -> Iterator[dict[str, Any]]:
        """Yield the rows of all sweeps on one task."""
        cases = training(task, self._options.sweep_contacts)
        slow = [self._cache(case, Variant(small_steps(STANDARD.fidelity))).pin_tips for case in cases]
        for name, variant in PRESETS.items():
            yield {"task": task, "what": "preset", "value": name, "of_mesh": True} | self.row(cases, variant)
        for what, (of_mesh, variants) in sweeps().items():
            for value, variant in variants.items():
                row = {"task": task, "what": what, "value": value, "of_mesh": of_mesh} | self.row(cases, variant)
                if not of_mesh:
                    row["steps_mm"] = spread([self._cache(case, variant).pin_tips for case in cases], slow)
                yield row

    def _reference(self) -> dict[str, Any]:
        """Return how the reference itself converges over mesh and steps, by case."""
        cases = [case for case in CASES if case.name in CONVERGING]
        meshes, steps = refined_meshes(), refined_steps()
        rows = []
        for case in cases:
            over_mesh = sequence([self._cache(case, v) for v in meshes.values()], 2**0.5)
            over_steps = sequence([self._cache(case, v) for v in steps.values()], 2.0)
            half = self._cache(case, Variant(finer(REFERENCE.fidelity)))
            whole = self._cache(case, REFERENCE)
            halved = {
                "pins_mm": spread([half.pin_tips], [whole.pin_tips]),
                "force_percent": _percent(half.force_n, whole.force_n),
            }
            rows.append({"case": case.name, "mesh": over_mesh, "steps": over_steps, "half_the_steps": halved})
        return {"spacings_mm": list(meshes), "rows": rows}

    def _standard(self, task: str) -> list[tuple[Case, CachedContact, PoseSensitivity]]:
        """Return the contacts of a task at `standard`."""
        return [
            (case, self._cache(case, STANDARD), self._sensitivity(case)) for case in training(task, self._options.contacts)
        ]


def median_by_component(worths: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the median magnitude of each component of poses, and their number as `contacts`."""
    if not worths:
        return {"contacts": 0}
    return {c: float(np.median([abs(w[c]) for w in worths])) for c in worths[0]} | {"contacts": len(worths)}


def _percent(value: float, expected: float) -> float:
    return float(100 * abs(value - expected) / abs(expected))


def sequence(contacts: Sequence[CachedContact], ratio: float) -> dict[str, Any]:
    """Return how a sequence of contacts converges whose step shrinks by `ratio` each time.

    Returns:
        `differences_mm`, the mean distance of pins between each contact and the next; `forces_n`; `order`, by the last two
        differences; `remains_mm`, Richardson's estimate of the mean errors of the last but one and of the last, None if the
        order is below MIN_ORDER.
    """
    tips = [p.pin_tips for p in contacts]
    differences = [spread([a], [b])[0] for a, b in pairwise(tips)]
    out: dict[str, Any] = {"differences_mm": differences, "forces_n": [p.force_n for p in contacts]}
    order = float(np.log(differences[-2] / differences[-1]) / np.log(ratio))
    out |= {"order": order, "remains_mm": None}
    if order >= MIN_ORDER:
        last = differences[-1] / (ratio**order - 1)
        out["remains_mm"] = [last + differences[-1], last]
    return out


def compare_renderers(contacts: Sequence[tuple[Case, CachedContact, PoseSensitivity]], pins: ImagePins) -> dict[str, Any]:
    """Return the differences between raster and pyrender on the same pins."""
    design = design_named(DESIGN)
    renderers = {"raster": Raster(design), "pyrender": PinCamera(design)}
    times, grey, binary, shifts, worths = {name: [] for name in renderers}, [], [], [], []
    for renderer in renderers.values():  # the first image of each is slow: it builds what later ones reuse
        renderer.render(contacts[0][1].pin_tips, contacts[0][1].directions)
    for _, contact, sensitivity in contacts:
        frames, images = {}, {}
        for name, renderer in renderers.items():
            start = time.process_time()
            frames[name] = renderer.render(contact.pin_tips, contact.directions)
            times[name].append(1e3 * (time.process_time() - start))
            images[name] = tactile_image(frames[name], design.image)
        grey.append(np.abs(frames["raster"].astype(float) - frames["pyrender"]))
        binary.append((images["raster"] != images["pyrender"]).mean())
        expected = pins(contact.pin_tips)
        shift = np.subtract(*(blobs_at(frames[name], design.image, expected) for name in ("raster", "pyrender")))
        shifts.append(np.linalg.norm(shift, axis=1))
        if sensitivity.is_determined:
            worths.append(sensitivity(shift))
    return {
        "task": contacts[0][0].stimulus,
        "images": len(contacts),
        "grey_levels": [float(np.mean(grey)), float(np.quantile(grey, 0.999)), float(np.max(grey))],
        "binary_percent": [float(100 * np.mean(binary)), float(100 * np.max(binary))],
        "blobs_px": [float(np.nanmean(shifts)), float(np.nanmax(shifts))],
        "blobs_seen": float(np.isfinite(shifts).mean()),
        "label": median_by_component(worths),
        "milliseconds": {name: float(np.median(t)) for name, t in times.items()},
    }


def blobs_at(frame: np.ndarray, settings: TactileImage, expected: np.ndarray) -> np.ndarray:
    """Return the centres (p, 2), px of the tactile image, of the pins' blobs in a frame; NaN where none is near its pin.

    Blobs are detected in the binary image at the frame's own size, because neighbours at the rim merge at the tactile
    image's size.

    Args:
        frame: (h, w) uint8 grey.
        settings: Of the tactile image.
        expected: (p, 2), px of the tactile image.
    """
    width = frame.shape[1]
    centres = find_blobs(tactile_image(frame, replace(settings, size_px=width))).centres
    centres = (centres + 0.5) * settings.size_px / width - 0.5
    if not len(centres):
        return np.full(np.shape(expected), np.nan)
    distance = np.linalg.norm(centres[:, None] - expected, axis=-1)
    nearest = distance.argmin(0)
    near = distance[nearest, np.arange(len(expected))] < NEAR_PX
    return np.where(near[:, None], centres[nearest], np.nan)


def run(options: FidelityOptions) -> dict[str, Any]:
    """Measure, write fidelity.json, .md and .png, and return the results.

    After Ctrl-C the contacts simulated so far are kept. Raises TactipError and OSError.
    """
    if not 1 <= options.sweep_contacts <= options.contacts:
        allowed = f"between 1 and --contacts, {options.contacts}"
        raise TactipError(f"--sweep-contacts must be {allowed}, got {options.sweep_contacts}")
    wanted = jobs(options)
    with tqdm(total=len(wanted), unit="contact", file=sys.stderr, smoothing=0.05) as bar:
        cache = ContactCache(options.cache, bar.set_postfix_str)
        for case, variant in wanted:
            cache(case, variant)
            bar.update()
    result = Measurement(options, cache).result()
    write_results("fidelity", result, tables(result), options.out)
    plot(result, options.out / "fidelity.png")
    cache.forget()
    return result
