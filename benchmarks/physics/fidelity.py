"""Error against run time of simulated contacts: `tactip bench fidelity`.

The fidelity presets on named cases and on the first contacts of the training sets; `standard` with one number changed at a
time; the reference itself refined; and the raster against pyrender. Errors are of pins, of force, and of the label that
they are worth; costs are CPU time relative to `standard`, played side by side. Stopped, it goes on where it was. Writes
docs/fidelity.json, .md and .png.
"""

import json
import sys
import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
from tqdm import tqdm

from tactip_twin.benchmarks.hardware import machine
from tactip_twin.benchmarks.physics.contact_cache import DESIGN, STANDARD, Plays, Variant
from tactip_twin.benchmarks.physics.contact_cases import CASES, CONVERGING, training
from tactip_twin.benchmarks.physics.fidelity_page import draw, page
from tactip_twin.benchmarks.physics.parameter_sweeps import refined_meshes, refined_steps, small_steps, sweeps
from tactip_twin.benchmarks.physics.pose_sensitivity import ImagePins, PoseSensitivity, moved_about
from tactip_twin.sim.contact.fidelity import FIDELITIES, finer
from tactip_twin.sim.labels import TASKS
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.pin_detection import find_blobs
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.pyrender_renderer import PinCamera
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

PRESETS = {name: Variant(fidelity) for name, fidelity in FIDELITIES.items()}
REFERENCE = PRESETS["reference"]

SMALLEST_ORDER = 0.5
"""Least observed order of convergence, -, for Richardson's estimate to be given: below it, differences do not fall."""

NEAR_PX = 1.5
"""Distance, px of the tactile image, at which a blob is the pin that is expected there: a fifth of the pins' spacing."""


def jobs(options):
    """All contacts that a measurement needs: list of (Case, Variant), those of one Variant and stimulus in a row."""
    trained = {task: training(task, options.contacts) for task in TASKS}
    swept = {task: training(task, options.swept) for task in TASKS}
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


def spread(tips, expected):
    """Distances of tips (n, p, 3), m, to the expected: mean, 95th percentile and greatest, mm."""
    distance = 1e3 * np.linalg.norm(np.asarray(tips) - np.asarray(expected), axis=-1)
    return [float(np.mean(distance)), float(np.quantile(distance, 0.95)), float(distance.max())]


