"""The conventions of a laboratory's table, found by holding it against contacts estimated from the frames.

A column means depth, tilt, yaw, offset or shear if it varies with what the pins say. Its sign, the rotation of the camera,
the point about which the rig rotates and the zero of depth follow. What the frames do not tell is said; where they speak
equally well for two readings that give different labels, both are named and none is taken.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tactip_twin.sim2real.importing.column_map import Angles, ColumnMap, parse_column
from tactip_twin.sim2real.importing.convert_labels import convert_labels
from tactip_twin.sim2real.importing.estimated_contacts import EstimatedContacts, chosen_of
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import read_json

_MIN_CORRELATION = 0.35
"""Correlation with an estimate above which a column explains it; by chance, 120 frames give 0.09 rms."""

_SAME_COLUMN = 0.99
"""Correlation of two columns above which they say the same: a table that is sorted by a tilt numbers its rows by it too."""

_MIN_EVIDENCE = 6.0
"""Logarithm of the likelihood ratio above which one reading of the frames is preferred to another [?]."""

_UNITS = {"pose": {1.0: "", 1000.0: "m"}, "angle": {1.0: "", 57.29578: "rad"}}
"""Factors to mm and degrees, and the units that they are from."""

_MIN_GAIN, _MAX_GAIN = 0.1, 10.0
"""Estimates are within these factors of what they estimate, or the unit is another one."""

_MAX_ZERO_MM = 1.7
"""Distance of the estimated from the table's zero of depth within which the table is believed, mm: a rig's zero has an
offset of some tenths, and an estimate with other mechanics one of 1 mm in the two sets that this was tried on [M]."""

_SAME_DEG = 0.5
"""Mean difference of labels, degrees, that does not matter."""

_MAX_UNEXPLAINED = 0.6
"""Largest part of the circular variance of the yaw that a column may leave [?]."""

_SAME_VECTORS = 0.3
"""Difference of two readings of a vector, in standard deviations of its columns, that does not matter."""

_MAX_UNCLEAR_DEG = 2.0
"""Mean difference of the labels of two readings that fit equally well, degrees, above which none is taken [?]."""

_INDEPENDENT, _YAW_SPREAD_RAD, _OUTLIERS = 10.0, 0.2, 0.05
"""Choice among the optima of an edge's yaw: number of independent measurements in a frame, standard deviation of a right
yaw, and fraction of frames in which no optimum is right [?]."""

_CLEAR_YAW_DEG = 8.0
"""Standard deviation of an edge's yaw below which a frame shows it [?]."""

_ROTATION_STEPS = np.radians(np.arange(0.0, 360.0, 0.5))

_Known = Mapping[str, tuple[float, str | None, float]]

_SUFFIXES = {"1": "x", "2": "y", "3": "z", "4": "Rx", "5": "Ry", "6": "Rz"}


@dataclass(frozen=True)
class Conventions:
    """What was found."""

    column_map: ColumnMap
    """Conventions of the table."""
    rotate_image_deg: float
    """Rotation of the frames to add, degrees: they are rotated by quarter turns until an edge is upright."""
    evidence: tuple[str, ...]
    """A sentence for each choice, and for what was not found."""


@dataclass(frozen=True)
class _Columns:
    """Numeric columns of the table that vary. (n frames, k columns)"""

    names: tuple[str, ...]
    values: np.ndarray
    """(n, k)."""

    def of(self, name: str) -> np.ndarray:
        """Return a column (n,), its mean subtracted."""
        values = self.values[:, self.names.index(name)]
        return values - values.mean()

    def likeliest(self, name: str, free: Sequence[str], components: Sequence[str]) -> tuple[str, list[str]]:
        """Return the column in `free` that is most likely meant, among those that say the same as column `name`, and these:
        by its name, or because it does not count rows."""
        same = [one for one in free if abs(np.corrcoef(self.of(one), self.of(name))[0, 1]) > _SAME_COLUMN]

        def rank(one: str) -> tuple[bool, bool, bool]:
            whole = bool((self.values[:, self.names.index(one)] % 1 == 0).all())
            return not any(_sounds_like(one, component) for component in components), whole, one != name

        return min(same, key=rank), same


