"""The readings of rotations, offset and shears on an edge: the columns that fit contacts estimated from the frames.

Several yaws may explain a frame, so the column that explains those of all frames best chooses among them.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim2real.importing.column_map import Angles, AnglesChoice
from tactip_twin.sim2real.importing.estimated_contacts import EstimatedContacts, chosen_of
from tactip_twin.sim2real.importing.find_angles import places
from tactip_twin.sim2real.importing.table_columns import (
    MIN_CORRELATION,
    MIN_EVIDENCE,
    UNITS,
    Columns,
    Known,
    assignments,
    centred,
    column_spec,
    correlation,
    explaining,
    is_named_shear,
    is_to_scale,
    nearest_unit,
    plainness,
    possible,
)
from tactip_twin.tactip_model.errors import TactipError

_MAX_UNEXPLAINED = 0.6
"""Largest part of the circular variance of the yaw that a column may leave [?]."""

_MAX_ZERO_MM = 3.0
"""Distance of the edge that the frames show from the table's zero within which the table is believed, mm [?]."""

_MAX_UNCLEAR_DEG = 2.0
"""Mean difference of the labels of two readings that fit equally well, degrees, above which none is taken [?]."""


_CERTAIN_TILT = 0.6
"""Correlation with the tilts from which a column that is named as a shear is one all the same [?]. A twist shows as a tilt
where the friction is far from the expected one: 0.49 on a hidden sensor [M]."""

_TILTS = ("Rx", "Ry")
"""Components of a pose that are tilts."""

_INDEPENDENT, _YAW_SPREAD_RAD, _OUTLIERS = 10.0, 0.2, 0.05
"""Choice among the optima of an edge's yaw: number of independent measurements in a frame, standard deviation of a right
yaw, and fraction of frames in which no optimum is right [?]."""

_CLEAR_YAW_DEG = 8.0
"""Standard deviation of an edge's yaw below which a frame shows it [?]."""


def with_yaws_resolved(columns: Columns, contacts: EstimatedContacts) -> EstimatedContacts:
    """Return contacts on an edge whose yaw is chosen among several optima: in each frame, the likelier of those that agree
    with the column, sign and offset that explain the yaws of all frames best. A frame alone may fit a wrong one better."""
    yaws = np.radians([one.poses[:, 5] for one in contacts.optima])
    misfits = np.square([one.residuals_px for one in contacts.optima])
    weights = np.exp(-0.5 * _INDEPENDENT * (misfits / misfits.min(0) - 1))
    weights /= weights.sum(0)
    offsets = np.radians(np.arange(0.0, 360.0, 5.0))
    best, which = -np.inf, np.zeros(len(contacts.rows), int)
    for values in columns.values.T:
        for sign, factor in itertools.product((1.0, -1.0), UNITS["angle"]):
            expected = sign * np.radians(factor * values) + offsets[:, None]
            agreement = weights * np.exp(-((1 - np.cos(yaws - expected[:, None])) / _YAW_SPREAD_RAD**2))
            scores = np.log(_OUTLIERS + agreement.sum(1)).sum(1)
            k = int(scores.argmax())
            if scores[k] > best:
                best, which = float(scores[k]), agreement[k].argmax(0)
    return chosen_of(contacts.optima, which)


@dataclass(frozen=True)
class EdgeReading:
    """What the columns mean on an edge."""

    columns: dict[str, str]
    """Columns by our components, as --columns has them, rotations by axis."""
    angles: Angles
    """Convention of the angles."""
    camera_deg: float
    """Rotation of the table's axes relative to the image's, degrees, after the quarter turns."""
    quarter_turns: int
    """Number of quarter turns by which the frames are to be rotated, so that an edge is upright."""
    evidence: list[str]
    """A sentence for each choice."""


_Reading = tuple[float, Angles, dict[str, tuple[str, float]], float, Rotation]
"""Likelihood of a reading of the rotations (_rotation_fit), convention of the angles, columns and signs of the tilts by
component, the yaw of the camera, degrees, and the rotations."""


