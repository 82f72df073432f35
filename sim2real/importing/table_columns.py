"""Columns of a laboratory's table, and what they explain of estimates from the frames."""

import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from tactip_twin.sim2real.importing.column_map import TOOL_COLUMNS, written
from tactip_twin.tactip_model.errors import TactipError

MIN_CORRELATION = 0.35
"""Correlation with an estimate above which a column explains it; by chance, 120 frames give 0.09 rms."""

_SAME_COLUMN = 0.99
"""Correlation of two columns above which they say the same: a table that is sorted by a tilt numbers its rows by it too."""

MIN_EVIDENCE = 6.0
"""Logarithm of the likelihood ratio above which one reading of the frames is preferred to another [?]."""

UNITS = {"pose": {1.0: "", 1000.0: "m"}, "angle": {1.0: "", 57.29578: "rad"}}
"""Factors to mm and degrees, and the units that they are from."""

_MAX_SCALE = 5.0
"""Largest ratio, up or down, of an estimate to what a column says in one of its units. Estimates are up to three times too
small, because skin slips [?]; a column that is not so is another one's trace, as the height of a shear on a tilted table."""

_MAX_TILT_SCALE = 2.0
"""The same of a tilt, which does not slip [?]. A twist of the skin at an edge shows as a fifth of a tilt [M]."""

Known = Mapping[str, tuple[float, str | None, float]]
"""Columns that are given: (factor, column, offset) by our components."""

_SUFFIXES = {"1": "x", "2": "y", "3": "z", "4": "Rx", "5": "Ry", "6": "Rz"}
"""Components by the last digit of a column's name."""


@dataclass(frozen=True)
class Columns:
    """Numeric columns of the table that vary. (n frames, k columns)"""

    names: tuple[str, ...]
    """Names of the columns."""
    values: np.ndarray
    """(n, k)."""
    half_turned: frozenset[str] = frozenset()
    """Names of those that are angles around 180°: `values` has them around 0."""

    def raw(self, name: str) -> np.ndarray:
        """Return a column (n,)."""
        return self.values[:, self.names.index(name)]

    def of(self, name: str) -> np.ndarray:
        """Return a column (n,), its mean subtracted."""
        return centred(self.raw(name))

    def angle_spec(self, factor: float, name: str) -> str:
        """Return a column that is an angle as the option --columns has it."""
        return column_spec(factor, name, -180.0 if name in self.half_turned else 0.0)

    def length_along(self, name: str, same: Sequence[str]) -> float:
        """Return how long a line is on which column `name` grows by 1: longer than 1 if it is the x or y of a position whose
        y or x is among those that say the `same`, because the line is along neither axis."""
        other = {"x": "y", "y": "x", "X": "Y", "Y": "X"}.get(name[-1:])
        mate = name[:-1] + other if other else ""
        return float(np.hypot(1.0, self.of(mate).std() / self.of(name).std())) if mate in same else 1.0

    def likeliest(self, name: str, free: Sequence[str], components: Sequence[str]) -> tuple[str, list[str]]:
        """Return the column in `free` that is most likely meant, among those that say the same as column `name`, and these:
        by its name, or because it does not count rows."""
        same = [one for one in free if abs(np.corrcoef(self.of(one), self.of(name))[0, 1]) > _SAME_COLUMN]

        def rank(one: str) -> tuple[bool, bool, bool]:
            whole = bool((self.raw(one) % 1 == 0).all())
            return not any(_sounds_like(one, component) for component in components), whole, one != name

        return min(same, key=rank), same


def numeric_columns(table: Mapping[str, Sequence[str]], rows: np.ndarray) -> Columns:
    """Return the numeric columns of some rows (n,) of a table that vary.

    Angles from 0 to 360° become those from -180 to 180°, and angles around 180° those around 0. Columns that are named as
    forces, torques, times or counts are left out: a force follows the depth, too.

    Raises:
        TactipError: If there is none.
    """
    read = {name: np.array([number(cells[int(i)]) for i in rows]) for name, cells in table.items()}
    read = {name: column for name, column in read.items() if np.isfinite(column).all()}
    read = {name: x for name, x in read.items() if len(np.unique(x)) > 2 and not _NO_POSE.search(name.lower())}
    found = {name: _unwrapped(column) for name, column in read.items()}
    if not found:
        raise TactipError(f"the table has no column of numbers that vary: its columns are {', '.join(table)}")
    turned = frozenset(name for name, column in read.items() if _half_turn(column))
    return Columns(tuple(found), np.stack(list(found.values()), -1), turned)