class Measurement:
    """Errors and costs, from contacts that are played or found."""

    def __init__(self, options, plays):
        """options: FidelityOptions. plays: called with a Case and a Variant for a Played
        (tactip_twin.benchmarks.physics.contact_cache)."""
        self._options, self._plays = options, plays
        self._pins = ImagePins(design_named(DESIGN))
        self._worths = {}

    def result(self):
        """All figures: a dict for docs/fidelity.json."""
        o = self._options
        trained = {task: training(task, o.contacts) for task in TASKS}
        return {
            "design": DESIGN,
            "contacts_a_task": o.contacts,
            "swept_contacts_a_task": o.swept,
            "machine": machine(),
            "presets": [self._preset(task, name, cases) for task, cases in trained.items() for name in PRESETS],
            "cases": [self._case(case, name) for case in CASES for name in PRESETS],
            "reference": self._reference(),
            "sweeps": [row for task in TASKS for row in self._swept(task)],
            "drawing": [drawing(self._standard(task), self._pins) for task in TASKS],
        }

    def row(self, cases, variant):
        """Errors against the reference, and costs, of a Variant on Cases: a dict."""
        played = [self._plays(case, variant) for case in cases]
        best = [self._plays(case, REFERENCE) for case in cases]
        force, expected = (np.array([p.force_n for p in ps]) for ps in (played, best))
        return {
            "pins_mm": spread([p.tips for p in played], [p.tips for p in best]),
            "force_percent": float(100 * np.abs(force - expected).sum() / np.abs(expected).sum()),
            "label": self._label(cases, played, best),
            "penetration_mm": 1e3 * max(p.penetration_m for p in played),
            "speed_mm_s": 1e3 * float(np.median([p.speed_m_s for p in played])),
            "untrusted": sum(p.faults > 0 for p in played),
            "steps": float(np.median([p.steps for p in played])),
            "degrees_of_freedom": played[0].freedom,
            "megabytes": max(p.model_bytes for p in played) / 1e6,
            "cost": float(np.median([p.seconds / p.standard_seconds for p in played])),
            "seconds": float(np.median([p.seconds for p in played])),
        }

    def _worth(self, case):
        if case not in self._worths:
            self._worths[case] = PoseSensitivity.about(case, self._plays, self._pins)
        return self._worths[case]

    def _label(self, cases, played, best):
        """What differences of pins are worth (dict, see median_by_component), of the contacts that tell their pose."""
        worths = []
        for case, p, b in zip(cases, played, best, strict=True):
            estimator = self._worth(case)
            if estimator.tells:
                worths.append(estimator(self._pins(p.tips) - self._pins(b.tips)))
        return median_by_component(worths)

    def _against_small_steps(self, cases, variant):
        slow = Variant(small_steps(variant.fidelity))
        return spread(*([self._plays(case, v).tips for case in cases] for v in (variant, slow)))

    def _preset(self, task, name, cases):
        variant = PRESETS[name]
        steps = self._against_small_steps(cases, variant)
        return {"task": task, "preset": name, "steps_mm": steps} | self.row(cases, variant)

    def _case(self, case, name):
        played = self._plays(case, PRESETS[name])
        row = {"case": case.name, "pose_mm_deg": case.pose_mm_deg, "shear_mm_deg": case.shear_mm_deg, "preset": name}
        return row | {"force_n": played.force_n} | self.row([case], PRESETS[name])

    def _swept(self, task):
        """Rows of all sweeps on one task."""
        cases = training(task, self._options.swept)
        slow = [self._plays(case, Variant(small_steps(STANDARD.fidelity))).tips for case in cases]
        for name, variant in PRESETS.items():
            yield {"task": task, "what": "preset", "value": name, "of_mesh": True} | self.row(cases, variant)
        for what, (of_mesh, variants) in sweeps().items():
            for value, variant in variants.items():
                row = {"task": task, "what": what, "value": value, "of_mesh": of_mesh} | self.row(cases, variant)
                if not of_mesh:
                    row["steps_mm"] = spread([self._plays(case, variant).tips for case in cases], slow)
                yield row

    def _reference(self):
        """How the reference itself converges: rows by case, over mesh and steps."""
        cases = [case for case in CASES if case.name in CONVERGING]
        meshes, steps = refined_meshes(), refined_steps()
        rows = []
        for case in cases:
            over_mesh = sequence([self._plays(case, v) for v in meshes.values()], 2**0.5)
            over_steps = sequence([self._plays(case, v) for v in steps.values()], 2.0)
            half = self._plays(case, Variant(finer(REFERENCE.fidelity)))
            whole = self._plays(case, REFERENCE)
            halved = {"pins_mm": spread([half.tips], [whole.tips]), "force_percent": _percent(half.force_n, whole.force_n)}
            rows.append({"case": case.name, "mesh": over_mesh, "steps": over_steps, "half_the_steps": halved})
        return {"spacings_mm": list(meshes), "shares_of_steps": list(steps), "rows": rows}

    def _standard(self, task):
        """Cases of a task with their Played at `standard` and their PoseSensitivity."""
        return [(case, self._plays(case, STANDARD), self._worth(case)) for case in training(task, self._options.contacts)]


def median_by_component(worths):
    """Median size of each component of a list of poses (dict), and how many they are ("contacts"): a dict."""
    if not worths:
        return {"contacts": 0}
    return {c: float(np.median([abs(w[c]) for w in worths])) for c in worths[0]} | {"contacts": len(worths)}


def _percent(value, expected):
    return float(100 * abs(value - expected) / abs(expected))


