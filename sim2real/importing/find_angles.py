"""The convention of a table's angles and its tool centre: those whose labels fit contacts estimated from the frames best."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import get_args

import numpy as np

from tactip_twin.sim2real.importing.column_map import Angles, AnglesChoice, ColumnMap, parse_column
from tactip_twin.sim2real.importing.convert_labels import convert_labels
from tactip_twin.sim2real.importing.estimated_contacts import EstimatedContacts
from tactip_twin.sim2real.importing.table_columns import MIN_EVIDENCE, centred, robust_fit
from tactip_twin.tactip_model.errors import TactipError

_SAME_DEG = 0.5
"""Mean difference of labels, degrees, that does not matter."""

_MIN_DEPTH_SPREAD_MM = 0.1
"""Minimum standard deviation of the labels of depth, mm, from which their gain can be told [?]."""

_MIN_CHANGE = 1e-4
"""Minimum standard deviation of the change of depth, mm, by a tool centre that is 1 mm off, for it to be sought."""

_SIGNIFICANT = 3.5
"""Minimum of the tool centre's distance from the apex, in standard deviations [?]."""

_MIN_LEVER_MM = {"surface": np.array([3.0, 0.3, 0.3]), "edge": np.array([3.0, 2.0, 2.0])}
"""Minimum of the tool centre's distance from the apex, mm, by task: behind it, and beside it in x and y [?]. On an edge,
another stiffness than the estimated one looks like a tool centre up to 1.2 mm beside the axis [M]."""


def angles_and_lever(
    table: Mapping[str, Sequence[str]], contacts: EstimatedContacts, column_map: ColumnMap
) -> tuple[ColumnMap, list[str]]:
    """Return a ColumnMap with the convention of angles and the tool centre that fit best, and the evidence."""
    rows: dict[str, Sequence[str]] = {name: [cells[int(i)] for i in contacts.rows] for name, cells in table.items()}
    evidence = []
    mapped = {ours for ours, (_, column, _) in map(parse_column, column_map.columns) if column is not None}
    if column_map.task == "surface" and len(mapped & {"pose_Rx", "pose_Ry"}) > 1 and not column_map.base_pose:
        column_map, told = _angles(rows, contacts, column_map)
        evidence.append(told)
    elif column_map.task == "surface":
        column_map = in_order(column_map, "vector" if column_map.angles == "auto" else column_map.angles)
    if mapped & {"pose_Rx", "pose_Ry"}:
        column_map, told = _lever(rows, contacts, column_map)
        evidence.append(told)
    return column_map, evidence


def _angles(rows: Mapping[str, Sequence[str]], contacts: EstimatedContacts, column_map: ColumnMap) -> tuple[ColumnMap, str]:
    parts, given = [3, 4], column_map.angles
    maps = {angles: in_order(column_map, angles) for angles in get_args(Angles)}
    labels = {angles: convert_labels(one, rows)[0][:, parts] for angles, one in maps.items()}
    score = {angles: _fit(label, contacts.poses[:, parts]) for angles, label in labels.items()}
    best = max(score, key=lambda angles: score[angles])
    if given == "auto" and score[best] - score["vector"] < MIN_EVIDENCE:
        best = "vector"
    apart = {angles: float(np.abs(label - labels[best]).mean(0).max()) for angles, label in labels.items()}
    if given != "auto":
        if score[best] - score[given] >= MIN_EVIDENCE and apart[given] > _SAME_DEG:
            raise TactipError(f"angles {given} contradict the frames, which say angles {best}")
        return maps[given], f"angles {given}, as given; the frames do not contradict it"
    unclear = [one for one in labels if score[best] - score[one] < MIN_EVIDENCE and apart[one] > _SAME_DEG]
    if unclear:
        worst = max(apart[one] for one in unclear)
        told = (
            f"the frames do not exclude {', '.join(unclear)}, with labels up to {worst:.1f}° away: give --angles if you know"
        )
    else:
        told = f"others that fit as well give the same labels within {_SAME_DEG:g}°"
    return maps[best], f"angles {best}; {told}"


def in_order(column_map: ColumnMap, angles: Angles) -> ColumnMap:
    """Return a ColumnMap, whose rotations are about x, y and z, with another convention: Euler angles are listed in the
    order of its letters."""
    return replace(column_map, columns=_renamed(column_map.columns, places(angles)), angles=angles)


