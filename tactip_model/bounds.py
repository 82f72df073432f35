"""What the numbers of a configuration may be: the range stands beside the field, and what breaks it is refused by name.

    thickness_m: float = within(0.3e-3, 3e-3, default=1e-3)

A configuration calls `check(self)` as it is made: one that exists can be used.
"""

from dataclasses import field, fields
from functools import cache
from math import isfinite
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from tactip_twin.tactip_model.errors import TactipError


def within(low, high, *, default) -> Any:
    """A dataclass field whose number, or each of whose numbers, lies from low to high, both allowed.

    low, high: numbers, or tuples of them with one a number of the field. default: the field's default.
    The field's type says what it takes: float, int, or a tuple of a fixed number of them, each also with None.
    """
    return field(default=default, metadata={"low": low, "high": high})


def check(configuration):
    """Raise TactipError where a number of a configuration (a dataclass) is none, not finite, or out of its bounds, and where
    a field has another number of them than its type. None is for fields whose type or default has it."""
    for name, optional, many, numbers in _bounded(type(configuration)):
        value = getattr(configuration, name)
        if value is None and optional:
            continue
        if isinstance(value, tuple | list) != many or (many and len(value) != len(numbers)):
            allowed = list(dict.fromkeys(_allowed(*number) for number in numbers))
            many_of = f"{len(numbers)} numbers, {'each ' if len(allowed) == 1 else ''}" if many else ""
            raise TactipError(f"{name} must be {many_of}{' and '.join(allowed)}, got {value}")
        for number, (kind, low, high) in zip(value if many else (value,), numbers, strict=True):
            if not isinstance(number, kind) or not isfinite(number) or not low <= number <= high:
                raise TactipError(f"{name} must be {_allowed(kind, low, high)}, got {value}")


@cache
def _bounded(configuration):
    """The fields of a configuration's class that have bounds, list of: name, whether it may be None, whether it is a tuple,
    and kind, least and greatest value of each of its numbers (list)."""
    hints, out = get_type_hints(configuration), []
    for f in fields(configuration):
        if "low" not in f.metadata:
            continue
        hint = hints[f.name]
        either = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        (kind,) = (one for one in either if one is not NoneType)
        many = get_origin(kind) is tuple
        kinds = [Integral if one is int else Real for one in (get_args(kind) if many else (kind,))]
        lows, highs = (_each(f.metadata[end], len(kinds)) for end in ("low", "high"))
        optional = NoneType in either or f.default is None
        out.append((f.name, optional, many, list(zip(kinds, lows, highs, strict=True))))
    return out


def _allowed(kind, low, high):
    """What a number may be, as text."""
    return f"{'a whole number' if kind is Integral else 'a finite number'} from {low:g} to {high:g}"


def require(holds, name, value, what):
    """Raise TactipError, naming a field's name and value and `what` is allowed (str), where `holds` is False."""
    if not holds:
        raise TactipError(f"{name} must be {what}, got {value}")


def _each(bound, count):
    """A bound for each of `count` numbers."""
    return bound if isinstance(bound, tuple) else (bound,) * count
