"""The readings of tilts and shears on a surface: the columns that fit contacts estimated from the frames."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tactip_twin.sim2real.importing.estimated_contacts import EstimatedContacts
from tactip_twin.sim2real.importing.table_columns import (
    MIN_EVIDENCE,
    Columns,
    Known,
    assignments,
    centred,
    column_spec,
    correlation,
    explaining,
    nearest_unit,
    plainness,
)
from tactip_twin.tactip_model.errors import TactipError

_SAME_VECTORS = 0.3
"""Difference of two readings of a vector, in standard deviations of its columns, that does not matter."""

_ROTATION_STEPS = np.radians(np.arange(0.0, 360.0, 0.5))


@dataclass(frozen=True)
class _SurfaceReading:
    columns: dict[str, str]
    camera_deg: float
    evidence: list[str]


def on_surface(columns: Columns, free: list[str], contacts: EstimatedContacts, known: Known) -> _SurfaceReading:
    """Return the readings of tilts and shears, which one rotation of the camera must explain together."""
    tilt = centred(contacts.poses[:, 3] + 1j * contacts.poses[:, 4])
    shear = centred(contacts.shears[:, 0] + 1j * contacts.shears[:, 1])
    r = {one: [abs(correlation(columns.of(one), estimate)) for estimate in (tilt, shear)] for one in free}
    tilts, _ = explaining(columns, [one for one in free if r[one][0] >= r[one][1]], tilt, ("Rx", "Ry"))
    shears, _ = explaining(columns, [one for one in free if one not in tilts], shear, ("x", "y"))
    evidence = []
    if not tilts:
        evidence.append("no column explains the tilts of the frames")
    if not shears:
        evidence.append("no column explains the shear of the frames")
    if not tilts and not shears:
        return _SurfaceReading({}, 0.0, evidence)
    scored = []
    for a, b in itertools.product(assignments(tilts, ("Rx", "Ry"), known), assignments(shears, ("x", "y"), known)):
        curve = _log_likelihood(columns, a, tilt) + _log_likelihood(columns, b, shear)
        k = int(curve.argmax())
        scored.append((float(curve[k]), float(_ROTATION_STEPS[k]), a, b))
    most = max(score for score, *_ in scored)
    equal = [one for one in scored if one[0] > most - 1e-3]
    score, turn, a, b = max(equal, key=lambda one: plainness(one[1], one[2], one[3]))
    others = [one for one in scored if not _same_labels(columns, one, (score, turn, a, b))]
    margin = score - max((one[0] for one in others), default=-np.inf)
    if margin < MIN_EVIDENCE:
        other = max(others, key=lambda one: one[0])
        raise TactipError(
            f"the frames speak equally well for two readings of the table: {_words(columns, turn, a, b)}, and "
            f"{_words(columns, *other[1:])}: give the columns of one of them with --columns"
        )
    found = {}
    for prefix, parts, estimate in (("pose", a, tilt), ("shear", b, shear)):
        for component, (name, sign) in parts.items():
            unit_of = "angle" if component.startswith("R") else "pose"
            slope = abs((columns.of(name) * estimate).sum()) / (columns.of(name) ** 2).sum()
            factor, unit = nearest_unit(float(slope), unit_of)
            turns = component.startswith("R")
            spec = columns.angle_spec(sign * factor, name) if turns else column_spec(sign * factor, name, 0.0)
            found[f"{prefix}_{component}"] = spec
            r = abs(correlation(columns.of(name), estimate))
            evidence.append(f"{prefix}_{component}={spec}: correlation {r:.2f}{unit}")
    degrees = float((np.degrees(turn) + 180) % 360 - 180)
    evidence.append(
        f"camera-rotation-deg {degrees:.1f}, by tilts and shears together; "
        + (f"the next reading is {_times(float(margin))} less likely" if np.isfinite(margin) else "no other fits")
    )
    return _SurfaceReading(found, degrees, evidence)


def _times(margin: float) -> str:
    """Return by how much another reading is less likely, from the logarithm of that factor."""
    return "more than a million times" if margin > np.log(1e6) else f"{np.exp(margin):,.0f} times"


def _as_complex(columns: Columns, parts: Mapping[str, tuple[str, float]]) -> np.ndarray:
    """Return the vectors (n,) that a reading gives, each column over its standard deviation."""
    axis = {"Rx": 1.0, "Ry": 1j, "x": 1.0, "y": 1j}
    total = np.zeros(len(columns.values), complex)
    for component, (name, sign) in parts.items():
        total = total + sign * axis[component] * columns.of(name) / columns.of(name).std()
    return total


def _log_likelihood(columns: Columns, parts: Mapping[str, tuple[str, float]], estimate: np.ndarray) -> np.ndarray:
    """Return the logarithm of the likelihood of a reading at each of _ROTATION_STEPS; 0 if it has no columns."""
    if not parts:
        return np.zeros(len(_ROTATION_STEPS))
    reading = _as_complex(columns, parts)
    product, power = (estimate * reading.conj()).sum(), (abs(reading) ** 2).sum()
    along = np.maximum((np.exp(-1j * _ROTATION_STEPS) * product).real, 0.0)
    total = (abs(estimate) ** 2).sum()
    return -len(estimate) * np.log(np.maximum(total - along**2 / power, 1e-12 * total) / total)


_Scored = tuple[float, float, dict[str, tuple[str, float]], dict[str, tuple[str, float]]]


def _same_labels(columns: Columns, one: _Scored, other: _Scored) -> bool:
    """Return whether two readings give the same labels."""
    for mine, theirs in ((one[2], other[2]), (one[3], other[3])):
        apart = np.exp(1j * one[1]) * _as_complex(columns, mine) - np.exp(1j * other[1]) * _as_complex(columns, theirs)
        if np.abs(apart).max() > _SAME_VECTORS:
            return False
    return True


def _words(columns: Columns, turn: float, *readings: Mapping[str, tuple[str, float]]) -> str:
    parts = []
    for prefix, reading in zip(("pose", "shear"), readings, strict=True):
        parts += [f"{prefix}_{c}={'-' if sign < 0 else ''}{name}" for c, (name, sign) in reading.items()]
    return f"{' '.join(parts)} with the camera rotated by {(np.degrees(turn) + 180) % 360 - 180:.0f}°"
