"""The linear part of a network's errors on a real set, and what it says about the rig, the tip and the next step.

A rig's zero of depth and its tilt show as offsets, a tip of other mechanics or optics as a gain, and a skin that sticks
longer or shorter than the simulated one as a leak of shear into the pose. Frames that are taken before the shear is finished
show as a leak of the same component: their labels are ahead of the tip. The remaining error is noise of frames, labels and
network.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from tactip_twin.learning.data import Samples
from tactip_twin.sim.labels import SHEARS

_MIN_SPREAD = {"mm": 0.1, "°": 0.5}
"""Minimum standard deviation of a label or shear that is fitted, by unit: noise of a rig is less [?]."""

_MIN_FRAMES_PER_TERM = 5
"""Minimum number of frames per term of the fit [?]."""

_GAIN = 0.1
"""Difference of a gain from 1 that is worth a remark, - [?]."""

_LEAK = {"mm": 0.02, "°": 0.2}
"""Leak of a shear of 1 mm or 1 degree that is worth a remark, by unit of the component: with the paper's 5 mm, 0.1 mm and 1
degree [?]."""

_AHEAD = 0.1
"""Part of a shear by which labels are ahead of the tip that is worth a remark, - [?]."""

_BESIDE_MM = 0.3
"""Distance of a tool centre from the axis that is worth a remark, mm: 0.1 mm of depth at a tilt of 20 degrees [?]."""

_OFFSET = {"mm": 0.1, "°": 0.5}
"""Offset that is worth a remark, by unit [?]."""


def linear_errors(predictions: np.ndarray, samples: Samples) -> dict[str, Any] | None:
    """Return the linear part of predictions (n, k), mm and degrees; None where a set has too few frames for a fit.

    Each component is fitted by least squares as offset + gain · label + the other labels and shears that vary, times a
    coefficient each.

    Returns:
        For each component that varies: offset at the middle of the labels, gain, change by another component, leak by the
        name of the shear, and the mean error without the linear part.
    """
    names = samples.labels.names
    varying = [k for k, name in enumerate(names) if samples.targets[:, k].std() > _MIN_SPREAD[unit_of(name)]]
    # A motion along the normal is a press, not a shear: only what it leaves the skin at counts, which is the depth.
    tangential = [k for k, name in enumerate(SHEARS) if name != "shear_z"]
    sheared = [k for k in tangential if samples.shears[:, k].std() > _MIN_SPREAD[unit_of(SHEARS[k])]]
    terms = np.concatenate([samples.targets[:, varying], samples.shears[:, sheared]], 1)
    if len(terms) < _MIN_FRAMES_PER_TERM * (1 + terms.shape[1]):
        return None
    middle = terms.mean(0)
    columns = np.column_stack([np.ones(len(terms)), terms - middle])
    found, *_ = np.linalg.lstsq(columns, predictions[:, varying], rcond=None)
    rest = np.abs(predictions[:, varying] - columns @ found).mean(0)
    out = {}
    for i, k in enumerate(varying):
        leaks = found[1 + len(varying) :, i]
        out[names[k]] = {
            "offset": float(found[0, i] - middle[i]),
            "gain": float(found[1 + i, i]),
            "cross": {names[j]: float(found[1 + m, i]) for m, j in enumerate(varying) if m != i},
            "leak": {SHEARS[j]: float(leak) for j, leak in zip(sheared, leaks, strict=True)},
            "rest": float(rest[i]),
        }
    return out


def table_of(linear: Mapping[str, Any]) -> str:
    """Return the linear part of the errors as a Markdown table."""
    lines = ["| component | offset | gain | largest leak of shear | error without these |", "|---|---|---|---|---|"]
    for name, part in linear.items():
        unit = unit_of(name)
        cells = [f"{part['offset']:+.2f} {unit}", f"{part['gain']:.2f}", _leak(name, part), f"{part['rest']:.2f} {unit}"]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def advice(linear: Mapping[str, Any]) -> list[str]:
    """Return what the linear part of the errors says, a sentence or two per remark; the first is worth most."""
    out = []
    low = [name for name, part in linear.items() if part["gain"] < 1 - _GAIN]
    high = [name for name, part in linear.items() if part["gain"] > 1 + _GAIN]
    for found, word in ((low, "small"), (high, "large")):
        if found:
            gains = ", ".join(f"{name} at {linear[name]['gain']:.0%}" for name in found)
            out.append(
                f"Read too {word}: {gains} of the labels. The real tip moves its pins differently from the simulated one: "
                "fit its mechanics with `tactip calibrate`, or correct by 10 labelled frames (`tactip transfer few-shot`)."
            )
    ahead = {name: -part["leak"].get(name.replace("pose", "shear"), 0.0) for name, part in linear.items()}
    ahead = {name: fraction for name, fraction in ahead.items() if fraction > _AHEAD}
    if ahead:
        parts = ", ".join(f"{name} by {fraction:.0%} of {name.replace('pose', 'shear')}" for name, fraction in ahead.items())
        out.append(
            f"Labels seem to be ahead of the tip: {parts}. If frames were taken before the motion was finished, this is an "
            "error of the labels, not of the network: wait until the robot stands still."
        )
    linear = {name: _without_own_leak(name, part) if name in ahead else part for name, part in linear.items()}
    leaks = [name for name, part in linear.items() if _largest(part) > _LEAK[unit_of(name)]]
    if leaks:
        worst = ", ".join(f"{name} by {_leak(name, linear[name])}" for name in leaks)
        out.append(
            f"Shear leaks into the pose: {worst}. Friction or the thickness of the skin differ: calibrate, or correct by "
            "labelled frames."
        )
    # Depth in a tilt about x or y changes by the distance times the sine of the tilt.
    cross = linear.get("pose_z", {}).get("cross", {})
    beside_mm = np.degrees([cross.get(name, 0.0) for name in ("pose_Rx", "pose_Ry")])
    if np.abs(beside_mm).max() > _BESIDE_MM:
        out.append(
            f"Depth changes with tilt, as about a tool centre {np.hypot(*beside_mm):.1f} mm beside the axis: import again "
            "with `--find`, or with `--tcp-beside-axis-mm`."
        )
    offsets = {name: part["offset"] for name, part in linear.items() if abs(part["offset"]) > _OFFSET[unit_of(name)]}
    if "pose_z" in offsets:
        out.append(
            f"Depth is off by {offsets.pop('pose_z'):+.2f} mm in the middle of its range: the rig's zero of depth is not at "
            "the surface, or the camera's image has grown. Measure where the tip first touches."
        )
    if offsets:
        values = ", ".join(f"{name} {value:+.2f} {unit_of(name)}" for name, value in offsets.items())
        out.append(
            f"Constant offsets: {values}. The stimulus or the sensor is mounted so: measure it, or add it to --columns."
        )
    return out or [
        "No offset, gain or leak of shear stands out: the remaining error is noise of frames, labels and network."
    ]


def unit_of(name: str) -> str:
    """Return the unit of a component of a pose or shear."""
    return "°" if "_R" in name else "mm"


def _without_own_leak(name: str, part: Mapping[str, Any]) -> dict[str, Any]:
    """Return the linear part of a component without the leak of the shear of the same component."""
    own = name.replace("pose", "shear")
    return {**part, "leak": {shear: leak for shear, leak in part["leak"].items() if shear != own}}


def _largest(part: Mapping[str, Any]) -> float:
    """Return the magnitude of the largest leak; 0 if nothing was sheared."""
    return max((abs(leak) for leak in part["leak"].values()), default=0.0)


def _leak(name: str, part: Mapping[str, Any]) -> str:
    """Return the largest leak as text."""
    if not part["leak"]:
        return "no shear"
    shear, leak = max(part["leak"].items(), key=lambda item: abs(item[1]))
    return f"{leak:+.2f} {unit_of(name)} per {unit_of(shear)} of {shear}"