def find_conventions(
    table: Mapping[str, Sequence[str]], contacts: EstimatedContacts, given: ColumnMap, tap_mm: float | None = None
) -> Conventions:
    """Return the conventions of a table.

    Args:
        table: Cells of each column.
        contacts: Contacts that were estimated from some of its rows.
        given: What is known: its task, and columns, which are kept and checked.
        tap_mm: Depth of the tap that makes contact, if the set's meta.json has one.

    Raises:
        TactipError: If no column explains the depth (for an edge, also the offset and the yaw), a given column contradicts
            the frames, or two readings explain them equally well.
    """
    columns = _numeric(table, contacts.rows)
    known = dict(parse_column(spec) for spec in given.columns)
    if contacts.optima:
        contacts = _resolved(columns, contacts)
    found, evidence, free = _depth(columns, contacts, tap_mm)
    if "pose_z" in known:
        _check_sign("pose_z", known["pose_z"], found["pose_z"])
    reading = (_on_surface if given.task == "surface" else _on_edge)(columns, free, contacts, known)
    found |= reading.columns
    evidence += reading.evidence
    found |= _by_name(columns, found)
    if "pose_x" in known and "pose_x" in found:
        _check_sign("pose_x", known["pose_x"], found["pose_x"])
    specs = [*given.columns, *(f"{ours}={text}" for ours, text in found.items() if ours not in known)]
    column_map = replace(given, columns=tuple(specs), camera_rotation_deg=round(reading.camera_deg, 1))
    if isinstance(reading, _EdgeReading):
        column_map, turned = _in_order(column_map, reading.angles), 90.0 * reading.quarter_turns
    else:
        turned = 0.0
    column_map, told = _angles_and_lever(table, contacts, column_map)
    return Conventions(column_map, turned, (*evidence, *told))


def tap_of(folder: Path) -> float | None:
    """Return the length, mm, of the tap in a set's meta.json (tap_move); None if there is none."""
    path = folder / "meta.json"
    content = read_json(path, f"the file {path}") if path.is_file() else None
    tap = content.get("tap_move") if isinstance(content, dict) else None
    if not isinstance(tap, list) or len(tap) < 3 or not all(isinstance(x, (int, float)) for x in tap[:3]):
        return None
    length = float(np.linalg.norm(tap[:3]))
    return length if 0 < length < 100 else None


def _numeric(table: Mapping[str, Sequence[str]], rows: np.ndarray) -> _Columns:
    names, values = [], []
    for name, cells in table.items():
        try:
            column = np.array([float(cells[int(i)]) for i in rows])
        except (ValueError, TypeError):
            continue
        if np.isfinite(column).all() and len(np.unique(column)) > 2:
            names.append(name)
            values.append(column)
    if not names:
        raise TactipError(f"the table has no column of numbers that vary: its columns are {', '.join(table)}")
    return _Columns(tuple(names), np.stack(values, -1))


def _resolved(columns: _Columns, contacts: EstimatedContacts) -> EstimatedContacts:
    """Return contacts on an edge whose yaw is chosen among several optima: in each frame, the likelier of those that agree
    with the column, sign and offset that explain the yaws of all frames best. A frame alone may fit a wrong one better."""
    yaws = np.radians([one.poses[:, 5] for one in contacts.optima])
    misfits = np.square([one.residuals_px for one in contacts.optima])
    weights = np.exp(-0.5 * _INDEPENDENT * (misfits / misfits.min(0) - 1))
    weights /= weights.sum(0)
    offsets = np.radians(np.arange(0.0, 360.0, 5.0))
    best, which = -np.inf, np.zeros(len(contacts.rows), int)
    for values in columns.values.T:
        for sign, factor in itertools.product((1.0, -1.0), _UNITS["angle"]):
            expected = sign * np.radians(factor * values) + offsets[:, None]
            agreement = weights * np.exp(-((1 - np.cos(yaws - expected[:, None])) / _YAW_SPREAD_RAD**2))
            scores = np.log(_OUTLIERS + agreement.sum(1)).sum(1)
            k = int(scores.argmax())
            if scores[k] > best:
                best, which = float(scores[k]), agreement[k].argmax(0)
    return chosen_of(contacts.optima, which)


