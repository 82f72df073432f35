"""Allowed ranges of configuration values: each range stands beside its field, and an error names the field.

    thickness_m: float = within(0.3e-3, 3e-3, default=1e-3)

A configuration calls `check(self)` in `__post_init__`, so every configuration that exists is valid.
"""

from dataclasses import field, fields
from functools import cache
from math import isfinite
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import TYPE_CHECKING, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from tactip_twin.tactip_model.errors import TactipError

if TYPE_CHECKING:
    import numpy as np
    from _typeshed import DataclassInstance

T = TypeVar("T")


def within(low: float | tuple[float, ...], high: float | tuple[float, ...], *, default: T) -> T:
    """Return a dataclass field whose number, or each of whose numbers, lies between two limits.

    The field's type must be float, int, or a tuple of a fixed number of them; each may also be None.

    Args:
        low: Smallest allowed value; for a tuple field, optionally one value per number.
        high: Largest allowed value, likewise.
        default: Default value of the field.
    """
    return field(default=default, metadata={"low": low, "high": high})


def check(configuration: "DataclassInstance") -> None:
    """Check every bounded field of a configuration.

    A field may be None where its type or its default is None.

    Raises:
        TactipError: A value is not a number, not finite or out of bounds, or a tuple has the wrong length.
    """
    for name, optional, is_tuple, ranges in _bounded_fields(type(configuration)):
        value = getattr(configuration, name)
        if value is None and optional:
            continue
        numbers = value if isinstance(value, tuple | list) else (value,)
        if isinstance(value, tuple | list) != is_tuple or len(numbers) != len(ranges):
            allowed = list(dict.fromkeys(_allowed(number) for number in ranges))
            count = f"{len(ranges)} numbers, {'each ' if len(allowed) == 1 else ''}" if is_tuple else ""
            raise TactipError(f"{name} must be {count}{' and '.join(allowed)}, got {value}")
        for number, limits in zip(numbers, ranges, strict=True):
            if not _in_range(number, limits):
                raise TactipError(f"{name} must be {_allowed(limits)}, got {value}")


def require(condition: "bool | np.bool", name: str, value: object, allowed: str) -> None:
    """Raise TactipError unless a condition holds.

    Args:
        condition: What must be true.
        name: Name of the field or quantity, for the message.
        value: Its value.
        allowed: The allowed values in words; completes "NAME must be …".
    """
    if not condition:
        raise TactipError(f"{name} must be {allowed}, got {value}")


class _Range(NamedTuple):
    """Kind and inclusive limits of one number."""

    kind: type[Integral] | type[Real]
    low: float
    high: float


class _BoundedField(NamedTuple):
    """A field with bounds."""

    name: str
    optional: bool
    is_tuple: bool
    ranges: list[_Range]


@cache
def _bounded_fields(configuration: "type[DataclassInstance]") -> list[_BoundedField]:
    """Return the fields of a configuration's class that have bounds."""
    hints, out = get_type_hints(configuration), []
    for f in fields(configuration):
        if "low" not in f.metadata:
            continue
        hint = hints[f.name]
        options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        (own,) = (option for option in options if option is not NoneType)
        is_tuple = get_origin(own) is tuple
        kinds = [Integral if one is int else Real for one in (get_args(own) if is_tuple else (own,))]
        lows, highs = (_per_number(f.metadata[end], len(kinds)) for end in ("low", "high"))
        ranges = [_Range(*limits) for limits in zip(kinds, lows, highs, strict=True)]
        out.append(_BoundedField(f.name, NoneType in options or f.default is None, is_tuple, ranges))
    return out


def _in_range(number: object, limits: _Range) -> bool:
    """Return whether a value is a number of the right kind, finite and within the limits."""
    if not isinstance(number, limits.kind):
        return False
    value = float(number)
    return isfinite(value) and limits.low <= value <= limits.high


def _allowed(limits: _Range) -> str:
    """Return the allowed values of a number in words."""
    kind = "a whole number" if limits.kind is Integral else "a finite number"
    return f"{kind} from {limits.low:g} to {limits.high:g}"


def _per_number(bound: float | tuple[float, ...], count: int) -> tuple[float, ...]:
    """Return a bound for each of `count` numbers."""
    return bound if isinstance(bound, tuple) else (bound,) * count
