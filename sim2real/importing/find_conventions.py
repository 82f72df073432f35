"""The conventions of a laboratory's table, found by holding it against contacts estimated from the frames.

A column means depth, tilt, yaw, offset or shear if it varies with what the pins say. Its sign, the rotation of the camera,
the point about which the rig rotates and the zero of depth follow. What the frames do not tell is said; where they speak
equally well for two readings that give different labels, both are named and none is taken.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from tactip_twin.sim2real.importing.column_map import Angles, ColumnMap, parse_column
from tactip_twin.sim2real.importing.convert_labels import own_columns
from tactip_twin.sim2real.importing.estimated_contacts import EstimatedContacts
from tactip_twin.sim2real.importing.find_angles import angles_and_lever, by_axis, in_order
from tactip_twin.sim2real.importing.find_on_edge import EdgeReading, on_edge, with_yaws_resolved
from tactip_twin.sim2real.importing.find_on_surface import on_surface
from tactip_twin.sim2real.importing.source import MAX_TAP_MM
from tactip_twin.sim2real.importing.table_columns import (
    MIN_CORRELATION,
    Columns,
    centred,
    column_spec,
    is_to_scale,
    nearest_unit,
    numeric_columns,
    possible,
)
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import read_json

_MAX_ZERO_MM = 1.7
"""Distance of the estimated from the table's zero of depth within which the table is believed, mm: a rig's zero has an
offset of some tenths, and an estimate with other mechanics one of 1 mm in the two sets that this was tried on [M]."""


@dataclass(frozen=True)
class Conventions:
    """What was found."""

    column_map: ColumnMap
    """Conventions of the table."""
    rotate_image_deg: float
    """Rotation of the frames to add, degrees: they are rotated by quarter turns until an edge is upright."""
    evidence: tuple[str, ...]
    """A sentence for each choice, and for what was not found."""


def find_conventions(
    table: Mapping[str, Sequence[str]], contacts: EstimatedContacts, given: ColumnMap, tap_mm: float | None = None
) -> Conventions:
    """Return the conventions of a table.

    Args:
        table: Cells of each column.
        contacts: Contacts that were estimated from some of its rows.
        given: What is known: its task, and columns and angles, which are kept and checked.
        tap_mm: Depth of the tap that makes contact, if the set's meta.json has one.

    Raises:
        TactipError: If no column explains the depth (for an edge, also the offset and the yaw), a given column or convention
            of angles contradicts the frames, or two readings explain them equally well.
    """
    table = {name: cells for name, cells in table.items() if name not in given.base_pose}
    columns, given = numeric_columns(table, contacts.rows), by_axis(given)
    known = dict(parse_column(spec) for spec in given.columns)
    if contacts.optima:
        contacts = with_yaws_resolved(columns, contacts)
    found, evidence, free = _depth(columns, contacts, tap_mm)
    if "pose_z" in known:
        _check_sign("pose_z", known["pose_z"], found["pose_z"])
    if given.task == "surface":
        reading = on_surface(columns, free, contacts, known)
    else:
        # The columns in place of a pose in the base's frame are a rotation vector by construction.
        conventions: tuple[Angles, ...] = ("vector",) if given.base_pose else get_args(Angles)
        reading = on_edge(columns, free, contacts, known, given.angles, conventions)
    found |= reading.columns
    evidence += reading.evidence
    by_name = _by_name(columns, found)
    evidence += [f"{ours}={text}: by its name alone" for ours, text in by_name.items()]
    found |= by_name
    evidence += [f"{spec}: as given" for spec in given.columns]
    unseen = [ours for ours, name in own_columns(table).items() if name in columns.names and ours not in {*found, *known}]
    if unseen:
        evidence.append(f"{', '.join(unseen)}: by their names alone, as the frames do not show them")
    if "pose_x" in known and "pose_x" in found:
        _check_sign("pose_x", known["pose_x"], found["pose_x"])
    specs = [*given.columns, *(f"{ours}={text}" for ours, text in found.items() if ours not in known)]
    column_map = replace(given, columns=tuple(specs), camera_rotation_deg=round(reading.camera_deg, 1))
    if isinstance(reading, EdgeReading):
        column_map, turned = in_order(column_map, reading.angles), 90.0 * reading.quarter_turns
    else:
        turned = 0.0
    column_map, told = angles_and_lever(table, contacts, column_map)
    return Conventions(column_map, turned, (*evidence, *told))


def tap_of(folder: Path, log: Callable[[str], object]) -> float | None:
    """Return the length, mm, of the tap in a set's meta.json (tap_move); None if there is none, or the file cannot be read,
    which `log` is told."""
    path = folder / "meta.json"
    try:
        content = read_json(path, f"the file {path}") if path.is_file() else None
    except TactipError as error:
        log(f"the tap is not known: {error}")
        return None
    tap = content.get("tap_move") if isinstance(content, dict) else None
    if not isinstance(tap, list) or len(tap) < 3 or not all(isinstance(x, (int, float)) for x in tap[:3]):
        return None
    return float(np.linalg.norm(tap[:3])) or None if all(abs(x) <= MAX_TAP_MM for x in tap[:3]) else None


def _depth(
    columns: Columns, contacts: EstimatedContacts, tap_mm: float | None
) -> tuple[dict[str, str], list[str], list[str]]:
    """Return the reading of the depth, its evidence, and the columns that are left."""
    depth, free = contacts.poses[:, 2], list(columns.names)
    to_scale = [name for name in possible(free, "pose_z") if is_to_scale(columns.of(name), centred(depth), "z")]
    r = {name: float(np.corrcoef(columns.of(name), depth)[0, 1]) for name in to_scale}
    best = max(r, key=lambda name: abs(r[name])) if r else ""
    if not r or abs(r[best]) < MIN_CORRELATION:
        raise TactipError(
            f"no column explains the depth that the frames show, in mm or m (the nearest is {best or 'none'}, correlation "
            f"{r.get(best, 0):.2f}): give --columns pose_z=…"
        )
    best, same = columns.likeliest(best, to_scale, ("z",))
    raw = columns.raw(best)
    # Deep contacts are read too shallow where the mechanics differ, so the zero is where the line meets no depth.
    slope = float((columns.of(best) * (depth - depth.mean())).sum() / (columns.of(best) ** 2).sum())
    slope /= min(r[best] ** 2, 1.0) or 1.0
    factor, unit = nearest_unit(abs(slope), "pose")
    sign = float(np.sign(slope))
    gain = abs(slope) / factor
    zero = float(np.mean(depth) / gain - np.mean(sign * factor * raw))
    candidates = [0.0] if tap_mm is None else [0.0, -tap_mm, tap_mm]
    if contacts.touching_at_rest:  # the frames show no zero, so the one that puts them into the object is believed
        inside = [offset for offset in candidates if np.mean(sign * factor * raw) + offset < 0]
        zero = inside[0] if inside else zero
    nearest = min(candidates, key=lambda offset: abs(offset - zero))
    offset = nearest if abs(nearest - zero) < _MAX_ZERO_MM else round(zero, 1)
    text = column_spec(sign * factor, best, offset)
    why = f"pose_z={text}: the depth of the frames follows {best} (correlation {r[best]:+.2f}{unit})"
    if offset == nearest and offset:
        why += f"; its zero is a tap of {tap_mm:g} mm away (measured: {zero:+.1f} mm)"
    elif offset == nearest and contacts.touching_at_rest:
        why += "; its zero is taken as given, because no neutral image shows it"
    elif offset == nearest:
        why += f"; its zero is the surface (measured: {zero:+.1f} mm away)"
    else:
        why += f"; its zero is {zero:+.1f} mm from where frames show no contact"
    return {"pose_z": text}, [why], [name for name in free if name not in same]


def _by_name(columns: Columns, found: Mapping[str, str]) -> dict[str, str]:
    """Return shears' rotations by the names of columns: where pose_5 is a pose's rotation and move_1 a shear, move_5 is the
    shear's rotation, with the same sign."""
    poses = {ours[5:]: parse_column(f"{ours}={text}")[1] for ours, text in found.items() if ours.startswith("pose_R")}
    shears = [parse_column(f"{ours}={text}")[1][1] for ours, text in found.items() if ours in ("shear_x", "shear_y")]
    stems = {_stem(name) for name in shears if name}
    used = {parse_column(f"{ours}={text}")[1][1] for ours, text in found.items()}
    out = {}
    for component, (factor, column, _) in poses.items():
        ours = f"shear_{component}"
        if column is None or ours in found:
            continue
        for stem in stems:
            twin = stem + column[len(_stem(column)) :]
            if twin in columns.names and twin not in used:
                out[ours] = column_spec(factor, twin, 0.0)
    return out


def _stem(column: str) -> str:
    """Return a column's name without the component at its end: x, Rx or a digit."""
    return re.sub(r"(?:[Rr]?[xyzXYZ]|\d)$", "", column)


def _check_sign(ours: str, given: tuple[float, str | None, float], found: str) -> None:
    """Raise TactipError if a given column, (factor, column, offset), is not what the frames say, or negated."""
    factor, column, _ = parse_column(f"{ours}={found}")[1]
    if given[1] is not None and (given[1] != column or np.sign(given[0]) != np.sign(factor)):
        asked = f"{ours}={'-' if given[0] < 0 else ''}{given[1]}"
        raise TactipError(f"{asked} contradicts the frames, which say {ours}={found}")