def by_axis(given: ColumnMap) -> ColumnMap:
    """Return a ColumnMap, whose rotations are in the order of its angles, with rotations about x, y and z."""
    axes = {place: letter for letter, place in places(given.angles).items()}
    return replace(given, columns=_renamed(given.columns, axes))


def places(angles: AnglesChoice) -> dict[str, str]:
    """Return for each axis x, y and z the letter under which its rotation is listed: that of its place in the order."""
    order = "xyz" if angles in ("auto", "vector") else angles.lower()
    return {letter: "xyz"[k] for k, letter in enumerate(order)}


def _renamed(columns: Sequence[str], letters: Mapping[str, str]) -> tuple[str, ...]:
    """Return columns (OURS=THEIRS) with other letters of their rotations."""
    specs = []
    for spec in columns:
        ours, _, theirs = (part.strip() for part in spec.partition("="))
        prefix, turns, letter = ours.partition("_R")
        specs.append(f"{prefix}_R{letters[letter]}={theirs}" if turns else spec)
    return tuple(specs)


def _lever(rows: Mapping[str, Sequence[str]], contacts: EstimatedContacts, column_map: ColumnMap) -> tuple[ColumnMap, str]:
    """Return a ColumnMap with the place of the tool centre, where it is not given, that explains how depth changes with
    tilt; and the evidence."""
    fits = contacts.fits_well
    rows = {name: [cells[int(i)] for i in np.flatnonzero(fits)] for name, cells in rows.items()}
    depths = contacts.poses[fits, 2]
    given = np.array([column_map.tcp_behind_apex_mm, *column_map.tcp_beside_axis_mm])
    plain = convert_labels(column_map, rows)[0][:, 2]
    if plain.std() < _MIN_DEPTH_SPREAD_MM:
        return column_map, "the depth hardly varies, so no tool centre is sought"
    changes = np.array([convert_labels(_with_lever(column_map, given + one), rows)[0][:, 2] - plain for one in np.eye(3)])
    chosen = (given == 0) & (changes.std(1) > _MIN_CHANGE)
    lever, deviations = np.zeros(3), np.zeros(3)
    for _ in range(2):  # again without what is not significant
        design = np.stack([plain, np.ones_like(plain), *changes[chosen]], -1)
        found, spread = robust_fit(design, depths)
        gain = float(found[0])
        lever[:], deviations[chosen] = 0.0, spread[2:] / abs(gain)
        lever[chosen] = found[2:] / gain
        chosen &= np.abs(lever) >= np.maximum(_SIGNIFICANT * deviations, _MIN_LEVER_MM[column_map.task])
    lever = np.where(chosen, np.clip(lever, [-100, -20, -20], [100, 20, 20]).round(1), given)
    names = [
        f"{value:g} (± {deviation:.1f})" if new else f"{value:g}"
        for value, deviation, new in zip(lever, deviations, chosen, strict=True)
    ]
    where = f"tcp-behind-apex-mm {names[0]}, tcp-beside-axis-mm {names[1]} {names[2]}"
    if not chosen.any():
        return column_map, f"{where}: depth does not show another tool centre"
    told = f"{where}: depth differs from the table in tilted frames as that tool centre makes it"
    return _with_lever(column_map, lever), told


def _with_lever(column_map: ColumnMap, lever_mm: np.ndarray) -> ColumnMap:
    """Return a ColumnMap with a tool centre (3,): behind the apex, and beside the axis in x and y."""
    behind, x, y = (float(value) for value in lever_mm)
    return replace(column_map, tcp_behind_apex_mm=behind, tcp_beside_axis_mm=(x, y))


def _fit(labels: np.ndarray, estimates: np.ndarray) -> float:
    """Return the logarithm of the likelihood of estimates (n, k) as a multiple of labels (n, k), plus a constant each."""
    total = 0.0
    for label, estimate in zip(labels.T, estimates.T, strict=True):
        x, y = centred(label), centred(estimate)
        if not x.any():
            continue
        wrong = np.abs(y - x * (x * y).sum() / (x * x).sum())
        spread = 1.48 * np.median(wrong) + 1e-9
        # Student's t with 3 degrees of freedom: some frames lag behind their row.
        total -= float(2 * np.log1p((wrong / spread) ** 2 / 3).sum() + len(x) * np.log(spread))
    return total