def _depth(
    columns: _Columns, contacts: EstimatedContacts, tap_mm: float | None
) -> tuple[dict[str, str], list[str], list[str]]:
    """Return the reading of the depth, its evidence, and the columns that are left."""
    depth, free = contacts.poses[:, 2], list(columns.names)
    r = {name: float(np.corrcoef(columns.of(name), depth)[0, 1]) for name in free}
    best = max(r, key=lambda name: abs(r[name])) if r else ""
    if not r or abs(r[best]) < _MIN_CORRELATION:
        raise TactipError(
            f"no column explains the depth that the frames show (the nearest is {best or 'none'}, correlation "
            f"{r.get(best, 0):.2f}): give --columns pose_z=…"
        )
    best, same = columns.likeliest(best, free, ("z",))
    raw = columns.values[:, columns.names.index(best)]
    # Deep contacts are read too shallow where the mechanics differ, so the zero is where the line meets no depth.
    slope = float((columns.of(best) * (depth - depth.mean())).sum() / (columns.of(best) ** 2).sum())
    slope /= min(r[best] ** 2, 1.0) or 1.0
    factor, unit = _unit(abs(slope), "pose")
    sign = float(np.sign(slope))
    gain = abs(slope) / factor
    zero = float(np.mean(depth) / gain - np.mean(sign * factor * raw))
    candidates = [0.0] if tap_mm is None else [0.0, -tap_mm, tap_mm]
    nearest = min(candidates, key=lambda offset: abs(offset - zero))
    offset = nearest if abs(nearest - zero) < _MAX_ZERO_MM else round(zero, 1)
    text = _spec(sign * factor, best, offset)
    why = f"pose_z={text}: the depth of the frames follows {best} (correlation {r[best]:+.2f}{unit})"
    if offset == nearest and offset:
        why += f"; its zero is a tap of {tap_mm:g} mm away (measured: {zero:+.1f} mm)"
    elif offset == nearest:
        why += f"; its zero is the surface (measured: {zero:+.1f} mm away)"
    else:
        why += f"; its zero is {zero:+.1f} mm from where frames show no contact"
    return {"pose_z": text}, [why], [name for name in free if name not in same]


@dataclass(frozen=True)
class _SurfaceReading:
    columns: dict[str, str]
    camera_deg: float
    evidence: list[str]


def _on_surface(columns: _Columns, free: list[str], contacts: EstimatedContacts, known: _Known) -> _SurfaceReading:
    """Return the readings of tilts and shears, which one rotation of the camera must explain together."""
    tilt = _centred(contacts.poses[:, 3] + 1j * contacts.poses[:, 4])
    shear = _centred(contacts.shears[:, 0] + 1j * contacts.shears[:, 1])
    r = {one: [abs(_correlation(columns.of(one), estimate)) for estimate in (tilt, shear)] for one in free}
    tilts, _ = _explaining(columns, [one for one in free if r[one][0] >= r[one][1]], tilt, ("Rx", "Ry"))
    shears, _ = _explaining(columns, [one for one in free if one not in tilts], shear, ("x", "y"))
    evidence = []
    if not tilts:
        evidence.append("no column explains the tilts of the frames, so none is taken")
    if not shears:
        evidence.append("no column explains the shear of the frames, so none is taken")
    if not tilts and not shears:
        return _SurfaceReading({}, 0.0, evidence)
    scored = []
    for a, b in itertools.product(_assignments(tilts, ("Rx", "Ry"), known), _assignments(shears, ("x", "y"), known)):
        curve = _log_likelihood(columns, a, tilt) + _log_likelihood(columns, b, shear)
        k = int(curve.argmax())
        scored.append((float(curve[k]), float(_ROTATION_STEPS[k]), a, b))
    most = max(score for score, *_ in scored)
    equal = [one for one in scored if one[0] > most - 1e-3]
    score, turn, a, b = max(equal, key=lambda one: _plainness(one[1], one[2], one[3]))
    others = [one for one in scored if not _same_labels(columns, one, (score, turn, a, b))]
    margin = score - max((one[0] for one in others), default=-np.inf)
    if margin < _MIN_EVIDENCE:
        other = max(others, key=lambda one: one[0])
        raise TactipError(
            f"the frames speak equally well for two readings of the table: {_words(columns, turn, a, b)}, and "
            f"{_words(columns, *other[1:])}: give one of them with --columns and --camera-rotation-deg, without --find"
        )
    found = {}
    for prefix, parts, estimate in (("pose", a, tilt), ("shear", b, shear)):
        for component, (name, sign) in parts.items():
            unit_of = "angle" if component.startswith("R") else "pose"
            slope = abs((columns.of(name) * estimate).sum()) / (columns.of(name) ** 2).sum()
            factor, unit = _unit(float(slope), unit_of)
            found[f"{prefix}_{component}"] = _spec(sign * factor, name, 0.0)
            r = abs(_correlation(columns.of(name), estimate))
            evidence.append(f"{prefix}_{component}={_spec(sign * factor, name, 0.0)}: correlation {r:.2f}{unit}")
    degrees = float((np.degrees(turn) + 180) % 360 - 180)
    evidence.append(
        f"camera-rotation-deg {degrees:.1f}, by tilts and shears together; "
        + (
            f"the next reading is {np.exp(min(margin, 700)):.0e} times less likely"
            if np.isfinite(margin)
            else "no other fits"
        )
    )
    return _SurfaceReading(found, degrees, evidence)


