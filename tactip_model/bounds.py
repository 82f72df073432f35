"""What the numbers of a configuration may be: the range stands beside the field, and what breaks it is refused by name.

    thickness_m: float = within(0.3e-3, 3e-3, default=1e-3)

A configuration calls `check(self)` as it is made: one that exists can be used.
"""

from dataclasses import field, fields
from math import isfinite
from numbers import Integral, Real
from typing import Any

from tactip_model.errors import TactipError


def within(low, high, *, default) -> Any:
    """A dataclass field whose number, or each of whose numbers, lies from low to high, both allowed.

    low, high: numbers, or tuples of them with one a number of the field. default: the field's default.
    """
    return field(default=default, metadata={"low": low, "high": high})


def check(configuration):
    """Raise TactipError where a number of a configuration (a dataclass) is none, not finite, or outside its bounds."""
    for f in fields(configuration):
        value = getattr(configuration, f.name)
        if "low" not in f.metadata or value is None:
            continue
        name = f"{type(configuration).__name__}.{f.name}"
        numbers = value if isinstance(value, tuple | list) else (value,)
        lows, highs = (_each(f.metadata[end], len(numbers)) for end in ("low", "high"))
        kind = Integral if f.type is int else Real
        for number, low, high in zip(numbers, lows, highs, strict=True):
            if not isinstance(number, kind) or not isfinite(number) or not low <= number <= high:
                what = "a whole number" if kind is Integral else "a finite number"
                raise TactipError(f"{name} is {value}: it must be {what} from {low:g} to {high:g}")


def require(holds, name, value, what):
    """Raise TactipError, naming a field's name and value and `what` is allowed (str), where `holds` is False."""
    if not holds:
        raise TactipError(f"{name} is {value}: it must be {what}")


def _each(bound, count):
    """A bound for each of `count` numbers."""
    return bound if isinstance(bound, tuple) else (bound,) * count
