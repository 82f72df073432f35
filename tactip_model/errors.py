"""Errors whose message is one sentence that the user can act on."""

from collections.abc import Mapping
from typing import TypeVar

K = TypeVar("K")
V = TypeVar("V")


class TactipError(Exception):
    """An error shown to the user without a traceback; its message gives what is wrong, the value and what is allowed."""


class Interrupted(Exception):
    """An interrupt by the user. The message says what is kept and how to resume."""


def lookup(kind: str, name: object, table: Mapping[K, V]) -> V:
    """Return the value that a table has under a name.

    Args:
        kind: What the name stands for, for the message.
        name: The name to look up.
        table: Values by name.

    Raises:
        TactipError: The table lacks the name; the message lists the valid ones.
    """
    for key, value in table.items():
        if key == name:
            return value
    raise TactipError(f"unknown {kind} {name!r}: choose one of {', '.join(map(str, table))}")