def sequence(played, ratio):
    """How a sequence of Played converges whose step shrinks by `ratio` each time: a dict.

    `differences_mm`: mean distance of pins between each and the next. `order`: by the last two differences. `remains_mm`:
    Richardson's estimate of the last but one's mean error, and the last's; None where the order is below SMALLEST_ORDER.
    """
    tips = [p.tips for p in played]
    differences = [spread([a], [b])[0] for a, b in pairwise(tips)]
    out = {"differences_mm": differences, "forces_n": [p.force_n for p in played]}
    order = float(np.log(differences[-2] / differences[-1]) / np.log(ratio))
    out |= {"order": order, "remains_mm": None}
    if order >= SMALLEST_ORDER:
        last = differences[-1] / (ratio**order - 1)
        out["remains_mm"] = [last + differences[-1], last]
    return out


def drawing(contacts, pins):
    """Raster against pyrender on the same pins: a dict. contacts: list of (Case, Played, PoseSensitivity). pins:
    ImagePins."""
    design = design_named(DESIGN)
    painters = {"raster": Raster(design), "pyrender": PinCamera(design)}
    times, grey, binary, shifts, worths = {name: [] for name in painters}, [], [], [], []
    for painter in painters.values():  # the first image of each pays for what later ones find ready
        painter.render(contacts[0][1].tips, contacts[0][1].directions)
    for _, played, worth in contacts:
        frames, images = {}, {}
        for name, painter in painters.items():
            start = time.process_time()
            frames[name] = painter.render(played.tips, played.directions)
            times[name].append(1e3 * (time.process_time() - start))
            images[name] = tactile_image(frames[name], design.image)
        grey.append(np.abs(frames["raster"].astype(float) - frames["pyrender"]))
        binary.append((images["raster"] != images["pyrender"]).mean())
        places = pins(played.tips)
        shift = np.subtract(*(seen_at(frames[name], design.image, places) for name in ("raster", "pyrender")))
        shifts.append(np.linalg.norm(shift, axis=1))
        if worth.tells:
            worths.append(worth(shift))
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


def seen_at(frame, settings, places):
    """Centres (p, 2) of the pins' blobs in a frame, px of its tactile image; NaN where none is near where it should be.

    frame: (h, w) uint8 grey. settings: design.TactileImage. places: (p, 2) px of the tactile image. Blobs are looked for in
    the binary image at the frame's own size: at the tactile image's, neighbours at the rim grow together.
    """
    width = frame.shape[1]
    centres = find_blobs(tactile_image(frame, replace(settings, size_px=width))).centres
    centres = (centres + 0.5) * settings.size_px / width - 0.5
    if not len(centres):
        return np.full(np.shape(places), np.nan)
    distance = np.linalg.norm(centres[:, None] - places, axis=-1)
    nearest = distance.argmin(0)
    near = distance[nearest, np.arange(len(places))] < NEAR_PX
    return np.where(near[:, None], centres[nearest], np.nan)


def run(options):
    """Measure, and write fidelity.json, .md and .png. options: FidelityOptions. Returns the result (dict).

    Raises TactipError and OSError. Stopped by Ctrl-C, the contacts played so far are kept.
    """
    known = options.out / "fidelity.json"
    if options.redraw:
        if not known.exists():
            raise TactipError(f"there is no {known} to draw from: measure first")
        result = json.loads(known.read_text())
    else:
        if not 1 <= options.swept <= options.contacts:
            raise TactipError(f"{options.swept} contacts to sweep on: at least 1, at most the {options.contacts} of presets")
        wanted = jobs(options)
        with tqdm(total=len(wanted), unit="contact", file=sys.stderr, smoothing=0.05) as bar:
            plays = Plays(options.kept, bar.set_postfix_str)
            for case, variant in wanted:
                plays(case, variant)
                bar.update()
        result = Measurement(options, plays).result()
        options.out.mkdir(parents=True, exist_ok=True)
        write_file(known, (json.dumps(result, indent=1) + "\n").encode())
    draw(result, options.out / "fidelity.png")
    write_file(options.out / "fidelity.md", page(result).encode())
    if not options.redraw:
        plays.forget()
    return result