@dataclass(frozen=True)
class _EdgeReading:
    columns: dict[str, str]
    angles: Angles
    camera_deg: float
    quarter_turns: int
    evidence: list[str]


def _on_edge(columns: _Columns, free: list[str], contacts: EstimatedContacts, known: _Known) -> _EdgeReading:
    """Return the readings of yaw, tilts, offset and shears on an edge."""
    # Far from the edge, a frame does not show its direction.
    deviations = contacts.pose_deviations[:, 5]
    clear = deviations <= max(_CLEAR_YAW_DEG, float(np.sort(deviations)[min(len(deviations), 30) - 1]))
    estimated = Rotation.from_rotvec(contacts.poses[clear, 3:], degrees=True)
    sheared = _centred(contacts.shears[:, 0] + 1j * contacts.shears[:, 1])
    found, angles, offset_deg, evidence, left = _edge_rotations(columns, free, estimated, clear, sheared, known)
    quarter_turns = round(offset_deg / 90)
    wanted = {"pose_x": contacts.poses[:, 0]}
    wanted |= {"shear_x": contacts.shears[:, 0], "shear_y": contacts.shears[:, 1], "shear_Rz": contacts.shears[:, 5]}
    for ours, estimate in wanted.items():
        r = {one: float(np.corrcoef(columns.of(one), estimate)[0, 1]) for one in left}
        best = max(r, key=lambda one: abs(r[one]), default="")
        if not r or abs(r[best]) < _MIN_CORRELATION:
            if ours == "pose_x":
                raise TactipError(
                    "no column explains the distance to the edge that the frames show (the nearest is "
                    f"{best or 'none'}, correlation {r.get(best, 0):.2f}): give --columns pose_x=…"
                )
            continue
        best, same = columns.likeliest(best, left, (ours.partition("_")[2],))
        slope = float((columns.of(best) * _centred(estimate)).sum() / (columns.of(best) ** 2).sum())
        factor, unit = _unit(abs(slope), "angle" if "_R" in ours else "pose")
        found[ours] = _spec(float(np.sign(slope)) * factor, best, 0.0)
        evidence.append(f"{ours}={found[ours]}: correlation {r[best]:+.2f}{unit}")
        left = [one for one in left if one not in same]
    return _EdgeReading(found, angles, -(offset_deg - 90 * quarter_turns), quarter_turns, evidence)


