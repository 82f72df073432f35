"""What can go wrong by the user's doing or the machine's, as one sentence a user can act on."""


class TactipError(Exception):
    """An error with a message for the user: what was wrong, the value, what is allowed. Shown without a traceback."""


class Interrupted(Exception):
    """The user stopped a long work. The message says what is kept and how to go on."""


def lookup(kind, name, table):
    """Return `table[name]`; raise TactipError that lists the valid names where there is none."""
    try:
        return table[name]
    except KeyError:
        raise TactipError(f"unknown {kind} {name!r}: choose one of {', '.join(map(str, table))}") from None