def with_lists_split(table: Mapping[str, Sequence[str]]) -> dict[str, Sequence[str]]:
    """Return a table with columns NAME_1, NAME_2 … in place of a column NAME whose cells are lists of numbers, as
    `[1.5, 2, -3]` or `[1.5 2. -3.]`, most of one length; where a cell is no list of this length, they are empty."""
    out: dict[str, Sequence[str]] = {}
    for name, cells in table.items():
        lists = [_LIST.fullmatch(cell) for cell in cells]
        parts = [re.split(r"[,;\s]+", one[1].strip()) if one else [] for one in lists]
        count = Counter(len(one) for one in parts if one).most_common(1)[0][0] if any(parts) else 0
        new = [f"{name}_{k + 1}" for k in range(count)]
        if count < 2 or any(one in table for one in new):
            out[name] = cells
            continue
        whole = [one if len(one) == count else [""] * count for one in parts]
        out |= {one: [row[k] for row in whole] for k, one in enumerate(new)}
    return out


_LIST = re.compile(r"[\[(]([-+\d.eE,;\s]+)[\])]")
"""A list or tuple of numbers, as Python writes it."""


def complete_rows(table: Mapping[str, Sequence[str]]) -> np.ndarray:
    """Return which rows (n,) bool of a table have a number in each column that has one nearly everywhere."""
    count = len(next(iter(table.values())))
    complete = np.ones(count, bool)
    for cells in table.values():
        finite = np.array([np.isfinite(number(cell)) for cell in cells])
        if finite.mean() > _NEARLY:
            complete &= finite
    return complete


def number(cell: str | None) -> float:
    """Return the number in a table's cell; NaN if it is none."""
    try:
        return float("nan" if cell is None else cell)
    except ValueError:
        return float("nan")


_NEARLY = 0.8
"""Fraction of a column's cells that are numbers above which the other cells are gaps in the record [?]."""

_NO_POSE = re.compile(r"force|torque|wrench|time|stamp|index|count|\bn?id\b|^f_?[xyz]\b|unnamed")
"""Names, in small letters, of columns that hold no pose."""


def _unwrapped(column: np.ndarray) -> np.ndarray:
    """Return a column (n,) with its angles from 180 to 360° brought to -180 to 0, if it has values near 0 and 360 alone, or
    those around 180° brought to 0, if it has values near 180 and -180° alone."""
    wraps = 0 <= column.min() < 45 and 315 < column.max() <= 360 and not ((column > 135) & (column < 225)).any()
    half = _half_turn(column)
    return column - half * np.sign(column) if half else np.where(wraps & (column > 180), column - 360, column)


def _half_turn(column: np.ndarray) -> float:
    """Return half a turn, in degrees or rad, if a column (n,) has angles near it on both sides alone; 0 if not."""
    for half in (180.0, np.pi):
        near = (0.75 * half < np.abs(column)) & (np.abs(column) <= 1.001 * half)
        if near.all() and column.min() < 0 < column.max():
            return half
    return 0.0


def possible(names: Sequence[str], ours: str) -> list[str]:
    """Return those of some columns that can be one of our components, pose_x to shear_Rz: TOOL_COLUMNS are poses, and their
    positions are no angles."""
    turns, moves = "_R" in ours, ours.startswith("shear")
    return [name for name in names if name not in TOOL_COLUMNS or (not moves and name.startswith("tool_R") == turns)]


def explaining(
    columns: Columns, free: Sequence[str], estimate: np.ndarray, components: tuple[str, str]
) -> tuple[list[str], list[str]]:
    """Return up to two columns that explain a complex estimate (n,), in directions that are about square to each other, and
    the columns that say something else."""
    chosen: list[str] = []
    tilts = components[0].startswith("R")
    left, others = estimate, list(free)
    for _ in range(2):
        names = possible(others, "pose_Rx" if tilts else "shear_x")
        to_scale = [name for name in names if is_to_scale(columns.of(name), left, components[0], tilts=tilts)]
        r = {name: correlation(columns.of(name), left) for name in to_scale}
        if chosen:
            first = np.angle(correlation(columns.of(chosen[0]), estimate))
            r = {name: value for name, value in r.items() if abs(np.cos(np.angle(value) - first)) < 0.5}
        best = max(r, key=lambda name: abs(r[name]), default=None)
        if best is None or abs(r[best]) < MIN_CORRELATION:
            break
        best, same = columns.likeliest(best, others, components)
        chosen.append(best)
        others = [name for name in others if name not in same]
        x = columns.of(best)
        left = left - x * (x * left).sum() / (x * x).sum()
    return chosen, others


