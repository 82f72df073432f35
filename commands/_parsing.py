"""Commands, made from the command line: a command's options are the fields of a dataclass."""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, make_dataclass
from typing import Any, ClassVar, Self, TypeVar

import tyro

from tactip_twin.commands._help_text import fields_named, registry

T = TypeVar("T")


class Command(ABC):
    """A command; subclasses are dataclasses of its options."""

    common: ClassVar[tuple[str, ...]] = ()
    """Dotted names of the options that --help shows, where --help-all shows the others too; empty: --help shows all."""
    example: ClassVar[str] = ""
    """Command line that --help shows."""

    @classmethod
    def parse(cls, arguments: Sequence[str], prog: str) -> "Command":
        """Return the command of a command line.

        Args:
            arguments: Words after the command's name.
            prog: The words before, for messages.

        Raises:
            TactipError: A value is not allowed.
            SystemExit: For --help (0), and for options or choices that do not exist (2).
        """
        return parse_options(cls, arguments, prog, cls.defaults(arguments))

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> Self | None:
        """Return an instance with the defaults, if they depend on other options of the command line."""
        return None

    @abstractmethod
    def run(self) -> int:
        """Run the command. Return the exit status."""


@dataclass(frozen=True)
class Entry:
    """A command in a list of commands."""

    summary: str
    """One line for the list."""
    parse: Callable[[Sequence[str], str], Command]
    """Makes the command from the words after its name and the words up to it."""


def parse_options(options: type[T], arguments: Sequence[str], prog: str, default: T | None = None) -> T:
    """Return a dataclass from a command line; `default` has its defaults, tyro.MISSING for what must be given."""
    given: dict[str, Any] = {} if default is None else {"default": default}
    shown = None
    if "--help-all" in arguments:
        arguments = ["--help"]
    elif {"-h", "--help"} & set(arguments) and issubclass(options, Command) and options.example:
        given["description"] = f"{inspect.getdoc(options)}\n\nExample: {options.example}"
        if options.common:
            shown = fields_named(options, options.common)
            given["description"] += f"\n\nThese are the common options; {prog} --help-all lists all."
    return tyro.cli(options, args=arguments, prog=prog, registry=registry(shown), **given)


def parse_subcommand(table: Mapping[str, Entry], arguments: Sequence[str], prog: str, description: str) -> Command:
    """Return the command that the first word names; without one, show the list of commands or refuse."""
    if arguments and arguments[0] in table:
        return table[arguments[0]].parse(arguments[1:], f"{prog} {arguments[0]}")
    # Placeholders without options are enough for the list, so no command's module is loaded.
    arguments = ["--help" if word == "--help-all" else word for word in arguments]
    listed = {name: make_dataclass("Listed", (), namespace={"__doc__": entry.summary}) for name, entry in table.items()}
    tyro.extras.subcommand_cli_from_dict(listed, args=arguments, prog=prog, description=description)
    raise SystemExit(2)


def last_value(arguments: Sequence[str], option: str) -> str | None:
    """Return the last value of an option in a command line that is not parsed yet, or None if it is absent."""
    name, value = f"--{option}", None
    for word, after in zip(arguments, [*arguments, None][1:], strict=True):
        if word == name:
            value = after
        elif word.startswith(f"{name}="):
            value = word.partition("=")[2]
    return value