def _edge_rotations(
    columns: _Columns, free: list[str], estimated: Rotation, clear: np.ndarray, sheared: np.ndarray, known: _Known
) -> tuple[dict[str, str], Angles, float, list[str], list[str]]:
    """Return the readings of the rotations on an edge, their convention, the yaw at which the camera is mounted, degrees,
    the evidence, and the columns that are left.

    Args:
        columns: The columns.
        free: Those that may be taken.
        estimated: Estimated rotations of the frames that show the yaw.
        clear: (n,) bool, which frames these are.
        sheared: (n,) complex, estimated shears, without their mean.
        known: Columns that are given.
    """
    yaw = np.radians(estimated.as_rotvec(degrees=True)[:, 2])
    values = {name: columns.values[clear, columns.names.index(name)] for name in free}
    scores = {
        (name, sign, factor): np.exp(1j * (yaw - sign * np.radians(factor * values[name]))).mean()
        for name in free
        for sign, factor in itertools.product((1.0, -1.0), _UNITS["angle"])
    }
    best = max(scores, key=lambda key: abs(scores[key]), default=None)
    alone = abs(np.exp(1j * yaw).mean())
    if best is None or 1 - abs(scores[best]) > _MAX_UNEXPLAINED * (1 - alone):
        raise TactipError("no column explains the yaw of the edge that the frames show: give --columns pose_Rz=…")
    name, same = columns.likeliest(best[0], free, ("Rz",))
    sign, factor = best[1:]
    agreement = scores[name, sign, factor]
    left = [one for one in free if one not in same]
    tilts, left = _tilts_on_edge(columns, left, estimated, clear, sheared)
    turn, scored = factor * values[name] * sign, []
    for reading in _assignments(tilts, ("Rx", "Ry"), known):
        about = {"x": np.zeros(len(turn)), "y": np.zeros(len(turn)), "z": turn}
        about |= {component[1]: s * factor * values[one] for component, (one, s) in reading.items()}
        for angles in get_args(Angles) if tilts else ("vector",):
            score, offset, labels = _rotation_fit(about, angles, estimated, float(np.degrees(np.angle(agreement))))
            scored.append((score, angles, reading, offset, labels))
    most = max(one[0] for one in scored)
    near = [one for one in scored if one[0] > most - _MIN_EVIDENCE]
    _, angles, reading, offset, labels = max(near, key=lambda one: (_plainness(0.0, one[2])[:2], one[1] == "vector", one[0]))
    apart = [float(np.degrees((labels.inv() * one[4]).magnitude()).mean()) for one in near]
    k = int(np.argmax(apart))
    if apart[k] > _MAX_UNCLEAR_DEG:
        raise TactipError(
            f"the frames speak equally well for two readings of the table: {_rotation_words(reading, angles)}, and "
            f"{_rotation_words(near[k][2], near[k][1])}: give one of them with --columns and --angles, without --find"
        )
    parts = reading | {"Rz": (name, sign)}
    found = {f"pose_{component}": _spec(s * factor, one, 0.0) for component, (one, s) in parts.items()}
    evidence = [
        f"{_rotation_words(parts, angles)}: agreement of the yaw {abs(agreement):.2f} (1 is perfect), with a camera rotated "
        f"by {-offset:.0f}°; other readings that fit give the same labels within {apart[k]:.1f}°"
    ]
    if not tilts:
        evidence.append("no column explains the tilts of the frames, so none is taken")
    return found, angles, offset, evidence, left


def _tilts_on_edge(
    columns: _Columns, free: list[str], estimated: Rotation, clear: np.ndarray, sheared: np.ndarray
) -> tuple[list[str], list[str]]:
    """Return the columns that explain the tilts, and those that are left. A tilt before the yaw turns with the sensor, one
    after it does not: both are tried. A column that explains the shear better is none, because shear shows as tilt too."""
    shown = _Columns(columns.names, columns.values[clear])
    normals = [turn.apply([0.0, 0.0, 1.0]) for turn in (estimated, estimated.inv())]
    tilted = [_centred(normal[:, 0] + 1j * normal[:, 1]) for normal in normals]
    shears = [
        one
        for one in free
        if abs(_correlation(columns.of(one), sheared)) > max(abs(_correlation(shown.of(one), t)) for t in tilted)
    ]
    options = [_explaining(shown, [one for one in free if one not in shears], tilt, ("Rx", "Ry")) for tilt in tilted]
    tilts, left = max(options, key=lambda option: len(option[0]))
    return tilts, [*left, *shears]


def _rotation_fit(
    about: Mapping[str, np.ndarray], angles: Angles, estimated: Rotation, offset_deg: float
) -> tuple[float, float, Rotation]:
    """Return how well rotations explain the estimated ones (logarithm of the likelihood), the yaw of the camera, degrees,
    that fits them best, and the rotations."""
    if angles == "vector":
        commanded = Rotation.from_rotvec(np.stack([about[axis] for axis in "xyz"], -1), degrees=True)
    else:
        commanded = Rotation.from_euler(angles, np.stack([about[axis] for axis in angles.lower()], -1), degrees=True)

    def errors(offset: float) -> tuple[Rotation, np.ndarray]:
        there = commanded * Rotation.from_euler("z", offset, degrees=True)
        return there, (there.inv() * estimated).as_rotvec(degrees=True)

    for _ in range(2):
        offset_deg += float(np.median(errors(offset_deg)[1][:, 2]))
    labels, wrong = errors(offset_deg)
    spread = 1.48 * np.median(np.abs(wrong), 0) + 1e-9
    score = -float((2 * np.log1p((wrong / spread) ** 2 / 3)).sum() + len(wrong) * np.log(spread).sum())
    return score, offset_deg, labels