def assignments(names: Sequence[str], components: tuple[str, str], known: Known) -> list[dict[str, tuple[str, float]]]:
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


def plainness(turn: float, *readings: Mapping[str, tuple[str, float]]) -> tuple[int, int, float]:
    """Return how plain a reading is: names that sound like their component, no minus signs, little rotation."""
    parts = [(component, name, sign) for reading in readings for component, (name, sign) in reading.items()]
    named = sum(_sounds_like(name, component) for component, name, _ in parts)
    minus = sum(sign < 0 for *_, sign in parts)
    return named, -minus, -abs((turn + np.pi) % (2 * np.pi) - np.pi)


def _sounds_like(name: str, component: str) -> bool:
    """Return whether a column's name ends like one of our components, or says depth, roll, pitch or yaw."""
    low = plain_name(name)
    if component == "z" and "depth" in low:
        return True
    if component.startswith("R"):
        words = {"Rx": ("roll",), "Ry": ("pitch",), "Rz": ("yaw",)}[component]
        return low.endswith((component.lower(), *words)) or _SUFFIXES.get(low[-1:]) == component
    return low == component or low.endswith(("_" + component, " " + component)) or _SUFFIXES.get(low[-1:]) == component


def plain_name(name: str) -> str:
    """Return a column's name in small letters, without its unit."""
    return _UNIT.sub("", name.lower())


def is_named_shear(name: str) -> bool:
    """Return whether a column's name says that it is a part of a move in contact."""
    return bool(_SHEAR.search(name.lower()))


_SHEAR = re.compile(r"shear|move|slide|twist")
"""Names, in small letters, of columns of a move in contact."""

_UNIT = re.compile(r"[\s_]*[(\[]?(?:mm|cm|m|deg|degrees|rad|°)[)\]]?$")
"""A unit at the end of a column's name, in small letters."""


def is_to_scale(column: np.ndarray, estimate: np.ndarray, component: str, *, tilts: bool = False) -> bool:
    """Return whether an estimate of a component (n,), real or complex, changes with a column (n,) about as much as it says,
    in one of its units; both without mean. `tilts`: whether it is a tilt of the pose, which no skin follows by a part."""
    slope = abs((column * estimate).sum()) / (column**2).sum()
    factor, _ = nearest_unit(float(slope), "angle" if component.startswith("R") else "pose")
    largest = _MAX_TILT_SCALE if tilts else _MAX_SCALE
    return 1 / largest < slope / factor < largest


def nearest_unit(slope: float, kind: str) -> tuple[float, str]:
    """Return the factor to mm or degrees that brings a slope near 1, and words for the evidence."""
    factors = UNITS[kind]
    best = min(factors, key=lambda factor: abs(np.log(max(slope, 1e-12) / factor)))
    return best, f", in {factors[best]}" if factors[best] else ""


def column_spec(factor: float, name: str, offset: float) -> str:
    """Return a column as the option --columns has it."""
    number = "" if abs(factor) == 1 else f"{abs(factor):.7g}*"
    return f"{'-' if factor < 0 else ''}{number}{written(name)}" + (f"{offset:+.7g}" if offset else "")


def centred(values: np.ndarray) -> np.ndarray:
    """Return values without their mean."""
    return values - values.mean()


def robust_fit(design: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the coefficients (k,) of a fit to values (n,) that outliers hardly pull, and their standard deviations (k,)."""
    start, *_ = np.linalg.lstsq(design, values, rcond=None)
    spread = 1.48 * float(np.median(np.abs(values - design @ start))) + 1e-9
    fit = least_squares(lambda p: (values - design @ p) / spread, start, loss="soft_l1")
    return fit.x, np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))


def correlation(column: np.ndarray, estimate: np.ndarray) -> complex:
    """Return the correlation of a real column (n,) with a complex estimate (n,); both without mean."""
    scale = np.sqrt((column**2).sum() * (abs(estimate) ** 2).sum())
    return complex((column * estimate).sum() / scale) if scale else 0j