def on_edge(
    columns: Columns,
    free: list[str],
    contacts: EstimatedContacts,
    known: Known,
    given_angles: AnglesChoice,
    possible_angles: Sequence[Angles] = get_args(Angles),
) -> EdgeReading:
    """Return the readings of yaw, tilts, offset and shears on an edge.

    Args:
        columns: The columns.
        free: Those that may be taken.
        contacts: Estimated contacts.
        known: Columns that are given.
        given_angles: Convention of the angles that is given, or auto.
        possible_angles: Conventions that the table may have.

    Raises:
        TactipError: If no column explains the yaw or the offset, what is given contradicts the frames, or two readings
            explain them equally well.
    """
    # Far from the edge, a frame does not show its direction.
    deviations = contacts.pose_deviations[:, 5]
    clear = deviations <= max(_CLEAR_YAW_DEG, float(np.sort(deviations)[min(len(deviations), 30) - 1]))
    estimated = Rotation.from_rotvec(contacts.poses[clear, 3:], degrees=True)
    others = [centred(contacts.shears[:, 0] + 1j * contacts.shears[:, 1]), centred(contacts.poses[:, 0])]
    asked = (given_angles, possible_angles)
    found, angles, offset_deg, evidence, left = _edge_rotations(columns, free, estimated, clear, others, known, *asked)
    quarter_turns = round(offset_deg / 90)
    wanted = {"pose_x": contacts.poses[:, 0]}
    wanted |= {"shear_x": contacts.shears[:, 0], "shear_y": contacts.shears[:, 1], "shear_Rz": contacts.shears[:, 5]}
    for ours, estimate in wanted.items():
        component = ours.partition("_")[2]
        to_scale = [one for one in possible(left, ours) if is_to_scale(columns.of(one), centred(estimate), component)]
        r = {one: float(np.corrcoef(columns.of(one), estimate)[0, 1]) for one in to_scale}
        best = max(r, key=lambda one: abs(r[one]), default="")
        if not r or abs(r[best]) < MIN_CORRELATION:
            if ours == "pose_x":
                raise TactipError(
                    "no column explains the distance to the edge that the frames show (the nearest is "
                    f"{best or 'none'}, correlation {r.get(best, 0):.2f}): give --columns pose_x=…"
                )
            continue
        best, _ = columns.likeliest(best, to_scale, (component,))
        _, same = columns.likeliest(best, left, (component,))
        slope = float((columns.of(best) * centred(estimate)).sum() / (columns.of(best) ** 2).sum())
        factor, unit = nearest_unit(abs(slope), "angle" if "_R" in ours else "pose")
        gain = abs(slope) / factor
        factor *= float(np.sign(slope)) * (columns.length_along(best, same) if ours == "pose_x" else 1.0)
        zero = float(np.mean(estimate) / gain - factor * columns.raw(best).mean())
        zero = round(zero, 1) if ours == "pose_x" and abs(zero) > _MAX_ZERO_MM else 0.0
        found[ours] = column_spec(factor, best, zero)
        where = f"; its zero is {zero:+.1f} mm from the edge that the frames show" if zero else ""
        evidence.append(f"{ours}={found[ours]}: correlation {r[best]:+.2f}{unit}{where}")
        left = [one for one in left if one not in same]
    return EdgeReading(found, angles, -(offset_deg - 90 * quarter_turns), quarter_turns, evidence)