def _rotation_words(parts: Mapping[str, tuple[str, float]], angles: Angles) -> str:
    columns = " ".join(f"pose_{c}={'-' if sign < 0 else ''}{name}" for c, (name, sign) in parts.items())
    return f"{columns} (angles {angles}, by axis)"


def _angles_and_lever(
    table: Mapping[str, Sequence[str]], contacts: EstimatedContacts, column_map: ColumnMap
) -> tuple[ColumnMap, list[str]]:
    """Return a ColumnMap with the convention of angles and the tool centre that fit best, and the evidence."""
    rows: dict[str, Sequence[str]] = {name: [cells[int(i)] for i in contacts.rows] for name, cells in table.items()}
    evidence = []
    mapped = {ours for ours, (_, column, _) in map(parse_column, column_map.columns) if column is not None}
    if column_map.task == "surface" and len(mapped & {"pose_Rx", "pose_Ry"}) > 1:
        column_map, told = _angles(rows, contacts, column_map)
        evidence.append(told)
    if mapped & {"pose_Rx", "pose_Ry"} and column_map.tcp_behind_apex_mm == 0:
        column_map, told = _lever(rows, contacts, column_map)
        evidence.append(told)
    return column_map, evidence


def _angles(rows: Mapping[str, Sequence[str]], contacts: EstimatedContacts, column_map: ColumnMap) -> tuple[ColumnMap, str]:
    parts = [3, 4]
    maps = {angles: _in_order(column_map, angles) for angles in get_args(Angles)}
    labels = {angles: convert_labels(one, rows)[0][:, parts] for angles, one in maps.items()}
    score = {angles: _fit(label, contacts.poses[:, parts]) for angles, label in labels.items()}
    best = max(score, key=lambda angles: score[angles])
    if score[best] - score["vector"] < _MIN_EVIDENCE:
        best = "vector"
    apart = {angles: float(np.abs(label - labels[best]).mean(0).max()) for angles, label in labels.items()}
    unclear = [one for one in labels if score[best] - score[one] < _MIN_EVIDENCE and apart[one] > _SAME_DEG]
    if unclear:
        worst = max(apart[one] for one in unclear)
        told = (
            f"the frames do not exclude {', '.join(unclear)}, with labels up to {worst:.1f}° away: give --angles if you know"
        )
    else:
        told = f"others that fit as well give the same labels within {_SAME_DEG:g}°"
    return maps[best], f"angles {best}; {told}"


def _in_order(column_map: ColumnMap, angles: Angles) -> ColumnMap:
    """Return a ColumnMap, whose rotations are about x, y and z, with another convention: Euler angles are listed in the
    order of its letters."""
    if angles == "vector":
        return replace(column_map, angles=angles)
    place = {letter: "xyz"[k] for k, letter in enumerate(angles.lower())}
    specs = []
    for spec in column_map.columns:
        ours, _, theirs = spec.partition("=")
        prefix, turns, letter = ours.partition("_R")
        specs.append(f"{prefix}_R{place[letter]}={theirs}" if turns else spec)
    return replace(column_map, columns=tuple(specs), angles=angles)


def _lever(rows: Mapping[str, Sequence[str]], contacts: EstimatedContacts, column_map: ColumnMap) -> tuple[ColumnMap, str]:
    """Return a ColumnMap with the distance of the tool centre from the apex that explains how depth changes with tilt."""
    labels = convert_labels(column_map, rows)[0]
    lift = 1 - np.cos(np.radians(np.linalg.norm(labels[:, 3:5], axis=1)))
    depth = contacts.poses[:, 2]
    design = np.stack([labels[:, 2], lift, np.ones_like(lift)], -1)
    start, *_ = np.linalg.lstsq(design, depth, rcond=None)
    spread = 1.48 * float(np.median(np.abs(depth - design @ start))) + 1e-9
    fit = least_squares(lambda p: (depth - design @ p) / spread, start, loss="soft_l1")
    gain, slope, _ = (float(value) for value in fit.x)
    lever, deviation = slope / gain, float(np.sqrt(np.linalg.inv(fit.jac.T @ fit.jac)[1, 1])) / abs(gain)
    if abs(lever) < max(2.5 * deviation, 3.0):
        return column_map, f"tcp-behind-apex-mm 0: depth does not show another ({lever:+.0f} ± {deviation:.0f} mm)"
    rounded = round(float(np.clip(lever, -100, 100)), 1)
    return replace(column_map, tcp_behind_apex_mm=rounded), (
        f"tcp-behind-apex-mm {rounded:g} (± {deviation:.0f}): depth differs from the table in tilted frames as a rotation "
        "about that point makes it"
    )


