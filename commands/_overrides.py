"""Options that, where they are given, replace what a configuration has."""

from dataclasses import fields, replace


def with_options(ranges, options):
    """A configuration (a dataclass) with the fields that options (a dataclass) give put in their place."""
    given = {f.name: getattr(options, f.name) for f in fields(options) if getattr(options, f.name) is not None}
    return replace(ranges, **given)