def _edge_rotations(
    columns: Columns,
    free: list[str],
    estimated: Rotation,
    clear: np.ndarray,
    others: list[np.ndarray],
    known: Known,
    given_angles: AnglesChoice,
    possible_angles: Sequence[Angles],
) -> tuple[dict[str, str], Angles, float, list[str], list[str]]:
    """Return the readings of the rotations on an edge, their convention, the yaw at which the camera is mounted, degrees,
    the evidence, and the columns that are left.

    Args:
        columns: The columns.
        free: Those that may be taken.
        estimated: Estimated rotations of the frames that show the yaw.
        clear: (n,) bool, which frames these are.
        others: Estimates of other things, (n,), without their mean: shear (complex) and offset.
        known: Columns that are given.
        given_angles: Convention of the angles that is given, or auto.
        possible_angles: Conventions that the table may have.
    """
    yaw = np.radians(estimated.as_rotvec(degrees=True)[:, 2])
    values = {name: columns.values[clear, columns.names.index(name)] for name in free}
    scores = {
        (name, sign, factor): np.exp(1j * (yaw - sign * np.radians(factor * values[name]))).mean()
        for name in possible(free, "pose_Rz")
        for sign, factor in itertools.product((1.0, -1.0), UNITS["angle"])
    }
    best = max(scores, key=lambda key: abs(scores[key]), default=None)
    alone = abs(np.exp(1j * yaw).mean())
    if best is None or 1 - abs(scores[best]) > _MAX_UNEXPLAINED * (1 - alone):
        raise TactipError("no column explains the yaw of the edge that the frames show: give --columns pose_Rz=…")
    name, same = columns.likeliest(best[0], free, ("Rz",))
    sign, factor = best[1:]
    agreement = scores[name, sign, factor]
    left = [one for one in free if one not in same]
    tilts, seconds, left = _tilts_on_edge(columns, left, estimated, clear, others, name)
    if any(f"pose_{component}" in known for component in _TILTS):
        seconds = []  # who gives one tilt gives both
    turn = factor * values[name] * sign

    def readings(tilts: Sequence[str]) -> list[_Reading]:
        out = []
        for reading in assignments(tilts, _TILTS, known):
            about = {"x": np.zeros(len(turn)), "y": np.zeros(len(turn)), "z": turn}
            about |= {component[1]: s * factor * values[one] for component, (one, s) in reading.items()}
            for angles in possible_angles if tilts else ("vector" if given_angles == "auto" else given_angles,):
                score, offset, labels = _rotation_fit(about, angles, estimated, float(np.degrees(np.angle(agreement))))
                out.append((score, angles, reading, offset, labels))
        return out

    scored = readings(tilts)
    most = max(one[0] for one in scored)
    with_second = [one for second in seconds for one in readings([*tilts, second])]
    if with_second and max(one[0] for one in with_second) > most + MIN_EVIDENCE:
        scored, most = with_second, max(one[0] for one in with_second)
    near = [one for one in scored if one[0] > most - MIN_EVIDENCE]
    if given_angles != "auto":
        fitting = [one for one in near if one[1] == given_angles]
        if not fitting:
            best_angles = max(near, key=lambda one: one[0])[1]
            raise TactipError(f"angles {given_angles} contradict the frames, which say angles {best_angles}")
        near = fitting
    _, angles, reading, offset, labels = max(near, key=lambda one: (plainness(0.0, one[2])[:2], one[1] == "vector", one[0]))
    apart = [float(np.degrees((labels.inv() * one[4]).magnitude()).mean()) for one in near]
    k = int(np.argmax(apart))
    if apart[k] > _MAX_UNCLEAR_DEG:
        raise TactipError(
            f"the frames speak equally well for two readings of the table: {_rotation_words(reading, angles)}, and "
            f"{_rotation_words(near[k][2], near[k][1])}: give "
            + ("--angles, and the rest is found" if near[k][1] != angles else "the columns of one of them with --columns")
        )
    parts = reading | {"Rz": (name, sign)}
    found = {f"pose_{component}": columns.angle_spec(s * factor, one) for component, (one, s) in parts.items()}
    evidence = [
        f"{_rotation_words(parts, angles)}: agreement of the yaw {abs(agreement):.2f} (1 is perfect), with a camera rotated "
        f"by {-offset:.0f}°; other readings that fit give the same labels within {apart[k]:.1f}°"
    ]
    if not reading:
        evidence.append("no column explains the tilts of the frames")
    for column, _ in reading.values():
        if column in left:
            _, same = columns.likeliest(column, left, _TILTS)
            left = [one for one in left if one not in same]
    return found, angles, offset, evidence, left


def _tilts_on_edge(
    columns: Columns, free: list[str], estimated: Rotation, clear: np.ndarray, others: list[np.ndarray], yaw: str
) -> tuple[list[str], list[str], list[str]]:
    """Return the columns that explain the tilts; where this is a single one, those that may be the second; and all that are
    left.

    A tilt before the yaw turns with the sensor, one after it does not: both are tried. If one is before it and one after it,
    they do not look square to each other, and the second remains to be found by the rotations as a whole. A column that
    explains shear or offset better is none, because these show as tilt too; nor is one whose name, unlike that of the column
    `yaw`, says that it is a shear, unless it explains them very well.
    """
    shown = Columns(columns.names, columns.values[clear])
    normals = [turn.apply([0.0, 0.0, 1.0]) for turn in (estimated, estimated.inv())]
    tilted = [180 / np.pi * centred(normal[:, 0] + 1j * normal[:, 1]) for normal in normals]  # degrees, small angles
    explained = {one: max(abs(correlation(shown.of(one), tilt)) for tilt in tilted) for one in free}
    taken = [
        one
        for one in free
        if max(abs(correlation(columns.of(one), other)) for other in others) > explained[one]
        or (is_named_shear(one) and not is_named_shear(yaw) and explained[one] < _CERTAIN_TILT)
    ]
    options = [explaining(shown, [one for one in free if one not in taken], tilt, _TILTS) for tilt in tilted]
    tilts, left = max(options, key=lambda option: len(option[0]))
    seconds = [
        columns.likeliest(one, left, _TILTS)[0] for one in possible(left, "pose_Rx") if explained[one] > MIN_CORRELATION
    ]
    return tilts, list(dict.fromkeys(seconds)) if len(tilts) == 1 else [], [*left, *taken]


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
    place = places(angles)
    columns = " ".join(f"pose_R{place[c[1]]}={'-' if sign < 0 else ''}{name}" for c, (name, sign) in parts.items())
    return f"{columns} with --angles {angles}"