def _fit(labels: np.ndarray, estimates: np.ndarray) -> float:
    """Return the logarithm of the likelihood of estimates (n, k) as a multiple of labels (n, k), plus a constant each."""
    total = 0.0
    for label, estimate in zip(labels.T, estimates.T, strict=True):
        x, y = _centred(label), _centred(estimate)
        if not x.any():
            continue
        wrong = np.abs(y - x * (x * y).sum() / (x * x).sum())
        spread = 1.48 * np.median(wrong) + 1e-9
        # Student's t with 3 degrees of freedom: some frames lag behind their row.
        total -= float(2 * np.log1p((wrong / spread) ** 2 / 3).sum() + len(x) * np.log(spread))
    return total


def _explaining(
    columns: _Columns, free: Sequence[str], estimate: np.ndarray, components: tuple[str, str]
) -> tuple[list[str], list[str]]:
    """Return up to two columns that explain a complex estimate (n,), in directions that are about square to each other, and
    the columns that say something else."""
    chosen: list[str] = []
    left, others = estimate, list(free)
    for _ in range(2):
        r = {name: _correlation(columns.of(name), left) for name in others}
        if chosen:
            first = np.angle(_correlation(columns.of(chosen[0]), estimate))
            r = {name: value for name, value in r.items() if abs(np.cos(np.angle(value) - first)) < 0.5}
        best = max(r, key=lambda name: abs(r[name]), default=None)
        if best is None or abs(r[best]) < _MIN_CORRELATION:
            break
        best, same = columns.likeliest(best, others, components)
        chosen.append(best)
        others = [name for name in others if name not in same]
        x = columns.of(best)
        left = left - x * (x * left).sum() / (x * x).sum()
    return chosen, others


def _assignments(names: Sequence[str], components: tuple[str, str], known: _Known) -> list[dict[str, tuple[str, float]]]:
    """Return all ways to read columns as two components that agree with what is given: {component: (column, sign)}.

    Raises:
        TactipError: If none agrees.
    """
    prefix = "pose" if components[0].startswith("R") else "shear"
    given = {
        c: (known[f"{prefix}_{c}"][1], np.sign(known[f"{prefix}_{c}"][0])) for c in components if f"{prefix}_{c}" in known
    }
    out: list[dict[str, tuple[str, float]]] = []
    for order in itertools.permutations(components, len(names)):
        for signs in itertools.product((1.0, -1.0), repeat=len(names)):
            reading = {c: (name, sign) for c, name, sign in zip(order, names, signs, strict=True)}
            if all(reading.get(c, one) == one for c, one in given.items()):
                out.append(reading)
    if not out:
        asked = ", ".join(f"{prefix}_{c}={'-' if sign < 0 else ''}{column}" for c, (column, sign) in given.items())
        raise TactipError(f"{asked} contradicts the frames, whose {prefix} follows {' and '.join(names)}")
    return out


def _as_complex(columns: _Columns, parts: Mapping[str, tuple[str, float]]) -> np.ndarray:
    """Return the vectors (n,) that a reading gives, each column over its standard deviation."""
    axis = {"Rx": 1.0, "Ry": 1j, "x": 1.0, "y": 1j}
    total = np.zeros(len(columns.values), complex)
    for component, (name, sign) in parts.items():
        total = total + sign * axis[component] * columns.of(name) / columns.of(name).std()
    return total


def _log_likelihood(columns: _Columns, parts: Mapping[str, tuple[str, float]], estimate: np.ndarray) -> np.ndarray:
    """Return the logarithm of the likelihood of a reading at each of _ROTATION_STEPS; 0 if it has no columns."""
    if not parts:
        return np.zeros(len(_ROTATION_STEPS))
    reading = _as_complex(columns, parts)
    product, power = (estimate * reading.conj()).sum(), (abs(reading) ** 2).sum()
    along = np.maximum((np.exp(-1j * _ROTATION_STEPS) * product).real, 0.0)
    total = (abs(estimate) ** 2).sum()
    return -len(estimate) * np.log(np.maximum(total - along**2 / power, 1e-12 * total) / total)


_Scored = tuple[float, float, dict[str, tuple[str, float]], dict[str, tuple[str, float]]]


def _same_labels(columns: _Columns, one: _Scored, other: _Scored) -> bool:
    """Return whether two readings give the same labels."""
    for mine, theirs in ((one[2], other[2]), (one[3], other[3])):
        apart = np.exp(1j * one[1]) * _as_complex(columns, mine) - np.exp(1j * other[1]) * _as_complex(columns, theirs)
        if np.abs(apart).max() > _SAME_VECTORS:
            return False
    return True


def _plainness(turn: float, *readings: Mapping[str, tuple[str, float]]) -> tuple[int, int, float]:
    """Return how plain a reading is: names that sound like their component, no minus signs, little rotation."""
    parts = [(component, name, sign) for reading in readings for component, (name, sign) in reading.items()]
    named = sum(_sounds_like(name, component) for component, name, _ in parts)
    minus = sum(sign < 0 for *_, sign in parts)
    return named, -minus, -abs((turn + np.pi) % (2 * np.pi) - np.pi)


def _sounds_like(name: str, component: str) -> bool:
    """Return whether a column's name ends like one of our components, or says depth, roll, pitch or yaw."""
    low = name.lower()
    if component == "z" and "depth" in low:
        return True
    if component.startswith("R"):
        words = {"Rx": ("roll",), "Ry": ("pitch",), "Rz": ("yaw",)}[component]
        return low.endswith((component.lower(), *words)) or _SUFFIXES.get(name[-1]) == component
    return (low == component or low.endswith("_" + component)) or _SUFFIXES.get(name[-1]) == component


def _by_name(columns: _Columns, found: Mapping[str, str]) -> dict[str, str]:
    """Return shears' rotations by the names of columns: where pose_5 is a pose's rotation and move_1 a shear, move_5 is the
    shear's rotation, with the same sign."""
    poses = {ours[5:]: parse_column(f"{ours}={text}")[1] for ours, text in found.items() if ours.startswith("pose_R")}
    shears = [parse_column(f"{ours}={text}")[1][1] for ours, text in found.items() if ours in ("shear_x", "shear_y")]
    stems = {name[:-1] for name in shears if name}
    used = {parse_column(f"{ours}={text}")[1][1] for ours, text in found.items()}
    out = {}
    for component, (factor, column, _) in poses.items():
        ours = f"shear_{component}"
        if column is None or ours in found:
            continue
        for stem in stems:
            twin = stem + column[-1]
            if twin in columns.names and twin not in used:
                out[ours] = _spec(factor, twin, 0.0)
    return out


def _check_sign(ours: str, given: tuple[float, str | None, float], found: str) -> None:
    """Raise TactipError if a given column, (factor, column, offset), is not what the frames say, or negated."""
    factor, column, _ = parse_column(f"{ours}={found}")[1]
    if given[1] is not None and (given[1] != column or np.sign(given[0]) != np.sign(factor)):
        asked = f"{ours}={'-' if given[0] < 0 else ''}{given[1]}"
        raise TactipError(f"{asked} contradicts the frames, which say {ours}={found}")


def _unit(slope: float, kind: str) -> tuple[float, str]:
    """Return the factor to mm or degrees that brings a slope near 1, and words for the evidence."""
    factors = _UNITS[kind]
    best = min(factors, key=lambda factor: abs(np.log(max(slope, 1e-12) / factor)))
    return best, f", in {factors[best]}" if factors[best] else ""


def _spec(factor: float, name: str, offset: float) -> str:
    """Return a column as the option --columns has it."""
    number = "" if abs(factor) == 1 else f"{abs(factor):.7g}*"
    return f"{'-' if factor < 0 else ''}{number}{name}" + (f"{offset:+.7g}" if offset else "")


def _words(columns: _Columns, turn: float, *readings: Mapping[str, tuple[str, float]]) -> str:
    parts = []
    for prefix, reading in zip(("pose", "shear"), readings, strict=True):
        parts += [f"{prefix}_{c}={'-' if sign < 0 else ''}{name}" for c, (name, sign) in reading.items()]
    return f"{' '.join(parts)} with the camera rotated by {(np.degrees(turn) + 180) % 360 - 180:.0f}°"


def _centred(values: np.ndarray) -> np.ndarray:
    return values - values.mean()


def _correlation(column: np.ndarray, estimate: np.ndarray) -> complex:
    """Return the correlation of a real column (n,) with a complex estimate (n,); both without mean."""
    scale = np.sqrt((column**2).sum() * (abs(estimate) ** 2).sum())
    return complex((column * estimate).sum() / scale) if scale else 0j
